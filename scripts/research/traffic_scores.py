"""What `skope eval traffic` reports of generated clips against the truth: counts, speeds, conflicts, lengths.

    python scripts/research/traffic_scores.py counts clips                        # clips of traffic_clips.py
    python scripts/research/traffic_scores.py counts clips --true-keypoints       # labels with 2 px of noise
    python scripts/research/traffic_scores.py lengths clips

`counts`: the truth is the simulation's exact places, put through the same measures, and a plain count of where they
cut the gates. A true crossing counts if the labels show at least one pixel of the road user around it; road users
that are hidden there, or in the whole clip, are listed apart. results.json has everything that is printed.

`lengths` fits the errors of vehicle lengths in skope/traffic/length_bins.py. A track belongs to the true vehicle that
is nearest in most of its frames. For each class of tracks it prints the errors as two normal distributions and a
share of mistaken bodies. For each site it prints the number of vehicles above some limits: in truth, by length, and
as `bin_probabilities` expects with 90%.
"""

import argparse
import math
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
from footage_scores import matched
from scipy.optimize import minimize
from scipy.stats import norm
from traffic_clips import CLIP, LABELS, NOISE_PX, SEEN, SITE, chosen, plain_counts, read_truth

from skope.confidence_level import INTERVAL_SIGMAS
from skope.dataset import coco
from skope.dataset.folder import PREDICTIONS_FILE
from skope.errors import UserError
from skope.files.json_files import read_json, write_json
from skope.schema import CATEGORY_NAMES, VEHICLE_CATEGORY, AnnotationFile, Labelled
from skope.site.site_file import read_site
from skope.tracks.csv_file import TRACKS_CSV, read_tracks
from skope.tracks.track import KMH_PER_MPS, Track, is_in_traffic
from skope.traffic.conflicts import conflicts
from skope.traffic.count_uncertainty import CountInterval
from skope.traffic.gate_counts import ALL_CLASSES, confidence_interval
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.length_bins import bin_probabilities
from skope.traffic.measure import measure
from skope.traffic.observation import FOOTAGE_FILE, Observation, read_observation
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import NO_GATE
from skope.traffic.write_report import SUMMARY_FILE
from skope.types import Array

GROUND: Final = "0"
"""Height of the road, which is level at all sites of the clips."""
AT_GATE_S: Final = 0.5
"""Time before and after a crossing in which visibility is required, seconds."""
AROUND_S: Final = 2.0
"""Time around a crossing in which detections and tracks are looked for, seconds."""
SAME_S: Final = 2.0
"""Largest time between a true and a counted crossing of the same vehicle, seconds."""
NEAR_S, NEAR_M = 0.7, 2.5
"""The same for a vehicle without overlapping boxes, in time and place."""
SCORE: Final = 0.5
"""Detections above this are tracked."""
Times = Mapping[int, list[float]]


def run_skope(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "skope", *words, "-q"], check=True, stdout=subprocess.DEVNULL)


def reported(folder: Path, true_keypoints: bool) -> Path:
    """Track the clip and measure its traffic with skope's commands, unless that is done; returns the folder of both."""
    out = folder / ("true" if true_keypoints else "found")
    if not (out / "tracks" / FOOTAGE_FILE).is_file():
        camera = ["--camera", str(folder / LABELS)]
        noisy = ["--annotations", str(folder / LABELS), "--noise", NOISE_PX]
        what = noisy if true_keypoints else [str(folder / SEEN), *camera]
        run_skope("eval", "track", *what, "--ground", GROUND, "--out", str(out / "tracks"))
    if not (out / "report" / SUMMARY_FILE).is_file():
        run_skope("eval", "traffic", str(out / "tracks"), "--site", str(folder / SITE), "--out", str(out / "report"))
    return out


