"""`skope eval`: predict (or read results), match, measure, draw, write, print."""

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skope import keypoints
from skope.dataset import coco, shards
from skope.dataset.folder import read_image
from skope.dataset.image_selection import take
from skope.detections import apart
from skope.detector.network_settings import Settings
from skope.errors import UserError
from skope.eval import report
from skope.eval.report import table
from skope.files.atomic import write_text
from skope.files.json_files import write_json
from skope.files.output_folders import claim_output
from skope.files.progress import Progress
from skope.metrics import pck_precision_recall, read_inputs
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.read_inputs import GroundTruth
from skope.metrics.split_scores import split_metrics, to_tallies
from skope.pictures import draw
from skope.schema import CATEGORY_NAMES, VEHICLE_ALONE, AnnotationFile, AnyResult, Result, RoadUserResult, far_outside
from skope.terminal.console import Console, counted

if TYPE_CHECKING:
    from skope.detector.predictor import Predictor

EVALUATION_REPORT: Final = "report.html"
OVERLAY_COUNT: Final = 4
"""Number of overlay images per split."""


@dataclass(frozen=True, kw_only=True)
class EvalJob:
    """Settings of one evaluation. Either `checkpoint` or `predictions` is given."""

    truth: GroundTruth
    out: Path
    options: MetricOptions
    protocol: str
    checkpoint: Path | None
    predictions: Path | None
    settings: Settings
    """Settings for running `checkpoint`."""
    fast: bool = False
    """Whether to predict keypoints only for detections above the score threshold."""
    max_images: int | None = None
    scheme: str = keypoints.SCHEME
    """Keypoint scheme of the detector."""
    beside_paper: bool = False
    """Whether to print the rows of the paper below ours."""


def evaluate(job: EvalJob, console: Console, width: int) -> dict[str, Any]:
    """Evaluate a detector or its results, and write everything under `job.out`.

    Args:
        job: Inputs and settings of the evaluation.
        console: Console for progress and the table.
        width: Width of the printed table, characters.

    Returns:
        The content of `metrics.json`.

    Raises:
        UserError: Images or boxes are missing, the output folder has the output of another run, or files are
            malformed.
    """
    splits = [read_inputs.limit(file, job.max_images) for file in job.truth.splits]
    for file in splits:
        read_inputs.check_boxes(file, job.options.boxes)
    if job.checkpoint:
        _check_images(splits, job.truth.root)
    predictor = _predictor(job, console) if job.checkpoint else None
    found = {} if predictor else _read(job, splits)
    for text in _doubts(job, splits, found):
        console.warn(text)
    work = _claim(job, predictor)
    found |= _predicted(job, predictor, splits) if predictor else {}
    calibrated = predictor.calibrated if predictor else None
    known = _known(job, predictor, found)
    measured = []
    for file in splits:
        vehicles, road_users = apart(found[file.name])
        measured.append(
            split_metrics(
                file,
                vehicles,
                job.options,
                job.truth.fleet,
                all_scores=not job.fast,
                road_users=road_users,
                known=known,
            )
        )
    entries = {split.file.name: split.entry for split in measured}
    document = pck_precision_recall.scores_document(
        job.options, entries, calibrated=calibrated, scheme=job.scheme, work=work
    )
    write_json(job.out / "metrics.json", document)
    tallies = {split.file.name: to_tallies(split) for split in measured}
    write_text(
        job.out / "tallies.json",
        json.dumps({"version": pck_precision_recall.METRIC_RULES.version, "splits": tallies}) + "\n",
    )
    beside = table.published() if job.beside_paper else None
    subject = f"{job.checkpoint or job.predictions} on {job.truth.root}"
    page = report.render_page(document, measured, job.truth.root, job.options, job.protocol, beside, subject)
    write_text(job.out / EVALUATION_REPORT, page)
    pictures = [path for file in splits for path in _overlays(job, file, found[file.name], console)]

    console.result(table.render_table(document, job.protocol, width, beside=beside))
    for line in _advice(job, entries, {split.file.name: split.results for split in measured}):
        console.result(line)
    console.result(_last_line(job, splits, pictures))
    return document


