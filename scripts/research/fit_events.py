"""Fit what skope/traffic/event_probability.py holds: how probable counted crossings are, and how many are missed.

    python scripts/research/traffic_clips.py score clips/travel --out scored
    python scripts/research/fit_events.py scored
    python scripts/research/fit_events.py scored_checks --coverage          # nothing fitted: do the intervals hold?

Crossings of vehicles: a logistic regression of what `crossing_evidence` says, with a small ridge; beside it the same
with each site left out in turn, by which its calibration is printed. Others: shares. What is missed, and who came of
those who vanished: Beta-binomial over gates and directions, together by maximum likelihood.
"""

import argparse
import itertools
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from scipy.optimize import minimize
from scipy.special import betaln, gammaln
from traffic_clips import CLIP
from traffic_evidence import paired
from traffic_scores import clip_of, count_rows, side_of
from traffic_tables import VISIBLE

from skope.files.json_files import read_json
from skope.schema import VEHICLE
from skope.traffic.event_probability import SEEN_IN_METRES, crossing_evidence, usual_step
from skope.traffic.gate_counts import ALL
from skope.types import Array

_RIDGE: Final = 1e-3
_PRIOR: Final = 0.02
"""Of the logarithms of a Beta distribution's parameters: against shares that few gates say too much of."""
_BINS: Final = (0.0, 0.3, 0.5, 0.7, 0.9, 0.97, 1.01)


@dataclass(frozen=True)
class Crossing:
    """A crossing that was told, counted or not."""

    where: tuple[str, str, int]
    """Clip, gate and direction."""
    site: str
    category: str
    evidence: tuple[float, ...]
    probability: float
    counts: bool
    happened: bool


@dataclass(frozen=True)
class Missed:
    """Of a gate and direction, those who are seen alike."""

    kind: int
    """Of `SEEN_IN_METRES`."""
    crossed: int
    not_told: int
    possible: int
    """How many vanished before the gate, or came from nowhere behind it."""


def read_clip(folder: Path) -> tuple[list[Crossing], list[Missed]]:
    """What there is to fit in a clip that was scored."""
    clip = clip_of(folder, true_keypoints=False, clip=read_json(folder / CLIP))
    every = (*clip.told.crossings, *clip.told.unseen.doubtful)
    told = replace(clip, told=replace(clip.told, crossings=every))
    pairs = paired(told)
    step_s = usual_step(told.told.trajectories)
    crossings = [
        Crossing(
            where=(folder.name, one.gate, one.direction),
            site=read_json(folder / CLIP)["site"],
            category=one.trajectory.category,
            evidence=crossing_evidence(one.trajectory, one.time_s, step_s),
            probability=one.probability,
            counts=one.counts,
            happened=j in pairs,
        )
        for j, one in enumerate(every)
    ]
    found = set(pairs.values())
    missed = []
    for total in (one for one in clip.told.counts_total if one.class_name == ALL):
        for k, kind in enumerate(SEEN_IN_METRES):
            own = [
                i
                for i, one in enumerate(clip.real.crossings)
                if (one.gate, one.direction_name) == (total.gate, total.direction)
                and one.trajectory.class_name in kind.classes
                and clip.evidence.state_of(one) in VISIBLE
            ]
            side = side_of({"gate": total.gate, "direction": total.direction}, clip)
            possible = clip.told.unseen.most(total.gate, side, total.interval, kind.classes)
            missed.append(Missed(k, len(own), sum(i not in found for i in own), possible))
    return crossings, missed


# ------------------------------------------------------------------------------------------------------------ fitting


def logistic(evidence: Array, happened: Array) -> Array:
    """(K,) weights of evidence (N, K), by maximum likelihood."""

    def loss(weights: Array) -> float:
        logits = (2 * happened - 1) * (evidence @ weights)
        return float(np.logaddexp(0, -logits).mean() + _RIDGE * (weights[1:] ** 2).sum())

    return np.asarray(minimize(loss, np.zeros(evidence.shape[1])).x)


def fit_vehicles(crossings: Sequence[Crossing]) -> None:
    """Print the weights, and how well they say it of sites that a fit has not seen."""
    own = [one for one in crossings if one.category == VEHICLE]
    evidence, happened = np.array([one.evidence for one in own]), np.array([float(one.happened) for one in own])
    sites = np.array([one.site for one in own])
    print(f"vehicles, of {len(own)} crossings: {logistic(evidence, happened).round(2).tolist()}")
    unseen = np.zeros(len(own))
    for name in set(sites):
        weights = logistic(evidence[sites != name], happened[sites != name])
        unseen[sites == name] = 1 / (1 + np.exp(-evidence[sites == name] @ weights))
    calibration("  each site by the others", unseen, happened)


def calibration(title: str, said: Array, happened: Array) -> None:
    """Print how often what was said with some probability happened."""
    print(title)
    for low, high in itertools.pairwise(_BINS):
        inside = (said >= low) & (said < high)
        if inside.any():
            print(f"    said {said[inside].mean():.2f}  was {happened[inside].mean():.2f}  of {inside.sum()}")


