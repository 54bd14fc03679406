"""Read trajectories in pixels from the numbered boxes of `skope eval predict`, for counts without a calibrated
camera."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from skope.camera.motion.view_registration import KnownView, is_inside, read_views, transformed, view_numbers
from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE, START_TIME_KEY, VISIBILITY_KEY
from skope.errors import UserError
from skope.metrics.read_inputs import read_all_results
from skope.schema import CATEGORY_NAMES, VEHICLE_CATEGORY, AnnotationFile
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import UNKNOWN_CLASS
from skope.tracking.duplicates import DUPLICATE_LIMITS, feet, inside_and_apart
from skope.tracking.track_flags import box_never_moved
from skope.tracks.track import Track
from skope.traffic.observation import Observation, checked_visibility, read_start_time
from skope.types import Array


@dataclass(frozen=True)
class ImageTrackLimits:
    """Limits of tracks in the image."""

    foot_sigma_share: float = 0.03
    """Standard deviation of the middle of the lower edge, as a share of the box's longer edge, at least a pixel."""
    fewest_boxes: int = 3
    """Minimum number of boxes of a counted track."""
    shortest_s: float = 0.4
    """Minimum duration of a counted track, seconds."""
    together_share: float = 0.5
    """Minimum share of the shorter of two tracks that lies in the longer one if both are one road user."""
    least_visible: float = 0.9
    """Minimum share of each gate that a view must show to count as observed."""
    gate_points: int = 200
    """Number of points on a gate that are projected."""
    moving_s: float = 1.0
    """Duration of a change of view if its end is not known, seconds."""
    drift_sizes: float = 0.3
    """Largest change of the distance between the feet of two boxes of one road user, in sizes of the larger one."""


IMAGE_TRACKS: Final = ImageTrackLimits()

MotRow = tuple[float, float, float, float, float]
"""Time in seconds, column and row of the middle of a box's lower edge, and the box's width and height, pixels."""


def read_image_trajectories(folder: Path, gates: Sequence[Gate] = ()) -> tuple[list[Track], Observation, list[str]]:
    """Read the numbered boxes of a video as tracks in its first view.

    Positions are columns and negative rows, so that left and right of a line are as on the screen. If the camera was
    moved, positions are transformed to the first view if the transformation is known. Otherwise their frames, and
    those during the movement, are not observed.

    Args:
        folder: Output folder of `skope eval predict`.
        gates: The gates with `pixels` in the first view. A view that does not show all of them is not observed.

    Returns:
        The tracks, the times that were observed, and a sentence for each time that the camera was moved.

    Raises:
        UserError: A file is missing or invalid, the images have no times, or the detections have no numbers.
    """
    file = coco.read(folder / FRAMES_FILE)
    views, notes = _followed_views(file, gates)
    timed = {image.id: image.time_s for image in file.images if image.time_s is not None}
    shown = dict(zip(timed, view_numbers(views, list(timed.values())).tolist(), strict=True))
    observed = {number for number, view in enumerate(views) if view.from_first is not None}
    rows: dict[tuple[int, int], list[tuple[int, MotRow]]] = defaultdict(list)
    results = read_all_results(folder / PREDICTIONS_FILE, file)
    for result in results:
        view = shown.get(result.image_id)
        if result.track_id is not None and view is not None and view in observed:
            x, y, width, height = map(float, result.bbox)
            row = (timed[result.image_id], x + width / 2, y + height, width, height)
            rows[result.category_id, result.track_id].append((view, row))
    if results and not rows:
        raise UserError(
            f"{folder / PREDICTIONS_FILE}: track_id: missing: what images show is not followed from one to another"
        )
    tracks = [(category_id, _in_first_view(track_rows, views)) for (category_id, _), track_rows in rows.items()]
    made = [_trajectory(k, *track) for k, track in enumerate(_without_doubles(tracks), start=1)]
    source = str(file.info.get("source", file.name))
    observation = Observation(
        times_s=np.array(sorted(time_s for number, time_s in timed.items() if shown[number] in observed)),
        source=source,
        camera_moved_s=np.array(sorted(time_s for number, time_s in timed.items() if shown[number] not in observed)),
        visibility_samples=checked_visibility(
            file.info.get(VISIBILITY_KEY, []), f"{folder / FRAMES_FILE}: info.{VISIBILITY_KEY}"
        ),
        start_time=read_start_time(file.info[START_TIME_KEY], f"{folder / FRAMES_FILE}: info.{START_TIME_KEY}")
        if START_TIME_KEY in file.info
        else None,
    )
    return [track for track in made if track.confirmed], observation, notes


