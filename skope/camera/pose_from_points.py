"""Fit a camera's pose, and its focal length if unknown, to points with known image and world positions."""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.types import Array


@dataclass(frozen=True)
class PointFitLimits:
    """Limits for fitting a camera to points."""

    fewest_points: int = 4
    """Minimum number of points for a camera."""
    marked_px: float = 1.0
    """Minimum standard deviation of a marked point, pixels per axis."""


POINT_FIT: Final = PointFitLimits()

FOCAL_GRID: Final = np.geomspace(0.3, 8.0, 48)
"""Focal lengths of the first search, in widths of the image: fields of view from 118 to 7 degrees."""


@dataclass(frozen=True)
class CameraSigma:
    """Standard deviations of a camera that was fitted to points."""

    focal: float
    """Focal length, pixels."""
    pitch: float
    """Pitch, radians."""
    roll: float
    """Roll, radians."""
    height: float
    """Camera's z in the world, metres."""


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A camera fitted to control points."""

    camera: Camera
    errors_px: Array
    """(N,) distance of each point from its projection in the image, pixels."""
    points_world: Array
    """(N, 3) positions of the points, metres."""
    fitted_focal: bool = False
    """Whether the focal length was fitted too."""

    @property
    def rms_px(self) -> float:
        """Root mean square of the errors, pixels."""
        return float(np.sqrt((self.errors_px**2).mean()))

    def sigma(self) -> CameraSigma:
        """Return standard deviations for marking errors of at least `POINT_FIT.marked_px`, or of the residuals."""
        middle = self.points_world.mean(axis=0)
        pixels, _, _ = self.camera.project(self.points_world)
        _, jacobian = _linearised(self.camera, pixels, self.points_world, middle, self.fitted_focal)
        spare = max(1, 2 * len(pixels) - jacobian.shape[1])
        variance = max(POINT_FIT.marked_px**2, float((self.errors_px**2).sum()) / spare)
        covariance = variance * np.linalg.pinv(jacobian.T @ jacobian)
        scale = np.array([1.0, 1, 1, *[float(np.linalg.norm(self.camera.to_camera(middle)))] * 3, 1.0])
        steps = 1e-5 * np.diag(scale)[: len(covariance), : len(covariance)]
        slopes = [
            (_figures(_moved(self.camera, step, middle)) - _figures(_moved(self.camera, -step, middle)))
            / (2 * step.max())
            for step in steps
        ]
        J = np.stack(slopes, axis=1)
        focal, pitch, roll, height = np.sqrt(np.einsum("ij,jk,ik->i", J, covariance, J)).tolist()
        return CameraSigma(focal, pitch, roll, height)


def fit_camera_to_points(
    pixels: ArrayLike,
    points_world: ArrayLike,
    size: tuple[int, int],
    *,
    K: Array | None = None,
    distortion: Distortion | None = None,
) -> CameraFit:
    """Fit a camera to points by least squares of their distances in the image.

    SQPnP (Terzakis and Lourakis, 2020) gives the pose for each tested focal length. Levenberg and Marquardt's method
    refines the best.

    Args:
        pixels: (N, 2) points in the image.
        points_world: (N, 3) the same points in the world, metres.
        size: Width and height of the image, pixels.
        K: (3, 3) intrinsics. None: the principal point is the image's middle, and the focal length is estimated too.
        distortion: The lens; None: without distortion.

    Raises:
        UserError: There are fewer than four points, they lie on one line, or no camera fits them.
    """
    uv, xyz = np.asarray(pixels, dtype=np.float64), np.asarray(points_world, dtype=np.float64)
    lens = distortion or Distortion()
    if len(uv) < POINT_FIT.fewest_points:
        raise UserError(f"control points: expected {POINT_FIT.fewest_points} or more, got {len(uv)}")
    if np.linalg.svd(xyz - xyz.mean(axis=0), compute_uv=False)[1] < 1e-3:
        raise UserError("control points: they lie on one line")
    tried = [K] if K is not None else [centred(size, share * size[0]) for share in FOCAL_GRID]
    fits = [fit for intrinsics in tried if (fit := _posed(uv, xyz, size, intrinsics, lens)) is not None]
    if not fits:
        raise UserError("control points: no camera fits them; check for swapped points")
    best = min(fits, key=lambda fit: fit.rms_px)
    return replace(_refined(best, uv, xyz, focal=K is None), fitted_focal=K is None)


def centred(size: tuple[int, int], focal: float) -> Array:
    """Return (3, 3) intrinsics of a focal length in pixels, with a centred principal point."""
    return np.array([[focal, 0, size[0] / 2], [0, focal, size[1] / 2], [0, 0, 1.0]])


def _posed(uv: Array, xyz: Array, size: tuple[int, int], K: Array, distortion: Distortion) -> CameraFit | None:
    """Return the best pose for given intrinsics; None if there is none."""
    import cv2

    rays, valid = Camera(*size, K, np.eye(4), distortion).rays(uv)
    if not valid.all():
        raise UserError("control points: a pixel lies beyond what the distortion can undo")
    middle = xyz.mean(axis=0)
    try:
        _, turns, shifts, _ = cv2.solvePnPGeneric(
            xyz - middle, rays[:, :2].copy(), np.eye(3), None, flags=cv2.SOLVEPNP_SQPNP
        )
    except cv2.error:
        return None
    fits = []
    for turn, shift in zip(turns, shifts, strict=True):
        T = np.eye(4)
        T[:3, :3] = cv2.Rodrigues(turn)[0]
        T[:3, 3] = shift.ravel() - T[:3, :3] @ middle
        fit = _measured(Camera(*size, K, T, distortion), uv, xyz)
        if fit is not None:
            fits.append(fit)
    return min(fits, key=lambda fit: fit.rms_px, default=None)


def _measured(camera: Camera, uv: Array, xyz: Array) -> CameraFit | None:
    pixels, _, valid = camera.project(xyz)
    return CameraFit(camera, np.linalg.norm(pixels - uv, axis=1), xyz) if valid.all() else None


def _figures(camera: Camera) -> Array:
    """Return (4,) focal length (pixels), pitch and roll (radians), and z (metres)."""
    _, pitch, roll = camera.angles
    return np.array([camera.K[0, 0], pitch, roll, camera.position[2]])


def _refined(fit: CameraFit, uv: Array, xyz: Array, *, focal: bool) -> CameraFit:
    """Minimise the distances in the image over pose and (with `focal`) focal length, by Levenberg and Marquardt."""
    middle, weight = xyz.mean(axis=0), 1e-3
    residual, jacobian = _linearised(fit.camera, uv, xyz, middle, focal)
    for _ in range(200):
        if not np.isfinite(jacobian).all():  # a point lies at the limit of the lens model
            break
        normal = jacobian.T @ jacobian
        step = np.linalg.solve(normal + weight * np.diag(np.diag(normal) + 1e-12), -jacobian.T @ residual)
        moved = _measured(_moved(fit.camera, step.astype(np.float64), middle), uv, xyz)
        if moved is not None and moved.rms_px <= fit.rms_px:
            done = fit.rms_px - moved.rms_px < 1e-12 and weight < 1e-6
            fit, weight = moved, max(weight / 5, 1e-12)
            if done:
                break
            residual, jacobian = _linearised(fit.camera, uv, xyz, middle, focal)
        else:
            weight *= 5
            if weight > 1e9:
                break
    return fit


def _linearised(camera: Camera, uv: Array, xyz: Array, middle: Array, focal: bool) -> tuple[Array, Array]:
    """Return (2N,) residuals in pixels and their (2N, 6 or 7) derivatives."""
    residual = (camera.project(xyz)[0] - uv).ravel()
    distance = float(np.linalg.norm(camera.to_camera(middle)))
    columns = []
    for k in range(7 if focal else 6):
        step: Array = np.zeros(7 if focal else 6)
        step[k] = 1e-6 * (distance if 3 <= k < 6 else 1.0)
        ahead, behind = (_moved(camera, np.asarray(sign * step), middle).project(xyz)[0] for sign in (1, -1))
        columns.append((ahead - behind).ravel() / (2 * step[k]))
    return residual, np.stack(columns, axis=1)


def _moved(camera: Camera, step: Array, middle: Array) -> Camera:
    """Return a camera rotated by a small vector about the points' centre, shifted, and with a scaled focal length."""
    import cv2

    T = camera.T_camera_world.copy()
    u, _, v = np.linalg.svd(cv2.Rodrigues(step[:3])[0] @ T[:3, :3])
    shifted = T[:3, :3] @ middle + T[:3, 3] + step[3:6]
    T[:3, :3] = u @ v
    T[:3, 3] = shifted - T[:3, :3] @ middle
    K = camera.K.copy()
    if len(step) > 6:
        K[[0, 1], [0, 1]] *= math.exp(float(step[6]))
    return Camera(camera.width, camera.height, K, T, camera.distortion)
