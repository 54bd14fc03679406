"""Position, heading and shape of vehicles from their keypoints, many vehicles at once.

Each vehicle is a deformable model (`skope.eval.shapes`) that is moved, turned and bent until its keypoints project to
where they were found: the most probable pose and shape given

- keypoints that are off by `sigma_px`, more where their score is lower, with the heavy tails of a Cauchy distribution;
- shapes as vehicles of the body type have them;
- wheels that stand on the road, where `ground` says where that is.

The search starts from every body type's mean (on a known ground in closed form, see `skope.eval.start`), goes on by
Levenberg and Marquardt's method from the best few, and is repeated from random subsets of the keypoints, and with sides
or ends of the vehicle exchanged, for vehicles that do not fit. What is not supported by enough keypoints is refused.
"""

import math
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope import keypoints
from skope.camera import Camera
from skope.eval import start
from skope.eval.hidden import facing
from skope.eval.observe import Mask, Observed, observe
from skope.eval.refine import Fits, Ground, refine
from skope.eval.shapes import Shapes, fleet_shapes
from skope.eval.start import Starts

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
Kinds = NDArray[np.intp]

REFUSALS: Final = ("few_keypoints", "on_a_line", "no_fit", "inconsistent", "uncertain")
"""Why a vehicle has no pose: fewer keypoints than a pose needs; keypoints on one line; nothing in front of the camera
fits; more than 60% of the keypoints contradict the rest; the covariance says that the answer is worth nothing."""
FLAGS: Final = ("sides_exchanged", "ends_exchanged", "turned_around", "outliers", "heading_in_doubt", "end_in_doubt")
"""What a pose should be distrusted for: keypoints that fit only with left and right, or front and rear, or both taken
for each other; some keypoints left out; another heading fits about as well; the keypoints that are seen belong to the
end that faces away from the camera."""

_KEPT: Final = 2
"""Body types that go on from the start."""
_CHUNK: Final = 128
_FEWEST: Final = {True: 4, False: 6}
"""Keypoints a pose needs, with and without a known ground."""
_INLIER: Final = 9.0
"""Squared distance, in variances, up to which a keypoint agrees."""
_AGREE: Final = 0.4
"""Detectors that learn from visible keypoints alone put hidden ones, half of all, anywhere, with a high score."""
_DOUBT: Final = 0.8
"""Share of agreeing keypoints under which other starts are tried."""
_SUBSETS: Final = {True: 24, False: 4}
"""Random starts, with and without a known ground."""
_SUBSET: Final = 6
_BETTER: Final = 12.0
"""How much lower (twice the log likelihood) the cost must be for labels to count as exchanged."""
_LEVEL: Final = 6.0
"""Difference of cost within which another heading is as good."""
_HIDDEN: Final = 9.0
"""What a keypoint costs that lies anywhere: about a box's area over that of its own spread, as a log likelihood."""
_RIVAL: Final = 30.0
"""Difference of cost within which the opposite heading leaves doubt: 2% of the right ones, half of the wrong."""
_LOOKS: Final = 2
"""How often it is looked again what a pose hides."""
_HOPELESS: Final = 1e5
_BESIDE: Final = 6.0
"""Metres before or behind a vehicle's middle from which a camera sees one end of it and not the other."""
_SHOWN: Final = 0.4
"""How much more probable the lamps of one end must be to contradict that."""
_WORST_HEADING: Final = math.radians(25)
_WORST_DISTANCE: Final = 0.1
"""Largest standard deviation of the position as a share of the distance, at least 1 m."""


_OPPOSITE: Final = {
    "roof_front": "roof_rear",
    "windscreen_base": "rear_window_base",
    "headlight_outer": "taillight_outer",
    "headlight_inner": "taillight_inner",
    "wheel_front": "wheel_rear",
    "bumper_front": "bumper_rear",
    "hood_front": "trunk_rear",
}


def _other_end(name: str) -> str:
    stem, _, side = name.rpartition("_")
    both = _OPPOSITE | {b: a for a, b in _OPPOSITE.items()}
    return f"{both[stem]}_{side}" if stem in both else name


ENDS: Final = tuple(keypoints.INDEX[_other_end(name)] for name in keypoints.NAMES)
"""`ENDS[i]` is the keypoint that `i` becomes when front and rear are taken for each other (a permutation)."""
assert all(ENDS[ENDS[i]] == i for i in range(keypoints.K))

