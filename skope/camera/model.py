"""A calibrated camera: intrinsics, lens distortion, pose; projection and its inverse.

Frames and units are OpenCV's (x right, y down, z forward; metres), pixels are continuous: the centre of pixel
(col, row) is (col + 0.5, row + 0.5), so the principal point of a centred 1920x1080 camera is (960, 540).

Distortion formulas: OpenCV's `calib3d` documentation (Brown-Conrady with rational and thin-prism terms, and the
equidistant fisheye model of Kannala and Brandt).
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike

from skope.errors import UserError, one_of
from skope.types import Array, Mask

DISTORTION_MODELS: Final = ("none", "brown", "fisheye")
COEFFICIENT_COUNTS: Final = {"none": (0,), "brown": (4, 5, 8, 12), "fisheye": (4,)}
"""Possible numbers of coefficients of each distortion model."""


@dataclass(frozen=True)
class CameraNumerics:
    """Numerical limits of projection."""

    near_m: float = 1e-6
    """Minimum depth of a point in front of the camera, metres. Nearer points count as behind it."""
    same_aspect: float = 0.01
    """Maximum relative difference of two aspect ratios that count as equal."""
    block: int = 1 << 13
    """Number of points that are distorted per block."""


CAMERA_NUMERICS: Final = CameraNumerics()


def same_aspect(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Return whether two images (width, height) have the same aspect ratio, within 1%."""
    return abs(first[0] * second[1] - second[0] * first[1]) <= CAMERA_NUMERICS.same_aspect * first[0] * second[1]


def _first_positive_root(coefficients: list[float]) -> float:
    """Return the smallest positive real root of a polynomial (constant term first); inf if there is none."""
    roots = np.polynomial.Polynomial(coefficients).roots()
    real = roots.real[(np.abs(roots.imag) < 1e-9) & (roots.real > 0)]
    return float(real.min()) if real.size else math.inf


