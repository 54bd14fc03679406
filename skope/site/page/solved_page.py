"""The server's answer to a document of the page: the camera that its marks give, the errors, drawings and advice."""

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
    "Mark at least four points whose positions you know, or a known length and lines that are parallel on the road. "
    "Gates in the image need no calibration; everything in metres does."
)
MIRRORED_ADVICE: Final = (
    "These places are mirrored: the camera would hang below the road. Looking along x, y has to grow to the left, as "
    "with x east and y north. Are x and y swapped (surveyors often count x to the north), or does y of your plan grow "
    "downwards?"
)
DEGREES_ADVICE: Final = (
    "These places look like latitude and longitude: degrees, not metres. Say which comes first, and they are taken as "
    "metres around a point between them."
)
NUMBER_WORDS: Final = ("no", "one", "two", "three", "four")


@dataclass(frozen=True)
class SolvedPageRules:
    """What the page reports of a solved camera."""

    no_metres: float = 0.2
    """Positions that differ by less are not metres of a road."""
    cells: int = 80
    """Cells across the image."""
    farthest_m: float = 250.0
    """Distance up to which positions are reported, metres."""
    doubtful_sigmas: float = 3.0
    """Residual from which a mark is highlighted, in standard deviations."""


SOLVED_PAGE: Final = SolvedPageRules()


def missing(document: Mapping[str, Any], marks: Marks) -> str:
    """Advice on what to mark or type before points can tell a camera; empty where points are not what is missing."""
    evidence = marks.evidence
    # Three points have as many coordinates as a pose; a fourth is needed where the lens is not known.
    needed = (
        POINT_FIT.fewest_points - 1
        if any("focal" in belief.of for belief in evidence.beliefs)
        else POINT_FIT.fewest_points
    )
    if evidence.lengths or evidence.parallels or len(evidence.points) >= needed:
        return ""
    marked = entries_of(document, "points")
    if not marked:
        return FIRST_ADVICE
    good = len(evidence.points)
    unplaced = [i for i in range(len(marked)) if i not in marks.entries["points"].values()]
    words = f"{good} of {needed} points have their places. "
    if unplaced:
        name = marked[unplaced[0]].get("name") or unplaced[0] + 1
        words += f"Type x and y of point {name} in metres"
    left = needed - good - len(unplaced)
    if left > 0:
        words += (", then mark " if unplaced else "Mark ") + f"{NUMBER_WORDS[left]} more"
        words += ", spread over the road: near and far, left and right"
    return words + "."


def in_degrees(evidence: Evidence) -> bool:
    """Whether places look like degrees on the Earth: none of them a hand's breadth from the others as metres."""
    if len(evidence.points) < 2:
        return False
    places: Array = np.array([point.place[:2] for point in evidence.points])
    return bool(
        np.ptp(places, axis=0).max() < SOLVED_PAGE.no_metres and 0 < np.abs(places).max() <= 180 and np.any(places % 1)
    )


def implausible(camera: Camera) -> str:
    """Sentence on a camera that no road camera is, as marks give it that contradict each other; empty for any other."""
    fov_deg = 2 * math.degrees(math.atan(camera.width / 2 / float(camera.K[0, 0])))
    height_m = float(camera.position[2])
    if fov_deg >= KNOWN_RANGES["fov_deg"][0] and height_m >= KNOWN_RANGES["height_m"][0]:
        return ""
    return (
        f"The marks give a camera {height_m:.1f} m over the road with a field of view of {fov_deg:.1f} degrees, which "
        "is not plausible. Check that the lines are parallel on the road, and the lengths; or mark points."
    )


def below_road(evidence: Evidence, camera: Camera) -> bool:
    """Whether a camera hangs below the points that it was found by, as a mirrored plan has it."""
    heights = [point.place[2] for point in evidence.points]
    return bool(heights) and float(camera.position[2]) < min(heights)


