"""`skope eval pose`: position, heading and size of vehicles."""

from typing import Annotated

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
    from skope.pose.pose_footage import PoseJob, locate_footage

    levels = numbers_of("--noise", noise)
    scene = options.scene(*levels, console=console)
    options.claim_output(out, "skope eval pose", noise=levels)
    job = PoseJob(scene=scene, out=out, score=options.score, sigma_px=options.sigma, noise=levels)
    for line in locate_footage(job, console):
        console.result(line)
