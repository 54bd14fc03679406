"""Counts of vehicles by length (short, medium, long), with the probability of each bin.

The errors of lengths were measured on 13 generated clips with full ground truth: four sites by day, at night and in
rain (`scripts/research/traffic_scores.py`, 1205 tracks of vehicles of 3.6 to 12 m). For three quarters of the cars and
vans, the standard deviation of the length is 2%; for the rest it is 14% (cars) and 5.5% (vans). For half of the
vehicles of other classes it is 3%, and for nearly half 9%. For the remaining few vehicles the body type was mistaken.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from skope.confidence_level import at_most
from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import OF_VEHICLES, TrafficSettings
from skope.tracks.track import Track
from skope.traffic.count_uncertainty import CountDistribution, CountErrors, CountInterval
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import observed_word
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.missed_crossings import LostTrack, MissedCrossings
from skope.traffic.observation import Observation
from skope.types import Array

LENGTH_BINS: Final = ("short", "medium", "long")
NO_BIN: Final = "unknown"
"""Name of the bin of vehicles with a length that is too uncertain."""


@dataclass(frozen=True)
class LengthModel:
    """Errors of lengths, and limits of length bins."""

    bin_probability: float = 0.8
    """Minimum probability for a vehicle to be counted in a bin."""
    longest_measured_m: float = 12.0
    """Length of the longest vehicle on which errors were measured, metres."""
    other_errors: tuple[tuple[float, float], tuple[float, float]] = ((0.5, 0.03), (0.46, 0.09))
    """Share of tracks and relative standard deviation of their lengths, for classes other than car and van. The
    remaining tracks may have any length."""
    longest_car_m: float = 6.2
    """Upper limit of the length of a car, metres."""
    mistaken_m: tuple[float, float] = (3.0, 13.0)
    """Range of lengths of vehicles with a mistaken body type, metres."""
    possible_probability: float = 0.02
    """Minimum probability of a bin for a lost vehicle to be counted as possible there."""


LENGTH_MODEL: Final = LengthModel()

WHY_NOT: Final = (
    f"no interval: errors of lengths were measured on vehicles of up to {LENGTH_MODEL.longest_measured_m:g} m"
)
CLASS_ERRORS: Final = {"car": ((0.75, 0.02), (0.245, 0.14)), "van": ((0.75, 0.02), (0.248, 0.055))}


@dataclass(frozen=True, kw_only=True)
class LengthCount:
    """Number of vehicles in a length bin that crossed a gate in a counting interval."""

    interval: ClockInterval
    observed: str
    """Observed part of the counting interval: "full", "partial" or "none"."""
    gate: str
    direction: str
    bin_name: str
    """One of `LENGTH_BINS`, or `NO_BIN`."""
    between_m: tuple[float, float] | None
    """Shortest and longest length of the bin, metres; None for `NO_BIN`."""
    count: int | None
    """Number of counted vehicles; None if nothing was observed."""
    confidence_interval: CountInterval | None
    """90% confidence interval of the true number. None if counts of vehicles lack one there, for `NO_BIN`, and for bins
    that begin at or above `LENGTH_MODEL.longest_measured_m`."""


def bounds_m(limits_m: Sequence[float]) -> tuple[tuple[float, float], ...]:
    """Return the shortest and longest length of each of `LENGTH_BINS`, metres."""
    first, second = limits_m
    return (0.0, first), (first, second), (second, math.inf)


def length_sigma_m(trajectory: Track, common_scale_sigma: float | None) -> float:
    """Return the standard deviation of a vehicle's length, metres.

    Args:
        trajectory: A vehicle with a measured length.
        common_scale_sigma: Relative standard deviation of the scale, which all lengths share; None: not known.
    """
    assert trajectory.length is not None
    length = trajectory.length
    parts = _errors(trajectory)
    low, high = (end - length for end in LENGTH_MODEL.mistaken_m)
    strayed = (high**3 - low**3) / (3 * (high - low))
    square = sum(share * (sigma * length) ** 2 for share, sigma in parts) + _rest(parts) * strayed
    return math.hypot(math.sqrt(square), (common_scale_sigma or 0.0) * length)


def bin_probabilities(trajectory: Track, limits_m: Sequence[float], common_scale_sigma: float | None) -> Array:
    """Return (3,) probabilities that a vehicle is short, medium and long.

    Args:
        trajectory: A vehicle with a measured length.
        limits_m: Shortest medium and shortest long vehicle, metres.
        common_scale_sigma: As in `length_sigma_m`.
    """
    below = [_shorter_than(trajectory, limit, common_scale_sigma or 0.0) for limit in limits_m]
    return np.diff([0.0, *below, 1.0])


def length_bin(trajectory: Track, limits_m: Sequence[float], common_scale_sigma: float | None) -> tuple[str, float]:
    """Return the bin of a vehicle and the probability of the most probable bin.

    Args:
        trajectory: A vehicle with a measured length.
        limits_m: Shortest medium and shortest long vehicle, metres.
        common_scale_sigma: As in `length_sigma_m`.

    Returns:
        The most probable bin, or `NO_BIN` if its probability is below `LENGTH_MODEL.bin_probability`; and that
        probability.
    """
    chances = bin_probabilities(trajectory, limits_m, common_scale_sigma)
    return _bin_of(chances), float(chances.max())


def _bin_of(chances: Array) -> str:
    """Return the bin for the probabilities (3,) of a vehicle, or `NO_BIN`."""
    most = int(np.argmax(chances))
    return LENGTH_BINS[most] if chances[most] >= LENGTH_MODEL.bin_probability else NO_BIN


def has_length(trajectory: Track) -> bool:
    """Return whether a track is a vehicle with a measured length. Two-wheelers and pedestrians have none."""
    return trajectory.category == VEHICLE_CATEGORY and trajectory.length is not None


def length_counts(
    crossings: Sequence[GateCrossing],
    gates: Sequence[Gate],
    intervals: Sequence[ClockInterval],
    observation: Observation,
    settings: TrafficSettings,
    unseen: MissedCrossings,
) -> list[LengthCount]:
    """Count vehicles for each counting interval, gate, direction and bin, including `NO_BIN`.

    Args:
        crossings: The crossings that are counted.
        gates: All gates.
        intervals: The intervals.
        observation: The observed times, and the scale error of the camera.
        settings: The limits of the bins, and the classes that are counted.
        unseen: Road users that may have crossed and are not counted.

    Returns:
        The counts; empty if no class of vehicles is counted.
    """
    if OF_VEHICLES.isdisjoint(settings.classes):
        return []
    limits, common = settings.length_bins_m, observation.common_scale_sigma
    measured = [crossing for crossing in (*crossings, *unseen.doubtful) if has_length(crossing.trajectory)]
    every: list[GateCrossing | LostTrack] = [
        *measured,
        *(lost for lost in unseen.vanished if has_length(lost.trajectory)),
    ]
    chances: Chances = {event: bin_probabilities(event.trajectory, limits, common) for event in every}
    names = {crossing: _bin_of(chances[crossing]) for crossing in measured}
    out = []
    for interval in intervals:
        observed_s = observation.seconds_in(interval.begin_s, interval.end_s)
        in_interval = [crossing for crossing in measured if interval.begin_s <= crossing.time_s < interval.end_s]
        for gate in gates:
            for k, direction in enumerate(direction_names(gate)):
                at_gate = [
                    crossing for crossing in in_interval if (crossing.gate, crossing.direction) == (gate.name, k)
                ]
                known = observed_s > 0 and gate.name not in unseen.gates
                between = (
                    _between(at_gate, chances, names, (gate.name, k), interval, limits, unseen) if known else NO_LIMITS
                )
                for name, bounds, confidence_interval in zip(
                    (*LENGTH_BINS, NO_BIN), (*bounds_m(limits), None), between, strict=True
                ):
                    number = sum(crossing.is_counted and names[crossing] == name for crossing in at_gate)
                    out.append(
                        LengthCount(
                            interval=interval,
                            observed=observed_word(interval, observed_s),
                            gate=gate.name,
                            direction=direction,
                            bin_name=name,
                            between_m=bounds,
                            count=number if observed_s > 0 else None,
                            confidence_interval=confidence_interval,
                        )
                    )
    return out


NO_LIMITS: Final = (None, None, None, None)
Chances = dict[GateCrossing | LostTrack, Array]
"""Probability of each bin, by crossing or vanished track."""


def _between(
    at_gate: Sequence[GateCrossing],
    chances: Chances,
    names: Mapping[GateCrossing, str],
    side: tuple[str, int],
    interval: ClockInterval,
    limits_m: Sequence[float],
    unseen: MissedCrossings,
) -> tuple[CountInterval | None, ...]:
    """Return the confidence intervals of the bins at a gate, from its crossings and lost tracks; None for `NO_BIN`."""
    (kind,) = (group for group in unseen.kinds_at(*side) if group.classes == OF_VEHICLES)
    most = partial(unseen.most, *side, interval, kind.classes)
    if kind.loses(sum(crossing.is_counted for crossing in at_gate), most()):
        return NO_LIMITS

    lost_here = [lost_track for lost_track in unseen.vanished if (lost_track.gate, lost_track.direction) == side]

    def intervals() -> Iterator[CountInterval | None]:
        for k, (shortest, _) in enumerate(bounds_m(limits_m)):
            may = tuple(
                lost_track
                for lost_track in lost_here
                if lost_track in chances and chances[lost_track][k] >= LENGTH_MODEL.possible_probability
            )
            lost = replace(unseen, vanished=may).most(*side, interval, kind.classes)
            each = {crossing: kind.real * crossing.probability * float(chances[crossing][k]) for crossing in at_gate}
            inside = {crossing for crossing in at_gate if crossing.is_counted and names[crossing] == LENGTH_BINS[k]}
            false = [1 - each[crossing] for crossing in at_gate if crossing in inside]
            uncounted = [each[crossing] for crossing in at_gate if crossing not in inside and each[crossing] > 0]
            errors = CountErrors(false, uncounted, lost, kind.came, kind.missed)
            yield (
                None
                if shortest >= LENGTH_MODEL.longest_measured_m
                else CountDistribution(len(false), [errors]).interval()
            )

    return (*intervals(), None)


def _errors(trajectory: Track) -> tuple[tuple[float, float], ...]:
    return CLASS_ERRORS.get(trajectory.class_name, LENGTH_MODEL.other_errors)


def _rest(parts: Sequence[tuple[float, float]]) -> float:
    return 1 - sum(share for share, _ in parts)


def _shorter_than(trajectory: Track, limit_m: float, common_scale_sigma: float) -> float:
    """Return the probability that the true length of a vehicle is below a limit."""
    assert trajectory.length is not None
    parts = _errors(trajectory)
    low, high = LENGTH_MODEL.mistaken_m
    strayed = min(1.0, max(0.0, (limit_m - low) / (high - low)))
    longest = LENGTH_MODEL.longest_car_m if trajectory.class_name == "car" else math.inf
    measured_m = min(trajectory.length, longest)

    def below(sigma: float, length_m: float) -> float:
        return at_most((length_m / measured_m - 1) / math.hypot(sigma, common_scale_sigma))

    shares = sum(share * below(sigma, min(limit_m, longest)) / below(sigma, longest) for share, sigma in parts)
    return shares + _rest(parts) * strayed
