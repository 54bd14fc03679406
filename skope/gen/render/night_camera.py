"""The night camera, from the linear light of a night to the picture: metering, two exposures, veiling glare, the curve,
noise and denoising.

Metering: the camera keeps its shutter and amplifies until the road has the brightness that it aims at, up to the
greatest gain. The figures are those of a common surveillance sensor: pixels of 4 micrometres behind a lens of F1.2
count about 20,000 electrons for each second at 1 cd/m2, and hold 15,000 (EMVA 1288 data of 1/1.8 inch sensors,
rounded).

Noise: its variance in electrons is the signal's own plus the reading's (EMVA 1288). Cameras average it over frames and
smooth it within areas between edges (Tomasi and Manduchi, Bilateral filtering, 1998). That takes the road's texture
away and leaves blotches of noise a few pixels wide.

Veiling glare: lens and sensor spread light around lamps, by a point-spread function on linear light before it is
clipped. It is a sum of Gaussians: scatter in the lens and reflections between its faces leave a narrow core and long
tails (McCann and Rizzi, The Art and Science of HDR Imaging, 2011, ch. 11). Blue light spreads most and green least, as
lateral and axial colour errors show around small lamps.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.daylight import Daylight
from skope.gen.scene.conditions import Conditions
from skope.types import Array, Pixels


@dataclass(frozen=True)
class NightSensor:
    """Sensor, exposure, noise and glare of the camera at night."""

    candela_per_unit: float = 200.0
    """Luminance at night of a radiance of 1 in the renderer's units, cd/m2: street lights then give 5 to 25 lux."""
    day_units: float = 50.0
    """How many times more luminance a radiance of 1 means by day (a sun of 100,000 lux has 10)."""
    road_level: float = 0.12
    """Light, where the sensor's range ends at 1, that the road is exposed to at 0 EV: 112 of 255 after the curve."""
    electrons_per_candela_second: float = 20_000.0
    """Electrons of a pixel per cd/m2 and second."""
    full_well_electrons: float = 15_000.0
    """Electrons of a full pixel."""
    short_exposure_range: float = 16.0
    """Ratio of the light that the short exposure takes to that of the long one."""
    single_exposure_range: float = 6.0
    """The same for the whole range of a camera that takes one exposure: its curve rolls off to white there."""
    balance_limits: tuple[float, float] = (0.5, 2.0)
    """Least and greatest factor of the white balance: cameras leave a part of sodium lamps' colour."""
    metered_from: float = 1 / 3
    """Share of the rows above the part that is metered."""
    lamps_from: float = 0.95
    """Pixels brighter than this share of the others are lamps, which the metering leaves out."""
    read_electrons: float = 2.5
    """Read noise, electrons."""
    usual_noise: float = 1.75
    """`Conditions.noise` of a usual sensor: others have more or less than the electrons say."""
    over_frames: float = 0.96
    """Share of the frames before in the average of the strongest denoising."""
    edge_deviations: float = 4.0
    """Differences of this many standard deviations of the noise are edges, which smoothing keeps."""
    least_edge: float = 32.0
    """Differences from which on they are edges for the strongest denoising, of 255, where noise is low."""
    smoothed_px: tuple[int, float] = (9, 4.0)
    """Width of the window within which areas are smoothed, and the standard deviation, in pixels of half the
    resolution."""
    detail_share: float = 0.5
    """Finer differences than those of half the resolution are taken away up to this share of the least edge."""
    blotches_px: float = 1.0
    """Standard deviation of the Gaussian that gives the noise that is left its blotches, pixels."""
    spreads_px: tuple[float, ...] = (1.2, 3.0, 7.0, 16.0, 45.0)
    """Standard deviations of the point-spread function in an image 1920 pixels wide."""
    dirt_share: float = 0.02
    """Share of light that the dirtiest glass spreads widest."""
    fog_share: float = 0.12
    """Share of light that fog spreads over the two widest, at a visibility of `fog_m`."""
    fog_m: float = 200.0
    curve_steps: int = 4096
    """Entries of the tone curve."""
    brightest_light: float = 1.0 + short_exposure_range
    """Light at which the curve's table ends; the picture is white long before."""


NIGHT_SENSOR: Final = NightSensor()


@dataclass(frozen=True, eq=False)
class Exposure:
    """How the camera exposes a scene."""

    gains: Array
    """(3,) factors on the light of each channel, after which the range of the long exposure ends at 1."""
    electrons: float
    """Electrons that a pixel counts at a light of 1."""
    short_share: float
    """Share of the short exposure in the blend; 0 for a camera that takes one exposure."""

    @property
    def full(self) -> float:
        """Light, after `gains`, at which the long exposure is full."""
        return 1.0 if self.short_share else NIGHT_SENSOR.single_exposure_range

    @property
    def uniforms(self) -> dict[str, Any]:
        """Values for composite.frag.glsl, which works on the light before `gains`."""
        return {
            "u_full": self.full / float(self.gains.mean()),
            "u_short": (self.short_share, NIGHT_SENSOR.short_exposure_range),
        }


