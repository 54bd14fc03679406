"""Fit what skope/traffic/length_bins.py holds: how far the lengths of vehicles are off.

    python scripts/research/traffic_clips.py score clips/travel --out scored
    python scripts/research/fit_lengths.py scored

A track is that vehicle's in truth which it is nearest to in most of its frames. For each class of tracks it prints what
the errors are, as two normal distributions and a share of bodies that were mistaken; then, for each site, how many
vehicles are longer than some limits: in truth, as lengths say, and as `bin_probabilities` expects with 90%.
"""

import argparse
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from scipy.optimize import minimize
from scipy.stats import norm
from traffic_truth import TRUTH, read_truth

from skope.schema import VEHICLE
from skope.tracks.csv_file import TRACKS_CSV, read_tracks
from skope.tracks.track import Track, is_in_traffic
from skope.traffic.length_bins import bin_probabilities
from skope.traffic.normal_distribution import INTERVAL_SIGMAS
from skope.types import Array

TRACKS: Final = "found/tracks"
NEAR_M: Final = 1.5
MOST: Final = 0.6
"""A track is a vehicle's that it is near to in so many of its frames."""
FEWEST: Final = 24
"""Moments that a track has at least."""
LIMITS_M: Final = (5.2, 6.0, 6.55, 7.5, 9.0, 11.0)


@dataclass(frozen=True)
class Pair:
    """A track, and how long its vehicle is."""

    site: str
    track: Track
    true_m: float


def pairs_of(folder: Path) -> Iterator[Pair]:
    """The tracks of a clip whose vehicles are known."""
    tracks = folder / TRACKS
    truth = [one for one in read_truth(folder).trajectories if one.category == VEHICLE]
    at: defaultdict[float, list[tuple[int, Array]]] = defaultdict(list)
    for k, one in enumerate(truth):
        for time_s, place in zip(one.times_s, one.xy, strict=True):
            at[round(float(time_s), 3)].append((k, place))
    for track in read_tracks(tracks / TRACKS_CSV):
        if track.category != VEHICLE or not is_in_traffic(track) or len(track.times_s) < FEWEST:
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
    """How many vehicles of each site are longer than limits."""
    for site in sorted({one.site for one in pairs}):
        own = [one for one in pairs if one.site == site]
        for limit in LIMITS_M:
            longer = np.array([1 - bin_probabilities(one.track, (limit, 30.0), None)[0] for one in own])
            spread = INTERVAL_SIGMAS * float(np.sqrt((longer * (1 - longer)).sum()))
            true, told = (sum(v > limit for v in vs) for vs in ([p.true_m for p in own], [p.track.length for p in own]))
            print(
                f"{site:24} over {limit:5.2f} m: {true:3} in truth, {told:3} told, {longer.sum():5.1f} +- {spread:.1f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scored", type=Path, help="what `traffic_clips.py score` wrote")
    scored: Path = parser.parse_args().scored
    folders = [one.parent for one in sorted(scored.glob(f"*/{TRUTH}")) if (one.parent / TRACKS / TRACKS_CSV).is_file()]
    if not folders:
        parser.error("no clips that were tracked")
    pairs = [pair for folder in folders for pair in pairs_of(folder)]
    print(f"{len(pairs)} tracks; shares of small and large errors and of mistaken bodies, and standard deviations")
    print_fit(pairs)
    print_bins(pairs)


if __name__ == "__main__":
    main()