def error_map(known: UncertainCamera) -> dict[str, Any]:
    """Square cells of `cell` pixels, row by row from the top: errors in their middles, metres; None: no road there."""
    camera = known.camera
    cell = max(4, -(-camera.width // SOLVED_PAGE.cells))
    columns, rows = -(-camera.width // cell), -(-camera.height // cell)
    x, y = np.meshgrid((np.arange(columns) + 0.5) * cell, (np.arange(rows) + 0.5) * cell)
    pixels = np.stack([x, y], axis=-1)
    away = np.linalg.norm(known.places(pixels) - camera.position, axis=-1)
    errors = np.where(away < SOLVED_PAGE.farthest_m, known.place_error(pixels), np.nan)
    return {"cell": cell, "columns": columns, "rows": rows, "values": values(errors.ravel())}


def values(errors: Array) -> list[float | None]:
    """Numbers as JSON has them: three digits, None for NaN."""
    return [float(f"{value:.3g}") if np.isfinite(value) else None for value in errors.tolist()]


MARK_WORDS: Final = {"points": "point", "lengths": "length", "parallels": "parallel lines", "verticals": "vertical"}
RESIDUAL_UNITS: Final = {"points": "px", "lengths": "m", "parallels": "deg", "verticals": "px"}


@dataclass(frozen=True, eq=False)
class SolvedCamera:
    """The camera of a document."""

    camera: Camera | None
    known: UncertainCamera | None
    """The camera with its covariance; None where nothing says how well it is known."""
    message: str
    """Reason why there is no camera, or why it is not that of the marks; empty where it is."""
    mend: str = ""
    """Faults that the page may offer to mend by itself: "degrees" or "mirrored" places; empty: none."""
    left_out: Mapping[str, LeftOutError] = field(default_factory=dict)
    """Error of each point, left out once and placed by the others, by its name."""

    @property
    def calibration(self) -> SiteCalibration | None:
        """The camera that the marks told; None where it is a given one."""
        return self.known if isinstance(self.known, SiteCalibration) else None


class SolvedPage:
    """Answers to documents, whose camera is solved again only where its marks have changed."""

    def __init__(self, size: tuple[int, int], vehicles: CameraPrior | None = None) -> None:
        """`vehicles` is what vehicles say of the camera."""
        self.size, self._vehicles = size, vehicles
        self._lock = threading.Lock()
        self._last: tuple[str, SolvedCamera] | None = None

    def solve(self, document: Mapping[str, Any]) -> tuple[SolvedCamera, Marks]:
        """The camera of a document, and its marks."""
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
        evidence = replace(evidence, beliefs=(*evidence.beliefs, *vehicles))
        try:
            found = calibrate(evidence)
        except UserError as error:
            return replace(fallback, message=str(error).removeprefix("calibration: "))
        except (np.linalg.LinAlgError, FloatingPointError):
            return replace(fallback, message="no camera agrees with what is marked")
        if below_road(evidence, found.camera):
            return replace(fallback, message=MIRRORED_ADVICE, mend="mirrored")
        if words := implausible(found.camera):
            return replace(fallback, message=words)
        return SolvedCamera(found.camera, found, "", left_out=left_out_errors(evidence, found))

    def look(self, document: Mapping[str, Any]) -> dict[str, Any]:
        """All that the page shows of a document."""
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
        """Places of pixels (N, 2) on the road: rows [x, y] in metres or None, and the error of each in metres."""
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
    """A camera that a file says."""

    camera: Camera
    known: UncertainCamera | None


def given_camera(document: Mapping[str, Any], size: tuple[int, int]) -> GivenCamera | None:
    """The camera that came with a document, at the footage's size; a UserError where it is none."""
    value = document.get("camera")
    if value is None:
        return None
    if not isinstance(value, dict):
        raise UserError("camera: expected an object")
    camera = Camera.from_dict(value, int(value.get("width", size[0])), int(value.get("height", size[1])))
    camera = sized(camera, size, "the footage")
    return GivenCamera(camera, _known(camera, value.get("covariance")))


def _known(camera: Camera, value: Any) -> UncertainCamera | None:
    """The camera with the covariance that came with it; None where none did."""
    return UncertainCamera.from_dict(camera, value) if isinstance(value, dict) else None


def _figures(solved: SolvedCamera) -> dict[str, Any]:
    """The camera in numbers that people know, with standard deviations where they are known."""
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
    """Distance of each mark from the camera, in the order of the document's lists; left-out points too.

    `by_others` of a point is [how far from its place the others put it, within what that lies in 90% of the cases],
    metres; None where they do not say it.
    """
    out = []
    told = {(one.kind, one.name): one for one in calibration.residuals}
    for kind in MARK_KINDS:
        for record in getattr(marks.evidence, kind):
            left_out = kind == "points" and record.name in calibration.outliers
            one = told.get((MARK_WORDS[kind], record.name))
            value = one.value if one else None
            if one is None and kind == "points":
                off = np.linalg.norm(calibration.camera.project(record.place)[0] - record.pixel)
                value = float(off) if np.isfinite(off) else None
            out.append(
                {
                    "kind": kind,
                    "index": marks.entries[kind][record.name],
                    "value": None if value is None else round(value, 3),
                    "unit": RESIDUAL_UNITS[kind],
                    "left_out": left_out,
                    "wrong": left_out or (one is not None and one.sigmas > SOLVED_PAGE.doubtful_sigmas),
                    "at": _expected(calibration.camera, record.place) if kind == "points" else None,
                    "by_others": _by_others(without.get(record.name)) if kind == "points" else None,
                }
            )
    return out


def _by_others(error: LeftOutError | None) -> list[float] | None:
    told = [] if error is None else values(np.array([error.error_m, error.stated_m]))
    return [value for value in told if value is not None] if told and None not in told else None


def _expected(camera: Camera, place: Array) -> list[float] | None:
    """The pixel at which a camera sees a place."""
    pixel, _, valid = camera.project(place)
    return [round(float(v), 2) for v in pixel] if valid else None


def _toward(drawings: list[Drawing]) -> Array | None:
    """The direction of the first lane, along which boxes stand."""
    lane = next((one for one in drawings if one.kind == "lanes"), None)
    return None if lane is None else lane.positions[-1] - lane.positions[0]


def unfinished(problems: list[Problem]) -> str:
    """Sentence on what keeps a document from being saved; empty where nothing does."""
    if not problems:
        return ""
    first = problems[0]
    rest = f" (and {len(problems) - 1} more)" if len(problems) > 1 else ""
    return f"{first.kind} {first.index + 1}: {first.field}: {first.text}{rest}"
