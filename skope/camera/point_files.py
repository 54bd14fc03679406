"""Read marked points: CSV with world metres or WGS84, and OTVision's reference points (`.otrfpts`).

Map coordinates are large. They are shifted to a local origin, which is returned with the points.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.camera.evidence import MARKING_ERRORS, MarkedPoint
from skope.camera.geographic import local_metres, utm_scale
from skope.errors import UserError
from skope.files.csv_files import read_csv
from skope.files.json_files import read_json
from skope.types import Array

METRIC_COLUMNS: Final = ("column", "row", "x", "y", "z")
"""Columns of a file with metric positions."""
GEOGRAPHIC_COLUMNS: Final = ("column", "row", "longitude", "latitude")
"""Columns of a file with longitude and latitude."""
DEFAULT_SIGMAS: Final = {
    "sigma_px": MARKING_ERRORS.pixel,
    "sigma_m": MARKING_ERRORS.position_m,
    "sigma_z_m": MARKING_ERRORS.height_m,
}
"""Columns of standard deviations, with their defaults."""
OTVISION_COLUMNS: Final = ("x_px", "y_px", "hemisphere", "zone_utm", "lon_utm", "lat_utm")
"""Columns of OTVision's files."""


@dataclass(frozen=True)
class PointFileLimits:
    """Limits of coordinates in files of points."""

    widest_px: float = 1e5
    """Maximum column or row, pixels."""
    farthest_m: float = 1e8
    """Maximum coordinate, metres."""
    spread_m: float = 20_000.0
    """Maximum distance between points of one camera, metres."""
    stretched: float = 5e-4
    """Minimum deviation of UTM's scale from 1 that is reported. Inside a zone it is smaller."""


POINT_FILE_LIMITS: Final = PointFileLimits()


@dataclass(frozen=True, kw_only=True, eq=False)
class PointFile:
    """Points of a file, in metres of a local world."""

    points: tuple[MarkedPoint, ...]
    world: Mapping[str, Any] | None = None
    """Map position of the world's (0, 0), for the camera's file; None: the file's own coordinates are the world's.
    """
    notes: tuple[str, ...] = ()
    """Sentences for the user on these coordinates."""


def read_points(path: Path) -> PointFile:
    """Read a file of marked points.

    Args:
        path: `.otrfpts` or `.json` of OTVision; else CSV with the columns column, row, x, y, z, or column, row,
            longitude, latitude and perhaps z; perhaps name, sigma_px, sigma_m, sigma_z_m.

    Raises:
        UserError: The file cannot be read, or a value is missing or invalid; the message names file and field.
    """
    return _otvision(path) if path.suffix.lower() in (".otrfpts", ".json") else _table(path)


# ----------------------------------------------------------------------------------------------------------------- CSV


def _table(path: Path) -> PointFile:
    names, rows = read_csv(path)
    geographic = "longitude" in names and "x" not in names
    needed = GEOGRAPHIC_COLUMNS if geographic else METRIC_COLUMNS
    if missing := [name for name in needed if name not in names]:
        raise UserError(f"{path}: column {missing[0]}: missing; expected {','.join(needed)}")
    numbers = [name for name in (*needed, "z", *DEFAULT_SIGMAS) if name in names]
    values = {name: np.zeros(len(rows)) for name in numbers}
    for k, row in enumerate(rows):
        for name in numbers:
            values[name][k] = _number(path, f"line {k + 2}: {name}", row[name])
    labels = [(row.get("name") or "").strip() or str(k) for k, row in enumerate(rows, start=1)]
    z = values["z"] if "z" in values else np.zeros(len(rows))
    world, notes = None, tuple[str, ...]()
    if geographic:
        xy, world = _from_wgs84(path, values["longitude"], values["latitude"])
        notes = ("positions are metres east and north of the points' centre; the file has its longitude and latitude",)
    else:
        xy = np.column_stack([values["x"], values["y"]])
    pixels = np.column_stack([values["column"], values["row"]])
    sigmas = {name: values.get(name, np.full(len(rows), default)) for name, default in DEFAULT_SIGMAS.items()}
    return _made(path, labels, pixels, np.column_stack([xy, z]), sigmas, world, notes)


def _from_wgs84(path: Path, longitude: Array, latitude: Array) -> tuple[Array, Mapping[str, Any]]:
    for name, values, most in (("longitude", longitude, 180.0), ("latitude", latitude, 90.0)):
        if (np.abs(values) > most).any():
            raise UserError(f"{path}: {name}: expected -{most:g} to {most:g} degrees")
    if not len(longitude):
        return np.zeros((0, 2)), {}
    origin = (round(float(np.median(longitude)), 6), round(float(np.median(latitude)), 6))
    world = {"origin": {"longitude": origin[0], "latitude": origin[1]}, "axes": "east, north"}
    return local_metres(longitude, latitude, origin), world


