"""Marks of the page as evidence for the solver, and what is wrong or missing in them, field by field.

The page's document has lists `points`, `lengths`, `parallels`, `verticals` (pixels of the footage's own size, metres)
and `gates` (`pixels` of the image with its `size`, or `line` in metres), `zones`, `lanes` (the world's metres) and
`occluders` (pixels). A value that is not given yet is None; what a user typed that is no number is a text, and stays in
the page until it is mended.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from skope.camera.evidence import MARKING_ERRORS, Belief, Evidence, MarkedLength, MarkedPoint, ParallelLines, Vertical
from skope.errors import UserError
from skope.site.calibration_marks import beliefs_of
from skope.site.mark_limits import (
    FARTHEST,
    KNOWN_RANGES,
    LENGTH_M,
    LENS,
    MARKED_LENGTH_SIGMA_M,
    SIGMA,
    VERTICAL_M,
    WIDEST_PX,
    is_known,
)
from skope.site.page.document_values import NO_NAME, entries_of, is_name, number_or_none, positions, unique_names

KINDS: Final = ("points", "lengths", "parallels", "verticals")
"""Lists of evidence in the document, in the order in which the solver has their residuals."""
SIGMA_FIELDS: Final = ("sigma_m", "sigma_px", "sigma_z_m")
"""Standard deviations that a point may have of its own."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Fault of one field of one entry of the document."""

    kind: str
    """Name of the list."""
    index: int
    field: str
    text: str
    missing: bool = False
    """Whether the field is only not filled in yet."""


@dataclass(kw_only=True)
class Marks:
    """The evidence of a document, and which entry each piece of it is."""

    evidence: Evidence
    entries: dict[str, dict[str, int]]
    """Index in the document by kind and by the name that the solver has for it, in order."""
    problems: list[Problem] = field(default_factory=list)


def marks_of_document(document: Mapping[str, Any], size: tuple[int, int]) -> Marks:
    """The evidence in a document; entries with problems are left out of it."""
    makers: dict[str, Callable[[_Entry], Any]] = {
        "points": _point,
        "lengths": _length,
        "parallels": _parallels,
        "verticals": _vertical,
    }
    found: dict[str, list[Any]] = {}
    entries: dict[str, dict[str, int]] = {}
    problems: list[Problem] = []
    for kind in KINDS:
        names = unique_names(entries_of(document, kind))
        found[kind], entries[kind] = [], {}
        for index, (name, value) in enumerate(zip(names, entries_of(document, kind), strict=True)):
            entry = _Entry(kind, index, name, value)
            entry.check_name()
            made = None
            try:
                made = makers[kind](entry)
            except UserError as error:
                if not entry.problems:
                    entry.wrong("", str(error))
            problems += entry.problems
            if made is not None and not entry.problems:
                found[kind].append(made)
                entries[kind][name] = index
    beliefs, wrong = _known(document.get("known"), size[0])
    problems += wrong
    evidence = Evidence(size, **{kind: tuple(found[kind]) for kind in KINDS}, beliefs=beliefs)
    return Marks(evidence=evidence, entries=entries, problems=problems)


def _known(value: Any, width: int) -> tuple[tuple[Belief, ...], list[Problem]]:
    """Prior knowledge of the camera: `fov_deg` and `height_m`, each [value, standard deviation]."""
    found: dict[str, tuple[float, float]] = {}
    problems = []
    for name, limits in KNOWN_RANGES.items():
        pair = value.get(name) if isinstance(value, dict) else None
        if pair is None or pair == [None, None]:
            continue
        rows = positions([pair], 2)
        if rows and is_known(rows[0][0], rows[0][1], limits):
            found[name] = (rows[0][0], rows[0][1])
        else:
            unit = "degrees" if name == "fov_deg" else "metres"
            text = f"expected {limits[0]:g} to {limits[1]:g} {unit}, and how exactly that is known"
            problems.append(Problem(kind="known", index=0, field=name, text=text))
    lens = value.get("lens") if isinstance(value, dict) else None
    return beliefs_of(width, **found, lens=None if lens is None else _lens(lens)), problems


def _lens(value: Any) -> dict[str, tuple[float, float]]:
    """The lens of a camera file, which the page shows and does not change."""
    given = {key: value[key] for key in LENS if value.get(key) is not None} if isinstance(value, dict) else {}
    rows = positions(list(given.values()), 2)
    lens = {key: (row[0], row[1]) for key, row in zip(given, rows or [], strict=False)}
    if "focal_px" not in lens or not all(is_known(*lens[key], LENS[key]) for key in lens):
        raise UserError("known.lens: expected focal_px and k1, each [value, standard deviation]")
    return lens


def _in_image(value: Any) -> list[list[float]] | None:
    """Rows of column and row, no farther off than marks may be, or None for anything else."""
    rows = positions(value, 2)
    return None if rows is None or any(abs(one) > WIDEST_PX for row in rows for one in row) else rows