def fit_others(crossings: Sequence[Crossing]) -> None:
    """Print the share of others' crossings that happened, and as which Beta distribution gates differ in it."""
    for name in sorted({one.category for one in crossings} - {VEHICLE}):
        own = [one for one in crossings if one.category == name and one.counts]
        gates: dict[Any, list[bool]] = defaultdict(list)
        for one in own:
            gates[one.where].append(one.happened)
        numbers = np.array([(sum(happened), len(happened)) for happened in gates.values()])
        if len(numbers):
            a, b = beta_of(numbers[:, 0], numbers[:, 1])
            share = numbers[:, 0].sum() / numbers[:, 1].sum()
            print(f"{name}, of {len(own)} at {len(gates)} gates and ways: {share:.2f}, over gates ({a:.2f}, {b:.2f})")
        every = [one for one in crossings if one.category == name]
        said, was = np.array([one.probability for one in every]), np.array([one.happened for one in every])
        calibration("  as it is said now", said, was)


def log_beta_binomial(number: Array, of: Array, a: float, b: float) -> Array:
    """Logarithm of the probability of so many of so many."""
    ways = gammaln(of + 1) - gammaln(number + 1) - gammaln(of - number + 1)
    return np.asarray(ways + betaln(number + a, of - number + b) - betaln(a, b))


def beta_of(number: Array, of: Array) -> Array:
    """(2,) parameters of the Beta distribution of a share that gates differ in."""
    return most_probable(lambda a, b: -float(log_beta_binomial(number, of, a, b).sum()), 2)


def most_probable(loss: Callable[..., float], parameters: int) -> Array:
    """(K,) parameters, all positive, at which a loss is the least."""
    start = np.zeros(parameters)
    found = minimize(
        lambda logs: loss(*np.exp(logs)) + _PRIOR * float((logs**2).sum()),
        start,
        method="Nelder-Mead",
        options={"maxiter": 5000, "maxfev": 5000},
    )
    return np.asarray(np.exp(found.x))


def fit_missed(rows: Sequence[Missed]) -> None:
    """Print the Beta distributions of what is missed without a trace, and of who came of those who vanished."""
    for title, kinds in (("vehicles", (0,)), ("others", (1, 2))):
        own = [row for row in rows if row.kind in kinds and (row.crossed or row.possible)]

        def loss(came: float, not_came: float, missed: float, seen: float, own: Sequence[Missed] = own) -> float:
            total = 0.0
            for row in own:
                of_those = np.arange(min(row.possible, row.not_told) + 1.0)
                rest = row.not_told - of_those
                chances = log_beta_binomial(of_those, np.float64(row.possible), came, not_came)
                chances = chances + log_beta_binomial(rest, np.maximum(row.crossed - of_those, rest), missed, seen)
                total -= float(np.logaddexp.reduce(chances))
            return total

        came, not_came, missed, seen = most_probable(loss, 4)
        crossed, lost = sum(row.crossed for row in own), sum(row.not_told for row in own)
        print(
            f"{title}: {lost} of {crossed} were not told; missed=({missed:.2f}, {seen:.2f}) "
            f"came=({came:.2f}, {not_came:.2f}) of {sum(row.possible for row in own)} who vanished"
        )


# ------------------------------------------------------------------------------------------------------------ coverage


def covered(folder: Path) -> list[dict[str, Any]]:
    """The counts of a clip, with their intervals."""
    clip = clip_of(folder, true_keypoints=False, clip=read_json(folder / CLIP))
    sides = [
        {"gate": one.gate, "direction": one.direction, "count": one.count}
        for one in clip.told.counts_total
        if one.class_name == ALL
    ]
    return [{**row, "clip": folder.name} for row in count_rows(clip, sides, clip.told.observation.times_s)]


def print_coverage(rows: Sequence[dict[str, Any]]) -> None:
    """How often the intervals hold the truth, and how wide they are."""
    for who in ("vehicles", "others", "all"):
        own = [row for row in rows if row["who"] == who and row["holds"] is not None]
        busy = [row for row in own if row["truth"] or row["count"]]
        if busy:
            near = np.mean([abs(row["difference"]) <= max(1, 0.03 * row["truth"]) for row in busy])
            width = np.mean([row["high"] - row["low"] for row in busy])
            print(
                f"{who}: truth {sum(row['truth'] for row in own)}, counted {sum(row['count'] for row in own)}; "
                f"{len(own)} intervals hold it {np.mean([row['holds'] for row in own]):.0%}, "
                f"{len(busy)} with traffic {np.mean([row['holds'] for row in busy]):.0%}, {width:.1f} wide; "
                f"within 3% or one {near:.0%}"
            )
        for row in own:
            if not row["holds"]:
                print(
                    "   ",
                    row["clip"],
                    row["gate"],
                    row["direction"],
                    row["truth"],
                    row["count"],
                    row["low"],
                    row["high"],
                )


def scored(folder: Path) -> Iterator[Path]:
    """The clips in a folder that were tracked."""
    return (path.parents[2] for path in sorted(folder.glob("*/found/tracks/footage.json")))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+", help="of clips that were scored")
    parser.add_argument("--coverage", action="store_true", help="how often the intervals hold the truth; no fit")
    parser.add_argument("--workers", type=int, default=1)
    options = parser.parse_args()
    folders = [clip for folder in options.folder for clip in scored(folder)]
    if not folders:
        parser.error("no clips that were tracked")
    with ProcessPoolExecutor(options.workers) as workers:
        if options.coverage:
            print_coverage([row for rows in workers.map(covered, folders) for row in rows])
            return
        read = list(workers.map(read_clip, folders))
    crossings = [one for found, _ in read for one in found]
    fit_vehicles(crossings)
    fit_others(crossings)
    fit_missed([row for _, rows in read for row in rows])


if __name__ == "__main__":
    main()