@dataclass(frozen=True)
class Owners:
    """The road users whose boxes each track has."""

    seen: Mapping[int, list[tuple[float, int]]]
    """Times and numbers in the labels, by track."""

    def _votes(self, trajectory: Track) -> list[tuple[float, int]]:
        return [vote for number in (trajectory.number, *trajectory.joined) for vote in self.seen.get(number, ())]

    def of(self, trajectory: Track, time_s: float) -> int | None:
        """The road user of a trajectory around a time; None without one in the labels."""
        votes = self._votes(trajectory)
        near = [vote for vote in votes if abs(vote[0] - time_s) < AROUND_S]
        return _most(who for _, who in near or votes)

    def whole(self, trajectory: Track) -> int | None:
        """The road user of a trajectory in the whole clip."""
        return _most(who for _, who in self._votes(trajectory))


def _most(numbers: Iterable[int]) -> int | None:
    found = Counter(numbers).most_common(1)
    return found[0][0] if found else None


def labels_of(file: AnnotationFile) -> list[list[Labelled]]:
    """The labels of each image, ignored ones and all road users too."""
    out: dict[int, list[Labelled]] = defaultdict(list)
    for label in (*file.annotations, *file.road_users):
        if label.track_id is not None:
            out[label.image_id].append(label)
    return [out[image.id] for image in file.images]


def owners_of(tracks: Path, file: AnnotationFile) -> Owners:
    """Compare the boxes of the MOTChallenge files with the labels."""
    boxes: dict[int, list[tuple[str, Any]]] = defaultdict(list)
    for name in ("mot.txt", *(f"mot_{category}.txt" for category in CATEGORY_NAMES[1:])):
        lines = (tracks / name).read_text().splitlines() if (tracks / name).is_file() else []
        for line in lines:
            frame, number, *box = line.split(",")[:6]
            boxes[int(frame) - 1].append((number, np.array(box, dtype=float)))
    seen: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for at, labels in enumerate(labels_of(file)):
        taken = matched(labels, boxes[at])  # type: ignore[arg-type]  # it asks for boxes and ids alone
        for label in labels:
            if label.id in taken and label.track_id is not None:
                seen[int(taken[label.id])].append((float(file.images[at].time_s or 0.0), label.track_id))
    return Owners(seen)


@dataclass(frozen=True)
class Evidence:
    """The times at which each road user was visible, found and tracked."""

    visible: Times
    """By number in the labels: times with a visible pixel."""
    clear: Times
    """Times at which the label is not ignored."""
    found: Times
    """Times with a detection."""
    followed: Mapping[int, list[tuple[float, int]]]
    """Times, and the trajectory at each."""
    owner: Mapping[int, int | None]
    """The road user of each trajectory in the whole clip."""

    def shown(self, one: Track) -> Track | None:
        """A true trajectory from the first to the last moment at which it is visible; None where that is never."""
        times = self.visible.get(one.number, [])
        rows = (one.times_s >= min(times, default=1) - 1e-6) & (one.times_s <= max(times, default=0) + 1e-6)
        return one.during(rows) if rows.sum() > 1 else None

    def state_of(self, crossing: GateCrossing) -> str:
        """Seen (before and after), hardly (by ignored labels too), hidden (there), or never seen in the clip."""
        number, time_s = crossing.trajectory.number, crossing.time_s
        clear = self.clear.get(number, ())
        if any(0 <= time_s - t < AT_GATE_S for t in clear) and any(0 <= t - time_s < AT_GATE_S for t in clear):
            return "seen"
        if _near(self.visible.get(number, ()), time_s, AT_GATE_S):
            return "hardly"
        return "hidden" if number in self.visible else "never"

    def cause_of(self, crossing: GateCrossing) -> str:
        """The reason why a crossing is not counted."""
        number, time_s = crossing.trajectory.number, crossing.time_s
        if not self.found.get(number):
            return "never detected"
        if not _near(self.found[number], time_s, AROUND_S):
            return "not detected at the gate"
        around = [(t, who) for t, who in self.followed.get(number, ()) if abs(t - time_s) < AROUND_S]
        if not around:
            return "detected, not tracked"
        tracks = {who for _, who in around}
        if all(self.owner[who] != number for who in tracks):
            return "joined wrongly"
        before, after = ({who for t, who in around if (t < time_s) == first} for first in (True, False))
        if not before or not after:
            return "tracked on one side of the gate"
        if not before & after:
            return "tracked in pieces"
        return "tracked, not across the gate"


def _near(times: Iterable[float], time_s: float, within_s: float) -> bool:
    return any(abs(time - time_s) < within_s for time in times)


