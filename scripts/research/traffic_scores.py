"""One generated clip: what `skope eval traffic` says of it against what really happened.

    python scripts/research/traffic_scores.py clips/t06_plaza_opening_day --true-keypoints

The folder is one of traffic_clips.py. The truth is the simulation's exact places (traffic_truth.py) put through the
same measures, and a plain count of where they cut the gates. What counts is who crosses a gate while the labels say
that one of its pixels at least is visible then; who is hidden there, or in the whole clip, is told apart.
"""

import argparse
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from traffic_evidence import LABELS, SEEN, Clip, evidence_of, owners_of, paired, reported
from traffic_gates import SITE
from traffic_tables import VISIBLE, middle_of, print_tables
from traffic_truth import plain_counts, read_truth

from skope.dataset import coco
from skope.dataset.folder import PREDICTIONS_FILE
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.schema import VEHICLE
from skope.site.site_file import read_site
from skope.tracks.csv_file import TRACKS_CSV, read_tracks
from skope.tracks.track import KMH_PER_MPS
from skope.traffic.conflicts import conflicts
from skope.traffic.count_uncertainty import CountInterval
from skope.traffic.gate_counts import ALL_CLASSES, expected
from skope.traffic.gates import direction_names
from skope.traffic.measure import measure
from skope.traffic.normal_distribution import INTERVAL_SIGMAS
from skope.traffic.observation import Observation, read_observation
from skope.traffic.turning_movements import NO_GATE
from skope.traffic.write_report import SUMMARY_FILE

RESULTS: Final = "results.json"
KINDS: Final = {"all": (True, False), "vehicles": (True,), "others": (False,)}
"""Whom counts are of, and whether these are vehicles."""
Row = dict[str, Any]


def clip_of(folder: Path, *, true_keypoints: bool, clip: Mapping[str, Any]) -> Clip:
    """What is known of a clip and what is told of it; its traffic is measured unless that is done."""
    out = folder / ("true" if true_keypoints else "found")
    reported(folder, out, true_keypoints)
    site, truth, file = read_site(folder / SITE), read_truth(folder), coco.read(folder / LABELS)
    observation = read_observation(out / "tracks")
    told = measure(read_tracks(out / "tracks" / TRACKS_CSV), observation, site)
    owners = owners_of(out / "tracks", file)
    found = None if true_keypoints else folder / SEEN / PREDICTIONS_FILE
    return Clip(
        file=file,
        truth=truth.trajectories,
        real=measure(truth.trajectories, Observation(times_s=truth.times_s), site, broken=False),
        told=told,
        owners=owners,
        evidence=evidence_of(file, found, owners, told.trajectories),
        plain=plain_counts(truth, site.gates),
        light=str(clip.get("light", "day")),
    )


def score_clip(folder: Path, *, true_keypoints: bool, clip: Mapping[str, Any]) -> Row:
    """Everything that is measured of a clip."""
    this = clip_of(folder, true_keypoints=true_keypoints, clip=clip)
    pairs = paired(this)
    summary = read_json(folder / ("true" if true_keypoints else "found") / "report" / SUMMARY_FILE)
    return {
        "clip": dict(clip),
        "true_tracks_joined": sum(bool(one.joined) for one in this.real.trajectories),
        "counts": count_rows(
            this, [one for one in summary["counts"] if one["class"] == ALL_CLASSES], this.real.observation.times_s
        ),
        "turning": turning_rows(this),
        "speeds": speed_rows(this),
        "headways": headway_rows(this, pairs),
        "conflicts": conflict_rows(this),
        "crossings": crossing_rows(this, pairs),
        "besides": besides_rows(this, pairs),
        "categories": this.evidence.categories,
    }


# ---------------------------------------------------------------------------------------------------------------- rows


