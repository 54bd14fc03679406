"""Bundle adjustment with vehicles in place of points: estimate a camera and the vehicles that it sees together.

The unknowns are

- the camera over the level road z = 0: focal length, tilt, roll, height and the lens's first radial coefficient;
- the offsets of keypoints from their position in the shape space, shared by all vehicles and mirrored left and right.
  Detectors and people mark a corner at another point than the model, always to the same side;
- the shape of each vehicle, constant over its views;
- the vehicle's position on the road and its heading in each view.

Keypoints that the vehicle's own body hides do not count (`skope.pose.shape_model`). The others count with Cauchy's
distribution. Levenberg and Marquardt's method eliminates views, then vehicles, from the normal equations (Schur's
complement, Triggs et al. 2000). The remaining system has the size of the camera and the offsets. It is a sum with one
part per vehicle, which also shows how much single vehicles disagree.
"""

import math
from dataclasses import dataclass, field, replace
from typing import Final, Literal, Self

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, UNKNOWN_NAMES, Pictured, by_camera, camera_of_unknowns
from skope.camera.fit.normal_equations import Linearised, Parts, summed
from skope.camera.ground_plane import Ground
from skope.pose import closed_form_starts, observations
from skope.pose.closed_form_starts import Starts
from skope.pose.observations import KEYPOINT_WEIGHTS, observe
from skope.pose.shape_model import Shapes, facing
from skope.types import Array, Mask

LARGEST_STEP: Final = np.array([0.3, 0.2, 0.1, 0.3, 0.05])
"""Maximum change of the camera's unknowns per step."""


@dataclass(frozen=True)
class AdjustmentLimits:
    """Noise model and limits of the bundle adjustment."""

    offset_m: float = 0.04
    """Standard deviation of a keypoint's offset from its body type, metres per axis."""
    hidden_cost: float = 6.0
    """Cost of a keypoint that the body hides. Without this cost, candidate cameras that show few keypoints would
    win."""
    middle_offset_m: float = 0.001
    """Standard deviation of the lateral offset of a keypoint in the vehicle's plane of symmetry, metres."""
    behind_cost: float = 1e6
    """Squared distance assigned to a keypoint behind the camera."""
    view_cost_cap: float = 300.0
    """Maximum cost of a view while the body type is chosen."""
    first_damping: float = 1e-3
    """Damping of the first step."""
    last_damping: float = 1e4
    """Damping at which the search stops."""
    most_steps: int = 20
    """Maximum number of steps of a search for everything but body types."""
    type_rounds: int = 3
    """Maximum number of rounds in which body types are chosen again."""
    least_gain: float = 0.01
    """The search ends after a round that lowers the cost by less than this."""
    shape_steps: int = 6
    """Number of steps of a search for shapes and positions alone."""
    visibility_steps: int = 3
    """Number of steps after which the hidden keypoints are determined again."""
    settled: float = 1e-5
    """The search ends when a step lowers the cost by less than this share."""


ADJUSTMENT_LIMITS: Final = AdjustmentLimits()

START_ROAD: Final = Ground(height_sigma=0.03, tilt_sigma=math.radians(0.7))
"""Road on which vehicles are placed before they are adjusted."""

MIRROR_PAIRS: Final = sorted({tuple(sorted((i, mirrored))) for i, mirrored in enumerate(keypoints.FLIP)})
"""Keypoints with their mirror images. A keypoint in the plane of symmetry is its own."""
PAIR_OF_KEYPOINT: Final = np.array(
    [next(g for g, pair in enumerate(MIRROR_PAIRS) if i in pair) for i in range(keypoints.K)]
)
"""(33,) index into `MIRROR_PAIRS`."""
_SIDE_SIGNS: Final = np.array([-1.0 if name.endswith("_right") else 1.0 for name in keypoints.NAMES])
UNKNOWN_COUNT: Final = len(UNKNOWN_NAMES) + 3 * len(MIRROR_PAIRS)
"""Number of unknowns of the camera and the offsets."""


