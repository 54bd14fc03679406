"""Probabilities that an event happened once, and that events happened that nothing saw.

Measured on 13 generated clips of four sites by day, at night and in rain, of which everything is known
(`scripts/research/traffic_clips.py`, 2217 crossings that were told); sites that a fit has not seen say the same of it.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import expit

from skope.schema import PEDESTRIAN, VEHICLE
from skope.site.traffic_settings import CLASSES, OF_VEHICLES, UNKNOWN
from skope.tracks.track import Track, worst_sigma
from skope.traffic.count_uncertainty import Group
from skope.traffic.gate_shares import Beta, LearntShares

COUNTED_FROM: Final = 0.5
"""A less probable event is not counted."""
_MOST_PLACES: Final = 48
"""More places than this say no more."""
_DOUBTED: Final = 0.75
"""Factor for a track with one of `_DOUBTS`."""
_DOUBTS: Final = frozenset({"two_poses", "impossible_motion", "against_traffic"})
_AROUND_S: Final = 1.5
"""A crossing is surer the shorter the longest time without a place is, from so long before until so long after it."""
_HALF_S: Final = 0.5
"""And the more parts of this length have a place, before and after it."""
_USUAL_STEP_S: Final = 0.1
"""Time from place to place in the footage that this was measured on."""
_LOGIT: Final = (-2.29, 0.90, -2.57, -2.39, -1.07)
"""Of the log odds that a vehicle's crossing is one: constant, and what they change with the logarithms of parts with a
place (and one) on the side that has fewer, of the place's standard deviation (and 0.05 m), and of the longest time
without a place (and 0.1 s), and with a class that is unknown."""
_REAL_OF_OTHERS: Final[Mapping[str, float]] = {"bicycle": 0.89, "motorcycle": 0.89, "pedestrian": 0.87}
"""Share of others' crossings that are one, of 98, 99 and 157 well inside a gate: nothing of the track says more."""
_FASTEST: Final[Mapping[str, float]] = {"bicycle": 16.0, "pedestrian": 6.0}
"""A track that is faster where it crosses, m/s, jumps from one to another: only a sprinter, or a cyclist downhill, is
as fast."""
_JUMPS: Final = 0.1
"""Factor for such a crossing."""
_SAME_VEHICLE: Final = (6.13, -3.55, -1.54)
"""Of the log odds that a track is one vehicle from one gate to the next: constant, and what they change with the
logarithms of the longest time without a place meanwhile (and 0.1 s) and of the time between (and 1 s). Of 526 such
13 had gone over to another vehicle, 12 of them where nothing was seen for a second or longer."""
_SAME_WALKER: Final = (-1.91, -4.54)
"""The same of people: constant, and what they change with the logarithm of the largest standard deviation of their
place meanwhile (and 0.05 m). Of 43 tracks 25 had gone over to somebody who walks beside."""
_SAME_RIDER: Final = 0.976
"""The same of two-wheelers: 41 of 42 were one."""
_FEW_VANISH: Final = 2
"""So many vanish at any gate."""


@dataclass(frozen=True)
class SeenAlike:
    """Road users of whom is missed, and counted wrongly, alike."""

    classes: frozenset[str]
    missed: Beta
    """The share that is missed at a gate without a trace, as a Beta distribution."""
    came: Beta
    """The share of those who were lost before a gate or found behind it (`skope.traffic.missed_crossings`) who did
    cross it, as a Beta distribution: nearly none where vehicles are seen at the gate, all where the camera loses them
    there."""
    real: Beta | None = None
    """The share of the crossings at a gate that are one, where gates differ in it: as a Beta distribution."""
    refused: bool = False
    """Whether nothing is said of a gate where more of them vanish than cross: of such gates some see nobody."""
    too_small: bool = False
    """Whether nothing is said of any: too few are seen."""
    learnt: LearntShares | None = None
    """One gate's shares as hand counts tell them; None: they tell nothing."""

    @property
    def mean_missed(self) -> float:
        """The share that is missed without a trace, in the mean."""
        return self.missed[0] / sum(self.missed) if self.learnt is None else float(self.learnt.missed.mean())

    def loses(self, crossed: int, vanished: int) -> bool:
        """Whether a gate sees so few of those who come there that nothing can be said of their number."""
        return self.too_small or (self.refused and vanished > max(_FEW_VANISH, crossed))

    def group(self, probabilities: Sequence[float], possible: int = 0) -> Group:
        """Those of them who were counted with these probabilities, and how many more may have been there."""
        return Group(probabilities, self.missed, self.real, possible, self.came, self.learnt)


_VEHICLES: Final = SeenAlike(OF_VEHICLES, missed=(0.09, 1.94), came=(0.04, 0.52), refused=True)
_LARGE: Final = 17.0
_SMALL: Final = 12.7
"""Pixels of a metre where who walks is 29 and 22 pixels high."""
_TWO_WHEELED: Final = frozenset({"bicycle", "motorcycle"})
_OTHERS: Final = (_TWO_WHEELED, frozenset({PEDESTRIAN}))


