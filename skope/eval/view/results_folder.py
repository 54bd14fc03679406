"""Results folders: which ground truth, predictions and pictures belong to what `skope eval` wrote."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from skope import keypoints
from skope.dataset.folder import CARD, FRAMES, MANIFEST
from skope.dataset.image_selection import part
from skope.errors import UserError
from skope.eval.report import compare
from skope.eval.view.footage_folder import footage_collection
from skope.files.reading import sha256_of
from skope.metrics import read_inputs
from skope.metrics.keypoint_outcomes import Options
from skope.metrics.read_inputs import GroundTruth
from skope.schema import AnnotationFile, Result
from skope.terminal.console import Console
from skope.viewer.collection import Collection, ShownSplit
from skope.viewer.pictures import read_picture


def read_results_folder(folder: Path, console: Console) -> Collection:
    """Read for the viewer a folder that `skope eval` or `skope eval predict` wrote.

    Raises UserError where it is no such folder, or what it was made of is missing or another one by now.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; `skope eval --out {folder}` makes it")
    if (folder / compare.METRICS).is_file():
        return _evaluation(folder, console)
    if (folder / FRAMES).is_file():
        return footage_collection(folder)
    raise UserError(f"{folder}: neither {compare.METRICS} of `skope eval` nor {FRAMES} of `skope eval predict` in it")


def _evaluation(folder: Path, console: Console) -> Collection:
    run = compare.read_run(folder)
    path = folder / compare.METRICS
    inputs = _inputs(path, run.metrics)
    if not isinstance(run.metrics["splits"], dict) or not isinstance(run.tallies, dict):
        raise UserError(f"{folder}: {compare.METRICS}, {compare.TALLIES}: splits: expected an object")
    truth = _ground_truth(path, inputs, list(run.metrics["splits"]))
    options = _options(path, run.metrics, truth)
    scored = [Path(name) for name in list(inputs)[len(truth.sources) :]]
    if not scored:
        raise UserError(f"{path}: of.inputs: names no checkpoint and no predictions")
    # Where another program has made the predictions, they lie where they lay; a checkpoint's are written here.
    given = scored[0] if run.metrics.get("calibrated") is None else None
    if given:
        _check_unchanged(path, given, inputs)
    splits = []
    for file in console.bar(truth.splits, unit="split", label="reading"):
        shown = _evaluated(folder / compare.TALLIES, run.tallies, file)
        results = _results(given or folder / f"predictions_{file.name}.json", file, run.metrics["scheme"])
        splits.append(ShownSplit(file=shown, results=read_inputs.for_images(results, shown)))
    names = ", ".join(file.name for file in truth.splits)
    root = truth.root
    return Collection(
        title=f"{'/'.join(scored[0].parts[-2:])} on {root.resolve().name} ({names})",
        splits=tuple(splits),
        picture=lambda image: read_picture(root / image.file_name),
        options=options,
    )


def _inputs(path: Path, metrics: Mapping[str, Any]) -> dict[str, str]:
    """The files that an evaluation is of, with their checksums: first those of the ground truth."""
    of = metrics.get("of")
    inputs = of.get("inputs") if isinstance(of, dict) else None
    if not isinstance(inputs, dict) or not inputs:
        raise UserError(f"{path}: of.inputs: expected the files that were evaluated; evaluate again")
    return inputs


def _ground_truth(path: Path, inputs: Mapping[str, str], names: Sequence[str]) -> GroundTruth:
    """The ground truth of the splits `names`, which must still be what was evaluated."""
    source = Path(next(iter(inputs)))
    roots = [source.parent] if source.name == MANIFEST else []
    roots += [source.parent.parent] if source.parent.name == "annotations" else []
    root = next((root for root in roots if (root / CARD).is_file()), None)
    _check_unchanged(path, source, inputs)
    truth = read_inputs.read_dataset(root, names) if root else read_inputs.read_annotations(source)
    for other in truth.sources[1:]:
        _check_unchanged(path, other, inputs)
    if [file.name for file in truth.splits] != list(names):
        raise UserError(f"{path}: splits: expected {truth.splits[0].name}, got {', '.join(names)}")
    return truth


def _check_unchanged(path: Path, source: Path, inputs: Mapping[str, str]) -> None:
    """Raise a UserError where a file that was evaluated is not there, or holds something else by now."""
    if not source.is_file():
        where = "" if source.is_absolute() else "; it is looked for from where `skope eval` was called"
        raise UserError(f"{source}: no such file, but {path} is of it{where}")
    if sha256_of(source) != inputs.get(str(source)):
        raise UserError(f"{source}: has changed since {path} was written; evaluate again")


def _options(path: Path, metrics: Mapping[str, Any], truth: GroundTruth) -> Options:
    """Options that an evaluation was made with."""
    try:
        thresholds = [float(t) for split in metrics["splits"].values() for t in split["iou"]]
        points = tuple(metrics["points"])
        if metrics["scheme"] not in read_inputs.RESULT_SCHEMES:
            raise UserError(f"scheme: {metrics['scheme']!r} is none")
        if not all(isinstance(k, int) and 0 <= k < keypoints.K for k in points):
            raise UserError(f"points: expected whole numbers from 0 to {keypoints.K - 1}")
        return Options(
            score=metrics["score_threshold"],
            alpha=metrics["alpha"],
            labelled=metrics["labelled"],
            boxes=metrics["boxes"],
            iou=tuple(dict.fromkeys(thresholds)),
            keypoint_score=metrics["keypoint_score_threshold"],
            points=points,
            scheme=truth.scheme,
        )
    except KeyError as error:
        raise UserError(f"{path}: field {error.args[0]} is missing") from None
    except (TypeError, ValueError, AttributeError) as error:
        raise UserError(f"{path}: {error}") from None


def _evaluated(path: Path, tallies: Mapping[str, Mapping[str, Any]], file: AnnotationFile) -> AnnotationFile:
    """The images of a split that were evaluated: all, or those that `--max-images` left."""
    entry = tallies.get(file.name)
    ids = entry.get("image_ids") if isinstance(entry, dict) else None
    if not isinstance(ids, list):
        raise UserError(f"{path}: splits.{file.name}.image_ids: expected a list")
    wanted = set(ids)
    return part(file, (image for image in file.images if image.id in wanted))


def _results(path: Path, file: AnnotationFile, scheme: str) -> Sequence[Result]:
    return read_inputs.read_vehicle_results(path, file, scheme)
