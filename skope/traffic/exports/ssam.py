"""Tracks for FHWA's Surrogate Safety Assessment Model: `.trj`, version 3.0.

The file has little-endian records without padding: format, dimensions, and a time step with its vehicles every 0.1 s
(FHWA, Open Source SSAM File Format v3.0). Numbers have a precision of 24 bits. Positions are therefore relative to the
south-west corner of all tracks, and times to the first frame of the footage.
"""

import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.files.atomic import replacing
from skope.traffic.footprints import FootprintPath
from skope.traffic.gates import may_count
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array

SSAM_FILE: Final = "tracks.trj"


@dataclass(frozen=True)
class SsamFormat:
    """Values of SSAM's file header."""

    step_s: float = 0.1
    """Time step at which SSAM examines collisions, seconds."""
    version: float = 3.0
    metric: int = 1
    """Unit: metres."""
    has_z: int = 1
    """Vehicles have heights."""
    margin_m: int = 20
    """Margin around all positions, metres. SSAM drops positions outside the stated area."""


SSAM_FORMAT: Final = SsamFormat()

_FORMAT, _DIMENSIONS, _TIME_STEP, _VEHICLE = range(4)
VEHICLE_RECORD: Final = np.dtype(
    [
        ("type", "u1"),
        ("vehicle", "<i4"),
        ("link", "<i4"),
        ("lane", "u1"),
        *((name, "<f4") for name in ("front_x", "front_y", "rear_x", "rear_y")),
        *((name, "<f4") for name in ("length", "width", "speed", "acceleration", "front_z", "rear_z")),
    ]
)


def write_ssam(folder: Path, report: TrafficReport) -> list[Path]:
    """Write the tracks of a report that may count to `tracks.trj`; return the file.

    Vehicles, two-wheelers and pedestrians are all vehicles in the file, with their own sizes. Link and lane are 0.
    """
    chosen = [track for track in report.trajectories if may_count(track, report.site.traffic)]
    paths = [path for path in (FootprintPath(track, SSAM_FORMAT.step_s) for track in chosen) if len(path.ticks)]
    origin, size = _area(paths)
    times = report.observation.times_s
    first, last = (round(float(times[row]) / SSAM_FORMAT.step_s) for row in (0, -1)) if len(times) else (0, 0)
    rows = np.concatenate([np.zeros(0, VEHICLE_RECORD), *(_rows(path, origin) for path in paths)])
    ticks = np.concatenate([np.zeros(0, np.int64), *(path.ticks for path in paths)]) - first
    order = np.argsort(ticks, kind="stable")
    rows, ticks = rows[order], ticks[order]
    steps = max(last - first, int(ticks[-1]) if len(ticks) else 0)
    bounds = np.searchsorted(ticks, np.arange(steps + 2))
    path = folder / SSAM_FILE
    with replacing(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<Bcf", _FORMAT, b"L", SSAM_FORMAT.version) + struct.pack("<B", SSAM_FORMAT.has_z))
        file.write(struct.pack("<BBf4i", _DIMENSIONS, SSAM_FORMAT.metric, 1.0, 0, 0, *size))
        for step in range(steps + 1):
            file.write(struct.pack("<Bf", _TIME_STEP, step * SSAM_FORMAT.step_s))
            file.write(rows[bounds[step] : bounds[step + 1]].tobytes())
    return [path]


def _area(paths: list[FootprintPath]) -> tuple[Array, tuple[int, int]]:
    """Return the (2,) origin of positions, metres, and the extent of the area to the east and north, metres."""
    places = np.concatenate([np.zeros((0, 2)), *(path.position for path in paths)])
    if not len(places):
        return np.zeros(2), (1, 1)
    low, high = np.floor(places.min(axis=0)) - SSAM_FORMAT.margin_m, np.ceil(places.max(axis=0)) + SSAM_FORMAT.margin_m
    east, north = (high - low).astype(int).tolist()
    return low, (east, north)


def _rows(path: FootprintPath, origin: Array) -> NDArray[np.void]:
    """Return the (M,) records of a vehicle."""
    rows = np.zeros(len(path.ticks), VEHICLE_RECORD)
    length, width = path.size
    rows["type"], rows["vehicle"] = _VEHICLE, path.trajectory.number
    half = path.facing * (length / 2)
    for name, places in (("front", path.position + half), ("rear", path.position - half)):
        rows[f"{name}_x"], rows[f"{name}_y"] = (places - origin).T
    rows["length"], rows["width"], rows["speed"] = length, width, path.speed
    if len(rows) > 1:
        rows["acceleration"] = np.gradient(path.speed, SSAM_FORMAT.step_s)
    return rows
