"""Counts at gates of generated clips against the truth: coverage of intervals, and the rates that they are made from.

    python scripts/research/gate_coverage.py clips/* --out coverage.json               # clips of traffic_clips.py
    python scripts/research/gate_coverage.py clips/* --out coverage.json --true-keypoints
    python scripts/research/gate_coverage.py --fit coverage.json --rates skope/traffic/crossing_rates.json

Each clip is measured in several ways: gates in metres and in the image, a camera from eight marked points and one
from vehicles, and every folder of detections (seen*) of the clip. The truth comes from the simulation. A true crossing
counts if a pixel of the vehicle is visible within half a second of it. Coverage has a bootstrap over clips.
"""

import argparse
import itertools
import json
import math
import re
import subprocess
import sys
import zlib
from collections import defaultdict
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from camera_calibration import points
from scipy.optimize import minimize
from scipy.special import betaln, gammaln
from traffic_clips import LABELS, NOISE_PX, SITE, read_truth

from skope.dataset import coco
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.files.json_files import read_json, write_json
from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.site.site_file import SiteFile, read_site
from skope.site.traffic_settings import OF_VEHICLES
from skope.tracking.image_trajectories import read_image_trajectories
from skope.tracks.csv_file import TRACKS_CSV, read_tracks
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.event_probability import crossing_doubts, usual_step
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.image_counts import count_in_image
from skope.traffic.measure import measure
from skope.traffic.observation import FOOTAGE_FILE, Observation, read_observation
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array

VISIBLE_S: Final = 0.5
"""A true crossing counts if a pixel of the road user is visible within this time of it, seconds."""
SAME_S: Final = 2.0
"""Largest time between a counted crossing and the true one of its gate and direction, seconds."""
MARKED: Final = 8
"""Number of marked points for a camera from points, each with the errors of `camera_calibration.points`."""
PRIOR_SIGMA: Final = 1.0
"""Prior standard deviation of the logarithms of the Beta parameters, around those of the rates' file."""
DRAWS: Final = 2000
EVER: Final = ClockInterval(begin_s=-math.inf, end_s=math.inf, begin=None, end=None)
Row = dict[str, Any]


def run_skope(*words: str) -> bool:
    """Run a command of skope; returns whether it succeeded."""
    return (
        subprocess.run([sys.executable, "-m", "skope", *words, "-q"], check=False, capture_output=True).returncode == 0
    )


def drawn_site(folder: Path) -> SiteFile:
    """Return the clip's site with its gates drawn in the image by the true camera."""
    site = read_site(folder / SITE)
    camera = coco.read(folder / LABELS).images[0].camera
    assert camera is not None

    def drawn(gate: Gate) -> Gate:
        pixels, _, _ = camera.project(np.column_stack([np.array(gate.line), np.zeros(2)]))
        (a, b), (c, d) = pixels.tolist()
        return replace(gate, pixels=((a, b), (c, d)), size=(camera.width, camera.height))

    return replace(site, gates=tuple(map(drawn, site.gates)))


def camera_from_points(folder: Path) -> Path | None:
    """Compute a camera file from `MARKED` points of the road with marking errors; None if the camera is rejected."""
    found, table = folder / "camera_points.json", folder / "points.csv"
    if not found.is_file():
        camera = coco.read(folder / LABELS).images[0].camera
        assert camera is not None
        marks = points(camera, MARKED, np.random.default_rng(zlib.crc32(folder.name.encode())))
        rows = [",".join(f"{value:.3f}" for value in (*mark.pixel, *mark.place)) for mark in marks]
        write_text(table, "\n".join(["column,row,x,y,z", *rows]) + "\n")
        size = f"{camera.width}x{camera.height}"
        if not run_skope("eval", "camera", "--points", str(table), "--size", size, "--out", str(found)):
            return None
    return found