def evidence_of(file: AnnotationFile, results: Path | None, owners: Owners, trajectories: Sequence[Track]) -> Evidence:
    """Collect the evidence; without results the labels that are not ignored count as detections."""
    visible, clear, found = defaultdict[int, list[float]](list), defaultdict[int, list[float]](list), None
    for image, labels in zip(file.images, labels_of(file), strict=True):
        for label in labels:
            assert label.track_id is not None
            visible[label.track_id].append(float(image.time_s or 0.0))
            if not label.ignored:
                clear[label.track_id].append(float(image.time_s or 0.0))
    if results is not None:
        found = _detected(file, results)
    followed: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for one in trajectories:
        for number in (one.number, *one.joined):
            for time_s, who in owners.seen.get(number, ()):
                followed[who].append((time_s, one.number))
    return Evidence(
        visible=visible,
        clear=clear,
        found=clear if found is None else found,
        followed=followed,
        owner={one.number: owners.whole(one) for one in trajectories},
    )


def _detected(file: AnnotationFile, results: Path) -> Times:
    """Times at which each road user was detected."""
    by_image: dict[int, list[tuple[str, Any]]] = defaultdict(list)
    for k, result in enumerate(coco.iter_all_results(results)):
        if result.score >= SCORE:
            by_image[result.image_id].append((str(k), result.bbox))
    times: dict[int, list[float]] = defaultdict(list)
    for image, labels in zip(file.images, labels_of(file), strict=True):
        taken = matched(labels, by_image[image.id])  # type: ignore[arg-type]
        for label in labels:
            if label.id in taken and label.track_id is not None:
                times[label.track_id].append(float(image.time_s or 0.0))
    return times


@dataclass(frozen=True)
class ScoredClip:
    """The truth and the report of a clip."""

    file: AnnotationFile
    truth: Sequence[Track]
    real: TrafficReport
    told: TrafficReport
    owners: Owners
    evidence: Evidence
    plain: Mapping[tuple[str, int], list[tuple[int, float]]]
    light: str

    @property
    def category(self) -> Mapping[int, str]:
        """Of each true road user."""
        return {one.number: one.category for one in self.truth}

    @property
    def eye(self) -> Any:
        camera = self.file.images[0].camera
        assert camera is not None
        return camera.position

    def distance(self, crossing: GateCrossing) -> float:
        """From the camera, metres."""
        return math.hypot(math.dist(crossing.position, self.eye[:2]), self.eye[2])


def paired(clip: ScoredClip) -> dict[int, int]:
    """Index of the true crossing that each counted one is, by its index."""
    real, told = clip.real.crossings, clip.told.crossings
    options = []
    for j, d in enumerate(told):
        owner = clip.owners.of(d.trajectory, d.time_s)
        for i, c in enumerate(real):
            late = abs(c.time_s - d.time_s)
            if (c.gate, c.direction) != (d.gate, d.direction) or late > SAME_S:
                continue
            same = owner == c.trajectory.number
            if same or (late < NEAR_S and math.dist(c.position, d.position) < NEAR_M):
                options.append((not same, late, j, i))
    out: dict[int, int] = {}
    for _, _, j, i in sorted(options):
        if j not in out and i not in out.values():
            out[j] = i
    return out


Row = Mapping[str, Any]
VISIBLE: Final = ("seen", "hardly")
BINS: Final = (0, 20, 40, 60, 1000)
"""Distances from the camera, metres."""


def print_tables(clips: Sequence[Row]) -> None:
    """All tables."""
    by_gate(clips)
    by_clip(clips)
    crossings = [row for clip in clips for row in clip["crossings"]]
    besides = [row for clip in clips for row in clip["besides"]]
    print("\n                      crossings  missed (90%)        double  nobody's  did not cross  time within 90%")
    for title, key in (("distance", distance_of), ("class", class_of), ("light", light_of), ("label", state_of)):
        by_kind(crossings, besides, title, key)
    hidden = Counter(row["state"] for row in crossings if row["state"] not in VISIBLE)
    counted = sum(row["counted"] for row in crossings if row["state"] not in VISIBLE)
    print(
        f"\nhidden at the gate: {hidden['hidden']}, in the whole clip: {hidden['never']}; of these counted: {counted}"
    )
    causes = Counter(row["cause"] for row in visible(crossings) if not row["counted"])
    print("why missed:", ", ".join(f"{number} {cause}" for cause, number in causes.most_common()) or "-")


