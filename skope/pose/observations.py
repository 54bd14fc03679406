"""Keypoints prepared for a pose search: without lens distortion, each with a variance, with Cauchy's distribution.

The heavy tails of Cauchy's distribution keep a few wrong keypoints from deciding the pose.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.model import Camera
from skope.types import Array, Mask


@dataclass(frozen=True)
class KeypointWeights:
    """Weights of keypoints in a pose."""

    tail_variances: float = 9.0
    """Squared distance, in variances, at which the weight of a keypoint is one half."""
    least_probability: float = 0.2
    """Minimum probability of a used keypoint."""
    nearest_m: float = 0.5
    """Minimum depth of a keypoint in front of the camera, metres."""
    thinness: float = 0.04
    """Ratio of breadth to length of the keypoints in the image below which they lie on a line."""


KEYPOINT_WEIGHTS: Final = KeypointWeights()


def cost(squared: Array) -> Array:
    """Return twice the negative log likelihood of squared distances in variances, up to a constant."""
    return np.asarray(KEYPOINT_WEIGHTS.tail_variances * np.log1p(squared / KEYPOINT_WEIGHTS.tail_variances))


def weight(squared: Array) -> Array:
    """Return the weights, 0 to 1, of squared distances in iteratively reweighted least squares."""
    return np.asarray(1 / (1 + squared / KEYPOINT_WEIGHTS.tail_variances))


_PER_KEYPOINT: Final = ("xy", "variance", "counted", "probability")
_PER_VEHICLE: Final = (*_PER_KEYPOINT, "camera_index")


@dataclass(frozen=True, eq=False)
class Observed:
    """Keypoints of N vehicles in one or more images, each with its own camera."""

    xy: Array
    """(N, 33, 2) x / z and y / z in the camera frame."""
    variance: Array
    """(N, 33) variances, pixels squared, in an image without distortion."""
    counted: Mask
    """(N, 33) whether a keypoint counts."""
    probability: Array
    """(N, 33) probability that the keypoint is correct, 0 to 1."""
    camera_index: NDArray[np.intp]
    """(N,) index in `cameras` of each vehicle's camera."""
    cameras: tuple[Camera, ...]

    @property
    def focal(self) -> Array:
        """(N, 2) fx, fy, pixels."""
        return np.array([[camera.K[0, 0], camera.K[1, 1]] for camera in self.cameras]).reshape(-1, 2)[self.camera_index]

    @property
    def world_to_camera(self) -> Array:
        """(N, 4, 4) T_camera_world of each vehicle's camera."""
        return np.array([camera.T_camera_world for camera in self.cameras]).reshape(-1, 4, 4)[self.camera_index]

    @property
    def eye(self) -> Array:
        """(N, 3) positions of the cameras in the world, metres."""
        return np.array([camera.position for camera in self.cameras]).reshape(-1, 3)[self.camera_index]

    @property
    def count(self) -> NDArray[np.intp]:
        """(N,) number of counted keypoints."""
        return np.asarray(self.counted.sum(axis=1))

    def take(self, rows: NDArray[np.intp]) -> Self:
        """Return the vehicles `rows`."""
        parts = {name: getattr(self, name)[rows] for name in _PER_VEHICLE}
        return replace(self, **parts)

    def relabelled(self, order: Sequence[int]) -> Self:
        """Return the vehicles with renamed keypoints: keypoint `i` gets the position of keypoint `order[i]`."""
        index = list(order)
        parts = {name: getattr(self, name)[:, index] for name in _PER_KEYPOINT}
        return replace(self, **parts)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Return the vehicles of several images, in their order."""
        values = {name: np.concatenate([getattr(part, name) for part in parts]) for name in _PER_KEYPOINT}
        first = np.cumsum([0, *(len(part.cameras) for part in parts)])
        index = np.concatenate([part.camera_index + shift for part, shift in zip(parts, first, strict=False)])
        return cls(**values, camera_index=index, cameras=tuple(camera for part in parts for camera in part.cameras))

    def with_rows(self, rows: NDArray[np.intp], other: "Observed") -> Self:
        """Return a copy in which the vehicles `rows` are replaced by those of `other`."""
        parts = {}
        for name in _PER_KEYPOINT:
            parts[name] = getattr(self, name).copy()
            parts[name][rows] = getattr(other, name)
        return replace(self, **parts)

    def first_counted(self, size: int, order: Array) -> Mask:
        """Return (N, 33) the counted keypoints of each vehicle with the `size` smallest values, 0 to 1, in `order`."""
        rank = np.argsort(np.argsort(np.where(self.counted, order, 2.0), axis=1), axis=1)
        return np.asarray(self.counted & (rank < size))

    def on_a_line(self) -> Mask:
        """Return (N,) whether the counted keypoints lie on one line, within their errors."""
        weight = self.counted / np.maximum(self.count, 1)[:, None]
        middle = np.einsum("nk,nki->ni", weight, self.xy)
        away = (self.xy - middle[:, None]) * self.focal[:, None]
        scatter = np.linalg.eigvalsh(np.einsum("nk,nki,nkj->nij", weight, away, away))
        return np.asarray(scatter[:, 0] < KEYPOINT_WEIGHTS.thinness**2 * scatter[:, 1] + 1e-9)


def observe(camera: Camera, found: Array, sigma: Array) -> Observed:
    """Convert keypoints to rays and weights. Values that are not finite, or beyond the lens model, do not count.

    Args:
        camera: The camera of the image.
        found: (N, 33, 3) x, y in pixels, and the probability that the point is correct.
        sigma: (N,) standard deviation of a keypoint of probability 1, pixels.
    """
    probability = np.where(np.isfinite(found).all(axis=-1), found[..., 2], 0.0)
    pixels = np.where(np.isfinite(found[..., :2]), found[..., :2], 0.0)
    around = np.array([[0.0, 0.0], [0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]])
    distorted = camera.distortion.model != "none"
    # One call for all points: the lens model is inverted by iteration.
    rays, valid = camera.rays(pixels + around[: 5 if distorted else 1, None, None])
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    counted = valid[0] & (probability >= KEYPOINT_WEIGHTS.least_probability)
    xy = np.where(counted[..., None], rays[0, ..., :2], 0.0)
    stretch = np.ones(found.shape[:2])
    if distorted:
        # Length of a pixel without distortion relative to its length with it: the root of the ratio of areas.
        right, left, down, up = rays[1:, ..., :2] * focal
        a, b = right - left, down - up
        area = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        stretch = np.where(counted & np.isfinite(area) & (area > 0), area, 1.0)
    variance = (
        (np.maximum(sigma, 1e-3) ** 2)[:, None]
        * stretch
        / np.clip(probability, KEYPOINT_WEIGHTS.least_probability, 1.0)
    )
    assert xy.shape[1] == keypoints.K
    return Observed(xy, variance, counted, np.clip(probability, 0, 1), np.zeros(len(xy), dtype=np.intp), (camera,))
