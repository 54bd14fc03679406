"""Write tracks as CSV, as MOTChallenge's text for metrics of trackers, and as SUMO's floating-car data.

Other road users than vehicles have files of their own, but for floating-car data, where SUMO tells them apart.
"""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final, TypeVar
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from skope.eval.tracking.ground_track import GroundTrack
from skope.eval.tracking.pedestrian_and_cycle_tracks import RoadUserTrack
from skope.eval.tracking.tracks import Track
from skope.files.atomic import replacing
from skope.schema import PEDESTRIAN

T = TypeVar("T", bound=GroundTrack)

_TRACK_COLUMNS: Final = (
    "track", "type", "frame", "time_s", "detected", "x", "y", "z", "heading_deg", "speed", "vx", "vy", "acceleration",
    "length", "width", "height", "located", "sigma_position", "sigma_speed", "class", "class_confidence", "flags",
)  # fmt: skip
_ROAD_USER_COLUMNS: Final = (
    "track", "category", "frame", "time_s", "detected", "x", "y", "z", "heading_deg", "speed", "vx", "vy",
    "located", "sigma_position", "sigma_speed",
)  # fmt: skip
_SUMO_CLASS: Final = {"bus": "bus", "lorry": "truck", "van": "delivery"}


def write_csv(path: Path, tracks: Sequence[Track], frame_index: Sequence[int]) -> None:
    """Write a row for each frame of each track: metres, seconds, m/s, m/s^2, degrees counter-clockwise from world x.

    docs/from-camera-to-tracks.md says what the columns mean.

    Args:
        path: The .csv file.
        tracks: The tracks.
        frame_index: The number that each frame is given in the file.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_TRACK_COLUMNS)
        for track in tracks:
            detected, speed, along = track.detected, track.speed, track.along
            for i, frame in enumerate(track.frames):
                writer.writerow(
                    [
                        track.number,
                        track.kind,
                        frame_index[frame],
                        f"{track.times_s[i]:.4f}",
                        int(detected[i]),
                        *(f"{v:.3f}" for v in track.position[i]),
                        f"{math.degrees(track.heading[i]):.2f}",
                        f"{speed[i]:.3f}",
                        *(f"{v:.3f}" for v in track.velocity[i]),
                        f"{along[i]:.3f}",
                        *(f"{v:.2f}" for v in track.size_lwh),
                        int(track.located[i]),
                        f"{track.position_sigma[i]:.3f}",
                        f"{track.speed_sigma[i]:.3f}",
                        track.vehicle_class,
                        f"{track.class_confidence:.2f}",
                        " ".join(track.flags),
                    ]
                )


def write_road_users(path: Path, tracks: Sequence[RoadUserTrack], frame_index: Sequence[int]) -> None:
    """Write a row for each frame of each track of people on foot and on two wheels, in the units of `write_csv`.

    The heading is that of motion, and empty where there may be none.

    Args:
        path: The .csv file.
        tracks: The tracks.
        frame_index: The number that each frame is given in the file.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(_ROAD_USER_COLUMNS)
        for track in tracks:
            for i, frame in enumerate(track.frames):
                heading = float(track.heading[i])
                writer.writerow(
                    [
                        track.number,
                        track.category,
                        frame_index[frame],
                        f"{track.times_s[i]:.4f}",
                        int(track.detected[i]),
                        *(f"{v:.3f}" for v in track.position[i]),
                        "" if math.isnan(heading) else f"{math.degrees(heading):.2f}",
                        f"{track.speed[i]:.3f}",
                        *(f"{v:.3f}" for v in track.velocity[i]),
                        int(track.located[i]),
                        f"{track.position_sigma[i]:.3f}",
                        f"{track.speed_sigma[i]:.3f}",
                    ]
                )


