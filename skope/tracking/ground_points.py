"""Ground points of pedestrians and two-wheelers: the bottom middle of a box, projected onto the road."""

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.camera.ground_plane import Ground, ground_jacobian, intersect_ground
from skope.camera.model import Camera
from skope.pose.camera_error import camera_errors
from skope.pose.keypoint_views import Scene
from skope.schema import Image, RoadUser, RoadUserResult
from skope.tracking.duplicates import DUPLICATE_LIMITS, feet, inside_and_apart
from skope.types import Array


@dataclass(frozen=True)
class FootErrors:
    """Error model of the bottom middle of a box."""

    box_shares: tuple[float, float] = (0.03, 0.06)
    """Standard deviations of the middle of the lower edge, across and up, as shares of a predicted box's longer
    edge. Measured on generated footage by day, at night and in rain."""
    least_px: float = 1.0
    """Minimum standard deviation, pixels."""
    labelled_px: float = 0.5
    """Standard deviation of a labelled box, pixels."""
    edge_px: float = 2.0
    """Distance to the image's lower edge within which a box is cut and does not show the feet, pixels."""
    largest_sigma_m: float = 5.0
    """Maximum standard deviation of a used position in its worst direction, metres."""


FOOT_ERRORS: Final = FootErrors()


@dataclass(frozen=True, eq=False, slots=True)
class GroundPoint:
    """Position on the road with its covariance."""

    position: Array
    """(2,) world x, y, metres."""
    covariance: Array
    """(2, 2) covariance of the position, square metres."""
    height: float
    """z of the road there, metres."""


@dataclass(frozen=True, eq=False, slots=True)
class GroundDetection:
    """Pedestrian or two-wheeler in one image."""

    category_id: int
    """Category of the box with the highest score."""
    bbox: Array
    """(4,) x, y, width, height, pixels."""
    score: float
    """Score of the box, 0 to 1; 1 if it is labelled."""
    links: tuple[tuple[int, int], ...]
    """Category and number that the detections of one road user share from frame to frame, if known."""
    scores: Mapping[int, float]
    """Confidence in each category."""
    point: GroundPoint | None
    """Position on the ground; None if the box is cut, followed from other frames, or too far away."""


def ground_detections(scene: Scene, *, score: float, sigma_px: float | None) -> list[list[GroundDetection]]:
    """Return the detected or labelled road users of each image; boxes of one road user are merged.

    Without a road they have no positions.

    Args:
        scene: Images, results and the road.
        score: Minimum score of detections. Labels are taken if they are not ignored.
        sigma_px: Standard deviation of the lower edge's middle, pixels; None: from the size of the box.

    Returns:
        The road users of each image.
    """
    found: dict[int, list[RoadUser | RoadUserResult]] = {image.id: [] for image in scene.file.images}
    for detection in _chosen(scene, score):
        if detection.image_id in found:
            found[detection.image_id].append(detection)
    return [_in_image(scene, image, found[image.id], sigma_px) for image in scene.file.images]


def _chosen(scene: Scene, score: float) -> Iterable[RoadUser | RoadUserResult]:
    if scene.road_users is None:
        return (user for user in scene.file.road_users if not user.ignored)
    return (result for result in scene.road_users if result.score > score)


def _in_image(
    scene: Scene, image: Image, found: Sequence[RoadUser | RoadUserResult], sigma_px: float | None
) -> list[GroundDetection]:
    boxes = np.array([detection.bbox for detection in found]).reshape(-1, 4)
    stand = feet(boxes)
    spread = (
        np.full((len(found), 2), sigma_px)
        if sigma_px is not None
        else np.array([_spread(detection) for detection in found])
    )
    points: list[GroundPoint | None] = [None] * len(found)
    road = scene.road_in(image)
    if road is not None and found and not scene.moved_in(image):
        points = ground_points(scene.camera_in(image), road, stand, spread)
        points = [_wider(point, scene, image) for point in points]
    out = []
    for group in _groups(found, boxes):
        best, point = found[group[0]], points[group[0]]
        shown = point if stand[group[0], 1] < image.height - FOOT_ERRORS.edge_px else None
        if isinstance(best, RoadUser):  # as with vehicles, labels carry no identity from frame to frame
            out.append(GroundDetection(best.category_id, best.bbox, 1.0, (), {best.category_id: 1.0}, shown))
        else:
            same = [result for result in (found[i] for i in group) if isinstance(result, RoadUserResult)]
            links = tuple((result.category_id, result.track_id) for result in same if result.track_id is not None)
            scores: dict[int, float] = defaultdict(float)
            for result in same:
                scores[result.category_id] += result.score
            measured = None if best.interpolated else shown
            out.append(GroundDetection(best.category_id, best.bbox, best.score, links, scores, measured))
    return out


