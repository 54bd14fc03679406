"""Hard braking: road users and places."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.schema import PEDESTRIAN
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track, has_plausible_speed, is_in_traffic
from skope.traffic.normal_distribution import at_most
from skope.types import Array

_OVER_S: Final = 1.0
"""A deceleration is that over so long: shorter ones are mostly errors of the places."""
_LEAST: Final = 0.5
"""Braking that is less probable than this is not listed."""


@dataclass(frozen=True, kw_only=True, eq=False)
class HardBraking:
    """A road user brakes harder than the limit."""

    trajectory: Track
    time_s: float
    """Time at which it brakes hardest, seconds."""
    place: Array
    """(2,) metres."""
    deceleration: float
    """m/s^2 over a second, positive."""
    sigma: float
    """Standard deviation of that, m/s^2, from those of the speeds."""
    probability: float
    """Probability that it was harder than the limit."""


def hard_brakings(trajectories: Sequence[Track], settings: TrafficSettings) -> list[HardBraking]:
    """The hardest braking of each vehicle that brakes harder than `settings.hard_braking_ms2`, in order of time.

    Tracks with the flag `implausible_speed` are left out.
    """
    found = []
    for trajectory in trajectories:
        if is_in_traffic(trajectory) and has_plausible_speed(trajectory) and trajectory.category != PEDESTRIAN:
            hardest = _hardest(trajectory, settings.hard_braking_ms2)
            if hardest is not None and hardest.probability > _LEAST:
                found.append(hardest)
    return sorted(found, key=lambda one: one.time_s)


def _hardest(trajectory: Track, limit: float) -> HardBraking | None:
    times = trajectory.times_s
    begins = times[times + _OVER_S <= times[-1]]
    if not len(begins):
        return None
    drop = trajectory.at(trajectory.speed, begins) - trajectory.at(trajectory.speed, begins + _OVER_S)
    k = int(drop.argmax())
    # A gap in the track is bridged by a straight line, which brakes evenly: there it is seen nowhere.
    if not trajectory.located[(times >= begins[k]) & (times <= begins[k] + _OVER_S)].any():
        return None
    ends = np.array([begins[k], begins[k] + _OVER_S])
    sigma = math.hypot(*trajectory.at(trajectory.speed_sigma, ends)) / _OVER_S
    hardest = float(drop[k]) / _OVER_S
    middle = float(begins[k]) + _OVER_S / 2
    return HardBraking(
        trajectory=trajectory,
        time_s=middle,
        place=trajectory.at(trajectory.xy, middle),
        deceleration=hardest,
        sigma=sigma,
        probability=at_most((hardest - limit) / sigma) if sigma > 0 else float(hardest > limit),
    )
