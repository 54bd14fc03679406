"""The tracks of some footage together: by frame, drawn, and as a file."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from skope.boxes import xywh_to_xyxy
from skope.eval.tracking import track_overlay, write_tracks
from skope.eval.tracking.pedestrian_and_cycle_tracks import RoadUserTrack
from skope.eval.tracking.tracks import Track
from skope.traffic.observation import Observation
from skope.types import Array, Pixels


@dataclass(frozen=True, eq=False, kw_only=True)
class TrackedVehicle:
    """A vehicle in one frame of its track."""

    number: int
    """The track's, the same in all frames."""
    vehicle_class: str
    """Of `skope.eval.tracking.vehicle_classes`."""
    position: Array
    """(3,) on the ground under the middle of the vehicle, world, metres."""
    heading: float
    """Radians, counter-clockwise from world x."""
    speed: float
    """m/s."""
    size_lwh: Array
    """(3,) length, width, height, metres."""
    box_xyxy: Array
    """(4,) pixels; NaN where the vehicle was missed in this frame."""
    located: bool
    """Whether a place was taken in this frame; else it follows from the frames around."""


class Tracks(list[Track]):
    """The vehicles of some footage, followed, in the order in which they appear."""

    def __init__(
        self,
        tracks: Iterable[Track],
        observation: Observation,
        *,
        road_users: Sequence[RoadUserTrack] = (),
        frame_index: Sequence[int] | None = None,
    ) -> None:
        """Put tracks together.

        Args:
            tracks: The vehicles' tracks.
            observation: When the road was observed, by what camera: without it nothing can be counted.
            road_users: Tracks of people on foot and on two wheels.
            frame_index: The number of each frame in its video; None: 0, 1, 2, ...
        """
        super().__init__(tracks)
        self.observation = observation
        self.road_users = tuple(road_users)
        self._frame_index = frame_index

    @property
    def times_s(self) -> Array:
        """(F,) times of all frames in which the road was observed, seconds."""
        return self.observation.times_s

    def at(self, frame: int) -> tuple[TrackedVehicle, ...]:
        """The vehicles that are there in a frame, numbered from 0."""
        return tuple(_vehicle(track, i) for track in self if (i := _row(track, frame)) is not None)

    def draw(self, image: Pixels, frame: int) -> Pixels:
        """A copy of a frame, (H, W, 3) RGB, with box, number, class and speed of everybody who is seen in it."""
        everybody: list[Track | RoadUserTrack] = [*self, *self.road_users]
        rows = ((track, _row(track, frame)) for track in everybody)
        return track_overlay.with_tracks_drawn(
            image, [(track, i) for track, i in rows if i is not None and track.detected[i]]
        )

    def to_csv(self, path: str | Path) -> None:
        """Write the vehicles' tracks as `skope eval track` does: a row for each frame of each track.

        docs/from-camera-to-tracks.md says what the columns mean.

        Raises:
            UserError: The file cannot be written.
        """
        last = max((int(track.frames[-1]) for track in self), default=-1)
        write_tracks.write_csv(Path(path), self, self._frame_index or range(last + 1))


def _row(track: Track | RoadUserTrack, frame: int) -> int | None:
    """Row of a frame in a track; None where the track is not there."""
    rows = np.flatnonzero(track.frames == frame)
    return int(rows[0]) if len(rows) else None


def _vehicle(track: Track, i: int) -> TrackedVehicle:
    return TrackedVehicle(
        number=track.number,
        vehicle_class=track.vehicle_class,
        position=track.position[i],
        heading=float(track.heading[i]),
        speed=float(track.speed[i]),
        size_lwh=track.size_lwh,
        box_xyxy=xywh_to_xyxy(track.boxes[i][None])[0],
        located=bool(track.located[i]),
    )
