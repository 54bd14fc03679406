"""`skope eval` and its commands on a detector's results: compare, view, calibrate-scores."""

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from skope import keypoints
from skope.detector import weights
from skope.errors import UserError
from skope.eval.cli.options import (
    PAPER_PROTOCOL,
    PROTOCOL_CHOICES,
    MachineOptions,
    check_probability,
    counts,
    data_option,
    machine,
    output,
)
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.terminal.command_options import (
    DATA_FOLDER,
    DIR_METAVAR,
    FILE_METAVAR,
    LIST_METAVAR,
    RUN_FOLDER,
    PortOption,
    option,
    separated,
)
from skope.terminal.console import Console


def calibrate_scores(
    *,
    checkpoint: Annotated[
        Path, option(metavar="PATH", help="Checkpoint file, or run folder for its newest one.")
    ] = RUN_FOLDER,
    data: Annotated[Path, option(metavar=DIR_METAVAR, help="Dataset folder.")] = DATA_FOLDER,
    split: Annotated[
        str,
        option(metavar="NAME", help="Split to fit on; train: only the part that training kept for validation."),
    ] = "train",
    last: Annotated[
        float | None, option(help="Use only this share of each recording, at its end.", show_default="see --split")
    ] = None,
    score: Annotated[float, option(help="Fit on keypoints of detections with a score above this.")] = 0.9,
    max_images: Annotated[int | None, option(least=1, help="Maximum number of images.")] = None,
    out: Annotated[
        Path | None,
        option(
            metavar=FILE_METAVAR,
            help="Checkpoint to write, with calibrated keypoint and box scores.",
            show_default="keypoint scores only, in a file beside the weights",
        ),
    ] = None,
    hardware: MachineOptions,
    console: Console,
) -> None:
    """Calibrate a checkpoint's keypoint scores: probabilities that a keypoint is visible and close to its position.

    With --out, box scores also become probabilities that there is a road user of that category.

    (`skope eval camera` estimates a camera's focal length and tilt.)
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


def view(
    results: Annotated[
        Path, typer.Argument(metavar="RESULTS", help="Folder that `skope eval` or `skope eval predict` wrote.")
    ],
    console: Console,
    port: PortOption = None,
) -> None:
    """Browse predictions beside ground truth, missed vehicles and false positives first; Ctrl-C ends it."""
    from skope.eval.view.results_folder import read_results_folder
    from skope.viewer.server import serve

    serve(read_results_folder(results, console), port, console)


def compare_runs(
    folders: Annotated[list[Path], typer.Argument(metavar="FOLDER", help="Output folders of `skope eval`.")],
    console: Console,
    protocol: Annotated[str, option(choices=PROTOCOL_CHOICES, help="Protocol of the table.")] = "pooled",
    out: Annotated[Path | None, option(metavar=FILE_METAVAR, help="Also write all figures to this JSON file.")] = None,
) -> None:
    """Compare evaluations, with paired intervals of their differences from the first."""
    from skope.eval.report import compare
    from skope.files.json_files import json_bytes
    from skope.files.output_folders import write_new

    document = compare.compare(folders)
    text = compare.render_comparison(document, protocol)
    if out:
        write_new(out, json_bytes(document))
    console.result(text)


GIVEN_BOXES = "given"


def evaluate_or_score(
    *,
    data: Annotated[
        Path | None, data_option(metavar=DIR_METAVAR, help="Dataset folder.", show_default=str(DATA_FOLDER))
    ] = None,
    split: Annotated[
        list[str] | None,
        data_option(
            metavar=LIST_METAVAR,
            help="Split to evaluate; several: repeat it or separate by commas.",
            show_default="all test splits",
        ),
    ] = None,
    checkpoint: Annotated[
        Path | None,
        data_option(
            metavar="PATH",
            help="Checkpoint file, run folder for its newest one, or weights that come with skope.",
            show_default=f"{RUN_FOLDER} if it exists, else {weights.DEFAULT_WEIGHTS}",
        ),
    ] = None,
    annotations: Annotated[
        Path | None,
        data_option(metavar=FILE_METAVAR, help="Score --predictions against this COCO file, without a dataset folder."),
    ] = None,
    predictions: Annotated[
        Path | None,
        data_option(
            metavar=FILE_METAVAR, help="Score this COCO results file, of any detector, instead of a checkpoint."
        ),
    ] = None,
    scheme: Annotated[
        str | None,
        data_option(
            choices=keypoints.RESULT_SCHEMES,
            help="Keypoint scheme of --predictions; keypoints that both schemes have are scored. boxes: no keypoints; "
            "coco: no keypoints, and COCO's category numbers.",
            show_default="the ground truth's",
        ),
    ] = None,
    max_images: Annotated[
        int | None,
        data_option(least=1, help="Maximum number of images per split, selected as in `skope train`."),
    ] = None,
    labelled: Annotated[
        str,
        counts(choices=("visible", "all"), help="Keypoints that count; all: hidden ones inside the image too."),
    ] = "visible",
    boxes: Annotated[
        str,
        counts(
            choices=("full", "visible", GIVEN_BOXES),
            help="Ground-truth boxes: whole or of visible pixels; given: predict keypoints on the ground-truth boxes.",
        ),
    ] = "full",
    score: Annotated[float, counts(help="Score above which a detection counts.")] = PAPER_THRESHOLDS.score,
    alpha: Annotated[
        float, counts(help="Maximum error of a correct keypoint, as a share of the box's longer edge.")
    ] = PAPER_THRESHOLDS.alpha,
    iou: Annotated[
        list[str] | None,
        counts(
            metavar=LIST_METAVAR,
            help="IoU threshold for matching; several: repeat it or separate by commas.",
            show_default=",".join(map(str, PAPER_THRESHOLDS.iou)),
        ),
    ] = None,
    keypoint_score: Annotated[
        float, counts(help="Score above which a keypoint counts as predicted; 0: all, as in the paper.")
    ] = 0.0,
    protocol: Annotated[
        str | None,
        output(
            choices=PROTOCOL_CHOICES,
            help="Protocol of the table.",
            show_default="pooled; paper with --compare",
        ),
    ] = None,
    compare: Annotated[
        str | None,
        output(choices=(PAPER_PROTOCOL,), help="Print the published rows below ours (splits easy, medium, hard)."),
    ] = None,
    out: Annotated[
        Path | None,
        output(metavar=DIR_METAVAR, help="Output folder.", show_default="RUN/eval, or eval for a results file"),
    ] = None,
    fast: Annotated[
        bool, machine("--fast", help="Predict keypoints only for detections above --score; AP is then not available.")
    ] = False,
    hardware: MachineOptions,
    console: Console,
) -> None:
    """Measure a checkpoint on a dataset's test splits, or score a COCO results file."""
    from skope.eval.evaluate import EvalJob, evaluate
    from skope.metrics import read_inputs
    from skope.metrics.keypoint_outcomes import MetricOptions

    options = MetricOptions(
        score=score,
        alpha=alpha,
        labelled=labelled,
        boxes="full" if boxes == GIVEN_BOXES else boxes,
        iou=_thresholds(iou) or PAPER_THRESHOLDS.iou,
        keypoint_score=keypoint_score,
    )
    splits = separated(split)
    _refuse_mixtures(data, checkpoint, splits, annotations, predictions, boxes)
    if fast and (predictions or boxes == GIVEN_BOXES):
        raise UserError("--fast: needs a checkpoint that detects vehicles; remove --predictions and --boxes given")
    if scheme and not predictions:
        raise UserError("--scheme needs --predictions: a checkpoint's scheme is its own")
    checkpoint = (
        None if predictions else checkpoint or (RUN_FOLDER if RUN_FOLDER.exists() else Path(weights.DEFAULT_WEIGHTS))
    )
    out = out or _default_out(checkpoint)
    if out.exists() and not out.is_dir():
        raise UserError(f"--out: expected a folder, got the file {out}")
    truth = (
        read_inputs.read_annotations(annotations)
        if annotations
        else read_inputs.read_dataset(data or DATA_FOLDER, splits)
    )
    scheme = scheme or truth.scheme.name
    options = replace(options, scheme=truth.scheme, points=read_inputs.scheme_points(scheme, truth.scheme))
    evaluate(
        EvalJob(
            truth=truth,
            out=out,
            options=options,
            protocol=protocol or (PAPER_PROTOCOL if compare else "pooled"),
            checkpoint=checkpoint,
            predictions=predictions,
            settings=hardware.settings(given=boxes == GIVEN_BOXES),
            fast=fast,
            max_images=max_images,
            scheme=scheme,
            beside_paper=compare == PAPER_PROTOCOL,
        ),
        console,
        width=shutil.get_terminal_size((120, 24)).columns,
    )