_EXCHANGED: Final = (
    (FLAGS[0], list(keypoints.FLIP)),
    (FLAGS[1], list(ENDS)),
    (FLAGS[2], [keypoints.FLIP[i] for i in ENDS]),
)
_FRONT: Final = [i for i, name in enumerate(keypoints.NAMES) if name.startswith(("headlight", "front_logo"))]
_REAR: Final = [i for i, name in enumerate(keypoints.NAMES) if name.startswith("taillight")]


@dataclass(frozen=True, eq=False)
class Poses:
    """Answers for N vehicles; where `refusal` is not None the numbers mean nothing."""

    T_world_vehicle: Array
    """(N, 4, 4)"""
    points: Array
    """(N, 33, 3) keypoints in the vehicle frame, metres."""
    size_lwh: Array
    """(N, 3)"""
    covariance: Array
    """(N, 4, 4) of x, y, z (world, metres) and the turn about the vehicle's upright axis (radians)."""
    types: tuple[str, ...]
    """The body type that fits best."""
    used: NDArray[np.bool_]
    """(N, 33) keypoints that agree with the pose."""
    rms_px: Array
    """(N,) over the keypoints that agree."""
    refusal: tuple[str | None, ...]
    flags: tuple[tuple[str, ...], ...]

    def __len__(self) -> int:
        return len(self.types)

    def moved(self, T: Array) -> Self:
        """The same vehicles in another world, `T` (4, 4) from this one to it; headings turn about the upright axes."""
        turn = np.eye(4)
        turn[:3, :3] = T[:3, :3]
        return replace(self, T_world_vehicle=T @ self.T_world_vehicle, covariance=turn @ self.covariance @ turn.T)

    @property
    def yaw(self) -> Array:
        """(N,) heading, counter-clockwise from world x, radians."""
        R = self.T_world_vehicle[:, :3, :3]
        return np.asarray(np.arctan2(R[:, 1, 0], R[:, 0, 0]))

    @property
    def position(self) -> Array:
        """(N, 3) on the ground under the middle of the box, world."""
        return self.T_world_vehicle[:, :3, 3]


def locate(
    camera: Camera,
    points: ArrayLike,
    *,
    sigma_px: ArrayLike = 2.0,
    ground: Ground | None = Ground(),  # noqa: B008 (frozen)
    shapes: Shapes | None = None,
) -> Poses:
    """Pose and shape of vehicles from their keypoints (N, 33, 3): x, y in pixels and the probability that it is right.

    Keypoints with probability 0 do not count. `sigma_px`, one for all or one a vehicle, is the standard deviation
    of a keypoint of probability 1. `ground` is where the road is in the camera's world; None: unknown, so that distance
    rests on the size of vehicles alone. `shapes` are the body types to choose from, by default the fleet's.
    """
    found = np.asarray(points, dtype=np.float64).reshape(-1, keypoints.K, 3)
    sigma = np.broadcast_to(np.asarray(sigma_px, dtype=np.float64), len(found))
    space = shapes or fleet_shapes()
    if ground and not ground.level:
        camera, flat = levelled(camera, ground)
        return locate(camera, found, sigma_px=sigma, ground=flat, shapes=space).moved(ground.T_world_level)
    rng = np.random.default_rng(0)  # which subsets are tried must not depend on what was run before
    chunks = [
        _locate(camera, found[i : i + _CHUNK], sigma[i : i + _CHUNK], ground, space, rng)
        for i in range(0, len(found), _CHUNK)
    ]
    return _joined(chunks)


def levelled(camera: Camera, ground: Ground) -> tuple[Camera, Ground]:
    """Camera and ground in the frame in which the ground is the level z = 0 (`Ground.T_world_level`)."""
    flat = replace(ground, height=0.0, slope=(0.0, 0.0), about=(0.0, 0.0))
    return replace(camera, T_camera_world=camera.T_camera_world @ ground.T_world_level), flat


def _locate(
    camera: Camera, found: Array, sigma: Array, ground: Ground | None, shapes: Shapes, rng: np.random.Generator
) -> Poses:
    seen = observe(camera, found, sigma)
    fits = best_types(seen, shapes, ground)
    exchanged: dict[int, str] = {}
    doubted: set[int] = set()
    doubtful = (_share(seen, fits) < _DOUBT) | (fits.cost[:, 0] > _HOPELESS)
    poor = np.flatnonzero(doubtful & (seen.count >= _FEWEST[ground is not None]))
    if poor.size:
        _retry_from_subsets(seen, fits, poor, shapes, ground, rng)
        whole = seen.take(poor)
        seen, margin = _without_hidden(camera, seen, fits, poor, shapes, ground)
        doubted.update(poor[margin < _RIVAL].tolist())
        seen = _retry_exchanged(seen, whole, fits, poor, shapes, ground, exchanged)
    return _judged(camera, seen, fits, shapes, ground, exchanged, doubted)