def _spread(detection: RoadUser | RoadUserResult) -> tuple[float, float]:
    """Return the standard deviations of a box's lower middle, across and up, pixels."""
    if isinstance(detection, RoadUser):
        return FOOT_ERRORS.labelled_px, FOOT_ERRORS.labelled_px
    across, up = (max(FOOT_ERRORS.least_px, share * detection.bbox[2:].max()) for share in FOOT_ERRORS.box_shares)
    return across, up


def _groups(found: Sequence[RoadUser | RoadUserResult], boxes: Array) -> list[list[int]]:
    """Return the indices of the boxes of each road user, highest score first; each label is a road user."""
    groups: list[list[int]] = []
    scores = [detection.score if isinstance(detection, RoadUserResult) else 1.0 for detection in found]
    for i in sorted(range(len(found)), key=lambda i: -scores[i]):
        first = boxes[[group[0] for group in groups]].reshape(-1, 4)
        inside, apart = inside_and_apart(first, np.broadcast_to(boxes[i], first.shape))
        same = np.flatnonzero((inside >= DUPLICATE_LIMITS.inside_share) & (apart <= DUPLICATE_LIMITS.foot_sizes))
        if len(same) and isinstance(found[i], RoadUserResult):
            groups[same[0]].append(i)
        else:
            groups.append([i])
    return sorted(groups)


def _wider(point: GroundPoint | None, scene: Scene, image: Image) -> GroundPoint | None:
    """Return a ground point with the residual camera shake added to its covariance."""
    shake, road = scene.shake_in(image), scene.road_in(image)
    if point is None or shake is None or road is None:
        return point
    added, _ = camera_errors(shake, np.array([[*point.position, point.height]]), np.zeros((1, 2)), road.slope)
    return replace(point, covariance=point.covariance + added[0])


def ground_points(camera: Camera, ground: Ground, pixels: Array, sigma_px: Array) -> list[GroundPoint | None]:
    """Return the positions on the road that pixels show.

    Args:
        camera: The camera of the image.
        ground: The road: a plane with small deviations.
        pixels: (N, 2) pixels of the image.
        sigma_px: (N, 2) standard deviations of the pixels, across and up.

    Returns:
        N ground points; None if the pixel shows no road or the position is too uncertain.
    """
    places, per_metre = _on_plane(camera, ground, pixels)
    slopes = ground_jacobian(camera, pixels, ground.height, slope=ground.slope, about=ground.about)
    rise = ground.height_sigma * per_metre
    moved = slopes * sigma_px[:, None]
    covariances = moved @ moved.swapaxes(1, 2) + rise[:, :, None] * rise[:, None]
    out: list[GroundPoint | None] = []
    for position, covariance in zip(places, covariances, strict=True):
        known = (
            bool(np.isfinite(covariance).all()) and np.linalg.eigvalsh(covariance)[-1] < FOOT_ERRORS.largest_sigma_m**2
        )
        height = ground.height + float((position - ground.about) @ ground.slope)
        out.append(GroundPoint(position, covariance, height) if known else None)
    return out


def _on_plane(camera: Camera, ground: Ground, pixels: Array) -> tuple[Array, Array]:
    """Intersect the rays of pixels (..., 2) with the plane; return positions and their shift per metre of height.

    Both are (..., 2), metres; NaN where a ray does not meet the plane.
    """
    eye, slope = camera.position, np.array(ground.slope)
    places = intersect_ground(camera, pixels, ground.height, slope=slope, about=ground.about)[..., :2]
    below = ground.height + float((eye[:2] - ground.about) @ slope) - eye[2]
    return places, (places - eye[:2]) / (below if below else np.nan)
