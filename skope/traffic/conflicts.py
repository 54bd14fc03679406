"""Conflicts: two road users who would collide if both went on, or of whom one gets where the other one just was."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.site.marks import Zone
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.collision import REAR_END_DEG, Doubt, angle_deg, deceleration_to_avoid, times_to_collision
from skope.traffic.encroachment import Encroachment, by_area, by_places, near
from skope.traffic.event_probability import event_probability
from skope.traffic.footprints import FootprintPath, overlap, paths
from skope.traffic.normal_distribution import LEVEL, Z
from skope.traffic.trajectories import LENGTH_SIGMA_M, Trajectory, wandering
from skope.traffic.zones import inside
from skope.types import Array

_STEP_S: Final = 0.1
"""Pairs are looked at so often, as SSAM does."""
_CROSSING_DEG: Final = 80.0
"""From this angle on ways cross (SSAM); between that and `REAR_END_DEG` lanes change."""
_DRIVES: Final = 1.0
"""One of two in a conflict is as fast as this, m/s."""
_SAMPLES: Final = 200
"""So many draws of places and speeds tell how uncertain a time to collision is."""
_HORIZON_S: Final = 3.0
"""Decelerations count collisions that are ahead so far, seconds, or as far as a conflict's."""
_ROWS: Final = 400
"""Moments that are looked at together, which bounds the memory."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Conflict:
    """Two road users near a collision."""

    first: Trajectory
    second: Trajectory
    """Who gets where the other one was, or, where that does not happen, who drives behind."""
    time_s: float
    """Of the least time to collision; without one, when the second one gets there. Seconds of the footage."""
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
    """Pairs whose footprints overlap while they drive: two tracks of one vehicle, or places that are wrong. They are
    no conflicts."""


def conflicts(
    trajectories: Sequence[Trajectory],
    settings: TrafficSettings,
    rng: np.random.Generator,
    zones: Sequence[Zone] = (),
) -> ConflictSearch:
    """All pairs with a time to collision up to `settings.ttc_s`, or whose ways cross within `settings.pet_s`.

    `zones` give the conflicts in them a name.
    """
    made = paths([one for one in trajectories if wandering(one)], _STEP_S)
    found, overlapping = [], 0
    for one, other in _pairs(made, settings.pet_s):
        if not near(one, other, max(settings.pet_s, settings.ttc_s)):
            continue
        if _overlapping(one, other):
            overlapping += 1
        elif (conflict := _between(one, other, settings, rng, zones)) is not None:
            found.append(conflict)
    found.sort(key=lambda conflict: conflict.time_s)
    return ConflictSearch(conflicts=tuple(found), overlapping=overlapping)


def _pairs(made: Sequence[FootprintPath], late_s: float) -> Iterator[tuple[FootprintPath, FootprintPath]]:
    """Those who are there at the same time, or within `late_s` of each other; not two people on foot."""
    ordered = sorted(made, key=lambda path: int(path.ticks[0]))
    present: list[FootprintPath] = []
    for path in ordered:
        present = [other for other in present if other.times_s[-1] + late_s >= path.times_s[0]]
        for other in present:
            if not path.trajectory.category == other.trajectory.category == "pedestrian":
                yield other, path
        present.append(path)


def _common(one: FootprintPath, other: FootprintPath) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """The rows of the moments at which both are there."""
    begin, end = max(one.ticks[0], other.ticks[0]), min(one.ticks[-1], other.ticks[-1]) + 1
    ticks = np.arange(begin, max(begin, end))
    return ticks - one.ticks[0], ticks - other.ticks[0]


def _overlapping(one: FootprintPath, other: FootprintPath) -> bool:
    """Whether the footprints ever overlap, each of them a little smaller than it is stated."""
    a, b = _common(one, other)
    close = np.linalg.norm(one.place[a] - other.place[b], axis=1) < one.radius + other.radius
    shrunk = [
        path.place[rows, None] + 0.8 * (path.corners[rows] - path.place[rows, None])
        for path, rows in ((one, a[close]), (other, b[close]))
    ]
    return bool(overlap(*shrunk).any())


def _between(
    one: FootprintPath,
    other: FootprintPath,
    settings: TrafficSettings,
    rng: np.random.Generator,
    zones: Sequence[Zone],
) -> Conflict | None:
    rows, seconds, drac = _approaches(one, other, settings)
    least = int(seconds.argmin()) if len(seconds) else 0
    close = bool(len(seconds) and seconds[least] <= settings.ttc_s)
    reached = by_places(one, other, settings.pet_s)
    if reached is not None and reached.seconds == 0:
        reached = None  # they touch: places are not that exact
    if close:
        i, j = int(rows[0][least]), int(rows[1][least])
    elif reached is not None:
        times = (reached.first_s, reached.second_s)
        i, j = (_row(path, time_s) for path, time_s in zip((one, other), _in_order(times, reached), strict=True))
    else:
        return None
    # Two that turn one behind the other head elsewhere at any moment, but not at any place.
    ways_deg = _angle_of_ways(one, other, i, j)
    if not close and ways_deg < REAR_END_DEG:
        return None  # one behind the other: that is a gap
    if not close and not _surely(one, other, i, j, settings.pet_s):
        return None
    angle = float(angle_deg(one.facing[i], other.facing[j])) if close else ways_deg
    area = by_area(one, other, float(one.times_s[i])) if ways_deg >= REAR_END_DEG else None
    low, high, probability = _ttc_doubt(one, other, (i, j), settings, rng) if close else (math.nan,) * 3
    hardest, drac_low, drac_high = _hardest(one, other, rows, drac, settings, rng)
    swapped = reached.swapped if reached is not None else _behind(one, other, i, j)
    middle = (one.place[i] + other.place[j]) / 2
    return Conflict(
        first=(other if swapped else one).trajectory,
        second=(one if swapped else other).trajectory,
        time_s=float(one.times_s[i]) if close or reached is None else reached.second_s,
        place=middle,
        zone=next((zone.name for zone in zones if inside(np.array(zone.polygon), middle[None])[0]), ""),
        kind=_kind(angle),
        angle_deg=angle,
        ttc_s=float(seconds[least]) if close else math.nan,
        ttc_low_s=low,
        ttc_high_s=high,
        probability=probability,
        drac_ms2=hardest,
        drac_low_ms2=drac_low,
        drac_high_ms2=drac_high,
        pet_places_s=reached.seconds if reached is not None else math.nan,
        pet_area_s=area.seconds if area is not None and area.seconds <= settings.pet_s else math.nan,
        pet_sigma_s=_pet_sigma(one, other, reached, (i, j)),
    )


def _approaches(
    one: FootprintPath, other: FootprintPath, settings: TrafficSettings
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], Array, Array]:
    """The rows of moments at which the two are near, the times to their collision, and what avoids it, m/s^2."""
    a, b = _common(one, other)
    horizon = max(settings.ttc_s, _HORIZON_S)
    speeds = one.speed[a] + other.speed[b]
    reach = one.radius + other.radius + speeds * horizon
    close = (np.linalg.norm(one.place[a] - other.place[b], axis=1) < reach) & (
        np.maximum(one.speed[a], other.speed[b]) >= _DRIVES
    )
    rows = a[close], b[close]
    parts = [(rows[0][k : k + _ROWS], rows[1][k : k + _ROWS]) for k in range(0, len(rows[0]), _ROWS)]
    seconds = [times_to_collision(one, other, part, horizon) for part in parts]
    needed = [deceleration_to_avoid(one, other, *pair) for pair in zip(parts, seconds, strict=True)]
    none = np.zeros(0)
    return rows, np.concatenate([none, *seconds]), np.concatenate([none, *needed])


def _ttc_doubt(
    one: FootprintPath, other: FootprintPath, row: tuple[int, int], settings: TrafficSettings, rng: np.random.Generator
) -> tuple[float, float, float]:
    """Between what the time to collision lies with 90%, and the probability that it is within the limit, of two."""
    index, doubt = _drawn(one, other, row, rng)
    drawn = times_to_collision(one, other, index, _farthest_s(settings), doubt)
    both = event_probability(one.trajectory) * event_probability(other.trajectory)
    return *_middle(drawn), both * float((drawn <= settings.ttc_s).mean())


def _hardest(
    one: FootprintPath,
    other: FootprintPath,
    rows: tuple[NDArray[np.intp], NDArray[np.intp]],
    drac: Array,
    settings: TrafficSettings,
    rng: np.random.Generator,
) -> tuple[float, float, float]:
    """The largest deceleration of the moments `rows`, and between what it lies with 90%; NaN where there is none."""
    if not len(drac) or drac.max() <= 0:
        return (math.nan,) * 3
    k = int(drac.argmax())
    index, doubt = _drawn(one, other, (int(rows[0][k]), int(rows[1][k])), rng)
    ahead = times_to_collision(one, other, index, _farthest_s(settings), doubt)
    return float(drac[k]), *_middle(deceleration_to_avoid(one, other, index, ahead, doubt))


def _farthest_s(settings: TrafficSettings) -> float:
    """How far ahead drawn collisions are looked for, seconds: much farther than the one that was found."""
    return 4 * max(settings.ttc_s, _HORIZON_S)


def _drawn(
    one: FootprintPath, other: FootprintPath, rows: tuple[int, int], rng: np.random.Generator
) -> tuple[tuple[NDArray[np.intp], NDArray[np.intp]], Doubt]:
    """A moment `_SAMPLES` times, with places and speeds drawn as uncertain as they are."""
    shifts, speeds = [], []
    for path, row in zip((one, other), rows, strict=True):
        time_s, trajectory = float(path.times_s[row]), path.trajectory
        shifts.append(rng.multivariate_normal(np.zeros(2), trajectory.at(trajectory.covariance, time_s), _SAMPLES))
        sigma = float(trajectory.at(trajectory.speed_sigma, time_s))
        speeds.append(np.maximum(0.0, path.speed[row] + rng.normal(0, sigma, _SAMPLES)))
    index = np.full(_SAMPLES, rows[0]), np.full(_SAMPLES, rows[1])
    return index, Doubt((shifts[0], shifts[1]), (speeds[0], speeds[1]))


def _middle(drawn: Array) -> tuple[float, float]:
    """Between what values lie with `LEVEL`; infinite ones are the largest."""
    tail = round(len(drawn) * (1 - LEVEL) / 2)
    ordered = np.sort(drawn)
    return float(ordered[tail]), float(ordered[-1 - tail])


def _pet_sigma(one: FootprintPath, other: FootprintPath, reached: Encroachment | None, rows: tuple[int, int]) -> float:
    """Standard deviation of an encroachment's time: of the two times, by places, lengths and speeds."""
    if reached is None:
        return math.nan
    total = 0.0
    for path, time_s in zip((one, other), _in_order((reached.first_s, reached.second_s), reached), strict=True):
        trajectory = path.trajectory
        spread = float(np.linalg.eigvalsh(trajectory.at(trajectory.covariance, time_s))[-1])
        speed = max(0.1, float(trajectory.at(trajectory.speed, time_s)))
        total += (spread + (LENGTH_SIGMA_M / 2) ** 2) / speed**2
    return math.sqrt(total)