def visible(crossings: Iterable[Row]) -> list[Row]:
    """Crossings that count: those that are visible at the gate."""
    return [row for row in crossings if row["state"] in VISIBLE]


def distance_of(row: Row) -> str:
    """The bin of its distance."""
    k = int(np.searchsorted(BINS, row["distance"], side="right")) - 1
    return f"{BINS[k]}-{BINS[k + 1]} m" if k < len(BINS) - 2 else f"over {BINS[-2]} m"


def class_of(row: Row) -> str:
    """Its class."""
    return str(row["class"])


def light_of(row: Row) -> str:
    """Its clip's light."""
    return str(row["light"])


def state_of(row: Row) -> str:
    """Whether its labels at the gate are not ignored; of who is besides, nothing."""
    return str(row.get("state", "-"))


def by_gate(clips: Sequence[Row]) -> None:
    """A line for each gate and direction."""
    print("clip                        gate   dir   who      truth hidden  all plain counted  off      %  GEH 90%")
    for clip in clips:
        for row in clip["counts"]:
            if row["who"] == "all" or not (row["who"] == "vehicles" or row["truth_all"] or row["count"]):
                continue
            percent = "-" if row["percent"] is None else f"{row['percent']:+.0f}"
            hidden = row["hidden_at_gate"] + row["hidden_always"]
            interval = (
                f"{row['low']}-{row['high']} {'holds' if row['holds'] else 'FAILS'}"
                if row["high"] is not None
                else "not known"
            )
            name = f"{clip['clip']['name']:27.27} {row['gate']:6.6} {row['direction']:5.5} {row['who']:8}"
            true = f"{row['truth']:5d} {hidden:6d} {row['truth_all']:4d} {row['plain_all']:5d}"
            print(f"{name} {true} {row['count']:7d} {row['difference']:+4d} {percent:>6} {row['geh']:4.1f} {interval}")


def by_clip(clips: Sequence[Row]) -> None:
    """A line for each clip."""
    print(
        "\nclip                        movements: truth counted wrong   v50 off, km/h  v85 off   headways: median (90%)"
    )
    for clip in clips:
        turning = clip["turning"]
        true, said = (sum(row[key] for row in turning) for key in ("truth", "count"))
        wrong = sum(abs(row["truth"] - row["count"]) for row in turning)
        headways, conflicts = clip["headways"], clip["conflicts"]
        told = f"{headways['matched']} of {headways['truth']}: {pair_of(headways)} s"
        print(
            f"{clip['clip']['name']:27.27} {true:16d} {said:7d} {wrong:5d}  {speeds_off(clip, 'v50'):>14}  "
            f"{speeds_off(clip, 'v85'):>8}   {told}"
        )
        pet = f"PET off {pair_of(conflicts['pet_ssam_s'])} s, of the area {pair_of(conflicts['pet_area_s'])} s"
        pairs = f"{conflicts['matched']} of {conflicts['truth']} conflicts, {conflicts['told']} told"
        print(f"{'':27} {pairs}; {pet}")


def middle_of(values: Sequence[float]) -> dict[str, Any]:
    """Median and 90% of values; None where there are none."""
    known = [value for value in values if not math.isnan(value)]
    names = {"median": 50, "p90": 90}
    return {name: float(np.percentile(known, share)) if known else None for name, share in names.items()}


def pair_of(values: Row) -> str:
    """Median and 90%."""
    return "-" if values["median"] is None else f"{values['median']:.2f} ({values['p90']:.2f})"


def speeds_off(clip: Row, name: str) -> str:
    """Median of the absolute differences of a percentile, over the gates that tell it."""
    off = [abs(row["told"] - row["truth"]) for row in clip["speeds"] if row["name"] == name and row["told"] is not None]
    return f"{np.median(off):.1f} [{len(off)}]" if off else "-"


