"""Score a detector on hand-labelled photographs of roads.

    python scripts/score_photographs.py FOLDER --checkpoint runs/skope --out runs/real
    python scripts/score_photographs.py FOLDER --predictions results.json --out runs/real

FOLDER holds the photographs and one COCO keypoints JSON of scheme skope33. Keypoints with v = 2 are scored; v = 0 means
not labelled. An image's `scene` or `site` names its camera. `boxes_complete` false means that not all of its vehicles
have a box; such an image is used for keypoints only. A box with `iscrowd` 1 is a region where detections are neither
right nor wrong.

Writes metrics.json, predictions.json and sheets of labels beside predictions. It also adds a line to looks.jsonl, a
record of how often these photographs were used, because photographs that were used in development are no test. An
output folder that holds other work (of other labels, weights or options) is rejected.
"""

import argparse
import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.dataset import coco, image_selection
from skope.dataset.folder import read_image
from skope.detector.network_settings import BACKEND_CHOICES, PRECISION_CHOICES, Settings
from skope.detector.predictor import Predictor
from skope.errors import UserError
from skope.files import safe_names
from skope.files.atomic import sha256_of
from skope.files.json_files import read_json, write_json
from skope.files.output_folders import claim_output
from skope.keypoints import FLIP, OTHER_END
from skope.metrics.coco_ap import average_precision
from skope.metrics.keypoint_outcomes import MetricOptions, lengths, outcomes_at
from skope.metrics.match import Matches, match
from skope.metrics.pck_precision_recall import METRIC_RULES, recall_at_precision
from skope.metrics.read_inputs import for_images, read_vehicle_results
from skope.pictures import draw
from skope.schema import Annotation, AnnotationFile, Result
from skope.terminal.console import Console

IOU: Final = 0.5
"""Lowest overlap at which a detection matches a vehicle."""
LOWEST_PX: Final = 14.0
"""Vehicles lower than this are not labelled; an unmatched detection below this height is neither right nor wrong."""
BANDS_PX: Final = ((0, 32), (32, 64), (64, 128), (128, math.inf))
"""Ranges of heights of ground-truth boxes: from, and below."""
EXCHANGES: Final = {
    "left_right": np.array(FLIP),
    "front_rear": np.array(OTHER_END),
    "turned": np.array([FLIP[i] for i in OTHER_END]),
}
"""Kind of flip -> (33,) index of the keypoint that each keypoint is confused with."""
FEWEST_POINTS: Final = 4
"""Fewest labelled keypoints for which a vehicle can be called flipped."""
FARTHEST_PX: Final = 1e6
"""Largest coordinate of boxes and keypoints that is accepted."""
RESAMPLES: Final = 2000
PANEL_PX: Final = 1280
"""Width of a photograph on a sheet."""
ROWS: Final = 2
"""Photographs per sheet, few enough to read a sheet at full size."""
OPTIONS: Final = MetricOptions(alpha=0.1, iou=(IOU,))
UNNAMED: Final = "unnamed"

