"""Compute post-encroachment times (time between two road users in the same place), by two definitions.

SSAM (FHWA, Surrogate Safety Assessment Model): time from when the first vehicle was at a place until the second
vehicle's box touches the first one's box at that place; the minimum over all places.

Allen, Shin and Cooper (1978): time from when the first vehicle leaves the area that both cover until the second vehicle
enters it; 0 if both are in it at the same time.
"""

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from skope.traffic.footprints import FootprintPath, overlap
from skope.types import Array


@dataclass(frozen=True)
class EncroachmentSearch:
    """Resolution of the search for post-encroachment times."""

    fine_steps: int = 10
    """Number of times between two positions that are examined."""
    around_s: float = 10.0
    """Time before and after the conflict in which areas are compared, seconds."""
    batch_steps: int = 10
    """Number of time steps that are examined together."""
    coarse_step: int = 5
    """Step of the first pass, which finds whether paths come near each other."""


ENCROACHMENT_SEARCH: Final = EncroachmentSearch()


@dataclass(frozen=True, kw_only=True)
class Encroachment:
    """Event in which a road user reaches a place that an earlier road user has left."""

    seconds: float
    """Post-encroachment time, seconds."""
    first_s: float
    """Time at which the first road user was at the place, seconds of the footage."""
    second_s: float
    """Time at which the second road user reaches the place, seconds of the footage."""
    swapped: bool
    """Whether the second argument of the search was first at the place."""


def near(first: FootprintPath, second: FootprintPath, most_s: float) -> bool:
    """Return whether two paths are close enough for the footprints to touch within `most_s` of each other.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        most_s: Longest time between the two, seconds.
    """
    rows, columns = (
        slice(None, None, ENCROACHMENT_SEARCH.coarse_step),
        slice(None, None, ENCROACHMENT_SEARCH.coarse_step),
    )
    away = np.linalg.norm(first.position[rows, None] - second.position[None, columns], axis=-1)
    late = np.abs(first.times_s[rows, None] - second.times_s[None, columns])
    step_s = float(first.times_s[1] - first.times_s[0]) * ENCROACHMENT_SEARCH.coarse_step
    reach = first.radius + second.radius + step_s * (float(first.speed.max()) + float(second.speed.max()))
    return bool(((away < reach) & (late <= most_s + step_s)).any())


def by_places(first: FootprintPath, second: FootprintPath, most_s: float) -> Encroachment | None:
    """Find the encroachment by SSAM's definition.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        most_s: Longest time between the two, seconds.

    Returns:
        The encroachment with the shorter time of the two orders; None if there is none within `most_s`.
    """
    found = [
        made
        for earlier, later, swapped in ((first, second, False), (second, first, True))
        if (made := _after(earlier, later, most_s, swapped)) is not None
    ]
    return min(found, key=lambda made: made.seconds, default=None)


def _after(first: FootprintPath, second: FootprintPath, most_s: float, swapped: bool) -> Encroachment | None:
    step_s = float(first.times_s[1] - first.times_s[0])
    reach = first.radius + second.radius
    shift = int(first.ticks[0] - second.ticks[0])
    delays = round(most_s / step_s) + 1
    # later[i, d] is the place of `second` d steps after row i of `first` (a view, not a copy), or NaN.
    before, after = max(0, -shift), max(0, len(first.ticks) + delays - 1 + shift - len(second.ticks))
    place = second.position @ [1, 1j]
    later = sliding_window_view(np.pad(place, (before, after), constant_values=np.nan)[max(0, shift) :], delays)
    here = (first.position @ [1, 1j])[:, None]
    # Examine the delays in batches, shortest first: one batch is usually enough, or the two are never near each other.
    for begin in range(0, delays, ENCROACHMENT_SEARCH.batch_steps):
        batch = later[: len(here), begin : begin + ENCROACHMENT_SEARCH.batch_steps]
        i, late = np.nonzero(np.abs(batch - here) < reach)
        j = i + shift + begin + late
        meets = np.flatnonzero(overlap(first.footprints[i], second.footprints[j])) if len(i) else i
        if len(meets):
            k = meets[(j[meets] - i[meets]).argmin()]
            return _finer(first, second, first.times_s[i[k]], second.times_s[j[k]], step_s, swapped)
    return None


