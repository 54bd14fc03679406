"""Scores of the detection and tracking of vehicles in generated footage, against its labels.

    skope gen video t06_plaza_opening --fps 10 --seconds 12 --out footage     # and other sites
    skope eval predict footage/t06_plaza_opening.mp4 --out seen/as_it_is/t06_plaza_opening
    skope eval predict footage/t06_plaza_opening.mp4 --unconfirmed --out seen/unconfirmed/t06_plaza_opening
    python scripts/research/footage_scores.py frames footage seen/as_it_is seen/unconfirmed

    python scripts/research/footage_scores.py tracks footage/SITE.json              # true keypoints with 2 px of noise
    python scripts/research/footage_scores.py tracks footage/SITE.json --predictions seen/predictions.json

`frames`: the first folder holds the labels of `skope gen video`. Each other folder is a mode, with a folder of
`skope eval predict` for each label file. The columns of the table are vehicles (not ignored, in all frames together),
precision, false positives per frame, recall, recall of vehicles in their first second, PCK@0.1 of found vehicles, and
recall at precision 0.90, all at IoU 0.6.

`tracks`: the footage is reduced to each frame rate and tracked by `skope eval track`. A vehicle counts if it is
labelled in at least three frames over at least a second. It counts as tracked if one track covers half of them. HOTA
and IDF1 are computed by TrackEval, if it is installed.
"""

import argparse
import contextlib
import csv
import io
import math
import subprocess
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope import boxes
from skope.dataset import coco
from skope.dataset.folder import PREDICTIONS_FILE
from skope.dataset.image_selection import part
from skope.metrics.keypoint_outcomes import MetricOptions, outcomes_at
from skope.metrics.match import match
from skope.metrics.outcome_counts import ratio
from skope.metrics.pck_precision_recall import ranked, recall_at_precision
from skope.metrics.read_inputs import read_vehicle_results
from skope.pose.keypoint_views import VIEW_ERRORS
from skope.schema import Annotation, AnnotationFile, Result

IOU: Final = 0.6
ALPHA: Final = 0.1
JUST_ENTERED_S: Final = 1.0
"""Time for which a vehicle counts as just entered."""
PRECISION: Final = 0.9
COLUMNS: Final = (
    *("vehicles", "precision", "false positives per frame", "recall", "of those in their first second", "PCK %"),
    f"recall at precision {PRECISION:.2f}",
)


@dataclass(frozen=True)
class Counts:
    """Sums over frames; the counts of several clips can be added."""

    frames: int = 0
    vehicles: int = 0
    found: int = 0
    entering: int = 0
    entering_found: int = 0
    false_positives: int = 0
    labelled: int = 0
    correct: int = 0
    scores: tuple[float, ...] = ()
    """Scores of all detections that count, including low ones."""
    hits: tuple[bool, ...] = ()
    """Whether each of these detections is a vehicle."""

    def __add__(self, other: "Counts") -> "Counts":
        return Counts(*(getattr(self, field.name) + getattr(other, field.name) for field in fields(self)))

    def cells(self) -> list[str]:
        """Return the cells of `COLUMNS`."""
        shares = (
            ratio(self.found, self.found + self.false_positives),
            ratio(self.false_positives, self.frames),
            ratio(self.found, self.vehicles),
            ratio(self.entering_found, self.entering),
        )
        pck = ratio(100 * self.correct, self.labelled)
        at = recall_at_precision(np.array(self.scores), np.array(self.hits, dtype=bool), self.vehicles, PRECISION)
        return [str(self.vehicles), *(_text(share, 3) for share in shares), _text(pck, 1), _text(at["recall"], 3)]


def count(truth: AnnotationFile, results: Sequence[Result], score: float = 0.0) -> Counts:
    """Compare the detections with scores above `score` with the labels, in each frame of a clip."""
    everything = match(truth, results, score=0.0, thresholds=(IOU,))
    scores, hits = ranked(everything, IOU)
    matches = match(truth, results, score=score, thresholds=(IOU,)) if score else everything
    outcomes = outcomes_at(matches, IOU, MetricOptions())
    times = np.array([image.time_s or 0.0 for image in truth.images])[matches.gt_image]
    tracks = np.array([vehicle.track_id for vehicle in matches.vehicles])
    first = {track: times[tracks == track].min() for track in set(tracks.tolist())}
    entered = np.array([first[track] for track in tracks.tolist()])
    begin = min((image.time_s or 0.0 for image in truth.images), default=0.0)
    # A vehicle that is present when the clip begins has not just entered.
    entering = (times - entered < JUST_ENTERED_S) & (entered > begin)
    found = outcomes.found
    return Counts(
        frames=len(truth.images),
        vehicles=len(found),
        found=int(found.sum()),
        entering=int(entering.sum()),
        entering_found=int((entering & found).sum()),
        false_positives=int(((matches.taken[IOU] < 0) & ~matches.det_on_ignored).sum()),
        labelled=int(outcomes.labelled[found].sum()),
        correct=int(outcomes.correct(ALPHA)[found].sum()),
        scores=tuple(scores.tolist()),
        hits=tuple(hits.tolist()),
    )