Figures = dict[str, Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Photographs:
    """Labelled photographs; each image's `site` is its scene."""

    source: Path
    """The annotation file; file names are relative to its folder."""
    file: AnnotationFile
    complete: frozenset[int]
    """Ids of the images on which every vehicle has a box."""


@dataclass(frozen=True, kw_only=True)
class Vehicle:
    """A vehicle with labelled keypoints, and its detection."""

    id: int
    scene: str
    height_px: float
    labelled: int
    """Number of keypoints with v = 2."""
    matched: bool
    found: int
    """Number of keypoints found; 0 for an unmatched vehicle."""
    in_given: int
    """Number of keypoints found in the ground-truth box."""
    flip: str | None
    """Key of `EXCHANGES`."""


# ----------------------------------------------------------------------------------------------------------- reading


def read_photographs(path: Path) -> Photographs:
    """Read the photographs of a folder with one JSON file, or of the annotation file `path`.

    Raises UserError if one is missing.
    """
    source = path
    if path.is_dir():
        found = sorted(path.glob("*.json"))
        if len(found) != 1:
            names = ", ".join(p.name for p in found) or "none"
            raise UserError(f"{path}: expected one annotation file (*.json) in this folder, found {names}")
        (source,) = found
    file = coco.read(source)
    if file.scheme.name != keypoints.SCHEME:
        raise UserError(f"{source}: has keypoint scheme {file.scheme.name}, expected {keypoints.SCHEME}")
    images, complete = [], set()
    for i, (image, row) in enumerate(zip(file.images, read_json(source)["images"], strict=True)):
        where = f"{source}: images[{i}]"
        whole, scene = row.get("boxes_complete", True), row.get("scene")
        if not isinstance(whole, bool):
            raise UserError(f"{where}: boxes_complete: expected true or false, got {whole!r}")
        if scene not in (None, ""):
            safe_names.name(f"{where}: scene", scene)
        try:
            read_image(source.parent / image.file_name, (image.width, image.height))
        except UserError as error:
            raise UserError(f"{where}: {error}") from None
        images.append(replace(image, site=scene or image.site or UNNAMED))
        if whole:
            complete.add(image.id)
    check_places(f"{source}: annotations", file.annotations)
    return Photographs(source=source, file=replace(file, images=tuple(images)), complete=frozenset(complete))


def check_places(records: str, rows: Sequence[Annotation] | Sequence[Result]) -> None:
    """Raise a UserError if a box or keypoint is so far away that its area or distance overflows."""
    for i, row in enumerate(rows):
        for name, values in (("bbox", row.bbox), ("keypoints", row.keypoints)):
            if (farthest := float(np.abs(values).max())) > FARTHEST_PX:
                raise UserError(f"{records}[{i}]: {name}: expected at most {FARTHEST_PX:g} px, got {farthest:g}")


# ----------------------------------------------------------------------------------------------------------- figures


def score_photographs(
    photographs: Photographs, results: Sequence[Result], given: Sequence[Result] | None, score: float
) -> Figures:
    """Compute all figures: of all photographs, each scene, and (keypoints only) each range of heights and each vehicle.

    `given` are results in the ground-truth boxes, None without them. A ratio without a denominator is None.
    """
    file = photographs.file
    vehicles = judge_vehicles(file, results, given, score)

    def figures(scenes: Sequence[str]) -> Figures:
        images = [image for image in file.images if image.site in scenes]
        whole = image_selection.part(file, [image for image in images if image.id in photographs.complete])
        return {
            "images": len(images),
            "boxes": box_figures(whole, for_images(results, whole), score),
            "keypoints": keypoint_figures([v for v in vehicles if v.scene in scenes], in_given=given is not None),
        }

    bands = {
        f"{low}-{high}" if high < math.inf else f"{low}+": [v for v in vehicles if low <= v.height_px < high]
        for low, high in BANDS_PX
    }
    scenes = sorted({str(image.site) for image in file.images})
    return {
        "all": figures(scenes),
        "keypoints_of_all_interval_90": scene_interval(vehicles, np.random.default_rng(0)),
        "scenes": {scene: figures([scene]) for scene in scenes},
        "heights_px": {
            band: keypoint_figures(band_vehicles, in_given=given is not None) for band, band_vehicles in bands.items()
        },
        "vehicles": {
            str(v.id): {"labelled": v.labelled, "found": v.found, "found_in_given_boxes": v.in_given} for v in vehicles
        },
    }


def matched(file: AnnotationFile, results: Sequence[Result]) -> Matches:
    """Match all of `results` at one IoU.

    Results above any score match the same way without the others.
    """
    return match(file, results, score=-1.0, thresholds=(IOU,))


def judge_vehicles(
    file: AnnotationFile, results: Sequence[Result], given: Sequence[Result] | None, score: float
) -> list[Vehicle]:
    """Compare the vehicles of `file` that have labelled keypoints with the detections that score at least `score`."""
    matches = matched(file, [result for result in results if result.score >= score])
    outcomes = outcomes_at(matches, IOU, OPTIONS)
    found = outcomes.correct(OPTIONS.alpha).sum(axis=1)
    inside = outcomes_at(matched(file, given or ()), IOU, OPTIONS).correct(OPTIONS.alpha).sum(axis=1)
    scenes = {image.id: str(image.site) for image in file.images}
    return [
        Vehicle(
            id=vehicle.id,
            scene=scenes[vehicle.image_id],
            height_px=float(vehicle.bbox[3]),
            labelled=int(outcomes.labelled[i].sum()),
            matched=bool(outcomes.found[i]),
            found=int(found[i]),
            in_given=int(inside[i]),
            flip=flip_of(vehicle, matches.det_keypoints[outcomes.detection[i]]) if outcomes.found[i] else None,
        )
        for i, vehicle in enumerate(matches.vehicles)
        if outcomes.labelled[i].any()
    ]


def flip_of(vehicle: Annotation, predicted: NDArray[np.float64]) -> str | None:
    """Return the exchange of `predicted` (33, 3) that fits a vehicle best and clearly better than none.

    Clearly better: the share of keypoints found is higher by at least 0.25, and the mean distance is lower by at least
    a third. None without such an exchange.
    """
    labelled = vehicle.keypoints[:, 2] == 2
    count = int(labelled.sum())
    if count < FEWEST_POINTS:
        return None

    def fit(points: NDArray[np.float64]) -> tuple[int, float]:
        offsets_px = lengths(points[labelled, :2] - vehicle.keypoints[labelled, :2])
        return int((offsets_px <= OPTIONS.alpha * vehicle.bbox[2:].max()).sum()), float(offsets_px.mean())

    found, mean_px = fit(predicted)
    fits = {kind: fit(predicted[order]) for kind, order in EXCHANGES.items()}
    better = {kind: m for kind, (n, m) in fits.items() if n - found >= 0.25 * count and m <= 2 / 3 * mean_px}
    return min(better, key=better.__getitem__, default=None)


def keypoint_figures(vehicles: Sequence[Vehicle], *, in_given: bool) -> Figures:
    """Count the keypoints found: of all labelled ones, of those of matched vehicles, and in given boxes; and flips."""
    labelled = sum(v.labelled for v in vehicles)
    of_matched = sum(v.labelled for v in vehicles if v.matched)
    found, inside = sum(v.found for v in vehicles), sum(v.in_given for v in vehicles)
    kinds = [v.flip for v in vehicles]
    return {
        "vehicles": len(vehicles),
        "matched": sum(v.matched for v in vehicles),
        "labelled": labelled,
        "labelled_of_matched": of_matched,
        "found": found,
        "found_in_given_boxes": inside if in_given else None,
        "share_of_all": _ratio(found, labelled),
        "share_of_matched": _ratio(found, of_matched),
        "share_in_given_boxes": _ratio(inside, labelled) if in_given else None,
        "flips": len(kinds) - kinds.count(None),
        "flips_by_kind": {kind: kinds.count(kind) for kind in EXCHANGES},
        "flipped_annotations": {str(v.id): v.flip for v in vehicles if v.flip},
    }


def scene_interval(vehicles: Sequence[Vehicle], rng: np.random.Generator) -> list[float] | None:
    """Return the 90% interval of the share of labelled keypoints that are found, by drawing scenes with replacement."""
    scenes = sorted({v.scene for v in vehicles})
    if not scenes:
        return None
    scene = [scenes.index(v.scene) for v in vehicles]
    found = np.bincount(scene, weights=[v.found for v in vehicles])
    labelled = np.bincount(scene, weights=[v.labelled for v in vehicles])
    drawn = rng.integers(0, len(scenes), (RESAMPLES, len(scenes)))
    shares = found[drawn].sum(axis=1) / labelled[drawn].sum(axis=1)
    return [float(limit) for limit in np.percentile(shares, (5, 95))]


def box_figures(file: AnnotationFile, results: Sequence[Result], score: float) -> Figures:
    """Compute precision and recall of boxes on the images of `file`, whose boxes must be complete.

    An unmatched detection is not counted if at least half of it lies in one ignored region, or if it is lower than
    `LOWEST_PX`.
    """
    matches = matched(file, results)
    hit = matches.taken[IOU] >= 0
    low = np.array([results[i].bbox[3] < LOWEST_PX for i in matches.det_result], dtype=bool)
    counted = hit | ~(low | matches.det_on_ignored)
    shown = matches.det_score >= score
    truth, hits, phantoms = len(matches.vehicles), int((hit & shown).sum()), int((counted & ~hit & shown).sum())
    precision = average_precision(file, [results[i] for i in matches.det_result[hit | ~low]], OPTIONS)
    return {
        "complete_frames": len(file.images),
        "vehicles": truth,
        "hits": hits,
        "phantoms": phantoms,
        "left_out": int((~counted & shown).sum()),
        "ap": precision["box_ap"],
        "ap50": precision["box_ap50"],
        "recall_at_precision": {
            f"{p:.2f}": recall_at_precision(matches.det_score[counted], hit[counted], truth, p)
            for p in METRIC_RULES.at_precision
        },
        "precision": _ratio(hits, hits + phantoms),
        "recall": _ratio(hits, truth),
        "phantoms_a_frame": _ratio(phantoms, len(file.images)),
    }


def _ratio(numerator: int, denominator: int) -> float | None:
    return numerator / denominator if denominator else None


# ------------------------------------------------------------------------------------------------------------ output


def table(metrics: Mapping[str, Any]) -> str:
    """Format the figures in aligned columns, with a row for each scene and each range of heights."""
    rows = [["", "frames", "complete", "vehicles", "AP", "AP50", "R@P.90", "R@P.95", "precision", "recall"]]
    rows[0] += ["phantoms/frame", "matched", "points", "found", "of matched", "in given", "flips"]
    for name, entry in (*metrics["scenes"].items(), ("all", metrics["all"])):
        boxes, at = entry["boxes"], entry["boxes"]["recall_at_precision"]
        rows.append([name, str(entry["images"]), str(boxes["complete_frames"]), str(boxes["vehicles"])])
        shares = (boxes["ap"], boxes["ap50"], *(at[p]["recall"] for p in at), boxes["precision"], boxes["recall"])
        rows[-1] += [*map(_cell, shares), _cell(boxes["phantoms_a_frame"]), *_keypoint_cells(entry["keypoints"])]
    rows += [
        [f"{band} px high", *[""] * 10, *_keypoint_cells(band_figures)]
        for band, band_figures in metrics["heights_px"].items()
    ]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return "\n".join(
        "  ".join([row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:], strict=True))])
        for row in rows
    )


