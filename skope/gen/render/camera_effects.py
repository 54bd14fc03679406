"""Effects of the camera on a clean picture: the lens' distortion, rain, snow and dirt before it, noise; what its
electronics and stream do, which is text, less resolution, processing and compression."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from datetime import date, timedelta
from functools import lru_cache
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.gen.render.frame import RenderedFrame, Renderer
from skope.gen.render.lens import Lens, LensDirt
from skope.gen.render.night_camera import NIGHT_SENSOR, denoised
from skope.gen.render.rain_and_snow import Rain, Snowfall
from skope.gen.render.screen_graphics import ScreenGraphics
from skope.gen.scene.conditions import DARK_DEG, Conditions
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording
from skope.types import Pixels


@dataclass(frozen=True)
class StreamEffects:
    """Numerical limits of the camera's effects."""

    contrast_pivot: float = 118.0
    """Value that contrast leaves unchanged, of 255: that of a surface which reflects 18% of the light."""
    detail_px: float = 1.2
    """Standard deviation of the Gaussian that separates the finest detail, pixels of the stream."""
    overlay_year: int = 2025
    """Year in overlaid dates."""
    least_noise: float = 0.3
    """Noise of rounding to whole values, standard deviation."""
    table_slack: int = 256
    """Entries of the tone table beyond its range."""
    rounding: int = 2
    """Difference up to which a pixel was not drawn over, of 255."""


STREAM_EFFECTS: Final = StreamEffects()

_GREY_WEIGHTS: Final = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in a pixel's brightness (ITU-R BT.601)."""


def processed(rgb: Pixels, conditions: Conditions) -> Pixels:
    """A picture (H, W, 3) as the camera sends it; the very same array where the camera changes nothing."""
    if conditions.contrast != 1 or conditions.black_level:
        rgb = _as_image(cv2.LUT(rgb, _tones(conditions.contrast, conditions.black_level)))
    if conditions.saturation != 1:
        grey = np.broadcast_to(_GREY_WEIGHTS, (3, 3))
        rgb = _as_image(cv2.transform(rgb, conditions.saturation * (np.eye(3) - grey) + grey))
    if conditions.sharpening:
        smooth = cv2.GaussianBlur(rgb, (0, 0), STREAM_EFFECTS.detail_px)
        rgb = _as_image(cv2.addWeighted(rgb, 1 + conditions.sharpening, smooth, -conditions.sharpening, 0))
    return rgb


def _tones(contrast: float, black_level: float) -> Pixels:
    """(256,) what each value of the sensor's picture is shown as."""
    values = STREAM_EFFECTS.contrast_pivot + contrast * (np.arange(256) - STREAM_EFFECTS.contrast_pivot)
    lifted = black_level + (1 - black_level / 255) * np.clip(values, 0, 255)
    return np.asarray(np.rint(lifted), dtype=np.uint8)


def _as_image(rgb: object) -> Pixels:
    return np.asarray(rgb, dtype=np.uint8)


_LABEL_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


