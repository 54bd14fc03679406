"""Fit the plane of the road to the vehicles on it, with a known camera.

Each vehicle alone, located by its size, gives a rough point of the road. A plane through these points starts the
search. A bundle adjustment of road and vehicles completes it, as for a camera (`skope.camera.fit.fit_camera`).
"""

import math
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from skope.camera.fit.bundle_adjustment import BundleAdjustment, Known, Solved, VehicleViews
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, camera_of_unknowns
from skope.camera.fit.fit_camera import capped
from skope.camera.fit.vehicle_sample import sample_vehicles
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.dataset.image_selection import part
from skope.errors import UserError
from skope.files.json_files import json_bytes
from skope.pose.estimate_pose import estimate_poses, levelled
from skope.pose.fit_body_types import best_types
from skope.pose.keypoint_views import Scene
from skope.pose.observations import observe
from skope.schema import Image
from skope.terminal.console import counted
from skope.types import Array


@dataclass(frozen=True)
class GroundSearch:
    """Prior and limits of the search for the road's plane."""

    slope_sigma: float = 0.05
    """Prior standard deviation of a road's slope. A slope of 0.08 is steep."""
    lowest_camera_m: float = 0.5
    """Minimum height of the camera over the road at the start of the search, metres."""
    fewest_vehicles: int = 3
    """Minimum number of vehicles; fewer than for an unknown camera, because each vehicle contributes more."""
    fewest_places: int = 3
    """Minimum number of positions for a plane."""
    tried_sigmas_m: tuple[float, ...] = (0.04, 0.08, 0.16, 0.32, 0.64)
    """Candidate standard deviations of the road's height over its plane, metres."""
    weight_rounds: int = 5
    """Number of reweighting rounds for the first plane."""
    most_vehicles: int = 40
    """Maximum number of vehicles that are used."""
    clear_gap: float = 5.0
    """Minimum gain in twice the log likelihood of the views at which a fitted plane replaces the plane z = 0."""


GROUND_SEARCH: Final = GroundSearch()


@dataclass(frozen=True)
class GroundFit:
    """Road plane fitted to vehicles; `ground.height_sigma` is the deviation of the vehicles from the plane."""

    ground: Ground
    vehicles: int
    """Number of vehicles used in the fit."""


def with_fitted_ground(
    scene: Scene, asked: str, *, score: float, noise: float, sigma_px: float | None
) -> tuple[Scene, str | None]:
    """Return the scene with the road fitted to its vehicles, and a line that reports it.

    If the images are from several cameras, each has its own road.

    Args:
        scene: Vehicles, and the initial level plane.
        asked: "fit": always; "auto": only if the vehicles clearly contradict that plane.
        score: Minimum score of detections.
        noise: Standard deviation of the noise that is added to labelled keypoints, pixels.
        sigma_px: Standard deviation of a keypoint, pixels; None as in `Scene.views`.

    Raises:
        UserError: "fit" was requested, and the vehicles do not determine the road.
    """
    if scene.ground is None or not scene.file.images:
        if asked == "fit" and scene.file.images:
            raise UserError("--ground fit: needs a camera with a known pose; `skope eval camera` finds both")
        return scene, None
    asking: dict[str, Any] = {"score": score, "noise": noise, "sigma_px": sigma_px}
    calibrated = scene.calibrated_part()  # a camera that was turned sees the same road
    if not calibrated.file.images:  # the camera was moved before the footage
        return scene, None
    cameras = _images_of_cameras(calibrated)
    if len(cameras) > 1:
        if asked == "fit":
            raise UserError(
                f"{scene.file.name}: --ground fit: its images are of several cameras, which see other roads"
            )
        return _with_roads(scene, cameras, asking)
    try:
        fit = _fit(calibrated, asked, **asking)
    except UserError as error:
        if asked == "fit":
            raise UserError(f"--ground fit: {error}") from None
        return scene, None
    return (replace(scene, ground=fit.ground), _words(fit, asked)) if fit else (scene, None)


def _images_of_cameras(scene: Scene) -> list[list[Image]]:
    """Group the images by their camera. Every image must contain a camera."""
    groups: dict[bytes, list[Image]] = {}
    for image in scene.file.images:
        groups.setdefault(json_bytes(scene.camera_of(image).to_dict()), []).append(image)
    return list(groups.values())


def _with_roads(scene: Scene, cameras: list[list[Image]], asking: dict[str, Any]) -> tuple[Scene, str | None]:
    """Return the scene with the roads of the cameras with vehicles that contradict the level plane, and a line on it.

    If the vehicles of any camera contradict the plane, the road of a camera with too few vehicles is unknown.
    """
    roads: dict[int, Ground | None] = {}
    contradicting, unclear = 0, list[Image]()
    for images in cameras:
        try:
            fit = _fit(replace(scene, file=part(scene.file, images)), "auto", **asking)
        except UserError:
            unclear += images
            continue
        if fit:
            contradicting += 1
            roads |= {image.id: fit.ground for image in images}
    if not contradicting:
        return scene, None
    roads |= {image.id: None for image in unclear}
    words = (
        f"{scene.file.name}: the vehicles of {contradicting} of {len(cameras)} cameras contradict a level road at "
        "z = 0 (--ground 0 insists on it): each of these has a road that was fitted to its vehicles"
    )
    if unclear:
        words += f"; {counted(len(unclear), 'image')} of others have too few vehicles: distances by size"
    return replace(scene, roads=roads), words


