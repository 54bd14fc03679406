"""The [calibration] table of a site file: marks that calibrate the camera."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Final, TypeVar

import numpy as np

from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.evidence import MARKING_ERRORS, Belief, Evidence, MarkedLength, MarkedPoint, ParallelLines, Vertical
from skope.errors import UserError
from skope.records import Table
from skope.site.gates_zones_lanes import checked_name
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

_Mark = TypeVar("_Mark")
_LARGEST_PX: Final = 8192


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationMarks:
    """Marks and prior knowledge that tell a camera, in pixels of the footage."""

    size: tuple[int, int] | None
    """Width and height of the images that were marked, pixels; None: the file does not say it."""
    when: datetime | None
    """Time at which they were marked."""
    points: tuple[MarkedPoint, ...] = ()
    lengths: tuple[MarkedLength, ...] = ()
    parallels: tuple[ParallelLines, ...] = ()
    verticals: tuple[Vertical, ...] = ()
    fov_deg: tuple[float, float] | None = None
    """Horizontal field of view and its standard deviation, degrees."""
    lens: Mapping[str, tuple[float, float]] | None = None
    """Calibration of the lens: `focal_px`, and `k1` where it is known, each with its standard deviation."""
    height_m: tuple[float, float] | None = None
    """The camera's height over the road and its standard deviation, metres."""
    vehicles: Belief | None = None
    """Evidence of its vehicles on the camera."""

    def evidence(self, size: tuple[int, int] | None = None) -> Evidence:
        """Evidence for the solver, for images of `size`; None: of the file's own.

        Raises UserError where neither says a size, or they contradict each other.
        """
        if size and self.size and size != self.size:
            raise UserError(
                f"calibration.size: {self.size[0]}x{self.size[1]} was marked, but the images are {size[0]}x{size[1]}"
            )
        whole = size or self.size
        if whole is None:
            raise UserError("calibration.size: missing: expected [width, height] of the images that were marked")
        known = beliefs_of(whole[0], fov_deg=self.fov_deg, lens=self.lens, height_m=self.height_m)
        beliefs = (self.vehicles, *known) if self.vehicles else known
        return Evidence(whole, self.points, self.lengths, self.parallels, self.verticals, beliefs)


def beliefs_of(
    width: int,
    *,
    fov_deg: tuple[float, float] | None = None,
    lens: Mapping[str, tuple[float, float]] | None = None,
    height_m: tuple[float, float] | None = None,
) -> tuple[Belief, ...]:
    """Prior knowledge of a camera as evidence for its calibration.

    Args:
        width: Width of the images, pixels.
        fov_deg: Horizontal field of view and its standard deviation, degrees; None: not known.
        lens: `focal_px` and, where it is known, `k1`, each with its standard deviation; None: not known.
        height_m: Height over the road and its standard deviation, metres; None: not known.
    """
    out = []
    if fov_deg:
        out.append(Belief.of_fov(*fov_deg, width))
    if lens:
        out.append(Belief.of_lens(*lens["focal_px"], lens.get("k1")))
    if height_m:
        out.append(Belief.of_height(*height_m))
    return tuple(out)


def read_marks(table: Table, unknown: list[str]) -> CalibrationMarks:
    """The marks of a [calibration] table; keys that mean nothing here are added to `unknown`.

    Raises:
        UserError: Something is missing or wrong; the message names file and key.
    """
    made = CalibrationMarks(
        size=_size(table),
        when=_time(table, "when"),
        points=_rows(table, "points", _point, unknown),
        lengths=_rows(table, "lengths", _length, unknown),
        parallels=_rows(table, "parallels", _parallel, unknown),
        verticals=_rows(table, "verticals", _vertical, unknown),
        fov_deg=_measured(table, "fov_deg", KNOWN_RANGES["fov_deg"]),
        lens=_lens(table.table("lens"), unknown) if "lens" in table else None,
        height_m=_measured(table, "height_m", KNOWN_RANGES["height_m"]),
        vehicles=_vehicles(table),
    )
    unknown += table.unread
    return made


def _rows(table: Table, key: str, read: Callable[[Table, str], _Mark], unknown: list[str]) -> tuple[_Mark, ...]:
    out, names = [], set[str]()
    for number, row in enumerate(table.rows(key), start=1):
        name = checked_name(row, "name", row.text("name")) if "name" in row else str(number)
        if name in names:
            raise row.wrong("name", f"{name!r} is the name of two {key}")
        names.add(name)
        try:
            out.append(read(row, name))
        except UserError as error:
            raise error if str(error).startswith(str(row.path)) else row.wrong("", str(error)) from None
        unknown += row.unread
    return tuple(out)


