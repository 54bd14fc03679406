"""Counts at gates of generated clips against the truth: coverage of intervals, and the rates that they are made from.

    python scripts/research/gate_coverage.py clips/* --out coverage.json               # clips of traffic_clips.py
    python scripts/research/gate_coverage.py clips/* --out coverage.json --true-keypoints
    python scripts/research/gate_coverage.py --fit coverage.json --rates skope/traffic/crossing_rates.json

Each clip is measured in several ways: gates in metres and in the image, a camera from eight marked points and one
from vehicles, and every folder of detections (seen*) of the clip. The truth is the simulation's. A true crossing
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
"""A counted crossing is the true one of its gate and direction that is nearest in time, within this, seconds."""
MARKED: Final = 8
"""Points that are marked for a camera from points, each with the errors of `camera_calibration.points`."""
PRIOR_SIGMA: Final = 1.0
"""The parameters of Beta distributions are known to this before, in logarithms, around those of the rates' file."""
DRAWS: Final = 2000
EVER: Final = ClockInterval(begin_s=-math.inf, end_s=math.inf, begin=None, end=None)
Row = dict[str, Any]


def run_skope(*words: str) -> bool:
    """Run a command of skope; whether it succeeded."""
    return (
        subprocess.run([sys.executable, "-m", "skope", *words, "-q"], check=False, capture_output=True).returncode == 0
    )


def drawn_site(folder: Path) -> SiteFile:
    """The clip's site with its gates drawn in the image as the true camera shows them."""
    site = read_site(folder / SITE)
    camera = coco.read(folder / LABELS).images[0].camera
    assert camera is not None

    def drawn(gate: Gate) -> Gate:
        pixels, _, _ = camera.project(np.column_stack([np.array(gate.line), np.zeros(2)]))
        (a, b), (c, d) = pixels.tolist()
        return replace(gate, pixels=((a, b), (c, d)), size=(camera.width, camera.height))

    return replace(site, gates=tuple(map(drawn, site.gates)))


def camera_from_points(folder: Path) -> Path | None:
    """The camera file that `MARKED` points of the road give, marked with errors; None if it is rejected."""
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
    """The clip's traffic, measured in every way that there is for it, each with a name."""
    site, labels = drawn_site(folder), str(folder / LABELS)
    surveyed = replace(site, gates=tuple(replace(gate, pixels=()) for gate in site.gates))
    ways = [("keypoints", ["--annotations", labels, "--noise", NOISE_PX])] if true_keypoints else []
    seen = [] if true_keypoints else sorted(path.parent for path in folder.glob("seen*/predictions.json"))
    for detections in seen:
        try:
            tracks, observation, _ = read_image_trajectories(detections)
            yield f"{detections.name} image", count_in_image(tracks, observation, site)
        except UserError as error:  # footage of few frames a second has no tracks in the image
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
            print(f"{folder.name}: {name}: not tracked")
            continue
        observation, tracks = read_observation(out), read_tracks(out / TRACKS_CSV)
        yield f"{name} drawn", measure(tracks, observation, site)
        if not name.endswith("vehicles"):  # those of vehicles have a world of their own
            yield f"{name} surveyed", measure(tracks, observation, surveyed)


def true_crossings(folder: Path) -> list[GateCrossing]:
    """The crossings of visible road users, with exact positions."""
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
        one for one in found if any(abs(t - one.time_s) <= VISIBLE_S for t in visible.get(one.trajectory.number, ()))
    ]


def paired(told: Sequence[GateCrossing], real: Sequence[GateCrossing]) -> set[int]:
    """Indices of the counted crossings that are true ones, each true one at most once."""
    pairs = []
    for j, one in enumerate(told):
        for i, other in enumerate(real):
            late = abs(one.time_s - other.time_s)
            if (one.gate, one.direction) != (other.gate, other.direction) or late > SAME_S:
                continue
            pairs.append((late, j, i))
    taken, out = set[int](), set[int]()
    for _, j, i in sorted(pairs):
        if j not in out and i not in taken:
            out.add(j)
            taken.add(i)
    return out


def rows_of(folder: Path, *, true_keypoints: bool) -> Iterator[Row]:
    """A row per clip, way, gate and direction: vehicles counted and true, the interval, and each crossing."""
    real = [one for one in true_crossings(folder) if one.trajectory.category == VEHICLE_CATEGORY]
    for way, report in reports(folder, true_keypoints=true_keypoints):
        step_s = usual_step(report.trajectories)
        every = [
            one for one in (*report.crossings, *report.unseen.doubtful) if one.trajectory.category == VEHICLE_CATEGORY
        ]
        happened = paired(every, real)
        totals = {(one.gate, one.direction): one for one in report.counts_total if one.class_name in ("vehicle", "all")}
        for gate in report.gates:
            for k, name in enumerate(direction_names(gate)):
                total = totals[gate.name, name]
                own = [(j, one) for j, one in enumerate(every) if (one.gate, one.direction) == (gate.name, k)]
                lost = report.unseen.most(gate.name, k, EVER, OF_VEHICLES)
                true = sum((one.gate, one.direction) == (gate.name, k) for one in real)
                yield {
                    "clip": folder.name,
                    "site": read_json(folder / "clip.json").get("site", folder.name),
                    "way": way,
                    "side": f"{gate.name} {name}",
                    "minutes": report.observation.observed_s / 60,
                    "truth": true,
                    "count": sum(one.is_counted for _, one in own),
                    "low": total.confidence_interval.low if total.confidence_interval else None,
                    "high": total.confidence_interval.high if total.confidence_interval else None,
                    "lost": lost,
                    "crossings": [
                        {
                            "doubts": crossing_doubts(one.trajectory, one.time_s, step_s),
                            "probability": round(one.probability, 4),
                            "counts": one.is_counted,
                            "real": j in happened,
                            "flags": list(one.trajectory.flags),
                        }
                        for j, one in own
                    ],
                }