def reports(folder: Path, *, true_keypoints: bool) -> Iterator[tuple[str, TrafficReport]]:
    """Measure the clip's traffic in every possible way; yields the name of each way and its report."""
    site, labels = drawn_site(folder), str(folder / LABELS)
    surveyed = replace(site, gates=tuple(replace(gate, pixels=()) for gate in site.gates))
    ways = [("keypoints", ["--annotations", labels, "--noise", NOISE_PX])] if true_keypoints else []
    seen = [] if true_keypoints else sorted(path.parent for path in folder.glob("seen*/predictions.json"))
    for detections in seen:
        try:
            tracks, observation, _ = read_image_trajectories(detections)
            yield f"{detections.name} image", count_in_image(tracks, observation, site)
        except UserError as error:  # footage with a low frame rate has no tracks in the image
            print(error)
        found = folder / f"camera_{detections.name}.json"
        if found.is_file() or run_skope("eval", "camera", str(detections), "--out", str(found)):
            ways.append((f"{detections.name} vehicles", [str(detections), "--camera", str(found)]))
        marked = camera_from_points(folder)
        if marked:
            ways.append((f"{detections.name} points", [str(detections), "--camera", str(marked)]))
    for name, words in ways:
        out = folder / "tracks" / name.replace(" ", "_")
        if not (out / FOOTAGE_FILE).is_file() and not run_skope(
            "eval", "track", *words, "--ground", "0", "--out", str(out)
        ):
            print(f"{folder.name}: {name}: tracking failed")
            continue
        observation, tracks = read_observation(out), read_tracks(out / TRACKS_CSV)
        yield f"{name} drawn", measure(tracks, observation, site)
        if not name.endswith("vehicles"):  # a camera from vehicles has a world of its own
            yield f"{name} surveyed", measure(tracks, observation, surveyed)


def true_crossings(folder: Path) -> list[GateCrossing]:
    """Return the crossings of visible road users, with exact positions."""
    truth, file = read_truth(folder), coco.read(folder / LABELS)
    visible: dict[int, list[float]] = defaultdict(list)
    times = {image.id: float(image.time_s or 0.0) for image in file.images}
    for label in (*file.annotations, *file.road_users):
        if label.track_id is not None:
            visible[label.track_id].append(times[label.image_id])
    found = measure(
        truth.trajectories, Observation(times_s=truth.times_s), read_site(folder / SITE), broken=False
    ).crossings
    return [
        crossing
        for crossing in found
        if any(abs(t - crossing.time_s) <= VISIBLE_S for t in visible.get(crossing.trajectory.number, ()))
    ]


def paired(counted: Sequence[GateCrossing], real: Sequence[GateCrossing]) -> set[int]:
    """Return the indices of the counted crossings that are true ones; each true one is used at most once."""
    pairs = []
    for j, crossing in enumerate(counted):
        for i, true_crossing in enumerate(real):
            late = abs(crossing.time_s - true_crossing.time_s)
            if (crossing.gate, crossing.direction) != (true_crossing.gate, true_crossing.direction) or late > SAME_S:
                continue
            pairs.append((late, j, i))
    taken, out = set[int](), set[int]()
    for _, j, i in sorted(pairs):
        if j not in out and i not in taken:
            out.add(j)
            taken.add(i)
    return out


