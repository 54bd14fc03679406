"""Convert marks of the page to evidence for the solver, and report what is wrong or missing, field by field.

The page's document has lists `points`, `lengths`, `parallels`, `verticals` (pixels of the footage's own size, metres)
and `gates` (`pixels` of the image with its `size`, or `line` in metres), `zones`, `lanes` (the world's metres) and
`occluders` (pixels). A missing value is None. Typed text that is not a number is kept as text until the user corrects
it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from typing import Any, Final
from zoneinfo import ZoneInfo

from skope.camera.evidence import CameraPrior, Evidence
from skope.errors import UserError
from skope.site.calibration_marks import priors_of
from skope.site.mark_parser import (
    KNOWN_RANGES,
    LENS_RANGES,
    MARK_KINDS,
    NO_NAME,
    Problem,
    is_name,
    known_value,
    read_mark,
)
from skope.site.site_file import clock_problem

_MAX_ENTRIES: Final = 500
"""Maximum number of entries of a list; a person marks some dozens."""
SIGMA_FIELDS: Final = ("sigma_m", "sigma_px", "sigma_z_m")
"""Standard deviations that a point may have individually."""


def entries_of(document: Mapping[str, Any], kind: str) -> list[Mapping[str, Any]]:
    """Return a list of the document. Raises UserError if it is not a list of objects."""
    value = document.get(kind, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value) or len(value) > _MAX_ENTRIES:
        raise UserError(f"{kind}: expected a list of up to {_MAX_ENTRIES} objects")
    return value


def unique_names(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return a unique name for each entry, its own if no earlier entry has it, for the solver's messages."""
    out: list[str] = []
    for number, entry in enumerate(entries, start=1):
        given = entry.get("name")
        name = given.strip() if isinstance(given, str) and given.strip() else str(number)
        plain, again = name, 2
        while name in out:
            name, again = f"{plain} ({again})", again + 1
        out.append(name)
    return out


@dataclass(kw_only=True)
class Marks:
    """Evidence of a document, and the entry of each piece of it."""

    evidence: Evidence
    entries: dict[str, dict[str, int]]
    """Index in the document by kind and by the name in the solver, in order."""
    problems: list[Problem] = field(default_factory=list)


def marks_of_document(document: Mapping[str, Any], size: tuple[int, int]) -> Marks:
    """Return the evidence in a document; entries with problems are left out."""
    found: dict[str, list[Any]] = {}
    entries: dict[str, dict[str, int]] = {}
    problems: list[Problem] = []
    for kind in MARK_KINDS:
        names = unique_names(entries_of(document, kind))
        found[kind], entries[kind] = [], {}
        for index, (name, value) in enumerate(zip(names, entries_of(document, kind), strict=True)):
            wrong = _name_problems(kind, index, name, value.get("name", ""))
            made, faults = read_mark(kind, index, name, value.get)
            problems += wrong + faults
            if not wrong and not faults:
                found[kind].append(made)
                entries[kind][name] = index
    priors, wrong = _known(document.get("known"), size[0])
    problems += wrong
    evidence = Evidence(size, **{kind: tuple(found[kind]) for kind in MARK_KINDS}, priors=priors)
    return Marks(evidence=evidence, entries=entries, problems=problems)


def _name_problems(kind: str, index: int, name: str, given: Any) -> list[Problem]:
    """Return the problem of a name that is invalid or used by an earlier entry.

    Args:
        kind: Name of the entry's list.
        index: Index of the entry in its list.
        name: The entry's unique name.
        given: The entry's name in the document.
    """
    if not isinstance(given, str) or not is_name(given or "1"):
        return [Problem(kind=kind, index=index, field="name", text=NO_NAME)]
    if given.strip() and given.strip() != name:
        return [
            Problem(kind=kind, index=index, field="name", text=f"another entry is already called {given.strip()!r}")
        ]
    return []


def _known(value: Any, width: int) -> tuple[tuple[CameraPrior, ...], list[Problem]]:
    """Return prior knowledge of the camera: `fov_deg` and `height_m`, each [value, standard deviation]."""
    given = value if isinstance(value, dict) else {}
    found: dict[str, tuple[float, float]] = {}
    problems = []
    for name, limits in KNOWN_RANGES.items():
        if given.get(name) in (None, [None, None]):
            continue
        if pair := known_value(given[name], limits):
            found[name] = pair
        else:
            unit = "degrees" if name == "fov_deg" else "metres"
            text = f"expected {limits[0]:g} to {limits[1]:g} {unit}, and a standard deviation"
            problems.append(Problem(kind="known", index=0, field=name, text=text))
    lens = given.get("lens")
    return priors_of(width, **found, lens=None if lens is None else _lens(lens)), problems


def _lens(value: Any) -> dict[str, tuple[float, float]]:
    """Return the lens of a camera file, which the page shows and does not change."""
    given = {key: value[key] for key in LENS_RANGES if value.get(key) is not None} if isinstance(value, dict) else {}
    lens = {key: pair for key in given if (pair := known_value(given[key], LENS_RANGES[key]))}
    if "focal_px" not in lens or len(lens) < len(given):
        raise UserError("known.lens: expected focal_px and k1, each [value, standard deviation]")
    return lens


@dataclass(frozen=True, kw_only=True)
class FootageTime:
    """Time at which the footage was taken, as entered on the page."""

    time_zone: str | None
    start: datetime | None
    """Start with its own zone, or without one if it is in `time_zone`."""
    problems: tuple[Problem, ...]


def read_time(document: Mapping[str, Any]) -> FootageTime:
    """Read time zone and start of a document, texts or None, with their problems."""
    problems: list[Problem] = []

    def wrong(field: str, text: str) -> None:
        problems.append(Problem(kind="footage", index=0, field=field, text=text))

    name, zone = document.get("time_zone"), None
    if name not in (None, ""):
        zone = _zone(name)
        if zone is None:
            wrong("time_zone", 'expected a name like "Europe/Berlin"')
    text, start = document.get("start"), None
    if text not in (None, ""):
        try:
            start = datetime.fromisoformat(text.strip().replace(" ", "T", 1))
        except (AttributeError, ValueError):
            wrong("start", "expected date and time, like 2026-11-26 10:00:00")
    if start is not None and start.tzinfo is None:
        if zone is None and not problems:
            wrong("start", "type the time zone too")
        elif zone is not None and (fault := clock_problem(start, zone)):
            wrong("start", fault)
    return FootageTime(time_zone=zone.key if zone else None, start=start, problems=tuple(problems))


def time_texts(time_zone: str | None, start: datetime | None) -> dict[str, str | None]:
    """Return `time_zone` and `start` of a document; a start in that zone is written without it."""
    if start is not None and time_zone is not None and getattr(start.tzinfo, "key", None) == time_zone:
        start = start.replace(tzinfo=None)
    return {"time_zone": time_zone, "start": None if start is None else start.isoformat(sep=" ")}


def _zone(name: Any) -> ZoneInfo | None:
    try:
        return ZoneInfo(name)
    except (ValueError, KeyError, OSError, TypeError):  # unknown zone, a path, a folder of zones
        return None
