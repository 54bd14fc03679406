"""Night camera: from the linear light of a night to the image.

The steps are metering, two exposures, veiling glare, the tone curve, noise and denoising.

Metering: the camera keeps its shutter and amplifies until the road has the target brightness, up to the maximum gain.
The figures are those of a common surveillance sensor. Pixels of 4 micrometres behind a lens of F1.2 count about 20,000
electrons per second at 1 cd/m2, and hold 15,000 (EMVA 1288 data of 1/1.8 inch sensors, rounded).

Noise: its variance in electrons is that of the signal plus that of the readout (EMVA 1288). Cameras average it over
frames and smooth it within areas between edges (Tomasi and Manduchi, Bilateral filtering, 1998). That removes the
texture of the road and leaves blotches of noise a few pixels wide.

Veiling glare: lens and sensor spread light around lamps. It is a point-spread function on linear light before clipping,
modelled as a sum of Gaussians. Scatter in the lens and reflections between its faces leave a narrow core and long tails
(McCann and Rizzi, The Art and Science of HDR Imaging, 2011, ch. 11). Blue light spreads most and green least, as
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
    """Luminance of a radiance of 1 in the renderer's units at night, cd/m2. Street lights then give 5 to 25 lux."""
    day_units: float = 50.0
    """Ratio of the luminance of a radiance of 1 by day to that at night (a sun of 100,000 lux has a radiance of 10)."""
    road_level: float = 0.16
    """Target light of the road at 0 EV, as a share of the sensor's range: 132 of 255 after the tone curve."""
    electrons_per_candela_second: float = 20_000.0
    """Electrons of a pixel per cd/m2 and second."""
    full_well_electrons: float = 15_000.0
    """Full-well capacity of a pixel, electrons."""
    short_exposure_range: float = 16.0
    """Ratio of the range of the short exposure to that of the long exposure."""
    single_exposure_range: float = 6.0
    """Range of a camera that takes one exposure, in the same unit. Its curve rolls off to white there."""
    balance_limits: tuple[float, float] = (0.5, 2.0)
    """Minimum and maximum factor of the white balance. Cameras keep a part of the colour of sodium lamps."""
    metered_from: float = 1 / 3
    """Share of the image rows above the part that is metered."""
    road_quantile: float = 0.7
    """Quantile of luminance that counts as the road's: its surroundings are darker."""
    lamps_from: float = 0.95
    """Quantile of luminance above which pixels count as lamps, which the metering ignores."""
    read_electrons: float = 2.5
    """Read noise, electrons."""
    usual_noise: float = 1.75
    """`Conditions.noise` of a typical sensor. Other values scale the noise that follows from the electrons."""
    over_frames: float = 0.96
    """Weight of earlier frames in the temporal average at the strongest denoising."""
    edge_deviations: float = 4.0
    """Edge threshold of the smoothing, standard deviations of the noise."""
    least_edge: float = 32.0
    """Minimum edge threshold at the strongest denoising, grey levels (0 to 255). Used if the noise is low."""
    smoothed_px: tuple[int, float] = (9, 4.0)
    """Width of the smoothing window, and its standard deviation, pixels of half the resolution."""
    detail_share: float = 0.5
    """Details finer than half the resolution are removed up to this share of the edge threshold."""
    blotches_px: float = 1.0
    """Standard deviation of the Gaussian that turns the residual noise into blotches, pixels."""
    spreads_px: tuple[float, ...] = (1.2, 3.0, 7.0, 16.0, 45.0)
    """Standard deviations of the point-spread function in an image that is 1920 pixels wide, pixels."""
    dirt_share: float = 0.02
    """Share of light that the dirtiest glass adds to the widest Gaussian."""
    fog_share: float = 0.12
    """Share of light that fog spreads over the two widest Gaussians, at a visibility of `fog_m`."""
    fog_m: float = 200.0
    curve_steps: int = 4096
    """Entries of the tone curve."""
    brightest_light: float = 1.0 + short_exposure_range
    """Light at which the table of the curve ends; the image is white well below it."""


NIGHT_SENSOR: Final = NightSensor()