def rows_of(folder: Path, *, true_keypoints: bool) -> Iterator[Row]:
    """Yield a row per clip, way, gate and direction: vehicles counted and true, the interval, and each crossing."""
    real = [crossing for crossing in true_crossings(folder) if crossing.trajectory.category == VEHICLE_CATEGORY]
    for way, report in reports(folder, true_keypoints=true_keypoints):
        step_s = usual_step(report.trajectories)
        every = [
            crossing
            for crossing in (*report.crossings, *report.unseen.doubtful)
            if crossing.trajectory.category == VEHICLE_CATEGORY
        ]
        happened = paired(every, real)
        totals = {(row.gate, row.direction): row for row in report.counts_total if row.class_name in ("vehicle", "all")}
        for gate in report.gates:
            for k, name in enumerate(direction_names(gate)):
                total = totals[gate.name, name]
                side_crossings = [
                    (j, crossing)
                    for j, crossing in enumerate(every)
                    if (crossing.gate, crossing.direction) == (gate.name, k)
                ]
                lost = report.unseen.most(gate.name, k, EVER, OF_VEHICLES)
                true = sum((crossing.gate, crossing.direction) == (gate.name, k) for crossing in real)
                yield {
                    "clip": folder.name,
                    "site": read_json(folder / "clip.json").get("site", folder.name),
                    "way": way,
                    "side": f"{gate.name} {name}",
                    "minutes": report.observation.observed_s / 60,
                    "truth": true,
                    "count": sum(crossing.is_counted for _, crossing in side_crossings),
                    "low": total.confidence_interval.low if total.confidence_interval else None,
                    "high": total.confidence_interval.high if total.confidence_interval else None,
                    "lost": lost,
                    "crossings": [
                        {
                            "doubts": crossing_doubts(crossing.trajectory, crossing.time_s, step_s),
                            "probability": round(crossing.probability, 4),
                            "counts": crossing.is_counted,
                            "real": j in happened,
                            "flags": list(crossing.trajectory.flags),
                        }
                        for j, crossing in side_crossings
                    ],
                }


# ------------------------------------------------------------------------------------------------------------ fitting


def fitted(rows: Sequence[Row], kind: str, counted: Sequence[int], prior: Mapping[str, Any]) -> dict[str, Any]:
    """Update the rates of one kind of gates with the measured rows.

    Args:
        rows: The rows of the clips.
        kind: "image" or "metres".
        counted: Manual counts of real footage, in which nothing was missed or counted wrongly.
        prior: Earlier `real` (by number of doubts, as trials), `missed` and `came`.

    Returns:
        The updated `real`, `missed` and `came`.
    """
    gate_rows = [row for row in rows if ("image" in row["way"]) == (kind == "image")]
    real = [list(trials) for trials in prior["real"]]
    real[0] = [real[0][0] + sum(counted), real[0][1] + sum(counted)]
    for row in gate_rows:
        for crossing in row["crossings"]:
            if not crossing["flags"]:
                real[crossing["doubts"]][0] += crossing["real"]
                real[crossing["doubts"]][1] += 1
    sides = [
        (row["truth"], max(0, row["truth"] - sum(crossing["real"] for crossing in row["crossings"])), row["lost"])
        for row in gate_rows
        if row["high"] is not None
    ]
    sides += [(number, 0, 0) for number in counted]
    missed, came = beta_binomials(sides, (*prior["missed"], *prior["came"]))
    return {"real": real, "missed": missed, "came": came}


def beta_binomials(sides: Sequence[tuple[int, int, int]], prior: Sequence[float]) -> tuple[list[float], list[float]]:
    """Fit two Beta distributions: of crossings missed without a trace, and of lost tracks that did cross.

    Args:
        sides: By gate and direction: true number, true crossings that were not counted, tracks that were lost there.
        prior: The four parameters before.
    """
    middle = np.log(np.asarray(prior))

    def log_pmf(k: Array, n: int, a: float, b: float) -> Array:
        return np.asarray(
            gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1) + betaln(k + a, n - k + b) - betaln(a, b)
        )

    def loss(logs: Array) -> float:
        a, b, c, d = np.exp(logs)
        total = 0.5 * float((((logs - middle) / PRIOR_SIGMA) ** 2).sum())
        for true, uncounted, lost in sides:
            k = np.arange(min(uncounted, lost) + 1, dtype=float)
            log_terms = log_pmf(k, lost, c, d) + np.array(
                [float(log_pmf(uncounted - crossed, true - int(crossed), a, b)) for crossed in k]
            )
            total -= float(np.logaddexp.reduce(log_terms))
        return total

    best = np.exp(minimize(loss, middle, method="Nelder-Mead", options={"maxiter": 4000}).x)
    return [round(float(v), 3) for v in best[:2]], [round(float(v), 3) for v in best[2:]]


