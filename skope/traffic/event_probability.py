"""Probability of counted events, and miss rates of road users, as measured on generated footage.

crossing_rates.json has the rates and describes the footage. scripts/research/gate_coverage.py writes it.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from typing import Any, Final

import numpy as np
from scipy.special import expit

from skope.schema import PEDESTRIAN_CATEGORY, VEHICLE_CATEGORY
from skope.site.traffic_settings import OF_VEHICLES, TRAFFIC_CLASSES
from skope.tracks.track import Track, worst_sigma
from skope.traffic.count_uncertainty import Beta


@dataclass(frozen=True)
class EventFactors:
    """Factors of the probability that an event is real."""

    counted_probability: float = 0.5
    """Probability below which an event is not counted."""
    most_positions: int = 48
    """Number of positions above which the probability of an event no longer grows."""
    doubted: float = 0.75
    """Factor on the probability of an event of a track with one of `DOUBTED_FLAGS`."""
    short_s: float = 0.5
    """Minimum time for which a track must be located before and after a crossing, seconds; else the crossing is in
    doubt."""
    around_s: float = 1.5
    """Half of the period around a crossing that is searched for gaps, seconds."""
    gap_s: float = 0.5
    """Maximum excess of a gap around a crossing over the usual step, seconds; above it the crossing is in doubt."""
    usual_step_s: float = 0.1
    """Time between positions if no track gives it, seconds."""
    jumping: float = 0.1
    """Factor on the probability of a crossing at a speed above `FASTEST_MPS`."""
    same_vehicle: tuple[float, float, float] = (6.13, -3.55, -1.54)
    """Coefficients of the log odds that a track is one vehicle from one gate to the next: intercept; log(0.1 s +
    longest gap); log(1 s + time). Of 526 such tracks 13 had switched to another vehicle, 12 of them in a gap of at
    least 1 s."""
    same_pedestrian: tuple[float, float] = (-1.91, -4.54)
    """Coefficients of the log odds that a track is one pedestrian from one gate to the next: intercept; log(0.05 m +
    largest standard deviation of the position). Of 43 tracks 25 had switched to another pedestrian."""
    same_rider: float = 0.976
    """Probability that a track is one two-wheeler from one gate to the next: 41 of 42 tracks were."""
    few_lost: int = 2
    """Number of lost tracks at a gate that never prevents a confidence interval."""


EVENT_FACTORS: Final = EventFactors()

DOUBTED_FLAGS: Final = frozenset({"two_poses", "impossible_motion", "against_traffic"})
FASTEST_MPS: Final[Mapping[str, float]] = {"bicycle": 16.0, "pedestrian": 6.0}
"""Speed at a crossing, m/s, above which the track probably jumps between two road users."""
_TWO_WHEELED: Final = frozenset({"bicycle", "motorcycle"})


@dataclass(frozen=True)
class MissRateGroup:
    """Group of road-user classes that share one miss rate at a gate."""

    classes: frozenset[str]
    missed: Beta
    """Share of road users that is never detected, as a Beta distribution over gates."""
    came: Beta
    """Share of the tracks lost near a gate (`skope.traffic.missed_crossings`) that did cross it, as a Beta distribution
    over gates."""
    real: float = 1.0
    """Factor on the probability of crossings, from manual counts."""
    rejects_losing_gates: bool = False
    """Whether counts get no confidence interval at a gate at which more tracks are lost than cross."""
    too_small: bool = False
    """Whether counts never get a confidence interval, because too few road users of these classes are detected."""

    @property
    def mean_missed(self) -> float:
        """Mean share that is never detected."""
        return self.missed[0] / sum(self.missed)

    def loses(self, crossed: int, lost: int) -> bool:
        """Return whether too few road users are detected at a gate to estimate their number.

        Args:
            crossed: Number of counted crossings.
            lost: Number of lost tracks.
        """
        return self.too_small or (self.rejects_losing_gates and lost > max(EVENT_FACTORS.few_lost, crossed))


@cache
def rates() -> Mapping[str, Any]:
    """Return the content of crossing_rates.json."""
    text = files("skope.traffic").joinpath("crossing_rates.json").read_text(encoding="utf-8")
    return dict(json.loads(text))


def miss_rate_groups(pixels_per_metre: float | None) -> tuple[MissRateGroup, ...]:
    """Return the groups at a gate in metres: vehicles, two-wheelers, pedestrians.

    Args:
        pixels_per_metre: Size of one metre at the gate, pixels; None: not known.
    """
    metres = rates()["metres"]
    by_size = metres["others"]
    size = "unknown"
    if pixels_per_metre is not None:
        large, small = by_size["large_px_per_m"], by_size["small_px_per_m"]
        size = "large" if pixels_per_metre >= large else "tiny" if pixels_per_metre < small else "unknown"
    missed, came = (_beta(by_size[size][name]) for name in ("missed", "came"))
    vehicle = metres["vehicle"]
    vehicles = MissRateGroup(
        OF_VEHICLES,
        _beta(vehicle["missed"]),
        _beta(vehicle["came"]),
        rejects_losing_gates=True,
        too_small=pixels_per_metre is not None and pixels_per_metre < vehicle["small_px_per_m"],
    )
    remaining_classes = (_TWO_WHEELED, frozenset({PEDESTRIAN_CATEGORY}))
    return vehicles, *(MissRateGroup(classes, missed, came, too_small=size == "tiny") for classes in remaining_classes)


def image_miss_rate_groups(vehicle_px: float | None) -> tuple[MissRateGroup, ...]:
    """Return the only group at a gate in the image, which contains all classes.

    Args:
        vehicle_px: Usual height of a vehicle's box at the gate, pixels; None: not known.
    """
    image = rates()["image"]
    small = vehicle_px is not None and vehicle_px < image["small_px"]
    return (MissRateGroup(frozenset(TRAFFIC_CLASSES), _beta(image["missed"]), _beta(image["came"]), too_small=small),)


def queue_miss_rate() -> Beta:
    """Return the distribution of the share of queued vehicles that are never detected."""
    return _beta(rates()["metres"]["queue"]["missed"])


def _beta(values: Sequence[float]) -> Beta:
    a, b = map(float, values)
    return a, b


def event_probability(track: Track) -> float:
    """Return the probability that an event of a track happened, and is not also an event of a second track.

    The probability follows from the number of measured positions by Laplace's rule of succession.
    """
    positions = min(int(track.located.sum()), EVENT_FACTORS.most_positions)
    return (positions + 1) / (positions + 2) * undoubted(track)


def crossing_probability(track: Track, time_s: float, step_s: float, *, metres: bool = True) -> float:
    """Return the probability that a road user crossed a gate, and is not also counted there by a second track.

    Args:
        track: The track that crosses.
        time_s: Time of the crossing, seconds of the footage.
        step_s: Usual time between positions in the footage (`usual_step`).
        metres: Whether positions are in metres; else in pixels.
    """
    kind = "vehicle" if track.category == VEHICLE_CATEGORY else "others"
    real, number = rates()["metres" if metres else "image"]["real"][kind][crossing_doubts(track, time_s, step_s)]
    jumps = metres and float(track.at(track.speed, time_s)) > FASTEST_MPS.get(track.category, math.inf)
    return float((real + 1) / (number + 2) * undoubted(track) * (EVENT_FACTORS.jumping if jumps else 1.0))


def crossing_doubts(track: Track, time_s: float, step_s: float) -> int:
    """Return the number of reasons to doubt a crossing, 0 to 2.

    First reason: the track was located for less than 0.5 s before or after the crossing. Second reason: a gap near the
    crossing exceeds the usual step by more than 0.5 s. Footage with a low frame rate is therefore not in doubt.

    Args:
        track: The track that crosses.
        time_s: Time of the crossing, seconds of the footage.
        step_s: Usual time between positions in the footage.
    """
    times = track.times_s[track.located]
    short = min(time_s - float(times[0]), float(times[-1]) - time_s) < EVENT_FACTORS.short_s
    gap = track.longest_gap(time_s, EVENT_FACTORS.around_s) - step_s > EVENT_FACTORS.gap_s
    return int(short) + int(gap)


def same_probability(track: Track, begin_s: float, end_s: float, step_s: float) -> float:
    """Return the probability that a track, in metres, belongs to one road user for a whole period.

    Args:
        track: The track.
        begin_s: Start of the period, seconds.
        end_s: End of the period, seconds.
        step_s: Usual time between positions in the footage (`usual_step`).
    """
    if track.category in _TWO_WHEELED:
        return EVENT_FACTORS.same_rider
    if track.category == VEHICLE_CATEGORY:
        gap_s = max(0.0, track.longest_gap((begin_s + end_s) / 2, (end_s - begin_s) / 2) - step_s)
        constant, of_gap, of_time = EVENT_FACTORS.same_vehicle
        logit = constant + of_gap * math.log(0.1 + gap_s) + of_time * math.log(1 + end_s - begin_s)
    else:
        between = track.times_s[(track.times_s > begin_s) & (track.times_s < end_s)]
        covariances = track.at(track.total_covariance, np.array([begin_s, *between, end_s]))
        constant, of_sigma = EVENT_FACTORS.same_pedestrian
        logit = constant + of_sigma * math.log(0.05 + float(worst_sigma(covariances).max()))
    return float(expit(logit))


def usual_step(tracks: Sequence[Track]) -> float:
    """Return the median time between positions of all tracks, seconds; 0.1 if there are none."""
    steps = [np.diff(track.times_s[track.located]) for track in tracks]
    every = np.concatenate([np.zeros(0), *steps])
    return float(np.median(every)) if len(every) else EVENT_FACTORS.usual_step_s


def undoubted(track: Track) -> float:
    """Return the factor for the flags of a track and for joined parts."""
    doubted = EVENT_FACTORS.doubted if DOUBTED_FLAGS & set(track.flags) else 1.0
    return doubted * track.stitch_probability
