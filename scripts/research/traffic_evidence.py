"""Who a track really is, and why somebody was not counted: boxes of tracks and detections on the labels' boxes.

    python scripts/research/traffic_evidence.py clips/NAME/labels.json clips/NAME/true/tracks

It prints each track's road users by their numbers in the labels, those that it has most often first.
"""

import argparse
import math
import subprocess
import sys
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from footage_scores import matched
from traffic_gates import SITE

from skope.dataset import coco
from skope.schema import CATEGORIES, AnnotationFile, Labelled
from skope.tracks.track import Track
from skope.traffic.gates import GateCrossing
from skope.traffic.observation import FOOTAGE
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.write_report import SUMMARY

LABELS: Final = "labels.json"
SEEN: Final = "seen"
NOISE_PX: Final = "2"
GROUND: Final = "0"
"""The roads of all the clips' sites are level there."""
AT_GATE_S: Final = 0.5
"""Whether somebody is visible at a gate is asked so long before and after."""
AROUND_S: Final = 2.0
"""And whether it was found and followed there, so long."""
SAME_S: Final = 2.0
"""The crossing of one and the same vehicle is found when it is so near in time."""
NEAR_S, NEAR_M = 0.7, 2.5
"""That of a vehicle that nothing says is the same, when it is so near in time and place."""
SCORE: Final = 0.5
"""Detections above this are tracked."""
Times = Mapping[int, list[float]]


def run_skope(*words: str) -> None:
    subprocess.run([sys.executable, "-m", "skope", *words, "-q"], check=True, stdout=subprocess.DEVNULL)


def reported(folder: Path, out: Path, true_keypoints: bool) -> None:
    """Track the clip and measure its traffic with the commands of every user; what is done is not done again."""
    if not (out / "tracks" / FOOTAGE).is_file():
        camera = ["--camera", str(folder / LABELS)]
        noisy = ["--annotations", str(folder / LABELS), "--noise", NOISE_PX]
        what = noisy if true_keypoints else [str(folder / SEEN), *camera]
        run_skope("eval", "track", *what, "--ground", GROUND, "--out", str(out / "tracks"))
    if not (out / "report" / SUMMARY).is_file():
        run_skope("eval", "traffic", str(out / "tracks"), "--site", str(folder / SITE), "--out", str(out / "report"))


@dataclass(frozen=True)
class Owners:
    """Whose boxes each track has."""

    seen: Mapping[int, list[tuple[float, int]]]
    """Times and numbers in the labels, by track."""

    def _votes(self, trajectory: Track) -> list[tuple[float, int]]:
        return [vote for number in (trajectory.number, *trajectory.joined) for vote in self.seen.get(number, ())]

    def of(self, trajectory: Track, time_s: float) -> int | None:
        """Who a trajectory is around a time; None: nobody whom the labels know."""
        votes = self._votes(trajectory)
        near = [vote for vote in votes if abs(vote[0] - time_s) < AROUND_S]
        return _most(who for _, who in near or votes)

    def whole(self, trajectory: Track) -> int | None:
        """Who it is in the whole clip."""
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
    """Hold the boxes of the files for MOTChallenge against the labels."""
    boxes: dict[int, list[tuple[str, Any]]] = defaultdict(list)
    for name in ("mot.txt", *(f"mot_{category}.txt" for category in CATEGORIES[1:])):
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
    """When everybody was visible, found and followed."""

    visible: Times
    """By number in the labels: times with a visible pixel."""
    clear: Times
    """And those at which the label is not ignored."""
    found: Times
    """Times with a detection."""
    followed: Mapping[int, list[tuple[float, int]]]
    """Times and the trajectory that has it then."""
    owner: Mapping[int, int | None]
    """Who each trajectory is in the whole clip."""
    categories: Mapping[str, int]
    """How often a detection of somebody had which category, as "20-40 m: vehicle as pedestrian"; empty without."""

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
        """Why a crossing is not counted."""
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
    """Collect it; without results the labels that are not ignored are what was detected."""
    visible, clear, found = defaultdict[int, list[float]](list), defaultdict[int, list[float]](list), None
    for image, labels in zip(file.images, labels_of(file), strict=True):
        for label in labels:
            assert label.track_id is not None
            visible[label.track_id].append(float(image.time_s or 0.0))
            if not label.ignored:
                clear[label.track_id].append(float(image.time_s or 0.0))
    categories: Mapping[str, int] = {}
    if results is not None:
        found, categories = _detected(file, results)
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
        categories=categories,
    )


def _detected(file: AnnotationFile, results: Path) -> tuple[Times, Mapping[str, int]]:
    """When everybody was detected, and as what, by distance."""
    by_image: dict[int, list[tuple[str, Any]]] = defaultdict(list)
    for k, result in enumerate(coco.iter_all_results(results)):
        if result.score >= SCORE:
            by_image[result.image_id].append((f"{k} {CATEGORIES[result.category_id - 1]}", result.bbox))
    times: dict[int, list[float]] = defaultdict(list)
    categories = Counter[str]()
    for image, labels in zip(file.images, labels_of(file), strict=True):
        taken = matched(labels, by_image[image.id])  # type: ignore[arg-type]
        for label in labels:
            if label.id in taken and label.track_id is not None:
                times[label.track_id].append(float(image.time_s or 0.0))
                true = CATEGORIES[getattr(label, "category_id", 1) - 1]
                far = int((label.distance or 0.0) // 20) * 20
                categories[f"{far}-{far + 20} m: {true} as {taken[label.id].split()[1]}"] += 1
    return times, dict(sorted(categories.items()))


@dataclass(frozen=True)
class Clip:
    """What is known and what is said of a clip."""

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
        return math.hypot(math.dist(crossing.place, self.eye[:2]), self.eye[2])


def paired(clip: Clip) -> dict[int, int]:
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
            if same or (late < NEAR_S and math.dist(c.place, d.place) < NEAR_M):
                options.append((not same, late, j, i))
    out: dict[int, int] = {}
    for _, _, j, i in sorted(options):
        if j not in out and i not in out.values():
            out[j] = i
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("labels", type=Path)
    parser.add_argument("tracks", type=Path, help="folder that `skope eval track` wrote")
    options = parser.parse_args()
    for number, votes in sorted(owners_of(options.tracks, coco.read(options.labels)).seen.items()):
        print(f"track {number}:", *(f"{who} ({n})" for who, n in Counter(who for _, who in votes).most_common()))


if __name__ == "__main__":
    main()
