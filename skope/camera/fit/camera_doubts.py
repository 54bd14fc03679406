"""Whether a camera that was worked out from vehicles holds together; if not, why not, in a sentence."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, RAY_LIMITS, camera_of_unknowns, on_road
from skope.camera.fit.fit_camera import CameraEstimate, gain_of_pixel_width
from skope.camera.uncertain_camera import slopes
from skope.confidence_level import INTERVAL_SIGMAS
from skope.pose.fit_body_types import INLIER_VARIANCES
from skope.types import Array


@dataclass(frozen=True)
class DoubtLimits:
    """Limits beyond which a camera found from vehicles is rejected."""

    least_agreement: float = 0.92
    """Smallest share of the visible keypoints that must agree. Correct cameras have 0.95 to 1."""
    unevenness_sigmas: float = 0.6
    """Largest median distance of views from the road, in standard deviations."""
    distance_sigma: float = 0.12
    """Relative standard deviation of distances on the road from which a camera is useless."""
    focal_sigma: float = 0.3
    """Relative standard deviation of the focal length from which a camera is useless."""
    likelihood_gap: float = 6.0
    """A camera that is behind by less (twice the log likelihood) may be the right one."""
    different_distance: float = 0.1
    """Relative difference of distances on the road that makes another camera."""
    squeezed_aspect: float = 4 / 3
    """Width of a pixel over its height where a recorder has squeezed a wide image to 4:3."""
    squeezed_gap: float = 30.0
    """Gain of likelihood (twice the logarithm) from which pixels are taken as squeezed."""
    heading_gap_rad: float = math.radians(6.0)
    """Median angle between direction of travel and heading from which the road is not a plane or the camera is
    wrong."""
    least_travel_m: float = 3.0
    """Least distance between two views that gives a direction of travel, metres."""
    fewest_directions: int = 5
    """Smallest number of such directions."""
    above_horizon: float = 0.05
    """Largest share of vehicles whose lower edge lies above the horizon."""
    segment_m: float = 2.0
    """Length of the segments of road by which distances are compared, metres."""


DOUBT_LIMITS: Final = DoubtLimits()


def rejection_reason(estimate: CameraEstimate, lower_edges: Array) -> str | None:
    """The first reason why an estimated camera is not to be trusted, as part of a sentence; None: it holds together.

    Args:
        estimate: The camera, with the vehicles that it was fitted to.
        lower_edges: (P, 2) pixels of the middles of the lower edges of all boxes that were found.
    """
    tests: Sequence[Callable[[], str | None]] = (
        lambda: _disagreement(estimate),
        lambda: _uneven(estimate),
        lambda: _over_the_horizon(estimate, lower_edges),
        lambda: _unknown(estimate),
        lambda: _as_likely(estimate),
        lambda: _sideways(estimate),
        lambda: _squeezed(estimate),
    )
    return next((words for test in tests if (words := test()) is not None), None)


def sigma_of_ways(estimate: CameraEstimate) -> float:
    """Relative standard deviation of ways that the vehicles go on the road, at the ninth in ten of their places."""
    J = slopes(lambda unknowns: _log_ways(estimate, unknowns), estimate.solved.bundle.camera, RAY_LIMITS.step)
    variance = np.einsum("bi,ij,bj->b", J, estimate.covariance, J)
    return float(np.sqrt(np.percentile(variance, 90)))


def _disagreement(estimate: CameraEstimate) -> str | None:
    solved = estimate.solved
    share = float((solved.squared <= INLIER_VARIANCES)[solved.counted].mean())
    if share >= DOUBT_LIMITS.least_agreement:
        return None
    return (
        f"under the likeliest one {1 - share:.0%} of their keypoints lie where they cannot: the road is no plane, the "
        "lens bends straight lines much, or the detector is wrong here"
    )


def _uneven(estimate: CameraEstimate) -> str | None:
    if estimate.unevenness <= DOUBT_LIMITS.unevenness_sigmas:
        return None
    return "the vehicles do not stand on one plane, or the lens bends straight lines more than one coefficient says"


def _over_the_horizon(estimate: CameraEstimate, lower_edges: Array) -> str | None:
    rays, valid = estimate.camera.rays(lower_edges)
    up = (rays @ estimate.camera.T_camera_world[:3, 2])[valid]
    share = float((up > 0).mean()) if up.size else 0.0
    if share <= DOUBT_LIMITS.above_horizon:
        return None
    return f"under the likeliest one {share:.0%} of all vehicles would stand above the horizon"


def _unknown(estimate: CameraEstimate) -> str | None:
    ways, focal = sigma_of_ways(estimate), math.sqrt(estimate.covariance[FOCAL, FOCAL])
    if ways <= DOUBT_LIMITS.distance_sigma and focal <= DOUBT_LIMITS.focal_sigma:
        return None
    return (
        f"distances along the road are known within {INTERVAL_SIGMAS * ways:.0%}, the focal length within "
        f"{INTERVAL_SIGMAS * focal:.0%} (90%); vehicles in other places and directions may tell more"
    )


def _as_likely(estimate: CameraEstimate) -> str | None:
    rival, best = estimate.rival, estimate.solved.bundle.camera
    if rival is None or rival.behind > DOUBT_LIMITS.likelihood_gap:
        return None
    apart = float(np.median(np.abs(_log_ways(estimate, rival.unknowns) - _log_ways(estimate, best))))
    if apart <= DOUBT_LIMITS.different_distance:
        return None
    heights = sorted(math.exp(unknowns[HEIGHT]) for unknowns in (best, rival.unknowns))
    return f"two are about as likely, {heights[0]:.1f} m and {heights[1]:.1f} m over the road"


def _sideways(estimate: CameraEstimate) -> str | None:
    bundle, vehicle = estimate.solved.bundle, estimate.views.vehicle
    places = bundle.pose[:, :2] * math.exp(bundle.camera[HEIGHT])
    order = np.argsort(vehicle, kind="stable")
    same = vehicle[order][1:] == vehicle[order][:-1]
    way = places[order][1:] - places[order][:-1]
    heading = np.exp(1j * bundle.pose[order, 2])
    middle = heading[1:] + heading[:-1]
    told = same & (np.linalg.norm(way, axis=1) > DOUBT_LIMITS.least_travel_m) & (np.abs(middle) > 1)
    if told.sum() < DOUBT_LIMITS.fewest_directions:
        return None
    turn = np.angle((way[told, 0] + 1j * way[told, 1]) * np.conj(middle[told]))
    away = np.minimum(np.abs(turn), math.pi - np.abs(turn))  # who heads the other way is turned around, not aside
    if np.median(away) <= DOUBT_LIMITS.heading_gap_rad:
        return None
    return f"under the likeliest one vehicles move {math.degrees(np.median(away)):.0f} degrees aside of where they head"


def _squeezed(estimate: CameraEstimate) -> str | None:
    if gain_of_pixel_width(estimate, DOUBT_LIMITS.squeezed_aspect) <= DOUBT_LIMITS.squeezed_gap:
        return None
    return (
        f"the vehicles fit better if a pixel is {DOUBT_LIMITS.squeezed_aspect:.2f} times as wide as high: bring "
        f"the images to the shape that the camera saw"
    )


def _log_ways(estimate: CameraEstimate, unknowns: Array) -> Array:
    """(B,) logarithms of the lengths, under a camera, of ways in the image that begin at each view and lead ahead."""
    bundle, size = estimate.solved.bundle, estimate.views.size
    begin = np.column_stack([bundle.pose[:, :2] * math.exp(bundle.camera[HEIGHT]), np.zeros(len(bundle.pose))])
    heading = bundle.pose[:, 2]
    end = begin + DOUBT_LIMITS.segment_m * np.column_stack([np.cos(heading), np.sin(heading), np.zeros_like(heading)])
    camera = camera_of_unknowns(unknowns, size)
    a, b = (on_road(camera, estimate.camera.project(points)[0]) for points in (begin, end))
    return np.asarray(np.log(np.linalg.norm(b - a, axis=1) + 1e-9))
