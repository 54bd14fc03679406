"""Flag doubtful tracks, and split tracks with motion that is impossible for one vehicle."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.tracking.tracks import is_confirmed
from skope.tracks.track import Track
from skope.types import Array

TRACK_FLAGS: Final = ("two_poses", "never_moved", "impossible_motion", "against_traffic", "implausible_speed")
"""Reasons to distrust a track, in the order of the files:

- `two_poses`: no more than two poses show the vehicle.
- `never_moved`: it may be a parked car, or an object that is taken for a road user.
- `impossible_motion`: part of a track with an acceleration that no vehicle can reach: two vehicles in one track.
- `against_traffic`: all others at its positions drive in the opposite direction.
- `implausible_speed`: the vehicles around it are much faster or slower.
"""


@dataclass(frozen=True)
class FlagLimits:
    """Limits at which a track is flagged."""

    few_poses: int = 2
    """Maximum number of poses of a track with the flag `two_poses`."""
    standing_m: float = 1.5
    """A track that stays within this distance of its median position in 95% of its frames never moved, metres."""
    standing_sizes: float = 0.25
    """The same for boxes in the image, in square roots of the box's area. In footage of two junctions the 20
    standing vehicles stayed within 0.16, and all pedestrians moved by more than 0.5."""
    standing_growth: float = 1.3
    """Ratio of the 95th to the 5th percentile of a box's size above which it moved towards or away from the camera."""
    standing_s: float = 5.0
    """Minimum duration of a track that never moved, seconds."""
    end_rows: int = 3
    """Number of rows at the start and end of a track; their medians show whether it arrived or left."""
    acceleration_mps2: float = 9.0
    """Acceleration, along or across, that no vehicle reaches, m/s^2."""
    acceleration_s: float = 0.5
    """Minimum duration of such accelerations, seconds."""
    direction_mps: float = 3.0
    """Minimum speed at which a direction of travel is used, m/s."""
    same_path_m: float = 1.5
    """Vehicles that pass within this distance of each other use the same path, metres. Also the grid's cell size."""
    fewest_vehicles: int = 5
    """Minimum number of vehicles in the opposite direction, and of vehicles in a flow."""
    opposite_rad: float = math.radians(150)
    """Minimum angle between opposite directions, radians."""
    first_neighbours: int = 128
    """Number of vehicles on the same path that are examined first."""
    flow_s: float = 60.0
    """Maximum time between a track and the tracks of the flow around it at a spot, seconds."""
    flow_tracks: int = 10
    """Maximum number of tracks in that flow: those nearest in time, so that a queue is compared with itself."""
    flow_rows: int = 64
    """Maximum number of rows of a cell, nearest in time before and after, in which these tracks are searched for."""
    flow_spots: int = 16
    """Maximum number of spots of a track at which its speed is compared."""
    flow_angle_rad: float = math.radians(45)
    """Maximum difference of direction from tracks in the same flow, radians. Not applied to tracks slower than
    `direction_mps`."""
    flow_factor: float = 1.8
    """A speed is implausible if it differs from the median of the flow by this factor or more."""
    flow_sigmas: float = 3.0
    """Number of standard deviations, of the flow and of the track's speed, by which the speed must also differ."""
    mad_sigma: float = 1.4826
    """Standard deviation of a normal distribution in units of its median absolute deviation."""


FLAG_LIMITS: Final = FlagLimits()


def flagged(tracks: Sequence[Track]) -> list[Track]:
    """Return the tracks with their `TRACK_FLAGS`, numbered from 1 by their first frames.

    Tracks are split where they accelerate, brake or turn harder than tyres allow.
    """
    parts = [part for track in tracks for part in _cut(track)]
    parts.sort(key=lambda track: int(track.frames[0]))
    parts = [replace(part, number=number) for number, part in enumerate(parts, start=1)]
    against = _against_traffic(parts)
    never_moved = {track.number for track in parts if _never_moved(track)}
    implausible = _implausible_speeds([track for track in parts if track.number not in never_moved])
    out = []
    for track in parts:
        holds = {
            "two_poses": int(track.located.sum()) <= FLAG_LIMITS.few_poses,
            "never_moved": track.number in never_moved,
            "impossible_motion": "impossible_motion" in track.flags,
            "against_traffic": track.number in against,
            "implausible_speed": track.number in implausible,
        }
        out.append(replace(track, flags=tuple(name for name in TRACK_FLAGS if holds[name])))
    return out


def _cut(track: Track) -> list[Track]:
    """Return the parts of a track before and after impossible motion; the whole track if no part is long enough."""
    hard = _impossible(track)
    if not hard.any():
        return [track]
    suspect = replace(track, flags=("impossible_motion",))
    possible = [suspect.during(run) for run in _runs(hard) if not hard[run[0]]]
    return [part for part in possible if is_confirmed(part.times_s[part.located])] or [suspect]


