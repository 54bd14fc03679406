"""A camera with its uncertainty, and the resulting uncertainty of positions on the road."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import erf

from skope.camera.evidence import CameraPrior
from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.types import Array

CAMERA_PARAMETERS: Final = ("focal", "k1", "x", "y", "z", "pitch", "roll", "yaw")
"""Logarithm of the focal length in pixels, first coefficient of the radial distortion, position (metres), downward
pitch, roll and yaw (radians) of a camera.
"""
_NAMES_IN_FILES: Final = {"log_focal": "focal", "log_height": "z"}
"""Names in files of parameters estimated from vehicles. The logarithm of the height is converted to z."""
PARAMETER_STEPS: Final = dict(zip(CAMERA_PARAMETERS, (1e-5, 1e-5, 1e-4, 1e-4, 1e-4, 1e-6, 1e-6, 1e-6), strict=True))
"""Steps of numerical derivatives."""


@dataclass(frozen=True)
class UncertaintyLimits:
    """Settings for converting a camera's uncertainty to errors of positions and distances."""

    position_coverage: float = 0.9
    """Nominal coverage of the stated error of a position."""
    beside_m: float = 0.5
    """Half length of the segment over which the road's scale error is computed, metres."""
    near_m: float = 60.0
    """Maximum distance from the camera of positions used for the accuracy of distances, metres."""


UNCERTAINTY_LIMITS: Final = UncertaintyLimits()


