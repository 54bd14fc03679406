"""Focal length, height and tilt of a camera from vehicles on the road before it, whose sizes are roughly known.

The right camera is the one under which all vehicles are likely: shapes as vehicles have them, the same in all views of
a vehicle, wheels on one plane. A grid of cameras is judged by the closed-form starts of `skope.eval.pose.initialize`,
the best few are adjusted together with their vehicles (`skope.eval.pose.bundle_adjustment`), and how differently
single vehicles pull tells the uncertainty. What does not hold together is refused.
Place and direction on the map cannot be known so: the camera hangs over (0, 0) and looks along x.
"""

import itertools
import math
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.camera.model import Camera
from skope.eval.pose import initialize
from skope.eval.pose.bundle_adjustment import (
    FOCAL,
    HEIGHT,
    PITCH,
    ROLL,
    BundleAdjustment,
    Known,
    Solved,
    VehicleViews,
    camera_of,
)
from skope.eval.pose.ground import Ground
from skope.eval.pose.observations import observe
from skope.eval.pose.shape_model import fleet_shapes
from skope.types import Array

_GROUND: Final = Ground(height_sigma=0.03, tilt_sigma=math.radians(0.7))
_FOCAL: Final = np.geomspace(0.34, 2.9, 10)
"""Focal lengths of the grid, as multiples of the image's width: fields of view from 112 to 20 degrees."""
_PITCH: Final = np.radians([3, 8, 14, 21, 29, 38, 48, 60, 74])
"""Tilts of the grid, downwards."""
_HEIGHT: Final = (2.6, 3.7, 5.2, 7.4, 10.5, 15.0, 22.0)
"""Heights of the grid over the road, metres."""
_JUDGED: Final = 60
"""Views by which the grid is judged, at most."""
_CAP: Final = 150.0
"""What a view can cost at most there."""
_APART: Final = 0.45
"""Cameras of the grid that are nearer to one another than this, in logarithms and twice radians, are one start."""
_STARTS: Final = 10
"""How many cameras of the grid, the best, are adjusted."""
_REFINED: Final = 4
"""How many of those have the body types of their vehicles chosen by full fits."""
_SAME: Final = 0.02
"""Cameras whose unknowns differ by less than this are one."""
_STEPS: Final = 10
"""Steps by which each start is adjusted before the best are known."""


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """A camera that was estimated from vehicles, and how certain it is."""

    camera: Camera
    solved: Solved
    views: VehicleViews
    covariance: Array
    """(5, 5) of the unknowns that `skope.eval.pose.bundle_adjustment.CAMERA` names."""
    rival: float
    """How much less likely the next camera is, twice the log likelihood; infinite where there is none."""

    @property
    def vehicles(self) -> int:
        """How many vehicles it was fitted to."""
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


def fit_camera(views: VehicleViews, known: Known | None = None) -> CameraEstimate:
    """Estimate focal length, height, tilt, roll and distortion of the camera that took the vehicles.

    The principal point is taken to be the image's middle.

    Args:
        views: Keypoints of vehicles that stand on one level road.
        known: What is known of the camera beforehand; None: what is so of any.

    Returns:
        The camera under which the vehicles are most likely, over (0, 0) and looking along x, and how certain it is.
    """
    shapes = fleet_shapes()
    adjustment = BundleAdjustment(views, shapes, known)
    begun = [adjustment.solve(adjustment.begun(at), _STEPS) for at in _starts(views, known or Known())]
    begun.sort(key=lambda solved: solved.cost)
    fits = [adjustment.refined(solved.bundle) for solved in _distinct(begun)[:_REFINED]]
    best, *others = _distinct(sorted(fits, key=lambda solved: solved.cost))
    return CameraEstimate(
        camera=camera_of(best.bundle.camera, views.size),
        solved=best,
        views=views,
        covariance=best.covariance(),
        rival=others[0].cost - best.cost if others else math.inf,
    )


def _starts(views: VehicleViews, known: Known) -> list[Array]:
    """The best cameras of the grid that are apart from one another, as unknowns (5,)."""
    few = views.take(np.random.default_rng(0).permutation(len(views.found))[:_JUDGED])
    shapes = fleet_shapes()

    def cost(at: Array) -> float:
        seen = observe(camera_of(at, views.size), few.found, few.sigma_px)
        least = initialize.on_ground(seen, shapes, _GROUND).cost.min(axis=1)
        return float((_CAP * np.tanh(np.minimum(least, 1e6) / _CAP)).sum())

    grid = [
        np.where(known.sigma < np.inf, known.center, [math.log(f * views.size[0]), pitch, 0.0, math.log(height), 0.0])
        for f, pitch, height in itertools.product(_FOCAL, _PITCH, _HEIGHT)
    ]
    out: list[Array] = []
    for at in sorted(grid, key=cost):
        if all(np.abs((at - other) * [1, 2, 0, 1, 0]).sum() > _APART for other in out):
            out.append(at)
        if len(out) == _STARTS:
            break
    return out


def _distinct(solved: list[Solved]) -> list[Solved]:
    """Of those that have come to one camera the first."""
    out: list[Solved] = []
    for one in solved:
        if all(np.abs(one.bundle.camera - other.bundle.camera).max() > _SAME for other in out):
            out.append(one)
    return out
