"""Reports of `skope eval traffic` on generated clips against the truth: counts, speeds, conflicts, lengths.

    python scripts/research/traffic_scores.py counts clips                        # clips of traffic_clips.py
    python scripts/research/traffic_scores.py counts clips --true-keypoints       # labels with 2 px of noise
    python scripts/research/traffic_scores.py lengths clips

`counts`: the truth is measured from the exact positions of the simulation with the same functions; a plain count of
where they cut the gates checks it. A true crossing counts if the labels show at least one pixel of the road user around
it; road users that are hidden there, or in the whole clip, are listed separately. results.json has everything that is
printed.

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
"""Time around a crossing in which detections and tracks are searched, seconds."""
SAME_S: Final = 2.0
"""Largest time between a true and a counted crossing of the same vehicle, seconds."""
NEAR_S, NEAR_M = 0.7, 2.5
"""The same for a vehicle without overlapping boxes, in time and distance."""
SCORE: Final = 0.5
"""Detections above this are tracked."""
Times = Mapping[int, list[float]]


def run_skope(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "skope", *words, "-q"], check=True, stdout=subprocess.DEVNULL)


def reported(folder: Path, true_keypoints: bool) -> Path:
    """Track the clip and measure its traffic with skope's commands, unless this is done; returns the folder of both."""
    out = folder / ("true" if true_keypoints else "found")
    if not (out / "tracks" / FOOTAGE_FILE).is_file():
        camera = ["--camera", str(folder / LABELS)]
        noisy = ["--annotations", str(folder / LABELS), "--noise", NOISE_PX]
        source = noisy if true_keypoints else [str(folder / SEEN), *camera]
        run_skope("eval", "track", *source, "--ground", GROUND, "--out", str(out / "tracks"))
    if not (out / "report" / SUMMARY_FILE).is_file():
        run_skope("eval", "traffic", str(out / "tracks"), "--site", str(folder / SITE), "--out", str(out / "report"))
    return out


@dataclass(frozen=True)
class Owners:
    """The road users whose boxes overlap those of each track."""

    seen: Mapping[int, list[tuple[float, int]]]
    """Times and numbers in the labels, by track."""

    def _votes(self, trajectory: Track) -> list[tuple[float, int]]:
        return [vote for number in (trajectory.number, *trajectory.joined) for vote in self.seen.get(number, ())]

    def of(self, trajectory: Track, time_s: float) -> int | None:
        """Return the road user of a trajectory around a time; None if the labels have none."""
        votes = self._votes(trajectory)
        near = [vote for vote in votes if abs(vote[0] - time_s) < AROUND_S]
        return _most(number for _, number in near or votes)

    def whole(self, trajectory: Track) -> int | None:
        """Return the road user of a trajectory in the whole clip."""
        return _most(number for _, number in self._votes(trajectory))


def _most(numbers: Iterable[int]) -> int | None:
    found = Counter(numbers).most_common(1)
    return found[0][0] if found else None


def labels_of(file: AnnotationFile) -> list[list[Labelled]]:
    """Return the labels of each image, including ignored ones and all road users."""
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

    def shown(self, track: Track) -> Track | None:
        """Return a true trajectory from the first to the last moment at which it is visible; None if it never is."""
        times = self.visible.get(track.number, [])
        rows = (track.times_s >= min(times, default=1) - 1e-6) & (track.times_s <= max(times, default=0) + 1e-6)
        return track.during(rows) if rows.sum() > 1 else None

    def state_of(self, crossing: GateCrossing) -> str:
        """Return the visibility at the gate.

        Seen (before and after), hardly (only with ignored labels), hidden there, or never seen in the clip.
        """
        number, time_s = crossing.trajectory.number, crossing.time_s
        clear = self.clear.get(number, ())
        if any(0 <= time_s - t < AT_GATE_S for t in clear) and any(0 <= t - time_s < AT_GATE_S for t in clear):
            return "seen"
        if _near(self.visible.get(number, ()), time_s, AT_GATE_S):
            return "hardly"
        return "hidden" if number in self.visible else "never"

    def cause_of(self, crossing: GateCrossing) -> str:
        """Return the reason why a crossing is not counted."""
        number, time_s = crossing.trajectory.number, crossing.time_s
        if not self.found.get(number):
            return "never detected"
        if not _near(self.found[number], time_s, AROUND_S):
            return "not detected at the gate"
        around = [(t, track) for t, track in self.followed.get(number, ()) if abs(t - time_s) < AROUND_S]
        if not around:
            return "detected, not tracked"
        tracks = {track for _, track in around}
        if all(self.owner[who] != number for who in tracks):
            return "joined wrongly"
        before, after = ({track for t, track in around if (t < time_s) == first} for first in (True, False))
        if not before or not after:
            return "tracked on one side of the gate"
        if not before & after:
            return "tracked in pieces"
        return "tracked, not across the gate"