def _followed_views(file: AnnotationFile, gates: Sequence[Gate]) -> tuple[list[KnownView], list[str]]:
    """Return the views, without the homography of those that do not show all gates, and one sentence per later view."""
    views, notes = read_views(file.name, file.info), list[str]()
    size = (file.images[0].width, file.images[0].height) if file.images else (1, 1)
    for k, view in enumerate(views[1:], start=1):
        why, start_s = "it is not surely known where the gates lie in its view", view.begin_s + IMAGE_TRACKS.moving_s
        if view.from_first is not None:
            shares = {gate.name: _visible_share(np.array(gate.pixels), view.from_first.matrix, size) for gate in gates}
            hidden = [name for name, share in shares.items() if share < IMAGE_TRACKS.least_visible]
            if not hidden:
                notes.append(
                    f"the camera was moved at {view.begin_s:.1f} s: from {view.settled_s:.1f} s on, gates are counted "
                    f"where its view shows them ({view.from_first.corner_error_px:.1f} px)"
                )
                continue
            why = f"its view does not show all of gate {hidden[0]!r} ({shares[hidden[0]]:.0%})"
            start_s = view.settled_s
            views[k] = replace(view, from_first=None)
        notes.append(
            f"the camera was moved at {view.begin_s:.1f} s: {why}, and nothing is counted in it. Draw the gates in "
            f"the new view in a second site file, and count it apart: `skope eval predict VIDEO --start "
            f"{start_s:.1f} --out second`, then `skope eval traffic second --site second.toml`"
        )
    return views, notes


def _visible_share(line: Array, matrix: Array, size: tuple[int, int]) -> float:
    """Return the share of a line (2, 2) in the first view's image that a second view shows; 1 if outside the first."""
    along = np.linspace(line[0], line[1], IMAGE_TRACKS.gate_points)
    along = along[is_inside(along, size)]
    return float(is_inside(transformed(matrix, along), size).mean()) if len(along) else 1.0


def _in_first_view(rows: list[tuple[int, MotRow]], views: Sequence[KnownView]) -> Array:
    """Return (M, 5) time, column and negative row of the foot, and width and height of the box, in the first view.

    Each input row comes with the number of its view.
    """
    numbers, values = np.array([number for number, _ in rows]), np.array([row for _, row in rows])
    for number in np.unique(numbers):
        homography = views[number].from_first
        if number and homography is not None:
            in_view, back = numbers == number, np.linalg.inv(homography.matrix)
            feet = values[in_view, 1:3]
            first_feet = transformed(back, feet)
            across, down = (transformed(back, feet + step) - first_feet for step in np.eye(2))
            growth = np.sqrt(np.abs(across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]))
            values[in_view] = np.column_stack([values[in_view, 0], first_feet, values[in_view, 3:] * growth[:, None]])
    values[:, 2] *= -1
    return np.array(sorted(values.tolist()))


def _without_doubles(tracks: list[tuple[int, Array]]) -> list[tuple[int, Array]]:
    """Return tracks, as category and rows (M, 5), without those that follow the road user of a longer track.

    Detectors often find a vehicle twice, for example as its front and as a whole.
    """
    kept: list[tuple[int, Array]] = []
    for category_id, rows in sorted(tracks, key=lambda track: -len(track[1])):
        if not any(_is_double(rows, longer) for _, longer in kept):
            kept.append((category_id, rows))
    return sorted(kept, key=lambda track: float(track[1][0, 0]))


def _is_double(rows: Array, longer: Array) -> bool:
    _, common, longer_common = np.intersect1d(rows[:, 0], longer[:, 0], return_indices=True)
    if len(common) < max(1.0, IMAGE_TRACKS.together_share * len(rows)):
        return False
    first, second = _boxes(rows[common]), _boxes(longer[longer_common])
    inside, apart = inside_and_apart(first, second)
    # Two boxes of one vehicle keep their relative position. A car whose box lies in that of a lorry moves along it.
    offset = (feet(first) - feet(second)) / np.maximum(first[:, 2:], second[:, 2:])
    drift = np.ptp(np.percentile(offset, (10, 90), axis=0), axis=0).max()
    return bool(
        np.median(inside) >= DUPLICATE_LIMITS.inside_share
        and np.median(apart) <= DUPLICATE_LIMITS.foot_sizes
        and drift <= IMAGE_TRACKS.drift_sizes
    )


def _boxes(rows: Array) -> Array:
    """Return (M, 4) x, y, width, height of rows (M, 5)."""
    _, middle, below, width, height = rows.T
    return np.stack([middle - width / 2, -below - height, width, height], axis=1)


def _trajectory(number: int, category_id: int, rows: Array) -> Track:
    """Return a track of rows (M, 5): seconds, position, width and height of the box."""
    times, position = rows[:, 0], rows[:, 1:3]
    velocity = np.gradient(position, times, axis=0) if len(times) > 1 else np.zeros_like(position)
    sigma = np.maximum(1.0, IMAGE_TRACKS.foot_sigma_share * rows[:, 3:].max(axis=1))
    category = CATEGORY_NAMES[category_id - 1]
    return Track(
        number=number,
        category=category,
        class_name=UNKNOWN_CLASS if category == VEHICLE_CATEGORY else category,
        class_confidence=0.0 if category == VEHICLE_CATEGORY else 1.0,
        times_s=times,
        position=np.column_stack([position, np.zeros(len(times))]),
        velocity=velocity,
        heading=np.full(len(times), np.nan),
        covariance=sigma[:, None, None] ** 2 * np.eye(2),
        speed_sigma=np.full(len(times), np.nan),
        located=np.ones(len(times), dtype=bool),
        boxes=_boxes(rows),
        confirmed=len(times) >= IMAGE_TRACKS.fewest_boxes and bool(times[-1] - times[0] >= IMAGE_TRACKS.shortest_s),
        flags=("never_moved",) if box_never_moved(_boxes(rows), times) else (),
    )
