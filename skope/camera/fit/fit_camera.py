"""Focal length, height and tilt of a camera from vehicles on the road before it, whose sizes are roughly known.

The right camera is the one under which all vehicles are likely: shapes as vehicles have them, the same in all views of
a vehicle, wheels on one plane. A grid of cameras is judged by `skope.pose.closed_form_starts`, the best few are
adjusted together with their vehicles (`skope.camera.fit.bundle_adjustment`), and how differently
single vehicles pull tells the uncertainty. What does not hold together is refused.
Place and direction on the map cannot be known so: the camera hangs over (0, 0) and looks along x.
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
_PITCH: Final = np.radians([3, 8, 14, 21, 29, 38, 48, 60, 74])
"""Tilts of the grid, downwards."""
_HEIGHT: Final = (2.6, 3.7, 5.2, 7.4, 10.5, 15.0, 22.0)
"""Heights of the grid over the road, metres."""
_JUDGED: Final = (20, 60)
"""Views by which the grid is judged, and then the best of it, at most."""
_JUDGED_AGAIN: Final = 100
"""Number of cameras of the grid that are judged by more views."""
_CAP: Final = 150.0
"""Largest cost of a view, so that a false detection does not decide."""
_START_DISTANCE: Final = 0.45
"""Cameras of the grid that are nearer to one another than this, in logarithms and twice radians, are one start."""
_STARTS: Final = 10
"""Number of cameras of the grid, the best ones, that are adjusted."""
_REFINED: Final = 4
"""Number of those for which full fits choose the body types of their vehicles."""
_SAME_UNKNOWNS: Final = 0.02
"""Cameras whose unknowns differ by less than this are one."""
_INFLATION: Final = 1.5
"""Standard deviations are this much larger than what differences between vehicles tell: with this and the two below,
95% intervals hold the truth of generated cameras as often (docs/from-camera-to-tracks.md)."""
_FOCAL_FLOOR: Final = 0.03
"""Standard deviation of the focal length, and of what goes with it, that stays with many vehicles, as a share."""
_FLOOR: Final = np.array([0.0, 0.0, math.radians(0.5), 0.04, 0.01])
"""The same of the other unknowns: all vehicles of a country are larger or smaller than those of the shape space, which
nothing in the image tells, and lenses are bent by more than one coefficient says."""
_FIRST_STEPS: Final = 10
"""Steps by which each start is adjusted before the best are known."""


@dataclass(frozen=True, eq=False)
class Rival:
    """Another camera that the search has come to."""

    unknowns: Array
    """(5,) as `skope.camera.fit.camera_unknowns.UNKNOWN_NAMES` names them."""
    behind: float
    """Twice the log likelihood by which it is less likely."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """A camera that was estimated from vehicles, and how certain it is."""

    camera: Camera
    solved: Solved
    views: VehicleViews
    covariance: Array
    """(5, 5) of the unknowns that `skope.camera.fit.camera_unknowns.UNKNOWN_NAMES` names."""
    unevenness: float
    """Distance of the views from the road, as `BundleAdjustment.unevenness` says; 0.3 to 0.5 on level ones."""
    rival: Rival | None
    """The likeliest of other cameras."""
    known: Known
    """Knowledge of the camera from before."""

    @property
    def vehicles(self) -> int:
        """Number of vehicles that it was fitted to."""
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
    """Estimate focal length, height, tilt, roll and distortion of the camera that took the vehicles.

    The principal point is taken to be the image's middle.

    Args:
        views: Keypoints of vehicles that stand on one level road.
        known: What is known of the camera beforehand; None: what is so of any.

    Returns:
        The camera under which the vehicles are most likely, over (0, 0) and looking along x, and how certain it is.
    """
    known = known or Known()
    adjustment = BundleAdjustment(views, known)
    begun = [adjustment.solve(adjustment.begun(at), _FIRST_STEPS) for at in _starts(views, known)]
    begun.sort(key=lambda solved: solved.cost)
    fits = [adjustment.refined(solved.bundle) for solved in _distinct(begun)[:_REFINED]]
    best, *others = _distinct(sorted(fits, key=lambda solved: solved.cost))
    return CameraEstimate(
        camera=camera_of_unknowns(best.bundle.camera, views.size),
        solved=best,
        views=views,
        covariance=_widened(best.covariance()),
        unevenness=adjustment.unevenness(best),
        rival=Rival(others[0].bundle.camera, others[0].cost - best.cost) if others else None,
        known=known,
    )


def gain_of_pixel_width(estimate: CameraEstimate, width: float) -> float:
    """Twice the log likelihood by which the vehicles are likelier if a pixel is `width` times as wide as high."""
    views, known, at = estimate.views, estimate.known, estimate.solved.bundle.camera.copy()
    found, center = views.found.copy(), known.center.copy()
    found[..., 0] *= width
    at[FOCAL] += 0.5 * math.log(width)
    center[FOCAL] += math.log(width)  # a field of view that is known is the horizontal one
    # Uncertain by as many pixels as before in the mean of both axes, so that wide pixels gain nothing by that.
    drawn = replace(
        views,
        found=found,
        sigma_px=views.sigma_px * math.sqrt(width),
        size=(round(views.size[0] * width), views.size[1]),
    )
    adjustment = BundleAdjustment(drawn, replace(known, center=center))
    return estimate.solved.cost - adjustment.refined(adjustment.begun(at)).cost


def _widened(covariance: Array) -> Array:
    """A covariance of the unknowns with what all vehicles have wrong together."""
    with_focal = covariance[:, FOCAL] / covariance[FOCAL, FOCAL] if covariance[FOCAL, FOCAL] > 0 else np.zeros(5)
    with_focal = np.where(np.arange(len(with_focal)) == K1, 0.0, with_focal)
    common = _FOCAL_FLOOR**2 * np.outer(with_focal, with_focal) + np.diag(_FLOOR**2)
    return np.asarray(_INFLATION**2 * covariance + common)


def _starts(views: VehicleViews, known: Known) -> list[Array]:
    """The best cameras of the grid that are apart from one another, as unknowns (5,)."""
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
        for f, pitch, height in itertools.product(_FOCAL_GRID, _PITCH, _HEIGHT)
    ]
    out: list[Array] = []
    for at in best(best(grid, _JUDGED[0])[:_JUDGED_AGAIN], _JUDGED[1]):
        if all(np.abs((at - other) * [1, 2, 0, 1, 0]).sum() > _START_DISTANCE for other in out):
            out.append(at)
        if len(out) == _STARTS:
            break
    return out


def capped(cost: Array) -> Array:
    """Costs of views that level off at `_CAP`, still smooth."""
    return np.asarray(_CAP * np.tanh(np.minimum(cost, 1e6) / _CAP))


def _distinct(solved: list[Solved]) -> list[Solved]:
    """Of those that have come to one camera the first."""
    out: list[Solved] = []
    for one in solved:
        if all(np.abs(one.bundle.camera - other.bundle.camera).max() > _SAME_UNKNOWNS for other in out):
            out.append(one)
    return out
