"""Camera effects on a rendered image.

They cover lens distortion, rain, snow, dirt on the glass and sensor noise. The effects of the camera's electronics and
stream follow: overlaid text, lower resolution, processing and compression.
"""

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
    """Numerical limits of the camera effects."""

    contrast_pivot: float = 118.0
    """Grey level that the contrast setting leaves unchanged, 0 to 255: that of a surface that reflects 18% of the
    light."""
    detail_px: float = 1.2
    """Standard deviation of the Gaussian that separates the finest detail, pixels of the stream."""
    overlay_year: int = 2025
    """Year in overlaid dates."""
    least_noise: float = 0.3
    """Standard deviation of the noise from rounding to whole grey levels."""
    table_slack: int = 256
    """Extra rows and columns of the noise field beyond the image, pixels. Each frame shows a window of the field."""
    rounding: int = 2
    """Maximum grey-level difference (0 to 255) at which a pixel counts as not drawn over."""


STREAM_EFFECTS: Final = StreamEffects()

_GREY_WEIGHTS: Final = np.array([0.299, 0.587, 0.114])
"""Weights of red, green and blue in the brightness of a pixel (ITU-R BT.601)."""


def processed(rgb: Pixels, conditions: Conditions) -> Pixels:
    """Return an image (H, W, 3) after the camera's processing; the same array if the camera changes nothing."""
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
    """Return the tone table (256,): the output value for each value of the sensor."""
    values = STREAM_EFFECTS.contrast_pivot + contrast * (np.arange(256) - STREAM_EFFECTS.contrast_pivot)
    lifted = black_level + (1 - black_level / 255) * np.clip(values, 0, 255)
    return np.asarray(np.rint(lifted), dtype=np.uint8)


def _as_image(rgb: object) -> Pixels:
    return np.asarray(rgb, dtype=np.uint8)


_LABEL_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


