"""`skope eval calibrate-scores`: scores that are probabilities."""

from pathlib import Path
from typing import Annotated

from skope.eval.cli.checks import check_probability
from skope.eval.cli.options import MachineOptions
from skope.terminal.command_options import DATA, DIR, FILE_METAVAR, RUN, option
from skope.terminal.console import Console


def calibrate_scores(
    *,
    checkpoint: Annotated[
        Path, option(metavar="PATH", help="Checkpoint file, or run folder for its newest one.")
    ] = RUN,
    data: Annotated[Path, option(metavar=DIR, help="Dataset folder.")] = DATA,
    split: Annotated[
        str,
        option(metavar="NAME", help="Split to fit on; of train, the part that training kept for validation."),
    ] = "train",
    last: Annotated[
        float | None, option(help="Take this share of each recording, at its end.", show_default="see --split")
    ] = None,
    score: Annotated[float, option(help="Fit on the keypoints of detections above this.")] = 0.9,
    max_images: Annotated[int | None, option(least=1, help="Take only so many images.")] = None,
    out: Annotated[
        Path | None,
        option(
            metavar=FILE_METAVAR,
            help="Checkpoint to write whose own scores are probabilities, boxes' too.",
            show_default="keypoint scores alone, in a file beside the weights",
        ),
    ] = None,
    hardware: MachineOptions,
    console: Console,
) -> None:
    """Turn a checkpoint's keypoint scores into probabilities that a point is visible and near its place.

    With --out, boxes' scores into probabilities that there is one of that category, too.

    (`skope eval camera` finds a camera's focal length and tilt.)
    """
    from skope.detector.fit_score_calibration import CalibrationJob, fit_calibration

    check_probability("--score", score)
    job = CalibrationJob(
        checkpoint=checkpoint,
        data=data,
        split=split,
        last=last,
        score=score,
        max_images=max_images,
        out=out,
        settings=hardware.settings(),
    )
    path = fit_calibration(job, console)
    console.result(f"Wrote {path}" if out else f"Wrote {path}; `skope eval` uses it from now on")