def streamed(rgb: Pixels, recording: Recording, frame: int) -> Pixels:
    """A frame (H, W, 3) as it comes out of a recording's stream."""
    conditions = recording.conditions
    height, width = rgb.shape[:2]
    if conditions.screen_text >= 0.5:
        _write_overlay_text(rgb, recording, frame)
    size = tuple(max(8, round(side * conditions.rescale)) for side in (width, height))
    small = rgb if size == (width, height) else np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    small = processed(small.astype(np.uint8, copy=False), conditions)
    if conditions.compression_quality < 100:
        # Red and blue are swapped for both ways, so that the codec's chroma is that of the right colours.
        quality = [cv2.IMWRITE_JPEG_QUALITY, round(conditions.compression_quality)]
        _, data = cv2.imencode(".jpg", small[..., ::-1], quality)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert decoded is not None
        small = np.asarray(decoded[..., ::-1], dtype=np.uint8)
    if small.shape != rgb.shape:
        small = cv2.resize(np.ascontiguousarray(small), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(small, dtype=np.uint8)


def _write_overlay_text(rgb: Pixels, recording: Recording, frame: int) -> None:
    """Date and time above, the site's name below, in white with a dark edge."""
    height, width = rgb.shape[:2]
    conditions = recording.conditions
    seconds = round(3600 * conditions.hour + float(recording.times_s[frame]))
    day = date(STREAM_EFFECTS.overlay_year, 1, 1) + timedelta(days=int(conditions.day) - 1 + seconds // 86400)
    clock = f"{seconds // 3600 % 24:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"
    scale, margin = width / 1920 * 1.3, round(0.02 * width)
    line = max(1, round(2 * scale))
    lines = {
        f"{day:%Y-%m-%d} {clock}": margin + round(30 * scale),
        recording.site.upper().replace("_", " "): height - margin,
    }
    for text, y in lines.items():
        for dx, dy in ((-line, 0), (line, 0), (0, -line), (0, line)):
            cv2.putText(rgb, text, (margin + dx, y + dy), _LABEL_FONT, scale, (20, 20, 20), line, cv2.LINE_AA)
        cv2.putText(rgb, text, (margin, y), _LABEL_FONT, scale, (245, 245, 245), line, cv2.LINE_AA)


class Sensor:
    """A renderer whose views are those of the recording's own camera."""

    def __init__(self, recording: Recording, make: Callable[[Recording], Renderer]) -> None:
        """`make` is given the recording with a camera that has no distortion."""
        self._recording = recording
        self._lens = None if recording.camera.distortion.model == "none" else Lens(recording.camera)
        seen, self._bent = recording, None
        if self._lens:
            photograph = recording.photograph
            straight = None if photograph is None else self._lens.straightened(photograph)
            self._bent = None if straight is None else self._lens.bent(straight)
            seen = replace(recording, camera=self._lens.pinhole, photograph=straight)
        self._rain, self._snowfall, self._dirt = Rain(recording), Snowfall(recording), LensDirt(recording)
        self._graphics = ScreenGraphics(recording)
        self._clean = make(seen)

    def render(self, frame: int) -> RenderedFrame:
        """Draw a frame; its contrast is in units of what noise and compression hide."""
        view = self._clean.render(frame)
        if self._lens:
            view = self._lens.bend(view)
        if self._recording.photograph is not None and self._bent is not None:
            # The photograph itself where nothing was drawn over it, for going through two warps blurs it.
            untouched = cv2.absdiff(view.rgb, self._bent).max(axis=-1, keepdims=True) <= STREAM_EFFECTS.rounding
            view = replace(view, rgb=np.where(untouched, self._recording.photograph, view.rgb))
        conditions = self._recording.conditions
        rgb = self._dirt.soil(self._snowfall.fall(self._rain.fall(view.rgb, frame), frame))
        if grey(conditions):
            rgb = np.asarray(cv2.cvtColor(cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB), dtype=np.uint8)
        if view.noise is None:
            rgb, hidden = with_noise(rgb, self._recording, frame), hidden_below(conditions)
        else:
            rgb = with_metered_noise(denoised(rgb, view.noise, conditions), view.noise, self._recording, frame)
            hidden = hidden_below(conditions, sigma=float(np.median(view.noise)))
        rgb = streamed(self._graphics.draw(rgb), self._recording, frame)
        return replace(view, rgb=rgb, contrast=view.contrast / hidden)


def grey(conditions: Conditions) -> bool:
    """Whether the camera has swung its infrared filter away."""
    return conditions.infrared >= 0.5 and conditions.sun_elevation_deg < DARK_DEG


def sigma_of(conditions: Conditions) -> float:
    """Standard deviation of the noise, of 255: it grows with less than the root of the gain, as cameras smooth it."""
    return float(conditions.noise * 10 ** (conditions.gain_db / 60))


def hidden_below(conditions: Conditions, sigma: float | None = None) -> float:
    """Difference that noise and compression hide, of 255; `sigma` is the noise's, None for that of the conditions.

    The standard deviation of the noise, or the step in which JPEG rounds the mean of a block of 8 x 8 pixels (16 / 8 at
    quality 50, by libjpeg's scale at others), whichever is more; the step is one of the picture that is compressed,
    whose differences the camera has multiplied by its contrast.
    """
    quality, step = conditions.compression_quality, 0.0
    if quality < 100:
        step = 2 * (50 / quality if quality < 50 else 2 - quality / 50) / conditions.contrast
    return max(sigma_of(conditions) if sigma is None else sigma, STREAM_EFFECTS.least_noise, step)


@lru_cache(maxsize=2)
def _standard_noise(height: int, width: int, channels: int) -> NDArray[np.float32]:
    """(height, width, channels) independent noise of standard deviation 1, for an image and
    `STREAM_EFFECTS.table_slack` pixels more."""
    return np.random.default_rng(5).standard_normal(
        (height + STREAM_EFFECTS.table_slack, width + STREAM_EFFECTS.table_slack, channels), dtype=np.float32
    )


@lru_cache(maxsize=2)
def _left_noise(height: int, width: int, mono: bool, blotches_px: float) -> NDArray[np.float32]:
    """(height, width, 3) noise of standard deviation 1 that a night camera leaves, sized as `_standard_noise`.

    It is smoothed by a Gaussian of `blotches_px`, 0 for none.
    """
    noise = _standard_noise(height, width, 1 if mono else 3)
    if not mono:
        # A part of it is common to the channels, as each is worked out from pixels of all colours.
        noise = 0.6 * noise + 0.4 * noise.sum(axis=-1, keepdims=True)
    if blotches_px:
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), blotches_px), dtype=np.float32).reshape(noise.shape)
    return np.ascontiguousarray(np.broadcast_to(noise / noise.std(), (*noise.shape[:2], 3)), dtype=np.float32)