def streamed(rgb: Pixels, recording: Recording, frame: int) -> Pixels:
    """Return a frame (H, W, 3) as it leaves the recording's stream."""
    conditions = recording.conditions
    height, width = rgb.shape[:2]
    if conditions.screen_text >= 0.5:
        _write_overlay_text(rgb, recording, frame)
    size = tuple(max(8, round(side * conditions.rescale)) for side in (width, height))
    small = rgb if size == (width, height) else np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA))
    small = processed(small.astype(np.uint8, copy=False), conditions)
    if conditions.compression_quality < 100:
        # Red and blue are swapped before and after, so that the codec's chroma uses the right colours.
        quality = [cv2.IMWRITE_JPEG_QUALITY, round(conditions.compression_quality)]
        _, data = cv2.imencode(".jpg", small[..., ::-1], quality)
        decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
        assert decoded is not None
        small = np.asarray(decoded[..., ::-1], dtype=np.uint8)
    if small.shape != rgb.shape:
        small = cv2.resize(np.ascontiguousarray(small), (width, height), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(small, dtype=np.uint8)


def _write_overlay_text(rgb: Pixels, recording: Recording, frame: int) -> None:
    """Write the date and time at the top and the site's name at the bottom, in white with a dark outline."""
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
    """Renderer that returns the views of the recording's own camera, with its lens, dirt, weather and noise."""

    def __init__(self, recording: Recording, make: Callable[[Recording], Renderer]) -> None:
        """Store the recording.

        Args:
            recording: The recording to draw.
            make: Makes the renderer; called with the recording and a camera without distortion.
        """
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
        """Draw a frame. Its contrast is in multiples of the difference that noise and compression hide."""
        view = self._clean.render(frame)
        if self._lens:
            view = self._lens.bend(view)
        if self._recording.photograph is not None and self._bent is not None:
            # Use the photograph itself where nothing was drawn over it, because two warps blur it.
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
    """Return whether the infrared filter is off, so that the image is grey."""
    return conditions.infrared >= 0.5 and conditions.sun_elevation_deg < DARK_DEG


def sigma_of(conditions: Conditions) -> float:
    """Return the standard deviation of the noise, in grey levels (0 to 255).

    It grows more slowly than the square root of the gain, because cameras smooth the noise.
    """
    return float(conditions.noise * 10 ** (conditions.gain_db / 60))


def hidden_below(conditions: Conditions, sigma: float | None = None) -> float:
    """Return the grey-level difference (0 to 255) that noise and compression hide.

    It is the largest of three values: the standard deviation of the noise, that of rounding to grey levels, and the
    step in which JPEG rounds the mean of a block of 8 x 8 pixels. The step is 16 / 8 at quality 50, scaled as in
    libjpeg for other qualities. It is divided by `conditions.contrast`, by which the camera multiplies differences
    before it compresses.

    Args:
        conditions: Conditions of the recording.
        sigma: Standard deviation of the noise; None: the value that follows from the conditions.
    """
    quality, step = conditions.compression_quality, 0.0
    if quality < 100:
        step = 2 * (50 / quality if quality < 50 else 2 - quality / 50) / conditions.contrast
    return max(sigma_of(conditions) if sigma is None else sigma, STREAM_EFFECTS.least_noise, step)


@lru_cache(maxsize=2)
def _standard_noise(height: int, width: int, channels: int) -> NDArray[np.float32]:
    """Return (height, width, channels) independent noise of standard deviation 1.

    It covers an image and `STREAM_EFFECTS.table_slack` more pixels on each axis.
    """
    return np.random.default_rng(5).standard_normal(
        (height + STREAM_EFFECTS.table_slack, width + STREAM_EFFECTS.table_slack, channels), dtype=np.float32
    )


@lru_cache(maxsize=2)
def _left_noise(height: int, width: int, mono: bool, blotches_px: float) -> NDArray[np.float32]:
    """Return (height, width, 3) residual noise of a night camera with standard deviation 1, sized as `_standard_noise`.

    A Gaussian with standard deviation `blotches_px` smooths it; 0 means no smoothing.
    """
    noise = _standard_noise(height, width, 1 if mono else 3)
    if not mono:
        # A part of the noise is common to the channels, because each channel is computed from pixels of all colours.
        noise = 0.6 * noise + 0.4 * noise.sum(axis=-1, keepdims=True)
    if blotches_px:
        noise = np.asarray(cv2.GaussianBlur(noise, (0, 0), blotches_px), dtype=np.float32).reshape(noise.shape)
    return np.ascontiguousarray(np.broadcast_to(noise / noise.std(), (*noise.shape[:2], 3)), dtype=np.float32)


@lru_cache(maxsize=2)
def _noise_field(height: int, width: int, sigma: float, gain_db: float, mono: bool) -> NDArray[np.uint8]:
    """Return (2, height, width, 3): the noise that is added and the noise that is subtracted.

    The field covers an image and `STREAM_EFFECTS.table_slack` more pixels on each axis. With more gain, a larger part
    of the noise is in blotches, because cameras smooth the finest noise away. With `mono` the noise has no colours.
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
    # Both parts are bytes, as the image is: OpenCV adds bytes in half the time.
    return np.stack([np.clip(sign * noise, 0, 255).astype(np.uint8) for sign in (1, -1)])


def with_noise(clean: NDArray[np.uint8], recording: Recording, frame: int) -> NDArray[np.uint8]:
    """Return the image (H, W, 3) with the noise of this frame.

    The noise depends only on seed, site, recording and frame. Each frame uses a different window of one noise field,
    because drawing 6 million random numbers per frame would take longer than rendering it.
    """
    conditions = recording.conditions
    field = _noise_field(*clean.shape[:2], sigma_of(conditions), conditions.gain_db, grey(conditions))
    more, less = field[:, *_noise_window(clean, recording, frame)]
    noisy = cv2.add(clean, more)
    return np.asarray(cv2.subtract(noisy, less, dst=noisy), dtype=np.uint8)


def _noise_window(clean: NDArray[np.uint8], recording: Recording, frame: int) -> tuple[slice, slice]:
    """Return the rows and columns of this frame's window in a noise field that is larger than the image."""
    y, x = recording.rng(Stream.SENSOR_NOISE, frame).integers(0, STREAM_EFFECTS.table_slack, 2)
    height, width = clean.shape[:2]
    return slice(y, y + height), slice(x, x + width)


def with_metered_noise(
    clean: NDArray[np.uint8], noise: NDArray[np.float32], recording: Recording, frame: int
) -> NDArray[np.uint8]:
    """Return the image (H, W, 3) with noise of this frame.

    Its standard deviation (256,) depends on each pixel's value.
    """
    conditions = recording.conditions
    blotches_px = NIGHT_SENSOR.blotches_px if conditions.denoising > 0 else 0.0
    field = _left_noise(*clean.shape[:2], grey(conditions), blotches_px)
    frame_noise = cv2.multiply(cv2.LUT(clean, noise), field[_noise_window(clean, recording, frame)])
    return np.asarray(cv2.add(clean, frame_noise, dtype=cv2.CV_8U), dtype=np.uint8)
