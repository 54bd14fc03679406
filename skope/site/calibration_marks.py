"""The [calibration] table of a site file: marks that calibrate the camera."""

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from skope.camera.calibration_files import read_uncertain_camera
from skope.camera.evidence import CameraPrior, Evidence, MarkedLength, MarkedPoint, ParallelLines, Vertical
from skope.errors import UserError
from skope.records import TomlTable
from skope.site.gates_zones_lanes import checked_name
from skope.site.mark_parser import KNOWN_RANGES, LENS_RANGES, known_value, read_mark

_LARGEST_PX: Final = 8192


@dataclass(frozen=True, kw_only=True, eq=False)
class CalibrationMarks:
    """Marks and prior knowledge for calibrating a camera, in pixels of the footage."""

    size: tuple[int, int] | None
    """Width and height of the marked images, pixels; None: not in the file."""
    when: datetime | None
    """Time of the marking; None: not in the file."""
    points: tuple[MarkedPoint, ...] = ()
    lengths: tuple[MarkedLength, ...] = ()
    parallels: tuple[ParallelLines, ...] = ()
    verticals: tuple[Vertical, ...] = ()
    fov_deg: tuple[float, float] | None = None
    """Horizontal field of view and its standard deviation, degrees."""
    lens: Mapping[str, tuple[float, float]] | None = None
    """Calibration of the lens: `focal_px`, and `k1` if known, each with its standard deviation."""
    height_m: tuple[float, float] | None = None
    """The camera's height over the road and its standard deviation, metres."""
    vehicles: CameraPrior | None = None
    """Prior of the camera from its vehicles."""

    def evidence(self, size: tuple[int, int] | None = None) -> Evidence:
        """Return the evidence for images of `size`. None: the size of the images in which the marks were set.

        Raises UserError if neither gives a size, or they contradict each other.
        """
        if size and self.size and size != self.size:
            raise UserError(
                f"calibration.size: marks are in {self.size[0]}x{self.size[1]}, but the images are {size[0]}x{size[1]}"
            )
        whole = size or self.size
        if whole is None:
            raise UserError("calibration.size: missing: expected [width, height] of the images that were marked")
        known = priors_of(whole[0], fov_deg=self.fov_deg, lens=self.lens, height_m=self.height_m)
        priors = (self.vehicles, *known) if self.vehicles else known
        return Evidence(whole, self.points, self.lengths, self.parallels, self.verticals, priors)


def priors_of(
    width: int,
    *,
    fov_deg: tuple[float, float] | None = None,
    lens: Mapping[str, tuple[float, float]] | None = None,
    height_m: tuple[float, float] | None = None,
) -> tuple[CameraPrior, ...]:
    """Return prior knowledge of a camera as evidence for its calibration.

    Args:
        width: Width of the images, pixels.
        fov_deg: Horizontal field of view and its standard deviation, degrees; None: not known.
        lens: `focal_px` and, if known, `k1`, each with its standard deviation; None: not known.
        height_m: Height over the road and its standard deviation, metres; None: not known.
    """
    out = []
    if fov_deg:
        out.append(CameraPrior.of_fov(*fov_deg, width))
    if lens:
        out.append(CameraPrior.of_lens(*lens["focal_px"], lens.get("k1")))
    if height_m:
        out.append(CameraPrior.of_height(*height_m))
    return tuple(out)


def read_marks(table: TomlTable, unknown: list[str]) -> CalibrationMarks:
    """Read the marks of a [calibration] table; unknown keys are added to `unknown`.

    Raises:
        UserError: A key is missing or invalid; the message names file and key.
    """
    made = CalibrationMarks(
        size=_size(table),
        when=_time(table, "when"),
        points=_rows(table, "points", unknown),
        lengths=_rows(table, "lengths", unknown),
        parallels=_rows(table, "parallels", unknown),
        verticals=_rows(table, "verticals", unknown),
        fov_deg=_measured(table, "fov_deg", KNOWN_RANGES["fov_deg"]),
        lens=_lens(table.table("lens"), unknown) if "lens" in table else None,
        height_m=_measured(table, "height_m", KNOWN_RANGES["height_m"]),
        vehicles=_vehicles(table),
    )
    unknown += table.unread
    return made


def _rows(table: TomlTable, kind: str, unknown: list[str]) -> tuple[Any, ...]:
    out, names = [], set[str]()
    for index, row in enumerate(table.rows(kind)):
        name = checked_name(row, "name", row.text("name")) if "name" in row else str(index + 1)
        if name in names:
            raise row.wrong("name", f"{name!r} is the name of two {kind}")
        names.add(name)
        for key, value in row.values.items():
            if value == "":  # an empty field on the page means its default
                raise row.wrong(key, "expected a value, got an empty text")
        mark, problems = read_mark(kind, index, name, row.value)
        for problem in problems:
            key = problem.field.partition(".")[0]
            if key and key not in row:
                raise row.wrong(key, "missing")
            raise row.wrong(problem.field, f"incomplete: {problem.text}" if problem.missing else problem.text)
        out.append(mark)
        unknown += row.unread
    return tuple(out)


def _measured(table: TomlTable, key: str, limits: tuple[float, float]) -> tuple[float, float] | None:
    """Return a value with its standard deviation, [value, sigma]; None if the key is missing."""
    if key not in table:
        return None
    found = known_value(table.value(key), limits)
    if found is None:
        raise table.wrong(key, f"expected 2 numbers, value and standard deviation, from {limits[0]:g} to {limits[1]:g}")
    return found


def _lens(table: TomlTable, unknown: list[str]) -> Mapping[str, tuple[float, float]]:
    """Return the lens. Raises UserError if it has no focal length."""
    focal = _measured(table, "focal_px", LENS_RANGES["focal_px"])
    if focal is None:
        raise table.wrong("focal_px", "missing: expected [value, standard deviation] in pixels")
    k1 = _measured(table, "k1", LENS_RANGES["k1"])
    unknown += table.unread
    return {"focal_px": focal, **({"k1": k1} if k1 else {})}


def _size(table: TomlTable) -> tuple[int, int] | None:
    if "size" not in table:
        return None
    width, height = table.numbers("size", 2)
    if not (min(width, height) >= 16 and max(width, height) <= _LARGEST_PX) or width % 1 or height % 1:
        raise table.wrong("size", f"expected width and height, 16 to {_LARGEST_PX} whole pixels")
    return int(width), int(height)


def _time(table: TomlTable, key: str) -> datetime | None:
    value = table.value(key)
    if value is not None and (not isinstance(value, datetime) or value.tzinfo is None):
        raise table.wrong(key, "expected a time with its zone, like 2026-06-21T14:30:00+02:00")
    return value


def _vehicles(table: TomlTable) -> CameraPrior | None:
    """Return the prior from the vehicles' camera file of `skope eval camera`, without position and direction."""
    path = table.file("vehicles")
    if path is None:
        return None
    known = read_uncertain_camera(path)
    if known is None or set(known.parameters) & {"x", "y", "yaw"}:
        raise table.wrong("vehicles", f"{path}: expected a camera file that `skope eval camera` made from vehicles")
    return known.prior("vehicles")
