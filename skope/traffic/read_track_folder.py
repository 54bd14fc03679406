"""Read what `skope eval track` wrote into trajectories."""

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.errors import UserError
from skope.schema import CATEGORIES, VEHICLE
from skope.site.traffic_settings import CLASSES
from skope.traffic.observation import FOOTAGE, Observation
from skope.traffic.place_errors import place_covariance, speed_sigma
from skope.traffic.trajectories import Trajectory
from skope.types import Array

TRACKS_CSV: Final = "tracks.csv"
ROAD_USERS_CSV: Final = "road_users.csv"
_SHARED: Final = (
    "track",
    "time_s",
    "x",
    "y",
    "z",
    "heading_deg",
    "vx",
    "vy",
    "located",
    "sigma_position",
    "sigma_speed",
)
_OF_VEHICLES: Final = (*_SHARED, "length", "width", "class", "class_confidence", "flags")
_OF_OTHERS: Final = (*_SHARED, "category")
CsvRows = list[dict[str, str]]


def track_files(folder: Path) -> list[Path]:
    """The files that a folder of tracks is read from; one of people and two-wheelers may be among them."""
    names = (TRACKS_CSV, ROAD_USERS_CSV, FOOTAGE)
    return [folder / name for name in names if name != ROAD_USERS_CSV or (folder / name).is_file()]


def read_trajectories(folder: Path, observation: Observation) -> list[Trajectory]:
    """The trajectories in a folder that `skope eval track` wrote, by their numbers.

    All of them are confirmed: tracks that are not are not in the files. `observation` is that of the folder.

    Raises:
        UserError: A file is missing or wrong; the message names file, line and column.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; `skope eval track` makes it")
    path = folder / TRACKS_CSV
    if not path.is_file():
        raise UserError(f"{path}: no such file; `skope eval track FOLDER --out {folder}` makes it")
    found = [_vehicle(path, rows, observation) for rows in _tracks(path, _OF_VEHICLES)]
    others = folder / ROAD_USERS_CSV
    if others.is_file():
        found += [_other(others, rows, observation) for rows in _tracks(others, _OF_OTHERS)]
    return found


def _tracks(path: Path, columns: Sequence[str]) -> Iterator[CsvRows]:
    """The rows of each track of a file, which lie together, each with its line under "line"."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            missing = [name for name in columns if name not in (reader.fieldnames or ())]
            if missing:
                raise UserError(f"{path}: expected a column {missing[0]}")
            rows: CsvRows = []
            for row in reader:
                row["line"] = str(reader.line_num)
                if rows and row["track"] != rows[0]["track"]:
                    yield rows
                    rows = []
                rows.append(row)
            if rows:
                yield rows
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


def _numbers(path: Path, rows: CsvRows, name: str, *, empty: bool = False) -> Array:
    """(M,) a column's numbers; with `empty`, an empty cell is NaN."""
    out = np.empty(len(rows))
    for i, row in enumerate(rows):
        text = row[name]
        try:
            out[i] = math.nan if empty and text == "" else float(text)
        except (TypeError, ValueError):
            raise UserError(f"{path}: line {row['line']}: {name}: expected a number, got {text!r:.40}") from None
        if not (math.isfinite(out[i]) or (empty and text == "")):
            raise UserError(f"{path}: line {row['line']}: {name}: expected a finite number, got {text!r:.40}")
    return out


def _columns(path: Path, rows: CsvRows, observation: Observation) -> dict[str, Any]:
    """Columns that vehicles and other road users have alike, by the names of `Trajectory`."""
    column = {name: _numbers(path, rows, name, empty=name == "heading_deg") for name in _SHARED}
    if (np.diff(column["time_s"]) <= 0).any():
        raise UserError(f"{path}: line {rows[0]['line']}: time_s: expected times that rise along the track")
    place = np.stack([column["x"], column["y"]], axis=1)
    velocity = np.stack([column["vx"], column["vy"]], axis=1)
    return {
        "times_s": column["time_s"],
        "place": place,
        "velocity": velocity,
        "heading": np.radians(column["heading_deg"]),
        "covariance": place_covariance(place, column["z"], column["sigma_position"], observation),
        "speed_sigma": speed_sigma(place, velocity, column["z"], column["sigma_speed"], observation),
    }


def _vehicle(path: Path, rows: CsvRows, observation: Observation) -> Trajectory:
    first = rows[0]
    if first["class"] not in CLASSES:
        raise UserError(f"{path}: line {first['line']}: class: expected one of {', '.join(CLASSES)}")
    length, width, confidence = (_numbers(path, rows[:1], name)[0] for name in ("length", "width", "class_confidence"))
    if not (length > 0 and width > 0 and 0 <= confidence <= 1):
        raise UserError(f"{path}: line {first['line']}: length, width, class_confidence: out of range")
    height = _numbers(path, rows[:1], "height", empty=True)[0] if "height" in first else math.nan
    return Trajectory(
        number=_number(path, first),
        category=VEHICLE,
        class_name=first["class"],
        class_confidence=float(confidence),
        located=_numbers(path, rows, "located") > 0,
        length=float(length),
        width=float(width),
        height=float(height) if height > 0 else None,
        flags=tuple(first["flags"].split()),
        **_columns(path, rows, observation),
    )


def _other(path: Path, rows: CsvRows, observation: Observation) -> Trajectory:
    first = rows[0]
    if first["category"] not in CATEGORIES[1:]:
        raise UserError(f"{path}: line {first['line']}: category: expected one of {', '.join(CATEGORIES[1:])}")
    return Trajectory(
        number=_number(path, first),
        category=first["category"],
        class_name=first["category"],
        class_confidence=1.0,
        located=_numbers(path, rows, "located") > 0,
        **_columns(path, rows, observation),
    )


def _number(path: Path, row: Mapping[str, str]) -> int:
    if not row["track"].isdecimal():
        raise UserError(f"{path}: line {row['line']}: track: expected a whole number, got {row['track']!r:.40}")
    return int(row["track"])
