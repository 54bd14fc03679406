"""The [traffic] table of a site file: by what rules traffic is counted and measured there."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from skope.records import TomlTable, plain_values
from skope.site.gates_zones_lanes import checked_name

VEHICLE_CLASSES: Final = ("car", "van", "lorry", "bus")
"""Classes that a vehicle can be of; one whose class is not sure enough to be named is of class unknown."""
UNKNOWN_CLASS: Final = "unknown"
OF_VEHICLES: Final = frozenset({*VEHICLE_CLASSES, UNKNOWN_CLASS})
"""Classes of vehicles, with that of those whose class is not sure enough."""
TRAFFIC_CLASSES: Final = (*VEHICLE_CLASSES, UNKNOWN_CLASS, "motorcycle", "bicycle", "pedestrian")
"""All classes by which traffic is counted."""
PCE_FACTORS: Final[Mapping[str, float]] = {
    "van": 1.0,
    "lorry": 2.3,
    "bus": 2.0,
    "motorcycle": 0.4,
    "bicycle": 0.2,
}
"""Default passenger-car equivalents by class: Transport for London, "Traffic Modelling Guidelines", version 3.0, 2010
(light goods vehicle 1.0, heavy goods vehicle 2.3, bus and coach 2.0, motorcycle 0.4, pedal cycle 0.2). The same table
has 1.5 for goods vehicles over 3.5 t with two axles."""


@dataclass(frozen=True)
class SettingLimits:
    """Limits of the traffic settings."""

    largest_pce: float = 10.0
    """Largest passenger-car equivalent."""
    day_minutes: int = 1440
    """Minutes of a day."""
    length_bins_m: tuple[float, float] = (5.0, 30.0)
    """Range of the limits of length bins, metres. Cars are not classified by length better than their errors, which
    are alike for all of a model."""


SETTING_LIMITS: Final = SettingLimits()


@dataclass(frozen=True, kw_only=True)
class TrafficSettings:
    """Limits of events, and the intervals that they are summed up over."""

    interval_minutes: int = 15
    """Length of the intervals on the clock; a day is a whole number of them."""
    classes: tuple[str, ...] = TRAFFIC_CLASSES
    """Of `TRAFFIC_CLASSES`: who is counted."""
    hysteresis_m: float = 0.5
    """A gate is crossed, a zone entered, when the road user is seen so far on the other side."""
    least_travel_m: float = 1.0
    """And when so much of its way lies along the gate's normal. To be counted there and back, a vehicle goes twice this
    far from the line in between, others once."""
    ttc_s: float = 1.5
    """A time to collision up to this is a conflict."""
    pet_s: float = 5.0
    """A post-encroachment time up to this is noted."""
    hard_braking_ms2: float = 4.0
    """A vehicle that brakes so hard for a second brakes hard."""
    queue_speed_kmh: float = 5.0
    """A vehicle that is slower stands in a queue."""
    queue_end_kmh: float = 10.0
    """A vehicle in a queue stands in it until it is faster than this."""
    queue_gap_m: float = 20.0
    """A queue ends where the next vehicle is farther away than this."""
    stop_kmh: float = 3.0
    """A road user that is slower for a second and longer has stopped, until it is twice as fast as this."""
    free_flow_kmh: float | None = None
    """Speed without hindrance, which delays are counted from; None: the 85th percentile of the section's motor
    vehicles."""
    turning: tuple[str, ...] | None = None
    """Names of the gates between which movements are counted; None: all."""
    trajectory_interval_s: float = 0.5
    """Trajectories are written with a row so often."""
    length_bins_m: tuple[float, float] = (6.55, 14.94)
    """From which lengths on vehicles are medium, and long: 21.5 and 49 feet (Minge and others, "Loop- and length-based
    vehicle classification", Federal Highway Administration's pooled fund TPF-5(192), 2012)."""
    pce: Mapping[str, float] = field(default_factory=lambda: dict(PCE_FACTORS), hash=False)
    """Passenger-car equivalent of each class; a car is 1 and a pedestrian 0."""

    def to_dict(self) -> dict[str, Any]:
        """The settings as JSON has them."""
        return plain_values(self)


SETTING_RANGES: Final = {
    "hysteresis_m": (0.0, 20.0),
    "least_travel_m": (0.0, 50.0),
    "ttc_s": (0.1, 10.0),
    "pet_s": (0.1, 30.0),
    "hard_braking_ms2": (0.5, 12.0),
    "queue_speed_kmh": (0.5, 50.0),
    "queue_end_kmh": (0.5, 100.0),
    "queue_gap_m": (1.0, 200.0),
    "stop_kmh": (0.5, 20.0),
    "trajectory_interval_s": (0.0, 60.0),
}
"""Settings that are numbers, and what they can be."""


def read_traffic(table: TomlTable, gates: tuple[str, ...], unknown: list[str]) -> TrafficSettings:
    """The table's settings, the default where it does not name one; keys that mean nothing are added to `unknown`.

    Args:
        table: The table; an empty one where the file has none.
        gates: Names of the site's gates.
        unknown: Takes the keys that mean nothing here.

    Raises:
        UserError: A value is wrong; the message names file and key.
    """
    plain = TrafficSettings()
    numbers = {
        key: table.number(key, getattr(plain, key), low=low, high=high) for key, (low, high) in SETTING_RANGES.items()
    }
    free_flow = table.number("free_flow_kmh", low=5, high=250) if "free_flow_kmh" in table else None
    settings = TrafficSettings(
        interval_minutes=_interval(table, plain.interval_minutes),
        classes=_names(table, "classes", TRAFFIC_CLASSES, "classes") or plain.classes,
        turning=_names(table, "turning", gates, "gates of this file"),
        free_flow_kmh=free_flow,
        length_bins_m=_length_bins(table) or plain.length_bins_m,
        pce=_pce_factors(table),
        **numbers,
    )
    if settings.queue_end_kmh < settings.queue_speed_kmh:
        raise table.wrong("queue_end_kmh", f"expected {settings.queue_speed_kmh:g} (queue_speed_kmh) or more")
    unknown += table.unread
    return settings


def _interval(table: TomlTable, default: int) -> int:
    minutes = table.number("interval_minutes", default, low=1, high=SETTING_LIMITS.day_minutes)
    if minutes % 1 or SETTING_LIMITS.day_minutes % minutes:
        raise table.wrong("interval_minutes", f"expected whole minutes that a day is a multiple of, got {minutes:g}")
    return int(minutes)


def _length_bins(table: TomlTable) -> tuple[float, float] | None:
    """The two limits; None where the key is missing."""
    if "length_bins_m" not in table:
        return None
    first, second = table.numbers("length_bins_m", 2)
    low, high = SETTING_LIMITS.length_bins_m
    if not low <= first < second <= high:
        raise table.wrong(
            "length_bins_m", f"expected two lengths that rise, from {low:g} to {high:g} m, got {first:g} and {second:g}"
        )
    return first, second


def _pce_factors(table: TomlTable) -> dict[str, float]:
    """The passenger-car equivalents, with defaults for the classes that the table does not name.

    Raises:
        UserError: A class is unknown, or a factor is no number from 0 to 10.
    """
    factors = table.table("pce")
    read = {
        name: factors.number(name, factor, low=0, high=SETTING_LIMITS.largest_pce)
        for name, factor in PCE_FACTORS.items()
    }
    factors.done()
    return read


def _names(table: TomlTable, key: str, known: tuple[str, ...], what: str) -> tuple[str, ...] | None:
    """A list of names, each of which is known; None where the key is missing."""
    if key not in table:
        return None
    names = table.value(key)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise table.wrong(key, f"expected a list of names of {what}")
    for name in names:
        if checked_name(table, key, name) not in known:
            raise table.wrong(key, f"{name!r} is none of the {what}: {', '.join(known) or 'there are none'}")
    if len(set(names)) < len(names):
        raise table.wrong(key, "a name stands there twice")
    return tuple(names)
