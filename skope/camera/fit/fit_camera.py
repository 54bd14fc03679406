"""Estimate focal length, height and tilt of a camera from vehicles of roughly known size on the road.

The correct camera makes all vehicles likely: plausible shapes, constant over all views of a vehicle, and wheels on one
plane. `skope.pose.closed_form_starts` ranks a grid of candidate cameras, and the best few are adjusted together with
their vehicles (`skope.camera.fit.bundle_adjustment`). The disagreement of single vehicles gives the uncertainty.
Implausible results are rejected. Vehicles do not show where the camera is on the map: by definition it is above (0, 0)
and faces along x.
"""

import itertools
import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.camera.fit.bundle_adjustment import START_ROAD, BundleAdjustment, Known, Solved, VehicleViews
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, K1, PITCH, ROLL, camera_of_unknowns
from skope.camera.model import Camera
from skope.pose import closed_form_starts
from skope.pose.observations import observe
from skope.types import Array

_FOCAL_GRID: Final = np.geomspace(0.34, 2.9, 10)
"""Focal lengths of the grid, as multiples of the image's width: fields of view from 112 to 20 degrees."""
GRID_PITCHES: Final = np.radians([3, 8, 14, 21, 29, 38, 48, 60, 74])
"""Downward pitch angles of the grid, radians."""


@dataclass(frozen=True)
class CameraSearch:
    """Grid of initial cameras and limits of the search for a camera from vehicles."""

    heights_m: tuple[float, ...] = (2.6, 3.7, 5.2, 7.4, 10.5, 15.0, 22.0)
    """Heights of the grid over the road, metres."""
    judged_views: tuple[int, int] = (20, 60)
    """Maximum number of views for ranking all candidate cameras of the grid, and for ranking the best again."""
    judged_again: int = 100
    """Number of candidate cameras that are ranked again with more views."""
    view_cost_cap: float = 150.0
    """Maximum cost of a view, so that a false detection does not decide."""
    start_distance: float = 0.45
    """Distance below which two candidate cameras of the grid count as one, in logarithms of focal length and height,
    and twice the pitch in radians."""
    starts: int = 10
    """Number of candidate cameras that are adjusted."""
    refined: int = 4
    """Number of adjusted candidate cameras for which full fits determine the body types."""
    same_unknowns: float = 0.02
    """Difference of the unknowns below which two candidate cameras count as one."""
    sigma_factor: float = 1.5
    """Factor on the standard deviations that the differences between vehicles give. With this factor and the two floors
    below, 95% confidence intervals cover 95% of generated cameras (docs/evidence/how-a-camera-is-calibrated.md)."""
    focal_floor: float = 0.03
    """Minimum relative standard deviation of the focal length, for any number of vehicles."""
    first_steps: int = 10
    """Number of adjustment steps of each candidate camera before the best are selected."""


CAMERA_SEARCH: Final = CameraSearch()

SIGMA_FLOORS: Final = np.array([0.0, 0.0, math.radians(0.5), 0.04, 0.01])
"""Minimum standard deviations of the unknowns, except the focal length. All vehicles of a country may be larger or
smaller than the shape space, and lens distortion may need more than one coefficient."""


