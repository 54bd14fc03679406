"""Spot speeds at gates, speeds over the sections between two gates, and their percentiles (v15, v50, v85).

Measurement errors spread speeds, which raises v85 and lowers v15. Where measured speeds vary by S^2 and their errors by
sigma^2, true ones vary by S^2 - sigma^2: values are drawn towards their median by the square root of the ratio. The
interval is that of order statistics (Conover, Practical Nonparametric Statistics: it holds for any distribution),
widened by the uncertainty of the ratio, and by the camera's error, which all speeds share and no number of vehicles
averages away.
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
    """Share of the measured variance below which the variance of true speeds is hidden by errors."""
    shape_sigma: float = 0.15
    """Standard deviation of the error if speeds are not normally distributed, as a share of the spread that is
    removed; from simulations with skewed speeds."""
    step_m: float = 1.0
    """Step in which path lengths are measured, metres. Shorter ones would add up the jitter of positions."""


SPEED_MODEL: Final = SpeedModel()


@dataclass(frozen=True, kw_only=True)
class Percentile:
    """A percentile of speeds, m/s."""

    value: float | None
    """None: it cannot be told, `unavailable_reason` says why."""
    low: float | None
    high: float | None
    """Between `low` and `high` is the percentile of all who drive so, with 90%."""
    unavailable_reason: str = ""


def speed_percentiles(
    speeds: Sequence[float], sigmas: Sequence[float], common_scale_sigma: float | None
) -> dict[str, Percentile]:
    """The percentiles of `SPEED_PERCENTILES`, by their names.

    Args:
        speeds: As measured, m/s.
        sigmas: Standard deviation of each for a known camera, m/s.
        common_scale_sigma: Relative standard deviation of the scale, which all speeds share; None if not known. It is
            then not in the intervals.
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
            out[name] = _unavailable("speeds vary hardly more than they are uncertain")
        else:
            drawn = math.sqrt(max(0.0, ratio)) if share != 0.5 else 1.0
            value, low, high = (
                middle + drawn * (float(x) - middle) for x in (np.quantile(values, share), *values[list(ranks)])
            )
            doubt = _ratio_sigma(ratio, n) * abs(float(np.quantile(values, share)) - middle)
            shape = SPEED_MODEL.shape_sigma * min(1.0, 1 - ratio) * math.sqrt(spread)
            widen = INTERVAL_SIGMAS * math.hypot(doubt, shape, shared * value)
            out[name] = Percentile(
                value=value,
                low=max(0.0, value - math.hypot(value - low, widen)),
                high=value + math.hypot(high - value, widen),
            )
    return out


def _unavailable(why: str) -> Percentile:
    return Percentile(value=None, low=None, high=None, unavailable_reason=why)


def _ratio_sigma(ratio: float, n: int) -> float:
    """Standard deviation of the square root of the ratio, as far as the spread of n normal values is uncertain."""
    return (1 - ratio) / math.sqrt(2 * n * ratio) if 0 < ratio < 1 else 0.0


def order_ranks(n: int, share: float) -> tuple[int, int] | None:
    """Indices of two of n sorted values between which a quantile lies with `INTERVAL_LEVEL`.

    Each end errs with half of the rest at most. None where n is too small for that.
    """
    tail = (1 - INTERVAL_LEVEL) / 2
    ranks = np.arange(n)
    below = bdtr(ranks, n, share)  # so many values or fewer lie below the quantile
    # The k-th value (from 0) is above the quantile where k or fewer values lie below it.
    lows = np.flatnonzero(below <= tail)
    highs = np.flatnonzero(below >= 1 - tail)
    highs = highs[highs < n]
    if not len(lows) or not len(highs):
        return None
    return int(lows[-1]), int(highs[0])


MOTOR_TRAFFIC: Final = "motor"
"""All classes of vehicles and motorcycles together."""
MOTOR_CLASSES: Final = frozenset(TRAFFIC_CLASSES) - {"bicycle", PEDESTRIAN_CATEGORY}
_Measured = TypeVar("_Measured")


