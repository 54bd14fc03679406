"""Say where the vehicles of a camera image are, in metres: position, heading and size, with how sure that is.

    python examples/locate_vehicles.py IMAGE CAMERA

CAMERA is a calibration file, or an annotation file of `skope gen`, of which the first image's camera is taken.
"""

import sys

import numpy as np

import skope


def main(image: str, camera: str) -> None:
    found = skope.load_detector()(image).above(0.5)
    located = skope.estimate_poses(found, skope.read_camera(camera))
    poses = located.poses
    print("     x      y  +- m  heading  length  type")
    for i in np.flatnonzero(located.good):
        x, y, _ = poses.position[i]
        sigma = np.sqrt(np.diag(poses.covariance[i])[:2].max())
        heading = np.degrees(poses.yaw[i])
        print(f"{x:6.1f} {y:6.1f} {sigma:5.2f} {heading:8.0f} {poses.size_lwh[i, 0]:7.1f}  {poses.types[i]}")
    print(f"{len(found)} vehicles, {int((~located.good).sum())} of them without a position")


if __name__ == "__main__":
    main(*sys.argv[1:])