# ------------------------------------------------------------------------------------------------------------ OTVision


def _otvision(path: Path) -> PointFile:
    document = read_json(path)
    if not isinstance(document, dict) or not all(isinstance(row, dict) for row in document.values()):
        raise UserError(f"{path}: expected a JSON object of points")
    rows: list[tuple[float, ...]] = []
    zones = set[str]()
    for name, row in document.items():
        if missing := [key for key in OTVISION_COLUMNS if key not in row]:
            raise UserError(f"{path}: {name}.{missing[0]}: missing")
        zone, half = row["zone_utm"], row["hemisphere"]
        if isinstance(zone, bool) or not isinstance(zone, int) or not 1 <= zone <= 60:
            raise UserError(f"{path}: {name}.zone_utm: expected 1 to 60")
        if half not in ("N", "S"):
            raise UserError(f'{path}: {name}.hemisphere: expected "N" or "S"')
        zones.add(f"{zone}{half}")
        rows.append(tuple(_number(path, f"{name}.{key}", row[key]) for key in ("x_px", "y_px", "lon_utm", "lat_utm")))
    if len(zones) > 1:
        raise UserError(f"{path}: zone_utm: points of {', '.join(sorted(zones))}: expected one zone")
    values = np.array(rows).reshape(-1, 4)
    if not len(values):
        raise UserError(f"{path}: expected a JSON object of points")
    zone_half = zones.pop()
    origin = np.round(np.median(values[:, 2:], axis=0))
    south = zone_half.endswith("S")
    scale = utm_scale(float(origin[0]), float(origin[1]), south=south)
    world = {
        "origin": {"easting": float(origin[0]), "northing": float(origin[1])},
        "utm_zone": zone_half,
        "epsg": (32700 if south else 32600) + int(zone_half[:-1]),
        "scale": round(scale, 7),
    }
    notes = [
        f"UTM zone {zone_half}: the world's (0, 0) is at easting {origin[0]:.0f}, northing {origin[1]:.0f}; the points "
        "have no heights: the road is taken to be a plane"
    ]
    if abs(scale - 1) > POINT_FILE_LIMITS.stretched:
        notes.append(
            f"far from the middle of zone {zone_half}: a metre on the road is {scale:.5f} m on the map; distances "
            f"and speeds are too {'large' if scale > 1 else 'small'} by {abs(scale - 1):.2%}"
        )
    places = np.column_stack([values[:, 2:] - origin, np.zeros(len(values))])
    sigmas = {name: np.full(len(values), default) for name, default in DEFAULT_SIGMAS.items()}
    return _made(path, list(document), values[:, :2], places, sigmas, world, tuple(notes))


# --------------------------------------------------------------------------------------------------------------- both


def _made(
    path: Path,
    names: list[str],
    pixels: Array,
    places: Array,
    sigmas: Mapping[str, Array],
    world: Mapping[str, Any] | None,
    notes: tuple[str, ...],
) -> PointFile:
    for k, name in enumerate(names):
        if name in names[:k]:
            raise UserError(f"{path}: name: {name!r} is the name of two points")
        if not name.isprintable() or len(name) > 200:
            raise UserError(f"{path}: name: expected one line and up to 200 letters")
    if (np.abs(pixels) > POINT_FILE_LIMITS.widest_px).any():
        raise UserError(f"{path}: expected pixels within {POINT_FILE_LIMITS.widest_px:g}")
    if (np.abs(places) > POINT_FILE_LIMITS.farthest_m).any() or (
        len(places) and np.ptp(places, axis=0).max() > POINT_FILE_LIMITS.spread_m
    ):
        raise UserError(f"{path}: points lie more than {POINT_FILE_LIMITS.spread_m / 1000:g} km apart")
    points = []
    for k, name in enumerate(names):
        try:
            point_sigmas = {key: float(values[k]) for key, values in sigmas.items()}
            points.append(MarkedPoint(pixels[k], places[k], name=name, **point_sigmas))
        except UserError as error:
            raise UserError(f"{path}: {error}") from None
    return PointFile(points=tuple(points), world=world, notes=notes)


def _number(path: Path, field: str, value: Any) -> float:
    try:
        number = math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        number = math.nan
    if not math.isfinite(number):
        raise UserError(f"{path}: {field}: expected a finite number")
    return number
