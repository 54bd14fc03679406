"""Effects of a camera's electronics and stream on a picture: text, less resolution, processing, compression."""

from datetime import date, timedelta
from typing import Final

import cv2
import numpy as np

from skope.gen.render.image_signal_processing import processed
from skope.gen.scene.recording import Recording
from skope.types import Pixels

_YEAR: Final = 2025
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
    day = date(_YEAR, 1, 1) + timedelta(days=int(conditions.day) - 1 + seconds // 86400)
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