# ------------------------------------------------------------------------------------------------------------ fitting


def fitted(rows: Sequence[Row], kind: str, counted: Sequence[int], prior: Mapping[str, Any]) -> dict[str, Any]:
    """Rates of one kind of gates, from prior ones and what came out.

    Args:
        rows: The rows of the clips.
        kind: "image" or "metres".
        counted: Manual counts of real footage, of which nothing was missed and nothing counted wrongly.
        prior: `real` (by doubts, as trials), `missed` and `came` before.

    Returns:
        The same after.
    """
    own = [row for row in rows if ("image" in row["way"]) == (kind == "image")]
    real = [list(trials) for trials in prior["real"]]
    real[0] = [real[0][0] + sum(counted), real[0][1] + sum(counted)]
    for row in own:
        for one in row["crossings"]:
            if not one["flags"]:
                real[one["doubts"]][0] += one["real"]
                real[one["doubts"]][1] += 1
    sides = [
        (row["truth"], max(0, row["truth"] - sum(one["real"] for one in row["crossings"])), row["lost"])
        for row in own
        if row["high"] is not None
    ]
    sides += [(number, 0, 0) for number in counted]
    missed, came = beta_binomials(sides, (*prior["missed"], *prior["came"]))
    return {"real": real, "missed": missed, "came": came}


def beta_binomials(sides: Sequence[tuple[int, int, int]], prior: Sequence[float]) -> tuple[list[float], list[float]]:
    """The Beta distributions of what is missed without a trace, and of the lost that did cross.

    Args:
        sides: By gate and direction: true number, those that no crossing tells, tracks that were lost there.
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
        for true, untold, lost in sides:
            k = np.arange(min(untold, lost) + 1, dtype=float)
            both = log_pmf(k, lost, c, d) + np.array([float(log_pmf(untold - one, true - int(one), a, b)) for one in k])
            total -= float(np.logaddexp.reduce(both))
        return total

    best = np.exp(minimize(loss, middle, method="Nelder-Mead", options={"maxiter": 4000}).x)
    return [round(float(v), 3) for v in best[:2]], [round(float(v), 3) for v in best[2:]]


def compact(document: Mapping[str, Any]) -> str:
    """JSON with lists of numbers in one line each."""
    lists = re.compile(r"\[\s+([^\[\]]*?)\s+\]")
    text = json.dumps(document, indent=1)
    return lists.sub(lambda found: f"[{', '.join(part.strip() for part in found[1].split(','))}]", text) + "\n"


def print_coverage(rows: Sequence[Row]) -> None:
    """Coverage by way, with a bootstrap over clips; and the reliability of the crossing probability."""
    rng = np.random.default_rng(0)
    for way in sorted({row["way"] for row in rows}):
        every_side = [row for row in rows if row["way"] == way]
        own = [row for row in every_side if row["high"] is not None]
        if not own:
            continue
        clips = sorted({row["clip"] for row in own})
        inside = {c: [row["low"] <= row["truth"] <= row["high"] for row in own if row["clip"] == c] for c in clips}
        every = [v for c in clips for v in inside[c]]
        drawn = [np.mean([v for c in rng.choice(clips, len(clips)) for v in inside[str(c)]]) for _ in range(DRAWS)]
        busy = [row for row in own if row["count"] >= 5]
        width = np.mean([(row["high"] - row["low"]) / row["count"] for row in busy]) if busy else math.nan
        minutes = sum(row["minutes"] for row in own if row["truth"] >= 5)
        out = sum(not row["low"] <= row["count"] <= row["high"] for row in own)
        off = sum(abs(row["count"] - row["truth"]) for row in own)
        low, high = np.quantile(drawn, (0.05, 0.95))
        counted, true = (sum(row[name] for row in own) for name in ("count", "truth"))
        print(
            f"{way:28} sides {len(own):4} of {len(every_side):4} held {np.mean(every):.3f} ({low:.3f} to {high:.3f}) "
            f"counted {counted} of {true}, off by {off}; width/count {width:.2f}; "
            f"busy gate-minutes {minutes:.0f}; count outside {out}"
        )
    print("probability of a crossing: said, real, number")
    every_crossing = [one for row in rows for one in row["crossings"]]
    bounds = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.01)
    for low, high in itertools.pairwise(bounds):
        there = [one for one in every_crossing if low <= one["probability"] < high]
        if there:
            said, real = (float(np.mean([one[name] for one in there])) for name in ("probability", "real"))
            print(f"  {low:.2f} to {high:.2f}: {said:.3f} {real:.3f} {len(there)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("clips", type=Path, nargs="*")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--fit", type=Path, nargs="*", help="files of rows to fit")
    parser.add_argument("--rates", type=Path, help="crossing_rates.json, which is changed")
    parser.add_argument("--true-keypoints", action="store_true", help="labels with 2 px of noise, no detections")
    options = parser.parse_args()
    if options.fit:
        rows = [row for path in options.fit for row in read_json(path)["rows"]]
        rates = read_json(options.rates)
        for kind in ("metres", "image"):
            place = rates["metres"]["vehicle"] if kind == "metres" else rates["image"]
            prior = rates["provenance"]["prior"][kind]
            found = fitted(rows, kind, rates["provenance"]["manual_counts"][kind], prior)
            rates[kind]["real"]["vehicle"] = found["real"]
            place["missed"], place["came"] = found["missed"], found["came"]
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
