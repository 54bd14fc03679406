"""Estimate position, heading and shape of many vehicles from their keypoints at once.

Each vehicle is a deformable model (`skope.pose.shape_model`). It is moved, turned and deformed until its keypoints
project to the detected ones. The result is the most probable pose and shape, given

- keypoint errors of `sigma_px`, larger for lower scores, with the heavy tails of a Cauchy distribution;
- the distribution of shapes of the body type;
- wheels on the road, if `ground` is known.

The search starts from the mean of every body type (in closed form on a known ground: `skope.pose.closed_form_starts`)
and continues with Levenberg and Marquardt's method from the best few. It is repeated for vehicles that do not fit
(`skope.pose.search`). Poses without enough supporting keypoints are rejected.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope import keypoints
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera
from skope.pose.fit_body_types import FEWEST_KEYPOINTS, INLIER_VARIANCES, agreeing_share, best_types
from skope.pose.levenberg_marquardt import Fits
from skope.pose.observations import Observed, observe
from skope.pose.search import EXCHANGE_FLAGS, POSE_SEARCH, retry_exchanged, retry_from_subsets, without_hidden
from skope.pose.shape_model import Shapes, fleet_shapes
from skope.types import Array

REJECTION_REASONS: Final = ("few_keypoints", "on_a_line", "no_fit", "inconsistent", "uncertain")
"""Reasons why a vehicle has no pose: too few keypoints; keypoints on one line; nothing in front of the camera fits;
more than 60% of the keypoints contradict the rest; the covariance is too large to be useful.
"""
POSE_FLAGS: Final = (*EXCHANGE_FLAGS, "outliers", "heading_in_doubt", "end_in_doubt", "cut")
"""Reasons to distrust a pose: keypoints that fit only with left and right, front and rear, or both exchanged; some
keypoints left out; a second heading that fits about as well; visible keypoints that belong to the end facing away from
the camera; a vehicle that is only partly in the image."""


@dataclass(frozen=True)
class PoseLimits:
    """Limits for accepting poses."""

    chunk_vehicles: int = 80
    """Approximate number of vehicles that are computed together. More do not fit into the processor's cache."""
    agreement: float = 0.4
    """Minimum share of the keypoints that must agree with a pose. Detectors trained on visible keypoints only put the
    hidden half anywhere, with a high score."""
    retry_agreement: float = 0.8
    """Share of agreeing keypoints below which other starts are tried."""
    heading_cost_gap: float = 6.0
    """Difference of cost within which a second heading is as good."""
    impossible_cost: float = 1e5
    """Cost at and above which a fit is impossible."""
    beside_m: float = 6.0
    """Distance in front of or behind a vehicle's middle beyond which a camera sees only one of its ends, metres."""
    lamp_margin: float = 0.4
    """Difference in probability by which the lamps of the other end must be higher to contradict a pose."""
    heading_rad: float = math.radians(25)
    """Maximum standard deviation of a useful heading, radians."""
    distance_share: float = 0.1
    """Maximum standard deviation of a useful position, as a share of the distance; at least 1 m."""


POSE_LIMITS: Final = PoseLimits()


_FRONT_LAMPS: Final = [i for i, name in enumerate(keypoints.NAMES) if name.startswith(("headlight", "front_logo"))]
_REAR_LAMPS: Final = [i for i, name in enumerate(keypoints.NAMES) if name.startswith("taillight")]


NUMERIC_FIELDS: Final = ("T_world_vehicle", "points", "size_lwh", "covariance", "rms_px")
"""Numeric fields of `Poses`, NaN for a vehicle without a pose."""