def _near(times: Iterable[float], time_s: float, within_s: float) -> bool:
    return any(abs(time - time_s) < within_s for time in times)


def evidence_of(file: AnnotationFile, results: Path | None, owners: Owners, trajectories: Sequence[Track]) -> Evidence:
    """Collect the evidence; without results, labels that are not ignored count as detections."""
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
    for track in trajectories:
        for number in (track.number, *track.joined):
            for time_s, road_user in owners.seen.get(number, ()):
                followed[road_user].append((time_s, track.number))
    return Evidence(
        visible=visible,
        clear=clear,
        found=clear if found is None else found,
        followed=followed,
        owner={track.number: owners.whole(track) for track in trajectories},
    )


def _detected(file: AnnotationFile, results: Path) -> Times:
    """Return the times at which each road user was detected."""
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
    reported: TrafficReport
    owners: Owners
    evidence: Evidence
    plain: Mapping[tuple[str, int], list[tuple[int, float]]]
    light: str

    @property
    def category(self) -> Mapping[int, str]:
        """Category of each true road user."""
        return {track.number: track.category for track in self.truth}

    @property
    def eye(self) -> Any:
        camera = self.file.images[0].camera
        assert camera is not None
        return camera.position

    def distance(self, crossing: GateCrossing) -> float:
        """Return the distance from the camera, metres."""
        return math.hypot(math.dist(crossing.position, self.eye[:2]), self.eye[2])


def paired(clip: ScoredClip) -> dict[int, int]:
    """Return the index of the true crossing for the index of each counted one."""
    real, counted = clip.real.crossings, clip.reported.crossings
    options = []
    for j, d in enumerate(counted):
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
    """Print all tables."""
    by_gate(clips)
    by_clip(clips)
    crossings = [row for clip in clips for row in clip["crossings"]]
    besides = [row for clip in clips for row in clip["besides"]]
    print("\n                      crossings  missed (90%)        double  no owner  did not cross  time within 90%")
    for title, key in (("distance", distance_of), ("class", class_of), ("light", light_of), ("label", state_of)):
        by_kind(crossings, besides, title, key)
    hidden = Counter(row["state"] for row in crossings if row["state"] not in VISIBLE)
    counted = sum(row["counted"] for row in crossings if row["state"] not in VISIBLE)
    print(f"\nhidden at the gate: {hidden['hidden']}, in the whole clip: {hidden['never']}; still counted: {counted}")
    causes = Counter(row["cause"] for row in visible(crossings) if not row["counted"])
    print("why missed:", ", ".join(f"{number} {cause}" for cause, number in causes.most_common()) or "-")


def visible(crossings: Iterable[Row]) -> list[Row]:
    """Return the crossings that count: those that are visible at the gate."""
    return [row for row in crossings if row["state"] in VISIBLE]


def distance_of(row: Row) -> str:
    """Return the bin of its distance."""
    k = int(np.searchsorted(BINS, row["distance"], side="right")) - 1
    return f"{BINS[k]}-{BINS[k + 1]} m" if k < len(BINS) - 2 else f"over {BINS[-2]} m"


def class_of(row: Row) -> str:
    """Return its class."""
    return str(row["class"])


def light_of(row: Row) -> str:
    """Return the light of its clip."""
    return str(row["light"])


def state_of(row: Row) -> str:
    """Return its visibility at the gate; "-" for a false or double crossing."""
    return str(row.get("state", "-"))