def compact(document: Mapping[str, Any]) -> str:
    """Format a document as JSON, with lists of numbers on one line each."""
    lists = re.compile(r"\[\s+([^\[\]]*?)\s+\]")
    text = json.dumps(document, indent=1)
    return lists.sub(lambda found: f"[{', '.join(part.strip() for part in found[1].split(','))}]", text) + "\n"


def print_coverage(rows: Sequence[Row]) -> None:
    """Print the coverage by way, with a bootstrap over clips, and the reliability of the crossing probability."""
    rng = np.random.default_rng(0)
    for way in sorted({row["way"] for row in rows}):
        every_side = [row for row in rows if row["way"] == way]
        with_interval = [row for row in every_side if row["high"] is not None]
        if not with_interval:
            continue
        clips = sorted({row["clip"] for row in with_interval})
        inside = {
            c: [row["low"] <= row["truth"] <= row["high"] for row in with_interval if row["clip"] == c] for c in clips
        }
        every = [v for c in clips for v in inside[c]]
        drawn = [np.mean([v for c in rng.choice(clips, len(clips)) for v in inside[str(c)]]) for _ in range(DRAWS)]
        busy = [row for row in with_interval if row["count"] >= 5]
        width = np.mean([(row["high"] - row["low"]) / row["count"] for row in busy]) if busy else math.nan
        minutes = sum(row["minutes"] for row in with_interval if row["truth"] >= 5)
        out = sum(not row["low"] <= row["count"] <= row["high"] for row in with_interval)
        off = sum(abs(row["count"] - row["truth"]) for row in with_interval)
        low, high = np.quantile(drawn, (0.05, 0.95))
        counted, true = (sum(row[name] for row in with_interval) for name in ("count", "truth"))
        print(
            f"{way:28} sides {len(with_interval):4} of {len(every_side):4} "
            f"covered {np.mean(every):.3f} ({low:.3f} to {high:.3f}) "
            f"counted {counted} of {true}, off by {off}; width/count {width:.2f}; "
            f"busy gate-minutes {minutes:.0f}; count outside {out}"
        )
    print("probability of a crossing: stated, real, number")
    every_crossing = [crossing for row in rows for crossing in row["crossings"]]
    bounds = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.01)
    for low, high in itertools.pairwise(bounds):
        in_bin = [crossing for crossing in every_crossing if low <= crossing["probability"] < high]
        if in_bin:
            stated, real = (float(np.mean([crossing[name] for crossing in in_bin])) for name in ("probability", "real"))
            print(f"  {low:.2f} to {high:.2f}: {stated:.3f} {real:.3f} {len(in_bin)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="*")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--fit", type=Path, nargs="*", help="fit the rates to these files of --out")
    parser.add_argument("--rates", type=Path, help="crossing_rates.json to update")
    parser.add_argument(
        "--true-keypoints", action="store_true", help="use labels with 2 px of noise instead of detections"
    )
    options = parser.parse_args()
    if options.fit:
        rows = [row for path in options.fit for row in read_json(path)["rows"]]
        rates = read_json(options.rates)
        for kind in ("metres", "image"):
            rates_of_kind = rates["metres"]["vehicle"] if kind == "metres" else rates["image"]
            prior = rates["provenance"]["prior"][kind]
            found = fitted(rows, kind, rates["provenance"]["manual_counts"][kind], prior)
            rates[kind]["real"]["vehicle"] = found["real"]
            rates_of_kind["missed"], rates_of_kind["came"] = found["missed"], found["came"]
            print(kind, found)
        rates["provenance"]["fitted_on"] = sorted({row["clip"] for row in rows})
        write_text(options.rates, compact(rates))
        print_coverage(rows)
        return
    folders = [path for path in options.clips if (path / "clip.json").is_file()]
    rows = [row for folder in folders for row in rows_of(folder, true_keypoints=options.true_keypoints)]
    if options.out:
        write_json(options.out, {"rows": rows})
    print_coverage(rows)


if __name__ == "__main__":
    main()