def _known(job: EvalJob, predictor: "Predictor | None", found: Mapping[str, Sequence[AnyResult]]) -> tuple[str, ...]:
    """Return the categories that the detector has learnt. A results file without other road users has vehicles only."""
    if predictor is not None:
        return VEHICLE_ALONE if job.settings.given else predictor.categories
    has_road_users = any(isinstance(result, RoadUserResult) for results in found.values() for result in results)
    return CATEGORY_NAMES if has_road_users else VEHICLE_ALONE


def _check_images(splits: Sequence[AnnotationFile], root: Path) -> None:
    """Raise a UserError if images are missing. This is checked before a long prediction."""
    for file in splits:
        missing = [image.file_name for image in file.images if shards.size(root / image.file_name) < 0]
        if missing:
            count = f"{len(missing)} of {len(file.images)} images"
            raise UserError(f"{root / missing[0]}: no such file; split {file.name} lacks {count}")


def _predictor(job: EvalJob, console: Console) -> "Predictor":
    """Load the checkpoint and check that its keypoint scheme is that of the ground truth."""
    from skope.detector.predictor import Predictor  # torch

    assert job.checkpoint is not None
    sizes = {(image.width, image.height) for file in job.truth.splits for image in file.images}
    settings = replace(job.settings, one_size=len(sizes) <= 1)
    if job.fast:
        settings = replace(settings, min_score=job.options.score)
    predictor = Predictor.load(job.checkpoint, settings, console)
    predictor.check_scheme(job.truth.scheme, job.truth.root)
    return predictor


def _claim(job: EvalJob, predictor: "Predictor | None") -> dict[str, Any]:
    """Claim the output folder for this evaluation; return the content of `work.json`."""
    scored = [*([job.predictions] if job.predictions else []), *(predictor.files if predictor else ())]
    options = asdict(job.options) | {"scheme": job.scheme, "points": list(job.options.points)}
    settings = {name: getattr(job.settings, name) for name in ("given", "backend", "precision", "min_size")}
    splits = [file.name for file in job.truth.splits]
    more = {"splits": splits, "fast": job.fast, "max_images": job.max_images}
    return claim_output(job.out, "skope eval", [*job.truth.sources, *scored], {**options, **settings, **more})


def _predicted(
    job: EvalJob, predictor: "Predictor", splits: Sequence[AnnotationFile]
) -> dict[str, tuple[AnyResult, ...]]:
    """Run the detector on all splits; return split name -> results. A stopped run resumes."""
    out = {}
    for file in splits:
        path = job.out / f"predictions_{file.name}.json"
        progress = Progress(job.out / f".predictions_{file.name}.jsonl", ("image_id", "results"))
        rows = {row["image_id"]: row["results"] for row in progress.rows()}
        for image_id, results in predictor.by_image(file, job.truth.root, rows):
            rows[image_id] = [coco.result_to_dict(result) for result in results]
            progress.add({"image_id": image_id, "results": rows[image_id]})
        found = [coco.any_result_from_dict(row) for image in file.images for row in rows[image.id]]
        coco.write_results(path, found)
        progress.end()
        # The file rounds results. They are read back from it so that scoring the file later gives the same figures.
        out[file.name] = tuple(coco.iter_all_results(path))
    return out


def _read(job: EvalJob, splits: Sequence[AnnotationFile]) -> dict[str, tuple[AnyResult, ...]]:
    assert job.predictions is not None
    (whole,), (part,) = job.truth.splits, splits
    return {part.name: read_inputs.for_images(read_inputs.read_all_results(job.predictions, whole, job.scheme), part)}


