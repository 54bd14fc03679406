"""Select vehicles for fitting a camera or a road: enough keypoints, and views along their paths."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import boxes as box_math
from skope.camera.fit.bundle_adjustment import VehicleViews
from skope.errors import UserError
from skope.pose.keypoint_views import Scene, View
from skope.pose.observations import KEYPOINT_WEIGHTS
from skope.pose.shape_model import fleet_shapes
from skope.tracking.box_links import LINK_LIMITS, BoxLinks
from skope.types import Array, Mask


@dataclass(frozen=True)
class SampleLimits:
    """Limits for the views of vehicles that calibrate a camera."""

    fewest_vehicles: int = 5
    """Minimum number of vehicles for a camera."""
    fewest_keypoints: int = 8
    """Minimum number of visible keypoints of a view."""
    least_edge_px: float = 48.0
    """Minimum longer edge of a view's box, pixels."""
    hiding_iou: float = 0.1
    """Minimum overlap (IoU) of two boxes at which one vehicle may hide the other."""
    most_views: int = 6
    """Maximum number of views of a vehicle."""
    most_images: int = 500
    """Maximum number of images in which stationary vehicles are searched for."""
    view_distance: float = 0.3
    """Minimum distance between views of a vehicle, in lengths of the longer edge of its box."""


SAMPLE_LIMITS: Final = SampleLimits()


@dataclass(frozen=True, eq=False)
class Sample:
    """Selected views of vehicles for a calibration."""

    views: VehicleViews
    numbered: bool
    """Whether views in several images are known to show the same vehicle; else each view counts as a vehicle."""
    lower_edges: Array
    """(P, 2) pixels of the middles of the lower edges of boxes, of all vehicles in images spread over the scene."""


@dataclass(frozen=True, eq=False)
class _Candidate:
    """View that may be selected, with its position in the scene."""

    image: int
    row: int
    middle: Array
    """(2,) of its box, pixels."""
    edge: float
    """Longer edge of its box, pixels."""


def sample_vehicles(
    scene: Scene,
    count: int,
    *,
    score: float,
    noise: float,
    sigma_px: float | None,
    fewest: int = SAMPLE_LIMITS.fewest_vehicles,
) -> Sample:
    """Select vehicles with enough keypoints, moving ones first, and separate views of each.

    Args:
        scene: Images of one camera, and the keypoints in them.
        count: Maximum number of vehicles.
        score: Minimum score of detections.
        noise: Standard deviation of the noise that is added to labelled keypoints, pixels.
        sigma_px: Standard deviation of a keypoint, pixels; None as in `Scene.views`.
        fewest: Minimum number of vehicles.

    Raises:
        UserError: The images differ in size, or too few vehicles show enough keypoints.
    """
    if not scene.file.images:
        raise UserError(f"{scene.file.name}: no images")
    scene = scene.calibrated_part()
    size = (scene.file.images[0].width, scene.file.images[0].height)

    def numbered_views() -> Iterator[tuple[View, NDArray[np.int64]]]:
        return _numbered(map(scene.stilled, scene.views(score=score, noise=noise, sigma_px=sigma_px)))

    of_vehicle: dict[int, list[_Candidate]] = {}
    known, lower = True, list[Array]()
    every = 1 + len(scene.file.images) // SAMPLE_LIMITS.most_images
    for i, (view, numbers) in enumerate(numbered_views()):
        if (view.image.width, view.image.height) != size:
            raise UserError(f"{scene.file.name}: {view.image.file_name}: images of one camera have one size")
        known = known and not (numbers < 0).any()
        if i % every == 0:
            lower.append((view.boxes[:, :2] + view.boxes[:, 2:] * [0.5, 1.0])[~view.interpolated])
        for row in np.flatnonzero(_shows_enough(view)).tolist():
            x, y, w, h = view.boxes[row].tolist()
            # A detection without a number counts as a separate vehicle with a new number.
            number = int(numbers[row]) if numbers[row] >= 0 else -1 - len(of_vehicle)
            candidate = _Candidate(i, row, np.array([x + w / 2, y + h / 2]), max(w, h))
            of_vehicle.setdefault(number, []).append(candidate)
    if len(of_vehicle) < fewest:
        raise UserError(
            f"{scene.file.name}: {len(of_vehicle)} vehicles show {SAMPLE_LIMITS.fewest_keypoints} keypoints on "
            f"{SAMPLE_LIMITS.least_edge_px:g} px or more, clear of others and of the image's edge; {fewest} are needed"
        )
    spread = {number: _spread_out(candidates) for number, candidates in of_vehicle.items()}
    order = np.random.default_rng(0).permutation(list(spread)).tolist()
    chosen = sorted(order, key=lambda number: len(spread[number]) == 1)[:count]
    vehicle_of = {
        (chosen_view.image, chosen_view.row): k for k, number in enumerate(chosen) for chosen_view in spread[number]
    }
    taken = [
        (view.found[row], float(view.sigma_px[row]), vehicle_of[i, row])
        for i, (view, _) in enumerate(numbered_views())
        for row in range(len(view.found))
        if (i, row) in vehicle_of
    ]
    found, sigma, vehicle = zip(*taken, strict=True)
    views = VehicleViews(np.array(found), np.array(sigma), np.array(vehicle, dtype=np.intp), size, fleet_shapes())
    return Sample(views, known, np.concatenate(lower))


def _numbered(views: Iterator[View]) -> Iterator[tuple[View, NDArray[np.int64]]]:
    """Yield each image with the numbers of its vehicles, from the file or from their boxes; -1 if unknown."""
    links, before_s = BoxLinks(), None
    for view in views:
        numbers, time_s = view.tracks, view.image.time_s
        if (numbers < 0).any():
            near = before_s is not None and time_s is not None and 0 < time_s - before_s <= LINK_LIMITS.lost_s
            if time_s is not None and (near or before_s is None):
                numbers = links.add_boxes(time_s, view.boxes).astype(np.int64)
        before_s = time_s
        yield view, numbers


def _shows_enough(view: View) -> Mask:
    """Return (N,) whether vehicles show enough keypoints, are large enough and have nothing in front of them."""
    large = view.boxes[:, 2:].max(axis=1, initial=0) >= SAMPLE_LIMITS.least_edge_px
    many = (view.found[..., 2] > KEYPOINT_WEIGHTS.least_probability).sum(axis=1) >= SAMPLE_LIMITS.fewest_keypoints
    rectangles = box_math.xywh_to_xyxy(view.boxes)
    overlap = box_math.iou(rectangles, rectangles) * (1 - np.eye(len(rectangles)))
    return np.asarray(
        large & many & ~view.cut & ~view.interpolated & (overlap.max(axis=1, initial=0) < SAMPLE_LIMITS.hiding_iou)
    )


def _spread_out(candidates: Sequence[_Candidate]) -> list[_Candidate]:
    """Return views evenly spaced along a vehicle's path in the image; one view of a stationary vehicle."""
    middles = np.array([candidate.middle for candidate in candidates])
    way = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(middles, axis=0), axis=1))])
    if np.ptp(middles, axis=0).max() < SAMPLE_LIMITS.view_distance * candidates[0].edge:  # detected boxes jitter
        return [candidates[len(candidates) // 2]]
    edge = float(np.median([candidate.edge for candidate in candidates]))
    count = int(min(SAMPLE_LIMITS.most_views, 1 + way[-1] // (SAMPLE_LIMITS.view_distance * edge)))
    wanted = np.linspace(0, way[-1], count) if count > 1 else np.array([way[-1] / 2])
    return [candidates[i] for i in sorted({int(np.abs(way - w).argmin()) for w in wanted})]