@dataclass(frozen=True, eq=False)
class Rival:
    """Second candidate camera that the search has found."""

    unknowns: Array
    """(5,) values in the order of `skope.camera.fit.camera_unknowns.UNKNOWN_NAMES`."""
    behind: float
    """Difference of twice the log likelihood to the best candidate camera."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """Camera estimated from vehicles, with its uncertainty."""

    camera: Camera
    solved: Solved
    views: VehicleViews
    covariance: Array
    """(5, 5) covariance in the order of `skope.camera.fit.camera_unknowns.UNKNOWN_NAMES`."""
    unevenness: float
    """Distance of the views from the road, from `BundleAdjustment.unevenness`; 0.3 to 0.5 on level ones."""
    rival: Rival | None
    """Most likely of the candidate cameras that differ from this one; None: no such candidate was found."""
    known: Known
    """Prior knowledge of the camera."""

    @property
    def vehicles(self) -> int:
        """Number of vehicles used in the fit."""
        return self.views.count

    @property
    def sigma_focal(self) -> float:
        """Standard deviation of the focal length, pixels."""
        return float(self.camera.K[0, 0]) * self._sigma(FOCAL)

    @property
    def sigma_pitch(self) -> float:
        """Standard deviation of the tilt, radians."""
        return self._sigma(PITCH)

    @property
    def sigma_roll(self) -> float:
        """Standard deviation of the roll, radians."""
        return self._sigma(ROLL)

    @property
    def sigma_height(self) -> float:
        """Standard deviation of the height over the road, metres."""
        return float(self.camera.position[2]) * self._sigma(HEIGHT)

    def _sigma(self, unknown: int) -> float:
        return math.sqrt(self.covariance[unknown, unknown])


def fit_camera_to_vehicles(views: VehicleViews, known: Known | None = None) -> CameraEstimate:
    """Estimate focal length, height, tilt, roll and distortion of a camera from vehicles in its images.

    The principal point is assumed to be the image's middle.

    Args:
        views: Keypoints of vehicles that stand on one level road.
        known: Prior knowledge of the camera; None: the default prior.

    Returns:
        The camera under which the vehicles are most likely, over (0, 0) and facing along x, with its covariance.
    """
    known = known or Known()
    adjustment = BundleAdjustment(views, known)
    begun = [adjustment.solve(adjustment.begun(at), CAMERA_SEARCH.first_steps) for at in _starts(views, known)]
    begun.sort(key=lambda solved: solved.cost)
    fits = [adjustment.refined(solved.bundle) for solved in _distinct(begun)[: CAMERA_SEARCH.refined]]
    best, *rest = _distinct(sorted(fits, key=lambda solved: solved.cost))
    return CameraEstimate(
        camera=camera_of_unknowns(best.bundle.camera, views.size),
        solved=best,
        views=views,
        covariance=_widened(best.covariance()),
        unevenness=adjustment.unevenness(best),
        rival=Rival(rest[0].bundle.camera, rest[0].cost - best.cost) if rest else None,
        known=known,
    )


def gain_of_pixel_width(estimate: CameraEstimate, width: float) -> float:
    """Return the gain in twice the log likelihood if a pixel is `width` times as wide as high."""
    views, known, at = estimate.views, estimate.known, estimate.solved.bundle.camera.copy()
    found, center = views.found.copy(), known.center.copy()
    found[..., 0] *= width
    at[FOCAL] += 0.5 * math.log(width)
    center[FOCAL] += math.log(width)  # a known field of view is the horizontal one
    # The mean error of both axes stays the same in pixels, so that wide pixels have no advantage.
    drawn = replace(
        views,
        found=found,
        sigma_px=views.sigma_px * math.sqrt(width),
        size=(round(views.size[0] * width), views.size[1]),
    )
    adjustment = BundleAdjustment(drawn, replace(known, center=center))
    return estimate.solved.cost - adjustment.refined(adjustment.begun(at)).cost


def _widened(covariance: Array) -> Array:
    """Return a covariance of the unknowns with the common errors of all vehicles added."""
    with_focal = covariance[:, FOCAL] / covariance[FOCAL, FOCAL] if covariance[FOCAL, FOCAL] > 0 else np.zeros(5)
    with_focal = np.where(np.arange(len(with_focal)) == K1, 0.0, with_focal)
    common = CAMERA_SEARCH.focal_floor**2 * np.outer(with_focal, with_focal) + np.diag(SIGMA_FLOORS**2)
    return np.asarray(CAMERA_SEARCH.sigma_factor**2 * covariance + common)


def _starts(views: VehicleViews, known: Known) -> list[Array]:
    """Return the best distinct candidate cameras of the grid, as unknowns (5,)."""
    shapes, order = views.shapes, np.random.default_rng(0).permutation(len(views.found))

    def best(cameras: list[Array], judged: int) -> list[Array]:
        few = views.take(order[:judged])

        def cost(at: Array) -> float:
            seen = observe(camera_of_unknowns(at, views.size), few.found, few.sigma_px)
            least = closed_form_starts.on_ground(seen, shapes, START_ROAD).cost.min(axis=1)
            return float(capped(least).sum())

        return sorted(cameras, key=cost)

    grid = [
        np.where(known.sigma < np.inf, known.center, [math.log(f * views.size[0]), pitch, 0.0, math.log(height), 0.0])
        for f, pitch, height in itertools.product(_FOCAL_GRID, GRID_PITCHES, CAMERA_SEARCH.heights_m)
    ]
    out: list[Array] = []
    for at in best(
        best(grid, CAMERA_SEARCH.judged_views[0])[: CAMERA_SEARCH.judged_again], CAMERA_SEARCH.judged_views[1]
    ):
        if all(np.abs((at - kept) * [1, 2, 0, 1, 0]).sum() > CAMERA_SEARCH.start_distance for kept in out):
            out.append(at)
        if len(out) == CAMERA_SEARCH.starts:
            break
    return out


def capped(cost: Array) -> Array:
    """Limit costs of views smoothly to `CAMERA_SEARCH.view_cost_cap`."""
    return np.asarray(CAMERA_SEARCH.view_cost_cap * np.tanh(np.minimum(cost, 1e6) / CAMERA_SEARCH.view_cost_cap))


def _distinct(solved: list[Solved]) -> list[Solved]:
    """Return the results without later ones for the same camera."""
    out: list[Solved] = []
    for candidate in solved:
        if all(
            np.abs(candidate.bundle.camera - kept.bundle.camera).max() > CAMERA_SEARCH.same_unknowns for kept in out
        ):
            out.append(candidate)
    return out
