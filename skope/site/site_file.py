"""Read a site file: camera, calibration marks, gates, zones, lanes, occluders, plan, and the time of the footage.

`skope gen --site` reads the same file. Unknown keys are reported and kept when the file is saved
(`skope.site.write_site`). Local times are those of clocks at the road. When the clocks change, a local time can be
ambiguous or impossible.
"""

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final, TypeVar
from zoneinfo import ZoneInfo

from skope.errors import UserError
from skope.files.atomic import decoded, read_bytes
from skope.records import TomlTable
from skope.site.calibration_marks import CalibrationMarks, read_marks
from skope.site.gates_zones_lanes import (
    Gate,
    Lane,
    OccluderMark,
    Zone,
    gate_on_road,
    read_gate,
    read_lane,
    read_occluder,
    read_zone,
)
from skope.site.mark_parser import MARK_LIMITS
from skope.site.site_camera import OwnCamera, read_site_camera
from skope.site.traffic_settings import TrafficSettings, read_traffic
from skope.site.world import read_world

_FOOTAGE_YEARS: Final = range(1900, 2900)
"""Years in which footage may begin. Times near year 1 or 9999 cannot be converted to other zones."""


def year_problem(time: datetime) -> str:
    """Return a message on an implausible year of footage; empty for other years."""
    if time.year in _FOOTAGE_YEARS:
        return ""
    return f"expected a year from {_FOOTAGE_YEARS.start} to {_FOOTAGE_YEARS.stop - 1}, got {time.year}"


def clock_problem(time: datetime, zone: ZoneInfo) -> str:
    """Check a local time against the clocks of its zone.

    Args:
        time: The time, without an offset.
        zone: The zone of the time.

    Returns:
        A message if clocks skip the time or show it twice, or its year is impossible; else empty.
    """
    if problem := year_problem(time):
        return problem
    first, second = (time.replace(tzinfo=zone, fold=fold) for fold in (0, 1))
    if first.astimezone(UTC).astimezone(zone).replace(tzinfo=None) != time:
        return f"there is no such time in {zone.key}: clocks are put forward then"
    if first.utcoffset() != second.utcoffset():
        ways = " or ".join(f"{moment.isoformat(sep=' ')}" for moment in (first, second))
        return f"clocks show this twice, as they are put back: type {ways}"
    return ""


_PIXEL_M: Final = (1e-5, 1e4)
"""Range of the size of a plan's pixel, metres."""


@dataclass(frozen=True, kw_only=True)
class PlanPicture:
    """Image of the road from above."""

    file: Path
    """File of the image, which may be missing."""
    metres_per_pixel: float
    origin: tuple[float, float]
    """World x and y of the image's top-left corner, metres."""
    rotation_deg: float
    """Angle of the image's up direction from the world's y, counter-clockwise, degrees."""


def read_plan(table: TomlTable, unknown: list[str]) -> PlanPicture:
    """Read the plan of a table; unknown keys are added to `unknown`.

    Raises:
        UserError: A key is missing or invalid; the message names file and key.
    """
    name = table.text("file")
    if not name or not name.isprintable():
        raise table.wrong("file", "expected the name of a picture")
    x, y = table.numbers("origin", 2)
    if max(abs(x), abs(y)) > MARK_LIMITS.farthest_m:
        raise table.wrong("origin", f"expected metres within {MARK_LIMITS.farthest_m:g}")
    plan = PlanPicture(
        file=table.path.parent / name,
        metres_per_pixel=table.number("metres_per_pixel", low=_PIXEL_M[0], high=_PIXEL_M[1]),
        origin=(x, y),
        rotation_deg=table.number("rotation_deg", 0.0, low=-360, high=360),
    )
    unknown += table.unread
    return plan


_Part = TypeVar("_Part")
_FOR_GENERATING: Final = (
    *("background", "conditions", "flows", "ground_height", "lefthand", "light", "name", "network", "origin"),
    *("shades", "splits", "style", "vehicles_per_hour"),
)
"""Keys that only `skope gen` reads."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SiteParts:
    """Parts of a site file that generation and evaluation share, without camera and occluders."""

    calibration: CalibrationMarks | None
    """Marks that calibrate the camera; None: there are none."""
    gates: tuple[Gate, ...]
    zones: tuple[Zone, ...]
    lanes: tuple[Lane, ...]
    time_zone: str | None
    """Name of the local time zone of the road, for example "Europe/Berlin"; None: not given."""
    start: datetime | None
    """Time at which the footage begins, with its zone; None: not given."""
    world: Mapping[str, Any] | None
    """Position of the world's (0, 0) on a map; None if it is not given."""
    plan: PlanPicture | None
    """Image of the road from above; None: there is none."""
    traffic: TrafficSettings
    """Rules for counting and measuring traffic."""
    unknown: tuple[str, ...]
    """Unknown keys in these parts."""


