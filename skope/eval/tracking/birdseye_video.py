"""Tracks seen from above, as a video of outlines that move."""

from collections.abc import Iterator, Sequence
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.draw import PALETTE
from skope.eval.tracking.tracks import Track
from skope.types import Array

Pixels = NDArray[np.uint8]
_SIDE: Final = 900
"""Pixels of the video's longer side."""
_MARGIN: Final = 6.0
_ROAD: Final = (44, 46, 50)
_TRAIL: Final = 50
"""Frames of a track that are drawn behind its vehicle."""


def frames(tracks: Sequence[Track], count: int) -> Iterator[Pixels]:
    """`count` pictures (H, W, 3) from above, north up: outlines with a line to their front, number and km/h."""
    places = [t.position[:, :2] for t in tracks] or [np.zeros((1, 2))]
    low = np.concatenate(places).min(axis=0) - _MARGIN
    high = np.concatenate(places).max(axis=0) + _MARGIN
    scale = _SIDE / float((high - low).max())
    # Encoders want even sides.
    width, height = (2 * round(v / 2) for v in (high - low) * scale)

    def at(points: Array) -> NDArray[np.int32]:
        flipped = (points - low) * scale * [1, -1] + [0, height]
        return np.asarray(np.rint(flipped), dtype=np.int32)

    for frame in range(count):
        picture: Pixels = np.full((max(2, height), max(2, width), 3), _ROAD, dtype=np.uint8)
        for track in tracks:
            i = frame - int(track.frames[0])
            if not 0 <= i < len(track.frames):
                continue
            color = PALETTE[track.number % len(PALETTE)]
            cv2.polylines(picture, [at(track.position[max(0, i - _TRAIL) : i + 1, :2])], False, color, 1, cv2.LINE_AA)
            ahead = np.array([np.cos(track.heading[i]), np.sin(track.heading[i])])
            across = np.array([-ahead[1], ahead[0]])
            length, breadth = track.size_lwh[:2] / 2
            middle = track.position[i, :2]
            corners = [
                middle + a * length * ahead + b * breadth * across for a, b in ((1, 1), (1, -1), (-1, -1), (-1, 1))
            ]
            cv2.fillPoly(picture, [at(np.array(corners))], color, cv2.LINE_AA)
            cv2.line(picture, at(middle).tolist(), at(middle + length * ahead).tolist(), _ROAD, 2, cv2.LINE_AA)
            text = f"{track.number}: {track.speed[i] * 3.6:.0f}"
            cv2.putText(picture, text, at(middle + across).tolist(), cv2.FONT_HERSHEY_SIMPLEX, 0.4, (255, 255, 255), 1)
        yield picture
