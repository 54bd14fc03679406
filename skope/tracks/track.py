"""`Track`: one road user over time, from the tracker to the traffic report.

Four errors make a position uncertain. Each is stored separately:

- the noise of single observations, filtered: `Track.covariance`;
- the shift of a whole track from the road user's height and shape: `Track.body_error`;
- the camera's error, which all road users share: once per recording, in `skope.traffic.observation.Observation`;
- the error of a gate's marks: with the gate.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import NDArray

from skope.schema import VEHICLE_CATEGORY
from skope.site.traffic_settings import UNKNOWN_CLASS, VEHICLE_CLASSES
from skope.types import Array

USUAL_SIZE_M: Final[Mapping[str, tuple[float, float]]] = {
    VEHICLE_CATEGORY: (4.5, 1.8),
    "pedestrian": (0.5, 0.6),
    "bicycle": (1.8, 0.7),
    "motorcycle": (2.1, 0.8),
}
"""Length and width by category, metres, of road users without a measured size."""
VEHICLE_LENGTH_SIGMA_M: Final = 0.3
"""Standard deviation of a vehicle's measured length, metres."""
KMH_PER_MPS: Final = 3.6
"""km/h per m/s."""
OPTIONAL_FIELDS: Final = ("acceleration", "body_error", "detected", "frames", "boxes", "scores", "truth_ids")
_PER_MOMENT: Final = (
    "times_s",
    "position",
    "velocity",
    "heading",
    "covariance",
    "speed_sigma",
    "located",
    *OPTIONAL_FIELDS,
)
"""Fields that have a row per moment."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Track:
    """Road user at M moments, from the first to the last at which it was located, including those between.

    Positions are on the ground: under the middle of a vehicle's body, or where a person or two-wheeler stands. In
    tracks of image gates they are columns and negative rows, pixels.
    """

    number: int
    """Number of the track in its footage."""
    category: str = VEHICLE_CATEGORY
    """Vehicle, bicycle, motorcycle or pedestrian."""
    class_name: str
    """One of `skope.site.traffic_settings.TRAFFIC_CLASSES`."""
    class_confidence: float
    """Probability that the class of a vehicle is right, 0 to 1."""
    times_s: Array
    """(M,) times in the footage, seconds, rising."""
    position: Array
    """(M, 3) smoothed positions, world, metres."""
    velocity: Array
    """(M, 2) velocities, m/s."""
    heading: Array
    """(M,) headings, radians, counter-clockwise from world x; NaN if not known."""
    covariance: Array
    """(M, 2, 2) covariances of x and y from the noise of the observations, square metres."""
    speed_sigma: Array
    """(M,) standard deviation of the speed for a known camera, m/s."""
    located: NDArray[np.bool_]
    """(M,) whether a position was measured; else it is interpolated from the moments around."""
    body_error: Array = None  # type: ignore[assignment]  # set below
    """(M, 2) displacement for one standard deviation of the error that is the same along the whole track: height over
    the road and shape, metres. Default: none."""
    acceleration: Array = None  # type: ignore[assignment]
    """(M, 2) m/s^2. Default: NaN."""
    detected: NDArray[np.bool_] = None  # type: ignore[assignment]
    """(M,) whether the road user has a box: detected there, or followed from other frames. Default: `located`."""
    frames: NDArray[np.intp] = None  # type: ignore[assignment]
    """(M,) index of the frame in the footage. Default: 0, 1, 2, ..."""
    boxes: Array = None  # type: ignore[assignment]
    """(M, 4) boxes of the detections, x, y, width and height in pixels. Default: NaN. Not in files."""
    scores: Array = None  # type: ignore[assignment]
    """(M,) scores of the detections. Default: NaN. Not in files."""
    truth_ids: NDArray[np.int64] = None  # type: ignore[assignment]
    """(M,) ground-truth track of the detection; -1 if there is none. Default: -1. Not in files."""
    body_type: str = ""
    """Body type of most poses of a vehicle; empty for others."""
    length: float | None = None
    """Length, metres; None: not measured."""
    width: float | None = None
    """Width, metres; None: not measured."""
    height: float | None = None
    """Height, metres; None: not measured."""
    confirmed: bool = True
    """Whether it was detected often and long enough to be a road user; others are never counted or written."""
    flags: tuple[str, ...] = ()
    """Reasons to distrust the track."""
    joined: tuple[int, ...] = ()
    """Numbers of further tracks that were joined to this one."""
    stitch_probability: float = 1.0
    """Probability that all of them belong to one road user."""

    def __post_init__(self) -> None:
        count = len(self.times_s)
        defaults: dict[str, Any] = {
            "body_error": lambda: np.zeros((count, 2)),
            "acceleration": lambda: np.full((count, 2), np.nan),
            "detected": lambda: self.located,
            "frames": lambda: np.arange(count),
            "boxes": lambda: np.full((count, 4), np.nan),
            "scores": lambda: np.full(count, np.nan),
            "truth_ids": lambda: np.full(count, -1, dtype=np.int64),
        }
        for name, make in defaults.items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, make())

    @property
    def xy(self) -> Array:
        """(M, 2) position on the ground, metres."""
        return self.position[:, :2]

    @cached_property
    def speed(self) -> Array:
        """(M,) speed, m/s."""
        return np.asarray(np.linalg.norm(self.velocity, axis=1))

    @cached_property
    def acceleration_along(self) -> Array:
        """(M,) acceleration in the direction of travel, m/s^2; 0 for a stationary road user."""
        dot = np.einsum("mi,mi->m", self.acceleration, self.velocity)
        return np.asarray(np.divide(dot, self.speed, out=np.zeros_like(dot), where=self.speed > 0.1))

    @cached_property
    def total_covariance(self) -> Array:
        """(M, 2, 2) of x and y for a known camera: noise and body error together, square metres."""
        return np.asarray(self.covariance + self.body_error[:, :, None] * self.body_error[:, None, :])

    @cached_property
    def position_sigma(self) -> Array:
        """(M,) standard deviation of the position in its worst direction, metres, without the camera's error."""
        return worst_sigma(self.total_covariance)

    @cached_property
    def size(self) -> tuple[float, float]:
        """Length and width of the footprint, metres; the usual ones of the category if not measured."""
        length, width = USUAL_SIZE_M[self.category]
        return (self.length or length, self.width or width)

    @property
    def size_lwh(self) -> Array:
        """(3,) length, width and height, metres; NaN where not measured."""
        return np.array([np.nan if v is None else v for v in (self.length, self.width, self.height)])

    @cached_property
    def facing(self) -> Array:
        """(M, 2) unit vectors towards the front; without a heading, that of the nearest moment with one.

        Along world x for a track without any heading.
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
        """(M, 2) middle of the front end, world, metres."""
        return self.xy + self.facing * (self.size[0] / 2)

    @cached_property
    def rear(self) -> Array:
        """(M, 2) middle of the rear end, world, metres."""
        return self.xy - self.facing * (self.size[0] / 2)

    def at(self, columns: Array, times_s: float | Array) -> Array:
        """Interpolate values linearly in time.

        Args:
            columns: (M,) or (M, ...) values at the track's moments.
            times_s: One time or (T,) times, seconds.

        Returns:
            One value, or (T, ...) values.
        """
        times = np.atleast_1d(times_s)
        rows = columns.reshape(len(columns), -1)
        out = np.stack([np.interp(times, self.times_s, rows[:, k]) for k in range(rows.shape[1])], axis=1)
        return np.asarray(out.reshape((*np.shape(times_s), *columns.shape[1:])))

    def during(self, rows: NDArray[Any]) -> Self:
        """Return the track at some of its moments.

        Args:
            rows: Indices (R,) or truth values (M,).
        """
        values: dict[str, Any] = {name: getattr(self, name)[rows] for name in _PER_MOMENT}
        return replace(self, **values)

    def sigma_at(self, time_s: float) -> float:
        """Return the position's standard deviation at a time in its worst direction, for a known camera, metres."""
        return float(worst_sigma(self.at(self.total_covariance, time_s)))

    def longest_gap(self, time_s: float, around_s: float) -> float:
        """Return the longest time without a measured position around a time, seconds.

        Time before the start and after the end of the track does not count: the road user was elsewhere.

        Args:
            time_s: The time, seconds.
            around_s: The period examined lasts from this long before to this long after it, seconds.
        """
        measured = self.times_s[self.located]
        begin_s = max(time_s - around_s, min(float(measured[0]), time_s))
        end_s = min(time_s + around_s, max(float(measured[-1]), time_s))
        inside = measured[(measured > begin_s) & (measured < end_s)]
        return float(np.diff(np.concatenate([[begin_s], inside, [end_s]])).max())

    def class_probability(self, name: str) -> float:
        """Return the probability that the road user is of the class `name`.

        The probability that a vehicle's class is wrong is shared evenly by the other classes of vehicles.
        """
        if self.category != VEHICLE_CATEGORY:
            return float(self.class_name == name)
        if name not in VEHICLE_CLASSES:
            return 0.0
        if self.class_name == UNKNOWN_CLASS:
            return 1 / len(VEHICLE_CLASSES)
        rest = (1 - self.class_confidence) / (len(VEHICLE_CLASSES) - 1)
        return self.class_confidence if name == self.class_name else rest


def worst_sigma(covariance: Array) -> Array:
    """Return (...,) standard deviations in the worst direction, metres, of covariances (..., 2, 2)."""
    return np.asarray(np.sqrt(np.maximum(0.0, np.linalg.eigvalsh(covariance)[..., -1])))


def concatenated(first: Track, second: Track) -> dict[str, Any]:
    """Return the fields per moment of two tracks of one road user; `second` begins after the end of `first`."""
    return {name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in _PER_MOMENT}


def is_in_traffic(track: Track) -> bool:
    """Return whether a track is that of a road user in traffic: confirmed, and without the flag `never_moved`."""
    return track.confirmed and "never_moved" not in track.flags


def has_plausible_speed(track: Track) -> bool:
    """Return whether the speed of a track can be used, because the traffic around does not contradict it."""
    return "implausible_speed" not in track.flags