@dataclass(frozen=True, kw_only=True, eq=False)
class SiteFile(SiteParts):
    """Contents of a site file."""

    path: Path
    revision: str
    """SHA-256 of the bytes that were read, which shows whether the file has been saved again since."""
    camera: OwnCamera | None
    """The camera with its uncertainty; None if the file has no camera yet."""
    occluders: tuple[OccluderMark, ...]


def read_site(path: Path) -> SiteFile:
    """Read and check a site file (TOML).

    Args:
        path: A TOML file (docs/own-road.md); files that it names are relative to its folder.

    Raises:
        UserError: A file cannot be read, or a key is missing or invalid; the message names file and key.
    """
    return parse_site(path, read_bytes(path))


def parse_site(path: Path, data: bytes) -> SiteFile:
    """Parse the content of a site file.

    Args:
        path: Path of the file. It is used in error messages, and files that the content names are relative to its
            folder.
        data: Content of the file.

    Raises:
        UserError: A file cannot be read, or a key is missing or invalid; the message names file and key.
    """
    try:
        table = TomlTable.parse(path, decoded(data))
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8 text") from None
    camera = read_site_camera(table.table("camera"), None) if "camera" in table else None
    parts = read_parts(table)
    occluders, unknown = [], list(parts.unknown)
    for row in table.rows("occluders"):
        occluders.append(read_occluder(row))
        unknown += row.unread
    unread_keys = [key for key in table.unread if key not in _FOR_GENERATING]
    gates = parts.gates if camera is None else tuple(gate_on_road(gate, camera.camera) for gate in parts.gates)
    return SiteFile(
        **{**vars(parts), "unknown": (*unread_keys, *unknown), "gates": gates},
        path=path,
        revision=hashlib.sha256(data).hexdigest(),
        camera=camera,
        occluders=tuple(occluders),
    )


def read_parts(table: TomlTable) -> SiteParts:
    """Return the shared parts of a site file. Raises UserError with the file and the invalid key."""
    unknown: list[str] = []
    zone = _time_zone(table)
    gates = _named(table, "gates", read_gate, unknown)
    if "image_gates" in table:
        raise table.wrong("image_gates", "gates in the image stand in [[gates]] too, with `pixels`")
    return SiteParts(
        calibration=read_marks(table.table("calibration"), unknown) if "calibration" in table else None,
        gates=gates,
        zones=_named(table, "zones", read_zone, unknown),
        lanes=_named(table, "lanes", read_lane, unknown),
        time_zone=zone.key if zone else None,
        start=_start(table, zone),
        world=read_world(table.table("world"), unknown) if "world" in table else None,
        plan=read_plan(table.table("plan"), unknown) if "plan" in table else None,
        traffic=read_traffic(table.table("traffic"), tuple(gate.name for gate in gates), unknown),
        unknown=tuple(unknown),
    )


def _named(table: TomlTable, key: str, read: Callable[[TomlTable], _Part], unknown: list[str]) -> tuple[_Part, ...]:
    """Return the rows of a list of tables with unique names."""
    out, names = [], set[str]()
    for row in table.rows(key):
        out.append(read(row))
        name = row.text("name")
        if name in names:
            raise row.wrong("name", f"{name!r} is the name of two {key}")
        names.add(name)
        unknown += row.unread
    return tuple(out)


def _time_zone(table: TomlTable) -> ZoneInfo | None:
    if "time_zone" not in table:
        return None
    name = table.text("time_zone")
    try:
        return ZoneInfo(name)
    except (ValueError, KeyError, OSError):  # unknown zone, a path, a folder of zones
        raise table.wrong("time_zone", f'expected a name like "Europe/Berlin", got {name[:60]!r}') from None


def _start(table: TomlTable, zone: ZoneInfo | None) -> datetime | None:
    if "start" not in table:
        return None
    start = table.value("start")
    if not isinstance(start, datetime) or (start.tzinfo is None and zone is None):
        raise table.wrong("start", "expected a time with its zone, like 2026-11-26T10:00:00+01:00, or time_zone too")
    if start.tzinfo is not None or zone is None:
        problem, zoned = year_problem(start), start
    else:
        problem, zoned = clock_problem(start, zone), start.replace(tzinfo=zone)
    if problem:
        raise table.wrong("start", problem)
    return zoned
