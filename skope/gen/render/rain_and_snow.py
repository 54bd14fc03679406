"""Rain and falling snow in camera images.

Rain shows as streaks in the air and drops on the glass. Snow shows as small soft flakes far away and large blurred ones
nearby.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording
from skope.types import Pixels


@dataclass(frozen=True)
class FallingWater:
    """Settings of rain, drops on the glass and snow."""

    field_sizes: float = 1.25
    """Size of the field with streaks or flakes, in sizes of the image. Each frame shows a window of it."""
    streaks: int = 12000
    """Number of streaks in the field of a 1920x1080 image, in rain of 10 mm/h."""
    exposures_s: tuple[float, float] = (0.012, 0.025)
    """Minimum and maximum exposure time for the length of streaks, seconds. Cameras expose longer in rain."""
    drop_count: int = 9
    """Mean number of drops on the glass, in rain of 10 mm/h."""
    drop_stays_s: float = 6.0
    """Time that a drop stays on the glass, seconds."""
    flakes: int = 7000
    """Number of flakes in the field of a 1920x1080 image, in snow of 1 mm/h."""
    fall_mps: float = 1.3
    """Speed at which flakes fall, m/s."""
    flake_focal_px: float = 1100.0
    """Focal length for the size of flakes, pixels of an image that is 1920 pixels wide."""
    flake_size_m: float = 0.013
    """Size of a typical flake, metres."""
    nearest_m: float = 0.8
    """Distance of the nearest flakes from the camera, metres."""
    farthest_m: float = 9.0
    """Distance of the farthest flakes, metres."""


FALLING_WATER: Final = FallingWater()


class Rain:
    """Rain of one recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._rate = recording.conditions.rain_mm_h
        size = (recording.camera.width, recording.camera.height)
        rng = recording.rng(Stream.RAIN)
        shutter = float(np.clip(recording.conditions.shutter_s, *FALLING_WATER.exposures_s))
        if self._rate > 0:
            self._streaks = _streak_field(size, round(self._rate, 3), float(rng.uniform(-0.25, 0.25)), shutter)

    def fall(self, rgb: Pixels, frame: int) -> Pixels:
        """Return the image (H, W, 3) of a frame with rain."""
        if self._rate <= 0:
            return rgb
        rng = self._recording.rng(Stream.RAIN_IN_FRAME, frame)
        return self._put_drops_on_glass(fallen(rgb, self._streaks, rng), frame)

    def _put_drops_on_glass(self, rgb: Pixels, frame: int) -> Pixels:
        """Draw drops on the glass, which show the street upside down, out of focus and small."""
        time = float(self._recording.times_s[frame])
        rng = self._recording.rng(Stream.DROPS_ON_GLASS)
        span = float(self._recording.times_s[-1]) + 2 * FALLING_WATER.drop_stays_s
        count = int(
            rng.poisson(
                FALLING_WATER.drop_count * (self._rate / 10) ** 0.5 * max(span / FALLING_WATER.drop_stays_s, 1.0)
            )
        )
        height, width = rgb.shape[:2]
        soft: Pixels | None = None
        for x, y, size, flat, born in rng.uniform(0, 1, (count, 5)).tolist():
            if not 0 <= time + FALLING_WATER.drop_stays_s - born * span < FALLING_WATER.drop_stays_s:
                continue
            soft = _out_of_focus(rgb) if soft is None else soft
            radius = width * (0.004 + 0.011 * size * size)
            _draw_drop(rgb, soft, (x * width, y * height), radius, 1 + 0.35 * flat)
        return rgb


def fallen(rgb: Pixels, field: Pixels, rng: np.random.Generator) -> Pixels:
    """Return the image (H, W, 3) with streaks or flakes in front of it.

    `rng` draws a window of `field` (H', W'), a larger grey image.
    """
    height, width = rgb.shape[:2]
    rows, columns = field.shape
    y, x = int(rng.integers(rows - height + 1)), int(rng.integers(columns - width + 1))
    window = field[y : y + height, x : x + width]
    # Drops show the light around them. They stand out in front of areas that are neither bright nor dark.
    small = cv2.cvtColor(smaller(rgb, 16), cv2.COLOR_RGB2GRAY)
    around = cv2.GaussianBlur(small, (0, 0), 0.05 * small.shape[1]) / np.float32(255)
    light = cv2.resize((6 + 460 * around * (1 - around)).astype(np.uint8), (width, height))
    grey = cv2.multiply(window, light, scale=1 / 255)
    return np.asarray(cv2.add(rgb, cv2.cvtColor(grey, cv2.COLOR_GRAY2RGB)), dtype=np.uint8)


