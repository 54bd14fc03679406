"""Propose what the keypoints of published SKoPe3D scenes are, from where they lie inside the vehicles' 3D boxes.

    python scripts/infer_order.py SCENES... --out map.json     # zips, or folders of them
    skope gen convert SCENES... --from skope3d --map map.json OUT

Each vehicle's eight projected corners give a camera that looks at a cube (a linear fit of 11 parameters to 16 numbers);
each keypoint's mean place in the cube is where the rays of all vehicles that show it meet best. Compared with where the
fleet's keypoints lie, every keypoint gets the name that makes all distances together least (Kuhn and Munkres), the
known ones (roof corners and logo) apart: they say which corner is which. A name must be nearer than any other by the
margin, for the keypoint and for the name, or the keypoint stays unmapped.

It is a proposal: look at a few vehicles before you rely on it.
"""

import argparse
import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import linear_sum_assignment

from skope import keypoints
from skope.errors import UserError
from skope.files.json_files import write_json
from skope.gen.formats.skope3d_scenes import ArchiveVehicle, archives, scene_of
from skope.gen.formats.source_files import opened
from skope.gen.vehicles.fleet import fleet
from skope.keypoints import PUBLISHED, SKOPE3D, K

HALF_SIZE_M = np.array([2.25, 0.9, 0.8])
"""Half of a car's length, width and height: distances in the cube are told in metres of such a car."""
MOST_VEHICLES = 4000
LEAST_VIEWS = 20
FARTHEST_M = 0.6
"""A keypoint that lies farther from the fleet's stays unmapped."""

_PRODUCT = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_RING = [(-1, -1), (-1, 1), (1, 1), (1, -1)]
ORDERS = {"nested": _PRODUCT, "in rings": np.array([(x, y, z) for z in (-1.0, 1.0) for x, y in _RING])}
"""Ways to count a cube's corners; another start, direction or axis is one of its 48 symmetries."""

Array = np.ndarray[Any, np.dtype[np.float64]]


