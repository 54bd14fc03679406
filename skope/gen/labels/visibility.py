"""Visibility of keypoints: what the image shows before each, and rays to those at an edge."""

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
    """Tolerances within which a keypoint counts as visible."""

    point_m: float = 0.05
    """A keypoint no farther than this behind the surface that the image shows counts as visible, metres."""
    vehicle_m: float = 0.20
    """A keypoint this far behind the surface shown counts as hidden where a whole vehicle is judged, metres
    (SKoPe3D)."""
    slope_m: float = 5.0
    """Largest allowance for the slope of a surface within a pixel, metres; see `behind`."""


VISIBILITY_TOLERANCES: Final = VisibilityTolerances()


def behind(view: RenderedFrame, camera: Camera, points: Array) -> tuple[Array, NDArray[np.int32]]:
    """Distance of points behind the surfaces that the four pixels around them show.

    A pixel's depth is that of its centre, not of the point's ray: what the surface's slope can make between the two is
    subtracted, up to `VISIBILITY_TOLERANCES.slope_m`.

    Args:
        view: The rendered frame.
        camera: Its camera.
        points: (..., 3) world, metres.

    Returns:
        (4, ...) metres behind the surface, as distances from the camera's centre; NaN outside the image. (4, ...) ids
        of the pixels; -2 outside the image. The first of the four is the pixel that the point is in.
    """
    pixels, _, valid = camera.project(points)
    seen = valid & camera.inside(pixels)
    at = np.where(seen[..., None], pixels, 0.5)
    own = np.floor(at)
    beside = own + np.where(at - own < 0.5, -1, 1)
    size = np.array([camera.width, camera.height])
    picks = [[0, 0], [1, 0], [0, 1], [1, 1]]
    which = np.clip([np.where(pick, beside, own) for pick in picks], 0, size - 1).astype(int)
    columns, rows = which[..., 0], which[..., 1]
    depth = view.depth[rows, columns].astype(np.float64)
    centers = which + 0.5
    rays, _ = camera.rays(centers)
    length = np.linalg.norm(rays, axis=-1)
    # On a plane the inverse depth is linear in the pixel, which carries the slope from the centre to the point's ray.
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
    """Find the keypoints that something hides.

    Where the four pixels around a point show the same object and agree, they decide. Where an edge passes between
    them, a ray to the point decides, since road users' shapes are known exactly. Scenery hides the point if the
    point's own pixel shows it, or where all four show what stands before the point and one of them scenery: the ray
    that passes by the edge of a road user meets that.

    Args:
        moment: Poses of the road users.
        world: Keypoints of N vehicles where they are in the world.
        view: The rendered frame.
        camera: Its camera.
        inside: (N, 33) which keypoints are in the image.
        gap: (4, N, 33) metres of each behind the surface that the pixels around it show, as `behind` gives them.
        shown: (4, N, 33) ids of these pixels.

    Returns:
        (N, 33) which are hidden.
    """
    blocked = np.nan_to_num(gap, nan=0.0) > VISIBILITY_TOLERANCES.point_m
    hidden: Mask = blocked[0].copy()
    edge = (blocked != blocked[0]).any(axis=0) | (shown != shown[0]).any(axis=0)
    # A wheel's centre may be inside the image while the middle of its face, which is tested, is not.
    beyond = inside & np.isnan(gap[0])
    doubtful = (edge & ~(blocked[0] & (shown[0] == STATIC_ID))) | beyond
    if doubtful.any():
        points = world.tested[doubtful]
        away = np.linalg.norm(points - camera.position, axis=-1)
        hits = RayCaster(moment, [body_of(recorded) for recorded in moment.vehicles], camera).first_hits(points)
        hidden[doubtful] = away - hits > VISIBILITY_TOLERANCES.point_m
        hidden |= blocked.all(axis=0) & (shown == STATIC_ID).any(axis=0)
    if beyond.any():
        # No ray meets scenery: the pixel of the wheel's centre shows it, which its own face is before.
        to_center, at_center = behind(view, camera, world.points[beyond])
        hidden[beyond] |= (at_center[0] == STATIC_ID) & (to_center[0] > VISIBILITY_TOLERANCES.vehicle_m)
    return hidden