def _point(row: Table, name: str) -> MarkedPoint:
    place = row.value("place")
    count = 2 if isinstance(place, list) and len(place) == 2 else 3
    where = row.numbers("place", count)
    if max(map(abs, where)) > FARTHEST:
        raise row.wrong("place", f"expected numbers within {FARTHEST:g}")
    return MarkedPoint(
        _pixels(row, "pixel", 1)[0],
        np.array([*where, 0.0][:3]),
        sigma_px=_sigma(row, "sigma_px", MARKING_ERRORS.pixel),
        sigma_m=_sigma(row, "sigma_m", MARKING_ERRORS.place_m),
        sigma_z_m=_sigma(row, "sigma_z_m", MARKING_ERRORS.height_m),
        name=name,
    )


def _length(row: Table, name: str) -> MarkedLength:
    return MarkedLength(
        _pixels(row, "pixels", 2),
        row.number("metres", low=LENGTH_M[0], high=LENGTH_M[1]),
        sigma_m=_sigma(row, "sigma_m", MARKED_LENGTH_SIGMA_M),
        sigma_px=_sigma(row, "sigma_px", MARKING_ERRORS.pixel),
        name=name,
    )


def _parallel(row: Table, name: str) -> ParallelLines:
    lines = row.value("lines")
    if not isinstance(lines, list) or len(lines) < 2 or not all(isinstance(line, list) for line in lines):
        raise row.wrong("lines", "expected two or more lines of two pixels each")
    marked = [_ends(row, line) for line in lines]
    return ParallelLines(np.array(marked), sigma_px=_sigma(row, "sigma_px", MARKING_ERRORS.pixel), name=name)


def _ends(row: Table, line: object) -> list[list[float]]:
    one = Table(row.path, "", {"line": line})
    try:
        ends = one.matrix("line", 2, 2)
    except UserError:
        raise row.wrong("lines", "expected two pixels [column, row] for each line") from None
    if max(abs(value) for end in ends for value in end) > WIDEST_PX or ends[0] == ends[1]:
        raise row.wrong("lines", f"expected lines between two pixels within {WIDEST_PX:g}")
    return [list(end) for end in ends]


def _vertical(row: Table, name: str) -> Vertical:
    return Vertical(
        _pixels(row, "pixels", 2),
        metres=row.number("metres", low=VERTICAL_M[0], high=VERTICAL_M[1]) if "metres" in row else None,
        sigma_m=_sigma(row, "sigma_m", 0.1),
        sigma_px=_sigma(row, "sigma_px", MARKING_ERRORS.pixel),
        name=name,
    )


def _pixels(row: Table, key: str, count: int) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """(count, 2) pixels; of one the key holds the pixel itself."""
    rows = [row.numbers(key, 2)] if count == 1 else row.matrix(key, count, 2)
    out = np.array(rows, dtype=np.float64)
    if np.abs(out).max() > WIDEST_PX:
        raise row.wrong(key, f"expected pixels within {WIDEST_PX:g}")
    if count == 2 and (out[0] == out[1]).all():
        raise row.wrong(key, "its ends are one pixel")
    return out


def _sigma(row: Table, key: str, default: float) -> float:
    return row.number(key, default, low=SIGMA[0], high=SIGMA[1])


def _measured(table: Table, key: str, limits: tuple[float, float]) -> tuple[float, float] | None:
    """A value with its standard deviation, [value, sigma]."""
    if key not in table:
        return None
    value, sigma = table.numbers(key, 2)
    if not is_known(value, sigma, limits):
        raise table.wrong(key, f"expected [value, standard deviation] from {limits[0]:g} to {limits[1]:g}")
    return value, sigma


def _lens(table: Table, unknown: list[str]) -> Mapping[str, tuple[float, float]]:
    """Raises UserError where it does not say a focal length."""
    focal = _measured(table, "focal_px", LENS["focal_px"])
    if focal is None:
        raise table.wrong("focal_px", "missing: expected [value, standard deviation] in pixels")
    k1 = _measured(table, "k1", LENS["k1"])
    unknown += table.unread
    return {"focal_px": focal, **({"k1": k1} if k1 else {})}


def _size(table: Table) -> tuple[int, int] | None:
    if "size" not in table:
        return None
    width, height = table.numbers("size", 2)
    if not (min(width, height) >= 16 and max(width, height) <= _LARGEST_PX) or width % 1 or height % 1:
        raise table.wrong("size", f"expected width and height, 16 to {_LARGEST_PX} whole pixels")
    return int(width), int(height)


def _time(table: Table, key: str) -> datetime | None:
    value = table.value(key)
    if value is not None and (not isinstance(value, datetime) or value.tzinfo is None):
        raise table.wrong(key, "expected a time with its zone, like 2026-06-21T14:30:00+02:00")
    return value


def _vehicles(table: Table) -> Belief | None:
    """The camera that `skope eval camera` has found from vehicles, which says nothing of place and direction."""
    path = table.file("vehicles")
    if path is None:
        return None
    known = read_uncertain_camera(path)
    if known is None or set(known.parameters) & {"x", "y", "yaw"}:
        raise table.wrong("vehicles", f"{path}: expected a camera file that `skope eval camera` made from vehicles")
    return known.belief("vehicles")
