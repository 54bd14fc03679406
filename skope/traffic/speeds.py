"""Compute spot speeds at gates, speeds over the sections between gates, and percentiles of both (v15, v50, v85).

Measurement errors spread speeds, which raises v85 and lowers v15. If measured speeds have the variance S^2 and their
errors sigma^2, true speeds have the variance S^2 - sigma^2. Values are therefore moved towards their median by the
square root of the ratio of the two variances.

The confidence interval of a percentile is that of order statistics, which is valid for any distribution (Conover,
Practical Nonparametric Statistics). The interval is widened by the uncertainty of the ratio and by the camera's error.
All speeds share the camera's error, so more vehicles do not reduce this error.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np
from scipy.special import bdtr

from skope.confidence_level import INTERVAL_LEVEL, INTERVAL_SIGMAS
from skope.schema import PEDESTRIAN_CATEGORY
from skope.site.traffic_settings import TRAFFIC_CLASSES
from skope.tracks.track import Track, has_plausible_speed
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gates import GateCrossing
from skope.traffic.observation import Observation
from skope.traffic.turning_movements import Movement

SPEED_PERCENTILES: Final[Mapping[str, float]] = {"v15": 0.15, "v50": 0.50, "v85": 0.85}


@dataclass(frozen=True)
class SpeedModel:
    """Errors of speed distributions."""

    least_ratio: float = 0.5
    """Minimum ratio of true to measured variance. Below it v15 and v85 are not available."""
    shape_sigma: float = 0.15
    """Error of the correction of v15 and v85 for measurement noise, as a share of the removed noise: speeds are not
    normally distributed. From simulations with skewed speeds."""
    step_m: float = 1.0
    """Minimum step for measuring path lengths, metres. Shorter steps would add up the jitter of positions."""


SPEED_MODEL: Final = SpeedModel()


@dataclass(frozen=True, kw_only=True)
class Percentile:
    """A percentile of speeds, m/s."""

    value: float | None
    """None if not available; `unavailable_reason` gives the reason."""
    low: float | None
    high: float | None
    """`low` and `high` are the 90% confidence interval of the percentile of all such traffic; None if not available."""
    unavailable_reason: str = ""
    """Reason why the percentile is not available; empty if it is."""


def speed_percentiles(
    speeds: Sequence[float], sigmas: Sequence[float], common_scale_sigma: float | None
) -> dict[str, Percentile]:
    """Return the percentiles of `SPEED_PERCENTILES` by name.

    Args:
        speeds: Measured speeds, m/s.
        sigmas: Standard deviation of each speed for an exactly known camera, m/s.
        common_scale_sigma: Relative standard deviation of the scale, which all speeds share. If None (not known), the
            confidence intervals exclude this error.
    """
    values = np.sort(np.asarray(speeds, dtype=np.float64))
    n = len(values)
    if n == 0:
        return {name: _unavailable("no vehicle") for name in SPEED_PERCENTILES}
    shared = 0.0 if common_scale_sigma is None else common_scale_sigma
    noise, spread = float(np.square(np.asarray(sigmas)).mean()), float(values.var(ddof=1)) if n > 1 else 0.0
    ratio = 1.0 if noise == 0 else 1 - noise / spread if spread > 0 else -1.0
    middle = float(np.median(values))
    out = {}
    for name, share in SPEED_PERCENTILES.items():
        ranks = order_ranks(n, share)
        if ranks is None:
            least = math.ceil(math.log((1 - INTERVAL_LEVEL) / 2) / math.log(max(share, 1 - share)))
            out[name] = _unavailable(f"{n} vehicles: an interval needs {least}")
        elif ratio < SPEED_MODEL.least_ratio and share != 0.5:
            out[name] = _unavailable("the spread of the speeds is too small compared with their errors")
        else:
            drawn = math.sqrt(max(0.0, ratio)) if share != 0.5 else 1.0
            value, low, high = (
                middle + drawn * (float(x) - middle) for x in (np.quantile(values, share), *values[list(ranks)])
            )
            ratio_error = _ratio_sigma(ratio, n) * abs(float(np.quantile(values, share)) - middle)
            shape = SPEED_MODEL.shape_sigma * min(1.0, 1 - ratio) * math.sqrt(spread)
            widen = INTERVAL_SIGMAS * math.hypot(ratio_error, shape, shared * value)
            out[name] = Percentile(
                value=value,
                low=max(0.0, value - math.hypot(value - low, widen)),
                high=value + math.hypot(high - value, widen),
            )
    return out


def _unavailable(why: str) -> Percentile:
    return Percentile(value=None, low=None, high=None, unavailable_reason=why)


def _ratio_sigma(ratio: float, n: int) -> float:
    """Return the standard deviation of the square root of the ratio, from the sampling error of n normal values."""
    return (1 - ratio) / math.sqrt(2 * n * ratio) if 0 < ratio < 1 else 0.0


def order_ranks(n: int, share: float) -> tuple[int, int] | None:
    """Return the indices of two of n sorted values that enclose a quantile with a probability of `INTERVAL_LEVEL`.

    Args:
        n: Number of values.
        share: The quantile, 0 to 1.

    Returns:
        The two indices, each with an error probability of at most half of the rest. None if n is too small.
    """
    tail = (1 - INTERVAL_LEVEL) / 2
    ranks = np.arange(n)
    below = bdtr(ranks, n, share)  # probability that at most `ranks` values lie below the quantile
    # The k-th value (from 0) is above the quantile if at most k values lie below it.
    lows = np.flatnonzero(below <= tail)
    highs = np.flatnonzero(below >= 1 - tail)
    highs = highs[highs < n]
    if not len(lows) or not len(highs):
        return None
    return int(lows[-1]), int(highs[0])


MOTOR_TRAFFIC: Final = "motor"
"""Name of the group of all vehicle classes and motorcycles."""
MOTOR_CLASSES: Final = frozenset(TRAFFIC_CLASSES) - {"bicycle", PEDESTRIAN_CATEGORY}
_Measured = TypeVar("_Measured")


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentTraversal:
    """Travel of a road user from one gate to another."""

    movement: Movement
    length_m: float
    """Travelled distance, metres."""
    seconds: float
    """Travel time, seconds."""
    seconds_sigma: float
    """Standard deviation of `seconds`."""
    speed: float
    """Journey speed: distance over travel time, m/s."""
    speed_sigma: float
    """Standard deviation of `speed`, m/s."""

    @property
    def name(self) -> str:
        """Names of the gates and directions."""
        return section_name(self.movement)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpeedGroup:
    """Speeds of the road users that passed one gate, or one section, in one direction."""

    interval: ClockInterval | None
    """Counting interval; None for the whole footage."""
    kind: str
    """"spot" or "section"."""
    where: str
    """Gate and direction; for a section those of both gates."""
    class_name: str
    """A class, or `MOTOR_TRAFFIC`."""
    number: int
    """Number of speeds."""
    percentiles: dict[str, Percentile]
    common_known: bool
    """Whether the confidence intervals include the camera's calibration error."""


