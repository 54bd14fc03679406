"""Parse marks in a camera's image, from a site file or from the page, with one set of limits."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skope.camera.evidence import MARKING_ERRORS, MarkedLength, MarkedPoint, ParallelLines, Vertical
from skope.errors import UserError
from skope.records import is_number, shown


@dataclass(frozen=True)
class MarkLimits:
    """Limits of numbers in marks, and default standard deviations."""

    farthest_m: float = 1e8
    """Maximum coordinate of a position, metres."""
    widest_px: float = 1e5
    """Maximum column or row of a mark, pixels."""
    length_m: tuple[float, float] = (0.01, 1e4)
    """Range of a marked length, metres."""
    vertical_m: tuple[float, float] = (0.01, 1000.0)
    """Range of the height of a vertical, metres."""
    sigma: tuple[float, float] = (1e-4, 1e3)
    """Range of standard deviations of marks, metres or pixels."""
    least_known_sigma: float = 1e-4
    """Minimum standard deviation of values of `KNOWN_RANGES` and of a lens, in their units. The maximum is their
    upper limit."""
    name_letters: int = 200
    """Maximum number of letters of a name."""
    lane_width_m: tuple[float, float] = (0.5, 50.0)
    """Range of the width of a lane, metres."""
    length_sigma_m: float = 0.05
    """Default standard deviation of a length, metres."""
    height_sigma_m: float = 0.1
    """Default standard deviation of the height of a vertical, metres."""
    most_rows: int = 500
    """Maximum number of positions of an entry."""
    shortest_px: float = 1.0
    """Minimum distance between the ends of a mark, pixels."""


MARK_LIMITS: Final = MarkLimits()

KNOWN_RANGES: Final = {"fov_deg": (2.0, 170.0), "height_m": (0.5, 1000.0)}
"""Horizontal field of view, degrees, and the camera's height over the road, metres."""
LENS_RANGES: Final = {"focal_px": (10.0, 1e5), "k1": (-2.0, 2.0)}
NO_NAME: Final = f"expected a name of one line and up to {MARK_LIMITS.name_letters} letters"
MARK_KINDS: Final = ("points", "lengths", "parallels", "verticals")
"""Lists of marks, in the order of their residuals."""


@dataclass(frozen=True, kw_only=True)
class Problem:
    """Error in one field of an entry of the page's document."""

    kind: str
    """Name of the list."""
    index: int
    field: str
    text: str
    missing: bool = False
    """Whether the field is only not filled in yet, and not wrong."""


def is_name(value: Any) -> bool:
    """Return whether a value is a name of one line, in any script, and not too long to be shown."""
    return (
        isinstance(value, str)
        and bool(value.strip())
        and len(value) <= MARK_LIMITS.name_letters
        and value.isprintable()
    )


def number_or_none(value: Any) -> float | None:
    """Return a finite number, or None for anything else."""
    return float(value) if is_number(value) else None


def positions(value: Any, width: int) -> list[list[float]] | None:
    """Return rows of `width` numbers each, or None for anything else."""
    if not isinstance(value, list) or len(value) > MARK_LIMITS.most_rows:
        return None
    if any(not isinstance(row, list) or len(row) != width or not all(map(is_number, row)) for row in value):
        return None
    return [[float(number) for number in row] for row in value]


def known_value(value: Any, limits: tuple[float, float]) -> tuple[float, float] | None:
    """Return a possible value of a camera with its standard deviation; None for anything else.

    Args:
        value: [value, standard deviation], in the same unit. The standard deviation must be between
            `MARK_LIMITS.least_known_sigma` and the upper limit.
        limits: Minimum and maximum value.
    """
    rows = positions([value], 2)
    if rows is None:
        return None
    (found, sigma), (low, high) = rows[0], limits
    return (found, sigma) if low <= found <= high and MARK_LIMITS.least_known_sigma <= sigma <= high else None


def read_mark(kind: str, index: int, name: str, value: Callable[[str], Any]) -> tuple[Any, list[Problem]]:
    """Read one mark.

    Args:
        kind: One of `MARK_KINDS`.
        index: Index in its list, for the problems.
        name: Name of the mark.
        value: Function that returns the value of a field; None if there is none.

    Returns:
        The mark (None if there are problems) and the problems.
    """
    fields = _Fields(kind, index, value)
    made = None
    try:
        made = MARK_READERS[kind](fields, name)
    except UserError as error:
        if not fields.problems:
            fields.wrong("", str(error))
    return (None if fields.problems else made), fields.problems


