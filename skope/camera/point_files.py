"""Points that were marked in an image and measured on the road: skope's CSV files, and OTVision's `.otrfpts`."""

import csv
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.errors import UserError
from skope.files.json_files import read_json
from skope.files.reading import read_text
from skope.types import Array

_COLUMNS: Final = ("column", "row", "x", "y", "z")
_OTVISION: Final = ("x_px", "y_px", "lon_utm", "lat_utm")


@dataclass(frozen=True, eq=False)
class PointFile:
    """The points of a file."""

    pixels: Array
    """(N, 2) pixels."""
    world: Array
    """(N, 3) metres."""
    names: tuple[str, ...]
    frame: str = ""
    """What the world's metres are counted in, as "UTM zone 32N"; empty where the file does not say it."""


def read_points(path: Path) -> PointFile:
    """The points of a file, whose name tells its format: .otrfpts is OTVision's, anything else a CSV file with the
    columns `column,row,x,y,z`.

    OTVision's points are places in the UTM zone that the file names, eastings and northings as they stand there, also
    where an easting lies outside the zone's usual range; they have no heights, and lie on the plane z = 0.

    Raises:
        UserError: The file cannot be read; the message names file, line and column.
    """
    return _read_otvision(path) if path.suffix.lower() == ".otrfpts" else _read_csv(path)


def _read_csv(path: Path) -> PointFile:
    reader = csv.DictReader(read_text(path).splitlines())
    missing = [name for name in _COLUMNS if name not in (reader.fieldnames or ())]
    if missing:
        raise UserError(f"{path}: column {missing[0]}: missing; expected {','.join(_COLUMNS)}")
    rows = []
    for number, row in enumerate(reader, start=2):
        try:
            rows.append([float(row[name]) for name in _COLUMNS])
        except (TypeError, ValueError):
            raise UserError(f"{path}: line {number}: expected five numbers") from None
    values = np.array(rows, dtype=np.float64).reshape(-1, len(_COLUMNS))
    if not np.isfinite(values).all():
        raise UserError(f"{path}: not all numbers are finite")
    return PointFile(values[:, :2], values[:, 2:], tuple(str(i + 1) for i in range(len(values))))


def _read_otvision(path: Path) -> PointFile:
    document = read_json(path)
    if not isinstance(document, dict) or not document:
        raise UserError(f"{path}: expected an object of points")
    rows, zones = [], set[str]()
    for name, point in document.items():
        rows.append([_number(path, name, point, field) for field in _OTVISION])
        zones.add(f"{point.get('zone_utm')}{point.get('hemisphere')}")
    if len(zones) > 1:
        raise UserError(f"{path}: zone_utm, hemisphere: expected one zone, got {', '.join(sorted(zones))}")
    values = np.array(rows, dtype=np.float64)
    world = np.concatenate([values[:, 2:], np.zeros((len(values), 1))], axis=1)
    return PointFile(values[:, :2], world, tuple(document), f"UTM zone {zones.pop()}")


def _number(path: Path, name: str, point: Any, field: str) -> float:
    value = point.get(field) if isinstance(point, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise UserError(f"{path}: {name[:60]}: {field}: expected a number")
    return float(value)
