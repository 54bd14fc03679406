"""Conflicts: two road users who would collide if both went on, or of whom one gets where the other one just was."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.schema import PEDESTRIAN
from skope.site.gates_zones_lanes import Zone
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track, has_plausible_speed, is_in_traffic
from skope.traffic.collision import REAR_END_DEG, angle_deg
from skope.traffic.conflict_doubt import STEP_S, hardest_needed, is_followed, pet_sigma, ttc_doubt
from skope.traffic.encounters import Meeting, meeting_of, rows_together
from skope.traffic.encroachment import by_area, near
from skope.traffic.footprints import FootprintPath, footprint_paths, overlap
from skope.traffic.zones import inside_polygon
from skope.types import Array

_CROSSING_DEG: Final = 80.0
"""From this angle on ways cross (SSAM); between that and `REAR_END_DEG` lanes change."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Conflict:
    """Two road users near a collision."""

    first: Track
    second: Track
    """The one that gets where the other one was, or, where that does not happen, that drives behind."""
    time_s: float
    """Of the least time to collision; without one, when the second one gets there. Seconds of the footage."""
    first_s: float
    """The same, but where there is no time to collision, when the first one was there."""
    place: Array
    """(2,) the middle between the two then, metres."""
    zone: str
    """Name of the zone that it lies in; empty for none."""
    kind: str
    """Rear end, lane change or crossing, by the angle between them as SSAM has it."""
    angle_deg: float
    ttc_s: float
    """Least time to collision, seconds; NaN where there is none up to the limit."""
    ttc_low_s: float
    ttc_high_s: float
    """Between these it lies with 90%; infinite: perhaps there is none."""
    probability: float
    """Probability that the time to collision is within the limit and both are road users; NaN where there is none."""
    drac_ms2: float
    """Largest deceleration rate to avoid a crash, m/s^2; NaN where there is no collision ahead."""
    drac_low_ms2: float
    drac_high_ms2: float
    """Between these it lies with 90%."""
    pet_places_s: float
    """Post-encroachment time by SSAM's definition, seconds; NaN where there is none up to the limit."""
    pet_area_s: float
    """The same from when the first one leaves the area that both drive over; NaN where they drive along one way."""
    pet_sigma_s: float
    """Standard deviation of both, seconds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ConflictSearch:
    """The conflicts of a footage, and what was left out."""

    conflicts: tuple[Conflict, ...]
    overlapping: int
    """Pairs whose footprints overlap while they drive, or touch: two tracks of one vehicle, or places that are wrong.
    They are no conflicts."""
    unsteady: int
    """Pairs of which one is not followed well enough where they meet to say that it is a conflict."""


def conflicts(
    trajectories: Sequence[Track],
    settings: TrafficSettings,
    rng: np.random.Generator,
    zones: Sequence[Zone] = (),
    common_sigma: float = 0.0,
) -> ConflictSearch:
    """Find all pairs with a time to collision up to `settings.ttc_s`, or whose ways cross within `settings.pet_s`.

    Args:
        trajectories: All tracks, in metres. Those with the flag `implausible_speed` are in no conflict.
        settings: Limits of the two times.
        rng: Draws places and speeds, for how uncertain a conflict is.
        zones: Give the conflicts in them a name.
        common_sigma: Relative standard deviation that the camera gives all distances and speeds alike. It cancels in
            times, and widens the intervals of decelerations.

    Returns:
        The conflicts by time, and how many pairs were left out.
    """
    followed = [one for one in trajectories if is_in_traffic(one) and has_plausible_speed(one)]
    made = footprint_paths(followed, STEP_S)
    found, overlapping, unsteady = [], 0, 0
    for one, other in _pairs(made, settings.pet_s):
        if not near(one, other, max(settings.pet_s, settings.ttc_s)):
            continue
        if _overlapping(one, other):
            overlapping += 1
        elif (meeting := meeting_of(one, other, settings)) is None:
            continue
        elif not all(is_followed(path.trajectory, time_s) for path, time_s in meeting.in_order()):
            unsteady += 1
        elif meeting.ttc_s <= 0:
            overlapping += 1
        else:
            found.append(_conflict(meeting, settings, rng, zones, common_sigma))
    found.sort(key=lambda conflict: conflict.time_s)
    return ConflictSearch(conflicts=tuple(found), overlapping=overlapping, unsteady=unsteady)


def _pairs(made: Sequence[FootprintPath], late_s: float) -> Iterator[tuple[FootprintPath, FootprintPath]]:
    """Those who are there at the same time, or within `late_s` of each other; not two people on foot."""
    ordered = sorted(made, key=lambda path: int(path.ticks[0]))
    present: list[FootprintPath] = []
    for path in ordered:
        present = [other for other in present if other.times_s[-1] + late_s >= path.times_s[0]]
        for other in present:
            if not path.trajectory.category == other.trajectory.category == PEDESTRIAN:
                yield other, path
        present.append(path)


def _overlapping(one: FootprintPath, other: FootprintPath) -> bool:
    """Whether the footprints ever overlap, each of them a little smaller than it is stated."""
    a, b = rows_together(one, other)
    close = np.linalg.norm(one.place[a] - other.place[b], axis=1) < one.radius + other.radius
    shrunk = [
        path.place[rows, None] + 0.8 * (path.corners[rows] - path.place[rows, None])
        for path, rows in ((one, a[close]), (other, b[close]))
    ]
    return bool(overlap(*shrunk).any())


def _conflict(
    meeting: Meeting,
    settings: TrafficSettings,
    rng: np.random.Generator,
    zones: Sequence[Zone],
    common_sigma: float,
) -> Conflict:
    """The conflict of two who meet, with how uncertain it is."""
    one, other, reached, (i, j) = meeting.one, meeting.other, meeting.reached, meeting.moment
    angle = float(angle_deg(one.facing[i], other.facing[j])) if meeting.close else meeting.ways_deg
    area = by_area(one, other, float(one.times_s[i])) if meeting.ways_deg >= REAR_END_DEG else None
    told = ttc_doubt(one, other, (i, j), settings, rng) if meeting.close else (math.nan,) * 3
    hardest, drac_low, drac_high = hardest_needed(
        one, other, meeting.rows, meeting.seconds, settings, rng, common_sigma
    )
    (first, first_s), (second, second_s) = meeting.in_order()
    middle = (one.place[i] + other.place[j]) / 2
    return Conflict(
        first=first.trajectory,
        second=second.trajectory,
        time_s=second_s,
        first_s=first_s,
        place=middle,
        zone=next((zone.name for zone in zones if inside_polygon(np.array(zone.polygon), middle[None])[0]), ""),
        kind=_kind(angle),
        angle_deg=angle,
        ttc_s=meeting.ttc_s,
        ttc_low_s=told[0],
        ttc_high_s=told[1],
        probability=told[2],
        drac_ms2=hardest,
        drac_low_ms2=drac_low,
        drac_high_ms2=drac_high,
        pet_places_s=reached.seconds if reached is not None else math.nan,
        pet_area_s=area.seconds if area is not None and area.seconds <= settings.pet_s else math.nan,
        pet_sigma_s=pet_sigma(one, other, reached),
    )


def _kind(angle: float) -> str:
    if angle < REAR_END_DEG:
        return "rear end"
    return "crossing" if angle > _CROSSING_DEG else "lane change"