class _Fields:
    """Fields of one entry, and the problems found in them."""

    def __init__(self, kind: str, index: int, value: Callable[[str], Any]) -> None:
        self.kind, self.index, self.value = kind, index, value
        self.problems: list[Problem] = []

    def wrong(self, field: str, text: str, *, missing: bool = False) -> None:
        self.problems.append(Problem(kind=self.kind, index=self.index, field=field, text=text, missing=missing))

    def number(self, field: str, low: float, high: float, unit: str, default: float | None = None) -> float:
        """Return a number between two limits; NaN, with a problem noted, if it is missing or invalid.

        An empty field has the default; if that is None, the field is missing.
        """
        value = self.value(field)
        if value in (None, ""):
            if default is None:
                self.wrong(field, f"type how many {unit}", missing=True)
            return math.nan if default is None else default
        found = number_or_none(value)
        if found is None or not low <= found <= high:
            self.wrong(field, f"expected a number from {low:g} to {high:g} {unit}".rstrip() + f", got {shown(value)}")
        return math.nan if found is None else found

    def sigma(self, field: str, default: float) -> float:
        """Return a standard deviation."""
        return self.number(field, *MARK_LIMITS.sigma, "", default)

    def ends(self, field: str, same: str) -> Any:
        """Return (2, 2) both ends of a mark, pixels; `same` is the message for equal ends."""
        rows = in_image(self.value(field))
        if rows is None or len(rows) != 2:
            self.wrong(field, "expected column and row in pixels, two numbers, of both ends")
        elif math.dist(*rows) < MARK_LIMITS.shortest_px:
            self.wrong(field, same)
        return np.array(rows)


def in_image(value: Any) -> list[list[float]] | None:
    """Return rows of column and row within the limits of marks, or None for anything else."""
    rows = positions(value, 2)
    return None if rows is None or any(abs(number) > MARK_LIMITS.widest_px for row in rows for number in row) else rows


def _point(fields: _Fields, name: str) -> MarkedPoint | None:
    pixel = in_image([fields.value("pixel")])
    if pixel is None:
        fields.wrong("pixel", "expected column and row in pixels, two numbers")
    position = fields.value("place")
    if position is None:
        position = [None, None, 0.0]
    if not isinstance(position, list) or len(position) not in (2, 3):
        fields.wrong("place", f"expected 2 or 3 numbers, metres, got {shown(position)}")
        return None
    position = [*position, 0.0][:3]
    for axis, value in zip("xyz", position, strict=True):
        found = number_or_none(value)
        if value in (None, ""):
            fields.wrong(f"place.{axis}", "type it in metres", missing=True)
        elif found is None or abs(found) > MARK_LIMITS.farthest_m:
            fields.wrong(f"place.{axis}", f"expected metres, got {shown(value)}")
    usual = {
        "sigma_px": MARKING_ERRORS.pixel,
        "sigma_m": MARKING_ERRORS.position_m,
        "sigma_z_m": MARKING_ERRORS.height_m,
    }
    sigmas = {field: fields.sigma(field, default) for field, default in usual.items()}
    if fields.problems or pixel is None:
        return None
    return MarkedPoint(np.array(pixel[0]), np.array(position, dtype=np.float64), name=name, **sigmas)


def _length(fields: _Fields, name: str) -> MarkedLength | None:
    pixels = fields.ends("pixels", "its two ends are the same")
    metres = fields.number("metres", *MARK_LIMITS.length_m, "metres")
    sigmas = {
        "sigma_m": fields.sigma("sigma_m", MARK_LIMITS.length_sigma_m),
        "sigma_px": fields.sigma("sigma_px", MARKING_ERRORS.pixel),
    }
    return None if fields.problems else MarkedLength(pixels, metres, name=name, **sigmas)


def _parallels(fields: _Fields, name: str) -> ParallelLines | None:
    lines = fields.value("lines")
    rows = [in_image(line) for line in lines] if isinstance(lines, list) else []
    sigma = fields.sigma("sigma_px", MARKING_ERRORS.pixel)
    if not rows or any(row is None or len(row) != 2 for row in rows):
        fields.wrong("lines", "expected column and row in pixels for both ends of each line")
    elif len(rows) < 2:
        fields.wrong("lines", "draw a second line that is parallel to this one on the road", missing=True)
    elif any(row is not None and math.dist(*row) < MARK_LIMITS.shortest_px for row in rows):
        fields.wrong("lines", "both ends of a line are the same")
    return None if fields.problems else ParallelLines(np.array(rows), name=name, sigma_px=sigma)


def _vertical(fields: _Fields, name: str) -> Vertical | None:
    pixels = fields.ends("pixels", "its foot and its top are the same")
    known = fields.value("metres") not in (None, "")
    metres = fields.number("metres", *MARK_LIMITS.vertical_m, "metres") if known else None
    sigmas = {
        "sigma_m": fields.sigma("sigma_m", MARK_LIMITS.height_sigma_m),
        "sigma_px": fields.sigma("sigma_px", MARKING_ERRORS.pixel),
    }
    return None if fields.problems else Vertical(pixels, metres, name=name, **sigmas)


MARK_READERS: Final[Mapping[str, Callable[[_Fields, str], Any]]] = {
    "points": _point,
    "lengths": _length,
    "parallels": _parallels,
    "verticals": _vertical,
}