def _fit(scene: Scene, asked: str, *, score: float, noise: float, sigma_px: float | None) -> GroundFit | None:
    """Return the road of a scene with one camera; None for "auto" if its vehicles agree with the scene's road.

    Raises UserError if too few vehicles show enough keypoints.
    """
    assert scene.ground is not None
    camera = scene.camera_of(scene.file.images[0])
    views = sample_vehicles(
        scene,
        GROUND_SEARCH.most_vehicles,
        score=score,
        noise=noise,
        sigma_px=sigma_px,
        fewest=GROUND_SEARCH.fewest_vehicles,
    ).views
    begun = _through_free_fits(views, camera)
    if asked == "auto":
        level, fitted = (_adjusted(views, camera, ground, free=False).cost for ground in (scene.ground, begun))
        if level - fitted < GROUND_SEARCH.clear_gap * len(views.found):
            return None
    return fit_ground(views, camera, begun)


def _words(fit: GroundFit, asked: str) -> str:
    ground = fit.ground
    why = "" if asked == "fit" else "the vehicles contradict a level road at z = 0 (--ground 0 insists on it): "
    rise, way = math.hypot(*ground.slope), math.degrees(math.atan2(ground.slope[1], ground.slope[0]))
    return (
        f"{why}road fitted to {fit.vehicles} vehicles: z = {ground.height:.2f} m at ({ground.about[0]:.1f}, "
        f"{ground.about[1]:.1f}), rising {rise:.1%} towards {way:.0f} deg, uneven by {ground.height_sigma:g} m"
    )


def fit_ground(views: VehicleViews, camera: Camera, begun: Ground) -> GroundFit:
    """Fit a plane under vehicles; its `height_sigma` is the deviation of the vehicles from the plane.

    Args:
        views: Keypoints of the vehicles.
        camera: The camera that sees them, with its pose.
        begun: The plane near which the search begins.
    """
    solved = _adjusted(views, camera, begun, free=True)
    ground = _plane(camera, solved.bundle.camera, begun)
    ground = replace(ground, height_sigma=_unevenness(views, camera, ground))
    return GroundFit(ground, views.count)


def _adjusted(views: VehicleViews, camera: Camera, ground: Ground, *, free: bool) -> Solved:
    """Return the most likely vehicles on a road under a known camera; with `free`, the road is adjusted too."""
    focal = math.sqrt(camera.K[0, 0] * camera.K[1, 1])
    level, _ = levelled(camera, ground)
    at = np.array(
        [math.log(focal), *level.angles[1:], math.log(max(level.position[2], GROUND_SEARCH.lowest_camera_m)), 0.0]
    )
    center = np.array([at[FOCAL], *camera.angles[1:], 0.0, 0.0])
    slope = math.atan(GROUND_SEARCH.slope_sigma)
    sigma = np.array([0.0, slope, slope, np.inf, 0.0]) if free else np.zeros(len(at))
    rays, valid = camera.rays(views.found[..., :2])
    ideal = rays[..., :2] * focal + np.array(views.size) / 2
    found = np.concatenate([ideal, np.where(valid, views.found[..., 2], 0.0)[..., None]], axis=-1)
    adjustment = BundleAdjustment(replace(views, found=found), Known(center, sigma))
    return adjustment.refined(adjustment.begun(at))


def _plane(camera: Camera, unknowns: Array, like: Ground) -> Ground:
    """Return the road of a bundle adjustment's result, in the world of the camera."""
    upright = camera_of_unknowns(unknowns, (camera.width, camera.height)).T_camera_world[:3, 2]
    x, y, z = camera.T_camera_world[:3, :3].T @ upright
    slope = (-x / z, -y / z)
    away = np.array(like.about) - camera.position[:2]
    height = camera.position[2] - math.exp(unknowns[HEIGHT]) / z + float(np.dot(slope, away))
    return replace(like, height=float(height), slope=(float(slope[0]), float(slope[1])))


def _through_free_fits(views: VehicleViews, camera: Camera) -> Ground:
    """Fit a plane robustly through the positions that vehicles have from their size alone."""
    poses = estimate_poses(camera, views.found, sigma_px=views.sigma_px, ground=None, shapes=views.shapes)
    good = np.array([reason is None for reason in poses.refusal])
    if good.sum() >= GROUND_SEARCH.fewest_places:
        points, sigma = poses.position[good], np.sqrt(np.maximum(poses.covariance[good, 2, 2], 0.01))
    else:
        points, sigma = poses.position, np.ones(len(poses.position))
    middle = np.median(points[:, :2], axis=0)
    A = np.column_stack([np.ones(len(points)), points[:, :2] - middle])
    prior = np.diag([0.0, 1.0, 1.0]) / GROUND_SEARCH.slope_sigma**2
    weight = 1 / sigma**2
    at = np.zeros(3)
    for _ in range(GROUND_SEARCH.weight_rounds):
        normal = (A.T * weight) @ A + prior
        at = np.linalg.solve(normal, (A.T * weight) @ points[:, 2])
        weight = 1 / (sigma**2 + (A @ at - points[:, 2]) ** 2)
    return Ground(
        height=float(at[0]),
        height_sigma=GROUND_SEARCH.tried_sigmas_m[2],
        tilt_sigma=math.radians(1.5),
        slope=(float(at[1]), float(at[2])),
        about=(float(middle[0]), float(middle[1])),
    )


def _unevenness(views: VehicleViews, camera: Camera, ground: Ground) -> float:
    """Return the most likely `height_sigma` of the vehicles, integrated over their poses (Laplace's approximation)."""

    def surprise(sigma: float) -> float:
        level, flat = levelled(camera, replace(ground, height_sigma=sigma))
        fits = best_types(observe(level, views.found, views.sigma_px), views.shapes, flat)
        _, spread = np.linalg.slogdet(fits.normal[:, 0])
        return float((capped(fits.cost[:, 0]) + spread).sum() + 2 * len(spread) * math.log(sigma))

    return min(GROUND_SEARCH.tried_sigmas_m, key=surprise)