def _keypoint_cells(figures: Mapping[str, Any]) -> list[str]:
    shares = (figures["share_of_all"], figures["share_of_matched"], figures["share_in_given_boxes"])
    return [
        f"{figures['matched']}/{figures['vehicles']}",
        str(figures["labelled"]),
        *map(_cell, shares),
        str(figures["flips"]),
    ]


def _cell(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


def write_sheets(photographs: Photographs, results: Sequence[Result], score: float, out: Path) -> list[Path]:
    """Write sheet_01.jpg and so on, a few photographs each with labels beside predictions; removes older sheets."""
    for old in out.glob("sheet_[0-9][0-9].jpg"):
        old.unlink()
    vehicles, paths = photographs.file.by_image(), []
    images = photographs.file.images
    for number, first in enumerate(range(0, len(images), ROWS), start=1):
        panels = []
        for image in images[first : first + ROWS]:
            pixels = read_image(photographs.source.parent / image.file_name, (image.width, image.height))
            scale = math.ceil(PANEL_PX / image.width)
            found = [r for r in results if r.image_id == image.id and r.score >= score]
            partly = "" if image.id in photographs.complete else ", some boxes only"
            labels = draw.annotations(pixels, vehicles[image.id], scale=scale)
            panels.append(draw.caption(_shrunk(labels), f"labels  {image.file_name} ({image.site}{partly})"))
            answers = draw.results(pixels, found, scale=scale)
            panels.append(draw.caption(_shrunk(answers), f"{len(found)} detections >= {score:g}"))
        paths.append(out / f"sheet_{number:02d}.jpg")
        draw.write(paths[-1], draw.contact_sheet(panels, 2))
    return paths


def _shrunk(pixels: draw.Pixels) -> draw.Pixels:
    size = (PANEL_PX, max(1, round(pixels.shape[0] * PANEL_PX / pixels.shape[1])))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def log_look(path: Path, metrics: Mapping[str, Any]) -> None:
    """Append a line with the time, the input, and the main figures."""
    boxes, points = metrics["all"]["boxes"], metrics["all"]["keypoints"]
    line = {"time": datetime.now(UTC).isoformat(timespec="seconds")}
    line |= {name: metrics[name] for name in ("annotations", "checkpoint", "predictions", "sha256", "score")}
    line |= {name: points[name] for name in ("share_of_all", "share_of_matched", "share_in_given_boxes", "flips")}
    line |= {f"box_{name}": boxes[name] for name in ("ap", "ap50", "precision", "recall", "phantoms_a_frame")}
    line |= {f"box_recall_at_precision_{p}": at["recall"] for p, at in boxes["recall_at_precision"].items()}
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(line, allow_nan=False) + "\n")
    except OSError as error:
        raise UserError(f"{path}: cannot be written: {error.strerror or error}") from error


