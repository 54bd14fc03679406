"""`skope eval pose`: estimate and write the poses of all vehicles image by image, so that an interrupted run resumes.

On generated data it also measures errors against the truth: position, heading, dimensions and overlap, by distance and
occlusion.
"""

import itertools
import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray

from skope.files.json_files import write_json
from skope.files.progress import Progress
from skope.metrics.thresholds import KEPT_SCORE
from skope.pose.camera_error import with_camera_error
from skope.pose.keypoint_views import Scene
from skope.pose.pose_records import INTERPOLATED_REASON, Located, locate_views, records, write_poses
from skope.schema import Annotation, Box3D
from skope.terminal.console import Console, text_table
from skope.types import Array


@dataclass(frozen=True)
class PoseErrorBands:
    """Bands for reporting errors of poses."""

    distances_m: tuple[tuple[float, float], ...] = (
        (0.0, 10.0),
        (10.0, 20.0),
        (20.0, 30.0),
        (30.0, 40.0),
        (40.0, 60.0),
        (60.0, math.inf),
    )
    """Bands of the distance from the camera, metres."""
    occlusions: tuple[tuple[float, float], ...] = ((0.0, 0.1), (0.1, 0.4), (0.4, 1.01))
    """Bands of the hidden share of a vehicle."""
    bends_deg: tuple[tuple[float, float], ...] = ((0.0, 5.0), (5.0, 20.0), (20.0, math.inf))
    """Bands of the angle between an articulated vehicle and its trailer, degrees."""
    percentiles: tuple[int, int, int] = (50, 90, 99)
    """Percentiles of the errors."""


ERROR_BANDS: Final = PoseErrorBands()


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of the poses of N vehicles with a known true box, (N,) each; NaN for vehicles without a pose."""

    position: Array
    """Distance on the ground between the middles of the boxes, metres."""
    heading: Array
    """Error of the heading, degrees, mod 360."""
    axis: Array
    """Error of the heading, degrees, mod 180: front and rear may be exchanged."""
    size: Array
    """Largest error among length, width and height, metres."""
    iou: Array
    """Intersection over union of the 3D boxes, 0 to 1."""
    distance: Array
    """Distance of the true box from the camera, metres."""
    occlusion: Array
    """Share of the vehicle's silhouette that other objects hide, 0 to 1."""
    bend: Array
    """Absolute angle between an articulated vehicle and its trailer, degrees; NaN for others."""

    def where(self, mask: NDArray[np.bool_]) -> "PoseErrors":
        """Return the errors of the vehicles that `mask` (N,) selects."""
        return PoseErrors(*(getattr(self, f.name)[mask] for f in fields(self)))


def measure_poses(
    scene: Scene, *, noise: float = 0.0, score: float = KEPT_SCORE, sigma_px: float | None = None
) -> PoseErrors:
    """Measure the poses of a scene with ground truth.

    The poses are those of the scene's predictions that match a ground-truth vehicle with an IoU of 0.6. Without
    predictions, they come from the labelled keypoints.

    Args:
        scene: Images with ground truth, and perhaps predictions.
        noise: Standard deviation of the noise that is added to labelled keypoints, pixels.
        score: Minimum score of predictions.
        sigma_px: Standard deviation of a keypoint for the pose search, pixels; None as in `Scene.views`.
    """
    rows: list[tuple[float, ...]] = []
    for located in locate_views(scene.views(score=score, noise=noise, sigma_px=sigma_px), scene):
        rows += [
            _row(located, i, truth)
            for i, truth in enumerate(located.view.truth)
            if truth is not None and truth.box_3d is not None
        ]
    return PoseErrors(*np.array(rows, dtype=np.float64).reshape(-1, len(fields(PoseErrors))).T)


def _row(located: Located, i: int, truth: Annotation) -> tuple[float, ...]:
    box, poses = truth.box_3d, located.poses
    assert box is not None
    distance = float(np.linalg.norm(box.center - located.camera.position))
    bend = math.nan if truth.articulation is None else abs(math.degrees(truth.articulation))
    ends = (distance, truth.occlusion or 0.0, bend)
    if poses.refusal[i] is not None:
        return (*(math.nan,) * 5, *ends)
    size, T = poses.size_lwh[i], poses.T_world_vehicle[i]
    guess = Box3D(center=T[:3, 3] + T[:3, 2] * size[2] / 2, size_lwh=size, yaw=float(poses.yaw[i]), R=T[:3, :3])
    turn = math.degrees(abs((guess.yaw - box.yaw + math.pi) % (2 * math.pi) - math.pi))
    return (
        float(np.linalg.norm((guess.center - box.center)[:2])),
        turn,
        min(turn, 180 - turn),
        float(np.abs(size - box.size_lwh).max()),
        iou_3d(guess, box),
        *ends,
    )


def iou_3d(a: Box3D, b: Box3D) -> float:
    """Return the intersection over union of two upright boxes: area of the common outline times the common height."""
    shared = _outline(a).intersection(_outline(b)).area
    low = max(box.center[2] - box.size_lwh[2] / 2 for box in (a, b))
    high = min(box.center[2] + box.size_lwh[2] / 2 for box in (a, b))
    inner = shared * max(0.0, high - low)
    return float(inner / (a.size_lwh.prod() + b.size_lwh.prod() - inner))


def _outline(box: Box3D) -> Any:
    corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2 * box.size_lwh[:2]
    c, s = math.cos(box.yaw), math.sin(box.yaw)
    return shapely.Polygon(corners @ [[c, s], [-s, c]] + box.center[:2])