def _starts(seen: Observed, shapes: Shapes, ground: Ground | None, chosen: Mask | None = None) -> Starts:
    return start.on_ground(seen, shapes, ground, chosen) if ground else start.free(seen, shapes, chosen)


def _refined(seen: Observed, shapes: Shapes, ground: Ground | None, starts: Starts, kinds: Kinds) -> Fits:
    """(N, kept) fits from the best starts of each vehicle, the best first."""
    chosen = np.argsort(starts.cost, axis=1)[:, : min(_KEPT, starts.cost.shape[1])]
    return refine(seen, shapes, ground, starts.take(chosen), kinds[chosen]).ordered()


def best_types(seen: Observed, shapes: Shapes, ground: Ground | None) -> Fits:
    """Fits of the likeliest body types to each vehicle, the best first, without second tries."""
    return _refined(seen, shapes, ground, _starts(seen, shapes, ground), np.arange(len(shapes.types)))


def _share(seen: Observed, fits: Fits) -> Array:
    """(N,) of the keypoints that count, how many agree with the best fit."""
    agree = (fits.squared[:, 0] <= _INLIER) & seen.counted
    return np.asarray(agree.sum(axis=1) / np.maximum(seen.count, 1))


def _retry_from_subsets(
    seen: Observed, fits: Fits, poor: Rows, shapes: Shapes, ground: Ground | None, rng: np.random.Generator
) -> None:
    """Random few keypoints place the vehicles `poor`; where that ends in a better fit to all, it takes the place."""
    times = _SUBSETS[ground is not None]
    some, again = seen.take(poor), seen.take(np.tile(poor, times))
    starts = _starts(again, shapes, ground, again.subsets(_SUBSET, rng)).gathered(times)
    better = _refined(some, shapes, ground, starts, np.tile(np.arange(len(shapes.types)), times))
    fits.replace_where(poor, better, better.cost[:, 0] < fits.cost[poor, 0])


def _without_hidden(
    camera: Camera, seen: Observed, fits: Fits, poor: Rows, shapes: Shapes, ground: Ground | None
) -> tuple[Observed, Array]:
    """Fit the vehicles `poor` without the keypoints that their own bodies hide, as they stand and turned around.

    Detectors give those high scores too. Returns `seen` without what was left out where that explains more (a keypoint
    that is hidden may lie anywhere, at the cost `_HIDDEN`), and by how much the opposite heading costs more.
    """
    some, every = seen.take(poor), np.arange(len(poor))
    best, cost = fits.take(poor), fits.cost[poor, 0].copy()
    rival = np.full(len(poor), np.inf)  # the least cost of heading the other way
    for turned in (False, True):
        guess, reached = best.take(every), np.full(len(poor), np.inf)
        for look in range(_LOOKS):
            shown = _shown(camera, guess, shapes, ground, turned=turned and not look)
            enough = (some.counted & shown).sum(axis=1) >= _FEWEST[ground is not None]
            tried = replace(some, counted=some.counted & (shown | ~enough[:, None]))
            guess = best_types(tried, shapes, ground)
            whole = np.where(enough, guess.cost[:, 0] + _HIDDEN * (some.count - tried.count), np.inf)
            reached = np.minimum(reached, np.where(_opposite(guess, best), whole, np.inf))
            wins = whole < cost
            rival = np.where(wins & _opposite(guess, best), cost, rival)
            best.replace_where(every, guess, wins)
            cost = np.where(wins, whole, cost)
            seen = seen.with_rows(poor[wins], tried.take(np.flatnonzero(wins)))
        rival = np.minimum(rival, reached)
    fits.replace_where(poor, best, np.ones(len(poor), dtype=bool))
    return seen, rival - cost


def _opposite(one: Fits, other: Fits) -> Mask:
    """(N,) whether the best fits head opposite ways."""
    return np.asarray(np.einsum("ni,ni->n", one.R[:, 0, :, 0], other.R[:, 0, :, 0]) < 0)


def _shown(camera: Camera, fits: Fits, shapes: Shapes, ground: Ground | None, *, turned: bool) -> Mask:
    """(N, 33) the keypoints that the best fit's own body does not hide; `turned`: were front and rear exchanged."""
    R, p, kind = fits.R[:, 0], fits.p[:, 0], fits.kind[:, 0]
    if turned:
        R = R * np.array([-1.0, -1.0, 1.0])
    eye = (np.zeros(3) if ground is None else camera.position) - p
    return facing(shapes, kind, shapes.mean[kind, :-1], np.einsum("nij,ni->nj", R, eye))


