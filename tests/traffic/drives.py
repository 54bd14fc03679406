"""Trajectories that are made up, so that what is measured of them can be worked out by hand."""

from dataclasses import replace
from typing import Any

import numpy as np

from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.tracks.track import Track, concatenated
from skope.traffic.observation import Observation


def drive(number: int, places: Any, times_s: Any = None, *, sigma: float = 0.05, **others: Any) -> Track:
    """A vehicle at places (M, 2), every 0.1 s if not at other times; it faces where it moves."""
    place = np.asarray(places, dtype=np.float64)
    times = np.arange(len(place)) * 0.1 if times_s is None else np.asarray(times_s, dtype=np.float64)
    velocity = np.gradient(place, times, axis=0) if len(times) > 1 else np.zeros_like(place)
    fast = np.linalg.norm(velocity, axis=1) > 0.05
    heading = np.where(fast, np.arctan2(velocity[:, 1], velocity[:, 0]), np.nan)
    values: dict[str, Any] = {
        "category": VEHICLE_CATEGORY,
        "class_name": "car",
        "class_confidence": 0.95,
        "length": 4.0,
        "width": 2.0,
        "heading": heading,
    }
    return Track(
        number=number,
        times_s=times,
        position=np.column_stack([place, np.zeros(len(place))]),
        velocity=velocity,
        covariance=np.tile(sigma**2 * np.eye(2), (len(times), 1, 1)),
        speed_sigma=np.full(len(times), 0.1),
        located=np.ones(len(times), dtype=bool),
        **{**values, **others},
    )


def straight(
    number: int,
    start: tuple[float, float],
    velocity: tuple[float, float],
    seconds: float,
    *,
    begin_s: float = 0.0,
    step_s: float = 0.1,
    **others: Any,
) -> Track:
    """A vehicle at constant velocity."""
    since = np.arange(round(seconds / step_s) + 1) * step_s
    return drive(number, np.array(start) + since[:, None] * np.array(velocity), begin_s + since, **others)


def then(track: Track, velocity: tuple[float, float], seconds: float = 1.0) -> Track:
    """A vehicle that goes on at once at another velocity; it faces where it did."""
    more = straight(track.number, tuple(track.xy[-1]), velocity, seconds, begin_s=float(track.times_s[-1]))
    columns = concatenated(track, more.during(np.arange(1, len(more.times_s))))
    columns["velocity"][len(track.times_s) :] = velocity
    columns["heading"][len(track.times_s) :] = track.heading[-1]
    return replace(track, **columns)


def along_x(number: int, x: Any, times_s: Any = None, **others: Any) -> Track:
    """A vehicle at these places along x, in the middle of `GATE`."""
    x = np.asarray(x, dtype=np.float64)
    return drive(number, np.stack([x, np.zeros_like(x)], axis=1), times_s, **others)


GATE = Gate(name="g", line=((0.0, -5.0), (0.0, 5.0)), directions=("west", "east"))
"""Across x at 0; to its left is -x, so that who goes to +x goes from its left to its right: "west" is a bad name for
that, and a user's, which stays."""


def watched(seconds: float, fps: float = 10.0, *, begin_s: float = 0.0, common: float | None = 0.0) -> Observation:
    """Footage without a gap."""
    return Observation(times_s=begin_s + np.arange(round(seconds * fps) + 1) / fps, common_scale_sigma=common)
