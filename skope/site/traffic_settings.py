"""The [traffic] table of a site file: rules for counting and measuring traffic."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from skope.records import TomlTable, plain_values
from skope.site.gates_zones_lanes import checked_name

VEHICLE_CLASSES: Final = ("car", "van", "lorry", "bus")
"""Classes of vehicles. A vehicle with a too uncertain class has the class unknown."""
UNKNOWN_CLASS: Final = "unknown"
OF_VEHICLES: Final = frozenset({*VEHICLE_CLASSES, UNKNOWN_CLASS})
"""Classes of vehicles, including unknown."""
TRAFFIC_CLASSES: Final = (*VEHICLE_CLASSES, UNKNOWN_CLASS, "motorcycle", "bicycle", "pedestrian")
"""All classes for counting traffic."""
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
    """Maximum passenger-car equivalent."""
    day_minutes: int = 1440
    """Number of minutes per day."""
    length_bins_m: tuple[float, float] = (5.0, 30.0)
    """Range of the limits of length bins, metres. Cars cannot be classified more finely, because the length errors of
    one model are equal."""


SETTING_LIMITS: Final = SettingLimits()


@dataclass(frozen=True, kw_only=True)
class TrafficSettings:
    """Limits for events, and the length of counting intervals."""

    interval_minutes: int = 15
    """Length of the counting intervals, minutes; it must divide a day."""
    classes: tuple[str, ...] = TRAFFIC_CLASSES
    """Counted classes, from `TRAFFIC_CLASSES`."""
    hysteresis_m: float = 0.5
    """Distance beyond a gate's line or a zone's edge at which it counts as crossed or entered, metres."""
    least_travel_m: float = 1.0
    """Minimum distance travelled along the gate's normal, metres. To be counted in both directions, a vehicle must move
    twice this distance away from the line in between, other road users once."""
    ttc_s: float = 1.5
    """Maximum time to collision of a conflict, seconds."""
    pet_s: float = 5.0
    """Maximum reported post-encroachment time, seconds."""
    hard_braking_ms2: float = 4.0
    """Minimum deceleration over a second of hard braking, m/s^2."""
    queue_speed_kmh: float = 5.0
    """Speed below which a vehicle joins a queue, km/h."""
    queue_end_kmh: float = 10.0
    """Speed above which a vehicle leaves a queue, km/h."""
    queue_gap_m: float = 20.0
    """Maximum distance to the next vehicle of a queue, metres."""
    stop_kmh: float = 3.0
    """Speed below which a road user has stopped after a second, until it is twice as fast, km/h."""
    free_flow_kmh: float | None = None
    """Free-flow speed, the reference for delays, km/h; None: the 85th percentile of the section's motor
    vehicles."""
    turning: tuple[str, ...] | None = None
    """Names of the gates for turning movements; None: all."""
    trajectory_interval_s: float = 0.5
    """Time between rows of written trajectories, seconds."""
    length_bins_m: tuple[float, float] = (6.55, 14.94)
    """Minimum lengths of medium and of long vehicles, metres: 21.5 and 49 feet (Minge and others, "Loop- and
    length-based vehicle classification", Federal Highway Administration's pooled fund TPF-5(192), 2012)."""
    pce: Mapping[str, float] = field(default_factory=lambda: dict(PCE_FACTORS), hash=False)
    """Passenger-car equivalent by class; a car is 1 and a pedestrian 0."""

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as JSON values."""
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
"""Numeric settings with their ranges."""


def read_traffic(table: TomlTable, gates: tuple[str, ...], unknown: list[str]) -> TrafficSettings:
    """Read the settings of a table, with defaults for missing ones; unknown keys are added to `unknown`.

    Args:
        table: The table; empty if the file has none.
        gates: Names of the site's gates.
        unknown: List that receives unknown keys.

    Raises:
        UserError: A value is invalid; the message names file and key.
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
    """Return the two limits; None if the key is missing."""
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
    """Return the passenger-car equivalents, with defaults for missing classes.

    Raises:
        UserError: A class is unknown, or a factor is not a number from 0 to 10.
    """
    factors = table.table("pce")
    read = {
        name: factors.number(name, factor, low=0, high=SETTING_LIMITS.largest_pce)
        for name, factor in PCE_FACTORS.items()
    }
    factors.done()
    return read


def _names(table: TomlTable, key: str, known: tuple[str, ...], subject: str) -> tuple[str, ...] | None:
    """Return a list of known names; None if the key is missing."""
    if key not in table:
        return None
    names = table.value(key)
    if not isinstance(names, list) or not names or not all(isinstance(name, str) for name in names):
        raise table.wrong(key, f"expected a list of names of {subject}")
    for name in names:
        if checked_name(table, key, name) not in known:
            raise table.wrong(key, f"{name!r} is none of the {subject}: {', '.join(known) or 'there are none'}")
    if len(set(names)) < len(names):
        raise table.wrong(key, "a name is listed twice")
    return tuple(names)