def count_rows(clip: Clip, told: Sequence[Mapping[str, Any]], times_s: Any) -> list[Row]:
    """By gate, direction and kind of road user; GEH is that of the hourly volumes that these would be."""
    hourly = 3600 / (float(times_s[-1] - times_s[0]) or 1.0)
    rows = []
    for side in told:
        for who, chosen in KINDS.items():
            real, counted = (
                [
                    c
                    for c in report.crossings
                    if (c.gate, c.direction_name) == (side["gate"], side["direction"])
                    and (c.trajectory.category == VEHICLE) in chosen
                ]
                for report in (clip.real, clip.told)
            )
            if who == "all" and len(counted) != side["count"]:
                raise UserError(f"{side}: what the command counted is not what was measured here: {len(counted)}")
            states = Counter(clip.evidence.state_of(c) for c in real)
            true, count = sum(states[name] for name in VISIBLE), len(counted)
            interval = expected_of(clip, side, chosen)
            plain = [number for number, _ in clip.plain[side["gate"], side_of(side, clip)]]
            rows.append(
                {
                    "gate": side["gate"],
                    "direction": side["direction"],
                    "who": who,
                    "truth": true,
                    "seen": states["seen"],
                    "hidden_at_gate": states["hidden"],
                    "hidden_always": states["never"],
                    "truth_all": len(real),
                    "plain_all": sum((clip.category[number] == VEHICLE) in chosen for number in plain),
                    "count": count,
                    "low": interval.low if interval else None,
                    "high": interval.high if interval else None,
                    "difference": count - true,
                    "percent": 100 * (count - true) / true if true else None,
                    "geh": math.sqrt(2 * hourly * (count - true) ** 2 / (count + true)) if count + true else 0.0,
                    "holds": interval and interval.low <= true <= interval.high,
                    "holds_all": interval and interval.low <= len(real) <= interval.high,
                }
            )
    return rows


def expected_of(clip: Clip, side: Mapping[str, Any], chosen: Sequence[bool]) -> CountInterval | None:
    """Between what the count of vehicles, of others, or of both is said to be; None: not known."""
    told = clip.told
    totals = {
        one.class_name: one
        for one in told.counts_total
        if (one.gate, one.direction) == (side["gate"], side["direction"])
    }
    total = totals[ALL_CLASSES if len(chosen) > 1 or not chosen[0] else VEHICLE]
    if len(chosen) > 1 or chosen[0]:
        return total.expected
    there = [
        one
        for one in (*told.crossings, *told.unseen.doubtful)
        if (one.gate, one.direction_name) == (total.gate, total.direction)
    ]
    direction = side_of(side, clip)
    kinds = told.unseen.kinds_at(total.gate, direction)[1:]
    most = partial(told.unseen.most, total.gate, direction, total.interval)
    return expected(there, kinds, most, ALL_CLASSES, {name for kind in kinds for name in kind.classes})


def side_of(side: Mapping[str, Any], clip: Clip) -> int:
    """Which of a gate's two directions a row of the summary is of."""
    (gate,) = (gate for gate in clip.real.site.gates if gate.name == side["gate"])
    return direction_names(gate).index(side["direction"])


def turning_rows(clip: Clip) -> list[Row]:
    """Movements from gate to gate of those that were seen at both."""
    real, told = (
        {
            (one.origin, one.destination, one.class_name): one
            for one in report.turning_total
            if NO_GATE not in (one.origin, one.destination)
        }
        for report in (clip.real, clip.told)
    )
    rows = []
    for pair in sorted({*real, *told}):
        true, said = (side[pair].count or 0 if pair in side else 0 for side in (real, told))
        expected = told[pair].expected if pair in told else None
        rows.append(
            {
                "from": list(pair[0]),
                "to": list(pair[1]),
                "who": pair[2],
                "truth": true,
                "count": said,
                "holds": expected.low <= true <= expected.high if expected is not None else None,
            }
        )
    return rows


def speed_rows(clip: Clip) -> list[Row]:
    """v50 and v85 of motor vehicles at each gate, km/h."""
    real, told = (
        {one.where: one for one in report.speeds if (one.kind, one.class_name, one.interval) == ("spot", "motor", None)}
        for report in (clip.real, clip.told)
    )
    rows = []
    for where, one in real.items():
        own = [
            KMH_PER_MPS * c.speed
            for c in clip.real.crossings
            if f"{c.gate} ({c.direction_name})" == where and c.trajectory.class_name not in ("bicycle", "pedestrian")
        ]
        for name, share in (("v50", 0.5), ("v85", 0.85)):
            said = told[where].percentiles[name] if where in told else None
            value, low, high = (said.value, said.low, said.high) if said is not None else (None,) * 3
            true = float(np.quantile(own, share))
            row: Row = {"where": where, "name": name, "number": one.number, "truth": true, "told": None}
            if value is not None and low is not None and high is not None:
                row |= {"told": KMH_PER_MPS * value, "holds": KMH_PER_MPS * low <= true <= KMH_PER_MPS * high}
            rows.append(row)
    return rows