@dataclass(frozen=True, eq=False)
class VehicleViews:
    """B views of N vehicles in images of one camera."""

    found: Array
    """(B, 33, 3) keypoints: x, y in pixels, probability."""
    sigma_px: Array
    """(B,) standard deviation of a keypoint of probability 1, pixels."""
    vehicle: NDArray[np.intp]
    """(B,) index of the vehicle in each view, 0 to N - 1."""
    size: tuple[int, int]
    """Width and height of the images, pixels."""
    shapes: Shapes
    """Possible shapes of vehicles, with the keypoints that `found` marks."""

    @property
    def count(self) -> int:
        """Number of vehicles."""
        return int(self.vehicle.max(initial=-1)) + 1

    def take(self, rows: NDArray[np.intp]) -> Self:
        """Return the views with the indices `rows`. Each becomes a vehicle of its own."""
        return replace(self, found=self.found[rows], sigma_px=self.sigma_px[rows], vehicle=np.arange(len(rows)))


@dataclass(frozen=True, eq=False)
class Known:
    """Prior knowledge of a camera: cameras are roughly level, lenses distort a little."""

    center: Array = field(default_factory=lambda: np.zeros(len(UNKNOWN_NAMES)))
    """(5,) means of the unknowns."""
    sigma: Array = field(default_factory=lambda: np.array([np.inf, np.inf, math.radians(3.0), np.inf, 0.05]))
    """(5,) standard deviations of the unknowns; inf for free ones, 0 for fixed ones."""

    def precision(self, offset_sigma: Array) -> Array:
        """Return (U,) prior inverse variances of all shared unknowns.

        `offset_sigma` (G, 3) are the standard deviations of the keypoints' offsets, metres.
        """
        camera = np.divide(1.0, self.sigma**2, out=np.zeros(len(UNKNOWN_NAMES)), where=self.sigma > 0)
        return np.concatenate([camera, 1 / offset_sigma.ravel() ** 2])


@dataclass(frozen=True, eq=False)
class Bundle:
    """Values of all unknowns."""

    shared: Array
    """(5 + 3 G,) the camera's unknowns, then the offsets (G, 3) of groups of keypoints, metres in the vehicle frame."""
    kind: NDArray[np.intp]
    """(N,) index of each vehicle's body type."""
    shape: Array
    """(N, M) shape parameters."""
    pose: Array
    """(B, 3) position on the road (x, y, divided by the camera's height) and heading (radians) of each view."""

    @property
    def camera(self) -> Array:
        """(5,) camera's unknowns in the order of `UNKNOWN_NAMES`."""
        return self.shared[: len(UNKNOWN_NAMES)]

    def moved(self, shared: Array, shape: Array, pose: Array) -> Self:
        """Return the values after a step.

        Args:
            shared: (5 + 3 G,) step of the shared unknowns.
            shape: (N, M) step of the shapes.
            pose: (B, 3) step of the poses.
        """
        return replace(self, shared=self.shared + shared, shape=self.shape + shape, pose=self.pose + pose)

    def where(self, better: Mask, other: Self, vehicle: NDArray[np.intp]) -> Self:
        """Return a copy in which the values of the vehicles in `better` are replaced by those of `other`.

        Args:
            better: (N,) whether a vehicle's body type, shape and poses are replaced.
            other: Values with the same shared unknowns.
            vehicle: (B,) the vehicle of each view.
        """
        return replace(
            self,
            kind=np.where(better, other.kind, self.kind),
            shape=np.where(better[:, None], other.shape, self.shape),
            pose=np.where(better[vehicle][:, None], other.pose, self.pose),
        )


@dataclass(frozen=True, eq=False)
class Solved:
    """Result of a search."""

    bundle: Bundle
    precision: Array
    """(U,) prior inverse variances of the shared unknowns."""
    cost: float
    """Twice the negative log posterior, up to a constant. It integrates over shapes that are about as likely (Laplace's
    approximation)."""
    squared: Array
    """(B, 33) squared distances between keypoints and bodies in the image, in variances."""
    counted: Mask
    """(B, 33) whether a keypoint counts."""
    information: Array
    """(N, U, U) information of each vehicle on the shared unknowns."""
    pull: Array
    """(N, U) gradient of half the cost with respect to the shared unknowns, per vehicle."""

    def covariance(self) -> Array:
        """Return the covariance (5, 5) of the camera's unknowns.

        The covariance follows from the disagreement of single vehicles, with the prior as one more vehicle (the
        sandwich estimator of Huber and White). This accounts for errors that the keypoints of a vehicle share in all of
        its views.
        """
        prior = np.diag(self.precision)
        inverse = np.linalg.inv(self.information.sum(axis=0) + prior)
        apart = self.pull - self.pull.mean(axis=0)
        few = len(apart) / max(1, len(apart) - len(UNKNOWN_NAMES))
        whole = inverse @ (few * apart.T @ apart + prior) @ inverse
        return np.asarray(whole[: len(UNKNOWN_NAMES), : len(UNKNOWN_NAMES)])


