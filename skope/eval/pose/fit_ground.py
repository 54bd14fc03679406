"""Where the road is, from the vehicles on it: the plane on which all of them are likely, the camera being known.

Each vehicle by itself, placed by its size alone, gives a rough point of the road; a plane through these starts the
search, and Nelder and Mead's simplex on the cost of full fits ends it, as for a camera (`skope.eval.pose.fit_camera`).
"""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from scipy.optimize import minimize

from skope.camera.model import Camera
from skope.errors import UserError
from skope.eval.pose.candidates import best_types
from skope.eval.pose.fit_camera import SampledVehicles, capped, sample
from skope.eval.pose.ground import Ground
from skope.eval.pose.observations import observe
from skope.eval.pose.shape_model import fleet_shapes
from skope.eval.pose.solver import levelled, locate
from skope.eval.pose.views import Scene
from skope.types import Array

_SLOPE: Final = 0.05
"""Standard deviation of a road's slope: 8% is steep."""
_STEPS: Final = np.array([0.2, 0.02, 0.02])
"""Steps in height (metres) and in the slopes along x and y: size of the first simplex."""
_UNEVEN: Final = (0.04, 0.08, 0.16, 0.32, 0.64)
"""Standard deviations of the road's height over its plane, metres, that are tried."""
_ROUNDS: Final = 5
"""Rounds of reweighting for the first plane."""
_VEHICLES: Final = 40
"""So many vehicles are used at most."""
_CLEAR: Final = 5.0
"""How much less a vehicle must contradict another plane (twice the log likelihood) before the level z = 0 is given up;
a road that is level is ahead by less than 1, one that lies a metre elsewhere behind by 20 and more."""


@dataclass(frozen=True)
class GroundFit:
    """A road that was fitted to vehicles; `ground.height_sigma` says how well it is known."""

    ground: Ground
    vehicles: int
    """How many vehicles it was fitted to."""


def with_fitted_ground(
    scene: Scene, asked: str, *, score: float, noise: float, sigma_px: float | None
) -> tuple[Scene, str | None]:
    """The scene with the road that its vehicles show, and a line that says so.

    `asked` is "fit" for always, "auto" for: where the vehicles clearly contradict the level plane that the scene has.
    """
    images = scene.file.images
    if scene.ground is None or not images:
        if asked == "fit" and images:
            raise UserError("--ground fit: needs a camera whose pose is known; `skope eval camera` finds both")
        return scene, None
    camera = scene.camera_of(images[0])
    if any(scene.camera_of(image).to_dict() != camera.to_dict() for image in images[1:]):
        if asked == "fit":
            raise UserError(
                f"{scene.file.name}: --ground fit: its images are of several cameras, which see other roads"
            )
        return scene, None
    try:
        vehicles = sample(scene, _VEHICLES, score=score, noise=noise, sigma_px=sigma_px)
    except UserError as error:
        if asked == "fit":
            raise UserError(f"--ground fit: {error}") from None
        return scene, None
    begun = _through_free_fits(vehicles, camera)
    gain = _cost(vehicles, camera, scene.ground) - _cost(vehicles, camera, begun)
    if asked == "auto" and gain < _CLEAR * len(vehicles.found):
        return scene, None
    fit = fit_ground(vehicles, camera, begun)
    return replace(scene, ground=fit.ground), _words(fit, asked)


def _words(fit: GroundFit, asked: str) -> str:
    ground = fit.ground
    why = "" if asked == "fit" else "the vehicles contradict a level road at z = 0 (--ground 0 insists on it): "
    rise, way = math.hypot(*ground.slope), math.degrees(math.atan2(ground.slope[1], ground.slope[0]))
    return (
        f"{why}road fitted to {fit.vehicles} vehicles: z = {ground.height:.2f} m at ({ground.about[0]:.1f}, "
        f"{ground.about[1]:.1f}), rising {rise:.1%} towards {way:.0f} deg, uneven by {ground.height_sigma:g} m"
    )


def fit_ground(vehicles: SampledVehicles, camera: Camera, begun: Ground) -> GroundFit:
    """The plane under `vehicles`, which `camera` sees, near `begun`; how far they lie off it is its `height_sigma`."""
    at = np.array([begun.height, *begun.slope])
    for size in (_STEPS, _STEPS / 4):  # a simplex that has gone flat starts again
        found = minimize(
            lambda x: _cost(vehicles, camera, _placed(begun, x)) + float((x[1:] ** 2).sum()) / _SLOPE**2,
            at,
            method="Nelder-Mead",
            options={
                "initial_simplex": np.concatenate([at[None], at + np.diag(size)]),
                "maxfev": 60,
                "xatol": 1e-4,
                "fatol": 1e-2,
            },
        )
        at = np.asarray(found.x)
    ground = _placed(begun, at)
    ground = replace(ground, height_sigma=_unevenness(vehicles, camera, ground))
    return GroundFit(ground, len(vehicles.found))


def _placed(like: Ground, at: Array) -> Ground:
    return replace(like, height=float(at[0]), slope=(float(at[1]), float(at[2])))


def _cost(vehicles: SampledVehicles, camera: Camera, ground: Ground) -> float:
    level, flat = levelled(camera, ground)
    seen = observe(level, vehicles.found, vehicles.sigma_px)
    return float(capped(best_types(seen, fleet_shapes(), flat).cost[:, 0]).sum())


def _through_free_fits(vehicles: SampledVehicles, camera: Camera) -> Ground:
    """A plane through the places that vehicles have by their size alone, those far from it counting less and less."""
    poses = locate(camera, vehicles.found, sigma_px=vehicles.sigma_px, ground=None)
    good = np.array([reason is None for reason in poses.refusal])
    if good.sum() >= len(_STEPS):
        points, sigma = poses.position[good], np.sqrt(np.maximum(poses.covariance[good, 2, 2], 0.01))
    else:
        points, sigma = poses.position, np.ones(len(poses.position))
    middle = np.median(points[:, :2], axis=0)
    A = np.column_stack([np.ones(len(points)), points[:, :2] - middle])
    prior = np.diag([0.0, 1.0, 1.0]) / _SLOPE**2
    weight = 1 / sigma**2
    at = np.zeros(3)
    for _ in range(_ROUNDS):
        normal = (A.T * weight) @ A + prior
        at = np.linalg.solve(normal, (A.T * weight) @ points[:, 2])
        weight = 1 / (sigma**2 + (A @ at - points[:, 2]) ** 2)
    return _placed(
        Ground(height_sigma=_UNEVEN[2], tilt_sigma=math.radians(1.5), about=(float(middle[0]), float(middle[1]))), at
    )


def _unevenness(vehicles: SampledVehicles, camera: Camera, ground: Ground) -> float:
    """The `height_sigma` under which the vehicles are likeliest, whatever their poses (Laplace's approximation)."""

    def surprise(sigma: float) -> float:
        level, flat = levelled(camera, replace(ground, height_sigma=sigma))
        fits = best_types(observe(level, vehicles.found, vehicles.sigma_px), fleet_shapes(), flat)
        _, spread = np.linalg.slogdet(fits.normal[:, 0])
        return float((capped(fits.cost[:, 0]) + spread).sum() + 2 * len(spread) * math.log(sigma))

    return min(_UNEVEN, key=surprise)
