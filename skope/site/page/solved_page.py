"""Answer of the server to a document of the page: the camera from its marks, the errors, drawings and advice."""

import json
import math
import threading
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Final

import numpy as np

from skope.camera.calibrate import LeftOutError, SiteCalibration, calibrate, left_out_errors
from skope.camera.evidence import CameraPrior, Evidence
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.camera.pose_from_points import POINT_FIT
from skope.camera.uncertain_camera import UncertainCamera
from skope.dataset.camera_of_file import sized
from skope.errors import UserError
from skope.site.mark_parser import KNOWN_RANGES, MARK_KINDS, Problem, positions
from skope.site.page.drawings import Drawing, read_drawings, shapes
from skope.site.page.marks import Marks, entries_of, marks_of_document, read_time
from skope.site.page.overlays import overlays
from skope.types import Array

FIRST_ADVICE: Final = (
    "Mark at least four points with known positions, or a known length and lines that are parallel on the road. "
    "Gates in the image need no calibration; everything in metres does."
)
MIRRORED_ADVICE: Final = (
    "These positions are mirrored: the camera would be below the road. The axes must be right-handed, for example x "
    "east and y north. Check whether x and y are swapped (common in survey data), or y points down in your plan."
)
DEGREES_ADVICE: Final = (
    "These positions look like latitude and longitude: degrees, not metres. Choose which comes first, and they are "
    "converted to metres around a point between them."
)
NUMBER_WORDS: Final = ("no", "one", "two", "three", "four")


@dataclass(frozen=True)
class SolvedPageRules:
    """Limits for reporting a solved camera."""

    no_metres: float = 0.2
    """Difference below which positions are not metres of a road."""
    cells: int = 80
    """Number of cells across the image."""
    farthest_m: float = 250.0
    """Maximum distance of reported positions, metres."""
    doubtful_sigmas: float = 3.0
    """Minimum residual of a highlighted mark, in standard deviations."""


SOLVED_PAGE: Final = SolvedPageRules()


def missing(document: Mapping[str, Any], marks: Marks) -> str:
    """Return advice on what to mark or type before points give a camera; empty if no points are missing."""
    evidence = marks.evidence
    # Three points have as many coordinates as a pose. A fourth is needed if the lens is unknown.
    needed = (
        POINT_FIT.fewest_points - 1
        if any("focal" in prior.of for prior in evidence.priors)
        else POINT_FIT.fewest_points
    )
    if evidence.lengths or evidence.parallels or len(evidence.points) >= needed:
        return ""
    marked = entries_of(document, "points")
    if not marked:
        return FIRST_ADVICE
    good = len(evidence.points)
    unplaced = [i for i in range(len(marked)) if i not in marks.entries["points"].values()]
    words = f"{good} of {needed} points have positions. "
    if unplaced:
        name = marked[unplaced[0]].get("name") or unplaced[0] + 1
        words += f"Type x and y of point {name} in metres"
    left = needed - good - len(unplaced)
    if left > 0:
        words += (", then mark " if unplaced else "Mark ") + f"{NUMBER_WORDS[left]} more"
        words += ", spread over the road: near and far, left and right"
    return words + "."


def in_degrees(evidence: Evidence) -> bool:
    """Return whether positions look like degrees: as metres, all would be within a hand's breadth."""
    if len(evidence.points) < 2:
        return False
    places: Array = np.array([point.place[:2] for point in evidence.points])
    return bool(
        np.ptp(places, axis=0).max() < SOLVED_PAGE.no_metres and 0 < np.abs(places).max() <= 180 and np.any(places % 1)
    )


def implausible(camera: Camera) -> str:
    """Return a sentence on a camera that is implausible for a road, as contradictory marks give it; else empty."""
    fov_deg = 2 * math.degrees(math.atan(camera.width / 2 / float(camera.K[0, 0])))
    height_m = float(camera.position[2])
    if fov_deg >= KNOWN_RANGES["fov_deg"][0] and height_m >= KNOWN_RANGES["height_m"][0]:
        return ""
    return (
        f"The marks give a camera {height_m:.1f} m over the road with a field of view of {fov_deg:.1f} degrees, which "
        "is not plausible. Check that the lines are parallel on the road, and the lengths; or mark points."
    )


def below_road(evidence: Evidence, camera: Camera) -> bool:
    """Return whether a camera is below all its points. This happens if the coordinates are mirrored."""
    heights = [point.place[2] for point in evidence.points]
    return bool(heights) and float(camera.position[2]) < min(heights)