@dataclass(frozen=True)
class Distortion:
    """Lens distortion of normalised image coordinates, invertible only inside its monotonic domain."""

    model: str = "none"
    coefficients: tuple[float, ...] = ()
    """OpenCV's order: brown k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4]]]; fisheye k1, k2, k3, k4."""

    def __post_init__(self) -> None:
        one_of("distortion.model", self.model, DISTORTION_MODELS)
        counts = COEFFICIENT_COUNTS[self.model]
        if len(self.coefficients) not in counts:
            expected = " or ".join(map(str, counts))
            raise UserError(
                f"distortion.coefficients: {self.model} takes {expected} numbers, got {len(self.coefficients)}"
            )
        if not all(math.isfinite(c) for c in self.coefficients):
            raise UserError("distortion.coefficients: not all are finite numbers")

    def _brown(self) -> Array:
        return np.array([*self.coefficients, *(0.0,) * (12 - len(self.coefficients))], dtype=np.float64)

    @cached_property
    def fold(self) -> float:
        """Radius where the radial model stops growing: tan(theta) for brown, an angle for fisheye; inf if never."""
        if self.model == "none":
            return math.inf
        if self.model == "fisheye":
            k1, k2, k3, k4 = self.coefficients
            return math.sqrt(_first_positive_root([1, 3 * k1, 5 * k2, 7 * k3, 9 * k4]))
        k1, k2, _, _, k3, k4, k5, k6, *_ = self._brown()
        if not (k2 or k3 or k4 or k5 or k6):  # fast path for camera searches, which need this thousands of times
            return math.sqrt(-1 / (3 * k1)) if k1 < 0 else math.inf
        # r * N(q) / D(q) with q = r^2 grows while N D + 2 q (N' D - N D') > 0; it also ends at a pole of D.
        poly = np.polynomial.Polynomial
        n, d, q = poly([1.0, k1, k2, k3]), poly([1.0, k4, k5, k6]), poly([0.0, 1.0])
        growth = n * d + 2 * q * (n.deriv() * d - n * d.deriv())
        return math.sqrt(min(_first_positive_root(list(growth.coef)), _first_positive_root(list(d.coef))))

    def _brown_forward(self, x: Array, y: Array) -> tuple[Array, Array, "_Jacobian"]:
        """Distort ideal x and y (N,); return distorted x and y (N,) and their Jacobian."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._brown()
        q = x * x + y * y
        n, d = 1 + q * (k1 + q * (k2 + q * k3)), 1 + q * (k4 + q * (k5 + q * k6))
        radial = n / d
        slope = (k1 + q * (2 * k2 + 3 * q * k3) - radial * (k4 + q * (2 * k5 + 3 * q * k6))) / d  # d radial / d q
        prism_x, prism_y = s1 + 2 * q * s2, s3 + 2 * q * s4
        cross = 2 * x * y * slope + 2 * p1 * x + 2 * p2 * y
        jacobian = _Jacobian(
            radial + 2 * x * x * slope + 2 * p1 * y + 6 * p2 * x + 2 * x * prism_x,
            cross + 2 * y * prism_x,
            cross + 2 * x * prism_y,
            radial + 2 * y * y * slope + 6 * p1 * y + 2 * p2 * x + 2 * y * prism_y,
        )
        distorted_x = x * radial + 2 * p1 * x * y + p2 * (q + 2 * x * x) + q * (s1 + q * s2)
        distorted_y = y * radial + p1 * (q + 2 * y * y) + 2 * p2 * x * y + q * (s3 + q * s4)
        return distorted_x, distorted_y, jacobian

    def _fisheye_radius(self, theta: Array) -> tuple[Array, Array]:
        """Return the distorted radius at an angle off the axis, and its derivative."""
        k1, k2, k3, k4 = self.coefficients
        q = theta * theta
        radius = theta * (1 + q * (k1 + q * (k2 + q * (k3 + q * k4))))
        return radius, 1 + q * (3 * k1 + q * (5 * k2 + q * (7 * k3 + q * 9 * k4)))

    def distort(self, xy: Array) -> tuple[Array, Mask]:
        """Distort ideal normalised coordinates x/z, y/z (..., 2).

        Also return (...,) whether the model is monotonic there.
        """
        if self.model == "none":
            return xy, np.ones(xy.shape[:-1], dtype=bool)
        return _by_blocks(self._distort_fisheye if self.model == "fisheye" else self._distort_brown, xy)

    def _distort_fisheye(self, x: Array, y: Array) -> tuple[Array, Array, Mask]:
        radius = np.hypot(x, y)
        theta = np.arctan(radius)
        distorted, _ = self._fisheye_radius(theta)
        scale = np.divide(distorted, radius, out=np.ones_like(radius), where=radius > 0)
        return x * scale, y * scale, theta < self.fold

    def _distort_brown(self, x: Array, y: Array) -> tuple[Array, Array, Mask]:
        distorted_x, distorted_y, jacobian = self._brown_forward(x, y)
        return distorted_x, distorted_y, (np.hypot(x, y) < self.fold) & (jacobian.determinant > 0)

    def undistort(self, xy: Array) -> tuple[Array, Mask]:
        """Invert `distort` by Newton's method: (..., 2) -> (..., 2). Also return (...,) whether the result is valid."""
        if self.model == "none":
            return xy, np.ones(xy.shape[:-1], dtype=bool)
        return _by_blocks(self._undistort_fisheye if self.model == "fisheye" else self._undistort_brown, xy)

    def _undistort_brown(self, x: Array, y: Array) -> tuple[Array, Array, Mask]:
        ideal_x, ideal_y = x, y
        for _ in range(40):
            if math.isfinite(self.fold):
                # An iterate inside the fold cannot converge to a branch beyond it.
                within = np.minimum(1.0, 0.999 * self.fold / np.maximum(np.hypot(ideal_x, ideal_y), 1e-12))
                ideal_x, ideal_y = ideal_x * within, ideal_y * within
            value_x, value_y, jacobian = self._brown_forward(ideal_x, ideal_y)
            step_x, step_y = jacobian.solve(value_x - x, value_y - y)
            ideal_x, ideal_y = ideal_x - step_x, ideal_y - step_y
            if max(np.abs(step_x).max(initial=0.0), np.abs(step_y).max(initial=0.0)) < 1e-13:
                break
        back_x, back_y, monotonic = self._distort_brown(ideal_x, ideal_y)
        return ideal_x, ideal_y, monotonic & (np.hypot(back_x - x, back_y - y) < 1e-9)

    def _undistort_fisheye(self, x: Array, y: Array) -> tuple[Array, Array, Mask]:
        target = np.hypot(x, y)
        limit = min(self.fold, math.pi / 2)
        theta = np.minimum(target, 0.999 * limit)
        for _ in range(40):
            value, slope = self._fisheye_radius(theta)
            before = theta
            theta = np.clip(theta - (value - target) / np.where(np.abs(slope) > 1e-9, slope, 1.0), 0.0, 0.9999 * limit)
            if np.abs(theta - before).max(initial=0.0) < 1e-14:
                break
        value, _ = self._fisheye_radius(theta)
        scale = np.divide(np.tan(theta), target, out=np.ones_like(target), where=target > 0)
        return x * scale, y * scale, np.abs(value - target) < 1e-9