def by_kind(crossings: Sequence[Row], besides: Sequence[Row], title: str, key: Callable[[Row], str]) -> None:
    """Misses and doubles of each kind, of those who are visible at the gate."""
    own = visible(crossings)
    for kind in sorted({key(row) for row in (*own, *besides)}):
        rows = [row for row in own if key(row) == kind]
        missed = sum(not row["counted"] for row in rows)
        low, high = share_between(missed, len(rows))
        more = Counter(row["what"] for row in besides if key(row) == kind)
        within = [row["time_holds"] for row in rows if row["counted"]]
        share = f"{100 * missed / len(rows):.0f}%" if rows else "-"
        told = f"{missed:4d} {share:>4} ({100 * low:.0f}-{100 * high:.0f}%)"
        print(
            f"{title:9} {kind:12} {len(rows):8d}  {told:19} {more['double']:6d} {more['nobody']:9d} "
            f"{more['did not cross']:14d}  {f'{100 * np.mean(within):.0f}%' if within else '-':>15}"
        )


def share_between(number: int, of: int) -> tuple[float, float]:
    """The share's interval that holds it with 90%: Clopper and Pearson's."""
    from scipy.special import betaincinv

    low = float(betaincinv(number, of - number + 1, 0.05)) if number else 0.0
    return low, float(betaincinv(number + 1, of - number, 0.95)) if number < of else 1.0


RESULTS: Final = "results.json"
KINDS: Final = {"all": (True, False), "vehicles": (True,), "others": (False,)}
"""Groups of road users that are counted, and whether these are vehicles."""
Row = dict[str, Any]


def scored_clip(folder: Path, out: Path, light: str) -> ScoredClip:
    """Truth and report of a clip; `out` has its tracks, made from labels if it is called "true"."""
    site, truth, file = read_site(folder / SITE), read_truth(folder), coco.read(folder / LABELS)
    told = measure(read_tracks(out / "tracks" / TRACKS_CSV), read_observation(out / "tracks"), site)
    owners = owners_of(out / "tracks", file)
    found = None if out.name == "true" else folder / SEEN / PREDICTIONS_FILE
    return ScoredClip(
        file=file,
        truth=truth.trajectories,
        real=measure(truth.trajectories, Observation(times_s=truth.times_s), site, broken=False),
        told=told,
        owners=owners,
        evidence=evidence_of(file, found, owners, told.trajectories),
        plain=plain_counts(truth, site.gates),
        light=light,
    )


def score_clip(folder: Path, *, true_keypoints: bool) -> Row:
    """All scores of a clip."""
    out, clip = reported(folder, true_keypoints), read_json(folder / CLIP)
    this = scored_clip(folder, out, str(clip["light"]))
    pairs = paired(this)
    summary = read_json(out / "report" / SUMMARY_FILE)
    return {
        "clip": dict(clip),
        "counts": count_rows(
            this, [one for one in summary["counts"] if one["class"] == ALL_CLASSES], this.real.observation.times_s
        ),
        "turning": turning_rows(this),
        "speeds": speed_rows(this),
        "headways": headway_rows(this, pairs),
        "conflicts": conflict_rows(this),
        "crossings": crossing_rows(this, pairs),
        "besides": besides_rows(this, pairs),
    }


# ---------------------------------------------------------------------------------------------------------------- rows


def count_rows(clip: ScoredClip, told: Sequence[Mapping[str, Any]], times_s: Any) -> list[Row]:
    """By gate, direction and kind of road user; GEH is that of the hourly volumes that these would be."""
    hourly = 3600 / (float(times_s[-1] - times_s[0]) or 1.0)
    rows = []
    for side in told:
        for who, kinds in KINDS.items():
            real, counted = (
                [
                    c
                    for c in report.crossings
                    if (c.gate, c.direction_name) == (side["gate"], side["direction"])
                    and (c.trajectory.category == VEHICLE_CATEGORY) in kinds
                ]
                for report in (clip.real, clip.told)
            )
            if who == "all" and len(counted) != side["count"]:
                raise UserError(f"{side}: what the command counted is not what was measured here: {len(counted)}")
            states = Counter(clip.evidence.state_of(c) for c in real)
            true, count = sum(states[name] for name in VISIBLE), len(counted)
            interval = expected_of(clip, side, kinds)
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
                    "plain_all": sum((clip.category[number] == VEHICLE_CATEGORY) in kinds for number in plain),
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