def metered(
    light: NDArray[np.float32], depth: NDArray[np.float32], conditions: Conditions, daylight: Daylight
) -> Exposure:
    """Meter the scenery without vehicles.

    Args:
        light: (H, W, 3) linear light, as `daylight` exposes it.
        depth: (H, W) metres, +inf for the sky.
        conditions: `exposure_ev`, `gain_db`, `shutter_s`, `auto_white_balance` and `short_exposure` are used.
        daylight: The light of the recording.
    """
    rows = slice(int(NIGHT_SENSOR.metered_from * len(light)), None, 4)
    part, ground = light[rows, ::4], np.isfinite(depth[rows, ::4])
    pixels = part[ground] if ground.any() else part.reshape(-1, 3)
    luminance = pixels.mean(axis=1)
    road = pixels[luminance <= np.quantile(luminance, NIGHT_SENSOR.lamps_from)]
    level = max(float(np.median(road.mean(axis=1))), 1e-6)
    wanted = NIGHT_SENSOR.road_level * 2**conditions.exposure_ev / level
    # Electrons for each unit of light, and with them the gain that `wanted` takes.
    electrons = (
        NIGHT_SENSOR.candela_per_unit
        / daylight.exposure.mean()
        * conditions.shutter_s
        * NIGHT_SENSOR.electrons_per_candela_second
    )
    greatest = electrons * 10 ** (conditions.gain_db / 20) / NIGHT_SENSOR.full_well_electrons
    gain = min(wanted, greatest)
    color = np.maximum(np.median(road, axis=0), 1e-6)
    balance = np.clip((color.mean() / color) ** min(conditions.auto_white_balance, 1.0), *NIGHT_SENSOR.balance_limits)
    return Exposure(gain * balance, float(electrons / gain), conditions.short_exposure)


def noise_by_value(conditions: Conditions, exposure: Exposure, light: Array, shown: Array) -> NDArray[np.float32]:
    """(256,) standard deviation of the noise at each value of a picture, of 255, after averaging over frames.

    Args:
        conditions: `noise` and `denoising` are used.
        exposure: How the picture is exposed.
        light: (N,) rising amounts of light after the exposure's gains.
        shown: (N,) values from 0 to 1 that the camera's curve shows them as.
    """
    rise = np.gradient(shown, light)
    electrons = light * exposure.electrons
    sigma = 255 * rise * np.sqrt(electrons + NIGHT_SENSOR.read_electrons**2) / exposure.electrons
    before = NIGHT_SENSOR.over_frames * np.sqrt(conditions.denoising)
    sigma *= conditions.noise / NIGHT_SENSOR.usual_noise * np.sqrt((1 - before) / (1 + before))
    return np.asarray(np.interp(np.arange(256) / 255, shown, sigma), dtype=np.float32)