@dataclass(frozen=True, eq=False)
class UncertainCamera:
    """Camera with a Gaussian error of its parameters.

    Raises UserError if the covariance is invalid, or a parameter name is unknown.
    """

    camera: Camera
    parameters: tuple[str, ...]
    """Names of the uncertain parameters, from `CAMERA_PARAMETERS`. Without points, the world's origin is under the
    camera and x
    points ahead of it."""
    covariance: Array
    """(P, P) covariance of `parameters`, in their units."""

    def __post_init__(self) -> None:
        unknown = [name for name in self.parameters if name not in CAMERA_PARAMETERS]
        if unknown or len(set(self.parameters)) < len(self.parameters):
            raise UserError(f"covariance: of: expected names among {', '.join(CAMERA_PARAMETERS)}, each once")
        matrix, count = np.asarray(self.covariance, dtype=np.float64), len(self.parameters)
        if matrix.shape != (count, count) or not np.isfinite(matrix).all():
            raise UserError(f"covariance: matrix: expected {count} rows of {count} finite numbers")
        scale = np.sqrt(np.abs(np.diag(matrix))) + 1e-12
        if np.abs((matrix - matrix.T) / np.outer(scale, scale)).max(initial=0) > 1e-6 or (
            np.linalg.eigvalsh(matrix / np.outer(scale, scale)).min(initial=0) < -1e-6
        ):
            raise UserError("covariance: matrix: expected a symmetric one without negative variances")
        object.__setattr__(self, "covariance", (matrix + matrix.T) / 2)

    @classmethod
    def from_dict(cls, camera: Camera, value: Mapping[str, Any]) -> "UncertainCamera":
        """Return the camera with the covariance {of, matrix} of a file."""
        names, rows = value.get("of"), value.get("matrix")
        if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
            raise UserError("covariance: of: expected a list of names")
        try:
            matrix = np.array(rows, dtype=np.float64).reshape(len(names), len(names))
        except (TypeError, ValueError, OverflowError):
            raise UserError(f"covariance: matrix: expected {len(names)} rows of {len(names)} finite numbers") from None
        units = np.array([camera.position[2] if name == "log_height" else 1.0 for name in names])
        return UncertainCamera(
            camera, tuple(str(_NAMES_IN_FILES.get(name, name)) for name in names), matrix * np.outer(units, units)
        )

    def covariance_dict(self) -> dict[str, Any]:
        """Return the covariance as JSON values {of, matrix}, which `from_dict` reads."""
        return {"of": list(self.parameters), "matrix": self.covariance.tolist()}

    def prior(self, name: str) -> CameraPrior:
        """Return the camera and its covariance as evidence for another calibration."""
        which = [CAMERA_PARAMETERS.index(parameter) for parameter in self.parameters]
        return CameraPrior(self.parameters, values_of(self.camera)[which], self.covariance, name)

    def of_camera(self, camera: Camera) -> "UncertainCamera":
        """Return the same uncertainty for `camera`, the same camera at another image size."""
        return UncertainCamera(camera, self.parameters, self.covariance)

    def widened(self, added: Mapping[tuple[str, ...], Array]) -> "UncertainCamera":
        """Return the camera with additional independent errors, given as covariances by parameter names."""
        names = tuple(name for name in CAMERA_PARAMETERS if any(name in part for part in (self.parameters, *added)))
        covariance = np.zeros((len(names), len(names)))
        for part, of_part in ((self.parameters, self.covariance), *added.items()):
            at = [names.index(name) for name in part]
            covariance[np.ix_(at, at)] += of_part
        return UncertainCamera(self.camera, names, covariance)

    # ---------------------------------------------------------------------------------------------------------- places

    def places(self, pixels: ArrayLike, height: float = 0.0) -> Array:
        """Return (..., 3) positions of pixels (..., 2) on the plane z = `height`, metres; NaN above the horizon."""
        return intersect_ground(self.camera, pixels, height)

    def place_covariance(self, pixels: ArrayLike, height: float = 0.0, sigma_px: float = 0.0) -> Array:
        """Return the covariance (..., 2, 2) of x and y of `places`, from the errors of camera and pixels.

        Args:
            pixels: (..., 2) pixels.
            height: z of the plane, metres.
            sigma_px: Standard deviation of the pixels per axis; 0: only the camera is uncertain.

        Returns:
            (..., 2, 2) square metres; NaN at or above the horizon.
        """
        uv = np.asarray(pixels, dtype=np.float64)
        J = self._by_parameters(uv, height=height)
        out = np.asarray(J @ self.covariance @ np.swapaxes(J, -1, -2))
        if sigma_px:
            J = slopes(lambda step: intersect_ground(self.camera, uv + step, height)[..., :2], np.zeros(2), 0.25)
            out = out + sigma_px**2 * J @ np.swapaxes(J, -1, -2)
        return out

    def place_error(self, pixels: ArrayLike, height: float = 0.0, sigma_px: float = 0.0) -> Array:
        """Return the radius (...,) around each of `places` that contains 90% of its error, metres; NaN if undefined.

        Args:
            pixels: (..., 2) pixels.
            height: z of the plane, metres.
            sigma_px: Standard deviation of the pixels per axis.
        """
        return radius_of(self.place_covariance(pixels, height, sigma_px), UNCERTAINTY_LIMITS.position_coverage)

    def covariance_at(self, places: ArrayLike, slope: ArrayLike = (0.0, 0.0)) -> Array:
        """Return the covariance (..., 2, 2) of positions (..., 3) on the road from the camera's error, square metres.

        `slope` is the road's rise per metre along x and y. NaN if the camera does not see a position.
        """
        J = self._by_parameters_at(np.asarray(places, dtype=np.float64), slope)
        return np.asarray(J @ self.covariance @ np.swapaxes(J, -1, -2))

    def covariance_of_velocities(
        self, places: ArrayLike, velocities: ArrayLike, slope: ArrayLike = (0.0, 0.0)
    ) -> Array:
        """Return the covariance (..., 2, 2) of velocities (..., 2) at positions (..., 3) from the camera's error.

        The camera's error scales and rotates the road around a position, and velocities with it.

        Args:
            places: (..., 3) world, metres.
            velocities: (..., 2) along world x and y, m/s.
            slope: (2,) rise of the road per metre along x and y.

        Returns:
            (..., 2, 2) in m²/s²; NaN if the camera does not see the position.
        """
        at, v = np.asarray(places, dtype=np.float64), np.asarray(velocities, dtype=np.float64)
        steps = UNCERTAINTY_LIMITS.beside_m * np.column_stack([np.eye(2), np.asarray(slope, dtype=np.float64)])
        beside = np.stack([at + steps[0], at - steps[0], at + steps[1], at - steps[1]])
        ahead_x, behind_x, ahead_y, behind_y = self._by_parameters_at(beside, slope)
        stretched = np.stack([ahead_x - behind_x, ahead_y - behind_y], axis=-1) / (2 * UNCERTAINTY_LIMITS.beside_m)
        V = (stretched @ v[..., None, :, None])[..., 0]
        return np.asarray(V @ self.covariance @ np.swapaxes(V, -1, -2))

    def distance_sigma(self) -> float:
        """Return the relative standard deviation of short distances on the road z = 0: the 90th percentile nearby."""
        u, v = np.meshgrid(*(np.linspace(0.05, 0.95, 9) * side for side in (self.camera.width, self.camera.height)))
        places = self.places(np.stack([u.ravel(), v.ravel()], axis=-1))
        near = np.linalg.norm(places[:, :2] - self.camera.position[:2], axis=1) < UNCERTAINTY_LIMITS.near_m
        shares = []
        for way in np.eye(2):
            C = self.covariance_of_velocities(places[near], np.tile(way, (int(near.sum()), 1)))
            along = np.sqrt(C @ way @ way)
            shares += along[np.isfinite(along)].tolist()
        return float(np.percentile(shares, 90)) if shares else 1.0

    def _by_parameters_at(self, places: Array, slope: ArrayLike) -> Array:
        """Return derivatives (..., 2, P) of positions (..., 3) on the road, at fixed pixels, by the parameters."""
        pixels, _, valid = self.camera.project(places)
        seen = np.where(valid[..., None], pixels, 0.0)
        J = self._by_parameters(seen, height=places[..., 2], about=places[..., :2], slope=slope)
        return np.where(valid[..., None, None], J, np.nan)

    def _by_parameters(self, pixels: Array, **plane: ArrayLike) -> Array:
        """Return (..., 2, P) derivatives of `intersect_ground` by the camera parameters."""
        steps = np.array([PARAMETER_STEPS[name] for name in self.parameters])

        def moved(step: Array) -> Array:
            camera = moved_camera(self.camera, dict(zip(self.parameters, (step * steps).tolist(), strict=True)))
            return intersect_ground(camera, pixels, **plane)[..., :2]  # type: ignore[arg-type]

        return np.asarray(slopes(moved, np.zeros(len(steps)), 1.0) / steps)


