"""Offsets of the fleet's keypoints from hand-placed labels, on photographs of real vehicles.

    python scripts/research/marker_offsets.py dev_real.json

For each kind of keypoint, the fleet's shape space is fitted to the other labelled keypoints of each vehicle, without
road and camera. The field of view of a site is the one of a few candidates at which its vehicles fit best. The
keypoints of the kind are then projected and compared with their labels. Each kind has a row with the number of points,
the median distance, and the median shift of the labels from the model: outwards from the middle of the box along the
image's rows, and downwards; in hundredths of the longer edge of the box.
"""

import argparse
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from skope import keypoints
from skope.camera.model import Camera
from skope.dataset import coco
from skope.pose.estimate_pose import Poses, estimate_poses
from skope.pose.shape_model import Shapes, fleet_shapes, read_shapes
from skope.schema import Annotation, Image
from skope.types import Array

FIELDS_DEG = (12.0, 20.0, 30.0, 45.0, 65.0)
FEWEST = 7
"""Fewest points that a vehicle is fitted to."""
SIGMA = 0.012
"""Standard deviation of a label, relative to the longer edge of the box."""


def kinds() -> dict[str, list[int]]:
    """Return the indices of the keypoints of each kind, both sides together."""
    out = defaultdict(list)
    for i, name in enumerate(keypoints.NAMES):
        out[name.removesuffix("_left").removesuffix("_right")].append(i)
    return dict(out)


def fitted(image: Image, vehicles: list[Annotation], fov_deg: float, without: list[int], shapes: Shapes) -> Poses:
    """Fit the vehicles of an image to their labelled keypoints except those in `without`."""
    camera = camera_of(image, fov_deg)
    found = np.array([a.keypoints for a in vehicles])
    found[..., 2] = found[..., 2] == 2
    found[:, without, 2] = 0
    longer = np.array([max(a.bbox[2:]) for a in vehicles])
    return estimate_poses(camera, found, sigma_px=SIGMA * longer, ground=None, shapes=shapes)


def camera_of(image: Image, fov_deg: float) -> Camera:
    """Return a level camera with that field of view."""
    size = (image.width, image.height)
    return Camera.looking([0, 0, 0], yaw=0, pitch_down=0, roll=0, size=size, fov=np.radians(fov_deg))


def field_of_view(images: list[tuple[Image, list[Annotation]]], shapes: Shapes) -> float:
    """Return the field of view, degrees, under which the vehicles of one site fit best."""

    def misfit(fov_deg: float) -> float:
        costs = []
        for image, vehicles in images:
            poses = fitted(image, vehicles, fov_deg, [], shapes)
            longer = np.array([max(a.bbox[2:]) for a in vehicles])
            costs += np.nan_to_num(poses.rms_px / longer, nan=0.1).tolist()
        return float(np.median(costs))

    return min(FIELDS_DEG, key=misfit)


def offsets(
    images: list[tuple[Image, list[Annotation]]], fov_deg: float, kind: list[int], shapes: Shapes
) -> Iterator[Array]:
    """Yield the offset (3,) of each labelled point of a kind: distance, shift outwards, shift downwards.

    Offsets are relative to the longer edge of the box.
    """
    for image, vehicles in images:
        poses = fitted(image, vehicles, fov_deg, kind, shapes)
        camera = camera_of(image, fov_deg)
        for i, vehicle in enumerate(vehicles):
            if poses.refusal[i] is not None:
                continue
            x, _, w, h = vehicle.bbox
            world = poses.points[i, kind] @ poses.T_world_vehicle[i, :3, :3].T + poses.T_world_vehicle[i, :3, 3]
            projected = camera.project(world)[0]
            for at, label in zip(projected, vehicle.keypoints[kind], strict=True):
                if label[2] == 2:
                    away = (label[:2] - at) / max(w, h)
                    yield np.array([np.linalg.norm(away), away[0] * np.sign(at[0] - x - w / 2), away[1]])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("annotations", type=Path, help="labelled photographs")
    parser.add_argument("--shapes", type=Path, help="file of scripts/vehicle_shapes.py; default: the shipped one")
    options = parser.parse_args()
    shapes = read_shapes(options.shapes) if options.shapes else fleet_shapes()
    file = coco.read(options.annotations)
    labelled = file.by_image()
    sites = defaultdict(list)
    for image in file.images:
        vehicles = [a for a in labelled[image.id] if not a.ignored and (a.keypoints[:, 2] == 2).sum() >= FEWEST]
        if vehicles:
            sites[image.site].append((image, vehicles))
    fields = {site: field_of_view(images, shapes) for site, images in sites.items()}
    print(", ".join(f"{site}: {fov:g} degrees" for site, fov in fields.items()))
    print("kind                points  distance  outwards    down")
    for name, kind in kinds().items():
        rows = [row for site, images in sites.items() for row in offsets(images, fields[site], kind, shapes)]
        if rows:
            distance, outwards, down = 100 * np.median(rows, axis=0)
            print(f"{name:20s}{len(rows):6d}{distance:10.1f}{outwards:10.1f}{down:8.1f}", flush=True)


if __name__ == "__main__":
    main()