class _Entry:
    """One entry of a list of the document, and what is wrong with it."""

    def __init__(self, kind: str, index: int, name: str, value: Mapping[str, Any]) -> None:
        self.kind, self.index, self.name, self._value = kind, index, name, value
        self.problems: list[Problem] = []

    def wrong(self, field: str, text: str, *, missing: bool = False) -> None:
        self.problems.append(Problem(kind=self.kind, index=self.index, field=field, text=text, missing=missing))

    def check_name(self) -> None:
        """Note a name that is no name, or that an earlier entry has."""
        own = self._value.get("name", "")
        if not isinstance(own, str) or not is_name(own or "1"):
            self.wrong("name", NO_NAME)
        elif own.strip() and own.strip() != self.name:
            self.wrong("name", f"another one is called {own.strip()!r} already")

    def number(self, field: str, low: float, high: float, unit: str, default: float | None = None) -> float | None:
        """A number between two limits; None, with a problem noted, where there is none such.

        A field that is empty has the default; where that is None, it is missing.
        """
        value = self._value.get(field)
        if value is None or value == "":
            if default is None:
                self.wrong(field, f"type how many {unit}", missing=True)
            return default
        found = number_or_none(value)
        if found is None or not low <= found <= high:
            self.wrong(field, f"expected a number from {low:g} to {high:g} {unit}".rstrip() + f", got {_short(value)}")
            return None
        return found

    def pixels(self, field: str, count: int | None) -> list[list[float]] | None:
        """Positions in the image; None, with a problem noted, where they are not that many."""
        rows = _in_image(self._value.get(field))
        if rows is None or (count is not None and len(rows) != count):
            self.wrong(field, "expected column and row in pixels, two numbers")
            return None
        return rows

    def value(self, field: str) -> Any:
        return self._value.get(field)


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _point(entry: _Entry) -> MarkedPoint | None:
    pixel = _in_image([entry.value("pixel")])
    if pixel is None:
        entry.wrong("pixel", "expected column and row in pixels, two numbers")
    place = entry.value("place")
    wanted = ["x", "y", "z"]
    values = place if isinstance(place, list) and len(place) == 3 else [None, None, None]
    given: list[float] = []
    for axis, value in zip(wanted, values, strict=True):
        found = number_or_none(value)
        if found is None or abs(found) > FARTHEST:
            empty = value is None or value == ""
            entry.wrong(f"place.{axis}", "type it in metres" if empty else f"expected metres, got {_short(value)}",
                        missing=empty)  # fmt: skip
        else:
            given.append(found)
    usual = {"sigma_m": MARKING_ERRORS.place_m, "sigma_px": MARKING_ERRORS.pixel, "sigma_z_m": MARKING_ERRORS.height_m}
    sigmas = {key: entry.number(key, *SIGMA, "", default) for key, default in usual.items()}
    known = {key: sigma for key, sigma in sigmas.items() if sigma is not None}
    if pixel is None or len(given) < 3 or len(known) < len(sigmas):
        return None
    return MarkedPoint(_array(pixel[0]), _array(given), name=entry.name, **known)


def _length(entry: _Entry) -> MarkedLength | None:
    pixels, metres = entry.pixels("pixels", 2), entry.number("metres", *LENGTH_M, "metres")
    sigma = entry.number("sigma_m", *SIGMA, "metres", MARKED_LENGTH_SIGMA_M)
    if pixels is None or metres is None or sigma is None:
        return None
    if math.dist(*pixels) < 1:
        entry.wrong("pixels", "its two ends are the same")
        return None
    return MarkedLength(_array(pixels), metres, sigma_m=sigma, name=entry.name)


def _parallels(entry: _Entry) -> ParallelLines | None:
    lines = entry.value("lines")
    rows = [_in_image(line) for line in lines] if isinstance(lines, list) else []
    if not rows or any(row is None or len(row) != 2 for row in rows):
        entry.wrong("lines", "expected column and row in pixels for both ends of each line")
        return None
    if len(rows) < 2:
        entry.wrong("lines", "draw a second line that is parallel to this one on the road", missing=True)
        return None
    if any(row is not None and math.dist(*row) < 1 for row in rows):
        entry.wrong("lines", "both ends of a line are the same")
        return None
    return ParallelLines(_array(rows), name=entry.name)


def _vertical(entry: _Entry) -> Vertical | None:
    pixels = entry.pixels("pixels", 2)
    known = entry.value("metres") not in (None, "")
    metres = entry.number("metres", *VERTICAL_M, "metres") if known else None
    if pixels is None or (known and metres is None):
        return None
    if math.dist(*pixels) < 1:
        entry.wrong("pixels", "its foot and its top are the same")
        return None
    return Vertical(_array(pixels), metres, name=entry.name)


def _array(value: Any) -> Any:
    import numpy as np

    return np.asarray(value, dtype=np.float64)