@dataclass(frozen=True, eq=False)
class Poses:
    """Poses and shapes of N vehicles. If `refusal` is not None, the numbers are NaN."""

    T_world_vehicle: Array
    """(N, 4, 4) from the vehicle frame (x forward, y left, z up, origin on the ground under its middle) to the world,
    metres."""
    points: Array
    """(N, 33, 3) keypoints in the vehicle frame, metres."""
    size_lwh: Array
    """(N, 3) length, width, height, metres."""
    covariance: Array
    """(N, 4, 4) covariance of x, y, z (world, metres) and the turn about the vehicle's upright axis (radians)."""
    types: tuple[str, ...]
    """(N,) best-fitting body type."""
    used: NDArray[np.bool_]
    """(N, 33) whether each keypoint counts and agrees with the pose."""
    rms_px: Array
    """(N,) root mean square distance in the image of the agreeing keypoints, pixels."""
    refusal: tuple[str | None, ...]
    """(N,) one of `REJECTION_REASONS` for a vehicle without a pose, else None."""
    flags: tuple[tuple[str, ...], ...]
    """(N,) flags of each vehicle, from `POSE_FLAGS`."""

    def __len__(self) -> int:
        return len(self.types)

    def moved(self, T: Array) -> Self:
        """Return the vehicles in another world frame; `T` (4, 4) transforms this frame to it."""
        turn = np.eye(4)
        turn[:3, :3] = T[:3, :3]
        return replace(self, T_world_vehicle=T @ self.T_world_vehicle, covariance=turn @ self.covariance @ turn.T)

    @property
    def yaw(self) -> Array:
        """(N,) heading, counter-clockwise from world x, radians."""
        R = self.T_world_vehicle[:, :3, :3]
        return np.asarray(np.arctan2(R[:, 1, 0], R[:, 0, 0]))

    def among(self, rows: NDArray[np.bool_], refusal: str) -> Self:
        """Return M vehicles with these at `rows` (M,); the others are rejected for one reason, with NaN as numbers."""
        count, at = len(rows), np.flatnonzero(rows)

        def spread(values: NDArray[Any], fill: float) -> NDArray[Any]:
            out = np.full((count, *values.shape[1:]), fill, dtype=values.dtype)
            out[at] = values
            return out

        def shared_out(values: tuple[Any, ...], fill: Any) -> tuple[Any, ...]:
            given = dict(zip(at.tolist(), values, strict=True))
            return tuple(given.get(i, fill) for i in range(count))

        return replace(
            self,
            **{name: spread(getattr(self, name), np.nan) for name in NUMERIC_FIELDS},
            used=spread(self.used, False),
            types=shared_out(self.types, ""),
            refusal=shared_out(self.refusal, refusal),
            flags=shared_out(self.flags, ()),
        )

    def part(self, rows: slice) -> Self:
        """Return the vehicles that the slice `rows` selects."""
        return replace(self, **{field.name: getattr(self, field.name)[rows] for field in fields(self)})

    def without_rejected(self) -> Self:
        """Return the same poses with NaN for the numbers of rejected vehicles."""
        rejected = np.array([reason is not None for reason in self.refusal], dtype=bool)
        blank = {name: getattr(self, name).copy() for name in NUMERIC_FIELDS}
        for values in blank.values():
            values[rejected] = np.nan
        return replace(self, **blank)

    @property
    def position(self) -> Array:
        """(N, 3) position on the ground under the middle of the box, world, metres."""
        return self.T_world_vehicle[:, :3, 3]


@dataclass(frozen=True, eq=False)
class VehicleKeypoints:
    """Detected keypoints of the N vehicles in one image, for a pose search."""

    camera: Camera
    """The camera of the image."""
    points: Array
    """(N, 33, 3) x, y in pixels and the probability that the point is correct; with 0 it does not count."""
    sigma_px: Array
    """(N,) standard deviation of a keypoint of probability 1, pixels."""
    cut: NDArray[np.bool_]
    """(N,) whether the image's edge may cut a vehicle. Keypoints beyond the edge then do not count."""


def estimate_poses(
    camera: Camera,
    points: ArrayLike,
    *,
    sigma_px: ArrayLike = 2.0,
    ground: Ground | None = Ground(),  # noqa: B008 (frozen)
    shapes: Shapes | None = None,
    cut: ArrayLike = False,
) -> Poses:
    """Estimate pose and shape of vehicles in one image from their keypoints.

    Args:
        camera: The camera of the image.
        points: (N, 33, 3) x, y in pixels and the probability that the point is correct; with 0 it does not count.
        sigma_px: Standard deviation of a keypoint of probability 1, pixels: one for all vehicles, or (N,).
        ground: The road in the camera's world; None: unknown, and distance follows from the size of vehicles alone.
        shapes: The body types to choose from; None: those of the fleet.
        cut: Whether the image's edge may cut a vehicle: one for all vehicles, or (N,). Keypoints beyond the edge then
            do not count.

    Returns:
        Poses of the N vehicles, in the camera's world; those that cannot be estimated are rejected.
    """
    found = np.asarray(points, dtype=np.float64).reshape(-1, keypoints.K, 3)
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(found))
    at_edge = np.broadcast_to(np.asarray(cut, dtype=bool), len(found))
    return poses_of_images([VehicleKeypoints(camera, found, sigma, at_edge)], ground, shapes)[0]