def mot_row(frame: int, number: int, bbox: ArrayLike, rest: str) -> str:
    """A line of MOTChallenge.

    Args:
        frame: Number of the frame, from 1.
        number: Id of the track.
        bbox: (4,) left, top, width and height, pixels.
        rest: The columns after these, with commas.
    """
    x, y, w, h = np.asarray(bbox, dtype=np.float64)
    return f"{frame},{number},{x:.2f},{y:.2f},{w:.2f},{h:.2f},{rest}\n"


def write_mot(path: Path, tracks: Sequence[GroundTrack]) -> None:
    """The boxes of what was seen, as MOTChallenge and TrackEval read them: with confidence and no place in the world.

    TrackEval takes the column of the place's x for a class.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        last = max((int(track.frames[-1]) for track in tracks), default=-1)
        for frame, present in _by_frame(tracks, last + 1):
            for track, i in present:
                if not math.isnan(track.scores[i]):
                    file.write(mot_row(frame + 1, track.number, track.boxes[i], f"{track.scores[i]:.4f},-1,-1,-1"))


def write_fcd(
    path: Path, tracks: Sequence[Track], times_s: Sequence[float], road_users: Sequence[RoadUserTrack] = ()
) -> None:
    """Write SUMO's floating-car data (`fcd-export`), in the network's coordinates.

    There a vehicle's position is the middle of its front bumper and its angle compass degrees: 0 north, clockwise. Of
    other road users it is the place where they stand, and the angle is left out where they may stand still.

    Args:
        path: The .xml file.
        tracks: The vehicles' tracks.
        times_s: Time of each frame, seconds.
        road_users: Tracks of people on foot and on two wheels.
    """
    others = _by_frame(road_users, len(times_s))
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for (_, present), (_, beside), time_s in zip(_by_frame(tracks, len(times_s)), others, times_s, strict=True):
            file.write(f'    <timestep time="{time_s:.3f}">\n')
            file.writelines(_fcd_vehicle(track, i) for track, i in present)
            file.writelines(_fcd_road_user(track, i) for track, i in beside)
            file.write("    </timestep>\n")
        file.write("</fcd-export>\n")


def _fcd_vehicle(track: Track, i: int) -> str:
    heading = float(track.heading[i])
    x, y = track.position[i, :2] + track.size_lwh[0] / 2 * np.array([math.cos(heading), math.sin(heading)])
    values = {
        "id": str(track.number),
        "x": f"{x:.3f}",
        "y": f"{y:.3f}",
        "z": f"{track.position[i, 2]:.3f}",
        "angle": f"{(90 - math.degrees(heading)) % 360:.2f}",
        "type": _SUMO_CLASS.get(track.vehicle_class, "passenger"),
        "speed": f"{track.speed[i]:.3f}",
        "acceleration": f"{track.along[i]:.3f}",
    }
    return _fcd_element("vehicle", values)


def _fcd_road_user(track: RoadUserTrack, i: int) -> str:
    heading = float(track.heading[i])
    values = {
        "id": str(track.number),
        **{axis: f"{v:.3f}" for axis, v in zip("xyz", track.position[i], strict=True)},
        **({} if math.isnan(heading) else {"angle": f"{(90 - math.degrees(heading)) % 360:.2f}"}),
        "type": track.category,
        "speed": f"{track.speed[i]:.3f}",
    }
    return _fcd_element("person" if track.category == PEDESTRIAN else "vehicle", values)


def _fcd_element(name: str, values: Mapping[str, str]) -> str:
    cells = " ".join(f"{key}={quoteattr(value)}" for key, value in values.items())
    return f"        <{name} {cells}/>\n"


def _by_frame(tracks: Sequence[T], count: int) -> Iterator[tuple[int, list[tuple[T, int]]]]:
    """Each of `count` frames with the tracks that are there, which rise in their first frames, and their rows."""
    waiting = list(reversed(tracks))
    present: list[T] = []
    for frame in range(count):
        present = [track for track in present if track.frames[-1] >= frame]
        while waiting and waiting[-1].frames[0] <= frame:
            present.append(waiting.pop())
        yield frame, [(track, frame - int(track.frames[0])) for track in present]