def _thresholds(values: list[str] | None) -> tuple[float, ...]:
    """Return the IoU thresholds, highest first."""
    try:
        return tuple(sorted((float(part) for part in separated(values)), reverse=True))
    except ValueError:
        raise UserError(f"--iou: expected numbers, got {', '.join(values or ())}") from None


def _refuse_mixtures(
    data: Path | None,
    checkpoint: Path | None,
    splits: list[str],
    annotations: Path | None,
    predictions: Path | None,
    boxes: str,
) -> None:
    def clash(a: str, b: str, given_a: Any, given_b: Any, why: str) -> None:
        if given_a and given_b:
            raise UserError(f"{a} and {b} cannot be combined: {why}")

    clash("--predictions", "--checkpoint", predictions, checkpoint, "results are scored as they are")
    clash(
        "--predictions",
        "--boxes given",
        predictions,
        boxes == GIVEN_BOXES,
        "only a checkpoint can be run on given boxes",
    )
    clash("--annotations", "--data", annotations, data, "both give the ground truth")
    clash("--annotations", "--split", annotations, splits, "an annotation file is one split")
    if annotations and not predictions:
        raise UserError("--annotations needs --predictions; to run a checkpoint, give its dataset with --data")
    if predictions and not annotations and len(splits) != 1:
        raise UserError("--predictions with a dataset needs exactly one --split, the one that was predicted")


def _default_out(checkpoint: Path | None) -> Path:
    if not checkpoint:
        return Path("eval")
    shipped = str(checkpoint) in weights.names() and not checkpoint.exists()
    run = RUN_FOLDER.parent / checkpoint if shipped else checkpoint
    return (run.parent if run.is_file() else run) / "eval"
