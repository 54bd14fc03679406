"""How probable it is that an event happened once, and that events happened that nothing saw.

Measured on 13 generated clips of four sites by day, at night and in rain, of which everything is known
(`scripts/research/traffic_clips.py`, 2217 crossings that were told); sites that a fit has not seen say the same of it.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from skope.site.traffic_settings import UNKNOWN
from skope.traffic.trajectories import VEHICLE, Trajectory

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
_LOGIT: Final = (-1.06, 0.69, -1.87, -2.66, -1.55)
"""Of the log odds that a vehicle's crossing is one: constant, and what they change with the logarithms of parts with a
place (and one) on the side that has fewer, of the place's standard deviation (and 0.05 m), and of the longest time
without a place (and 0.1 s), and with a class that is unknown."""
MISSED: Final[Mapping[bool, tuple[float, float]]] = {True: (0.21, 6.36), False: (1.32, 3.24)}
"""The share that is missed at a gate, of vehicles and of others, as Beta distributions: 3% and 28% in the mean. Who was
lost before the gate or found behind it comes besides (`skope.traffic.vanished`). Light makes no difference beyond
that: 3.6, 3.1 and 2.5% of vehicles by day, at night and in rain."""


def event_probability(trajectory: Trajectory) -> float:
    """Probability that an event of this track happened, and is no other track's too.

    By Laplace's rule of succession over the moments at which a place was taken: two say little, many say much.
    """
    places = min(int(trajectory.measured.sum()), _MOST_PLACES)
    return (places + 1) / (places + 2) * _undoubted(trajectory)


def crossing_probability(trajectory: Trajectory, time_s: float, step_s: float) -> float:
    """Probability that a road user crossed a line at a time, in metres, and is counted by no other track.

    Args:
        trajectory: The track that crosses.
        time_s: When, seconds of the footage.
        step_s: Usual time from place to place in the footage (`usual_step`): who is seen in key frames alone is not
            less sure for that.
    """
    if trajectory.category != VEHICLE:
        return event_probability(trajectory)
    times = trajectory.times_s[trajectory.measured]
    near = times[np.abs(times - time_s) <= _AROUND_S]
    gap = float(np.diff(np.concatenate([[time_s - _AROUND_S], near, [time_s + _AROUND_S]])).max())
    sides = (time_s - times[times < time_s], times[times >= time_s] - time_s)
    parts = min(len(np.unique(np.floor(side / _HALF_S))) for side in sides)
    values = (
        *(1.0, math.log(1 + min(parts, _MOST_PLACES)), math.log(0.05 + trajectory.place_sigma(time_s))),
        math.log(0.1 + max(0.0, gap - step_s) + _USUAL_STEP_S),
        float(trajectory.class_name == UNKNOWN),
    )
    logit = sum(weight * value for weight, value in zip(_LOGIT, values, strict=True))
    return _undoubted(trajectory) / (1 + math.exp(-logit))


def usual_step(trajectories: Sequence[Trajectory]) -> float:
    """Usual time from a place to the next one, over all tracks, seconds; that of 10 frames a second without any."""
    steps = [np.diff(one.times_s[one.measured]) for one in trajectories]
    every = np.concatenate([np.zeros(0), *steps])
    return float(np.median(every)) if len(every) else _USUAL_STEP_S


def _undoubted(trajectory: Trajectory) -> float:
    """Factor for what a track should be distrusted for."""
    doubted = _DOUBTED if _DOUBTS & set(trajectory.flags) else 1.0
    return doubted * trajectory.joined_probability