def poses_of_images(
    images: Sequence[VehicleKeypoints], ground: Ground | None, shapes: Shapes | None = None
) -> list[Poses]:
    """Estimate pose and shape of the vehicles in several images of one place.

    The poses are those that `estimate_poses` gives for each image; together they cost less.

    Args:
        images: The vehicles of each image.
        ground: The road in the world of all cameras; None: unknown.
        shapes: The body types to choose from; None: those of the fleet.

    Returns:
        The poses in each image.
    """
    space = shapes or fleet_shapes()
    if not images:
        return []
    if ground and not ground.level:
        level = [replace(image, camera=levelled(image.camera, ground)[0]) for image in images]
        flat = levelled(images[0].camera, ground)[1]
        return [poses.moved(ground.T_world_level) for poses in poses_of_images(level, flat, space)]
    seen = Observed.joined([observe(image.camera, image.points, image.sigma_px) for image in images])
    cut = np.concatenate([image.cut for image in images])
    parts = np.array_split(np.arange(len(cut)), max(1, round(len(cut) / POSE_LIMITS.chunk_vehicles)))
    chunks = [_locate_chunk(seen.take(part), cut[part], ground, space) for part in parts if part.size]
    together = _joined(chunks).without_rejected()
    ends = np.cumsum([0, *(len(image.points) for image in images)]).tolist()
    return [together.part(slice(first, last)) for first, last in itertools.pairwise(ends)]


def levelled(camera: Camera, ground: Ground) -> tuple[Camera, Ground]:
    """Return camera and ground in the frame in which the ground is the level z = 0 (`Ground.T_world_level`)."""
    flat = replace(ground, height=0.0, slope=(0.0, 0.0), about=(0.0, 0.0))
    return replace(camera, T_camera_world=camera.T_camera_world @ ground.T_world_level), flat


def _locate_chunk(seen: Observed, cut: NDArray[np.bool_], ground: Ground | None, shapes: Shapes) -> Poses:
    fits = best_types(seen, shapes, ground)
    exchanged: dict[int, str] = {}
    margin = np.full(len(fits.cost), np.inf)  # additional cost of the opposite heading
    poor = np.flatnonzero((_doubtful(seen, fits) | cut) & (seen.count >= FEWEST_KEYPOINTS[ground is not None]))
    if poor.size:
        # The detector's keypoints on the hidden sides explain most of the misfits.
        whole, first = seen, fits.take(poor)
        seen, margin[poor] = without_hidden(seen, fits, poor, cut[poor], shapes, ground)
        still = np.flatnonzero(_doubtful(seen, fits)[poor])
        if still.size:  # start again, elsewhere
            rows = poor[still]
            seen = seen.with_rows(rows, whole.take(rows))
            fits.replace_where(rows, first.take(still), np.ones(len(rows), dtype=bool))
            retry_from_subsets(seen, fits, rows, shapes, ground)
            seen, margin[rows] = without_hidden(seen, fits, rows, cut[rows], shapes, ground)
            seen = retry_exchanged(seen, whole.take(rows), fits, rows, shapes, ground, exchanged)
    return _to_poses(seen, fits, shapes, ground, exchanged, margin < POSE_SEARCH.rival_gap, cut)


def _doubtful(seen: Observed, fits: Fits) -> NDArray[np.bool_]:
    """Return (N,) whether too few keypoints agree with the best fit, or it is impossible."""
    few = agreeing_share(seen, fits) < POSE_LIMITS.retry_agreement
    return np.asarray(few | (fits.cost[:, 0] > POSE_LIMITS.impossible_cost))