@lru_cache(maxsize=2)
def _noise_field(height: int, width: int, sigma: float, gain_db: float, mono: bool) -> NDArray[np.uint8]:
    """(2, height, width, 3) what noise adds and takes, for an image and `STREAM_EFFECTS.table_slack` pixels more on
    each axis.

    With gain more and more of it is in blotches, as cameras smooth the finest of it away; `mono` has no colours.
    """
    noise = _standard_noise(height, width, 1 if mono else 3)
    if not mono and gain_db > 0:
        noise = 0.5 * noise + 0.5 * noise.mean(axis=-1, keepdims=True)
    share = min(gain_db / 80, 0.5)
    if share > 0:
        blotches = cv2.GaussianBlur(noise, (0, 0), 1.1).reshape(noise.shape)
        noise = (1 - share) * noise + share * blotches / blotches.std()
        noise = noise / noise.std()
    noise = np.broadcast_to(np.rint(sigma * noise), (*noise.shape[:2], 3))
    # Apart they are bytes, as the image is, which OpenCV adds in half the time.
    return np.stack([np.clip(sign * noise, 0, 255).astype(np.uint8) for sign in (1, -1)])


def with_noise(clean: NDArray[np.uint8], recording: Recording, frame: int) -> NDArray[np.uint8]:
    """(H, W, 3) with the noise of this frame, which depends on seed, site, recording and frame alone.

    A window of one field, at a place of its own in each frame: drawing 6 million numbers a frame would take longer
    than rendering it.
    """
    conditions = recording.conditions
    field = _noise_field(*clean.shape[:2], sigma_of(conditions), conditions.gain_db, grey(conditions))
    more, less = field[:, *_noise_window(clean, recording, frame)]
    noisy = cv2.add(clean, more)
    return np.asarray(cv2.subtract(noisy, less, dst=noisy), dtype=np.uint8)


def _noise_window(clean: NDArray[np.uint8], recording: Recording, frame: int) -> tuple[slice, slice]:
    """Rows and columns of the noise that this frame has, in a field larger than the image."""
    y, x = recording.rng(Stream.SENSOR_NOISE, frame).integers(0, STREAM_EFFECTS.table_slack, 2)
    height, width = clean.shape[:2]
    return slice(y, y + height), slice(x, x + width)


def with_metered_noise(
    clean: NDArray[np.uint8], noise: NDArray[np.float32], recording: Recording, frame: int
) -> NDArray[np.uint8]:
    """(H, W, 3) with noise of this frame whose standard deviation, (256,), follows from each pixel's value."""
    conditions = recording.conditions
    blotches_px = NIGHT_SENSOR.blotches_px if conditions.denoising > 0 else 0.0
    field = _left_noise(*clean.shape[:2], grey(conditions), blotches_px)
    own = cv2.multiply(cv2.LUT(clean, noise), field[_noise_window(clean, recording, frame)])
    return np.asarray(cv2.add(clean, own, dtype=cv2.CV_8U), dtype=np.uint8)
