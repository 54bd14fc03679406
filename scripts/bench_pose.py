"""Poses from keypoints with 2 px of noise, of a generated dataset's vehicles: skope against OpenCV's solvePnP.

The peer is plain `solvePnP` (iterative) with the fleet's average vehicle, on the same visible keypoints. Both run on
one core. Run: OMP_NUM_THREADS=1 python scripts/bench_pose.py DATASET/annotations/SPLIT.json
"""

import sys
import time
from pathlib import Path

import cv2
import numpy as np

from skope import coco
from skope.eval import pose
from skope.eval.shapes import fleet_shapes

NOISE = 2.0
BANDS = ((0, 10), (10, 20), (20, 30), (30, 40), (40, 60))
FEWEST = 8
"""Visible keypoints a vehicle must have to be counted here."""


def main(path: Path) -> None:
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    file = coco.read(path)
    mean = fleet_shapes().mean_vehicle()[:-1]
    ours, peers, distances, seconds = [], [], [], np.zeros(2)
    for image in file.images:
        vehicles = [a for a in file.by_image()[image.id] if not a.ignored and (a.keypoints[:, 2] == 2).sum() >= FEWEST]
        if not vehicles:
            continue
        camera = image.camera
        assert camera is not None
        found = np.stack([a.keypoints for a in vehicles])
        seen = found[..., 2] == 2
        found[..., :2] += rng.normal(0, NOISE, found[..., :2].shape)
        found[..., 2] = seen
        road = np.array([a.box_3d.center - a.box_3d.R @ [0, 0, a.box_3d.size_lwh[2] / 2] for a in vehicles])

        begun = time.process_time()
        poses = pose.locate(camera, found, sigma_px=NOISE)
        seconds[0] += time.process_time() - begun

        begun = time.process_time()
        T = np.linalg.inv(camera.T_camera_world)
        theirs = np.empty((len(vehicles), 3))
        for i, row in enumerate(found):
            rays, _ = camera.rays(row[seen[i], :2])
            _, _, shift = cv2.solvePnP(mean[seen[i]], rays[:, :2].copy(), np.eye(3), None)
            theirs[i] = T[:3, :3] @ shift[:, 0] + T[:3, 3]
        seconds[1] += time.process_time() - begun

        ours += np.linalg.norm((poses.position - road)[:, :2], axis=1).tolist()
        peers += np.linalg.norm((theirs - road)[:, :2], axis=1).tolist()
        distances += [a.distance for a in vehicles]
    a, b, distance = np.array(ours), np.array(peers), np.array(distances)
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
    main(Path(sys.argv[1]))
