"""Visibility of keypoints, from the rendered depth and ids; rays decide at edges."""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.labels.raycast import RayCaster
from skope.gen.labels.world_keypoints import WorldKeypoints
from skope.gen.render.frame import STATIC_ID, RenderedFrame
from skope.gen.scene.recording import Moment, body_of
from skope.types import Array, Mask


@dataclass(frozen=True)
class VisibilityTolerances:
    """Tolerances for the visibility of keypoints."""

    point_m: float = 0.05
    """Maximum distance of a visible keypoint behind the surface that the image shows, metres."""
    vehicle_m: float = 0.20
    """Distance behind the visible surface above which whole-vehicle rules count a keypoint as hidden, metres.

    Source: SKoPe3D."""
    slope_m: float = 5.0
    """Maximum allowance for the slope of a surface within a pixel, metres; see `behind`."""


VISIBILITY_TOLERANCES: Final = VisibilityTolerances()


def behind(view: RenderedFrame, camera: Camera, points: Array) -> tuple[Array, NDArray[np.int32]]:
    """Compute the distance of points behind the surfaces that the four surrounding pixels show.

    A pixel's depth belongs to its centre and not to the ray of the point. The largest difference that the surface's
    slope can cause between the two is subtracted, up to `VISIBILITY_TOLERANCES.slope_m`.

    Args:
        view: The rendered frame.
        camera: Camera of the frame.
        points: (..., 3) points, world, metres.

    Returns:
        (4, ...) distance behind the surface, metres, along rays from the camera's centre; NaN outside the image. (4,
        ...) ids of the pixels; -2 outside the image. The first of the four is the pixel that contains the point.
    """
    pixels, _, valid = camera.project(points)
    seen = valid & camera.inside(pixels)
    at = np.where(seen[..., None], pixels, 0.5)
    pixel = np.floor(at)
    beside = pixel + np.where(at - pixel < 0.5, -1, 1)
    size = np.array([camera.width, camera.height])
    picks = [[0, 0], [1, 0], [0, 1], [1, 1]]
    which = np.clip([np.where(pick, beside, pixel) for pick in picks], 0, size - 1).astype(int)
    columns, rows = which[..., 0], which[..., 1]
    depth = view.depth[rows, columns].astype(np.float64)
    centers = which + 0.5
    rays, _ = camera.rays(centers)
    length = np.linalg.norm(rays, axis=-1)
    # On a plane the inverse depth is linear in the pixel; the slope gives its change from the centre to the point's
    # ray.
    shift = (view.slope[rows, columns].astype(np.float64) * (at - centers)).sum(-1)
    finite = np.isfinite(depth)
    z = np.where(finite, depth, 1.0)
    room = np.abs(z / np.maximum(1 - shift / z, 1e-3) - z)
    slack = np.minimum(np.where(finite, room, 0.0) * length, VISIBILITY_TOLERANCES.slope_m)
    gap = np.linalg.norm(camera.to_camera(points), axis=-1) - depth * length - slack
    return np.where(seen, gap, np.nan), np.where(seen, view.ids[rows, columns], -2).astype(np.int32)


def find_hidden(
    moment: Moment,
    world: WorldKeypoints,
    view: RenderedFrame,
    camera: Camera,
    inside: Mask,
    gap: Array,
    shown: NDArray[np.int32],
) -> Mask:
    """Find the keypoints that an object hides.

    If the four pixels around a point show the same object and agree, they decide. If an edge passes between them, a ray
    to the point decides, since the shapes of road users are known exactly.

    Scenery hides a point in two cases: its own pixel shows scenery in front of it; or all four pixels show something in
    front of it and at least one of them shows scenery.

    Args:
        moment: Poses of the road users.
        world: Keypoints of N vehicles in the world.
        view: The rendered frame.
        camera: Camera of the frame.
        inside: (N, 33) whether each keypoint is in the image.
        gap: (4, N, 33) distances of the keypoints behind the surfaces around them, metres, as `behind` returns them.
        shown: (4, N, 33) ids of the pixels around the keypoints.

    Returns:
        (N, 33) whether each keypoint is hidden.
    """
    blocked = np.nan_to_num(gap, nan=0.0) > VISIBILITY_TOLERANCES.point_m
    hidden: Mask = blocked[0].copy()
    edge = (blocked != blocked[0]).any(axis=0) | (shown != shown[0]).any(axis=0)
    # A wheel's centre may be inside the image although the middle of its outer face, which is tested, is not.
    beyond = inside & np.isnan(gap[0])
    doubtful = (edge & ~(blocked[0] & (shown[0] == STATIC_ID))) | beyond
    if doubtful.any():
        points = world.tested[doubtful]
        away = np.linalg.norm(points - camera.position, axis=-1)
        hits = RayCaster(moment, [body_of(recorded) for recorded in moment.vehicles], camera).first_hits(points)
        hidden[doubtful] = away - hits > VISIBILITY_TOLERANCES.point_m
        hidden |= blocked.all(axis=0) & (shown == STATIC_ID).any(axis=0)
    if beyond.any():
        # Rays do not test scenery. The pixel of the wheel's centre shows scenery that is in front of the wheel.
        to_center, at_center = behind(view, camera, world.points[beyond])
        hidden[beyond] |= (at_center[0] == STATIC_ID) & (to_center[0] > VISIBILITY_TOLERANCES.vehicle_m)
    return hidden