def pose_summary(errors: PoseErrors) -> dict[str, Any]:
    """Return counts and quantiles over all vehicles, by distance and by occlusion; null if there are none.

    Articulated vehicles are also listed by their bend. Their pose is that of the part in front of the hinge.
    """
    out: dict[str, Any] = {"all": _cell(errors)}
    groups = [
        ("distance", ERROR_BANDS.distances_m, errors.distance),
        ("occlusion", ERROR_BANDS.occlusions, errors.occlusion),
    ]
    if np.isfinite(errors.bend).any():
        groups.append(("articulation", ERROR_BANDS.bends_deg, errors.bend))
    for name, bands, values in groups:
        out[name] = {_band(low, high): _cell(errors.where((values >= low) & (values < high))) for low, high in bands}
    return out


def _band(low: float, high: float) -> str:
    return f"{low:g}+" if math.isinf(high) else f"{low:g}-{min(high, 1.0) if high < 2 else high:g}"


def _cell(errors: PoseErrors) -> dict[str, Any]:
    good = np.isfinite(errors.position)
    cell: dict[str, Any] = {"vehicles": len(good), "refused": int((~good).sum())}
    for name in ("position", "heading", "axis", "size"):
        values = getattr(errors, name)[good]
        cell[name] = {str(q): float(np.percentile(values, q)) for q in ERROR_BANDS.percentiles} if values.size else None
    cell["iou"] = float(np.median(errors.iou[good])) if good.any() else None
    return cell


def pose_table(title: str, summary: dict[str, Any]) -> list[str]:
    """Return lines of a table: medians, and 90th and 99th percentiles in brackets."""
    cells = {"all": summary["all"]}
    cells |= {f"{band} m": cell for band, cell in summary["distance"].items()}
    cells |= {f"hid {band}": cell for band, cell in summary["occlusion"].items()}
    cells |= {f"bent {band} deg": cell for band, cell in summary.get("articulation", {}).items()}
    head = ["", "vehicles", "refused", "position, m", "heading, deg", "mod 180", "size, m", "3D IoU"]
    return [title, *text_table(head, [[name, *_shown(cell)] for name, cell in cells.items() if cell["vehicles"]])]


def _shown(cell: dict[str, Any]) -> list[str]:
    counts = [str(cell["vehicles"]), str(cell["refused"])]
    if cell["position"] is None:
        return [*counts, *["-"] * 5]
    p, h = cell["position"], cell["heading"]
    return [
        *counts,
        f"{p['50']:.3f} ({p['90']:5.2f}, {p['99']:5.2f})",
        f"{h['50']:.2f} ({h['90']:4.1f}, {h['99']:5.1f})",
        *(f"{cell['axis']['50']:.2f}", f"{cell['size']['50']:.3f}", f"{cell['iou']:.3f}"),
    ]


_PROGRESS_FILE: Final = ".vehicles.jsonl"


@dataclass(frozen=True, kw_only=True)
class PoseJob:
    """Settings of a pose run and its output folder."""

    scene: Scene
    out: Path
    score: float
    """Minimum score of detections."""
    sigma_px: float | None
    """Standard deviation of a keypoint, pixels; None: the default of `Scene.views`."""
    noise: Sequence[float]
    """Standard deviations of the noise that is added to labelled keypoints, pixels. Poses use the first; errors are
    measured with each."""


def locate_footage(job: PoseJob, console: Console) -> Iterator[str]:
    """Estimate the poses, write them to `job.out`, and yield lines that report files and results."""
    scene = job.scene
    progress = Progress(job.out / _PROGRESS_FILE, ("rows",))
    if progress.count:
        console.say(f"{scene.file.name}: resuming after the poses of {progress.count} images")
    with console.bar(total=len(scene.file.images), unit="image", label="poses") as bar:
        bar.update(progress.count)
        views = scene.views(score=job.score, sigma_px=job.sigma_px, noise=job.noise[0])
        for located in locate_views(itertools.islice(views, progress.count, None), scene):
            progress.add({"rows": list(records(_with_camera_error(located, scene)))})
            bar.update()
    reasons = Counter[str | None]()

    def rows() -> Iterator[dict[str, Any]]:
        return itertools.chain.from_iterable(row["rows"] for row in progress.rows())

    reasons.update(row["refused"] for row in rows())
    for path in write_poses(job.out, rows):
        yield f"wrote {path}"
    between = reasons.pop(INTERPOLATED_REASON, 0)
    found = reasons.total()
    interpolated_text = f"; {between} more were followed between key frames and have none" if between else ""
    yield f"{reasons[None]} poses of {found} vehicles; {found - reasons[None]} rejected{interpolated_text}"
    if scene.has_truth:
        yield from _errors(job)
    progress.end()


def _with_camera_error(located: Located, scene: Scene) -> Located:
    image = located.view.image
    return replace(located, poses=with_camera_error(located.poses, scene.known_in(image), scene.road_in(image)))


def _errors(job: PoseJob) -> Iterator[str]:
    """Write the errors of the poses if the truth is known."""
    summaries = {}
    for level in job.noise if job.scene.results is None else (0.0,):
        name = f"labels with {level:g} px of noise" if job.scene.results is None else "predictions"
        summaries[name] = pose_summary(measure_poses(job.scene, noise=level, score=job.score, sigma_px=job.sigma_px))
        yield from pose_table(f"{name}: median (90%, 99%)", summaries[name])
    write_json(job.out / "pose_errors.json", summaries)
    yield f"wrote {job.out / 'pose_errors.json'}"