def section_name(movement: Movement) -> str:
    """Return the names of the two gates of a movement, with directions."""
    return " -> ".join(f"{gate} ({direction})" for gate, direction in movement.sides)


def section_passes(found: Sequence[Movement]) -> list[SegmentTraversal]:
    """Return the traversals of all movements with two known gates, in order of time."""
    return [_pass(movement) for movement in found if movement.origin is not None and movement.destination is not None]


def _pass(movement: Movement) -> SegmentTraversal:
    before, after = movement.origin, movement.destination
    assert before is not None
    assert after is not None
    seconds = max(1e-3, after.time_s - before.time_s)
    length = way(before.trajectory, before.time_s, after.time_s)
    sigma = math.hypot(before.sigma_s, after.sigma_s)
    return SegmentTraversal(
        movement=movement,
        length_m=length,
        seconds=seconds,
        seconds_sigma=sigma,
        speed=length / seconds,
        speed_sigma=length / seconds * sigma / seconds,
    )


def way(trajectory: Track, begin_s: float, end_s: float) -> float:
    """Return the distance that a road user travels in a period.

    Args:
        trajectory: The track.
        begin_s: Start of the period, seconds.
        end_s: End of the period, seconds.

    Returns:
        The distance, metres, added up in steps of at least `SPEED_MODEL.step_m`.
    """
    inner = trajectory.times_s[(trajectory.times_s > begin_s) & (trajectory.times_s < end_s)]
    places = trajectory.at(trajectory.xy, np.array([begin_s, *inner, end_s]))
    total, at = 0.0, places[0]
    for position in places[1:-1]:
        step = math.dist(at, position)
        if step >= SPEED_MODEL.step_m:
            total, at = total + step, position
    return total + math.dist(at, places[-1])


def speed_groups(
    crossings: Sequence[GateCrossing],
    sections: Sequence[SegmentTraversal],
    intervals: Sequence[ClockInterval],
    observation: Observation,
) -> list[SpeedGroup]:
    """Return speed percentiles of the whole footage by class, and of motor vehicles by counting interval.

    Tracks with the flag `implausible_speed` are excluded.

    Args:
        crossings: The crossings, which have spot speeds.
        sections: The traversals between two gates.
        intervals: The intervals.
        observation: The observation with the scale error of the camera.
    """
    known = observation.common_scale_sigma
    crossings = [crossing for crossing in crossings if has_plausible_speed(crossing.trajectory)]
    sections = [section for section in sections if has_plausible_speed(section.movement.trajectory)]

    def grouped(
        kind: str,
        rows: Sequence[_Measured],
        where: Callable[[_Measured], str],
        of: Callable[[_Measured], tuple[float, str, float, float]],
    ) -> Iterator[SpeedGroup]:
        """Yield the groups of one kind. `of` returns time, class, speed and sigma of a row."""
        for location in sorted({where(row) for row in rows}):
            location_rows = [of(row) for row in rows if where(row) == location]
            for interval in (None, *intervals):
                interval_rows = [
                    row for row in location_rows if interval is None or interval.begin_s <= row[0] < interval.end_s
                ]
                classes = (MOTOR_TRAFFIC, *TRAFFIC_CLASSES) if interval is None else (MOTOR_TRAFFIC,)
                for name in classes:
                    chosen = [row for row in interval_rows if _is(row[1], name)]
                    if chosen:
                        yield SpeedGroup(
                            interval=interval,
                            kind=kind,
                            where=location,
                            class_name=name,
                            number=len(chosen),
                            percentiles=speed_percentiles(
                                [row[2] for row in chosen], [row[3] for row in chosen], known
                            ),
                            common_known=known is not None,
                        )

    return [
        *grouped(
            "spot",
            crossings,
            lambda crossing: f"{crossing.gate} ({crossing.direction_name})",
            lambda crossing: (crossing.time_s, crossing.trajectory.class_name, crossing.speed, crossing.speed_sigma),
        ),
        *grouped(
            "section",
            sections,
            lambda section: section.name,
            lambda section: (section.movement.time_s, _class_of(section.movement), section.speed, section.speed_sigma),
        ),
    ]


def _class_of(movement: Movement) -> str:
    first = movement.origin or movement.destination
    assert first is not None
    return first.trajectory.class_name


def _is(class_name: str, group: str) -> bool:
    return class_name in MOTOR_CLASSES if group == MOTOR_TRAFFIC else class_name == group
