"""Write tracks frame by frame: MOTChallenge text for tracking metrics, and SUMO's floating-car data."""

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

from skope.files.atomic import replacing
from skope.schema import PEDESTRIAN_CATEGORY, VEHICLE_CATEGORY
from skope.tracks.track import Track

_SUMO_CLASS: Final = {"bus": "bus", "lorry": "truck", "van": "delivery"}


def mot_row(frame: int, number: int, bbox: ArrayLike, rest: str) -> str:
    """Return a line of MOTChallenge text.

    Args:
        frame: Number of the frame, from 1.
        number: Id of the track.
        bbox: (4,) left, top, width and height, pixels.
        rest: The remaining columns, separated by commas.
    """
    x, y, w, h = np.asarray(bbox, dtype=np.float64)
    return f"{frame},{number},{x:.2f},{y:.2f},{w:.2f},{h:.2f},{rest}\n"


def write_mot(path: Path, tracks: Sequence[Track]) -> None:
    """Write the detected boxes for MOTChallenge and TrackEval, with confidence and without world positions.

    TrackEval reads the column of the world's x as a class.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        last = max((int(track.frames[-1]) for track in tracks), default=-1)
        for frame, present in _by_frame(tracks, last + 1):
            for track, i in present:
                if not math.isnan(track.scores[i]):
                    file.write(mot_row(frame + 1, track.number, track.boxes[i], f"{track.scores[i]:.4f},-1,-1,-1"))


def write_fcd(path: Path, tracks: Sequence[Track], times_s: Sequence[float]) -> None:
    """Write SUMO's floating-car data (`fcd-export`), in the network's coordinates.

    The position of a vehicle is the middle of its front bumper, its angle is in compass degrees: 0 north, clockwise.
    The position of another road user is its ground point. Its angle is left out if its heading is unknown.

    Args:
        path: The .xml file.
        tracks: The tracks.
        times_s: Time of each frame, seconds.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        file.write('<?xml version="1.0" encoding="UTF-8"?>\n<fcd-export>\n')
        for (_, present), time_s in zip(_by_frame(tracks, len(times_s)), times_s, strict=True):
            file.write(f'    <timestep time="{time_s:.3f}">\n')
            for track, i in present:
                file.write(_fcd_vehicle(track, i) if track.category == VEHICLE_CATEGORY else _fcd_road_user(track, i))
            file.write("    </timestep>\n")
        file.write("</fcd-export>\n")


def _fcd_vehicle(track: Track, i: int) -> str:
    heading = float(track.heading[i])
    x, y = track.position[i, :2] + track.size[0] / 2 * np.array([math.cos(heading), math.sin(heading)])
    values = {
        "id": str(track.number),
        "x": f"{x:.3f}",
        "y": f"{y:.3f}",
        "z": f"{track.position[i, 2]:.3f}",
        "angle": f"{(90 - math.degrees(heading)) % 360:.2f}",
        "type": _SUMO_CLASS.get(track.class_name, "passenger"),
        "speed": f"{track.speed[i]:.3f}",
        "acceleration": f"{track.acceleration_along[i]:.3f}",
    }
    return _fcd_element("vehicle", values)


def _fcd_road_user(track: Track, i: int) -> str:
    heading = float(track.heading[i])
    values = {
        "id": str(track.number),
        **{axis: f"{v:.3f}" for axis, v in zip("xyz", track.position[i], strict=True)},
        **({} if math.isnan(heading) else {"angle": f"{(90 - math.degrees(heading)) % 360:.2f}"}),
        "type": track.category,
        "speed": f"{track.speed[i]:.3f}",
    }
    return _fcd_element("person" if track.category == PEDESTRIAN_CATEGORY else "vehicle", values)


def _fcd_element(name: str, values: Mapping[str, str]) -> str:
    cells = " ".join(f"{key}={quoteattr(value)}" for key, value in values.items())
    return f"        <{name} {cells}/>\n"


def _by_frame(tracks: Sequence[Track], count: int) -> Iterator[tuple[int, list[tuple[Track, int]]]]:
    """Yield `count` frames, each with its tracks and their rows, ordered by track number."""
    waiting = sorted(tracks, key=lambda track: int(track.frames[0]), reverse=True)
    present: list[Track] = []
    for frame in range(count):
        present = [track for track in present if track.frames[-1] >= frame]
        while waiting and waiting[-1].frames[0] <= frame:
            present.append(waiting.pop())
        present.sort(key=lambda track: track.number)
        yield frame, [(track, frame - int(track.frames[0])) for track in present]
