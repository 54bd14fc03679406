"""Passenger-car equivalents (PCE) of the road users that crossed a gate."""

from collections.abc import Mapping, Sequence

from skope.schema import PEDESTRIAN
from skope.site.traffic_settings import UNKNOWN, VEHICLE_CLASSES, TrafficSettings
from skope.traffic.gates import GateCrossing

_MIN_KNOWN_SHARE = 0.5
"""Minimum share of the vehicles at a gate and direction whose class is known, for the others to take their mean."""


def pce_factors(crossings: Sequence[GateCrossing], settings: TrafficSettings) -> dict[str, float] | None:
    """Passenger-car equivalent of each class at one gate and direction.

    A vehicle of class unknown gets the mean factor of the vehicles (car, van, lorry, bus) whose class is known there.

    Args:
        crossings: All crossings of the gate and direction that are counted, over the whole footage.
        settings: The factors of the site.

    Returns:
        Class -> factor. None if fewer than half of the vehicles have a known class.
    """
    factors = {"car": 1.0, PEDESTRIAN: 0.0, **settings.pce}
    classes = [crossing.trajectory.class_name for crossing in crossings]
    known = [factors[name] for name in classes if name in VEHICLE_CLASSES]
    unknown = classes.count(UNKNOWN)
    if not unknown:
        return factors
    if len(known) < _MIN_KNOWN_SHARE * (len(known) + unknown):
        return None
    return {**factors, UNKNOWN: sum(known) / len(known)}


def passenger_cars(crossings: Sequence[GateCrossing], factors: Mapping[str, float] | None) -> float | None:
    """Sum of the passenger-car equivalents of crossings, to three decimals; None without factors.

    Args:
        crossings: The crossings, of one gate and direction.
        factors: What `pce_factors` returns for them.
    """
    return None if factors is None else round(sum(factors[one.trajectory.class_name] for one in crossings), 3)