# ----------------------------------------------------------------------------------------------------------- command


def run(options: argparse.Namespace) -> None:
    """Read, predict, score, write, print."""
    MetricOptions(score=options.score)
    photographs = read_photographs(options.photographs)
    root, out = photographs.source.parent, options.out
    if out.resolve().is_relative_to(root.resolve()):
        raise UserError(f"--out: {out} is inside the photographs' folder {root}, which this script does not change")
    given = weights = None
    if options.checkpoint:
        settings = Settings(device=options.device, backend=options.backend, precision=options.precision)
        predictor = Predictor.load(options.checkpoint, settings, Console())
        predictor.check_scheme(photographs.file.scheme, photographs.source)
        weights = predictor.weights
        claim_folder(options, photographs, predictor.files)
        results = predict(predictor, photographs)
        in_boxes = Predictor.load(weights, replace(settings, given=True), Console(quiet=True))
        given = predict(in_boxes, photographs)
    else:
        results = read_vehicle_results(options.predictions, photographs.file)
        check_places(f"{options.predictions}: results", results)
        claim_folder(options, photographs, [options.predictions])
    metrics = {
        "annotations": str(photographs.source),
        "checkpoint": str(weights) if weights else None,
        "predictions": str(options.predictions) if options.predictions else None,
        "sha256": sha256_of(weights or options.predictions),
        **computed_by(options),
        "score": options.score,
        "detections": len(results),
        **score_photographs(photographs, results, given, options.score),
    }
    log_look(out / "looks.jsonl", metrics)
    write_json(out / "metrics.json", metrics)
    coco.write_results(out / "predictions.json", results)
    sheets = write_sheets(photographs, results, options.score, out)
    print(table(metrics))
    interval = metrics["keypoints_of_all_interval_90"]
    print(f"keypoints found, 90% interval over scenes: {' to '.join(map(_cell, interval)) if interval else '-'}")
    print(f"Wrote metrics.json, predictions.json, looks.jsonl and {len(sheets)} sheets to {out}")