def seen_in_metres(pixels_per_metre: float | None) -> tuple[SeenAlike, ...]:
    """Kinds of road users that are missed alike, where a metre is so many pixels; None: that is not known.

    4% of vehicles are missed in the mean without a trace, by day, at night and in rain alike. Of people and
    two-wheelers it depends on how large they are in the image: of 185, 361 and 143 who were large, smaller and too
    small 14, 40 and 81% were not told.
    """
    missed, came = (1.43, 2.3), (0.08, 12.6)
    if pixels_per_metre is not None and pixels_per_metre >= _LARGE:
        missed, came = (0.07, 3.1), (0.87, 2.37)
    small = pixels_per_metre is not None and pixels_per_metre < _SMALL
    if small:
        missed, came = (13.1, 2.64), (0.10, 9.95)
    return _VEHICLES, *(SeenAlike(classes, missed=missed, came=came, too_small=small) for classes in _OTHERS)


SEEN_IN_METRES: Final = seen_in_metres(None)
"""Kinds where it is not known how many pixels a metre is."""

SEEN_IN_PIXELS: Final = (SeenAlike(frozenset(CLASSES), missed=(1.2, 8.0), came=(1.0, 1.0)),)
"""Kinds where nothing gives metres: 13% are missed in the mean, 1 to 34% with 90%. Of 57 and 56 vehicles of generated
footage 4 were missed by day and 15 in rain, over all distances."""


def event_probability(trajectory: Track) -> float:
    """Probability that an event of this track happened, and is no other track's too.

    By Laplace's rule of succession over the moments at which a place was taken: two say little, many say much.
    """
    places = min(int(trajectory.located.sum()), _MOST_PLACES)
    return (places + 1) / (places + 2) * undoubted(trajectory)


def crossing_probability(trajectory: Track, time_s: float, step_s: float) -> float:
    """Probability that a road user crossed a line at a time, in metres, and is counted by no other track.

    Args:
        trajectory: The track that crosses.
        time_s: When, seconds of the footage.
        step_s: Usual time from place to place in the footage (`usual_step`): who is seen in key frames alone is not
            less sure for that.
    """
    if trajectory.category != VEHICLE:
        speed = float(trajectory.at(trajectory.speed, time_s))
        jumps = speed > _FASTEST.get(trajectory.category, math.inf)
        return _REAL_OF_OTHERS[trajectory.category] * undoubted(trajectory) * (_JUMPS if jumps else 1.0)
    evidence = crossing_evidence(trajectory, time_s, step_s)
    logit = sum(weight * value for weight, value in zip(_LOGIT, evidence, strict=True))
    return undoubted(trajectory) * float(expit(logit))


def crossing_evidence(trajectory: Track, time_s: float, step_s: float) -> tuple[float, ...]:
    """Evidence on a vehicle's crossing that `_LOGIT` weighs (see `crossing_probability`).

    Args:
        trajectory: The track that crosses.
        time_s: When, seconds of the footage.
        step_s: Usual time from place to place in the footage (`usual_step`).

    Returns:
        1, and logarithms of the places on the shorter side, of the place's standard deviation (metres), and of the
        longest gap (seconds); 1 where the class is unknown, else 0.
    """
    times = trajectory.times_s[trajectory.located]
    sides = (time_s - times[times < time_s], times[times >= time_s] - time_s)
    parts = min(len(np.unique(np.floor(side / _HALF_S))) for side in sides)
    return (
        1.0,
        math.log(1 + min(parts, _MOST_PLACES)),
        math.log(0.05 + trajectory.sigma_at(time_s)),
        math.log(0.1 + max(0.0, trajectory.longest_gap(time_s, _AROUND_S) - step_s) + _USUAL_STEP_S),
        float(trajectory.class_name == UNKNOWN),
    )


def same_probability(trajectory: Track, begin_s: float, end_s: float, step_s: float) -> float:
    """Probability that a track, in metres, is one road user's all the time from one moment to another.

    Args:
        trajectory: The track.
        begin_s: The one moment, seconds.
        end_s: The other moment, seconds.
        step_s: Usual time from place to place in the footage (`usual_step`).
    """
    if trajectory.category in _TWO_WHEELED:
        return _SAME_RIDER
    if trajectory.category == VEHICLE:
        gap_s = max(0.0, trajectory.longest_gap((begin_s + end_s) / 2, (end_s - begin_s) / 2) - step_s)
        constant, of_gap, of_time = _SAME_VEHICLE
        logit = constant + of_gap * math.log(0.1 + gap_s) + of_time * math.log(1 + end_s - begin_s)
    else:
        between = trajectory.times_s[(trajectory.times_s > begin_s) & (trajectory.times_s < end_s)]
        covariances = trajectory.at(trajectory.total_covariance, np.array([begin_s, *between, end_s]))
        constant, of_sigma = _SAME_WALKER
        logit = constant + of_sigma * math.log(0.05 + float(worst_sigma(covariances).max()))
    return float(expit(logit))


def usual_step(trajectories: Sequence[Track]) -> float:
    """Usual time from a place to the next one, over all tracks, seconds; that of 10 frames a second without any."""
    steps = [np.diff(one.times_s[one.located]) for one in trajectories]
    every = np.concatenate([np.zeros(0), *steps])
    return float(np.median(every)) if len(every) else _USUAL_STEP_S


def undoubted(trajectory: Track) -> float:
    """Factor for what a track should be distrusted for."""
    doubted = _DOUBTED if _DOUBTS & set(trajectory.flags) else 1.0
    return doubted * trajectory.joined_probability