def rows(labels: Sequence[Path], modes: Sequence[Path]) -> Iterator[list[str]]:
    """Yield a row for each clip and mode, then one over all clips for each mode."""
    sums = dict.fromkeys(modes, Counts())
    for path in labels:
        truth = coco.read(path)
        for mode in modes:
            clip_counts = count(truth, read_vehicle_results(mode / path.stem / PREDICTIONS_FILE, truth))
            sums[mode] += clip_counts
            yield [path.stem, str(mode), *clip_counts.cells()]
    for mode, total in sums.items():
        yield ["all", str(mode), *total.cells()]


def _text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


NOISE_PX = 2.0
FEWEST, LEAST_S = 3, 1.0
SLOW = 2.0
"""Lowest speed, m/s, at which relative errors are meaningful."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """Tracks at one frame rate, compared with the truth."""

    vehicles: int
    tracked: int
    switches: int
    tracks: int
    speed: Sequence[float]
    """|error| / speed of each vehicle and frame, for vehicles faster than `SLOW`."""
    in_sigmas: Sequence[float]
    """|error| of these speeds over the standard deviation in tracks.csv; the median is 0.67 if those are right."""
    heading: Sequence[float]
    """|error| of the heading of each vehicle and frame, degrees."""
    scores: dict[str, float]
    """TrackEval's metrics by name."""


def thinned(
    file: AnnotationFile, results: Sequence[Result] | None, fps: float
) -> tuple[AnnotationFile, list[Result] | None]:
    """Reduce the frame rate; returns the images with their annotations, and the results."""
    times = [image.time_s for image in file.images]
    if any(time is None for time in times):
        sys.exit(f"{file.name}: its images have no times")
    full = 1 / float(np.median(np.diff(np.array(times, dtype=float))))
    images = file.images[:: max(1, round(full / fps))]
    ids = {image.id for image in images}
    kept = part(file, images)
    return kept, None if results is None else [r for r in results if r.image_id in ids]


def measure(file: AnnotationFile, results: list[Result] | None, folder: Path) -> Row:
    coco.write(folder / "truth.json", file)
    command = [sys.executable, "-m", "skope", "eval", "track", "--annotations", str(folder / "truth.json")]
    if results is None:
        command += ["--noise", str(NOISE_PX)]
    else:
        coco.write_results(folder / "found.json", results)
        command += ["--predictions", str(folder / "found.json")]
    subprocess.run(
        [*command, "--ground", "0", "--out", str(folder / "tracks"), "-q"], check=True, stdout=subprocess.DEVNULL
    )
    return judged(file, folder)


def judged(file: AnnotationFile, folder: Path) -> Row:
    """Compare the output of `skope eval track` with the truth, box by box."""
    poses = {
        (r["track"], r["frame"]): r for r in csv.DictReader((folder / "tracks" / "tracks.csv").read_text().splitlines())
    }
    seen: dict[int, list[tuple[str, Any]]] = defaultdict(list)
    for line in (folder / "tracks" / "mot.txt").read_text().splitlines():
        frame, number, *box = line.split(",")[:6]
        seen[int(frame) - 1].append((number, np.array(box, dtype=float)))
    tracks_of: dict[int, list[str | None]] = defaultdict(list)
    times: dict[int, list[float]] = defaultdict(list)
    speed, in_sigmas, heading = [], [], []
    labelled = file.by_image()
    for at, image in enumerate(file.images):
        truth = [a for a in labelled[image.id] if not a.ignored and a.track_id is not None]
        taken = matched(truth, seen[at])
        for vehicle in truth:
            assert vehicle.track_id is not None
            assert image.time_s is not None
            number = taken.get(vehicle.id)
            tracks_of[vehicle.track_id].append(number)
            times[vehicle.track_id].append(image.time_s)
            row = poses.get((number, str(image.frame_index))) if number else None
            if row is None or vehicle.velocity is None or vehicle.box_3d is None:
                continue
            real = float(np.linalg.norm(vehicle.velocity))
            if real >= SLOW:
                error = abs(float(row["speed"]) - real)
                speed.append(error / real)
                in_sigmas.append(error / float(row["sigma_speed"]))
            turn = math.radians(float(row["heading_deg"])) - vehicle.box_3d.yaw
            heading.append(abs(math.degrees((turn + math.pi) % (2 * math.pi) - math.pi)))
    counted = [v for v in tracks_of if len(tracks_of[v]) >= FEWEST and times[v][-1] - times[v][0] >= LEAST_S]
    numbers = {v: [n for n in tracks_of[v] if n is not None] for v in counted}
    return Row(
        vehicles=len(counted),
        tracked=sum(Counter(numbers[v]).most_common(1)[0][1] >= len(tracks_of[v]) / 2 for v in counted if numbers[v]),
        switches=sum(a != b for v in counted for a, b in zip(numbers[v], numbers[v][1:], strict=False)),
        tracks=len({number for number, _ in poses}),
        speed=speed,
        in_sigmas=in_sigmas,
        heading=heading,
        scores=trackeval_scores(folder, len(file.images)),
    )