@dataclass(frozen=True, eq=False)
class Exposure:
    """Exposure of a scene by the camera."""

    gains: Array
    """(3,) factor on the light of each channel, after which the range of the long exposure ends at 1."""
    electrons: float
    """Electrons that a pixel counts at a light of 1."""
    short_share: float
    """Share of the short exposure in the blend; 0 for a camera that takes one exposure."""

    @property
    def full(self) -> float:
        """Light, after `gains`, at which the long exposure saturates."""
        return 1.0 if self.short_share else NIGHT_SENSOR.single_exposure_range

    @property
    def uniforms(self) -> dict[str, Any]:
        """Return the uniforms of composite.frag.glsl, which works on the light before `gains`."""
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
    level = max(float(np.quantile(road.mean(axis=1), NIGHT_SENSOR.road_quantile)), 1e-6)
    wanted = NIGHT_SENSOR.road_level * 2**conditions.exposure_ev / level
    # Electrons per unit of light, from which the gain for `wanted` follows.
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
    """Return the standard deviation (256,) of the noise at each pixel value, after averaging over frames.

    The unit is grey levels (0 to 255).

    Args:
        conditions: `noise` and `denoising` are used.
        exposure: Exposure of the image.
        light: (N,) increasing amounts of light after the exposure's gains.
        shown: (N,) output of the camera's curve for `light`, 0 to 1.
    """
    rise = np.gradient(shown, light)
    electrons = light * exposure.electrons
    sigma = 255 * rise * np.sqrt(electrons + NIGHT_SENSOR.read_electrons**2) / exposure.electrons
    before = NIGHT_SENSOR.over_frames * np.sqrt(conditions.denoising)
    sigma *= conditions.noise / NIGHT_SENSOR.usual_noise * np.sqrt((1 - before) / (1 + before))
    return np.asarray(np.interp(np.arange(256) / 255, shown, sigma), dtype=np.float32)


