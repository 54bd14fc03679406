"""Find conflicts: pairs of road users on a collision course, or shortly after each other in the same place.

A conflict is made from an encounter: two road users close to a collision, or one after the other in the same place.
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
    CONFLICT_UNCERTAINTY,
    hardest_needed,
    in_order,
    is_followed,
    pet_sigma,
    surely_encroaches,
    ttc_interval,
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
    """Minimum speed of the faster road user, m/s."""
    block_rows: int = 400
    """Number of moments that are computed together. It bounds memory."""
    crossing_deg: float = 80.0
    """Minimum angle of a crossing conflict (SSAM), degrees. Below it, and above `rear_end_deg`, it is a lane change."""


CONFLICT_LIMITS: Final = ConflictLimits()


@dataclass(frozen=True, kw_only=True)
class Encounter:
    """Two road users close to a collision, or one after the other in the same place."""

    first: FootprintPath
    second: FootprintPath
    rows: tuple[NDArray[np.intp], NDArray[np.intp]]
    """Rows of both paths at the times when they are near each other."""
    seconds: Array
    """Times to collision at these rows, seconds."""
    moment: tuple[int, int]
    """Rows of both paths at the time of the conflict."""
    ttc_s: float
    """Smallest time to collision, seconds; NaN if it is above the limit."""
    encroachment: Encroachment | None
    """The encroachment with the smallest time; None if there is none within the limit."""
    crossing_angle_deg: float
    """Angle between the two paths, degrees."""

    @property
    def close(self) -> bool:
        """Whether a collision is ahead within the limit of the time to collision."""
        return not math.isnan(self.ttc_s)

    def in_order(self) -> tuple[tuple[FootprintPath, float], tuple[FootprintPath, float]]:
        """Both paths with the time at which each is in conflict, the earlier one first."""
        first, second = self.first, self.second
        swapped = self.encroachment.swapped if self.encroachment is not None else _behind(first, second, *self.moment)
        earlier, later = (second, first) if swapped else (first, second)
        if self.close or self.encroachment is None:
            time_s = float(first.times_s[self.moment[0]])
            return (earlier, time_s), (later, time_s)
        return (earlier, self.encroachment.first_s), (later, self.encroachment.second_s)


def find_encounter(first: FootprintPath, second: FootprintPath, settings: TrafficSettings) -> Encounter | None:
    """Find the encounter of two road users.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        settings: `ttc_s` and `pet_s` are the limits.

    Returns:
        The encounter. None without an encounter, if one road user only follows the other, or if it is uncertain whether
        both use the same place.
    """
    rows, seconds = _approaches(first, second, settings)
    least = int(seconds.argmin()) if len(seconds) else 0
    close = bool(len(seconds) and seconds[least] <= settings.ttc_s)
    if not close and _go_the_same_way(first, second):
        return None  # one follows the other: this is a gap
    encroachment = by_places(first, second, settings.pet_s)
    if encroachment is not None and encroachment.seconds == 0:
        encroachment = None  # the footprints touch: positions are not exact enough for an encroachment
    if close:
        i, j = int(rows[0][least]), int(rows[1][least])
    elif encroachment is not None:
        times = (encroachment.first_s, encroachment.second_s)
        i, j = (_row(path, time_s) for path, time_s in zip((first, second), in_order(times, encroachment), strict=True))
    else:
        return None
    # Two vehicles that turn one behind the other differ in heading at the same time, but not at the same place.
    crossing_angle_deg = _angle_of_ways(first, second, i, j)
    if not close and crossing_angle_deg < COLLISION_LIMITS.rear_end_deg:
        return None  # one follows the other: this is a gap
    if not close and not surely_encroaches(first, second, i, j, settings.pet_s):
        return None
    return Encounter(
        first=first,
        second=second,
        rows=rows,
        seconds=seconds,
        moment=(i, j),
        ttc_s=float(seconds[least]) if close else math.nan,
        encroachment=encroachment,
        crossing_angle_deg=crossing_angle_deg,
    )


def rows_together(first: FootprintPath, second: FootprintPath) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of both paths at the times that they have in common."""
    begin, end = max(first.ticks[0], second.ticks[0]), min(first.ticks[-1], second.ticks[-1]) + 1
    ticks = np.arange(begin, max(begin, end))
    return ticks - first.ticks[0], ticks - second.ticks[0]


