"""Find the visits of road users to zones."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skope.site.gates_zones_lanes import Zone
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.gates import leaving_distance
from skope.traffic.line_crossings import line_crossings
from skope.types import Array


@dataclass(frozen=True, kw_only=True, eq=False)
class ZoneVisit:
    """Visit of a road user to a zone, by the centre of its body."""

    trajectory: Track
    zone: str
    enter_s: float
    """Time of entry, seconds; NaN if the track begins inside."""
    leave_s: float
    """Time of exit, seconds; NaN if the track ends inside."""
    seen_s: tuple[float, float]
    """First and last time at which the road user is seen inside, seconds."""
    sigmas_s: tuple[float, float]
    """Standard deviations of `enter_s` and `leave_s`, seconds; NaN for a time that is NaN."""

    @property
    def dwell_s(self) -> float:
        """Time from entry to exit, seconds; NaN if entry or exit was not seen."""
        return self.leave_s - self.enter_s

    @property
    def dwell_sigma_s(self) -> float:
        """Standard deviation of the dwell time, seconds; NaN if there is no dwell time."""
        return math.hypot(*self.sigmas_s)


def inside_polygon(polygon: Array, places: Array) -> NDArray[np.bool_]:
    """Return (M,) whether positions (M, 2) are inside a polygon (N, 2).

    The number of sides that a ray to the right meets is odd for positions inside. Sides are half-open: a position on
    the common side of two polygons is inside exactly one of them.
    """
    a, b = polygon, np.roll(polygon, -1, axis=0)
    x, y = places[:, :1], places[:, 1:]
    spans = (a[:, 1] <= y) != (b[:, 1] <= y)
    rise = np.where(b[:, 1] == a[:, 1], 1.0, b[:, 1] - a[:, 1])
    met = a[:, 0] + (y - a[:, 1]) / rise * (b[:, 0] - a[:, 0]) > x
    return np.asarray((spans & met).sum(axis=1) % 2 == 1)


def depth_in_polygon(polygon: Array, places: Array) -> Array:
    """Return (M,) distances of positions (M, 2) from the border of a polygon (N, 2), negative outside, metres."""
    a, step = polygon, np.roll(polygon, -1, axis=0) - polygon
    away = places[:, None] - a
    length = np.maximum((step**2).sum(axis=1), 1e-12)
    share = np.clip((away * step).sum(axis=2) / length, 0, 1)
    nearest = np.linalg.norm(away - share[..., None] * step, axis=2).min(axis=1)
    return np.asarray(np.where(inside_polygon(polygon, places), nearest, -nearest))


def visits(trajectories: Sequence[Track], zones: Sequence[Zone], settings: TrafficSettings) -> list[ZoneVisit]:
    """Return all visits to all zones, in order of the time at which they are first seen.

    Args:
        trajectories: All tracks. Only confirmed tracks of counted classes make visits.
        zones: The zones.
        settings: The classes, and the hysteresis at the border.
    """
    found = [
        visit
        for trajectory in trajectories
        if trajectory.confirmed and trajectory.class_name in settings.classes
        for zone in zones
        for visit in _visits_of_track(trajectory, zone, settings)
    ]
    return sorted(found, key=lambda visit: (visit.seen_s[0], visit.trajectory.number, visit.zone))


def _visits_of_track(trajectory: Track, zone: Zone, settings: TrafficSettings) -> list[ZoneVisit]:
    signed = depth_in_polygon(np.array(zone.polygon), trajectory.xy)
    times = trajectory.times_s
    if (signed < 0).all():
        return []
    leave = leaving_distance(trajectory, settings.least_travel_m)
    changes = line_crossings(signed, times, hysteresis=settings.hysteresis_m, leave=leave, places=trajectory.xy)
    first = float(times[0]), float(times[-1])
    begins_inside = (
        changes[0].from_side > 0 if changes else bool(signed[0] >= 0 and signed.max() >= settings.hysteresis_m)
    )
    enters = [math.nan] if begins_inside else []
    enters += [change.time_s for change in changes if change.from_side < 0]
    leaves = [change.time_s for change in changes if change.from_side > 0]
    leaves += [math.nan] * (len(enters) - len(leaves))
    out = []
    for enter_s, leave_s in zip(enters, leaves, strict=True):
        seen = (first[0] if math.isnan(enter_s) else enter_s, first[1] if math.isnan(leave_s) else leave_s)
        out.append(
            ZoneVisit(
                trajectory=trajectory,
                zone=zone.name,
                enter_s=enter_s,
                leave_s=leave_s,
                seen_s=seen,
                sigmas_s=(_sigma_s(trajectory, enter_s), _sigma_s(trajectory, leave_s)),
            )
        )
    return out


def _sigma_s(trajectory: Track, time_s: float) -> float:
    """Return the standard deviation of a time of entry or exit, seconds; NaN if the time is NaN."""
    if math.isnan(time_s):
        return math.nan
    return trajectory.sigma_at(time_s) / max(float(trajectory.at(trajectory.speed, time_s)), 0.05)