def _retry_exchanged(
    seen: Observed,
    whole: Observed,
    fits: Fits,
    poor: Rows,
    shapes: Shapes,
    ground: Ground | None,
    exchanged: dict[int, str],
) -> Observed:
    """Fit the vehicles `poor` with other labels; returns `seen` with the labels that fit clearly better.

    `whole` are these vehicles with the keypoints that `seen` has without those that are hidden.
    """
    for name, order in _EXCHANGED:
        some = whole.relabelled(order)
        other = best_types(some, shapes, ground)
        left_out = whole.count - seen.count[poor]
        wins = other.cost[:, 0] < fits.cost[poor, 0] + _HIDDEN * left_out - _BETTER
        fits.replace_where(poor, other, wins)
        seen = seen.with_rows(poor[wins], some.take(np.flatnonzero(wins)))
        exchanged |= dict.fromkeys(poor[wins].tolist(), name)
    return seen


def _judged(
    camera: Camera,
    seen: Observed,
    fits: Fits,
    shapes: Shapes,
    ground: Ground | None,
    exchanged: dict[int, str],
    doubted: set[int],
) -> Poses:
    squared = fits.squared[:, 0]
    used = (squared <= _INLIER) & seen.counted
    agreeing = used.sum(axis=1)
    # Noise larger than promised makes the answer as much less certain.
    excess = np.where(used, squared, 0.0).sum(axis=1) + (fits.a[:, 0] ** 2).sum(axis=1)
    excess /= np.maximum(1, 2 * agreeing - (6 if ground is None else 3))
    covariance = fits.covariance(np.maximum(1.0, excess))
    T = np.tile(np.eye(4), (len(used), 1, 1))
    T[:, :3, :3], T[:, :3, 3] = fits.R[:, 0], fits.p[:, 0]
    if ground is None:  # worked out in the camera's frame
        to_world = np.linalg.inv(camera.T_camera_world)
        T = to_world @ T
        turn = np.eye(4)
        turn[:3, :3] = to_world[:3, :3]
        covariance = turn @ covariance @ turn.T
    kind = fits.kind[:, 0]
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
        refusal=_refusals(camera, seen, fits, T, covariance, agreeing, _FEWEST[ground is not None]),
        flags=tuple(_doubts(camera, seen, fits, T[i], i, exchanged.get(i), i in doubted) for i in range(len(T))),
    )


def _refusals(
    camera: Camera, seen: Observed, fits: Fits, T: Array, covariance: Array, agreeing: Array, fewest: int
) -> tuple[str | None, ...]:
    distance = np.linalg.norm(T[:, :3, 3] - camera.position, axis=1)
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance[:, :3, :3])[:, -1], 0))
    unsure = (spread > np.maximum(1.0, _WORST_DISTANCE * distance)) | (covariance[:, 3, 3] > _WORST_HEADING**2)
    reasons = (
        seen.count < fewest,
        seen.on_a_line(),
        ~(np.isfinite(T).all(axis=(1, 2)) & (fits.cost[:, 0] < _HOPELESS)),
        agreeing < np.maximum(fewest, _AGREE * seen.count),
        unsure | ~np.isfinite(spread),
    )
    found = np.stack([*reasons, np.ones(len(T), dtype=bool)])
    return tuple((*REFUSALS, None)[i] for i in found.argmax(axis=0))


def _doubts(
    camera: Camera, seen: Observed, fits: Fits, T: Array, i: int, exchanged: str | None, doubted: bool
) -> tuple[str, ...]:
    agree = (fits.squared[i, 0] <= _INLIER) & seen.counted[i]
    forward = fits.R[i, :, :, 0]
    elsewhere = forward @ forward[0] < math.cos(0.5)
    ahead = float((camera.position - T[:3, 3]) @ T[:3, 0])
    shown = float(seen.probability[i, _FRONT].mean() - seen.probability[i, _REAR].mean())
    doubts = {
        "outliers": agree.sum() < _DOUBT * seen.counted[i].sum(),
        "heading_in_doubt": doubted or (elsewhere & (fits.cost[i] < fits.cost[i, 0] + _LEVEL)).any(),
        "end_in_doubt": abs(ahead) > _BESIDE and abs(shown) > _SHOWN and ahead * shown < 0,
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