def matched(truth: Sequence[Annotation], found: Sequence[tuple[str, Any]]) -> dict[int, str]:
    """Return the track of each annotation by its id, best overlaps first."""
    if not truth or not found:
        return {}
    overlap = boxes.iou(
        boxes.xywh_to_xyxy(np.array([a.bbox for a in truth])), boxes.xywh_to_xyxy(np.array([box for _, box in found]))
    )
    out: dict[int, str] = {}
    for index in np.argsort(-overlap, axis=None):
        t, f = divmod(int(index), len(found))
        if overlap[t, f] < VIEW_ERRORS.match_iou:
            break
        if truth[t].id not in out and found[f][0] not in out.values():
            out[truth[t].id] = found[f][0]
    return out


def trackeval_scores(folder: Path, frames: int) -> dict[str, float]:
    """Compute HOTA and IDF1 of MotChallenge2DBox; empty if TrackEval is not installed."""
    try:
        import trackeval  # type: ignore[import-not-found]
    except ImportError:
        return {}
    gt, tracker = folder / "gt" / "site" / "gt", folder / "trackers" / "skope" / "data"
    for path, name, source in ((gt, "gt.txt", "mot_truth.txt"), (tracker, "site.txt", "mot.txt")):
        path.mkdir(parents=True)
        (path / name).write_text((folder / "tracks" / source).read_text())
    (gt.parent / "seqinfo.ini").write_text(f"[Sequence]\nname=site\nseqLength={frames}\n")
    with contextlib.redirect_stdout(io.StringIO()):
        data = trackeval.datasets.MotChallenge2DBox(
            {
                **{
                    "GT_FOLDER": str(folder / "gt"),
                    "TRACKERS_FOLDER": str(folder / "trackers"),
                    "SKIP_SPLIT_FOL": True,
                },
                **{"SEQ_INFO": {"site": frames}, "DO_PREPROC": False, "PRINT_CONFIG": False},
            }
        )
        quiet = dict.fromkeys(("PRINT_RESULTS", "PRINT_CONFIG", "TIME_PROGRESS", "DISPLAY_LESS_PROGRESS"), False)
        files = dict.fromkeys(("OUTPUT_SUMMARY", "OUTPUT_DETAILED", "PLOT_CURVES", "OUTPUT_EMPTY_CLASSES"), False)
        metrics = [trackeval.metrics.HOTA(), trackeval.metrics.Identity({"PRINT_CONFIG": False})]
        answer, _ = trackeval.Evaluator({**quiet, **files, "USE_PARALLEL": False}).evaluate([data], metrics)
    whole = answer["MotChallenge2DBox"]["skope"]["COMBINED_SEQ"]["pedestrian"]
    return {"HOTA": float(np.mean(whole["HOTA"]["HOTA"])), "IDF1": float(whole["Identity"]["IDF1"])}


def frames_table(options: argparse.Namespace) -> None:
    """Print a row for each clip and mode."""
    print("| " + " | ".join(("clip", "mode", *COLUMNS)) + " |", "|---" * (len(COLUMNS) + 2) + "|", sep="\n")
    for row in rows(sorted(options.labels.glob("*.json")), options.modes):
        print("| " + " | ".join(row) + " |")


def tracks_table(options: argparse.Namespace) -> None:
    """Print a row for each frame rate."""
    file = coco.read(options.footage)
    results = coco.read_results(options.predictions) if options.predictions else None
    if results is not None:
        last = max((result.image_id for result in results), default=0)
        file = part(file, [image for image in file.images if image.id <= last])
    print("  fps  tracked  tracks  switches   speed error       in its sigma    heading error, deg   HOTA   IDF1")
    for fps in map(float, options.fps.split(",")):
        with tempfile.TemporaryDirectory() as folder:
            row = measure(*thinned(file, results, fps), Path(folder))
        cells = [
            f"{np.median(v):.3g} ({np.percentile(v, 90):.3g})" if v else "-"
            for v in (row.speed, row.in_sigmas, row.heading)
        ]
        names = "".join(f"{row.scores[name]:7.3f}" if name in row.scores else "      -" for name in ("HOTA", "IDF1"))
        tracked = f"{row.tracked:3d}/{row.vehicles:<3d}  {row.tracks:6d}  {row.switches:8d}"
        print(f"{fps:5g}  {tracked}  {cells[0]:>14} {cells[1]:>18} {cells[2]:>18}  {names}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    frames = commands.add_parser("frames", help="score vehicles in each frame, by mode of the detector")
    frames.add_argument("labels", type=Path, help="folder of the labels of `skope gen video`")
    frames.add_argument("modes", type=Path, nargs="+", help="folders that contain folders of `skope eval predict`")
    frames.set_defaults(run=frames_table)
    tracks = commands.add_parser("tracks", help="score tracks, by frame rate")
    tracks.add_argument("footage", type=Path, help="annotation file of `skope gen video`")
    tracks.add_argument("--predictions", type=Path, help="COCO results for its images, instead of noisy labels")
    tracks.add_argument("--fps", default="25,10,5,2.5,2", help="frame rates, separated by commas")
    tracks.set_defaults(run=tracks_table)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