def _finer(
    first: FootprintPath, second: FootprintPath, first_s: float, second_s: float, step_s: float, swapped: bool
) -> Encroachment:
    """Return the shortest encroachment at finer times around those at which the footprints overlap."""
    shifts = (
        np.arange(-ENCROACHMENT_SEARCH.fine_steps, ENCROACHMENT_SEARCH.fine_steps + 1)
        * step_s
        / ENCROACHMENT_SEARCH.fine_steps
    )
    first_times = np.clip(first_s + shifts, *first.times_s[[0, -1]])
    second_times = np.clip(second_s + shifts, *second.times_s[[0, -1]])
    meets = overlap(first.at(first_times)[:, None], second.at(second_times)[None])
    late = second_times[None] - first_times[:, None]
    late = np.where(meets & (late >= 0), late, np.inf)
    i, j = np.unravel_index(int(late.argmin()), late.shape)
    return Encroachment(
        seconds=float(late[i, j]), first_s=float(first_times[i]), second_s=float(second_times[j]), swapped=swapped
    )


def by_area(first: FootprintPath, second: FootprintPath, about_s: float) -> Encroachment | None:
    """Find the post-encroachment time by the definition of Allen, Shin and Cooper: the area that both road users cover.

    Args:
        first: Path of the first road user.
        second: Path of the second road user.
        about_s: Middle of the period in which areas are compared, seconds of the footage.

    Returns:
        The encroachment; None if there is no common area.
    """
    from shapely import polygons, unary_union

    shown = [_during(path, about_s) for path in (first, second)]
    if not all(len(rows) for rows in shown):
        return None
    shapes = [polygons(path.footprints[rows].corners) for path, rows in zip((first, second), shown, strict=True)]
    area = unary_union(shapes[0]).intersection(unary_union(shapes[1]))
    if area.area <= 0:
        return None
    stays = [
        _stay(path, rows, footprints, area)
        for path, rows, footprints in zip((first, second), shown, shapes, strict=True)
    ]
    swapped = stays[1][0] < stays[0][0]
    earlier, later = stays[::-1] if swapped else stays
    return Encroachment(seconds=max(0.0, later[0] - earlier[1]), first_s=earlier[1], second_s=later[0], swapped=swapped)


def _during(path: FootprintPath, about_s: float) -> Array:
    return np.flatnonzero(np.abs(path.times_s - about_s) <= ENCROACHMENT_SEARCH.around_s)  # type: ignore[return-value]


def _stay(path: FootprintPath, rows: Array, shapes: Any, area: Any) -> tuple[float, float]:
    """Return the times at which the footprint enters and leaves the area, seconds."""
    from shapely import intersects, polygons

    def within(time_s: float) -> bool:
        return bool(intersects(polygons(path.at(np.array([time_s])).corners)[0], area))

    inside = np.flatnonzero(intersects(shapes, area))
    times = path.times_s[rows]
    first, last = int(inside[0]), int(inside[-1])
    enter = _border(within, times[first - 1], times[first]) if first else float(times[0])
    leave = _border(within, times[last + 1], times[last]) if last + 1 < len(times) else float(times[-1])
    return enter, leave


def _border(within: Any, outside_s: float, inside_s: float) -> float:
    """Return the time at which an area is entered or left, between a time outside and a time inside."""
    for _ in range(6):
        middle = (outside_s + inside_s) / 2
        outside_s, inside_s = (outside_s, middle) if within(middle) else (middle, inside_s)
    return float(inside_s)
