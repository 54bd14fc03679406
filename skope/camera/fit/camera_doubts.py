"""Check whether a camera estimated from vehicles is plausible; if not, give the reason in a sentence."""

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
class RejectionLimits:
    """Limits beyond which a camera estimated from vehicles is rejected."""

    least_agreement: float = 0.92
    """Minimum share of the visible keypoints that must agree. Correct cameras have 0.95 to 1."""
    unevenness_sigmas: float = 0.6
    """Maximum median distance of views from the road, in standard deviations."""
    distance_sigma: float = 0.12
    """Maximum relative standard deviation of distances on the road."""
    focal_sigma: float = 0.3
    """Maximum relative standard deviation of the focal length."""
    likelihood_gap: float = 6.0
    """Difference of twice the log likelihood below which a second candidate camera may be the correct one."""
    different_distance: float = 0.1
    """Relative difference of distances on the road above which two candidate cameras count as different."""
    squeezed_aspect: float = 4 / 3
    """Ratio of width to height of a pixel if a recorder has squeezed a wide image to 4:3."""
    squeezed_gap: float = 30.0
    """Minimum gain in twice the log likelihood at which pixels are taken as squeezed."""
    heading_gap_rad: float = math.radians(6.0)
    """Maximum median angle between direction of travel and heading. A larger angle shows that the road is not a plane
    or the estimated camera is wrong."""
    least_travel_m: float = 3.0
    """Minimum distance between two views that gives a direction of travel, metres."""
    fewest_directions: int = 5
    """Minimum number of such directions."""
    above_horizon: float = 0.05
    """Maximum share of vehicles with a lower edge above the horizon."""
    segment_m: float = 2.0
    """Length of the road segments over which distances are compared, metres."""


REJECTION_LIMITS: Final = RejectionLimits()


def rejection_reason(estimate: CameraEstimate, lower_edges: Array) -> str | None:
    """Return the first reason to reject an estimated camera, as part of a sentence; None for a plausible one.

    Args:
        estimate: The camera, with the vehicles that were used.
        lower_edges: (P, 2) pixels of the middles of the lower edges of all detected boxes.
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
    """Return the relative standard deviation of distances along headings: the 90th percentile of the views."""
    J = slopes(lambda unknowns: _log_ways(estimate, unknowns), estimate.solved.bundle.camera, RAY_LIMITS.step)
    variance = np.einsum("bi,ij,bj->b", J, estimate.covariance, J)
    return float(np.sqrt(np.percentile(variance, 90)))


def _disagreement(estimate: CameraEstimate) -> str | None:
    solved = estimate.solved
    share = float((solved.squared <= INLIER_VARIANCES)[solved.counted].mean())
    if share >= REJECTION_LIMITS.least_agreement:
        return None
    return (
        f"under the most likely one {1 - share:.0%} of their keypoints are impossible: the road is not a plane, the "
        "lens bends straight lines much, or the detector is wrong here"
    )


def _uneven(estimate: CameraEstimate) -> str | None:
    if estimate.unevenness <= REJECTION_LIMITS.unevenness_sigmas:
        return None
    return "the vehicles do not stand on one plane, or the lens distortion needs more than one coefficient"


def _over_the_horizon(estimate: CameraEstimate, lower_edges: Array) -> str | None:
    rays, valid = estimate.camera.rays(lower_edges)
    up = (rays @ estimate.camera.T_camera_world[:3, 2])[valid]
    share = float((up > 0).mean()) if up.size else 0.0
    if share <= REJECTION_LIMITS.above_horizon:
        return None
    return f"under the most likely one {share:.0%} of all vehicles would stand above the horizon"


def _unknown(estimate: CameraEstimate) -> str | None:
    ways, focal = sigma_of_ways(estimate), math.sqrt(estimate.covariance[FOCAL, FOCAL])
    if ways <= REJECTION_LIMITS.distance_sigma and focal <= REJECTION_LIMITS.focal_sigma:
        return None
    return (
        f"distances along the road are known within {INTERVAL_SIGMAS * ways:.0%}, the focal length within "
        f"{INTERVAL_SIGMAS * focal:.0%} (90%); vehicles in other positions and directions may help"
    )


def _as_likely(estimate: CameraEstimate) -> str | None:
    rival, best = estimate.rival, estimate.solved.bundle.camera
    if rival is None or rival.behind > REJECTION_LIMITS.likelihood_gap:
        return None
    apart = float(np.median(np.abs(_log_ways(estimate, rival.unknowns) - _log_ways(estimate, best))))
    if apart <= REJECTION_LIMITS.different_distance:
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
    has_direction = same & (np.linalg.norm(way, axis=1) > REJECTION_LIMITS.least_travel_m) & (np.abs(middle) > 1)
    if has_direction.sum() < REJECTION_LIMITS.fewest_directions:
        return None
    turn = np.angle((way[has_direction, 0] + 1j * way[has_direction, 1]) * np.conj(middle[has_direction]))
    away = np.minimum(np.abs(turn), math.pi - np.abs(turn))  # an opposite heading is a front-rear swap, not an error
    if np.median(away) <= REJECTION_LIMITS.heading_gap_rad:
        return None
    return f"under the most likely one vehicles move at {math.degrees(np.median(away)):.0f} degrees to their headings"


def _squeezed(estimate: CameraEstimate) -> str | None:
    if gain_of_pixel_width(estimate, REJECTION_LIMITS.squeezed_aspect) <= REJECTION_LIMITS.squeezed_gap:
        return None
    return (
        f"the vehicles fit better if a pixel is {REJECTION_LIMITS.squeezed_aspect:.2f} times as wide as high: rescale "
        f"the images to the shape that the camera saw"
    )


def _log_ways(estimate: CameraEstimate, unknowns: Array) -> Array:
    """Return (B,) logarithms of the road lengths, under a camera, of image segments that begin at each view."""
    bundle, size = estimate.solved.bundle, estimate.views.size
    begin = np.column_stack([bundle.pose[:, :2] * math.exp(bundle.camera[HEIGHT]), np.zeros(len(bundle.pose))])
    heading = bundle.pose[:, 2]
    end = begin + REJECTION_LIMITS.segment_m * np.column_stack(
        [np.cos(heading), np.sin(heading), np.zeros_like(heading)]
    )
    camera = camera_of_unknowns(unknowns, size)
    a, b = (on_road(camera, estimate.camera.project(points)[0]) for points in (begin, end))
    return np.asarray(np.log(np.linalg.norm(b - a, axis=1) + 1e-9))