def denoised(rgb: Pixels, noise: NDArray[np.float32], conditions: Conditions) -> Pixels:
    """The picture (H, W, 3) without noise, smoothed between edges; `noise` is that of `noise_by_value`.

    It is smoothed at half its resolution. Pixels that differ from that by more than a threshold stay as they are.
    """
    if conditions.denoising <= 0:
        return rgb
    height, width = rgb.shape[:2]
    typical = float(np.median(noise[rgb[::16, ::16, 1]]))
    edge = conditions.denoising * max(NIGHT_SENSOR.edge_deviations * typical, NIGHT_SENSOR.least_edge)
    half = cv2.resize(rgb, (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA)
    window, deviation = NIGHT_SENSOR.smoothed_px
    flat = cv2.bilateralFilter(half, window, edge, deviation)
    smooth = cv2.resize(flat, (width, height), interpolation=cv2.INTER_LINEAR)
    red, green, blue = cv2.split(cv2.absdiff(rgb, smooth))
    kept = (cv2.max(cv2.max(red, green), blue) > NIGHT_SENSOR.detail_share * edge).view(np.uint8)
    return np.asarray(cv2.copyTo(rgb, kept, smooth), dtype=np.uint8)


_SPREAD_SHARES: Final = np.array([0.010, 0.010, 0.008, 0.0025, 0.0008])
"""Share of a lamp's light in each, for a glare of 1. Equal shares would fall off with the
square of the distance; these fall off faster beyond 15 pixels."""
_SPREAD_COLORS: Final = np.array(
    [[1.0, 0.95, 1.1], [1.0, 0.9, 1.25], [1.0, 0.88, 1.35], [1.0, 0.9, 1.2], [1.0, 1.0, 1.0]], dtype=np.float32
)
"""(5, 3) factors on red, green and blue."""


class VeilingGlare:
    """Spreads light beyond what pixels hold."""

    def __init__(self, width: int, conditions: Conditions) -> None:
        """`width` is the image's, pixels."""
        self._scale = width / 1920
        fog = NIGHT_SENSOR.fog_share * min(NIGHT_SENSOR.fog_m / conditions.visibility_m, 1.0)
        self._shares = conditions.glare * _SPREAD_SHARES
        self._shares[-2:] += 0.5 * fog
        self._shares[-1] += NIGHT_SENSOR.dirt_share * conditions.lens_dirt

    def spread(self, excess: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]] | None:
        """Three planes (H, W) of light that is added everywhere; None where there is none to spread.

        Args:
            excess: Three planes (H, W), red, green and blue, of the light beyond what pixels hold.
        """
        height, width = excess[0].shape
        size = (-(-width // 2), -(-height // 2))
        half = cv2.merge([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in excess])
        if not half.any():
            return None
        total = np.zeros((size[1], size[0], 3), dtype=np.float32)
        for spread_px, share, color in zip(NIGHT_SENSOR.spreads_px, self._shares, _SPREAD_COLORS, strict=True):
            sigma = spread_px * self._scale / 2
            # The wider it is, the coarser the grid that it is worked out on.
            step = max(1, 2 ** int(np.log2(max(sigma / 2, 1.0))))
            coarse = (max(1, size[0] // step), max(1, size[1] // step))
            small = half if step == 1 else cv2.resize(half, coarse, interpolation=cv2.INTER_AREA)
            blurred = cv2.GaussianBlur(small, (0, 0), max(sigma / step, 0.5), borderType=cv2.BORDER_CONSTANT)
            if step > 1:
                blurred = cv2.resize(blurred, size, interpolation=cv2.INTER_LINEAR)
            total += blurred * (np.float32(share) * color)
        planes = cv2.split(total)
        return [np.asarray(cv2.resize(plane, (width, height), interpolation=cv2.INTER_LINEAR)) for plane in planes]


class NightCamera:
    """A recording's camera, which meters the scenery once and develops each frame alike."""

    def __init__(
        self,
        light: NDArray[np.float32],
        depth: NDArray[np.float32],
        conditions: Conditions,
        daylight: Daylight,
    ) -> None:
        """`light` (H, W, 3) is the scenery's linear light without vehicles, `depth` (H, W) its depth, metres."""
        self.exposure = metered(light, depth, conditions, daylight)
        self._glare = VeilingGlare(light.shape[1], conditions)
        self._gains = np.append(self.exposure.gains, self.exposure.gains.mean()).astype(np.float32)
        steps = (
            np.arange(NIGHT_SENSOR.curve_steps) / (NIGHT_SENSOR.curve_steps - 1)
        ) ** 2 * NIGHT_SENSOR.brightest_light
        shown = curve(steps)
        self._table = np.rint(255 * shown).astype(np.uint8)
        self.noise = noise_by_value(conditions, self.exposure, steps, shown)
        """(256,) standard deviation of the noise at each value of the picture, of 255."""

    @property
    def gain(self) -> float:
        """Mean factor on the light before it is developed."""
        return float(self._gains[3])

    @property
    def uniforms(self) -> dict[str, Any]:
        """Values for composite.frag.glsl."""
        return self.exposure.uniforms

    def without_glare(self, picture: NDArray[np.float32]) -> Pixels:
        """(h, w, 3) what a part of the picture shows without veiling glare; see `develop`."""
        *light, full = self._exposed(picture)
        return _merged([self._shown(np.minimum(one, full)) for one in light])

    def develop(self, picture: NDArray[np.float32]) -> Pixels:
        """(H, W, 3) the picture of a frame.

        Args:
            picture: (H, W, 4) linear light of the blended exposures, and the light at which their blend is full.
        """
        *light, full = self._exposed(picture)
        kept = [np.minimum(one, full) for one in light]
        veil = self._glare.spread([one - part for one, part in zip(light, kept, strict=True)])
        if veil is None:
            return _merged([self._shown(part) for part in kept])
        # What it adds to each exposure ends where that is full.
        share, shown = self.exposure.short_share, []
        for part, more in zip(kept, veil, strict=True):
            room = np.maximum(np.float32(self.exposure.full) - part, 0)
            added = (1 - share) * np.minimum(more, room)
            if share:
                added += share * np.minimum(more, np.float32(NIGHT_SENSOR.short_exposure_range))
            shown.append(self._shown(np.asarray(part + added, dtype=np.float32)))
        return _merged(shown)

    def _exposed(self, picture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """The four planes of a picture after the camera's gains: OpenCV and numpy are fastest plane by plane."""
        planes = cv2.split(np.ascontiguousarray(picture))
        return [np.asarray(plane) * gain for plane, gain in zip(planes, self._gains, strict=True)]

    def _shown(self, light: NDArray[np.float32]) -> Pixels:
        """(h, w) values of a plane of light."""
        steps = np.asarray(
            cv2.sqrt(light * np.float32((NIGHT_SENSOR.curve_steps - 1) ** 2 / NIGHT_SENSOR.brightest_light))
        )
        return np.asarray(self._table[np.minimum(steps, NIGHT_SENSOR.curve_steps - 1).astype(np.uint16)])


def _merged(planes: Sequence[Pixels]) -> Pixels:
    return np.asarray(cv2.merge(planes), dtype=np.uint8)


def curve(light: Array) -> Array:
    """Values from 0 to 1 of a picture: Narkowicz' fit of the ACES filmic curve, then sRGB's, as display.glsl has it."""
    film = np.clip(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), 0, 1)
    return np.asarray(np.where(film <= 0.0031308, 12.92 * film, 1.055 * film ** (1 / 2.4) - 0.055))