def _doubts(
    job: EvalJob, splits: Sequence[AnnotationFile], results: Mapping[str, Sequence[AnyResult]]
) -> Iterator[str]:
    """Yield warnings on guessed boxes of a results file, and on implausible annotations."""
    for found in results.values():
        vehicles, others = apart(found)
        foreign = job.scheme in keypoints.BOX_SCHEMES
        if others and not vehicles and not foreign and any(file.annotations for file in splits):
            yield (
                f"{job.predictions}: {counted(len(others), 'result')} of bicycles, motorcycles and pedestrians "
                "(category_id 2 to 4), none of a vehicle; --scheme coco reads the category numbers of COCO"
            )
        unboxed = [result for result in vehicles if not result.boxed]
        if unboxed:
            yield (
                f"{job.predictions}: {counted(len(unboxed), 'result')} without bbox, first for image "
                f"{unboxed[0].image_id}: the extent of the keypoints with a score above 0 is used as their box"
            )
    for file in splits:
        known = [annotation for annotation in file.annotations if not annotation.ignored]
        empty = [annotation for annotation in known if annotation.bbox[2:].min() <= 0]
        boxed = [annotation for annotation in known if annotation.bbox[2:].min() > 0]
        astray = [a for a in boxed if (far_outside(a) & (a.keypoints[:, 2] == 2)).any()]
        for wrong, defect in (
            (empty, "a box without area"),
            (astray, "keypoints called visible far outside of the box"),
        ):
            if wrong:
                count = counted(len(wrong), "vehicle")
                yield (
                    f"split {file.name}: {count} with {defect}, which no detector can find; first: "
                    f"annotation {wrong[0].id}"
                )


def _overlays(job: EvalJob, file: AnnotationFile, results: Sequence[AnyResult], console: Console) -> list[Path]:
    """Draw a few images with ground truth and predictions side by side; missing image files are skipped."""
    few = take(file, OVERLAY_COUNT)
    truth, users = few.by_image(), few.road_users_by_image()
    written = []
    for i, image in enumerate(few.images, start=1):
        source = job.truth.root / image.file_name
        if shards.size(source) < 0:
            continue
        try:
            pixels = read_image(source, size=(image.width, image.height))
        except UserError as error:
            console.say(f"no overlay: {error}")
            continue
        scale = 2 if image.width < 960 else 1
        found = [r for r in results if r.image_id == image.id and r.score > job.options.score]
        labels = draw.annotations(pixels, truth[image.id], users[image.id], scale=scale, scheme=file.scheme)
        answers = draw.results(pixels, *apart(found), scale=scale, scheme=file.scheme)
        panels = [
            draw.caption(labels, f"ground truth  {image.file_name}"),
            draw.caption(answers, f"{len(found)} detections > {job.options.score:g}"),
        ]
        path = job.out / "overlays" / f"{file.name}_{i}.jpg"
        draw.write(path, draw.contact_sheet(panels, columns=2))
        written.append(path)
    return written


def _advice(job: EvalJob, entries: Mapping[str, Any], results: Mapping[str, Sequence[Result]]) -> list[str]:
    """Return advice on splits without counted detections."""
    silent = [name for name, split in entries.items() if split["ground_truth"] and not split["detections"]]
    if not silent:
        return []
    highest = max((r.score for name in silent for r in results[name]), default=None)
    seen = "there are no detections" if highest is None else f"the highest score is {highest:.3f}"
    lines = ["", f"No detection scores above {job.options.score:g} in {', '.join(silent)}: {seen}."]
    if job.checkpoint:
        lines.append(
            "Possible remedies: longer training (`skope train --epochs N --resume`), `--recipe scratch` if training "
            "starts from random weights, `--init coco` to start from weights trained on COCO, and more images."
        )
    if highest:
        lower = f"--score {_below(highest):g} --out {job.out}_{_below(highest):g}"
        lines.append(f"To count weaker detections: `skope eval {lower}`. AP includes all detections.")
    return lines


def _below(score: float) -> float:
    """Return the highest round threshold below the best score."""
    return next((t for t in (0.7, 0.5, 0.3, 0.1) if t < score), 0.0)


def _last_line(job: EvalJob, splits: Sequence[AnnotationFile], pictures: Sequence[Path]) -> str:
    names = "{" + ",".join(file.name for file in splits) + "}" if len(splits) > 1 else splits[0].name
    files = ["metrics.json", "tallies.json"]
    files += [f"predictions_{names}.json"] if job.checkpoint else []
    files += [f"{pictures[0].parent.name}/"] if pictures else []
    return f"Wrote {', '.join(files)} to {job.out}; open {job.out / EVALUATION_REPORT}"
