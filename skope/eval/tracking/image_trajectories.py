"""Trajectories in pixels of what `skope eval predict` has followed through a video: for counts where no camera gives
metres."""

from collections import defaultdict
from pathlib import Path
from typing import Final

import numpy as np

from skope.dataset import coco
from skope.dataset.folder import BEGINS, CHANGES, FRAMES, PREDICTIONS, SIGHT_FIELD
from skope.errors import UserError
from skope.eval.tracking.duplicate_boxes import FOOT, INSIDE, inside_and_apart
from skope.eval.tracking.track_flags import box_never_moved
from skope.metrics.read_inputs import read_all_results
from skope.schema import CATEGORIES, VEHICLE
from skope.site.traffic_settings import UNKNOWN
from skope.tracks.track import Track
from skope.traffic.observation import Observation, checked_sight, read_begins
from skope.types import Array

_FOOT_SIGMA_SHARE: Final = 0.03
"""Standard deviation of the lower edge's middle, as a share of a box's longer edge, and a pixel at least."""
_FEWEST_BOXES: Final = 3
_SHORTEST_S: Final = 0.4
"""A road user that is seen in fewer boxes, or for less time (seconds), does not count."""
_TOGETHER_SHARE: Final = 0.5
"""Two tracks are one road user's where their boxes are in the median, over so much of the shorter track."""
MotRows = list[tuple[float, ...]]


def read_image_trajectories(folder: Path) -> tuple[list[Track], Observation]:
    """Read the ways of boxes through a video, by the numbers that they have, and when the view was the first one.

    Places are columns and negative rows, so that left and right of a line are what they are on the screen.

    Raises:
        UserError: A file is missing or wrong, the images have no times, or what was found has no numbers.
    """
    file = coco.read(folder / FRAMES)
    until_s = min((float(change["time_s"]) for change in file.info.get(CHANGES, ())), default=np.inf)
    times = {image.id: image.time_s for image in file.images}
    rows: dict[tuple[int, int], MotRows] = defaultdict(list)
    results = read_all_results(folder / PREDICTIONS, file)
    for result in results:
        time_s = times[result.image_id]
        if result.track_id is not None and time_s is not None and time_s < until_s:
            x, y, width, height = map(float, result.bbox)
            rows[result.category_id, result.track_id].append((time_s, x + width / 2, -y - height, width, height))
    seen = [time_s for time_s in times.values() if time_s is not None and time_s < until_s]
    if results and not rows:
        raise UserError(
            f"{folder / PREDICTIONS}: track_id: missing: what images show is not followed from one to another"
        )
    tracks = [(category_id, np.array(sorted(own))) for (category_id, _), own in rows.items()]
    made = [_trajectory(k, *track) for k, track in enumerate(_without_doubles(tracks), start=1)]
    times_s = np.array(sorted(seen))
    source = str(file.info.get("source", file.name))
    later = [time_s for time_s in times.values() if time_s is not None and time_s >= until_s]
    observation = Observation(
        times_s=times_s,
        source=source,
        moved_s=np.array(sorted(later)),
        sight=checked_sight(file.info.get(SIGHT_FIELD), f"{folder / FRAMES}: info.{SIGHT_FIELD}"),
        begins=read_begins(file.info[BEGINS], f"{folder / FRAMES}: info.{BEGINS}") if BEGINS in file.info else None,
    )
    return [one for one in made if one.confirmed], observation


def _without_doubles(tracks: list[tuple[int, Array]]) -> list[tuple[int, Array]]:
    """Tracks of categories and rows (M, 5), those left out that follow somebody whom a longer one follows too.

    Detectors see many a vehicle twice, as its front and as its whole, say.
    """
    kept: list[tuple[int, Array]] = []
    for category_id, rows in sorted(tracks, key=lambda track: -len(track[1])):
        if not any(_is_double(rows, longer) for _, longer in kept):
            kept.append((category_id, rows))
    return sorted(kept, key=lambda track: float(track[1][0, 0]))


def _is_double(rows: Array, longer: Array) -> bool:
    _, own, other = np.intersect1d(rows[:, 0], longer[:, 0], return_indices=True)
    if len(own) < max(1.0, _TOGETHER_SHARE * len(rows)):
        return False
    inside, apart = inside_and_apart(_boxes(rows[own]), _boxes(longer[other]))
    return bool(np.median(inside) >= INSIDE and np.median(apart) <= FOOT)


def _boxes(rows: Array) -> Array:
    """(M, 4) x, y, width, height of rows (M, 5), which have the middle of the lower edge, upwards, and the sizes."""
    _, middle, below, width, height = rows.T
    return np.stack([middle - width / 2, -below - height, width, height], axis=1)


def _trajectory(number: int, category_id: int, rows: Array) -> Track:
    """Of rows (M, 5): seconds, place, width and height of the box."""
    times, place = rows[:, 0], rows[:, 1:3]
    velocity = np.gradient(place, times, axis=0) if len(times) > 1 else np.zeros_like(place)
    sigma = np.maximum(1.0, _FOOT_SIGMA_SHARE * rows[:, 3:].max(axis=1))
    category = CATEGORIES[category_id - 1]
    return Track(
        number=number,
        category=category,
        class_name=UNKNOWN if category == VEHICLE else category,
        class_confidence=0.0 if category == VEHICLE else 1.0,
        times_s=times,
        position=np.column_stack([place, np.zeros(len(times))]),
        velocity=velocity,
        heading=np.full(len(times), np.nan),
        covariance=sigma[:, None, None] ** 2 * np.eye(2),
        speed_sigma=np.full(len(times), np.nan),
        located=np.ones(len(times), dtype=bool),
        confirmed=len(times) >= _FEWEST_BOXES and bool(times[-1] - times[0] >= _SHORTEST_S),
        flags=("never_moved",) if box_never_moved(_boxes(rows), times) else (),
    )
