"""Draw tracks from above as a video of outlines that move over the road."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.pictures.draw import DRAWING_STYLE
from skope.tracking import map_signs
from skope.tracking.birdseye import extent
from skope.tracking.ground_view import GroundView
from skope.tracks.track import Track
from skope.types import Array, Pixels

T = TypeVar("T", bound=Track)


@dataclass(frozen=True)
class MapVideoStyle:
    """Appearance of the video from above."""

    longer_px: int = 1200
    """Longer side of the video, pixels."""
    ink: tuple[int, int, int] = (27, 39, 51)
    """Colour of texts, RGB."""
    camera_color: tuple[int, int, int] = (194, 24, 91)
    """Colour of the camera, RGB."""
    trail_s: float = 2.0
    """Length of the drawn trail behind a vehicle, seconds."""


MAP_VIDEO_STYLE: Final = MapVideoStyle()

_LABEL_FONT: Final = cv2.FONT_HERSHEY_SIMPLEX


class _Map:
    """Map of the road, shared by all frames."""

    def __init__(self, tracks: Sequence[Track], camera: Camera, ground: Ground | None, road: Pixels | None) -> None:
        low, high = extent(tracks, camera.position[:2])
        self._low, self._scale = low, MAP_VIDEO_STYLE.longer_px / float((high - low).max())
        # Encoders want even sides.
        self._width, self._height = (2 * round(v / 2) for v in (high - low) * self._scale)
        self.background: Pixels = np.full((self._height, self._width, 3), 255, dtype=np.uint8)
        if ground is not None and road is not None:
            view = GroundView(camera=camera, ground=ground, low=low, high=high, cell_m=1 / self._scale)
            pale = view.pale(road)
            self.background = np.asarray(cv2.resize(pale, (self._width, self._height)), dtype=np.uint8)
        spot = self.at(camera.position[:2]).tolist()
        cv2.circle(self.background, spot, 7, MAP_VIDEO_STYLE.camera_color, -1, cv2.LINE_AA)
        put_text(self.background, "camera", (spot[0] + 12, spot[1] + 5), MAP_VIDEO_STYLE.camera_color)
        self._draw_scale()

    def at(self, places: Array) -> NDArray[np.int32]:
        """Return (..., 2) pixels of positions (..., 2), metres."""
        flipped = (places - self._low) * self._scale * [1, -1] + [0, self._height]
        return np.asarray(np.rint(flipped), dtype=np.int32)

    def holds(self, position: Array) -> bool:
        """Return whether a position (2,) is on the map."""
        x, y = self.at(position).tolist()
        return bool(0 <= x < self._width and 0 <= y < self._height)

    def present(self, tracks: Sequence[T], frame: int) -> Iterator[tuple[T, int]]:
        """Yield the tracks that are on the map in a frame, each with its row for that frame."""
        for track in tracks:
            i = frame - int(track.frames[0])
            if 0 <= i < len(track.frames) and self.holds(track.position[i, :2]):
                yield track, i

    def _draw_scale(self) -> None:
        """Draw a scale bar of a round length at the lower right."""
        metres = max(bar for bar in map_signs.MAP_SYMBOLS.bars_m if bar <= max(1, self._width / self._scale / 5))
        right, low = self._width - 20, self._height - 20
        left = right - round(metres * self._scale)
        cv2.line(self.background, (left, low), (right, low), MAP_VIDEO_STYLE.ink, 4)
        put_text(self.background, f"{metres} m", (left, low - 10))


def birdseye_frames(
    tracks: Sequence[Track],
    times_s: Sequence[float],
    camera: Camera,
    ground: Ground | None,
    road: Pixels | None,
    road_users: Sequence[Track] = (),
) -> Iterator[Pixels]:
    """Yield a frame (H, W, 3) of the road from above for each time.

    Each vehicle is an outline with its front, number and km/h. The world's y axis points to the top of the frame.

    Args:
        tracks: The vehicles' tracks.
        times_s: Time of each frame, seconds.
        camera: The camera, with its pose.
        ground: The road; None: unknown.
        road: (H, W, 3) the empty road as the camera shows it; None: not available.
        road_users: Tracks of pedestrians and two-wheelers, drawn as dots.
    """
    shown = _Map([*tracks, *road_users], camera, ground, road)
    for frame, time_s in enumerate(times_s):
        picture = shown.background.copy()
        for track, i in shown.present(tracks, frame):
            _draw(picture, shown, track, i)
        for user, i in shown.present(road_users, frame):
            _draw_dot(picture, shown, user, i)
        put_text(picture, f"{time_s:.1f} s", (20, 34), size=0.8)
        yield picture


def _draw(picture: Pixels, shown: _Map, track: Track, i: int) -> None:
    """Draw a vehicle in its i-th frame, and its recent path."""
    color = DRAWING_STYLE.palette[track.number % len(DRAWING_STYLE.palette)]
    since = int(np.searchsorted(track.times_s, track.times_s[i] - MAP_VIDEO_STYLE.trail_s))
    cv2.polylines(picture, [shown.at(track.position[since : i + 1, :2])], False, color, 2, cv2.LINE_AA)
    outline = shown.at(np.array(map_signs.vehicle_points(track, i, map_signs.MAP_SYMBOLS.outline)))
    cv2.fillPoly(picture, [outline], color, cv2.LINE_AA)
    cv2.polylines(picture, [outline], True, MAP_VIDEO_STYLE.ink, 1, cv2.LINE_AA)
    middle, front = shown.at(np.array(map_signs.vehicle_points(track, i, ((0.0, 0.0), (1.0, 0.0)))))
    cv2.line(picture, middle.tolist(), front.tolist(), (255, 255, 255), 2, cv2.LINE_AA)
    x, y = outline.max(axis=0)[0], outline.min(axis=0)[1]
    put_text(picture, map_signs.label(track, i), (int(x) + 3, int(y) - 3))


def _draw_dot(picture: Pixels, shown: _Map, track: Track, i: int) -> None:
    """Draw a pedestrian or two-wheeler in the track's i-th frame, and its recent path."""
    color = DRAWING_STYLE.palette[track.number % len(DRAWING_STYLE.palette)]
    since = int(np.searchsorted(track.times_s, track.times_s[i] - MAP_VIDEO_STYLE.trail_s))
    cv2.polylines(picture, [shown.at(track.position[since : i + 1, :2])], False, color, 1, cv2.LINE_AA)
    x, y = shown.at(track.position[i, :2]).tolist()
    cv2.circle(picture, (x, y), 5, color, -1, cv2.LINE_AA)
    cv2.circle(picture, (x, y), 5, MAP_VIDEO_STYLE.ink, 1, cv2.LINE_AA)
    put_text(picture, f"{track.category[0]} {map_signs.label(track, i)}", (x + 7, y - 3))


def put_text(
    picture: Pixels,
    text: str,
    corner: tuple[int, int],
    color: tuple[int, int, int] = MAP_VIDEO_STYLE.ink,
    size: float = 0.45,
) -> None:
    """Write a text with a white edge, moved if it would leave the image.

    Args:
        picture: (H, W, 3), changed in place.
        text: One line.
        corner: Column and row of its lower left corner, pixels.
        color: RGB.
        size: Font scale of OpenCV.
    """
    text = text.replace("±", "+-")  # OpenCV's fonts are ASCII only
    (width, height), _ = cv2.getTextSize(text, _LABEL_FONT, size, 1)
    x = int(np.clip(corner[0], 2, max(2, picture.shape[1] - width - 4)))
    y = int(np.clip(corner[1], height + 2, picture.shape[0] - 4))
    # The outline is drawn with the thin font's positions, because thicker letters may be wider.
    for dx, dy in itertools.product((-1, 0, 1), repeat=2):
        cv2.putText(picture, text, (x + dx, y + dy), _LABEL_FONT, size, (255, 255, 255), 1, cv2.LINE_AA)
    cv2.putText(picture, text, (x, y), _LABEL_FONT, size, color, 1, cv2.LINE_AA)
