"""Focal length, height and tilt of a camera from vehicles on the road before it, whose sizes are roughly known.

The right camera is the one under which all vehicles are likely: shapes as vehicles have them, wheels on one plane.
A grid of cameras is judged by the closed-form starts of `skope.eval.pose.initialize`, the best few are refined by
Nelder and Mead's simplex on the cost of full fits, and how differently single vehicles pull tells the uncertainty.
Place and direction on the map cannot be known so: the camera hangs over (0, 0) and looks along x.
"""

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import minimize

from skope.camera.model import Camera
from skope.errors import UserError
from skope.eval.pose import initialize
from skope.eval.pose.candidates import best_types
from skope.eval.pose.ground import Ground
from skope.eval.pose.observations import LEAST_PROBABILITY, observe
from skope.eval.pose.shape_model import fleet_shapes
from skope.eval.pose.views import Scene
from skope.types import Array

FEWEST: Final = 5
"""Vehicles a camera needs."""
_POINTS: Final = 8
"""Keypoints a vehicle must show."""
_EDGE: Final = 40.0
"""Pixels that a vehicle's box must measure along its longer edge."""
_GROUND: Final = Ground(height_sigma=0.03, tilt_sigma=math.radians(0.7))
_FOCAL: Final = np.geomspace(0.33, 3.0, 12)
"""Focal lengths of the grid, as multiples of the image's width: fields of view from 113 to 19 degrees."""
_PITCH: Final = np.radians([3, 7, 12, 18, 25, 33, 42, 55])
"""Tilts of the grid, downwards."""
_HEIGHT: Final = (4.0, 5.5, 7.5, 10.0, 14.0, 20.0)
"""Heights of the grid over the road, metres."""
_REFINED: Final = 3
"""How many cameras of the grid, the best, are refined."""
_STEPS: Final = np.array([0.02, math.radians(0.5), math.radians(0.5), 0.02])
"""Steps in log focal length, pitch, roll and log height: size of the first simplex, and basis of the differences that
tell the uncertainty."""
_CAP: Final = 150.0
"""What a vehicle can cost at most, so that a false detection does not decide."""
_MODEL_SIGMA: Final = 0.02
"""Relative error of focal length and height that stays with many vehicles: fleets differ from the shape space."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """A camera that was estimated from vehicles, with the standard deviations of what was estimated."""

    camera: Camera
    vehicles: int
    """How many vehicles it was fitted to."""
    sigma_focal: float
    """Standard deviation of the focal length, pixels."""
    sigma_pitch: float
    """Standard deviation of the tilt, radians."""
    sigma_roll: float
    """Standard deviation of the roll, radians."""
    sigma_height: float
    """Standard deviation of the height over the road, metres."""


@dataclass(frozen=True, eq=False)
class SampledVehicles:
    """N vehicles that a camera or road is fitted to, in images of one size."""

    found: Array
    """(N, 33, 3) keypoints: x, y in pixels, probability."""
    sigma_px: Array
    """(N,) standard deviation of a keypoint of probability 1, pixels."""
    size: tuple[int, int]
    """Width and height of the images, pixels."""


def sample(scene: Scene, count: int, *, score: float, noise: float, sigma_px: float | None) -> SampledVehicles:
    """Draw vehicles that show enough to fit a camera to, spread over the scene.

    Args:
        scene: Images of one camera, and the keypoints in them.
        count: At most so many vehicles.
        score: Detections above this are taken.
        noise: Standard deviation of the noise that is added to labelled keypoints, pixels.
        sigma_px: Standard deviation of a keypoint, pixels; None as in `Scene.views`.

    Raises:
        UserError: The images differ in size, or too few vehicles show enough.
    """
    if not scene.file.images:
        raise UserError(f"{scene.file.name}: no images")
    size = (scene.file.images[0].width, scene.file.images[0].height)

    def shown() -> Iterator[tuple[Array, float]]:
        for view in scene.views(score=score, noise=noise, sigma_px=sigma_px):
            if (view.image.width, view.image.height) != size:
                raise UserError(f"{scene.file.name}: {view.image.file_name}: images of one camera have one size")
            large = view.boxes[:, 2:].max(axis=1, initial=0) >= _EDGE
            good = large & ((view.found[..., 2] > LEAST_PROBABILITY).sum(axis=1) >= _POINTS)
            yield from zip(view.found[good], view.sigma_px[good].tolist(), strict=True)

    many = sum(1 for _ in shown())  # an hour of footage shows more than fits into memory
    if many < FEWEST:
        raise UserError(
            f"{scene.file.name}: {many} vehicles show {_POINTS} keypoints on {_EDGE:g} px or more; a camera "
            f"needs {FEWEST}"
        )
    chosen = set(np.random.default_rng(0).permutation(many)[:count].tolist())
    taken = [one for i, one in enumerate(shown()) if i in chosen]
    return SampledVehicles(np.array([found for found, _ in taken]), np.array([sigma for _, sigma in taken]), size)


def fit_camera(vehicles: SampledVehicles) -> CameraEstimate:
    """Estimate focal length, height, tilt and roll of the camera that took the vehicles.

    The lens is taken to be without distortion, and the principal point to be the image's middle.

    Args:
        vehicles: Keypoints of vehicles that stand on one level road.

    Returns:
        The camera under which the vehicles are most likely, over (0, 0) and looking along x, and how certain it is.
    """
    # Every camera of the grid, as the four unknowns: log focal length, pitch, roll, log height.
    grid = [
        np.array([math.log(f * vehicles.size[0]), pitch, 0.0, math.log(height)])
        for f, pitch, height in itertools.product(_FOCAL, _PITCH, _HEIGHT)
    ]
    # Judge all by closed-form starts, refine the best few by full fits, keep the likeliest.
    begun = sorted(grid, key=lambda at: _start_cost(vehicles, at))[:_REFINED]
    fits = [_refined(vehicles, at) for at in begun]
    best = min(fits, key=lambda at: _cost(vehicles, at))
    # Deviations of logarithms are relative ones.
    sigma = _uncertainty(vehicles, best)
    focal, height = math.exp(best[0]), math.exp(best[3])
    return CameraEstimate(
        camera=_camera(vehicles.size, best),
        vehicles=len(vehicles.found),
        sigma_focal=focal * float(sigma[0]),
        sigma_pitch=float(sigma[1]),
        sigma_roll=float(sigma[2]),
        sigma_height=height * float(sigma[3]),
    )


def _camera(size: tuple[int, int], at: Array) -> Camera:
    """The camera with the four unknowns `at` (log focal length in pixels, pitch, roll, log height in metres)."""
    fov = 2 * math.atan(size[0] / 2 / math.exp(at[0]))
    return Camera.looking([0, 0, math.exp(at[3])], yaw=0, pitch_down=at[1], roll=at[2], size=size, fov=fov)


def _start_cost(vehicles: SampledVehicles, at: Array) -> float:
    """Cost of a camera by the closed-form starts of its vehicles."""
    seen = observe(_camera(vehicles.size, at), vehicles.found, vehicles.sigma_px)
    return float(capped(initialize.on_ground(seen, fleet_shapes(), _GROUND).cost.min(axis=1)).sum())


def _costs(vehicles: SampledVehicles, at: Array) -> Array:
    """(N,) twice the negative log likelihood of each vehicle."""
    if not (3 < at[0] < 12 and -0.2 < at[1] < 1.4 and abs(at[2]) < 0.5 and 0 < at[3] < 5):
        return np.full(len(vehicles.found), _CAP)
    seen = observe(_camera(vehicles.size, at), vehicles.found, vehicles.sigma_px)
    return capped(best_types(seen, fleet_shapes(), _GROUND).cost[:, 0])


def _cost(vehicles: SampledVehicles, at: Array) -> float:
    """Cost of a camera by full fits of its vehicles."""
    return float(_costs(vehicles, at).sum())


def capped(cost: Array) -> Array:
    """Costs that level off at `_CAP`, still smooth."""
    return np.asarray(_CAP * np.tanh(np.minimum(cost, 1e6) / _CAP))


def _refined(vehicles: SampledVehicles, at: Array) -> Array:
    """The four unknowns of the likeliest camera near `at` (Nelder and Mead's simplex)."""
    simplex = np.concatenate([at[None], at + np.diag(4 * _STEPS)])
    for _ in range(2):  # a simplex that has gone flat starts again
        found = minimize(
            lambda x: _cost(vehicles, x),
            simplex[0],
            method="Nelder-Mead",
            options={"initial_simplex": simplex, "maxfev": 120, "xatol": 1e-4, "fatol": 1e-2},
        )
        simplex = np.concatenate([found.x[None], found.x + np.diag(_STEPS)])
    return np.asarray(found.x, dtype=np.float64)


def _uncertainty(vehicles: SampledVehicles, at: Array) -> Array:
    """(4,) standard deviations from how differently the vehicles pull: the outer product of their scores.

    Second differences of the cost would drown where vehicles change their body type; these never turn negative.
    """
    # Derivative of each vehicle's log likelihood (half its cost) by each unknown: (N, 4) scores.
    steps = np.diag(_STEPS / 4)
    slopes = [(_costs(vehicles, at + step) - _costs(vehicles, at - step)) / (2 * step.sum()) for step in steps]
    scores = np.stack(slopes, axis=1) / 2
    # Their outer product estimates the information matrix; `few` makes up for a small number of vehicles.
    few = len(scores) / max(1, len(scores) - len(at))
    scaled = scores * _STEPS  # numbers of like size
    variance = few * np.diag(np.linalg.pinv(scaled.T @ scaled)) * _STEPS**2
    return np.asarray(np.sqrt(variance + np.array([_MODEL_SIGMA, 0, 0, _MODEL_SIGMA]) ** 2))