def _to_poses(
    seen: Observed,
    fits: Fits,
    shapes: Shapes,
    ground: Ground | None,
    exchanged: dict[int, str],
    doubted: NDArray[np.bool_],
    cut: NDArray[np.bool_],
) -> Poses:
    squared = fits.squared[:, 0]
    used = (squared <= INLIER_VARIANCES) & seen.counted
    agreeing = used.sum(axis=1)
    # If residuals exceed `sigma_px`, the covariance grows by the excess (reduced chi-squared).
    excess = np.where(used, squared, 0.0).sum(axis=1) + (fits.a[:, 0] ** 2).sum(axis=1)
    excess /= np.maximum(1, 2 * agreeing - (6 if ground is None else 3))
    covariance = fits.covariance(np.maximum(1.0, excess))
    T = np.tile(np.eye(4), (len(used), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = fits.R[:, 0], fits.p[:, 0]
    if ground is None:  # the fit is in the camera's frame
        to_world = np.linalg.inv(seen.world_to_camera)
        T = to_world @ T
        turn = np.tile(np.eye(4), (len(T), 1, 1))
        turn[:, :3, :3] = to_world[:, :3, :3]
        covariance = turn @ covariance @ np.swapaxes(turn, -1, -2)
    kind = fits.kind[:, 0]
    ahead = np.einsum("ni,ni->n", seen.eye - T[:, :3, 3], T[:, :3, 0])  # metres from the middle to the camera, forward
    rows = shapes.mean[kind] + np.einsum("nm,nmki->nki", fits.a[:, 0], shapes.directions[kind])
    misses = np.where(used, squared * fits.variance[:, 0], 0.0).sum(axis=1)
    return Poses(
        T_world_vehicle=T,
        points=rows[:, :-1],
        size_lwh=np.maximum(rows[:, -1], 0.1),
        covariance=covariance,
        types=tuple(shapes.types[k] for k in kind),
        used=used,
        rms_px=np.sqrt(misses / np.maximum(1, agreeing)),
        refusal=_refusals(seen, fits, T, covariance, agreeing, FEWEST_KEYPOINTS[ground is not None]),
        flags=tuple(
            (*_doubts(ahead[i], seen, fits, i, exchanged.get(i), bool(doubted[i])), *(["cut"] if cut[i] else []))
            for i in range(len(T))
        ),
    )


def _refusals(
    seen: Observed, fits: Fits, T: Array, covariance: Array, agreeing: Array, fewest: int
) -> tuple[str | None, ...]:
    distance = np.linalg.norm(T[:, :3, 3] - seen.eye, axis=1)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1], 0))
    unsure = (spread > np.maximum(1.0, POSE_LIMITS.distance_share * distance)) | (
        covariance[:, 3, 3] > POSE_LIMITS.heading_rad**2
    )
    reasons = (
        seen.count < fewest,
        seen.on_a_line(),
        ~(np.isfinite(T).all(axis=(1, 2)) & (fits.cost[:, 0] < POSE_LIMITS.impossible_cost)),
        agreeing < np.maximum(fewest, POSE_LIMITS.agreement * seen.count),
        unsure | ~np.isfinite(spread),
    )
    found = np.stack([*reasons, np.ones(len(T), dtype=bool)])
    return tuple((*REJECTION_REASONS, None)[i] for i in found.argmax(axis=0))


def _doubts(ahead: float, seen: Observed, fits: Fits, i: int, exchanged: str | None, doubted: bool) -> tuple[str, ...]:
    agree = (fits.squared[i, 0] <= INLIER_VARIANCES) & seen.counted[i]
    forward = fits.R[i, :, :, 0]
    elsewhere = forward @ forward[0] < math.cos(0.5)
    shown = float(seen.probability[i, _FRONT_LAMPS].mean() - seen.probability[i, _REAR_LAMPS].mean())
    doubts = {
        "outliers": agree.sum() < POSE_LIMITS.retry_agreement * seen.counted[i].sum(),
        "heading_in_doubt": doubted
        or (elsewhere & (fits.cost[i] < fits.cost[i, 0] + POSE_LIMITS.heading_cost_gap)).any(),
        "end_in_doubt": abs(ahead) > POSE_LIMITS.beside_m
        and abs(shown) > POSE_LIMITS.lamp_margin
        and ahead * shown < 0,
    }
    return (*((exchanged,) if exchanged else ()), *(name for name, holds in doubts.items() if holds))


def _joined(chunks: list[Poses]) -> Poses:
    if not chunks:
        empty = np.zeros((0, 4, 4))
        return Poses(
            empty, np.zeros((0, keypoints.K, 3)), np.zeros((0, 3)), empty, (), np.zeros((0, keypoints.K), bool),
            np.zeros(0), (), (),
        )  # fmt: skip
    arrays = {
        name: np.concatenate([getattr(chunk, name) for chunk in chunks])
        for name in ("T_world_vehicle", "points", "size_lwh", "covariance", "used", "rms_px")
    }
    return Poses(
        **arrays,
        types=tuple(t for chunk in chunks for t in chunk.types),
        refusal=tuple(r for chunk in chunks for r in chunk.refusal),
        flags=tuple(f for chunk in chunks for f in chunk.flags),
    )