def headway_rows(clip: Clip, pairs: Mapping[int, int]) -> Row:
    """Absolute differences of headways, seconds, pairs matched by their vehicles."""
    index = {id(c): i for i, c in enumerate(clip.real.crossings)}
    real = {(index[id(h.leader)], index[id(h.follower)]): h for h in clip.real.headways}
    which = {id(d): pairs.get(j) for j, d in enumerate(clip.told.crossings)}
    off = [
        abs(h.headway_s - real[key].headway_s)
        for h in clip.told.headways
        if (key := (which[id(h.leader)], which[id(h.follower)])) in real
    ]
    return {"truth": len(real), "told": len(clip.told.headways), "matched": len(off), **middle_of(off)}


def conflict_rows(clip: Clip) -> Row:
    """PET by both definitions, pairs matched by their road users; the true ways are as long as they are visible.

    What lies beyond the image, or is hidden, makes the area larger that two drive over.
    """
    shown = [seen for one in clip.truth if (seen := clip.evidence.shown(one)) is not None]
    search = conflicts(shown, clip.real.site.traffic, np.random.default_rng(0))
    real = {frozenset((c.first.number, c.second.number)): c for c in search.conflicts}
    told = {
        frozenset((clip.owners.whole(c.first), clip.owners.whole(c.second))): c for c in clip.told.conflicts.conflicts
    }
    both = real.keys() & told.keys()
    return {
        "truth": len(real),
        "told": len(clip.told.conflicts.conflicts),
        "matched": len(both),
        "overlapping": clip.told.conflicts.overlapping,
        **{
            name: middle_of([abs(getattr(real[key], name) - getattr(told[key], name)) for key in both])
            for name in ("pet_places_s", "pet_area_s", "ttc_s")
        },
    }


def crossing_rows(clip: Clip, pairs: Mapping[int, int]) -> list[Row]:
    """A row for each true crossing: whether it was counted, as what class, or why not."""
    counted = {i: clip.told.crossings[j] for j, i in pairs.items()}
    rows = []
    for i, c in enumerate(clip.real.crossings):
        row: Row = {
            "gate": c.gate,
            "direction": c.direction_name,
            "time_s": round(c.time_s, 3),
            "vehicle": c.trajectory.number,
            "class": c.trajectory.class_name,
            "distance": round(clip.distance(c), 1),
            "light": clip.light,
            "state": clip.evidence.state_of(c),
            "counted": i in counted,
        }
        if i in counted:
            d = counted[i]
            row |= {"counted_class": d.trajectory.class_name, "late_s": round(d.time_s - c.time_s, 3)}
            row |= {
                "time_holds": abs(d.time_s - c.time_s) < INTERVAL_SIGMAS * d.sigma_s,
                "faster": round(d.speed - c.speed, 3),
            }
        else:
            row["cause"] = clip.evidence.cause_of(c)
        rows.append(row)
    return rows


def besides_rows(clip: Clip, pairs: Mapping[int, int]) -> list[Row]:
    """A row for each counted crossing that is none, or is one too often."""
    crossed = {(c.trajectory.number, c.gate, c.direction) for c in clip.real.crossings}
    rows = []
    for j, d in enumerate(clip.told.crossings):
        if j in pairs:
            continue
        owner = clip.owners.of(d.trajectory, d.time_s)
        double = owner is not None and (owner, d.gate, d.direction) in crossed
        rows.append(
            {
                "gate": d.gate,
                "direction": d.direction_name,
                "time_s": round(d.time_s, 3),
                "class": d.trajectory.class_name,
                "distance": round(clip.distance(d), 1),
                "light": clip.light,
                "probability": round(d.probability, 3),
                "what": "double" if double else "nobody" if owner is None else "who did not cross",
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of a clip")
    parser.add_argument("--true-keypoints", action="store_true", help="labels with 2 px of noise, no detections")
    options = parser.parse_args()
    known = options.folder / "clip.json"
    clip = read_json(known) if known.is_file() else {"name": options.folder.name}
    print_tables([score_clip(options.folder, true_keypoints=options.true_keypoints, clip=clip)])


if __name__ == "__main__":
    main()
