"""`skope eval pose`: the pose of every vehicle in every image, written as it comes, so that a stopped run goes on."""

import itertools
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

from skope.files.json_files import write_json
from skope.files.progress import Progress
from skope.pose.camera_error import with_camera_error
from skope.pose.keypoint_views import Scene
from skope.pose.pose_errors import measure_poses, pose_summary, pose_table
from skope.pose.pose_records import INTERPOLATED, Located, locate_view, records, write_poses
from skope.terminal.console import Console

_PROGRESS_FILE: Final = ".vehicles.jsonl"


@dataclass(frozen=True, kw_only=True)
class PoseJob:
    """Vehicles whose poses to work out, and where to write them."""

    scene: Scene
    out: Path
    score: float
    """Detections above this are taken."""
    sigma_px: float | None
    """Standard deviation of a keypoint, pixels; None as in `Scene.views`."""
    noise: Sequence[float]
    """Standard deviations of the noise that is added to labelled keypoints, pixels: poses have the first of them,
    errors are measured with each."""


def locate_footage(job: PoseJob, console: Console) -> Iterator[str]:
    """Work out the poses and write them under `job.out`; yields lines that say what was written and found."""
    scene = job.scene
    progress = Progress(job.out / _PROGRESS_FILE, ("rows",))
    if progress.count:
        console.say(f"{scene.file.name}: going on after the poses of {progress.count} images")
    with console.bar(total=len(scene.file.images), unit="image", label="poses") as bar:
        bar.update(progress.count)
        views = scene.views(score=job.score, sigma_px=job.sigma_px, noise=job.noise[0])
        for view in itertools.islice(views, progress.count, None):
            progress.add({"rows": list(records(_with_camera_error(locate_view(view, scene), scene)))})
            bar.update()
    reasons = Counter[str | None]()

    def rows() -> Iterator[dict[str, Any]]:
        return itertools.chain.from_iterable(row["rows"] for row in progress.rows())

    reasons.update(row["refused"] for row in rows())
    for path in write_poses(job.out, rows):
        yield f"wrote {path}"
    between = reasons.pop(INTERPOLATED, 0)
    found = reasons.total()
    besides = f"; {between} more were followed between key frames and have none" if between else ""
    yield f"{reasons[None]} poses of {found} vehicles; {found - reasons[None]} refused{besides}"
    if scene.has_truth:
        yield from _errors(job)
    progress.end()


def _with_camera_error(located: Located, scene: Scene) -> Located:
    image = located.view.image
    return replace(located, poses=with_camera_error(located.poses, scene.known_in(image), scene.road_in(image)))


def _errors(job: PoseJob) -> Iterator[str]:
    """Write how far off the poses are where the truth is known."""
    summaries = {}
    for level in job.noise if job.scene.results is None else (0.0,):
        name = f"labels with {level:g} px of noise" if job.scene.results is None else "predictions"
        summaries[name] = pose_summary(measure_poses(job.scene, noise=level, score=job.score, sigma_px=job.sigma_px))
        yield from pose_table(f"{name}: median (90%, 99%)", summaries[name])
    write_json(job.out / "pose_errors.json", summaries)
    yield f"wrote {job.out / 'pose_errors.json'}"
