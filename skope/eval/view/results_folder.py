"""Results folders for the viewer: ground truth, predictions and images of `skope eval` and `skope eval predict`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from skope import keypoints, schema
from skope.dataset import coco
from skope.dataset.folder import CARD_FILE, FRAMES_FILE, MANIFEST_FILE, PREDICTIONS_FILE
from skope.dataset.image_selection import part
from skope.detections import apart
from skope.errors import UserError
from skope.eval.report import compare
from skope.files.atomic import sha256_of
from skope.files.json_files import read_json
from skope.files.output_folders import WORK_FILE
from skope.metrics import read_inputs
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.read_inputs import GroundTruth
from skope.schema import AnnotationFile, Image, Result, RoadUser, RoadUserResult
from skope.terminal.console import Console
from skope.video.footage import FOUND_AT
from skope.video.frame_cache import FrameCache
from skope.viewer.collection import Collection, Picture, ShownSplit, encoded, read_picture


def footage_collection(folder: Path) -> Collection:
    """Read the frames and detections in an output folder of `skope eval predict`."""
    file = replace(coco.read(folder / FRAMES_FILE), name="")  # footage is no split
    results, found_users = apart(read_inputs.read_all_results(folder / PREDICTIONS_FILE, file))
    users = tuple(_as_label(number, user) for number, user in enumerate(found_users, start=1))
    known = schema.checked_categories({*file.categories, *(user.category for user in users)})
    file = replace(file, road_users=users, categories=known)
    checkpoint = _checkpoint(folder)
    return Collection(
        title=f"{checkpoint} on {file.info.get('source', folder.resolve().name)}",
        splits=(ShownSplit(file=file, results=tuple(results)),),
        picture=_pictures(folder, file.info.get(FOUND_AT)),
        truth=False,
        options=MetricOptions(score=0.0, scheme=file.scheme),
    )


def _as_label(number: int, found: RoadUserResult) -> RoadUser:
    """Return a detected pedestrian or two-wheeler as a label, because the page draws only detections of vehicles."""
    return RoadUser(
        id=number,
        image_id=found.image_id,
        category_id=found.category_id,
        bbox=found.bbox,
        area=float(found.bbox[2:].prod()),
        track_id=found.track_id,
    )


def _checkpoint(folder: Path) -> str:
    """Return the name of the checkpoint of the run, or "a detector" if it is not known."""
    work = read_json(folder / WORK_FILE) if (folder / WORK_FILE).is_file() else None
    inputs = work.get("inputs") if isinstance(work, dict) else None
    return "/".join(Path(next(iter(inputs))).parts[-2:]) if isinstance(inputs, dict) and inputs else "a detector"


def _pictures(folder: Path, found_at: Any) -> Callable[[Image], Picture]:
    """Return a reader for the images of the frames, from the files or the video of the folder."""
    source = folder / found_at if isinstance(found_at, str) else None
    if source and source.is_file():
        return FrameCache(source, encoded).frame

    def picture(image: Image) -> Picture:
        if source is None:
            raise UserError(
                f"{folder / FRAMES_FILE}: info.{FOUND_AT}: expected the path of the images, found none; predict again"
            )
        if not source.is_dir():
            raise UserError(f"{source}: no such file or folder, but {folder / FRAMES_FILE} refers to it")
        return read_picture(source / image.file_name)

    return picture


def read_results_folder(folder: Path, console: Console) -> Collection:
    """Read an output folder of `skope eval` or `skope eval predict` for the viewer.

    Raises:
        UserError: The folder is not an output of these commands, or its inputs are missing or have changed.
    """
    if not folder.is_dir():
        raise UserError(f"{folder}: no such folder; `skope eval --out {folder}` makes it")
    if (folder / compare.METRICS_FILE).is_file():
        return _evaluation(folder, console)
    if (folder / FRAMES_FILE).is_file():
        return footage_collection(folder)
    raise UserError(
        f"{folder}: neither {compare.METRICS_FILE} of `skope eval` nor {FRAMES_FILE} of `skope eval predict` in it"
    )


def _evaluation(folder: Path, console: Console) -> Collection:
    run = compare.read_run(folder)
    path = folder / compare.METRICS_FILE
    inputs = _inputs(path, run.metrics)
    if not isinstance(run.metrics["splits"], dict) or not isinstance(run.tallies, dict):
        raise UserError(f"{folder}: {compare.METRICS_FILE}, {compare.TALLIES_FILE}: splits: expected an object")
    truth = _ground_truth(path, inputs, list(run.metrics["splits"]))
    options = _options(path, run.metrics, truth)
    scored = [Path(name) for name in list(inputs)[len(truth.sources) :]]
    if not scored:
        raise UserError(f"{path}: of.inputs: expected a checkpoint or predictions, found none; evaluate again")
    # Predictions of another program stay in their own file. Those of a checkpoint are in this folder.
    given = scored[0] if run.metrics.get("calibrated") is None else None
    if given:
        _check_unchanged(path, given, inputs)
    splits = []
    for file in console.bar(truth.splits, unit="split", label="reading"):
        shown = _evaluated(folder / compare.TALLIES_FILE, run.tallies, file)
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
    """Return the input files of an evaluation with their checksums, ground truth first."""
    of = metrics.get("of")
    inputs = of.get("inputs") if isinstance(of, dict) else None
    if not isinstance(inputs, dict) or not inputs:
        raise UserError(f"{path}: of.inputs: expected the files that were evaluated; evaluate again")
    return inputs


def _ground_truth(path: Path, inputs: Mapping[str, str], names: Sequence[str]) -> GroundTruth:
    """Read the ground truth of the splits `names`, which must be unchanged since the evaluation."""
    source = Path(next(iter(inputs)))
    roots = [source.parent] if source.name == MANIFEST_FILE else []
    roots += [source.parent.parent] if source.parent.name == "annotations" else []
    root = next((root for root in roots if (root / CARD_FILE).is_file()), None)
    _check_unchanged(path, source, inputs)
    truth = read_inputs.read_dataset(root, names) if root else read_inputs.read_annotations(source)
    for further_source in truth.sources[1:]:
        _check_unchanged(path, further_source, inputs)
    if [file.name for file in truth.splits] != list(names):
        raise UserError(f"{path}: splits: expected {truth.splits[0].name}, got {', '.join(names)}")
    return truth


def _check_unchanged(path: Path, source: Path, inputs: Mapping[str, str]) -> None:
    """Raise a UserError if an evaluated file is missing or has changed."""
    if not source.is_file():
        where = "" if source.is_absolute() else "; the path is relative to the folder in which `skope eval` was run"
        raise UserError(f"{source}: no such file, but {path} refers to it{where}")
    if sha256_of(source) != inputs.get(str(source)):
        raise UserError(f"{source}: has changed since {path} was written; evaluate again")


def _options(path: Path, metrics: Mapping[str, Any], truth: GroundTruth) -> MetricOptions:
    """Return the options of an evaluation."""
    try:
        thresholds = [float(t) for split in metrics["splits"].values() for t in split["iou"]]
        points = tuple(metrics["points"])
        if metrics["scheme"] not in keypoints.RESULT_SCHEMES:
            raise UserError(f"scheme: {metrics['scheme']!r} is none")
        if not all(isinstance(k, int) and 0 <= k < keypoints.K for k in points):
            raise UserError(f"points: expected whole numbers from 0 to {keypoints.K - 1}")
        return MetricOptions(
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
    """Return the evaluated images of a split: all, or those selected by `--max-images`."""
    entry = tallies.get(file.name)
    ids = entry.get("image_ids") if isinstance(entry, dict) else None
    if not isinstance(ids, list):
        raise UserError(f"{path}: splits.{file.name}.image_ids: expected a list")
    wanted = set(ids)
    return part(file, (image for image in file.images if image.id in wanted))


def _results(path: Path, file: AnnotationFile, scheme: str) -> Sequence[Result]:
    return read_inputs.read_vehicle_results(path, file, scheme)