def denoised(rgb: Pixels, noise: NDArray[np.float32], conditions: Conditions) -> Pixels:
    """Return the image (H, W, 3) without noise, smoothed between edges.

    The image is smoothed at half its resolution. Pixels that differ from the result by more than a threshold stay as
    they are. `noise` is the table of `noise_by_value`.
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
"""Share of a lamp's light in each Gaussian, for a glare of 1. Equal shares would fall off with the square of the
distance; these fall off faster beyond 15 pixels."""
_SPREAD_COLORS: Final = np.array(
    [[1.0, 0.95, 1.1], [1.0, 0.9, 1.25], [1.0, 0.88, 1.35], [1.0, 0.9, 1.2], [1.0, 1.0, 1.0]], dtype=np.float32
)
"""(5, 3) factors of each Gaussian on red, green and blue."""


class VeilingGlare:
    """Spreads the light that exceeds the capacity of pixels."""

    def __init__(self, width: int, conditions: Conditions) -> None:
        """Set the shares of light; `width` is that of the image, pixels."""
        self._scale = width / 1920
        fog = NIGHT_SENSOR.fog_share * min(NIGHT_SENSOR.fog_m / conditions.visibility_m, 1.0)
        self._shares = conditions.glare * _SPREAD_SHARES
        self._shares[-2:] += 0.5 * fog
        self._shares[-1] += NIGHT_SENSOR.dirt_share * conditions.lens_dirt

    def spread(self, excess: Sequence[NDArray[np.float32]]) -> list[NDArray[np.float32]] | None:
        """Return three planes (H, W) of light to add to the image; None if there is none to spread.

        Args:
            excess: Three planes (H, W), red, green and blue, of the light that exceeds the capacity of pixels.
        """
        height, width = excess[0].shape
        size = (-(-width // 2), -(-height // 2))
        half = cv2.merge([cv2.resize(plane, size, interpolation=cv2.INTER_AREA) for plane in excess])
        if not half.any():
            return None
        total = np.zeros((size[1], size[0], 3), dtype=np.float32)
        for spread_px, share, color in zip(NIGHT_SENSOR.spreads_px, self._shares, _SPREAD_COLORS, strict=True):
            sigma = spread_px * self._scale / 2
            # A wider Gaussian is computed on a coarser grid.
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
    """A recording's camera, which meters the scenery once and develops all frames with that exposure."""

    def __init__(
        self,
        light: NDArray[np.float32],
        depth: NDArray[np.float32],
        conditions: Conditions,
        daylight: Daylight,
    ) -> None:
        """Meter the scenery.

        Args:
            light: (H, W, 3) linear light of the scenery without vehicles.
            depth: (H, W) its depth, metres.
            conditions: Conditions of the recording.
            daylight: The light of the recording.
        """
        self.exposure = metered(light, depth, conditions, daylight)
        self._glare = VeilingGlare(light.shape[1], conditions)
        self._gains = np.append(self.exposure.gains, self.exposure.gains.mean()).astype(np.float32)
        steps = (
            np.arange(NIGHT_SENSOR.curve_steps) / (NIGHT_SENSOR.curve_steps - 1)
        ) ** 2 * NIGHT_SENSOR.brightest_light
        shown = curve(steps)
        self._table = np.rint(255 * shown).astype(np.uint8)
        self.noise = noise_by_value(conditions, self.exposure, steps, shown)
        """(256,) standard deviation of the noise at each pixel value, grey levels (0 to 255)."""

    @property
    def gain(self) -> float:
        """Mean factor on the light before it is developed."""
        return float(self._gains[3])

    @property
    def uniforms(self) -> dict[str, Any]:
        """Return the uniforms of composite.frag.glsl."""
        return self.exposure.uniforms

    def without_glare(self, picture: NDArray[np.float32]) -> Pixels:
        """Return a part (h, w, 3) of the image without veiling glare; see `develop`."""
        *light, full = self._exposed(picture)
        return _merged([self._shown(np.minimum(plane, full)) for plane in light])

    def develop(self, picture: NDArray[np.float32]) -> Pixels:
        """Return the developed image (H, W, 3) of a frame.

        Args:
            picture: (H, W, 4) linear light of the blended exposures, and the light at which their blend saturates.
        """
        *light, full = self._exposed(picture)
        kept = [np.minimum(plane, full) for plane in light]
        veil = self._glare.spread([plane - part for plane, part in zip(light, kept, strict=True)])
        if veil is None:
            return _merged([self._shown(part) for part in kept])
        # The added light of each exposure ends where the exposure saturates.
        share, shown = self.exposure.short_share, []
        for part, more in zip(kept, veil, strict=True):
            room = np.maximum(np.float32(self.exposure.full) - part, 0)
            added = (1 - share) * np.minimum(more, room)
            if share:
                added += share * np.minimum(more, np.float32(NIGHT_SENSOR.short_exposure_range))
            shown.append(self._shown(np.asarray(part + added, dtype=np.float32)))
        return _merged(shown)

    def _exposed(self, picture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Return the four planes of an image after the camera's gains; OpenCV and numpy are fastest plane by plane."""
        planes = cv2.split(np.ascontiguousarray(picture))
        return [np.asarray(plane) * gain for plane, gain in zip(planes, self._gains, strict=True)]

    def _shown(self, light: NDArray[np.float32]) -> Pixels:
        """Return the pixel values (h, w) of a plane of light."""
        steps = np.asarray(
            cv2.sqrt(light * np.float32((NIGHT_SENSOR.curve_steps - 1) ** 2 / NIGHT_SENSOR.brightest_light))
        )
        return np.asarray(self._table[np.minimum(steps, NIGHT_SENSOR.curve_steps - 1).astype(np.uint16)])


def _merged(planes: Sequence[Pixels]) -> Pixels:
    return np.asarray(cv2.merge(planes), dtype=np.uint8)


def curve(light: Array) -> Array:
    """Return output values from 0 to 1: Narkowicz' fit of the ACES filmic curve, then sRGB's, as in display.glsl."""
    film = np.clip(light * (2.51 * light + 0.03) / (light * (2.43 * light + 0.59) + 0.14), 0, 1)
    return np.asarray(np.where(film <= 0.0031308, 12.92 * film, 1.055 * film ** (1 / 2.4) - 0.055))