def claim_folder(options: argparse.Namespace, photographs: Photographs, scored: Iterable[Path]) -> None:
    """Claim the output folder; a UserError if it holds other work than that of the labels and the files `scored`."""
    settings = {"score": options.score, **computed_by(options)}
    claim_output(options.out, "score_photographs.py", [photographs.source, *scored], settings)


def computed_by(options: argparse.Namespace) -> dict[str, str | None]:
    """Return the backend and number format of predictions that this script made."""
    if not options.checkpoint:
        return {"backend": None, "number_format": None}
    return {"backend": options.backend, "number_format": options.precision}


def predict(predictor: Predictor, photographs: Photographs) -> tuple[Result, ...]:
    """Predict, rounded as in a results file, so that scoring that file gives the same figures."""
    found = predictor.split(photographs.file, photographs.source.parent)
    return tuple(coco.result_from_dict(coco.result_to_dict(result)) for result in found)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument(
        "photographs", type=Path, metavar="FOLDER", help="folder of the photographs, or their COCO JSON"
    )
    source = parser.add_mutually_exclusive_group(required=True)
    source.add_argument("--checkpoint", type=Path, help="a checkpoint, or the folder of a run")
    source.add_argument("--predictions", type=Path, help="a COCO results file")
    parser.add_argument("--out", type=Path, default=Path("runs/real"))
    parser.add_argument("--device", default="auto", help="auto, cpu, cuda or cuda:N")
    parser.add_argument("--score", type=float, default=0.5, help="lowest score of detections that count")
    parser.add_argument("--backend", choices=BACKEND_CHOICES, default="torch")
    parser.add_argument("--precision", choices=PRECISION_CHOICES, default="float32")
    try:
        run(parser.parse_args())
    except UserError as error:
        parser.exit(2, f"score_photographs: {error}\n")


if __name__ == "__main__":
    main()