def vehicles_in(sources: Sequence[Path]) -> list[ArchiveVehicle]:
    """Vehicles with a 3D box, at most `MOST_VEHICLES`, evenly from all scenes."""
    found: list[ArchiveVehicle] = []
    paths = archives(sources)
    for path in paths:
        with opened(path) as archive:
            scene = scene_of(archive)
            own = (vehicle for frame in scene.frames for vehicle in scene.vehicles(frame))
            known = (vehicle for vehicle in own if np.ptp(vehicle.corners, axis=0).min() > 4)
            found += itertools.islice(known, -(-MOST_VEHICLES // len(paths)))
    return found


def cameras(corners: Array, cube: Array) -> tuple[Array, Array]:
    """(N, 3, 4) that project the cube (8, 3) to (N, 8, 2), and the (N,) largest misses over the box's size."""
    center = corners.mean(axis=1, keepdims=True)
    scale = np.abs(corners - center).max(axis=(1, 2), keepdims=True)
    uv = (corners - center) / scale
    X = np.column_stack([cube, np.ones(8)])
    zero = np.zeros((len(corners), 8, 4))
    rows = [[X + zero, zero, -uv[..., :1] * X], [zero, X + zero, -uv[..., 1:] * X]]
    A = np.concatenate([np.concatenate(row, axis=2) for row in rows], axis=1)
    P = np.linalg.svd(A)[2][:, -1].reshape(-1, 3, 4)
    P *= np.sign(P[:, 2:, 3:])
    shown = np.einsum("nij,kj->nki", P, X)
    missed = np.abs(shown[..., :2] / shown[..., 2:] - uv).max(axis=(1, 2))
    back = np.zeros((len(P), 3, 3))
    back[:, 0, 0] = back[:, 1, 1] = scale[:, 0, 0]
    back[:, :2, 2], back[:, 2, 2] = center[:, 0], 1
    return back @ P, missed


def place(P: Array, uv: Array, unit: Array) -> Array:
    """(3,) where the rays through pixels (V, 2) of cameras (V, 3, 4) meet best; misses count in `unit` (V,) pixels."""
    rows = (P[:, :2] - uv[..., None] * P[:, 2:]) / (P[:, 2, 3] * unit)[:, None, None]
    A, b = rows[..., :3].reshape(-1, 3), -rows[..., 3].ravel()
    weight = np.ones(len(b))
    for _ in range(5):  # what is far from where most rays meet counts less
        X = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
        away = np.abs(A @ X - b)
        weight = np.sqrt(1 / np.maximum(1, away / (1.5 * np.median(away) + 1e-9)))
    return X


def places(vehicles: Sequence[ArchiveVehicle]) -> tuple[Array, str]:
    """(33, 3) mean place of each keypoint in the cube, NaN where too few show it, and how corners are counted."""
    corners = np.stack([vehicle.corners for vehicle in vehicles])
    fits = {name: cameras(corners, cube) for name, cube in ORDERS.items()}
    order = min(fits, key=lambda name: float(np.median(fits[name][1])))
    P, missed = fits[order]
    if np.median(missed) > 0.05:
        raise UserError("the 3D boxes' corners are counted in no known order")
    good = missed < 0.05
    points = np.stack([vehicle.points for vehicle in vehicles])
    unit = np.ptp(corners, axis=1).max(axis=1)
    out = np.full((K, 3), np.nan)
    for k in range(K):
        seen = good & (points[:, k, 2] == 1)
        if seen.sum() >= LEAST_VIEWS:
            out[k] = place(P[seen], points[seen, k, :2], unit[seen])
    return out, order


def turned(found: Array, ours: Array) -> Array:
    """`found` with the cube's axes as the known keypoints have them."""
    known = [i for i in SKOPE3D if np.isfinite(found[i]).all()]
    if len(known) < 3:
        raise UserError(f"of the known keypoints only {len(known)} are seen often enough to tell front from rear")
    best: tuple[float, Array] | None = None
    for axes in itertools.permutations(range(3)):
        for signs in itertools.product((-1, 1), repeat=3):
            candidate = found[:, axes] * signs
            miss = float(np.linalg.norm((candidate[known] - ours[known]) * HALF_SIZE_M, axis=1).mean())
            if best is None or miss < best[0]:
                best = miss, candidate
    assert best is not None
    return best[1]


def fleet_places() -> Array:
    """(33, 3) median place of the fleet's keypoints in their boxes, of which each axis goes from -1 to 1.

    Where rays meet best is near the place that most vehicles have, and far from the mean where lorries have another.
    """
    rows = []
    for entry in fleet(further=False).values():
        size = np.array(entry.vehicle.size_lwh)
        rows.append((entry.vehicle.points - [0, 0, size[2] / 2]) / (size / 2))
    return np.asarray(np.median(rows, axis=0))


def propose(found: Array, ours: Array, margin: float) -> list[tuple[int, int | None, float, float]]:
    """Of each unknown keypoint: index, proposed index (None: unmapped), distance and margin in metres."""
    theirs = [k for k in range(K) if k not in SKOPE3D and np.isfinite(found[k]).all()]
    names = [k for k in range(K) if k not in SKOPE3D.values()]
    apart = np.linalg.norm((found[theirs][:, None] - ours[names][None]) * HALF_SIZE_M, axis=-1)
    rows: list[tuple[int, int | None, float, float]] = []
    for i, j in zip(*linear_sum_assignment(apart), strict=True):
        rivals = np.concatenate([np.delete(apart[i], j), np.delete(apart[:, j], i)])
        lead = float(rivals.min() - apart[i, j])
        sure = lead >= margin and apart[i, j] <= FARTHEST_M
        rows.append((theirs[i], names[j] if sure else None, float(apart[i, j]), lead))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("scenes", nargs="+", type=Path, help="scene_K.zip, or folders of them")
    parser.add_argument("--out", type=Path, default=Path("map.json"), help="for `skope gen convert --map`")
    parser.add_argument("--margin", type=float, default=0.05, help="metres by which a name must be nearest")
    arguments = parser.parse_args()
    try:
        if not arguments.margin >= 0:
            raise UserError(f"--margin: expected metres from 0, got {arguments.margin}")
        vehicles = vehicles_in(arguments.scenes)
        if len(vehicles) < LEAST_VIEWS:
            raise UserError(f"only {len(vehicles)} vehicles with 3D boxes; expected {LEAST_VIEWS} or more")
        ours = fleet_places()
        found, order = places(vehicles)
        rows = propose(turned(found, ours), ours, arguments.margin)
        sure = {PUBLISHED.names[k]: keypoints.NAMES[name] for k, name, _, _ in rows if name is not None}
        write_json(arguments.out, sure)
    except UserError as error:
        parser.exit(2, f"infer_order: {error}\n")
    print(f"{len(vehicles)} vehicles, corners counted {order}")
    for k, name, distance, lead in rows:
        proposed = "unmapped" if name is None else keypoints.NAMES[name]
        print(f"{PUBLISHED.names[k]}  {proposed:<24} {distance:.2f} m from the fleet's, {lead:.2f} m ahead")
    print(f"wrote {arguments.out}: {len(sure)} of {K - len(SKOPE3D)} keypoints; the others stay unmapped")


if __name__ == "__main__":
    main()
