"""How tracks of footage with a known truth depend on the frame rate: what is followed, how exactly, under one name.

    skope gen video SITE --fps 25 --seconds 30 --out footage
    python scripts/research/track_rates.py footage/SITE.json              # true keypoints with 2 px of noise
    python scripts/research/track_rates.py footage/SITE.json --predictions seen/predictions.json

The footage is thinned to each rate and followed by `skope eval track`; what it writes is held against the truth. A
vehicle counts where it is labelled in three frames or more, over a second or more; it is tracked when one track has it
in half of them. HOTA and IDF1 are TrackEval's where that is installed.
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
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from skope import boxes
from skope.dataset import coco
from skope.pose.keypoint_views import VIEW_ERRORS
from skope.schema import Annotation, AnnotationFile, Result

NOISE_PX = 2.0
FEWEST, LEAST_S = 3, 1.0
SLOW = 2.0
"""Speed, m/s, from which relative errors mean something."""


@dataclass(frozen=True, kw_only=True)
class Row:
    """What came out at one frame rate."""

    vehicles: int
    tracked: int
    switches: int
    tracks: int
    speed: Sequence[float]
    """|error| / speed of every vehicle and frame, of vehicles faster than `SLOW`."""
    in_sigmas: Sequence[float]
    """|error| of these speeds in the deviations that tracks.csv states: 0.67 in the median where those are right."""
    heading: Sequence[float]
    """Degrees."""
    scores: dict[str, float]
    """TrackEval's, by name."""


def thinned(
    file: AnnotationFile, results: Sequence[Result] | None, fps: float
) -> tuple[AnnotationFile, list[Result] | None]:
    """Every so many-th image, with what belongs to it."""
    times = [image.time_s for image in file.images]
    if any(time is None for time in times):
        sys.exit(f"{file.name}: its images carry no times")
    full = 1 / float(np.median(np.diff(np.array(times, dtype=float))))
    images = file.images[:: max(1, round(full / fps))]
    ids = {image.id for image in images}
    kept = replace(file, images=images, annotations=tuple(a for a in file.annotations if a.image_id in ids))
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
    """What `skope eval track` wrote against the truth, box by box."""
    poses = {
        (r["track"], r["frame"]): r for r in csv.DictReader((folder / "tracks" / "tracks.csv").read_text().splitlines())
    }
    seen: dict[int, list[tuple[str, Any]]] = defaultdict(list)
    for line in (folder / "tracks" / "mot.txt").read_text().splitlines():
        frame, number, *box = line.split(",")[:6]
        seen[int(frame) - 1].append((number, np.array(box, dtype=float)))
    who: dict[int, list[str | None]] = defaultdict(list)
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
            who[vehicle.track_id].append(number)
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
    counted = [v for v in who if len(who[v]) >= FEWEST and times[v][-1] - times[v][0] >= LEAST_S]
    numbers = {v: [n for n in who[v] if n is not None] for v in counted}
    return Row(
        vehicles=len(counted),
        tracked=sum(Counter(numbers[v]).most_common(1)[0][1] >= len(who[v]) / 2 for v in counted if numbers[v]),
        switches=sum(a != b for v in counted for a, b in zip(numbers[v], numbers[v][1:], strict=False)),
        tracks=len({number for number, _ in poses}),
        speed=speed,
        in_sigmas=in_sigmas,
        heading=heading,
        scores=trackeval_scores(folder, len(file.images)),
    )


def matched(truth: Sequence[Annotation], found: Sequence[tuple[str, Any]]) -> dict[int, str]:
    """Track by annotation id, best overlaps first."""
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
    """HOTA and IDF1 of MotChallenge2DBox, or nothing where TrackEval is not installed."""
    try:
        import trackeval  # type: ignore[import-not-found]
    except ImportError:
        return {}
    gt, own = folder / "gt" / "site" / "gt", folder / "trackers" / "skope" / "data"
    for path, name, source in ((gt, "gt.txt", "mot_truth.txt"), (own, "site.txt", "mot.txt")):
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


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("footage", type=Path, help="annotation file of `skope gen video`")
    parser.add_argument("--predictions", type=Path, help="COCO results for its images, in place of noisy labels")
    parser.add_argument("--fps", default="25,10,5,2.5,2", help="frame rates, separated by commas")
    options = parser.parse_args()
    file = coco.read(options.footage)
    results = coco.read_results(options.predictions) if options.predictions else None
    if results is not None:
        last = max((result.image_id for result in results), default=0)
        file = replace(file, images=tuple(image for image in file.images if image.id <= last))
        ids = {image.id for image in file.images}
        file = replace(file, annotations=tuple(a for a in file.annotations if a.image_id in ids))
    print("  fps  tracked  tracks  switches   speed error       in its sigma    heading error, deg   HOTA   IDF1")
    for fps in map(float, options.fps.split(",")):
        with tempfile.TemporaryDirectory() as folder:
            row = measure(*thinned(file, results, fps), Path(folder))
        told = [
            f"{np.median(v):.3g} ({np.percentile(v, 90):.3g})" if v else "-"
            for v in (row.speed, row.in_sigmas, row.heading)
        ]
        names = "".join(f"{row.scores[name]:7.3f}" if name in row.scores else "      -" for name in ("HOTA", "IDF1"))
        followed = f"{row.tracked:3d}/{row.vehicles:<3d}  {row.tracks:6d}  {row.switches:8d}"
        print(f"{fps:5g}  {followed}  {told[0]:>14} {told[1]:>18} {told[2]:>18}  {names}")


if __name__ == "__main__":
    main()