class BundleAdjustment:
    """Search for the most likely camera, shapes and positions, given views of vehicles."""

    def __init__(self, views: VehicleViews, known: Known | None = None) -> None:
        """Prepare a search. `known` is the prior of the camera; None: the default prior."""
        known = known or Known()
        self._views, self._shapes = views, views.shapes
        self._directions = np.moveaxis(views.shapes.directions[:, :, :-1], 1, -1)  # (T, 33, 3, M)
        rest = UNKNOWN_COUNT - len(UNKNOWN_NAMES)
        self._free = np.flatnonzero(np.concatenate([known.sigma > 0, np.ones(rest, dtype=bool)]))
        self._center = np.concatenate([known.center, np.zeros(rest)])
        self._seen = views.found[..., 2] >= KEYPOINT_WEIGHTS.least_probability
        self._variance = (views.sigma_px**2)[:, None] / np.clip(
            views.found[..., 2], KEYPOINT_WEIGHTS.least_probability, 1.0
        )
        self._prior = known.precision(_offset_sigma())

    def begun(self, camera: Array) -> Bundle:
        """Place vehicles under a camera (5,) in closed form, with the body type of the best-fitting mean shape."""
        starts = self._starts(camera)
        cost = self._by_vehicle(np.minimum(starts.cost, ADJUSTMENT_LIMITS.view_cost_cap)) - 2 * np.log(
            self._shapes.share
        )
        shared = np.concatenate([camera, np.zeros(UNKNOWN_COUNT - len(camera))])
        return self._placed(shared, starts, cost.argmin(axis=1))

    def refined(self, bundle: Bundle) -> Solved:
        """Continue the search from a bundle, alternating between body types and all other unknowns."""
        best = self.solve(self.with_likeliest_types(bundle), ADJUSTMENT_LIMITS.most_steps)
        for _ in range(ADJUSTMENT_LIMITS.type_rounds):
            again = self.solve(self.with_likeliest_types(best.bundle), ADJUSTMENT_LIMITS.most_steps)
            if again.cost > best.cost - ADJUSTMENT_LIMITS.least_gain:
                break
            same = (again.bundle.kind == best.bundle.kind).all()
            best = again
            if same:
                break
        return best

    def solve(self, bundle: Bundle, steps: int) -> Solved:
        """Improve camera, offsets, shapes and positions of a bundle in at most `steps` steps. Body types stay fixed."""
        vehicle, damping = self._views.vehicle, np.full(self._views.count, ADJUSTMENT_LIMITS.first_damping)
        counted = self._counted(bundle)
        here = self._linearised(bundle, counted)
        for step in range(steps):
            if step and step % ADJUSTMENT_LIMITS.visibility_steps == 0:
                counted = self._counted(bundle)
                here = self._linearised(bundle, counted)
            parts = here.without_poses(vehicle, bundle.shape, damping)
            move = self._shared_step(parts, bundle.shared, float(damping[0]))
            ahead = bundle.moved(move, *parts.back(move, vehicle))
            trial = self._linearised(ahead, counted)
            gain = self._total(here, bundle) - self._total(trial, ahead)
            if gain > 0:
                settled = gain < ADJUSTMENT_LIMITS.settled * self._total(here, bundle)
                bundle, here, damping = ahead, trial, damping / 5
                if settled and step > ADJUSTMENT_LIMITS.visibility_steps:
                    break
            else:
                damping = damping * 8
                if damping[0] > ADJUSTMENT_LIMITS.last_damping:
                    break
        parts, each = self._whole(here, bundle)
        cost = self._prior_cost(bundle) + float(each.sum())
        return Solved(bundle, self._prior, cost, here.squared, counted, parts.information, parts.pull)

    def with_likeliest_types(self, bundle: Bundle) -> Bundle:
        """Fit the shape of each body type to each vehicle, and keep the type with the lowest cost."""
        starts = self._starts(bundle.camera)
        best, least = bundle, np.full(self._views.count, np.inf)
        for kind in range(len(self._shapes.types)):
            placed = self._placed(bundle.shared, starts, np.full(self._views.count, kind))
            fitted, cost = self._fitted(placed)
            better = cost < least
            best, least = best.where(better, fitted, self._views.vehicle), np.where(better, cost, least)
        return best

    def _fitted(self, bundle: Bundle) -> tuple[Bundle, Array]:
        """Return the bundle with better shapes and positions, and (N,) the cost of each vehicle."""
        vehicle, still = self._views.vehicle, np.zeros(UNKNOWN_COUNT)
        damping = np.full(self._views.count, ADJUSTMENT_LIMITS.first_damping)
        counted = self._counted(bundle)
        here = self._linearised(bundle, counted, by="nothing")
        for step in range(ADJUSTMENT_LIMITS.shape_steps):
            if step == ADJUSTMENT_LIMITS.visibility_steps:
                counted = self._counted(bundle)
                here = self._linearised(bundle, counted, by="nothing")
            parts = here.without_poses(vehicle, bundle.shape, damping)
            ahead = bundle.moved(still, *parts.back(still, vehicle))
            trial = self._linearised(ahead, counted, by="nothing")
            better = trial.vehicle_cost < here.vehicle_cost
            bundle, here = bundle.where(better, ahead, vehicle), here.where(better, trial, vehicle)
            damping = np.where(better, damping / 5, damping * 10)
        return bundle, self._whole(here, bundle)[1]

    def _whole(self, here: Linearised, bundle: Bundle) -> tuple[Parts, Array]:
        """Return the undamped parts of the normal equations, and (N,) costs that integrate over likely shapes."""
        parts = here.without_poses(self._views.vehicle, bundle.shape, np.zeros(self._views.count))
        return parts, here.vehicle_cost + parts.spread - 2 * np.log(self._shapes.share[bundle.kind])

    def _shared_step(self, parts: Parts, shared: Array, damping: float) -> Array:
        """Return (U,) a damped step of the shared unknowns."""
        normal = parts.information.sum(axis=0) + np.diag(self._prior)
        normal += np.diag(damping * np.diag(normal) + 1e-9)
        pull = parts.pull.sum(axis=0) + self._prior * (shared - self._center)
        step = np.zeros(UNKNOWN_COUNT)
        step[self._free] = -np.linalg.solve(normal[np.ix_(self._free, self._free)], pull[self._free])
        step[: len(UNKNOWN_NAMES)] = np.clip(step[: len(UNKNOWN_NAMES)], -LARGEST_STEP, LARGEST_STEP)
        return step

    def _total(self, here: Linearised, bundle: Bundle) -> float:
        return float(here.vehicle_cost.sum()) + self._prior_cost(bundle)

    def _prior_cost(self, bundle: Bundle) -> float:
        return float((self._prior * (bundle.shared - self._center) ** 2).sum())

    def _starts(self, camera: Array) -> Starts:
        seen = observe(camera_of_unknowns(camera, self._views.size), self._views.found, self._views.sigma_px)
        return closed_form_starts.on_ground(seen, self._shapes, START_ROAD)

    def _placed(self, shared: Array, starts: Starts, kind: NDArray[np.intp]) -> Bundle:
        row, column = np.arange(len(self._views.vehicle)), kind[self._views.vehicle]
        p, R = starts.p[row, column], starts.R[row, column]
        height = math.exp(shared[HEIGHT])
        pose = np.column_stack([p[:, :2] / height, np.arctan2(R[:, 1, 0], R[:, 0, 0])])
        return Bundle(shared, kind, np.zeros((self._views.count, self._directions.shape[-1])), pose)

    def _by_vehicle(self, values: Array) -> Array:
        return summed(values, self._views.vehicle, self._views.count)

    def _counted(self, bundle: Bundle) -> Mask:
        """Return (B, 33) whether a keypoint was detected and is not hidden by the body."""
        kind, height = bundle.kind[self._views.vehicle], math.exp(bundle.shared[HEIGHT])
        u, v, heading = bundle.pose.T
        cos, sin = np.cos(heading), np.sin(heading)
        eye = height * np.column_stack([-cos * u - sin * v, sin * u - cos * v, np.ones_like(u)])
        return self._seen & facing(self._shapes, kind, self._shapes.mean[kind, :-1], eye)

    def unevenness(self, solved: Solved) -> float:
        """Return the median vertical distance of views from the road, in standard deviations of their heights."""
        here, count = self._linearised(solved.bundle, solved.counted, by="height"), len(self._views.found)
        parts = here.without_poses(np.arange(count), np.zeros((count, 0)), np.zeros(count))
        information = np.maximum(parts.information[:, 0, 0], 1e-12)
        return float(np.median(np.abs(parts.pull[:, 0]) / np.sqrt(information)))

    def _linearised(
        self, bundle: Bundle, counted: Mask, *, by: Literal["shared", "height", "nothing"] = "shared"
    ) -> Linearised:
        """Return costs and normal equations in pose, shape and shared unknowns.

        `by` may replace the shared unknowns by the height of each view over the road, with fixed shapes.
        """
        views, camera = self._views, bundle.camera
        kind, height, focal = bundle.kind[views.vehicle], math.exp(camera[HEIGHT]), math.exp(camera[FOCAL])
        directions = self._directions[kind]
        body = self._shapes.mean[kind, :-1] + _offsets(bundle.shared)
        body = body + np.einsum("bkim,bm->bki", directions, bundle.shape[views.vehicle])
        # Keypoints on the road and in the image.
        u, v, heading = bundle.pose.T
        R = np.zeros((len(kind), 3, 3))
        R[:, 0, 0] = R[:, 1, 1] = np.cos(heading)
        R[:, 1, 0] = np.sin(heading)
        R[:, 0, 1], R[:, 2, 2] = -R[:, 1, 0], 1.0
        foot = np.column_stack([u, v, np.zeros_like(u)])
        world = body @ np.swapaxes(R, -1, -2) + height * foot[:, None]
        pictured = Pictured.of(camera, views.size, world)
        away = pictured.pixels - views.found[..., :2]
        variance = self._variance + (focal * self._shapes.rest[kind] / pictured.near) ** 2
        squared = np.where(pictured.front, (away**2).sum(axis=-1) / variance, ADJUSTMENT_LIMITS.behind_cost)
        each = np.where(counted, observations.cost(squared), ADJUSTMENT_LIMITS.hidden_cost * self._seen)
        vehicle_cost = self._by_vehicle(each.sum(axis=1)) + (bundle.shape**2).sum(axis=1)
        weight = np.where(counted & pictured.front, observations.weight(squared) / variance, 0.0)
        # Derivatives of the image positions by a shift in the world, by the pose and by the shape.
        by_world = pictured.by_world()
        by_body = np.einsum("bkij,bjl->bkil", by_world, R)
        turned = np.stack([-body[..., 1], body[..., 0], np.zeros_like(body[..., 0])], axis=-1)
        by_heading = np.einsum("bkil,bkl->bki", by_body, turned)
        by_pose = np.concatenate([by_world[..., :2] * height, by_heading[..., None]], axis=-1)
        by_shape = np.einsum("bkil,bklm->bkim", by_body, directions, optimize=True)
        by_shared = np.zeros((*away.shape, 0))
        if by == "height":
            by_shape, by_shared = by_shape[..., :0], by_world[..., 2:]
        elif by == "shared":
            by_shared = np.zeros((*away.shape, UNKNOWN_COUNT))
            # Positions are multiples of the camera's height, and grow with it.
            by_shared[..., : len(UNKNOWN_NAMES)] = by_camera(camera, views.size, world, foot)
            mirrored = np.stack([np.ones_like(_SIDE_SIGNS), _SIDE_SIGNS, np.ones_like(_SIDE_SIGNS)], axis=-1)
            column = len(UNKNOWN_NAMES) + 3 * PAIR_OF_KEYPOINT[:, None] + np.arange(3)
            for k in range(keypoints.K):
                by_shared[:, k, :, column[k]] = np.moveaxis(by_body[:, k] * mirrored[k], -1, 0)
        return Linearised.of(squared, vehicle_cost, weight, away, by_pose, by_shape, by_shared)


def _offset_sigma() -> Array:
    """Return (G, 3) standard deviations of the keypoints' offsets, metres."""
    sigma = np.full((len(MIRROR_PAIRS), 3), ADJUSTMENT_LIMITS.offset_m)
    sigma[[first == second for first, second in MIRROR_PAIRS], 1] = ADJUSTMENT_LIMITS.middle_offset_m
    return sigma


def _offsets(shared: Array) -> Array:
    """Return (33, 3) the offset of each keypoint in the vehicle frame, metres."""
    offsets = shared[len(UNKNOWN_NAMES) :].reshape(-1, 3)[PAIR_OF_KEYPOINT]
    offsets[:, 1] *= _SIDE_SIGNS
    return np.asarray(offsets)