def _runs(holds: NDArray[np.bool_]) -> list[NDArray[np.intp]]:
    """Return the indices into (M,) truth values, split where the values change."""
    return np.split(np.arange(len(holds)), np.flatnonzero(np.diff(holds)) + 1)


def _never_moved(track: Track) -> bool:
    return _stays(track.xy, track.times_s, FLAG_LIMITS.standing_m)


def box_never_moved(boxes: Array, times_s: Array) -> bool:
    """Return whether boxes in the image belong to an object that never moved, of any category.

    A road user that waits has moved if its track shows it arriving or leaving.

    Args:
        boxes: (M, 4) x, y, width and height of one track, pixels.
        times_s: (M,) times, seconds, rising.

    Returns:
        True if the boxes stay in one place with one size for at least 5 s; False if there are no boxes.
    """
    if not len(boxes):
        return False
    sizes = np.sqrt(boxes[:, 2] * boxes[:, 3])
    small, large = np.percentile(sizes, [5, 95])
    middles = boxes[:, :2] + boxes[:, 2:] / 2
    return bool(large <= FLAG_LIMITS.standing_growth * small) and _stays(
        middles, times_s, FLAG_LIMITS.standing_sizes * float(np.median(sizes))
    )


def _stays(places: Array, times_s: Array, reach: float) -> bool:
    """Return whether positions (M, 2) stay within `reach` of their median, also at the start and at the end."""
    middle = np.median(places, axis=0)
    farthest = np.percentile(np.linalg.norm(places - middle, axis=1), 95)
    ends = [np.median(rows, axis=0) for rows in (places[: FLAG_LIMITS.end_rows], places[-FLAG_LIMITS.end_rows :])]
    came_or_left = max(float(np.linalg.norm(end - middle)) for end in ends) > reach
    return bool(times_s[-1] - times_s[0] >= FLAG_LIMITS.standing_s and farthest < reach and not came_or_left)


def _impossible(track: Track) -> NDArray[np.bool_]:
    """Return (M,) whether the vehicle accelerates, brakes or turns for some time harder than tyres allow."""
    hard = np.asarray(np.linalg.norm(track.acceleration, axis=1) > FLAG_LIMITS.acceleration_mps2)
    steps = np.diff(track.times_s, prepend=track.times_s[0])
    for run in _runs(hard):
        if steps[run].sum() < FLAG_LIMITS.acceleration_s:
            hard[run] = False
    return hard


def _against_traffic(tracks: Sequence[Track]) -> set[int]:
    """Return the numbers of tracks that meet only vehicles in the opposite direction on most of their path."""
    moving = [(track, np.flatnonzero(track.speed > FLAG_LIMITS.direction_mps)) for track in tracks]
    moving = [(track, rows) for track, rows in moving if rows.size]
    if len(moving) <= FLAG_LIMITS.fewest_vehicles:
        return set()
    places = np.concatenate([track.xy[rows] for track, rows in moving])
    ahead = np.concatenate([_directions(track, rows) for track, rows in moving])
    owner = np.concatenate([np.full(len(rows), k) for k, (_, rows) in enumerate(moving)])
    alone = np.zeros(len(places), dtype=bool)
    for here, near in _by_cell(places):
        # Most rows have company among a few neighbours; an hour of footage has thousands per cell.
        few = near[:: math.ceil(len(near) / FLAG_LIMITS.first_neighbours)]
        along = (ahead[here] @ ahead[few].T > 0) & (owner[here, None] != owner[few])
        for i in here[~along.any(axis=1)]:
            other_rows = near[owner[near] != owner[i]]
            cosine = ahead[other_rows] @ ahead[i]
            opposite = np.unique(owner[other_rows[cosine < math.cos(FLAG_LIMITS.opposite_rad)]])
            alone[i] = len(opposite) >= FLAG_LIMITS.fewest_vehicles and not (cosine > 0).any()
    return {track.number for k, (track, _) in enumerate(moving) if alone[owner == k].mean() > 0.5}