@dataclass(frozen=True, eq=False)
class _Jacobian:
    """N matrices of two rows and columns, stored by entries (N,) for speed."""

    xx: Array
    xy: Array
    yx: Array
    yy: Array

    @cached_property
    def determinant(self) -> Array:
        """(N,) determinants."""
        return self.xx * self.yy - self.xy * self.yx

    def solve(self, x: Array, y: Array) -> tuple[Array, Array]:
        """Solve for the vectors that the matrices map to x and y (N,); x and y unchanged if a matrix is singular."""
        regular = np.abs(self.determinant) > 1e-9
        divisor = np.where(regular, self.determinant, 1.0)
        return (
            np.where(regular, (self.yy * x - self.xy * y) / divisor, x),
            np.where(regular, (self.xx * y - self.yx * x) / divisor, y),
        )


def _by_blocks(of: Callable[[Array, Array], tuple[Array, Array, Mask]], xy: Array) -> tuple[Array, Mask]:
    """Apply a function of x and y (N,) to points (..., 2) in blocks.

    Small blocks keep intermediate results in the processor's cache. For the pixels of an image this is three times as
    fast as one call.
    """
    points = np.asarray(xy, dtype=np.float64).reshape(-1, 2)
    out, mask = np.empty_like(points), np.empty(len(points), dtype=bool)
    for begin in range(0, len(points), CAMERA_NUMERICS.block):
        part = slice(begin, begin + CAMERA_NUMERICS.block)
        x, y = np.ascontiguousarray(points[part].T)
        out[part, 0], out[part, 1], mask[part] = of(x, y)
    return out.reshape(xy.shape), mask.reshape(xy.shape[:-1])


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera with distortion, fixed in the world.

    Raises UserError if a field has the wrong shape, K is not an intrinsic matrix or the pose is not a rigid transform.
    """

    width: int
    height: int
    K: Array
    """(3, 3) intrinsic matrix, pixels."""
    T_camera_world: Array
    """(4, 4) takes world points to the camera frame, metres."""
    distortion: Distortion = field(default_factory=Distortion)

    def __post_init__(self) -> None:
        if self.width <= 0 or self.height <= 0:
            raise UserError(f"camera size: {self.width}x{self.height} is not positive")
        for name, shape in (("K", (3, 3)), ("T_camera_world", (4, 4))):
            value = np.asarray(getattr(self, name), dtype=np.float64)
            if value.shape != shape or not np.isfinite(value).all():
                raise UserError(f"camera.{name}: expected {shape[0]}x{shape[1]} finite numbers")
            object.__setattr__(self, name, value)
        if (
            self.K[0, 0] <= 0
            or self.K[1, 1] <= 0
            or not np.array_equal(self.K[[1, 2, 2, 2], [0, 0, 1, 2]], [0, 0, 0, 1])
        ):
            raise UserError("camera.K: expected [[fx, s, cx], [0, fy, cy], [0, 0, 1]] with positive fx, fy")
        R = self.T_camera_world[:3, :3]
        if (
            np.abs(R @ R.T - np.eye(3)).max() > 1e-6
            or np.linalg.det(R) < 0
            or list(self.T_camera_world[3]) != [0, 0, 0, 1]
        ):
            raise UserError("camera.T_camera_world: not a rigid transform")

    @classmethod
    def looking(
        cls,
        position: ArrayLike,
        *,
        yaw: float,
        pitch_down: float,
        roll: float = 0.0,
        size: tuple[int, int] = (1920, 1080),
        fov: float = math.radians(110),
        distortion: Distortion | None = None,
    ) -> Self:
        """Make a camera from its position, orientation and field of view.

        Args:
            position: (3,) position of the camera in the world, metres.
            yaw: Viewing direction, from world x towards y, radians.
            pitch_down: Angle of the optical axis below the horizontal, radians.
            roll: Rotation about the axis, radians; positive values turn the scene anticlockwise in the image.
            size: Width and height of the image, pixels.
            fov: Full horizontal field of view before distortion, radians.
            distortion: Distortion of the lens; None: none.

        Returns:
            A camera with square pixels and its axis through the middle of the image.
        """
        width, height = size
        focal = width / 2 / math.tan(fov / 2)
        K = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
        cy, sy, cp, sp, cr, sr = (f(a) for a in (yaw, pitch_down, roll) for f in (math.cos, math.sin))
        forward = np.array([cy * cp, sy * cp, -sp])
        right = np.array([sy, -cy, 0.0])
        down = np.cross(forward, right)
        T = np.eye(4)
        T[:3, :3] = np.array([[cr, sr, 0], [-sr, cr, 0], [0, 0, 1]]) @ np.stack([right, down, forward])
        T[:3, 3] = -T[:3, :3] @ np.asarray(position, dtype=np.float64)
        return cls(width, height, K, T, distortion or Distortion())

    @classmethod
    def from_dict(cls, value: Mapping[str, Any], width: int, height: int) -> Self:
        """Read the annotation schema's `camera` object {K, distortion, T_camera_world}.

        Args:
            value: The object; without `distortion` the lens has none.
            width: Width of the image, pixels.
            height: Height of the image, pixels.

        Raises:
            UserError: A field is missing or invalid.
        """
        try:
            distortion = value.get("distortion", {"model": "none", "coefficients": []})
            return cls(
                width,
                height,
                np.array(value["K"], dtype=np.float64),
                np.array(value["T_camera_world"], dtype=np.float64),
                Distortion(distortion["model"], tuple(float(c) for c in distortion["coefficients"])),
            )
        except KeyError as error:
            raise UserError(f"camera: field {error} is missing") from None
        except (TypeError, AttributeError) as error:
            raise UserError(f"camera: {error}") from None
        except ValueError as error:
            raise error if isinstance(error, UserError) else UserError(f"camera: {error}") from None

    def to_dict(self) -> dict[str, Any]:
        """Return the annotation schema's `camera` object; matrices are not rounded."""
        return {
            "K": self.K.tolist(),
            "distortion": {"model": self.distortion.model, "coefficients": list(self.distortion.coefficients)},
            "T_camera_world": self.T_camera_world.tolist(),
        }

    def resized(self, size: tuple[int, int]) -> "Camera":
        """Return a camera with the same view and images of another size (width, height), pixels."""
        scale = np.array([[size[0] / self.width], [size[1] / self.height], [1.0]])
        return replace(self, width=size[0], height=size[1], K=self.K * scale)

    @property
    def position(self) -> Array:
        """(3,) centre of projection in the world, metres."""
        R, t = self.T_camera_world[:3, :3], self.T_camera_world[:3, 3]
        return -R.T @ t

    @property
    def angles(self) -> tuple[float, float, float]:
        """Yaw, downward pitch and roll, radians; `looking` defines them."""
        x, y, z = self.T_camera_world[2, :3]
        yaw, pitch_down = math.atan2(y, x), math.asin(-max(-1.0, min(1.0, z)))
        level = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
        return yaw, pitch_down, math.atan2(-self.T_camera_world[1, :3] @ level, self.T_camera_world[0, :3] @ level)

    def to_camera(self, points_world: ArrayLike) -> Array:
        """Transform points (..., 3) from the world to the camera frame."""
        return np.asarray(points_world, dtype=np.float64) @ self.T_camera_world[:3, :3].T + self.T_camera_world[:3, 3]

    def project(self, points_world: ArrayLike) -> tuple[Array, Array, Mask]:
        """Project world points (..., 3); return pixels (..., 2), planar depth (...,) and validity (...,).

        Valid points are in front of the camera and inside the distortion's monotonic domain; other pixels are NaN. A
        valid point may still lie outside the image: see `inside`.
        """
        p = self.to_camera(points_world)
        z = p[..., 2]
        front = z > CAMERA_NUMERICS.near_m
        ideal = p[..., :2] / np.where(front, z, 1.0)[..., None]
        distorted, monotonic = self.distortion.distort(np.where(front[..., None], ideal, 0.0))
        valid = front & monotonic
        x, y = distorted[..., 0], distorted[..., 1]
        pixels = np.stack(
            [self.K[0, 0] * x + self.K[0, 1] * y + self.K[0, 2], self.K[1, 1] * y + self.K[1, 2]], axis=-1
        )
        return np.where(valid[..., None], pixels, np.nan), z, valid

    def rays(self, pixels: ArrayLike) -> tuple[Array, Mask]:
        """Return the viewing rays of pixels in the camera frame.

        Args:
            pixels: (..., 2) pixels.

        Returns:
            (..., 3) rays with z = 1, and (...,) whether the lens distortion can be inverted at the pixel. Other rays
            are not valid.
        """
        uv = np.asarray(pixels, dtype=np.float64)
        y = (uv[..., 1] - self.K[1, 2]) / self.K[1, 1]
        x = (uv[..., 0] - self.K[0, 2] - self.K[0, 1] * y) / self.K[0, 0]
        ideal, valid = self.distortion.undistort(np.stack([x, y], axis=-1))
        return np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1), valid

    def unproject(self, pixels: ArrayLike, depth: ArrayLike) -> tuple[Array, Mask]:
        """Return world points (..., 3) of pixels (..., 2) at planar depths (...,), metres, and their validity."""
        rays, valid = self.rays(pixels)
        p = rays * np.asarray(depth, dtype=np.float64)[..., None]
        return (p - self.T_camera_world[:3, 3]) @ self.T_camera_world[:3, :3], valid

    def inside(self, pixels: ArrayLike) -> Mask:
        """Return (...) whether pixels (..., 2) fall on the image; False for NaN."""
        uv = np.asarray(pixels, dtype=np.float64)
        return np.asarray((uv >= 0).all(-1) & (uv[..., 0] < self.width) & (uv[..., 1] < self.height))