def by_gate(clips: Sequence[Row]) -> None:
    """Print a row for each gate and direction."""
    print("clip                        gate   dir   group    truth hidden  all plain counted  off      %  GEH 90%")
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
    """Print two rows for each clip."""
    print(
        "\nclip                        movements: truth counted wrong   v50 off, km/h  v85 off   headways: median (90%)"
    )
    for clip in clips:
        turning = clip["turning"]
        true, counted = (sum(row[key] for row in turning) for key in ("truth", "count"))
        wrong = sum(abs(row["truth"] - row["count"]) for row in turning)
        headways, conflicts = clip["headways"], clip["conflicts"]
        headway_text = f"{headways['matched']} of {headways['truth']}: {pair_of(headways)} s"
        print(
            f"{clip['clip']['name']:27.27} {true:16d} {counted:7d} {wrong:5d}  {speeds_off(clip, 'v50'):>14}  "
            f"{speeds_off(clip, 'v85'):>8}   {headway_text}"
        )
        pet = f"PET off {pair_of(conflicts['pet_ssam_s'])} s, of the area {pair_of(conflicts['pet_area_s'])} s"
        pairs = f"{conflicts['matched']} of {conflicts['truth']} conflicts, {conflicts['told']} reported"
        print(f"{'':27} {pairs}; {pet}")


def middle_of(values: Sequence[float]) -> dict[str, Any]:
    """Return the median and 90% quantile of values; None without values."""
    known = [value for value in values if not math.isnan(value)]
    names = {"median": 50, "p90": 90}
    return {name: float(np.percentile(known, share)) if known else None for name, share in names.items()}


def pair_of(values: Row) -> str:
    """Format a median and 90% quantile."""
    return "-" if values["median"] is None else f"{values['median']:.2f} ({values['p90']:.2f})"


def speeds_off(clip: Row, name: str) -> str:
    """Format the median of the absolute differences of a percentile, over the gates that report it."""
    off = [abs(row["told"] - row["truth"]) for row in clip["speeds"] if row["name"] == name and row["told"] is not None]
    return f"{np.median(off):.1f} [{len(off)}]" if off else "-"


def by_kind(crossings: Sequence[Row], besides: Sequence[Row], title: str, key: Callable[[Row], str]) -> None:
    """Print the misses and doubles of each kind, for crossings that are visible at the gate."""
    visible_crossings = visible(crossings)
    for kind in sorted({key(row) for row in (*visible_crossings, *besides)}):
        rows = [row for row in visible_crossings if key(row) == kind]
        missed = sum(not row["counted"] for row in rows)
        low, high = share_between(missed, len(rows))
        more = Counter(row["what"] for row in besides if key(row) == kind)
        within = [row["time_holds"] for row in rows if row["counted"]]
        share = f"{100 * missed / len(rows):.0f}%" if rows else "-"
        missed_text = f"{missed:4d} {share:>4} ({100 * low:.0f}-{100 * high:.0f}%)"
        print(
            f"{title:9} {kind:12} {len(rows):8d}  {missed_text:19} {more['double']:6d} {more['nobody']:9d} "
            f"{more['did not cross']:14d}  {f'{100 * np.mean(within):.0f}%' if within else '-':>15}"
        )


def share_between(number: int, of: int) -> tuple[float, float]:
    """Return the 90% interval of a share, by Clopper and Pearson."""
    from scipy.special import betaincinv

    low = float(betaincinv(number, of - number + 1, 0.05)) if number else 0.0
    return low, float(betaincinv(number + 1, of - number, 0.95)) if number < of else 1.0


RESULTS: Final = "results.json"
KINDS: Final = {"all": (True, False), "vehicles": (True,), "others": (False,)}
"""Groups of road users that are counted, and whether they include vehicles."""
Row = dict[str, Any]


def scored_clip(folder: Path, out: Path, light: str) -> ScoredClip:
    """Read the truth and measure the report of a clip; `out` has its tracks, made from labels if its name is "true"."""
    site, truth, file = read_site(folder / SITE), read_truth(folder), coco.read(folder / LABELS)
    report = measure(read_tracks(out / "tracks" / TRACKS_CSV), read_observation(out / "tracks"), site)
    owners = owners_of(out / "tracks", file)
    found = None if out.name == "true" else folder / SEEN / PREDICTIONS_FILE
    return ScoredClip(
        file=file,
        truth=truth.trajectories,
        real=measure(truth.trajectories, Observation(times_s=truth.times_s), site, broken=False),
        reported=report,
        owners=owners,
        evidence=evidence_of(file, found, owners, report.trajectories),
        plain=plain_counts(truth, site.gates),
        light=light,
    )


