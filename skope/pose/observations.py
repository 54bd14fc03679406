"""Keypoints as a pose search needs them: without lens distortion, with a variance each, under Cauchy's distribution.

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
    """Keypoints below this probability are not used."""
    nearest_m: float = 0.5
    """Least depth of a keypoint before the camera, metres."""
    thinness: float = 0.04
    """Breadth over length of the keypoints in the image below which they lie on a line."""


KEYPOINT_WEIGHTS: Final = KeypointWeights()


def cost(squared: Array) -> Array:
    """Twice the negative log likelihood of distances that are given squared and in variances, but for a constant."""
    return np.asarray(KEYPOINT_WEIGHTS.tail_variances * np.log1p(squared / KEYPOINT_WEIGHTS.tail_variances))


def weight(squared: Array) -> Array:
    """The weight of such distances in least squares that are iterated until they have the same minimum, 0 to 1."""
    return np.asarray(1 / (1 + squared / KEYPOINT_WEIGHTS.tail_variances))


_PER_VEHICLE: Final = ("xy", "variance", "counted", "probability")


@dataclass(frozen=True, eq=False)
class Observed:
    """Keypoints of N vehicles in images of one camera."""

    xy: Array
    """(N, 33, 2) x / z and y / z in the camera frame."""
    variance: Array
    """(N, 33) pixels squared, of an image without distortion."""
    counted: Mask
    """(N, 33) which keypoints count."""
    probability: Array
    """(N, 33) probability that the keypoint is right, 0 to 1."""
    focal: Array
    """(2,) fx, fy, pixels."""
    T_camera_world: Array
    """(4, 4) from the world's axes to the camera's."""

    @property
    def count(self) -> NDArray[np.intp]:
        """(N,) how many keypoints count."""
        return np.asarray(self.counted.sum(axis=1))

    def take(self, rows: NDArray[np.intp]) -> Self:
        """The vehicles `rows`."""
        parts = {name: getattr(self, name)[rows] for name in _PER_VEHICLE}
        return replace(self, **parts)

    def relabelled(self, order: Sequence[int]) -> Self:
        """The vehicles with their keypoints renamed: keypoint `i` gets the position of keypoint `order[i]`."""
        index = list(order)
        parts = {name: getattr(self, name)[:, index] for name in _PER_VEHICLE}
        return replace(self, **parts)

    def with_rows(self, rows: NDArray[np.intp], other: "Observed") -> Self:
        """A copy in which the vehicles `rows` are those of `other`."""
        parts = {}
        for name in _PER_VEHICLE:
            parts[name] = getattr(self, name).copy()
            parts[name][rows] = getattr(other, name)
        return replace(self, **parts)

    def subsets(self, size: int, rng: np.random.Generator) -> Mask:
        """(N, 33) at most `size` random counted keypoints of each vehicle."""
        rank = np.argsort(np.argsort(np.where(self.counted, rng.random(self.counted.shape), 2.0), axis=1), axis=1)
        return np.asarray(self.counted & (rank < size))

    def on_a_line(self) -> Mask:
        """(N,) whether the counted keypoints lie on one line, as far as can be told."""
        weight = self.counted / np.maximum(self.count, 1)[:, None]
        middle = np.einsum("nk,nki->ni", weight, self.xy)
        away = (self.xy - middle[:, None]) * self.focal
        scatter = np.linalg.eigvalsh(np.einsum("nk,nki,nkj->nij", weight, away, away))
        return np.asarray(scatter[:, 0] < KEYPOINT_WEIGHTS.thinness**2 * scatter[:, 1] + 1e-9)


def observe(camera: Camera, found: Array, sigma: Array) -> Observed:
    """Take keypoints to rays and weights; what is not finite, or beyond what the lens model can undo, does not count.

    Args:
        camera: The camera that took the image.
        found: (N, 33, 3) x, y in pixels, and the probability that the point is right.
        sigma: (N,) standard deviation of a keypoint of probability 1, pixels.
    """
    probability = np.where(np.isfinite(found).all(axis=-1), found[..., 2], 0.0)
    pixels = np.where(np.isfinite(found[..., :2]), found[..., :2], 0.0)
    rays, valid = camera.rays(pixels)
    focal = np.array([camera.K[0, 0], camera.K[1, 1]])
    counted = valid & (probability >= KEYPOINT_WEIGHTS.least_probability)
    xy = np.where(counted[..., None], rays[..., :2], 0.0)
    stretch = np.ones(found.shape[:2])
    if camera.distortion.model != "none":
        # How much longer a pixel is without distortion: the root of how much larger its area is.
        right, up = (camera.rays(pixels + step)[0][..., :2] * focal for step in ([0.5, 0.0], [0.0, 0.5]))
        left, down = (camera.rays(pixels - step)[0][..., :2] * focal for step in ([0.5, 0.0], [0.0, 0.5]))
        a, b = right - left, up - down
        area = np.abs(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
        stretch = np.where(counted & np.isfinite(area) & (area > 0), area, 1.0)
    variance = (
        (np.maximum(sigma, 1e-3) ** 2)[:, None]
        * stretch
        / np.clip(probability, KEYPOINT_WEIGHTS.least_probability, 1.0)
    )
    assert xy.shape[1] == keypoints.K
    return Observed(xy, variance, counted, np.clip(probability, 0, 1), focal, camera.T_camera_world)