def camera_of_parameters(values: Array, size: tuple[int, int]) -> Camera:
    """Return the camera of values (8,) of `CAMERA_PARAMETERS`, with a centred principal point."""
    focal, k1, x, y, z, pitch, roll, yaw = values.tolist()
    lens = Distortion("brown", (k1, 0.0, 0.0, 0.0)) if k1 else Distortion()
    fov = 2 * math.atan(size[0] / 2 / math.exp(focal))
    return Camera.looking([x, y, z], yaw=yaw, pitch_down=pitch, roll=roll, size=size, fov=fov, distortion=lens)


def values_of(camera: Camera) -> Array:
    """Return (8,) values of `CAMERA_PARAMETERS` of a camera."""
    yaw, pitch, roll = camera.angles
    k1 = camera.distortion.coefficients[0] if camera.distortion.model != "none" else 0.0
    return np.array([math.log(camera.K[0, 0]), k1, *camera.position, pitch, roll, yaw])


def moved_camera(camera: Camera, steps: Mapping[str, float]) -> Camera:
    """Return a camera with `steps` added to its `CAMERA_PARAMETERS`; its other properties stay."""
    values = values_of(camera)
    for name, step in steps.items():
        values[CAMERA_PARAMETERS.index(name)] += step
    focal, k1, x, y, z, pitch, roll, yaw = values.tolist()
    lens = camera.distortion
    if k1 and "k1" in steps:
        coefficients = (0.0, 0.0, 0.0) if lens.model == "none" else lens.coefficients[1:]
        lens = Distortion("brown" if lens.model == "none" else lens.model, (k1, *coefficients))
    K = camera.K.copy()
    K[:2, :2] *= math.exp(focal) / K[0, 0]
    pose = Camera.looking([x, y, z], yaw=yaw, pitch_down=pitch, roll=roll).T_camera_world
    return replace(camera, K=K, T_camera_world=pose, distortion=lens)


def radius_of(covariance: ArrayLike, share: float) -> Array:
    """Return the radius (...,) of the circle that contains a share of a normal distribution with covariance (..., 2,
    2).

    Across the longer axis the share of a chord is an error function; along it, Gauss-Legendre quadrature is used.
    """
    C = np.asarray(covariance, dtype=np.float64)
    known = np.asarray(np.isfinite(C).all(axis=(-2, -1)))
    minor, major = np.moveaxis(np.linalg.eigvalsh(np.where(known[..., None, None], C, np.eye(2))), -1, 0)
    minor, major = np.sqrt(np.maximum(minor, 1e-24)), np.sqrt(np.maximum(major, 1e-24))
    node, weight = np.polynomial.legendre.leggauss(48)
    angle = node * np.pi / 2
    low, high = np.zeros_like(major), 6 * major
    for _ in range(40):
        radius = (low + high) / 2
        along, half = radius[..., None] * np.sin(angle), radius[..., None] * np.cos(angle)
        density = np.exp(-0.5 * (along / major[..., None]) ** 2) / (math.sqrt(2 * math.pi) * major[..., None])
        inside = (weight * density * half * erf(half / (math.sqrt(2) * minor[..., None]))).sum(axis=-1) * np.pi / 2
        low, high = np.where(inside < share, radius, low), np.where(inside < share, high, radius)
    return np.where(known, (low + high) / 2, np.nan)


def slopes(of: Callable[[Array], Array], at: Array, step: float) -> Array:
    """Differentiate a function of U numbers by central differences.

    Args:
        of: The function, from numbers (U,) to (...).
        at: (U,) the numbers at which to differentiate.
        step: Step to both sides in each number, in its unit.

    Returns:
        (..., U) derivatives, the numbers along the last axis.
    """
    return np.stack([(of(at + shift) - of(at - shift)) / (2 * step) for shift in step * np.eye(len(at))], axis=-1)
