"""Spot speeds at gates, speeds over the sections between two gates, and their percentiles."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

import numpy as np

from skope.schema import PEDESTRIAN
from skope.site.traffic_settings import CLASSES
from skope.tracks.track import Track, has_plausible_speed
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gates import GateCrossing
from skope.traffic.observation import Observation
from skope.traffic.speed_percentiles import Percentile, speed_percentiles
from skope.traffic.turning_movements import Movement

MOTOR: Final = "motor"
"""All classes of vehicles and motorcycles together."""
MOTOR_CLASSES: Final = frozenset(CLASSES) - {"bicycle", PEDESTRIAN}
_RULER_M: Final = 1.0
"""Ways are measured in steps of this: shorter ones would add up what places jitter."""
_Measured = TypeVar("_Measured")


@dataclass(frozen=True, kw_only=True, eq=False)
class SectionPass:
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
    """A class, or `MOTOR`."""
    number: int
    percentiles: dict[str, Percentile]
    common_known: bool
    """Whether the intervals hold what the camera's calibration leaves uncertain."""


def section_name(movement: Movement) -> str:
    """Names of the gates that a movement is between, with directions."""
    return " -> ".join(f"{gate} ({direction})" for gate, direction in movement.sides)


def section_passes(found: Sequence[Movement]) -> list[SectionPass]:
    """Everyone who was seen at two gates, in order of time."""
    return [_pass(one) for one in found if one.origin is not None and one.destination is not None]


def _pass(movement: Movement) -> SectionPass:
    before, after = movement.origin, movement.destination
    assert before is not None
    assert after is not None
    seconds = max(1e-3, after.time_s - before.time_s)
    length = way(before.trajectory, before.time_s, after.time_s)
    sigma = math.hypot(before.sigma_s, after.sigma_s)
    return SectionPass(
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
        Metres, in steps of `_RULER_M` and more: shorter ones would add up what places jitter.
    """
    inner = trajectory.times_s[(trajectory.times_s > begin_s) & (trajectory.times_s < end_s)]
    places = trajectory.at(trajectory.xy, np.array([begin_s, *inner, end_s]))
    total, at = 0.0, places[0]
    for place in places[1:-1]:
        step = math.dist(at, place)
        if step >= _RULER_M:
            total, at = total + step, place
    return total + math.dist(at, places[-1])


def speed_groups(
    crossings: Sequence[GateCrossing],
    sections: Sequence[SectionPass],
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
    known = observation.common_sigma
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
                classes = (MOTOR, *CLASSES) if interval is None else (MOTOR,)
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
    return class_name in MOTOR_CLASSES if group == MOTOR else class_name == group
