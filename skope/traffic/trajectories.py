"""A road user's way over the road, as everything that is measured of traffic sees it."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from skope.schema import VEHICLE
from skope.site.traffic_settings import UNKNOWN, VEHICLE_CLASSES
from skope.types import Array

OTHER_SIZES: Final[Mapping[str, tuple[float, float]]] = {
    "pedestrian": (0.5, 0.6),
    "bicycle": (1.8, 0.7),
    "motorcycle": (2.1, 0.8),
}
"""Lengths and widths, metres, that are taken for road users whose own are not measured."""
VEHICLE_LENGTH_SIGMA_M: Final = 0.3
"""Standard deviation of a vehicle's length, metres."""
KMH: Final = 3.6
"""Kilometres an hour in a metre a second."""
COLUMNS: Final = ("times_s", "place", "velocity", "heading", "covariance", "speed_sigma", "located")
"""Fields of a trajectory that have a row for each moment."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """A road user over M moments."""

    number: int
    """The track's number in its footage."""
    category: str
    """Vehicle, bicycle, motorcycle or pedestrian."""
    class_name: str
    """Of `skope.site.traffic_settings.CLASSES`."""
    class_confidence: float
    """Probability that a vehicle is of the class that is named, or would be, where it is unknown."""
    times_s: Array
    """(M,) seconds of the footage, rising."""
    place: Array
    """(M, 2) world, metres: under the middle of a vehicle's body, or where somebody else's box stands."""
    velocity: Array
    """(M, 2) m/s."""
    heading: Array
    """(M,) radians, counter-clockwise from world x; NaN where it is not known."""
    covariance: Array
    """(M, 2, 2) of the places, square metres."""
    speed_sigma: Array
    """(M,) standard deviations of the speeds, m/s."""
    located: NDArray[np.bool_]
    """(M,) at which moments a place was taken."""
    length: float | None = None
    """Metres; None where it is not measured."""
    width: float | None = None
    height: float | None = None
    confirmed: bool = True
    """Whether it has been seen often and long enough to be a road user: others never count."""
    flags: tuple[str, ...] = ()
    """Reasons to distrust the track."""
    joined: tuple[int, ...] = ()
    """Numbers of further tracks that were joined to this one."""
    joined_probability: float = 1.0
    """Probability that all of them are one road user's."""

    @cached_property
    def speed(self) -> Array:
        """(M,) m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1))

    @cached_property
    def size(self) -> tuple[float, float]:
        """Length and width of the footprint, metres, where nothing was measured by what such road users have."""
        length, width = OTHER_SIZES.get(self.category, (4.5, 1.8))
        return (self.length or length, self.width or width)

    @cached_property
    def facing(self) -> Array:
        """(M, 2) unit vectors where the front points; where that is not known, as at the nearest moment at which it is.

        Of somebody who never has a heading, along x.
        """
        known = np.flatnonzero(np.isfinite(self.heading))
        if not len(known):
            return np.tile([1.0, 0.0], (len(self.times_s), 1))
        moments = np.arange(len(self.times_s))
        after = np.searchsorted(known, moments).clip(0, len(known) - 1)
        before = (after - 1).clip(0)
        nearest = np.where(moments - known[before] < known[after] - moments, known[before], known[after])
        return np.stack([np.cos(self.heading[nearest]), np.sin(self.heading[nearest])], axis=1)

    @cached_property
    def front(self) -> Array:
        """(M, 2) the middle of the front end."""
        return self.place + self.facing * (self.size[0] / 2)

    @cached_property
    def rear(self) -> Array:
        """(M, 2) the middle of the rear end."""
        return self.place - self.facing * (self.size[0] / 2)

    def at(self, columns: Array, times_s: float | Array) -> Array:
        """Values (M,) or (M, K) between the moments, linearly."""
        times = np.atleast_1d(times_s)
        rows = columns.reshape(len(columns), -1)
        out = np.stack([np.interp(times, self.times_s, rows[:, k]) for k in range(rows.shape[1])], axis=1)
        return np.asarray(out.reshape((*np.shape(times_s), *columns.shape[1:])))

    def taken(self, rows: NDArray[np.bool_]) -> Self:
        """The trajectory at some of its moments: (M,) which."""
        values: dict[str, Any] = {name: getattr(self, name)[rows] for name in COLUMNS}
        return replace(self, **values)

    def place_sigma(self, time_s: float) -> float:
        """Standard deviation of the place at a time in the worst direction, metres."""
        return float(worst_sigma(self.at(self.covariance, time_s)))

    def longest_gap(self, time_s: float, around_s: float) -> float:
        """The longest time without a place from `around_s` before a time until as long after it, seconds."""
        times = self.times_s[self.located]
        near = times[np.abs(times - time_s) <= around_s]
        return float(np.diff(np.concatenate([[time_s - around_s], near, [time_s + around_s]])).max())

    def class_probability(self, name: str) -> float:
        """Probability that it is of the class `name`.

        What a vehicle's class may be wrong by is shared evenly by the other classes of vehicles.
        """
        if self.category != VEHICLE:
            return float(self.class_name == name)
        if name not in VEHICLE_CLASSES:
            return 0.0
        if self.class_name == UNKNOWN:
            return 1 / len(VEHICLE_CLASSES)
        rest = (1 - self.class_confidence) / (len(VEHICLE_CLASSES) - 1)
        return self.class_confidence if name == self.class_name else rest


def worst_sigma(covariance: Array) -> Array:
    """(...,) standard deviations in the worst direction, metres, of covariances (..., 2, 2)."""
    return np.asarray(np.sqrt(np.maximum(0.0, np.linalg.eigvalsh(covariance)[..., -1])))


def wandering(trajectory: Trajectory) -> bool:
    """Whether it is a road user in traffic: not a parked car, and not a sign of a car's size."""
    return trajectory.confirmed and "never_moved" not in trajectory.flags
