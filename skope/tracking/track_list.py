"""`Tracks`: all tracks of one footage, with access by frame, drawing and a file."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skope.boxes import xywh_to_xyxy
from skope.records import check_image
from skope.tracking import camera_picture
from skope.tracks.csv_file import write_tracks
from skope.tracks.track import Track
from skope.traffic.observation import Observation
from skope.types import Array, Pixels


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedRoadUser:
    """A road user in one frame of its track."""

    number: int
    """Number of the track, constant over all frames."""
    category: str
    """Vehicle, bicycle, motorcycle or pedestrian."""
    class_name: str
    """Class of a vehicle (car, van, lorry, bus, unknown), else the category."""
    position: Array
    """(3,) position on the ground, world, metres: under the middle of a vehicle, or under a person or two-wheeler."""
    heading: float
    """Heading, radians, counter-clockwise from world x; NaN if not known."""
    speed: float
    """Speed, m/s."""
    size_lwh: Array
    """(3,) length, width and height, metres; NaN if not measured."""
    box_xyxy: Array
    """(4,) box, pixels; NaN if the road user was not detected in this frame."""
    located: bool
    """Whether its position was measured in this frame; else it is interpolated from the frames around."""


class Tracks(list[Track]):
    """Road users of one footage: vehicles first, then pedestrians and two-wheelers, by their first frames."""

    def __init__(
        self, tracks: Iterable[Track], observation: Observation, *, frame_index: Sequence[int] | None = None
    ) -> None:
        """Combine tracks of one footage.

        Args:
            tracks: The tracks.
            observation: Times at which the road was observed, and the camera; needed for counts.
            frame_index: Number of each frame in its video. Default: 0, 1, 2, ...
        """
        super().__init__(tracks)
        self.observation = observation
        self._frame_index = frame_index

    @property
    def times_s(self) -> Array:
        """(F,) times of all frames in which the road was observed, seconds."""
        return self.observation.times_s

    def at(self, frame: int) -> tuple[TrackedRoadUser, ...]:
        """Return the road users that are present in a frame. The first frame has number 0."""
        return tuple(_state(track, i) for track in self if (i := _row(track, frame)) is not None)

    def draw(self, image: Pixels, frame: int) -> Pixels:
        """Return a copy of a frame, (H, W, 3) RGB, with box, number, class and speed of each detected road user.

        Raises:
            UserError: The pixels have another shape or type.
        """
        image = check_image("image", image)
        rows = ((track, _row(track, frame)) for track in self)
        return camera_picture.with_tracks_drawn(
            image, [(track, i) for track, i in rows if i is not None and np.isfinite(track.scores[i])]
        )

    def to_csv(self, path: str | Path) -> None:
        """Write tracks.csv as `skope eval track` does: one row per track and frame.

        docs/tracks.md explains the columns.

        Raises:
            UserError: The file cannot be written.
        """
        write_tracks(Path(path), self, self._frame_index)


def _row(track: Track, frame: int) -> int | None:
    """Return the row of a frame in a track, or None if the track is not present."""
    rows = np.flatnonzero(track.frames == frame)
    return int(rows[0]) if len(rows) else None


def _state(track: Track, i: int) -> TrackedRoadUser:
    return TrackedRoadUser(
        number=track.number,
        category=track.category,
        class_name=track.class_name,
        position=track.position[i],
        heading=float(track.heading[i]),
        speed=float(track.speed[i]),
        size_lwh=track.size_lwh,
        box_xyxy=xywh_to_xyxy(track.boxes[i][None])[0],
        located=bool(track.located[i]),
    )
