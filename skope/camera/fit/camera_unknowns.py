"""A camera over a level road as a few numbers, its pictures of points, and how these follow the numbers."""

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
"""The camera's unknowns: natural logarithms of pixels and metres, radians."""
FOCAL, PITCH, ROLL, HEIGHT, K1 = range(len(UNKNOWN_NAMES))


@dataclass(frozen=True)
class RayLimits:
    """Numerical limits of rays and derivatives."""

    step: float = 1e-4
    """Step of numerical derivatives by the camera's unknowns."""
    least_fall: float = 1e-3
    """Least descent of a ray, as a share of its depth. A flatter ray is treated as if it fell by this much."""
    distortion_radius: float = 2.0
    """Distance from the axis, at depth 1, beyond which distortion does not grow."""


RAY_LIMITS: Final = RayLimits()


def camera_of_unknowns(unknowns: Array, size: tuple[int, int]) -> Camera:
    """The camera with the unknowns (5,), over (0, 0) and looking along x."""
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
    """(P, 2) places on the road z = 0, metres, that pixels (P, 2) show; those above the horizon are very far away."""
    return intersect_ground(camera, pixels, least_fall=RAY_LIMITS.least_fall)[..., :2]


@dataclass(frozen=True, eq=False)
class Pictured:
    """Points of the world as a camera shows them, with what their pixels follow from."""

    camera: Array
    R: Array
    """(3, 3) from the world's axes to the camera's."""
    x: Array
    """(B, P) x / z before the camera."""
    y: Array
    near: Array
    """(B, P) depths, metres, those behind the camera as if they lay just before it."""
    front: Mask
    """(B, P) which points lie before the camera."""
    grown: Array
    """(B, P) how much farther from the axis the lens shows them."""
    pixels: Array
    """(B, P, 2)"""

    @classmethod
    def of(cls, camera: Array, size: tuple[int, int], world: Array) -> Self:
        """Picture points of the world.

        Args:
            camera: (5,) the unknowns, as `UNKNOWN_NAMES` names them.
            size: Width and height of the image, pixels.
            world: (B, P, 3) points, metres; the camera hangs over the origin and looks along x.
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
        """(B, P, 2, 3) derivatives of the pixels by a shift in the world."""
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
    """(B, P, 2, 5) derivatives of the pixels of points by the camera's unknowns.

    Args:
        camera: (5,) the unknowns.
        size: Of the image, pixels.
        world: (B, P, 3) the points, metres.
        foot: (B, 3) places in the world, over the camera's height, that they stand at: they go with the height.
    """
    height = math.exp(camera[HEIGHT])
    return slopes(
        lambda at: Pictured.of(at, size, world + (math.exp(at[HEIGHT]) - height) * foot[:, None]).pixels,
        camera,
        RAY_LIMITS.step,
    )
