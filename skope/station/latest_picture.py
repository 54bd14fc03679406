"""The latest frame of a camera with its detections and gates: one file, which each frame replaces."""

import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.files.atomic import write_bytes
from skope.footage.overlays import blurred
from skope.keypoints import Scheme
from skope.metrics.thresholds import KEPT_SCORE
from skope.pictures import draw
from skope.schema import AnyResult, Image, Result, RoadUserResult
from skope.site.gates_zones_lanes import Gate
from skope.types import Pixels

PICTURE_S: Final = 5.0
"""Time between two pictures, seconds."""
_GATE_COLOR: Final = (255, 220, 0)


class LatestPicture:
    """Writes a picture of the latest frame every `PICTURE_S`; a `Watcher` of the frames."""

    def __init__(self, path: Path, gates: Sequence[Gate], *, blur: bool) -> None:
        """Prepare to write to `path`.

        Args:
            path: The file, a JPEG.
            gates: Gates to draw.
            blur: Whether glass, plates and heads are blurred.
        """
        self._path, self._gates, self._blur = path, gates, blur
        self._last: Pixels | None = None
        self._written_s = -PICTURE_S

    def watch(self, frames: Iterator[tuple[Image, Pixels]]) -> Iterator[tuple[Image, Pixels]]:
        """Yield the same frames."""
        for image, pixels in frames:
            self._last = pixels
            yield image, pixels

    def write(self, found: Sequence[AnyResult], camera: Camera, scheme: Scheme) -> None:
        """Draw the last frame with its detections, if it is time.

        Raises:
            UserError: The file cannot be written.
        """
        if self._last is None or time.monotonic() - self._written_s < PICTURE_S:
            return
        self._written_s = time.monotonic()
        kept = [result for result in found if result.score > KEPT_SCORE]
        vehicles = [result for result in kept if isinstance(result, Result)]
        others = [result for result in kept if isinstance(result, RoadUserResult)]
        pixels = blurred(self._last, vehicles, others) if self._blur else self._last
        pixels = draw.results(pixels, vehicles, others, scheme=scheme)
        for gate in self._gates:
            self._draw_gate(pixels, gate, camera)
        pixels = draw.caption(pixels, f"{datetime.now(UTC):%Y-%m-%d %H:%M:%S} UTC")
        good, data = cv2.imencode(".jpg", pixels[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, 85])
        assert good
        write_bytes(self._path, data.tobytes())

    def _draw_gate(self, pixels: Pixels, gate: Gate, camera: Camera) -> None:
        ends = np.array([[*end, 0.0] for end in gate.line], dtype=np.float64)
        steps = ends[0] + np.linspace(0, 1, 16)[:, None] * (ends[1] - ends[0])
        at, _, visible = camera.project(steps)
        corners = np.rint(at[visible]).astype(np.int32)
        if len(corners) > 1:
            cv2.polylines(pixels, [corners], isClosed=False, color=_GATE_COLOR, thickness=2, lineType=cv2.LINE_AA)
            at_end = tuple((corners[0] + [4, -6]).tolist())
            for color, width in (((0, 0, 0), 3), (_GATE_COLOR, 1)):
                cv2.putText(pixels, gate.name, at_end, cv2.FONT_HERSHEY_SIMPLEX, 0.5, color, width, cv2.LINE_AA)
