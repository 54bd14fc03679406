"""Poses from keypoints with 2 px of noise, of a generated dataset's vehicles: skope against OpenCV's solvePnP.

The peer is plain `solvePnP` (iterative) with the fleet's average vehicle, on the same visible keypoints. Both run on
one core. Run: OMP_NUM_THREADS=1 python scripts/bench_pose.py DATASET/annotations/SPLIT.json
"""

import argparse
import time
from pathlib import Path

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.dataset import coco
from skope.errors import UserError
from skope.pose import estimate_pose
from skope.pose.shape_model import fleet_shapes

NOISE = 2.0
BANDS = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 60))
FEWEST = 8
"""Visible keypoints a vehicle must have to be counted here."""
Array = np.ndarray


def measured(path: Path) -> tuple[Array, Array, Array]:
    """(2, N) position errors of skope and solvePnP in metres, (N,) distances, (2,) seconds that they took."""
    rng = np.random.default_rng(0)
    file = coco.read(path)
    mean = fleet_shapes().mean_vehicle()[:-1]
    errors: tuple[list[float], list[float]] = ([], [])
    distances, seconds = [], np.zeros(2)
    annotations = file.by_image()
    for image in file.images:
        vehicles = [a for a in annotations[image.id] if not a.ignored and (a.keypoints[:, 2] == 2).sum() >= FEWEST]
        if not vehicles:
            continue
        camera = image.camera
        if camera is None or any(a.box_3d is None for a in vehicles):
            raise UserError(f"{path}: {image.file_name}: needs a camera, and box_3d of every vehicle")
        found = np.stack([a.keypoints for a in vehicles])
        seen = found[..., 2] == 2
        found[..., :2] += rng.normal(0, NOISE, found[..., :2].shape)
        found[..., 2] = seen
        road = np.array([a.box_3d.center - a.box_3d.R @ [0, 0, a.box_3d.size_lwh[2] / 2] for a in vehicles])
        begun = time.process_time()
        ours = estimate_pose.locate(camera, found, sigma_px=NOISE).position
        between = time.process_time()
        theirs = solve_pnp(camera, found, seen, mean)
        seconds += [between - begun, time.process_time() - between]
        for own, position in zip(errors, (ours, theirs), strict=True):
            own.extend(np.linalg.norm((position - road)[:, :2], axis=1).tolist())
        distances += [a.distance for a in vehicles]
    if not distances:
        raise UserError(f"{path}: no vehicle has {FEWEST} visible keypoints")
    return np.array(errors), np.array(distances), seconds


def solve_pnp(camera: Camera, found: Array, seen: Array, mean: Array) -> Array:
    """(N, 3) world positions by the peer."""
    T = np.linalg.inv(camera.T_camera_world)
    out = np.empty((len(found), 3))
    for i, row in enumerate(found):
        rays, _ = camera.rays(row[seen[i], :2])
        _, _, shift = cv2.solvePnP(mean[seen[i]], rays[:, :2].copy(), np.eye(3), None)
        out[i] = T[:3, :3] @ shift[:, 0] + T[:3, 3]
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("annotations", type=Path, help="annotation file of a split, with cameras and 3D boxes")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    try:
        (a, b), distance, seconds = measured(options.annotations)
    except UserError as error:
        parser.exit(2, f"bench_pose: {error}\n")
    print(f"{len(a)} vehicles, {NOISE:g} px of noise; position error in metres, median (90%)")
    print(f"{'distance':>10} {'vehicles':>9} {'skope':>16} {'solvePnP':>16} {'ratio':>6}")
    for low, high in BANDS:
        band = (distance >= low) & (distance < high)
        if band.any():
            cells = [f"{np.median(e[band]):7.3f} ({np.percentile(e[band], 90):6.3f})" for e in (a, b)]
            ratio = np.median(a[band]) / np.median(b[band])
            print(f"{low:>4}-{high:<3} m {band.sum():9d} {cells[0]:>16} {cells[1]:>16} {ratio:6.2f}")
    rates = len(a) / seconds
    print(f"vehicles a second on one core, image by image: skope {rates[0]:.0f}, solvePnP {rates[1]:.0f}")


if __name__ == "__main__":
    main()
