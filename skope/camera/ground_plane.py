"""The road as a plane, and the intersection of a camera's rays with it."""

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.camera.model import Camera
from skope.types import Array


@dataclass(frozen=True)
class GroundRays:
    """Numerical limits of rays to the ground."""

    step_px: float = 0.25
    """Step of numerical derivatives, pixels."""
    grazing_fall: float = 1e-6
    """Fall of a ray per length below which it counts as parallel to the plane."""


GROUND_RAYS: Final = GroundRays()

AROUND_PIXEL: Final = GROUND_RAYS.step_px * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""(4, 2) steps of numerical derivatives by pixels, forward and backward on each axis."""


@dataclass(frozen=True)
class Ground:
    """Road near the camera: a plane in the world, and the deviation of vehicles from it."""

    height: float = 0.0
    """z of the plane at `about`, metres."""
    height_sigma: float = 0.04
    """Standard deviation of the road's height over the plane, metres."""
    tilt_sigma: float = math.radians(1.0)
    """Standard deviation of the lean of a vehicle's upright axis from the plane's normal, radians: bumps and the
    suspension."""
    slope: tuple[float, float] = (0.0, 0.0)
    """Rise of the plane per metre along world x and y."""
    about: tuple[float, float] = (0.0, 0.0)
    """World x and y of the point at which the plane has `height`, metres."""

    @property
    def level(self) -> bool:
        """Whether the plane is horizontal."""
        return self.slope == (0.0, 0.0)

    def heights(self, xy: Array) -> Array:
        """Return (...,) z of the plane at positions (..., 2), metres."""
        return np.asarray(self.height + (xy - np.asarray(self.about)) @ np.asarray(self.slope))

    @property
    def T_world_level(self) -> Array:  # noqa: N802 (poses are called so)
        """(4, 4) from a frame in which the plane is z = 0 and `about` the origin; its x is world x along the plane."""
        along = np.array([1.0, 0.0, self.slope[0]]) / math.hypot(1.0, self.slope[0])
        up = np.array([-self.slope[0], -self.slope[1], 1.0]) / math.hypot(*self.slope, 1.0)
        T = np.eye(4)
        T[:3, :3] = np.stack([along, np.cross(up, along), up], axis=1)
        T[:3, 3] = [*self.about, self.height]
        return T


def intersect_ground(
    camera: Camera,
    pixels: ArrayLike,
    height: ArrayLike = 0.0,
    *,
    slope: ArrayLike = (0.0, 0.0),
    about: ArrayLike = (0.0, 0.0),
    least_fall: float | None = None,
) -> Array:
    """Return (..., 3) the points of pixels (..., 2) on a plane of the world, metres; NaN at or above its horizon.

    Args:
        camera: The camera of the image.
        pixels: (..., 2) pixels.
        height: z of the plane at `about`, metres; or (...) one per pixel.
        slope: (2,) rise of the plane per metre along x and y.
        about: (2,) world x and y, metres; or (..., 2).
        least_fall: Minimum fall of rays per metre along the camera's axis. Pixels above the horizon then have distant
            points, because a search for a camera needs finite values.
    """
    rays, valid = camera.rays(pixels)
    directions, eye = rays @ camera.T_camera_world[:3, :3], camera.position
    rise = np.asarray(slope, dtype=np.float64)
    falls = directions[..., 2] - directions[..., :2] @ rise
    below = np.asarray(height, dtype=np.float64) + (eye[:2] - np.asarray(about, dtype=np.float64)) @ rise - eye[2]
    if least_fall is None:
        meets = valid & (falls < -GROUND_RAYS.grazing_fall)
        reach = np.where(meets, below / np.where(meets, falls, -1.0), -1.0)
    else:
        reach = below / np.minimum(falls, -least_fall)
    return np.where((reach > 0)[..., None], eye + reach[..., None] * directions, np.nan)


def ground_jacobian(
    camera: Camera,
    pixels: Array,
    height: ArrayLike = 0.0,
    *,
    slope: ArrayLike = (0.0, 0.0),
    about: ArrayLike = (0.0, 0.0),
) -> Array:
    """Return (..., 2, 2) derivatives of `intersect_ground` by the pixels (..., 2), metres per pixel.

    The derivatives are central differences, computed for all pixels at once.

    Args:
        camera: The camera of the image.
        pixels: (..., 2) pixels.
        height: z of the plane at `about`, metres; or (...) one per pixel.
        slope: (2,) rise of the plane per metre along x and y.
        about: (2,) world x and y, metres; or (..., 2).

    Returns:
        (..., 2, 2) x and y by pixel u and v; NaN at or above the horizon.
    """
    around = pixels + AROUND_PIXEL.reshape(4, *(1,) * (pixels.ndim - 1), 2)
    places = intersect_ground(camera, around, height, slope=slope, about=about)[..., :2]
    return np.stack([places[0] - places[1], places[2] - places[3]], axis=-1) / (2 * GROUND_RAYS.step_px)
