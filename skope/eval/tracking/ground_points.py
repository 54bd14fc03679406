"""Where people on foot and on two wheels stand: the bottom middle of a box, taken to the road."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.camera.ground_plane import ground_places
from skope.camera.model import Camera
from skope.eval.pose.camera_error import camera_errors
from skope.eval.pose.ground import Ground
from skope.eval.pose.views import Scene
from skope.schema import Image, RoadUser, RoadUserResult
from skope.types import Array

_SHARE: Final = 0.03
"""Standard deviation of the lower edge's middle as a share of a predicted box's longer edge, at least a pixel."""
_LEAST_PX: Final = 1.0
_LABELLED_PX: Final = 0.5
"""The same of a labelled box, pixels."""
_STEP_PX: Final = 0.25
"""Over so many pixels to either side it is seen how far places lie apart."""
_EDGE_PX: Final = 2.0
"""A box that ends so near to the image's lower edge is cut there: it does not show the feet."""
_FARTHEST_SIGMA_M: Final = 5.0
"""Places that are less certain than this, one standard deviation in the worst direction, say nothing."""


@dataclass(frozen=True, eq=False, slots=True)
class GroundPoint:
    """A place on the road, and how certain it is."""

    place: Array
    """(2,) world x, y, metres."""
    covariance: Array
    """(2, 2) square metres."""
    height: float
    """z of the road there, metres."""


@dataclass(frozen=True, eq=False, slots=True)
class Sight:
    """Somebody on foot or on two wheels in one image."""

    category_id: int
    bbox: Array
    """(4,) x, y, width, height, pixels."""
    score: float
    """1 where it is labelled."""
    link: int | None
    """What the sights of one road user share from frame to frame; None: not known."""
    point: GroundPoint | None
    """Where it stands; None where the box does not say: cut, followed from other frames, or too far away."""


def sights_of(scene: Scene, *, score: float, sigma_px: float | None) -> list[list[Sight]]:
    """The road users of each image of a scene that score above `score`, or that are labelled and not ignored.

    `sigma_px` is the standard deviation of the lower edge's middle, pixels; None: by the box. Without a road there are
    no places.
    """
    found: dict[int, list[RoadUser | RoadUserResult]] = {image.id: [] for image in scene.file.images}
    for one in _chosen(scene, score):
        if one.image_id in found:
            found[one.image_id].append(one)
    return [_in_image(scene, image, found[image.id], sigma_px) for image in scene.file.images]


def _chosen(scene: Scene, score: float) -> Iterable[RoadUser | RoadUserResult]:
    if scene.road_users is None:
        return (user for user in scene.file.road_users if not user.ignored)
    return (result for result in scene.road_users if result.score > score)


def _in_image(
    scene: Scene, image: Image, found: Sequence[RoadUser | RoadUserResult], sigma_px: float | None
) -> list[Sight]:
    boxes = np.array([one.bbox for one in found]).reshape(-1, 4)
    feet = boxes[:, :2] + boxes[:, 2:] * [0.5, 1.0]
    sigmas = [
        _LABELLED_PX if isinstance(one, RoadUser) else max(_LEAST_PX, _SHARE * one.bbox[2:].max()) for one in found
    ]
    spread = np.array(sigmas) if sigma_px is None else np.full(len(found), sigma_px)
    points: list[GroundPoint | None] = [None] * len(found)
    road = scene.road_in(image)
    if road is not None and found:
        camera = scene.camera_in(image)
        points = [] if scene.moved_in(image) else ground_points(camera, road, feet, spread)
        points = [_wider(point, scene, image) for point in points] or [None] * len(found)
    out = []
    for one, foot, point in zip(found, feet, points, strict=True):
        shown = point if foot[1] < image.height - _EDGE_PX else None
        if isinstance(one, RoadUser):  # as with vehicles, labels do not tell who is who
            out.append(Sight(one.category_id, one.bbox, 1.0, None, shown))
        else:
            measured = None if one.interpolated else shown
            out.append(Sight(one.category_id, one.bbox, one.score, one.track_id, measured))
    return out


def _wider(point: GroundPoint | None, scene: Scene, image: Image) -> GroundPoint | None:
    """A place with what the camera's sway leaves uncertain."""
    sway, road = scene.sway_in(image), scene.road_in(image)
    if point is None or sway is None or road is None:
        return point
    added, _ = camera_errors(sway, np.array([[*point.place, point.height]]), np.zeros((1, 2)), road.slope)
    return replace(point, covariance=point.covariance + added[0])


def ground_points(camera: Camera, ground: Ground, pixels: Array, sigma_px: Array) -> list[GroundPoint | None]:
    """The places on the road that pixels show.

    Args:
        camera: What took the image.
        ground: The road: a plane, from which it deviates a little.
        pixels: (N, 2) of the image.
        sigma_px: (N,) standard deviations of the pixels in both directions.

    Returns:
        N places; None where the pixel shows no road, or it is too far away to tell where.
    """
    around = np.array([[0, 0], [_STEP_PX, 0], [-_STEP_PX, 0], [0, _STEP_PX], [0, -_STEP_PX]])
    places, per_metre = _on_plane(camera, ground, pixels[:, None] + around)
    slopes = np.stack([places[:, 1] - places[:, 2], places[:, 3] - places[:, 4]], axis=-1) / (2 * _STEP_PX)
    rise = ground.height_sigma * per_metre[:, 0]
    covariances = sigma_px[:, None, None] ** 2 * slopes @ slopes.swapaxes(1, 2) + rise[:, :, None] * rise[:, None]
    out: list[GroundPoint | None] = []
    for place, covariance in zip(places[:, 0], covariances, strict=True):
        known = bool(np.isfinite(covariance).all()) and np.linalg.eigvalsh(covariance)[-1] < _FARTHEST_SIGMA_M**2
        height = ground.height + float((place - ground.about) @ ground.slope)
        out.append(GroundPoint(place, covariance, height) if known else None)
    return out


def _on_plane(camera: Camera, ground: Ground, pixels: Array) -> tuple[Array, Array]:
    """(..., 2) where the rays of pixels (..., 2) meet the plane, and how far that moves per metre that it is higher.

    NaN where they do not.
    """
    eye, slope = camera.position, np.array(ground.slope)
    places = ground_places(camera, pixels, ground.height, slope=slope, about=ground.about)[..., :2]
    below = ground.height + float((eye[:2] - ground.about) @ slope) - eye[2]
    return places, (places - eye[:2]) / (below if below else np.nan)
