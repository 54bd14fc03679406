"""Propose names for the keypoints of published SKoPe3D scenes, from their positions in the vehicles' 3D boxes.

    python scripts/infer_order.py SCENES... --out map.json     # zips, or folders of them
    skope gen convert SCENES... --from skope3d --map map.json OUT

The eight projected corners of each vehicle give a camera that looks at a cube (a linear fit of 11 parameters to 16
numbers). The mean position of a keypoint in the cube is the point nearest to the rays of all vehicles that show it.
Each keypoint gets the name of a keypoint of the fleet, so that the sum of all distances is smallest (Kuhn and Munkres).
The known keypoints (roof corners and logo) are not renamed; they decide which corner is which. A name must be nearer
than any other by the margin, for the keypoint and for the name; otherwise the keypoint stays unmapped.

The result is a proposal: check it on a few vehicles before you rely on it.
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
"""Half the length, width and height of a car; distances in the cube are given in metres of such a car."""
MOST_VEHICLES = 4000
LEAST_VIEWS = 20
FARTHEST_M = 0.6
"""A keypoint that is farther than this from the fleet's keypoints stays unmapped."""

_PRODUCT = np.array(list(itertools.product((-1.0, 1.0), repeat=3)))
_RING = [(-1, -1), (-1, 1), (1, 1), (1, -1)]
ORDERS = {"nested": _PRODUCT, "in rings": np.array([(x, y, z) for z in (-1.0, 1.0) for x, y in _RING])}
"""Orders of a cube's corners; a different start, direction or axis is one of its 48 symmetries."""

Array = np.ndarray[Any, np.dtype[np.float64]]


def vehicles_in(sources: Sequence[Path]) -> list[ArchiveVehicle]:
    """Read vehicles with a 3D box, at most `MOST_VEHICLES`, evenly from all scenes."""
    found: list[ArchiveVehicle] = []
    paths = archives(sources)
    for path in paths:
        with opened(path) as archive:
            scene = scene_of(archive)
            vehicles = (vehicle for frame in scene.frames for vehicle in scene.vehicles(frame))
            known = (vehicle for vehicle in vehicles if np.ptp(vehicle.corners, axis=0).min() > 4)
            found += itertools.islice(known, -(-MOST_VEHICLES // len(paths)))
    return found


def cameras(corners: Array, cube: Array) -> tuple[Array, Array]:
    """Fit cameras to the corners of 3D boxes.

    Returns:
        (N, 3, 4) cameras that project the cube (8, 3) to (N, 8, 2), and their (N,) largest misses, relative to the size
        of the box.
    """
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


def meeting_point(P: Array, uv: Array, unit: Array) -> Array:
    """Return the point (3,) nearest to the rays through pixels (V, 2) of cameras (V, 3, 4).

    Misses are weighted by `unit` (V,), in pixels.
    """
    rows = (P[:, :2] - uv[..., None] * P[:, 2:]) / (P[:, 2, 3] * unit)[:, None, None]
    A, b = rows[..., :3].reshape(-1, 3), -rows[..., 3].ravel()
    weight = np.ones(len(b))
    for _ in range(5):  # outliers get less weight
        X = np.linalg.lstsq(A * weight[:, None], b * weight, rcond=None)[0]
        away = np.abs(A @ X - b)
        weight = np.sqrt(1 / np.maximum(1, away / (1.5 * np.median(away) + 1e-9)))
    return X


def places(vehicles: Sequence[ArchiveVehicle]) -> tuple[Array, str]:
    """Return the mean position (33, 3) of each keypoint in the cube, and the order of the corners.

    Keypoints that are visible in too few views are NaN.
    """
    corners = np.stack([vehicle.corners for vehicle in vehicles])
    fits = {name: cameras(corners, cube) for name, cube in ORDERS.items()}
    order = min(fits, key=lambda name: float(np.median(fits[name][1])))
    P, missed = fits[order]
    if np.median(missed) > 0.05:
        raise UserError("the corners of the 3D boxes are not in a known order")
    good = missed < 0.05
    points = np.stack([vehicle.points for vehicle in vehicles])
    unit = np.ptp(corners, axis=1).max(axis=1)
    out = np.full((K, 3), np.nan)
    for k in range(K):
        seen = good & (points[:, k, 2] == 1)
        if seen.sum() >= LEAST_VIEWS:
            out[k] = meeting_point(P[seen], points[seen, k, :2], unit[seen])
    return out, order


def turned(found: Array, ours: Array) -> Array:
    """Turn `found` so that its known keypoints agree with ours."""
    known = [i for i in SKOPE3D if np.isfinite(found[i]).all()]
    if len(known) < 3:
        raise UserError(f"only {len(known)} of the known keypoints are visible often enough to tell front from rear")
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
    """Return the median positions (33, 3) of the fleet's keypoints in their boxes, whose axes run from -1 to 1.

    The point nearest to most rays lies near the position of most vehicles. The mean would be shifted by lorries.
    """
    rows = []
    for entry in fleet(further=False).values():
        size = np.array(entry.vehicle.size_lwh)
        rows.append((entry.vehicle.points - [0, 0, size[2] / 2]) / (size / 2))
    return np.asarray(np.median(rows, axis=0))


def propose(found: Array, ours: Array, margin: float) -> list[tuple[int, int | None, float, float]]:
    """Propose a name for each unknown keypoint.

    Returns:
        For each: index, proposed index (None: unmapped), distance and margin in metres.
    """
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
    parser.add_argument("--margin", type=float, default=0.05, help="metres by which a name must be nearer than others")
    arguments = parser.parse_args()
    try:
        if not arguments.margin >= 0:
            raise UserError(f"--margin: expected 0 or more metres, got {arguments.margin}")
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
    print(f"{len(vehicles)} vehicles, order of the corners: {order}")
    for k, name, distance, lead in rows:
        proposed = "unmapped" if name is None else keypoints.NAMES[name]
        print(f"{PUBLISHED.names[k]}  {proposed:<24} {distance:.2f} m from the fleet's, margin {lead:.2f} m")
    print(f"wrote {arguments.out}: {len(sure)} of {K - len(SKOPE3D)} keypoints; the others stay unmapped")


if __name__ == "__main__":
    main()