def _implausible_speeds(tracks: Sequence[Track]) -> set[int]:
    """Return the numbers of tracks with a speed that contradicts the flow at most of the spots that they pass.

    Spots are counted, not moments: a vehicle that waits at a traffic light has the speed of the flow on most of its
    path.
    """
    if len(tracks) <= FLAG_LIMITS.fewest_vehicles:
        return set()
    rows = [_spots(track) for track in tracks]
    places = np.concatenate([track.xy[spots] for track, spots in zip(tracks, rows, strict=True)])
    times = np.concatenate([track.times_s[spots] for track, spots in zip(tracks, rows, strict=True)])
    speeds = np.concatenate([track.speed[spots] for track, spots in zip(tracks, rows, strict=True)])
    sigmas = np.concatenate([track.speed_sigma[spots] for track, spots in zip(tracks, rows, strict=True)])
    velocities = np.concatenate([track.velocity[spots] for track, spots in zip(tracks, rows, strict=True)])
    slow = speeds < FLAG_LIMITS.direction_mps  # headings of these tracks are often wrong, even by 180 degrees
    ahead = velocities / np.maximum(speeds, FLAG_LIMITS.direction_mps)[:, None]
    owner = np.repeat(np.arange(len(tracks)), [len(spots) for spots in rows])
    compared = np.concatenate([_spread_evenly(len(spots), FLAG_LIMITS.flow_spots) for spots in rows])
    contradicted = np.zeros(len(places), dtype=bool)
    for here, near in _by_cell(places):
        near = near[np.argsort(times[near], kind="stable")]
        at = np.searchsorted(times[near], times[here])
        for i, middle in zip(here[compared[here]].tolist(), at[compared[here]].tolist(), strict=True):
            window = near[max(0, middle - FLAG_LIMITS.flow_rows) : middle + FLAG_LIMITS.flow_rows]
            apart_s = np.abs(times[window] - times[i])
            flow = (owner[window] != owner[i]) & (apart_s <= FLAG_LIMITS.flow_s)
            flow &= slow[i] | slow[window] | (ahead[window] @ ahead[i] > math.cos(FLAG_LIMITS.flow_angle_rad))
            nearest = window[flow][np.argsort(apart_s[flow], kind="stable")]
            _, first = np.unique(owner[nearest], return_index=True)
            flow_speeds = speeds[nearest[np.sort(first)[: FLAG_LIMITS.flow_tracks]]]
            contradicted[i] = len(flow_speeds) >= FLAG_LIMITS.fewest_vehicles and _contradicts(
                flow_speeds, float(speeds[i]), float(sigmas[i])
            )
    return {track.number for k, track in enumerate(tracks) if contradicted[compared & (owner == k)].mean() > 0.5}


def _contradicts(flow_speeds: Array, speed: float, sigma: float) -> bool:
    """Return whether the speeds of a flow (N,) contradict a speed with standard deviation `sigma`, m/s."""
    median = float(np.median(flow_speeds))
    spread = FLAG_LIMITS.mad_sigma * float(np.median(np.abs(flow_speeds - median)))
    slower, faster = sorted((speed, median))
    return faster > FLAG_LIMITS.flow_factor * slower and faster - slower > FLAG_LIMITS.flow_sigmas * math.hypot(
        spread, sigma
    )


def _spots(track: Track) -> NDArray[np.intp]:
    """Return the middle row of each stay of a track in a square of `FLAG_LIMITS.same_path_m`."""
    cells = np.floor(track.xy / FLAG_LIMITS.same_path_m)
    change = np.flatnonzero((np.diff(cells, axis=0) != 0).any(axis=1)) + 1
    return np.array([run[len(run) // 2] for run in np.split(np.arange(len(cells)), change)])


def _spread_evenly(count: int, most: int) -> NDArray[np.bool_]:
    """Return (count,) truth values with up to `most` evenly spaced true ones."""
    chosen = np.zeros(count, dtype=bool)
    chosen[np.linspace(0, count - 1, min(count, most)).astype(int)] = True
    return chosen


def _by_cell(places: Array) -> Iterator[tuple[NDArray[np.intp], NDArray[np.intp]]]:
    """Yield for each square of `FLAG_LIMITS.same_path_m` the indices into places (P, 2) inside it, and the indices
    inside it or the eight squares around it."""
    cells = np.floor(places / FLAG_LIMITS.same_path_m).astype(np.int64)
    found, number = np.unique(cells, axis=0, return_inverse=True)
    order = np.argsort(number.ravel(), kind="stable")
    members = np.split(order, np.cumsum(np.bincount(number.ravel()))[:-1])
    at = dict(zip(map(tuple, found.tolist()), members, strict=True))
    for (x, y), here in at.items():
        around = [at.get((x + dx, y + dy)) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
        yield here, np.concatenate([indices for indices in around if indices is not None])


def _directions(track: Track, rows: NDArray[np.intp]) -> Array:
    """Return (R, 2) unit vectors of a vehicle's direction of travel in `rows`."""
    velocity = track.velocity[rows, :2]
    return np.asarray(velocity / np.linalg.norm(velocity, axis=1, keepdims=True))
