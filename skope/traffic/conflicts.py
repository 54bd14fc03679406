"""Conflicts: two road users who would collide if both continued, or of whom one reaches where the other just was.

Encounters of two road users, near a collision or one after the other in one place, are what conflicts are made of.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.schema import PEDESTRIAN_CATEGORY
from skope.site.gates_zones_lanes import Zone
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track, has_plausible_speed, is_in_traffic
from skope.traffic.conflict_doubt import (
    CONFLICT_DOUBT,
    hardest_needed,
    in_order,
    is_followed,
    pet_sigma,
    surely_encroaches,
    ttc_doubt,
)
from skope.traffic.footprints import FootprintPath, footprint_paths, overlap
from skope.traffic.post_encroachment_time import Encroachment, by_area, by_places, near
from skope.traffic.time_to_collision import COLLISION_LIMITS, angle_deg, times_to_collision
from skope.traffic.zones import inside_polygon
from skope.types import Array


@dataclass(frozen=True)
class ConflictLimits:
    """Limits of conflicts."""

    moving_mps: float = 1.0
    """Least speed of one of the two road users, m/s."""
    block_rows: int = 400
    """Number of moments that are computed together. It bounds memory."""
    crossing_deg: float = 80.0
    """Angle from which paths cross (SSAM), degrees. Between `rear_end_deg` and this it is a lane change."""


CONFLICT_LIMITS: Final = ConflictLimits()


@dataclass(frozen=True, kw_only=True)
class Meeting:
    """Two who come near to a collision, or get where the other one was."""

    one: FootprintPath
    other: FootprintPath
    rows: tuple[NDArray[np.intp], NDArray[np.intp]]
    """Of the moments at which they are near."""
    seconds: Array
    """Times to their collision then."""
    moment: tuple[int, int]
    """The rows of the moment of the conflict."""
    ttc_s: float
    """The least of the times; NaN where it is above the limit."""
    reached: Encroachment | None
    ways_deg: float
    """Between their ways."""

    @property
    def close(self) -> bool:
        """Whether a collision is ahead within the limit."""
        return not math.isnan(self.ttc_s)

    def in_order(self) -> tuple[tuple[FootprintPath, float], tuple[FootprintPath, float]]:
        """The first and the second of the two, and when they meet."""
        one, other = self.one, self.other
        swapped = self.reached.swapped if self.reached is not None else _behind(one, other, *self.moment)
        first, second = (other, one) if swapped else (one, other)
        if self.close or self.reached is None:
            time_s = float(one.times_s[self.moment[0]])
            return (first, time_s), (second, time_s)
        return (first, self.reached.first_s), (second, self.reached.second_s)


def meeting_of(one: FootprintPath, other: FootprintPath, settings: TrafficSettings) -> Meeting | None:
    """Find where two come near a collision, or get where the other one was.

    Args:
        one: A road user.
        other: Another one.
        settings: `ttc_s` and `pet_s` are the limits.

    Returns:
        The meeting; None where there is none, where one only follows the other, or where it is doubtful that places
        cross.
    """
    rows, seconds = _approaches(one, other, settings)
    least = int(seconds.argmin()) if len(seconds) else 0
    close = bool(len(seconds) and seconds[least] <= settings.ttc_s)
    reached = by_places(one, other, settings.pet_s)
    if reached is not None and reached.seconds == 0:
        reached = None  # they touch: places are not that exact
    if close:
        i, j = int(rows[0][least]), int(rows[1][least])
    elif reached is not None:
        times = (reached.first_s, reached.second_s)
        i, j = (_row(path, time_s) for path, time_s in zip((one, other), in_order(times, reached), strict=True))
    else:
        return None
    # Two that turn one behind the other head elsewhere at any moment, but not at any place.
    ways_deg = _angle_of_ways(one, other, i, j)
    if not close and ways_deg < COLLISION_LIMITS.rear_end_deg:
        return None  # one behind the other: that is a gap
    if not close and not surely_encroaches(one, other, i, j, settings.pet_s):
        return None
    return Meeting(
        one=one,
        other=other,
        rows=rows,
        seconds=seconds,
        moment=(i, j),
        ttc_s=float(seconds[least]) if close else math.nan,
        reached=reached,
        ways_deg=ways_deg,
    )


def rows_together(one: FootprintPath, other: FootprintPath) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The rows of the moments at which both are there, of each."""
    begin, end = max(one.ticks[0], other.ticks[0]), min(one.ticks[-1], other.ticks[-1]) + 1
    ticks = np.arange(begin, max(begin, end))
    return ticks - one.ticks[0], ticks - other.ticks[0]


def _approaches(
    one: FootprintPath, other: FootprintPath, settings: TrafficSettings
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], Array]:
    """The rows of moments at which the two are near, and the times to their collision."""
    a, b = rows_together(one, other)
    horizon = max(settings.ttc_s, CONFLICT_DOUBT.horizon_s)
    speeds = one.speed[a] + other.speed[b]
    reach = one.radius + other.radius + speeds * horizon
    close = (np.linalg.norm(one.place[a] - other.place[b], axis=1) < reach) & (
        np.maximum(one.speed[a], other.speed[b]) >= CONFLICT_LIMITS.moving_mps
    )
    rows = a[close], b[close]
    parts = [
        (rows[0][k : k + CONFLICT_LIMITS.block_rows], rows[1][k : k + CONFLICT_LIMITS.block_rows])
        for k in range(0, len(rows[0]), CONFLICT_LIMITS.block_rows)
    ]
    seconds = [times_to_collision(one, other, part, horizon) for part in parts]
    return rows, np.concatenate([np.zeros(0), *seconds])


def _angle_of_ways(one: FootprintPath, other: FootprintPath, i: int, j: int) -> float:
    """Degrees between the ways of two, where the way of one is nearest to where the other one is."""
    here = int(np.linalg.norm(one.place - other.place[j], axis=1).argmin())
    there = int(np.linalg.norm(other.place - one.place[i], axis=1).argmin())
    return float(min(angle_deg(one.facing[here], other.facing[j]), angle_deg(one.facing[i], other.facing[there])))


def _row(path: FootprintPath, time_s: float) -> int:
    return int(np.abs(path.times_s - time_s).argmin())


def _behind(one: FootprintPath, other: FootprintPath, i: int, j: int) -> bool:
    """Whether `one` sees `other` ahead."""
    return bool((other.place[j] - one.place[i]) @ one.facing[i] > 0)


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
    made = footprint_paths(followed, CONFLICT_DOUBT.step_s)
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
            if not path.trajectory.category == other.trajectory.category == PEDESTRIAN_CATEGORY:
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
    area = by_area(one, other, float(one.times_s[i])) if meeting.ways_deg >= COLLISION_LIMITS.rear_end_deg else None
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
    if angle < COLLISION_LIMITS.rear_end_deg:
        return "rear end"
    return "crossing" if angle > CONFLICT_LIMITS.crossing_deg else "lane change"