@lru_cache(maxsize=2)
def _streak_field(size: tuple[int, int], rate: float, slant: float, shutter: float) -> Pixels:
    """Return a field of streaks, from long faint ones near the camera to short ones far away."""
    width, height = (round(FALLING_WATER.field_sizes * side) for side in size)
    scale = size[0] / 1920
    rng = np.random.default_rng(17)
    count = int(FALLING_WATER.streaks * (rate / 10) ** 0.6)
    field: NDArray[Any] = np.zeros((height, width), dtype=np.uint8)
    # Closeness: most streaks are far away.
    near = rng.uniform(0, 1, count) ** 3
    # Drops fall at about 8 m/s, seen by a lens of 672 pixels' focal length from 1.5 to 12 m.
    length = np.clip(8.0 * shutter * 672 / (12 - 10.5 * near), 4, 140) * scale
    strength = (24 + 46 * near) * np.clip(22 / np.maximum(length / scale, 1), 0.45, 1.2)
    x, y = rng.uniform(0, width, count), rng.uniform(0, height, count)
    lean = slant + rng.normal(0, 0.03, count)
    for group in range(3):
        chosen = np.flatnonzero(np.minimum((near * 3).astype(int), 2) == group)
        layer = np.zeros_like(field)
        for k in chosen:
            ends = np.array([[x[k], y[k]], [x[k] + lean[k] * length[k], y[k] + length[k]]])
            (x0, y0), (x1, y1) = np.rint(ends * 16).astype(int).tolist()
            color = int(min(255, strength[k]))
            cv2.line(layer, (x0, y0), (x1, y1), color, 1 if group < 2 or scale < 0.6 else 2, cv2.LINE_AA, 4)
        blur = (0.45 + 0.45 * group) * max(scale, 0.5)
        field = cv2.add(field, cv2.GaussianBlur(layer, (0, 0), blur))
    return np.asarray(field, dtype=np.uint8)


def _out_of_focus(rgb: Pixels) -> Pixels:
    return np.asarray(cv2.GaussianBlur(smaller(rgb, 8), (0, 0), 1.5), dtype=np.uint8)


def smaller(rgb: Pixels, times: int) -> Pixels:
    """Return an image (H, W, 3) with its width and height divided by `times`."""
    size = (max(rgb.shape[1] // times, 1), max(rgb.shape[0] // times, 1))
    return np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _draw_drop(rgb: Pixels, soft: Pixels, center: tuple[float, float], radius: float, tall: float) -> None:
    """Draw one drop into the image."""
    height, width = rgb.shape[:2]
    cx, cy = center
    x0, x1 = max(int(cx - radius - 2), 0), min(int(cx + radius + 3), width)
    y0, y1 = max(int(cy - tall * radius - 2), 0), min(int(cy + tall * radius + 3), height)
    if x0 >= x1 or y0 >= y1:
        return
    x, y = np.meshgrid(np.arange(x0, x1, dtype=np.float32), np.arange(y0, y1, dtype=np.float32))
    dx, dy = (x - cx) / radius, (y - cy) / (tall * radius)
    away = np.sqrt(dx * dx + dy * dy)
    # A lens of short focal length: its rim shows objects far away on the other side.
    reach = 0.16 * width * away
    columns = np.clip(cx - dx * reach, 0, width - 1) / 8
    rows = np.clip(cy - dy * reach, 0, height - 1) / 8
    inside = cv2.remap(soft, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR)
    rim = np.clip(1.12 - 0.5 * away**4, 0, 1.12)[..., None]
    cover = 0.85 * np.clip((1 - away) * radius / 2.5, 0, 1)[..., None]
    window = rgb[y0:y1, x0:x1]
    window[...] = np.clip(window * (1 - cover) + inside * rim * cover, 0, 255).astype(np.uint8)


class Snowfall:
    """Falling snow of one recording."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        conditions, camera = recording.conditions, recording.camera
        self._field = None
        if conditions.snowfall_mm_h > 0:
            wind = float(recording.rng(Stream.RAIN).uniform(-1.5, 1.5))
            shutter = max(conditions.shutter_s, 0.002)
            self._field = _flake_field((camera.width, camera.height), round(conditions.snowfall_mm_h, 3), wind, shutter)

    def fall(self, rgb: Pixels, frame: int) -> Pixels:
        """Return the image (H, W, 3) of a frame with falling snow."""
        if self._field is None:
            return rgb
        return fallen(rgb, self._field, self._recording.rng(Stream.RAIN_IN_FRAME, frame))


@lru_cache(maxsize=2)
def _flake_field(size: tuple[int, int], rate: float, wind: float, shutter: float) -> Pixels:
    """Return a field of flakes, each as long as its motion during the exposure."""
    width, height = (round(FALLING_WATER.field_sizes * side) for side in size)
    scale = size[0] / 1920
    rng = np.random.default_rng(19)
    count = int(FALLING_WATER.flakes * rate**0.7)
    # Uniform in the volume before the camera: few flakes are near.
    away = (rng.uniform(FALLING_WATER.nearest_m**3, FALLING_WATER.farthest_m**3, count)) ** (1 / 3)
    radius = FALLING_WATER.flake_size_m * rng.uniform(0.4, 1.0, count) * FALLING_WATER.flake_focal_px * scale / away / 2
    way = FALLING_WATER.flake_focal_px * scale / away * shutter
    x, y = rng.uniform(0, width, count), rng.uniform(0, height, count)
    field: NDArray[Any] = np.zeros((height, width), dtype=np.uint8)
    for near in (False, True):
        layer = np.zeros_like(field)
        for k in np.flatnonzero((away < 3.0) == near).tolist():
            ends = np.array([[x[k], y[k]], [x[k] + wind * way[k], y[k] + FALLING_WATER.fall_mps * way[k]]])
            (x0, y0), (x1, y1) = np.rint(ends * 16).astype(int).tolist()
            # Flakes smaller than a pixel are fainter.
            strength = int(230 * min(1.0, (2 * radius[k]) ** 2 + 0.3) * (0.8 if near else 1.0))
            cv2.line(layer, (x0, y0), (x1, y1), strength, max(1, round(2 * radius[k])), cv2.LINE_AA, 4)
        blur = (2.2 if near else 0.6) * max(scale, 0.5)
        field = cv2.add(field, cv2.GaussianBlur(layer, (0, 0), blur))
    return np.asarray(field, dtype=np.uint8)