def _in_order(times: tuple[float, float], reached: Encroachment) -> tuple[float, float]:
    """The times of the two that were asked for, of those of the first and the second who got there."""
    return times[::-1] if reached.swapped else times


def _angle_of_ways(one: FootprintPath, other: FootprintPath, i: int, j: int) -> float:
    """Degrees between the ways of two, where the way of one is nearest to where the other one is."""
    here = int(np.linalg.norm(one.place - other.place[j], axis=1).argmin())
    there = int(np.linalg.norm(other.place - one.place[i], axis=1).argmin())
    return float(min(angle_deg(one.facing[here], other.facing[j]), angle_deg(one.facing[i], other.facing[there])))


def _surely(one: FootprintPath, other: FootprintPath, i: int, j: int, most_s: float) -> bool:
    """Whether one gets where the other was also if places are off by what they may be, and they are smaller by that."""
    shrunk = []
    for path, row in ((one, i), (other, j)):
        spread = path.trajectory.at(path.trajectory.covariance, float(path.times_s[row]))
        sides = path.facing[row], np.array([-path.facing[row, 1], path.facing[row, 0]])
        size = [
            max(0.1, extent - 2 * Z * math.sqrt(max(0.0, float(side @ spread @ side))))
            for extent, side in zip(path.size, sides, strict=True)
        ]
        shrunk.append(FootprintPath(replace(path.trajectory, length=size[0], width=size[1]), _STEP_S))
    return by_places(shrunk[0], shrunk[1], most_s + 1.0) is not None


def _row(path: FootprintPath, time_s: float) -> int:
    return int(np.abs(path.times_s - time_s).argmin())


def _behind(one: FootprintPath, other: FootprintPath, i: int, j: int) -> bool:
    """Whether `one` sees `other` ahead."""
    return bool((other.place[j] - one.place[i]) @ one.facing[i] > 0)


def _kind(angle: float) -> str:
    if angle < REAR_END_DEG:
        return "rear end"
    return "crossing" if angle > _CROSSING_DEG else "lane change"
