"""The road as a plane, and where a camera's rays meet it."""

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
    """A ray that falls by less than this share of its length is parallel to the plane."""


GROUND_RAYS: Final = GroundRays()

AROUND_PIXEL: Final = GROUND_RAYS.step_px * np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
"""(4, 2) steps of numerical derivatives by pixels, forward and backward on each axis."""


@dataclass(frozen=True)
class Ground:
    """The road near the camera: a plane in the world, and how far vehicles deviate from it."""

    height: float = 0.0
    """z of the plane at `about`, metres."""
    height_sigma: float = 0.04
    """Standard deviation of the road's height over the plane, metres."""
    tilt_sigma: float = math.radians(1.0)
    """Standard deviation of the lean of a vehicle's upright axis from the plane's normal, radians: bumps and the
    suspension."""
    slope: tuple[float, float] = (0.0, 0.0)
    """Metres that the plane rises per metre along world x and y."""
    about: tuple[float, float] = (0.0, 0.0)
    """World x and y of the point at which the plane has `height`, metres."""

    @property
    def level(self) -> bool:
        """Whether the plane is horizontal."""
        return self.slope == (0.0, 0.0)

    def heights(self, xy: Array) -> Array:
        """(...,) z of the plane at positions (..., 2), metres."""
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
    """(..., 3) where pixels (..., 2) lie on a plane of the world, metres; NaN at and above its horizon.

    Args:
        camera: What took the image.
        pixels: (..., 2)
        height: z of the plane at `about`, metres; or (...) of a plane for each pixel.
        slope: (2,) metres that the plane rises per metre along x and y.
        about: (2,) world x and y, metres; or (..., 2).
        least_fall: Rays fall by at least so much per metre along the camera's axis, so that pixels above the horizon
            have places too, far away: what searches for a camera needs numbers everywhere.
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
    """(..., 2, 2) derivatives of `intersect_ground` by the pixels (..., 2), metres per pixel.

    By central differences, of all pixels at once: a search asks for these thousands of times.

    Args:
        camera: What took the image.
        pixels: (..., 2)
        height: z of the plane at `about`, metres; or (...) of a plane for each pixel.
        slope: (2,) metres that the plane rises per metre along x and y.
        about: (2,) world x and y, metres; or (..., 2).

    Returns:
        (..., 2, 2) x and y by pixel u and v; NaN at and above the horizon.
    """
    around = pixels + AROUND_PIXEL.reshape(4, *(1,) * (pixels.ndim - 1), 2)
    places = intersect_ground(camera, around, height, slope=slope, about=about)[..., :2]
    return np.stack([places[0] - places[1], places[2] - places[3]], axis=-1) / (2 * GROUND_RAYS.step_px)
