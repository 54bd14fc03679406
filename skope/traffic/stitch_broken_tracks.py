"""Stitch tracks that a mast, a bus or a key frame has broken, by position, time, speed and body.

The probability that two tracks belong to one road user depends on how well the second track continues the first. This
fit is compared with all other possible continuations, and with the rate at which unrelated tracks begin there. Only
likely pairs are joined. The probability of a joined pair is a factor of the probability of its events.
"""

import math
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.schema import VEHICLE_CATEGORY
from skope.tracks.track import Track, concatenated, worst_sigma


@dataclass(frozen=True)
class JoinLimits:
    """Limits of joining broken tracks."""

    longest_gap_s: float = 8.0
    """Longest gap between two tracks of one road user, seconds."""
    overlap_s: float = 0.6
    """Longest overlap of two tracks, seconds. A track may continue by its box for half a second after the next track
    has begun."""
    acceleration_mps2: float = 1.5
    """Standard deviation of the acceleration in a gap, along and across, m/s^2."""
    unevenness_mps2: float = 1.5
    """Standard deviation of the deviation from a constant acceleration, m/s^2."""
    largest_sigma_m: float = 8.0
    """Largest standard deviation of the predicted position for joining, metres."""
    new_per_m2_s: float = 2e-5
    """Rate of unrelated tracks that begin on the road, per square metre and second."""
    size_sigma: float = 0.08
    """Relative standard deviation of a measured length."""
    probability: float = 0.8
    """Minimum probability for joining two tracks."""


JOIN_LIMITS: Final = JoinLimits()


def stitch_tracks(tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks with broken tracks joined, in order of their start."""
    ordered = sorted(tracks, key=lambda track: (float(track.times_s[0]), track.number))
    follows: dict[int, tuple[int, float]] = {}
    taken: set[int] = set()
    for probability, i, j in _likely_pairs(ordered):
        if i not in follows and j not in taken:
            follows[i] = j, probability
            taken.add(j)
    out = []
    for i in range(len(ordered)):
        if i in taken:
            continue
        whole, at = ordered[i], i
        while at in follows:
            at, probability = follows[at]
            whole = _together(whole, ordered[at], probability)
        out.append(whole)
    return out


def _likely_pairs(ordered: Sequence[Track]) -> list[tuple[float, int, int]]:
    """Return the pairs to join as (probability, first index, second index), most likely first."""
    begins = np.array([track.times_s[0] for track in ordered])
    likelihood: dict[tuple[int, int], float] = {}
    by_end, by_begin = defaultdict[int, float](float), defaultdict[int, float](float)
    for i, before in enumerate(ordered):
        end_s = float(before.times_s[-1])
        low, high = np.searchsorted(begins, [end_s - JOIN_LIMITS.overlap_s, end_s + JOIN_LIMITS.longest_gap_s])
        for j in range(int(low), int(high)):
            if i != j and (value := _likelihood(before, ordered[j])) > 0:
                likelihood[i, j] = value
                by_end[i] += value
                by_begin[j] += value
    stranger = JOIN_LIMITS.new_per_m2_s * JOIN_LIMITS.longest_gap_s
    pairs = [(value / (by_end[i] + by_begin[j] - value + stranger), i, j) for (i, j), value in likelihood.items()]
    return sorted((pair for pair in pairs if pair[0] >= JOIN_LIMITS.probability), reverse=True)


def _likelihood(before: Track, after: Track) -> float:
    """Return the probability density, per square metre, that `after` continues `before`; 0 if that is impossible."""
    if before.category != after.category or "impossible_motion" in {*before.flags, *after.flags}:
        return 0.0
    if before.category != VEHICLE_CATEGORY and "never_moved" in {*before.flags, *after.flags}:
        return 0.0  # an object that was detected as a pedestrian or rider: a road user that passes it is not the object
    kept = _until(before, float(after.times_s[0]))
    if kept is None or kept.times_s[-1] < before.times_s[-1] - JOIN_LIMITS.overlap_s:
        return 0.0
    before = kept
    gap = float(after.times_s[0] - before.times_s[-1])
    # Under constant acceleration, the displacement is that of the mean of the two velocities.
    missing = after.xy[0] - before.xy[-1] - (before.velocity[-1] + after.velocity[0]) / 2 * gap
    sigma_v = math.hypot(float(before.speed_sigma[-1]), float(after.speed_sigma[0])) / 2
    sigma_v = math.hypot(sigma_v, JOIN_LIMITS.unevenness_mps2 * gap / 4)
    spread = before.covariance[-1] + after.covariance[0] + (sigma_v * gap) ** 2 * np.eye(2)
    if worst_sigma(spread) > JOIN_LIMITS.largest_sigma_m:
        return 0.0
    turned = after.velocity[0] - before.velocity[-1]
    slack = (
        float(before.speed_sigma[-1]) ** 2
        + float(after.speed_sigma[0]) ** 2
        + 0.25
        + (JOIN_LIMITS.acceleration_mps2 * gap) ** 2
    )
    total = float(missing @ np.linalg.solve(spread, missing)) + float(turned @ turned) / slack
    if before.length and after.length:
        sigma = math.sqrt(2) * JOIN_LIMITS.size_sigma * (before.length + after.length) / 2
        total += ((before.length - after.length) / sigma) ** 2
    density = 1 / (2 * math.pi * math.sqrt(max(1e-12, float(np.linalg.det(spread)))))
    return density * math.exp(-total / 2) if total < 16 else 0.0


def _until(track: Track, end_s: float) -> Track | None:
    """Return the part of a track before a time; None if the track begins later."""
    if track.times_s[-1] < end_s:
        return track
    rows = track.times_s < end_s
    return track.during(rows) if rows.any() else None


def _together(before: Track, after: Track, probability: float) -> Track:
    """Return one track made of two. `Track.at` interpolates linearly between them."""
    kept = _until(before, float(after.times_s[0]))
    assert kept is not None
    longer, shorter = sorted((before, after), key=lambda track: -int(track.located.sum()))
    return replace(
        longer,
        **concatenated(kept, after),
        number=before.number,
        class_confidence=_confidence(longer, shorter),
        flags=_flags(before, after),
        joined=(*before.joined, after.number, *after.joined),
        stitch_probability=before.stitch_probability * after.stitch_probability * probability,
    )


def _flags(before: Track, after: Track) -> tuple[str, ...]:
    """Return the flags of both tracks. "never_moved" remains only if both have it."""
    moved = "never_moved" not in before.flags or "never_moved" not in after.flags
    names = dict.fromkeys((*before.flags, *after.flags))
    return tuple(name for name in names if not (moved and name == "never_moved"))


def _confidence(longer: Track, shorter: Track) -> float:
    """Return the confidence of the longer track's class, reduced if the shorter track has a different class."""
    return longer.class_confidence * (1.0 if longer.class_name == shorter.class_name else 0.8)