def error_map(known: UncertainCamera) -> dict[str, Any]:
    """Return the position errors over the image: square cells of `cell` pixels, row by row from the top.

    Errors are in metres; None for a cell without road.
    """
    camera = known.camera
    cell = max(4, -(-camera.width // SOLVED_PAGE.cells))
    columns, rows = -(-camera.width // cell), -(-camera.height // cell)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * cell, (np.arange(rows) + 0.5) * cell)
    pixels = np.stack([x, y], axis=-1)
    away = np.linalg.norm(known.places(pixels) - camera.position, axis=-1)
    errors = np.where(away < SOLVED_PAGE.farthest_m, known.place_error(pixels), np.nan)
    return {"cell": cell, "columns": columns, "rows": rows, "values": values(errors.ravel())}


def values(errors: Array) -> list[float | None]:
    """Return numbers as JSON values: three digits, None for NaN."""
    return [float(f"{value:.3g}") if np.isfinite(value) else None for value in errors.tolist()]


MARK_WORDS: Final = {"points": "point", "lengths": "length", "parallels": "parallel lines", "verticals": "vertical"}
RESIDUAL_UNITS: Final = {"points": "px", "lengths": "m", "parallels": "deg", "verticals": "px"}


@dataclass(frozen=True, eq=False)
class SolvedCamera:
    """Camera that was solved from the marks of a document, or given in it."""

    camera: Camera | None
    known: UncertainCamera | None
    """The camera with its covariance; None if the uncertainty is unknown."""
    message: str
    """Reason why there is no camera, or why it is not from the marks; empty if it is."""
    mend: str = ""
    """Fault that the page offers to correct: "degrees" or "mirrored" positions; empty: none."""
    left_out: Mapping[str, LeftOutError] = field(default_factory=dict)
    """Leave-one-out error of each point, by name."""

    @property
    def calibration(self) -> SiteCalibration | None:
        """Calibration from the marks; None for a given camera."""
        return self.known if isinstance(self.known, SiteCalibration) else None


class SolvedPage:
    """Answers to documents; the camera is solved again only if its marks have changed."""

    def __init__(self, size: tuple[int, int], vehicles: CameraPrior | None = None) -> None:
        """`vehicles` is the prior of the camera from vehicles."""
        self.size, self._vehicles = size, vehicles
        self._lock = threading.Lock()
        self._last: tuple[str, SolvedCamera] | None = None

    def solve(self, document: Mapping[str, Any]) -> tuple[SolvedCamera, Marks]:
        """Return the camera of a document, and its marks."""
        marks = marks_of_document(document, self.size)
        key = json.dumps([document.get(kind) for kind in (*MARK_KINDS, "camera", "known")], sort_keys=True)
        with self._lock:
            if self._last is None or self._last[0] != key:
                self._last = (
                    key,
                    self._solved(
                        marks, given_camera(document, self.size), "" if self._vehicles else missing(document, marks)
                    ),
                )
            return self._last[1], marks

    def _solved(self, marks: Marks, given: "GivenCamera | None", lacking: str) -> SolvedCamera:
        evidence = marks.evidence
        fallback = SolvedCamera(given.camera, given.known, "") if given else SolvedCamera(None, None, "")
        if not any(getattr(evidence, kind) for kind in MARK_KINDS):
            return replace(fallback, message="" if fallback.camera else lacking or FIRST_ADVICE)
        if in_degrees(evidence):
            return replace(fallback, message=DEGREES_ADVICE, mend="degrees")
        if lacking:
            return replace(fallback, message=lacking)
        vehicles = (self._vehicles,) if self._vehicles else ()
        evidence = replace(evidence, priors=(*evidence.priors, *vehicles))
        try:
            found = calibrate(evidence)
        except UserError as error:
            return replace(fallback, message=str(error).removeprefix("calibration: "))
        except (np.linalg.LinAlgError, FloatingPointError):
            return replace(fallback, message="no camera agrees with the marks")
        if below_road(evidence, found.camera):
            return replace(fallback, message=MIRRORED_ADVICE, mend="mirrored")
        if words := implausible(found.camera):
            return replace(fallback, message=words)
        return SolvedCamera(found.camera, found, "", left_out=left_out_errors(evidence, found))

    def look(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """Return everything that the page shows of a document."""
        solved, marks = self.solve(document)
        drawings, problems = read_drawings(document, self.size)
        out: dict[str, Any] = {
            "problems": [asdict(problem) for problem in (*marks.problems, *problems, *read_time(document).problems)],
            "message": solved.message,
            "mend": solved.mend,
            "camera": None,
            "residuals": [],
            "warnings": [],
            "drawn": None,
            "errors": None,
            "shapes": shapes(drawings, solved.camera, solved.known.place_error if solved.known else None),
        }
        if solved.camera is None:
            return out
        out["camera"] = _figures(solved)
        out["drawn"] = overlays(solved.camera, _toward(drawings))
        if solved.known is not None:
            out["errors"] = error_map(solved.known)
        if solved.calibration is not None:
            out["residuals"] = _residuals(solved.calibration, marks, solved.left_out)
            out["warnings"] = list(solved.calibration.warnings)
        return out

    def places(self, document: Mapping[str, Any], pixels: Any) -> dict[str, Any]:
        """Return positions of pixels (N, 2) on the road: rows [x, y] in metres or None, and their errors in metres."""
        rows = positions(pixels, 2)
        if rows is None:
            raise UserError("pixels: expected rows of two numbers")
        solved, _ = self.solve(document)
        if solved.camera is None:
            raise UserError("the camera is not calibrated yet: " + solved.message)
        at = np.asarray(rows).reshape(-1, 2)
        places = intersect_ground(solved.camera, at)
        errors = solved.known.place_error(at) if solved.known else None
        return {
            "places": [[round(float(v), 3) for v in p[:2]] if np.isfinite(p).all() else None for p in places],
            "errors": values(errors) if errors is not None else [None] * len(rows),
        }


@dataclass(frozen=True, eq=False)
class GivenCamera:
    """Camera that the page received from a file."""

    camera: Camera
    known: UncertainCamera | None


def given_camera(document: Mapping[str, Any], size: tuple[int, int]) -> GivenCamera | None:
    """Return the camera that a document contains, at the footage's size. Raises UserError if it is invalid."""
    value = document.get("camera")
    if value is None:
        return None
    if not isinstance(value, dict):
        raise UserError("camera: expected an object")
    camera = Camera.from_dict(value, int(value.get("width", size[0])), int(value.get("height", size[1])))
    camera = sized(camera, size, "the footage")
    return GivenCamera(camera, _known(camera, value.get("covariance")))


def _known(camera: Camera, value: Any) -> UncertainCamera | None:
    """Return the camera with its covariance; None if there is none."""
    return UncertainCamera.from_dict(camera, value) if isinstance(value, dict) else None


def _figures(solved: SolvedCamera) -> dict[str, Any]:
    """Return the camera's parameters for users, with standard deviations if known."""
    assert solved.camera is not None
    camera = solved.camera
    yaw, pitch, roll = camera.angles
    focal = float(camera.K[0, 0])
    rows = {
        "focal": ("focal length", focal, focal, "px"),
        "z": ("height", float(camera.position[2]), 1.0, "m"),
        "pitch": ("tilt down", math.degrees(pitch), 180 / math.pi, "°"),
        "roll": ("roll", math.degrees(roll), 180 / math.pi, "°"),
        "yaw": ("looks towards (from east, to the left)", math.degrees(yaw), 180 / math.pi, "°"),
        "x": ("x", float(camera.position[0]), 1.0, "m"),
        "y": ("y", float(camera.position[1]), 1.0, "m"),
    }
    k1 = camera.distortion.coefficients[0] if camera.distortion.model == "brown" else None
    if k1 is not None:
        rows["k1"] = ("lens distortion k1", k1, 1.0, "")
    sigmas = _sigmas(solved.known)
    return {
        "from_marks": solved.calibration is not None,
        "figures": [
            {
                "name": words,
                "value": round(value, 4),
                "sigma": round(sigmas[name] * scale, 4) if name in sigmas else None,
                "unit": unit,
            }
            for name, (words, value, scale, unit) in rows.items()
        ],
    }


def _sigmas(known: UncertainCamera | None) -> dict[str, float]:
    if known is None:
        return {}
    return dict(zip(known.parameters, np.sqrt(np.diag(known.covariance)).tolist(), strict=True))


def _residuals(calibration: SiteCalibration, marks: Marks, without: Mapping[str, LeftOutError]) -> list[dict[str, Any]]:
    """Return the residual of each mark, in the order of the document's lists; left-out points too.

    `by_others` of a point is [leave-one-out error, its 90% bound], metres; None if not available.
    """
    out = []
    residuals = {(residual.kind, residual.name): residual for residual in calibration.residuals}
    for kind in MARK_KINDS:
        for record in getattr(marks.evidence, kind):
            left_out = kind == "points" and record.name in calibration.outliers
            residual = residuals.get((MARK_WORDS[kind], record.name))
            value = residual.value if residual else None
            if residual is None and kind == "points":
                off = np.linalg.norm(calibration.camera.project(record.place)[0] - record.pixel)
                value = float(off) if np.isfinite(off) else None
            out.append(
                {
                    "kind": kind,
                    "index": marks.entries[kind][record.name],
                    "value": None if value is None else round(value, 3),
                    "unit": RESIDUAL_UNITS[kind],
                    "left_out": left_out,
                    "wrong": left_out or (residual is not None and residual.sigmas > SOLVED_PAGE.doubtful_sigmas),
                    "at": _expected(calibration.camera, record.place) if kind == "points" else None,
                    "by_others": _leave_one_out(without.get(record.name)) if kind == "points" else None,
                }
            )
    return out


def _leave_one_out(error: LeftOutError | None) -> list[float] | None:
    numbers = [] if error is None else values(np.array([error.error_m, error.stated_m]))
    return [value for value in numbers if value is not None] if numbers and None not in numbers else None


def _expected(camera: Camera, position: Array) -> list[float] | None:
    """Return the pixel at which a camera sees a position."""
    pixel, _, valid = camera.project(position)
    return [round(float(v), 2) for v in pixel] if valid else None


def _toward(drawings: list[Drawing]) -> Array | None:
    """Return the direction of the first lane. The example cars on the page are parallel to it."""
    lane = next((drawing for drawing in drawings if drawing.kind == "lanes"), None)
    return None if lane is None else lane.positions[-1] - lane.positions[0]


def unfinished(problems: list[Problem]) -> str:
    """Return a sentence on what keeps a document from being saved; empty if nothing does."""
    if not problems:
        return ""
    first = problems[0]
    rest = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{first.kind} {first.index + 1}: {first.field}: {first.text}{rest}"