def score_clip(folder: Path, *, true_keypoints: bool) -> Row:
    """Compute all scores of a clip."""
    out, clip = reported(folder, true_keypoints), read_json(folder / CLIP)
    this = scored_clip(folder, out, str(clip["light"]))
    pairs = paired(this)
    summary = read_json(out / "report" / SUMMARY_FILE)
    return {
        "clip": dict(clip),
        "counts": count_rows(
            this, [row for row in summary["counts"] if row["class"] == ALL_CLASSES], this.real.observation.times_s
        ),
        "turning": turning_rows(this),
        "speeds": speed_rows(this),
        "headways": headway_rows(this, pairs),
        "conflicts": conflict_rows(this),
        "crossings": crossing_rows(this, pairs),
        "besides": besides_rows(this, pairs),
    }


# ---------------------------------------------------------------------------------------------------------------- rows


def count_rows(clip: ScoredClip, summary_rows: Sequence[Mapping[str, Any]], times_s: Any) -> list[Row]:
    """Compare counts by gate, direction and kind of road user; GEH uses the corresponding hourly volumes."""
    hourly = 3600 / (float(times_s[-1] - times_s[0]) or 1.0)
    rows = []
    for side in summary_rows:
        for group, kinds in KINDS.items():
            real, counted = (
                [
                    c
                    for c in report.crossings
                    if (c.gate, c.direction_name) == (side["gate"], side["direction"])
                    and (c.trajectory.category == VEHICLE_CATEGORY) in kinds
                ]
                for report in (clip.real, clip.reported)
            )
            if group == "all" and len(counted) != side["count"]:
                raise UserError(f"{side}: the count of the command differs from the one measured here: {len(counted)}")
            states = Counter(clip.evidence.state_of(c) for c in real)
            true, count = sum(states[name] for name in VISIBLE), len(counted)
            interval = expected_of(clip, side, kinds)
            plain = [number for number, _ in clip.plain[side["gate"], side_of(side, clip)]]
            rows.append(
                {
                    "gate": side["gate"],
                    "direction": side["direction"],
                    "who": group,
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
    """Return the interval of the count of vehicles, of other road users, or of both; None without one."""
    report = clip.reported
    totals = {
        row.class_name: row
        for row in report.counts_total
        if (row.gate, row.direction) == (side["gate"], side["direction"])
    }
    total = totals[ALL_CLASSES if len(chosen) > 1 or not chosen[0] else VEHICLE_CATEGORY]
    if len(chosen) > 1 or chosen[0]:
        return total.confidence_interval
    crossings = [
        crossing
        for crossing in (*report.crossings, *report.unseen.doubtful)
        if (crossing.gate, crossing.direction_name) == (total.gate, total.direction)
    ]
    direction = side_of(side, clip)
    kinds = report.unseen.kinds_at(total.gate, direction)[1:]
    most = partial(report.unseen.most, total.gate, direction, total.interval)
    return confidence_interval(crossings, kinds, most, ALL_CLASSES, {name for kind in kinds for name in kind.classes})


def side_of(side: Mapping[str, Any], clip: ScoredClip) -> int:
    """Return the direction of a row of the summary, 0 or 1."""
    (gate,) = (gate for gate in clip.real.site.gates if gate.name == side["gate"])
    return direction_names(gate).index(side["direction"])


def turning_rows(clip: ScoredClip) -> list[Row]:
    """Compare movements between two gates, of road users that were seen at both."""
    real, counted = (
        {
            (movement.origin, movement.destination, movement.class_name): movement
            for movement in report.turning_total
            if NO_GATE not in (movement.origin, movement.destination)
        }
        for report in (clip.real, clip.reported)
    )
    rows = []
    for pair in sorted({*real, *counted}):
        true, count = (side[pair].count or 0 if pair in side else 0 for side in (real, counted))
        expected = counted[pair].confidence_interval if pair in counted else None
        rows.append(
            {
                "from": list(pair[0]),
                "to": list(pair[1]),
                "who": pair[2],
                "truth": true,
                "count": count,
                "holds": expected.low <= true <= expected.high if expected is not None else None,
            }
        )
    return rows


def speed_rows(clip: ScoredClip) -> list[Row]:
    """Compare v50 and v85 of motor vehicles at each gate, km/h."""
    real, counted = (
        {
            entry.where: entry
            for entry in report.speeds
            if (entry.kind, entry.class_name, entry.interval) == ("spot", "motor", None)
        }
        for report in (clip.real, clip.reported)
    )
    rows = []
    for where, true_speed in real.items():
        speeds = [
            KMH_PER_MPS * c.speed
            for c in clip.real.crossings
            if f"{c.gate} ({c.direction_name})" == where and c.trajectory.class_name not in ("bicycle", "pedestrian")
        ]
        for name, share in (("v50", 0.5), ("v85", 0.85)):
            percentile = counted[where].percentiles[name] if where in counted else None
            value, low, high = (
                (percentile.value, percentile.low, percentile.high) if percentile is not None else (None,) * 3
            )
            true = float(np.quantile(speeds, share))
            row: Row = {"where": where, "name": name, "number": true_speed.number, "truth": true, "told": None}
            if value is not None and low is not None and high is not None:
                row |= {"told": KMH_PER_MPS * value, "holds": KMH_PER_MPS * low <= true <= KMH_PER_MPS * high}
            rows.append(row)
    return rows


def headway_rows(clip: ScoredClip, pairs: Mapping[int, int]) -> Row:
    """Compare headways: absolute differences in seconds, of pairs matched by their vehicles."""
    index = {id(c): i for i, c in enumerate(clip.real.crossings)}
    real = {(index[id(h.leader)], index[id(h.follower)]): h for h in clip.real.headways}
    which = {id(d): pairs.get(j) for j, d in enumerate(clip.reported.crossings)}
    off = [
        abs(h.headway_s - real[key].headway_s)
        for h in clip.reported.headways
        if (key := (which[id(h.leader)], which[id(h.follower)])) in real
    ]
    return {"truth": len(real), "told": len(clip.reported.headways), "matched": len(off), **middle_of(off)}


def conflict_rows(clip: ScoredClip) -> Row:
    """Compare PET by both definitions, of pairs matched by their road users.

    True tracks end where they are no longer visible; parts beyond the image, or hidden ones, would enlarge the common
    area.
    """
    shown = [seen for track in clip.truth if (seen := clip.evidence.shown(track)) is not None]
    search = conflicts(shown, clip.real.site.traffic, np.random.default_rng(0))
    real = {frozenset((c.first.number, c.second.number)): c for c in search.conflicts}
    counted = {
        frozenset((clip.owners.whole(c.first), clip.owners.whole(c.second))): c
        for c in clip.reported.conflicts.conflicts
    }
    in_both = real.keys() & counted.keys()
    return {
        "truth": len(real),
        "told": len(clip.reported.conflicts.conflicts),
        "matched": len(in_both),
        "overlapping": clip.reported.conflicts.overlapping,
        **{
            name: middle_of([abs(getattr(real[key], name) - getattr(counted[key], name)) for key in in_both])
            for name in ("pet_ssam_s", "pet_area_s", "ttc_s")
        },
    }


def crossing_rows(clip: ScoredClip, pairs: Mapping[int, int]) -> list[Row]:
    """Return a row for each true crossing: whether it was counted, with which class, or why not."""
    counted = {i: clip.reported.crossings[j] for j, i in pairs.items()}
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
    """Return a row for each counted crossing that is false or double."""
    crossed = {(c.trajectory.number, c.gate, c.direction) for c in clip.real.crossings}
    rows = []
    for j, d in enumerate(clip.reported.crossings):
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


TRACK_NEAR_M: Final = 1.5
"""Largest distance between a track and its vehicle, metres."""
MOST: Final = 0.6
"""Smallest share of a track's frames in which its vehicle must be near."""
FEWEST: Final = 24
"""Fewest moments of a track."""
LIMITS_M: Final = (5.2, 6.0, 6.55, 7.5, 9.0, 11.0)


@dataclass(frozen=True)
class Pair:
    """A track, and the length of its vehicle."""

    site: str
    track: Track
    true_m: float


def pairs_of(folder: Path, true_keypoints: bool) -> Iterator[Pair]:
    """Yield the tracks of a clip whose vehicles are known."""
    tracks = reported(folder, true_keypoints) / "tracks"
    truth = [vehicle for vehicle in read_truth(folder).trajectories if vehicle.category == VEHICLE_CATEGORY]
    at: defaultdict[float, list[tuple[int, Array]]] = defaultdict(list)
    for k, vehicle in enumerate(truth):
        for time_s, position in zip(vehicle.times_s, vehicle.xy, strict=True):
            at[round(float(time_s), 3)].append((k, position))
    for track in read_tracks(tracks / TRACKS_CSV):
        if track.category != VEHICLE_CATEGORY or not is_in_traffic(track) or len(track.times_s) < FEWEST:
            continue
        votes, moments = Counter[int](), 0
        for time_s, position in zip(track.times_s[::3], track.xy[::3], strict=True):
            present = at[round(float(time_s), 3)]
            away = [float(np.hypot(*(position - true_position))) for _, true_position in present]
            moments += bool(present)
            if present and min(away) < TRACK_NEAR_M:
                votes[present[int(np.argmin(away))][0]] += 1
        if votes and votes.most_common(1)[0][1] >= MOST * moments:
            length = truth[votes.most_common(1)[0][0]].length
            assert length is not None
            yield Pair(folder.name.rsplit("_", 1)[0], track, length)


def fitted(estimated: Array, true: Array) -> tuple[Array, float, float]:
    """Fit the errors of lengths.

    Returns:
        Shares (3,) of small errors, of large ones and of mistaken bodies, and the two relative standard deviations.
    """

    def unlikely(a: Array) -> float:
        shares = np.exp([0, *a[2:]]) / np.exp([0, *a[2:]]).sum()
        off = (true - estimated) / estimated
        parts = (norm.pdf(off, 0, np.exp(a[0])) / estimated, norm.pdf(off, 0, np.exp(a[1])) / estimated, 0.1)
        return -float(np.log(sum(share * part for share, part in zip(shares, parts, strict=True))).sum())

    a = minimize(unlikely, [-4, -2.5, -1, -5], method="Nelder-Mead", options={"maxiter": 4000}).x
    shares = np.exp([0, *a[2:]]) / np.exp([0, *a[2:]]).sum()
    return shares, float(np.exp(a[0])), float(np.exp(a[1]))


def print_fit(pairs: Sequence[Pair]) -> None:
    """Print the errors of each class of tracks."""
    for name in sorted({pair.track.class_name for pair in pairs}):
        class_pairs = [pair for pair in pairs if pair.track.class_name == name]
        estimated, true = (
            np.array([value(pair) for pair in class_pairs]) for value in (lambda p: p.track.length, lambda p: p.true_m)
        )
        shares, small, large = fitted(estimated, true)
        rms = float(np.sqrt(np.mean((estimated - true) ** 2)))
        print(f"{name:8} {len(class_pairs):4} {np.round(shares, 3)} {small:.3f} {large:.3f}  rms {rms:.2f} m")


def print_bins(pairs: Sequence[Pair]) -> None:
    """Print the number of vehicles at each site that are longer than some limits."""
    for site in sorted({pair.site for pair in pairs}):
        site_pairs = [pair for pair in pairs if pair.site == site]
        for limit in LIMITS_M:
            longer = np.array([1 - bin_probabilities(pair.track, (limit, 30.0), None)[0] for pair in site_pairs])
            spread = INTERVAL_SIGMAS * float(np.sqrt((longer * (1 - longer)).sum()))
            true, estimated = (
                sum(v > limit for v in vs)
                for vs in ([p.true_m for p in site_pairs], [p.track.length for p in site_pairs])
            )
            print(
                f"{site:24} over {limit:5.2f} m: {true:3} in truth, {estimated:3} estimated, "
                f"{longer.sum():5.1f} +- {spread:.1f}"
            )


def clips_of(options: argparse.Namespace) -> list[Path]:
    """Return the folders of the chosen clips."""
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
    for name, run, quantities in (
        ("counts", score_counts, "counts, speeds, headways and conflicts"),
        ("lengths", fit_lengths, "vehicle lengths"),
    ):
        command = commands.add_parser(name, help=f"{quantities} against the truth")
        command.add_argument("folder", type=Path, help="folder of the clips")
        command.add_argument("--only", default="", help="names of clips, separated by commas, or `checks`")
        command.add_argument(
            "--true-keypoints", action="store_true", help="use labels with 2 px of noise instead of detections"
        )
        command.set_defaults(run=run)
    options = parser.parse_args()
    options.run(options)


if __name__ == "__main__":
    main()