def expected_of(clip: ScoredClip, side: Mapping[str, Any], chosen: Sequence[bool]) -> CountInterval | None:
    """The interval of the count of vehicles, of others, or of both; None without one."""
    told = clip.told
    totals = {
        one.class_name: one
        for one in told.counts_total
        if (one.gate, one.direction) == (side["gate"], side["direction"])
    }
    total = totals[ALL_CLASSES if len(chosen) > 1 or not chosen[0] else VEHICLE_CATEGORY]
    if len(chosen) > 1 or chosen[0]:
        return total.confidence_interval
    there = [
        one
        for one in (*told.crossings, *told.unseen.doubtful)
        if (one.gate, one.direction_name) == (total.gate, total.direction)
    ]
    direction = side_of(side, clip)
    kinds = told.unseen.kinds_at(total.gate, direction)[1:]
    most = partial(told.unseen.most, total.gate, direction, total.interval)
    return confidence_interval(there, kinds, most, ALL_CLASSES, {name for kind in kinds for name in kind.classes})


def side_of(side: Mapping[str, Any], clip: ScoredClip) -> int:
    """The direction of a row of the summary, 0 or 1."""
    (gate,) = (gate for gate in clip.real.site.gates if gate.name == side["gate"])
    return direction_names(gate).index(side["direction"])


def turning_rows(clip: ScoredClip) -> list[Row]:
    """Movements between two gates of road users that were seen at both."""
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
        expected = told[pair].confidence_interval if pair in told else None
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


def speed_rows(clip: ScoredClip) -> list[Row]:
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


def headway_rows(clip: ScoredClip, pairs: Mapping[int, int]) -> Row:
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


def conflict_rows(clip: ScoredClip) -> Row:
    """PET by both definitions, pairs matched by their road users; true tracks are as long as they are visible.

    Parts beyond the image, or hidden ones, would enlarge the area that both drive over.
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
            for name in ("pet_ssam_s", "pet_area_s", "ttc_s")
        },
    }


def crossing_rows(clip: ScoredClip, pairs: Mapping[int, int]) -> list[Row]:
    """A row for each true crossing: whether it was counted, with which class, or why not."""
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


def besides_rows(clip: ScoredClip, pairs: Mapping[int, int]) -> list[Row]:
    """A row for each counted crossing that is false or double."""
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
                "what": "double" if double else "nobody" if owner is None else "did not cross",
            }
        )
    return rows


NEAR_M: Final = 1.5
MOST: Final = 0.6
"""Least share of a track's frames in which its vehicle is near."""
FEWEST: Final = 24
"""Least number of moments of a track."""
LIMITS_M: Final = (5.2, 6.0, 6.55, 7.5, 9.0, 11.0)


@dataclass(frozen=True)
class Pair:
    """A track, and the length of its vehicle."""

    site: str
    track: Track
    true_m: float


def pairs_of(folder: Path, true_keypoints: bool) -> Iterator[Pair]:
    """The tracks of a clip whose vehicles are known."""
    tracks = reported(folder, true_keypoints) / "tracks"
    truth = [one for one in read_truth(folder).trajectories if one.category == VEHICLE_CATEGORY]
    at: defaultdict[float, list[tuple[int, Array]]] = defaultdict(list)
    for k, one in enumerate(truth):
        for time_s, place in zip(one.times_s, one.xy, strict=True):
            at[round(float(time_s), 3)].append((k, place))
    for track in read_tracks(tracks / TRACKS_CSV):
        if track.category != VEHICLE_CATEGORY or not is_in_traffic(track) or len(track.times_s) < FEWEST:
            continue
        votes, moments = Counter[int](), 0
        for time_s, place in zip(track.times_s[::3], track.xy[::3], strict=True):
            there = at[round(float(time_s), 3)]
            away = [float(np.hypot(*(place - other))) for _, other in there]
            moments += bool(there)
            if there and min(away) < NEAR_M:
                votes[there[int(np.argmin(away))][0]] += 1
        if votes and votes.most_common(1)[0][1] >= MOST * moments:
            length = truth[votes.most_common(1)[0][0]].length
            assert length is not None
            yield Pair(folder.name.rsplit("_", 1)[0], track, length)