def _approaches(
    first: FootprintPath, second: FootprintPath, settings: TrafficSettings
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], Array]:
    """Return the rows at which both road users are near each other, and the times to their collision."""
    a, b = rows_together(first, second)
    horizon = max(settings.ttc_s, CONFLICT_UNCERTAINTY.horizon_s)
    speeds = first.speed[a] + second.speed[b]
    reach = first.radius + second.radius + speeds * horizon
    close = (np.linalg.norm(first.position[a] - second.position[b], axis=1) < reach) & (
        np.maximum(first.speed[a], second.speed[b]) >= CONFLICT_LIMITS.moving_mps
    )
    rows = a[close], b[close]
    parts = [
        (rows[0][k : k + CONFLICT_LIMITS.block_rows], rows[1][k : k + CONFLICT_LIMITS.block_rows])
        for k in range(0, len(rows[0]), CONFLICT_LIMITS.block_rows)
    ]
    seconds = [times_to_collision(first, second, part, horizon) for part in parts]
    return rows, np.concatenate([np.zeros(0), *seconds])


def _go_the_same_way(first: FootprintPath, second: FootprintPath) -> bool:
    """Return whether all headings of two road users differ by less than `COLLISION_LIMITS.rear_end_deg`."""
    (first_middle, first_spread), (second_middle, second_spread) = first.headings_deg, second.headings_deg
    apart = abs(math.remainder(first_middle - second_middle, 360))
    return apart + first_spread + second_spread < COLLISION_LIMITS.rear_end_deg


def _angle_of_ways(first: FootprintPath, second: FootprintPath, i: int, j: int) -> float:
    """Return the angle between two paths, degrees, where one path is nearest to the position of the other road user."""
    first_row = int(np.linalg.norm(first.position - second.position[j], axis=1).argmin())
    second_row = int(np.linalg.norm(second.position - first.position[i], axis=1).argmin())
    return float(
        min(angle_deg(first.facing[first_row], second.facing[j]), angle_deg(first.facing[i], second.facing[second_row]))
    )


def _row(path: FootprintPath, time_s: float) -> int:
    return int(np.abs(path.times_s - time_s).argmin())


def _behind(first: FootprintPath, second: FootprintPath, i: int, j: int) -> bool:
    """Return whether `second` is ahead of `first`."""
    return bool((second.position[j] - first.position[i]) @ first.facing[i] > 0)


@dataclass(frozen=True, kw_only=True, eq=False)
class Conflict:
    """Conflict of two road users."""

    first: Track
    second: Track
    """Road user that reaches the place after `first`; without an encroachment, the road user behind."""
    time_s: float
    """Time of the smallest time to collision, seconds of the footage. Without a time to collision: time at which
    `second` reaches the place."""
    first_s: float
    """Time of the smallest time to collision, seconds of the footage. Without a time to collision: time at which
    `first` was at the place."""
    position: Array
    """(2,) midpoint between the two road users at the conflict, metres."""
    zone: str
    """Name of the zone that contains `position`; empty for none."""
    kind: str
    """Conflict type by angle (SSAM): "rear end", "lane change" or "crossing"."""
    angle_deg: float
    """Angle between the two road users, degrees."""
    ttc_s: float
    """Smallest time to collision, seconds; NaN if there is none up to the limit."""
    ttc_low_s: float
    ttc_high_s: float
    """`ttc_low_s` and `ttc_high_s` are the 90% confidence interval of `ttc_s`; infinite: there may be no collision."""
    probability: float
    """Probability that the time to collision is within the limit and both are road users; NaN without `ttc_s`."""
    drac_ms2: float
    """Largest deceleration rate to avoid a crash, m/s^2; NaN if there is no collision ahead."""
    drac_low_ms2: float
    drac_high_ms2: float
    """`drac_low_ms2` and `drac_high_ms2` are the 90% confidence interval of `drac_ms2`."""
    pet_ssam_s: float
    """Post-encroachment time by SSAM's definition, seconds; NaN if there is none up to the limit."""
    pet_area_s: float
    """Post-encroachment time for the area that both road users cover, seconds. NaN if there is none up to the limit, or
    if both use the same path."""
    pet_sigma_s: float
    """Standard deviation of `pet_ssam_s` and `pet_area_s`, seconds."""


@dataclass(frozen=True, kw_only=True, eq=False)
class ConflictSearch:
    """Conflicts of the footage, and the numbers of excluded pairs."""

    conflicts: tuple[Conflict, ...]
    overlapping: int
    """Number of pairs excluded because their footprints overlap or touch: two tracks of one vehicle, or wrong
    positions."""
    poorly_tracked_pairs: int
    """Number of pairs excluded because a track is too poor at the encounter."""


