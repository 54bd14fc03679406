"""Describe a camera over a level road by five numbers, project points with it, and compute the derivatives."""

import math
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera, Distortion
from skope.camera.uncertain_camera import slopes
from skope.pose.observations import KEYPOINT_WEIGHTS
from skope.types import Array, Mask

UNKNOWN_NAMES: Final = ("log_focal", "pitch", "roll", "log_height", "k1")
"""The camera's unknowns: logarithms of the focal length (pixels) and height (metres), angles (radians), k1."""
FOCAL, PITCH, ROLL, HEIGHT, K1 = range(len(UNKNOWN_NAMES))


@dataclass(frozen=True)
class RayLimits:
    """Numerical limits of rays and derivatives."""

    step: float = 1e-4
    """Step of numerical derivatives with respect to the camera's unknowns."""
    least_fall: float = 1e-3
    """Minimum descent of a ray, as a share of its depth. A flatter ray is treated as if it fell by this much."""
    distortion_radius: float = 2.0
    """Distance from the axis, at depth 1, beyond which distortion does not grow."""


RAY_LIMITS: Final = RayLimits()


def camera_of_unknowns(unknowns: Array, size: tuple[int, int]) -> Camera:
    """Return the camera with the unknowns (5,), over (0, 0) and facing along x."""
    bent = Distortion("brown", (float(unknowns[K1]), 0.0, 0.0, 0.0)) if unknowns[K1] else None
    return Camera.looking(
        [0, 0, math.exp(unknowns[HEIGHT])],
        yaw=0,
        pitch_down=float(unknowns[PITCH]),
        roll=float(unknowns[ROLL]),
        size=size,
        fov=2 * math.atan(size[0] / 2 / math.exp(unknowns[FOCAL])),
        distortion=bent,
    )


def on_road(camera: Camera, pixels: Array) -> Array:
    """Return (P, 2) points on the road z = 0 of pixels (P, 2), metres; those above the horizon are very far away."""
    return intersect_ground(camera, pixels, least_fall=RAY_LIMITS.least_fall)[..., :2]


@dataclass(frozen=True, eq=False)
class Pictured:
    """Projections of world points, with the intermediate results that derivatives need."""

    camera: Array
    R: Array
    """(3, 3) rotation from the world's axes to the camera's."""
    x: Array
    """(B, P) x / z in the camera frame."""
    y: Array
    near: Array
    """(B, P) depths, metres; those behind the camera are set to a small positive depth."""
    front: Mask
    """(B, P) whether the points lie in front of the camera."""
    grown: Array
    """(B, P) radial scale factors of the lens distortion."""
    pixels: Array
    """(B, P, 2) pixels."""

    @classmethod
    def of(cls, camera: Array, size: tuple[int, int], world: Array) -> Self:
        """Project points of the world.

        Args:
            camera: (5,) unknowns in the order of `UNKNOWN_NAMES`.
            size: Width and height of the image, pixels.
            world: (B, P, 3) points, metres; the camera is above the origin and faces along x.
        """
        pitch, roll = camera[PITCH], camera[ROLL]
        forward = np.array([math.cos(pitch), 0.0, -math.sin(pitch)])
        right = np.array([0.0, -1.0, 0.0])
        turn = np.array(
            [[math.cos(roll), math.sin(roll), 0.0], [-math.sin(roll), math.cos(roll), 0.0], [0.0, 0.0, 1.0]]
        )
        R = turn @ np.stack([right, np.cross(forward, right), forward])
        x, y, depth = np.moveaxis((world - [0.0, 0.0, math.exp(camera[HEIGHT])]) @ R.T, -1, 0)
        near = np.maximum(depth, KEYPOINT_WEIGHTS.nearest_m)
        x, y = x / near, y / near
        grown = 1 + camera[K1] * np.minimum(x**2 + y**2, RAY_LIMITS.distortion_radius**2)
        pixels = math.exp(camera[FOCAL]) * np.stack([x * grown, y * grown], axis=-1) + np.array(size) / 2
        return cls(camera, R, x, y, near, depth > KEYPOINT_WEIGHTS.nearest_m, grown, pixels)

    def by_world(self) -> Array:
        """Return (B, P, 2, 3) derivatives of the pixels with respect to a shift in the world."""
        x, y, near = self.x[..., None], self.y[..., None], self.near[..., None]
        by_x, by_y = (self.R[0] - x * self.R[2]) / near, (self.R[1] - y * self.R[2]) / near
        k1 = self.camera[K1]
        xx, xy, yy = (
            (self.grown[..., None] + 2 * k1 * x * x),
            (2 * k1 * x * y),
            (self.grown[..., None] + 2 * k1 * y * y),
        )
        along = [xx * by_x + xy * by_y, xy * by_x + yy * by_y]
        return np.asarray(math.exp(self.camera[FOCAL]) * np.stack(along, axis=-2))


def by_camera(camera: Array, size: tuple[int, int], world: Array, foot: Array) -> Array:
    """Return (B, P, 2, 5) derivatives of the pixels of points with respect to the camera's unknowns.

    Args:
        camera: (5,) the unknowns.
        size: Size of the image, pixels.
        world: (B, P, 3) points, metres.
        foot: (B, 3) ground positions of the points, divided by the camera's height; they scale with it.
    """
    height = math.exp(camera[HEIGHT])
    return slopes(
        lambda at: Pictured.of(at, size, world + (math.exp(at[HEIGHT]) - height) * foot[:, None]).pixels,
        camera,
        RAY_LIMITS.step,
    )
