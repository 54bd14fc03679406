"""Tracks in ASAM OpenLABEL 1.0.0: one cuboid on the road per frame and road user, in metres of the site.

A cuboid has its centre, its rotation as a quaternion, and length, width and height. A size that was not measured is a
default, which `size_measured` shows.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.files.atomic import replacing
from skope.files.json_files import json_bytes
from skope.tracks.track import KMH_PER_MPS, Track, worst_sigma
from skope.traffic.gates import may_count
from skope.traffic.report_tables import clock
from skope.traffic.traffic_report import TrafficReport
from skope.version import __version__

OPENLABEL_FILE: Final = "traffic.json"
WORLD_FRAME: Final = "world"
_HEIGHTS_M: Final[Mapping[str, float]] = {"pedestrian": 1.7, "bicycle": 1.7, "motorcycle": 1.6}


@dataclass(frozen=True)
class OpenlabelFormat:
    """Default height and digits."""

    height_m: float = 1.5
    """Default height of a road user, metres."""
    digits: int = 3
    """Digits after the decimal point."""


OPENLABEL_FORMAT: Final = OpenlabelFormat()


def write_openlabel(folder: Path, report: TrafficReport) -> list[Path]:
    """Write the tracks of a report that may count to `traffic.json`; return the file.

    Frames are the observed frames, numbered from 0, with their times.
    """
    chosen = [track for track in report.trajectories if may_count(track, report.site.traffic)]
    times = report.observation.times_s
    spans = {
        track.number: np.searchsorted(times, [track.times_s[0] - 1e-6, track.times_s[-1] + 1e-6]) for track in chosen
    }
    begun: dict[int, list[Track]] = {}
    for track in chosen:
        begun.setdefault(int(spans[track.number][0]), []).append(track)
    path = folder / OPENLABEL_FILE
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(b'{"openlabel":{"metadata":' + json_bytes(_metadata(report)).strip())
        file.write(b',\n"coordinate_systems":' + json_bytes({WORLD_FRAME: {"type": "scene_cs", "parent": ""}}).strip())
        file.write(b',\n"objects":' + json_bytes(_objects(chosen, spans)).strip())
        if len(times):
            file.write(b',\n"frame_intervals":' + json_bytes([_interval(0, len(times))]).strip())
        file.write(b',\n"frames":{')
        live: list[Track] = []
        for frame, time_s in enumerate(times.tolist()):
            beginning = map(report.observation.with_camera_error, begun.get(frame, ()))
            live = [track for track in (*live, *beginning) if spans[track.number][1] > frame]
            file.write(b",\n" if frame else b"\n")
            file.write(f'"{frame}":'.encode() + json_bytes(_frame(report, live, time_s)).strip())
        file.write(b"\n}}}\n")
    return [path]


def _metadata(report: TrafficReport) -> dict[str, Any]:
    begins = None if report.start is None else report.start.isoformat()
    return {
        "schema_version": "1.0.0",
        "annotator": f"skope {__version__}",
        "footage": report.observation.source,
        **({} if begins is None else {"begins": begins}),
    }


def _interval(begin: int, end: int) -> dict[str, int]:
    return {"frame_start": begin, "frame_end": end - 1}


def _objects(chosen: Sequence[Track], spans: Mapping[int, Any]) -> dict[str, Any]:
    """Return the road users that have a frame, by number."""
    objects = {}
    for track in chosen:
        begin, end = map(int, spans[track.number])
        if begin < end:
            objects[str(track.number)] = {
                "name": f"{track.class_name} {track.number}",
                "type": track.class_name,
                "frame_intervals": [_interval(begin, end)],
                "object_data_pointers": {"body": {"type": "cuboid", "frame_intervals": [_interval(begin, end)]}},
            }
    return objects


def _frame(report: TrafficReport, live: Sequence[Track], time_s: float) -> dict[str, Any]:
    moment = clock(report, time_s)
    timestamp = f"{time_s:.3f}" if moment is None else moment.isoformat(timespec="milliseconds")
    frame: dict[str, Any] = {"frame_properties": {"timestamp": timestamp}}
    if live:
        frame["objects"] = {str(track.number): {"object_data": {"cuboid": [_cuboid(track, time_s)]}} for track in live}
    return frame


def _cuboid(track: Track, time_s: float) -> dict[str, Any]:
    x, y = track.at(track.xy, time_s).tolist()
    ahead = track.at(track.facing, time_s)
    heading = math.atan2(ahead[1], ahead[0])
    length, width = track.size
    height = track.height or _HEIGHTS_M.get(track.category, OPENLABEL_FORMAT.height_m)
    values = (x, y, height / 2, 0.0, 0.0, math.sin(heading / 2), math.cos(heading / 2), length, width, height)
    sigma = float(worst_sigma(track.at(track.total_covariance, time_s)))
    speed, speed_sigma = (float(track.at(column, time_s)) * KMH_PER_MPS for column in (track.speed, track.speed_sigma))
    numbers = {"speed_kmh": speed, "speed_sigma_kmh": speed_sigma, "sigma_position_m": sigma}
    measured = bool(track.length and track.width and track.height)
    return {
        "name": "body",
        "val": [round(value, 6) for value in values],
        "coordinate_system": WORLD_FRAME,
        "attributes": {
            "num": [{"name": name, "val": round(value, OPENLABEL_FORMAT.digits)} for name, value in numbers.items()],
            "boolean": [{"name": "size_measured", "val": measured}],
        },
    }