def conflicts(
    trajectories: Sequence[Track],
    settings: TrafficSettings,
    rng: np.random.Generator,
    zones: Sequence[Zone] = (),
    common_scale_sigma: float = 0.0,
) -> ConflictSearch:
    """Find the conflicts: a time to collision up to `settings.ttc_s`, or paths that cross within `settings.pet_s`.

    Args:
        trajectories: All tracks, in metres. Tracks with the flag `implausible_speed` are excluded.
        settings: Limits of the two times.
        rng: Random generator for positions and speeds, which give the uncertainty of a conflict.
        zones: Zones. A conflict gets the name of the first zone that contains it.
        common_scale_sigma: Relative standard deviation of the scale, which all distances and speeds share. The scale
            error cancels in times. It widens the confidence intervals of decelerations.

    Returns:
        The conflicts in order of time, and the numbers of excluded pairs.
    """
    followed = [track for track in trajectories if is_in_traffic(track) and has_plausible_speed(track)]
    made = footprint_paths(followed, CONFLICT_UNCERTAINTY.step_s)
    found, overlapping, poorly_tracked_pairs = [], 0, 0
    for first, second in _pairs(made, settings.pet_s):
        if not near(first, second, max(settings.pet_s, settings.ttc_s)):
            continue
        if _overlapping(first, second):
            overlapping += 1
        elif (encounter := find_encounter(first, second, settings)) is None:
            continue
        elif not all(is_followed(path.trajectory, time_s) for path, time_s in encounter.in_order()):
            poorly_tracked_pairs += 1
        elif encounter.ttc_s <= 0:
            overlapping += 1
        else:
            found.append(_conflict(encounter, settings, rng, zones, common_scale_sigma))
    found.sort(key=lambda conflict: conflict.time_s)
    return ConflictSearch(conflicts=tuple(found), overlapping=overlapping, poorly_tracked_pairs=poorly_tracked_pairs)


def _pairs(made: Sequence[FootprintPath], late_s: float) -> Iterator[tuple[FootprintPath, FootprintPath]]:
    """Yield pairs that are present at the same time, or within `late_s` of each other, except two pedestrians."""
    ordered = sorted(made, key=lambda path: int(path.ticks[0]))
    present: list[FootprintPath] = []
    for path in ordered:
        present = [earlier for earlier in present if earlier.times_s[-1] + late_s >= path.times_s[0]]
        for earlier in present:
            if not path.trajectory.category == earlier.trajectory.category == PEDESTRIAN_CATEGORY:
                yield earlier, path
        present.append(path)


def _overlapping(first: FootprintPath, second: FootprintPath) -> bool:
    """Return whether the footprints ever overlap if each is reduced to 80% of its size."""
    a, b = rows_together(first, second)
    close = np.linalg.norm(first.position[a] - second.position[b], axis=1) < first.radius + second.radius
    shrunk = [path.footprints[rows].scaled(0.8) for path, rows in ((first, a[close]), (second, b[close]))]
    return bool(overlap(*shrunk).any())


def _conflict(
    encounter: Encounter,
    settings: TrafficSettings,
    rng: np.random.Generator,
    zones: Sequence[Zone],
    common_scale_sigma: float,
) -> Conflict:
    """Return the conflict of an encounter, with its uncertainty."""
    first, second, encroachment, (i, j) = encounter.first, encounter.second, encounter.encroachment, encounter.moment
    angle = float(angle_deg(first.facing[i], second.facing[j])) if encounter.close else encounter.crossing_angle_deg
    area = (
        by_area(first, second, float(first.times_s[i]))
        if encounter.crossing_angle_deg >= COLLISION_LIMITS.rear_end_deg
        else None
    )
    interval = ttc_interval(first, second, (i, j), settings, rng) if encounter.close else (math.nan,) * 3
    hardest, drac_low, drac_high = hardest_needed(
        first, second, encounter.rows, encounter.seconds, settings, rng, common_scale_sigma
    )
    (earlier, first_s), (later, second_s) = encounter.in_order()
    middle = (first.position[i] + second.position[j]) / 2
    return Conflict(
        first=earlier.trajectory,
        second=later.trajectory,
        time_s=second_s,
        first_s=first_s,
        position=middle,
        zone=next((zone.name for zone in zones if inside_polygon(np.array(zone.polygon), middle[None])[0]), ""),
        kind=_kind(angle),
        angle_deg=angle,
        ttc_s=encounter.ttc_s,
        ttc_low_s=interval[0],
        ttc_high_s=interval[1],
        probability=interval[2],
        drac_ms2=hardest,
        drac_low_ms2=drac_low,
        drac_high_ms2=drac_high,
        pet_ssam_s=encroachment.seconds if encroachment is not None else math.nan,
        pet_area_s=area.seconds if area is not None and area.seconds <= settings.pet_s else math.nan,
        pet_sigma_s=pet_sigma(first, second, encroachment),
    )


def _kind(angle: float) -> str:
    if angle < COLLISION_LIMITS.rear_end_deg:
        return "rear end"
    return "crossing" if angle > CONFLICT_LIMITS.crossing_deg else "lane change"