def fitted(told: Array, true: Array) -> tuple[Array, float, float]:
    """(3,) shares of small errors, of large ones and of mistaken bodies; the two relative standard deviations."""

    def unlikely(a: Array) -> float:
        shares = np.exp([0, *a[2:]]) / np.exp([0, *a[2:]]).sum()
        off = (true - told) / told
        parts = (norm.pdf(off, 0, np.exp(a[0])) / told, norm.pdf(off, 0, np.exp(a[1])) / told, 0.1)
        return -float(np.log(sum(share * part for share, part in zip(shares, parts, strict=True))).sum())

    a = minimize(unlikely, [-4, -2.5, -1, -5], method="Nelder-Mead", options={"maxiter": 4000}).x
    shares = np.exp([0, *a[2:]]) / np.exp([0, *a[2:]]).sum()
    return shares, float(np.exp(a[0])), float(np.exp(a[1]))


def print_fit(pairs: Sequence[Pair]) -> None:
    """The errors of each class of tracks."""
    for name in sorted({one.track.class_name for one in pairs}):
        own = [one for one in pairs if one.track.class_name == name]
        told, true = (np.array([value(one) for one in own]) for value in (lambda p: p.track.length, lambda p: p.true_m))
        shares, small, large = fitted(told, true)
        rms = float(np.sqrt(np.mean((told - true) ** 2)))
        print(f"{name:8} {len(own):4} {np.round(shares, 3)} {small:.3f} {large:.3f}  rms {rms:.2f} m")


def print_bins(pairs: Sequence[Pair]) -> None:
    """Number of vehicles of each site that are longer than limits."""
    for site in sorted({one.site for one in pairs}):
        own = [one for one in pairs if one.site == site]
        for limit in LIMITS_M:
            longer = np.array([1 - bin_probabilities(one.track, (limit, 30.0), None)[0] for one in own])
            spread = INTERVAL_SIGMAS * float(np.sqrt((longer * (1 - longer)).sum()))
            true, told = (sum(v > limit for v in vs) for vs in ([p.true_m for p in own], [p.track.length for p in own]))
            print(
                f"{site:24} over {limit:5.2f} m: {true:3} in truth, {told:3} told, {longer.sum():5.1f} +- {spread:.1f}"
            )


def clips_of(options: argparse.Namespace) -> list[Path]:
    """The folders of the chosen clips."""
    folders = [options.folder / clip.name for clip in chosen(options.only)]
    folders = [folder for folder in folders if (folder / CLIP).is_file()]
    if not folders:
        sys.exit(f"{options.folder}: no clips")
    return folders


def score_counts(options: argparse.Namespace) -> None:
    """Print the tables of all clips, and write results.json."""
    scored = [score_clip(folder, true_keypoints=options.true_keypoints) for folder in clips_of(options)]
    write_json(options.folder / (f"true_{RESULTS}" if options.true_keypoints else RESULTS), {"clips": scored})
    print_tables(scored)


def fit_lengths(options: argparse.Namespace) -> None:
    """Print the errors of the lengths of tracked vehicles."""
    pairs = [pair for folder in clips_of(options) for pair in pairs_of(folder, options.true_keypoints)]
    print(f"{len(pairs)} tracks; shares of small and large errors and of mistaken bodies, and standard deviations")
    print_fit(pairs)
    print_bins(pairs)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    for name, run, what in (
        ("counts", score_counts, "counts, speeds, headways and conflicts"),
        ("lengths", fit_lengths, "vehicle lengths"),
    ):
        command = commands.add_parser(name, help=f"{what} against the truth")
        command.add_argument("folder", type=Path, help="folder of the clips")
        command.add_argument("--only", default="", help="names of clips, separated by commas, or `checks`")
        command.add_argument("--true-keypoints", action="store_true", help="labels with 2 px of noise, no detections")
        command.set_defaults(run=run)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
