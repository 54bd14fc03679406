"""`skope eval pose`: position, heading and size of vehicles."""

from collections import Counter
from typing import Annotated, Any

from skope.eval.cli.checks import numbers_of
from skope.eval.cli.options import counts
from skope.eval.cli.scene_options import OutOption, SceneOptions
from skope.terminal.command_options import LIST, POSES
from skope.terminal.console import Console


def pose(
    options: SceneOptions,
    console: Console,
    noise: Annotated[
        str,
        counts(metavar=LIST, help="Pixels of noise added to ground-truth keypoints; several: measure each."),
    ] = "0",
    out: OutOption = POSES,
) -> None:
    """Position, heading and size of each vehicle in metres; with a ground truth, also how far off they are."""
    from skope.eval.pose.pose_errors import measure, summary, table
    from skope.eval.pose.records import INTERPOLATED, locate_view, records, write_poses
    from skope.files.json_files import write_json

    levels, score, sigma = numbers_of("--noise", noise), options.score, options.sigma
    scene = options.scene(*levels, console=console)
    options.claim_output(out, "skope eval pose", noise=levels)
    rows: list[dict[str, Any]] = []
    with console.bar(total=len(scene.file.images), unit="image", label="poses") as bar:
        for view in scene.views(score=score, sigma_px=sigma, noise=levels[0]):
            rows += records(locate_view(view, scene))
            bar.update()
    for path in write_poses(out, rows):
        console.result(f"wrote {path}")
    reasons = Counter(row["refused"] for row in rows)
    between = reasons.pop(INTERPOLATED, 0)
    refused, found = reasons.total() - reasons[None], reasons.total()
    besides = f"; {between} more were followed between key frames and have none" if between else ""
    console.result(f"{reasons[None]} poses of {found} vehicles; {refused} refused{besides}")
    if scene.has_truth:
        summaries = {}
        for level in levels if scene.results is None else (0.0,):
            name = f"labels with {level:g} px of noise" if scene.results is None else "predictions"
            summaries[name] = summary(measure(scene, noise=level, score=score, sigma_px=sigma))
            for line in table(f"{name}: median (90%, 99%)", summaries[name]):
                console.result(line)
        write_json(out / "pose_errors.json", summaries)
        console.result(f"wrote {out / 'pose_errors.json'}")