@dataclass(frozen=True, kw_only=True, eq=False)
class SegmentTraversal:
    """A road user drives from one gate to another."""

    movement: Movement
    length_m: float
    """Of its way."""
    seconds: float
    seconds_sigma: float
    speed: float
    """m/s: the way over the time, which traffic engineers call journey speed."""
    speed_sigma: float

    @property
    def name(self) -> str:
        """Names of the gates and directions."""
        return section_name(self.movement)


@dataclass(frozen=True, kw_only=True, eq=False)
class SpeedGroup:
    """The speeds of those who passed one place, or section, in one direction."""

    interval: ClockInterval | None
    """None: the whole footage."""
    kind: str
    """Spot, or section."""
    where: str
    """Gate and direction; of a section both."""
    class_name: str
    """A class, or `MOTOR_TRAFFIC`."""
    number: int
    percentiles: dict[str, Percentile]
    common_known: bool
    """Whether the intervals hold what the camera's calibration leaves uncertain."""


def section_name(movement: Movement) -> str:
    """Names of the gates that a movement is between, with directions."""
    return " -> ".join(f"{gate} ({direction})" for gate, direction in movement.sides)


def section_passes(found: Sequence[Movement]) -> list[SegmentTraversal]:
    """Everyone who was seen at two gates, in order of time."""
    return [_pass(one) for one in found if one.origin is not None and one.destination is not None]


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
    """Length of the way that a road user takes from one time to another.

    Args:
        trajectory: The track.
        begin_s: The one time, seconds.
        end_s: The other time, seconds.

    Returns:
        Metres, in steps of `SPEED_MODEL.step_m` and more: shorter ones would add up what places jitter.
    """
    inner = trajectory.times_s[(trajectory.times_s > begin_s) & (trajectory.times_s < end_s)]
    places = trajectory.at(trajectory.xy, np.array([begin_s, *inner, end_s]))
    total, at = 0.0, places[0]
    for place in places[1:-1]:
        step = math.dist(at, place)
        if step >= SPEED_MODEL.step_m:
            total, at = total + step, place
    return total + math.dist(at, places[-1])


def speed_groups(
    crossings: Sequence[GateCrossing],
    sections: Sequence[SegmentTraversal],
    intervals: Sequence[ClockInterval],
    observation: Observation,
) -> list[SpeedGroup]:
    """Percentiles of the speeds of the whole footage by class, and of motor vehicles by interval too.

    Tracks with the flag `implausible_speed` are left out.

    Args:
        crossings: The crossings, whose speeds are those at a spot.
        sections: Everyone who was seen at two gates.
        intervals: The intervals.
        observation: How uncertain the camera leaves all speeds.
    """
    known = observation.common_scale_sigma
    crossings = [one for one in crossings if has_plausible_speed(one.trajectory)]
    sections = [one for one in sections if has_plausible_speed(one.movement.trajectory)]

    def grouped(
        kind: str,
        rows: Sequence[_Measured],
        where: Callable[[_Measured], str],
        of: Callable[[_Measured], tuple[float, str, float, float]],
    ) -> Iterator[SpeedGroup]:
        """`of` gives time, class, speed and sigma of a row."""
        for place in sorted({where(row) for row in rows}):
            own = [of(row) for row in rows if where(row) == place]
            for interval in (None, *intervals):
                there = [row for row in own if interval is None or interval.begin_s <= row[0] < interval.end_s]
                classes = (MOTOR_TRAFFIC, *TRAFFIC_CLASSES) if interval is None else (MOTOR_TRAFFIC,)
                for name in classes:
                    chosen = [row for row in there if _is(row[1], name)]
                    if chosen:
                        yield SpeedGroup(
                            interval=interval,
                            kind=kind,
                            where=place,
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
            lambda one: f"{one.gate} ({one.direction_name})",
            lambda one: (one.time_s, one.trajectory.class_name, one.speed, one.speed_sigma),
        ),
        *grouped(
            "section",
            sections,
            lambda one: one.name,
            lambda one: (one.movement.time_s, _class_of(one.movement), one.speed, one.speed_sigma),
        ),
    ]


def _class_of(movement: Movement) -> str:
    first = movement.origin or movement.destination
    assert first is not None
    return first.trajectory.class_name


def _is(class_name: str, group: str) -> bool:
    return class_name in MOTOR_CLASSES if group == MOTOR_TRAFFIC else class_name == group
