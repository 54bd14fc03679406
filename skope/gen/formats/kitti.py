"""KITTI's object labels, with the road's plane as in Rope3D and DAIR-V2X.

    <split>/image_2/000000.jpg      the image
    <split>/label_2/000000.txt      type truncated occluded alpha x1 y1 x2 y2 h w l X Y Z ry
    <split>/calib/000000.txt        P0 to P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo
    <split>/denorm/000000.txt       a b c d: the road a x + b y + c z + d = 0 in the camera frame, its normal up
    <split>/rotation/000000.txt     one row per row of labels: the 3x3 rotation from box to camera axes, row by row
    <split>/index.txt               the number of each image, and its name in the dataset

X Y Z is the middle of the box's bottom in the camera frame. A roadside camera points down, so `ry` turns about the
road's normal, not the camera's y axis: corners = G R_y(ry) p + (X, Y, Z). G is the smallest rotation that takes the
camera's y axis to the road's downward normal; p is in KITTI's box axes (x forward, y down, z to the left). `ry` leaves
out a vehicle's own pitch and roll, which `rotation` contains. The format has no field for lens distortion.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath
from typing import Final

import numpy as np

from skope import boxes
from skope.camera.model import Camera
from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.gen.output.writers import place_file
from skope.schema import Annotation, Box3D, RoadUser
from skope.terminal.console import Console
from skope.types import Array

KITTI_TYPES: Final = {
    "bus": "Bus", "articulated_bus": "Bus", "truck": "Truck", "articulated_truck": "Truck", "box_truck": "Truck",
    "van": "Van", "minivan": "Van", "other": "Misc",
}  # fmt: skip
"""Names of vehicle types in KITTI's files; all other types are Car."""
KITTI_RIDERS: Final = {"bicycle": "Cyclist", "motorcycle": "Motorcyclist", "pedestrian": "Pedestrian"}
"""Names of the other categories. KITTI has no `Motorcyclist`; the name is from Rope3D and DAIR-V2X."""
OCCLUSION_SHARES: Final = (0.1, 0.4)
"""Minimum hidden shares of partly and largely occluded vehicles."""
DONT_CARE: Final = "DontCare -1 -1 -10 {} -1 -1 -1 -1000 -1000 -1000 -10"
BOX_AXES: Final = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
"""KITTI's box axes (x forward, y down, z left) as columns in skope's axes (x forward, y left, z up)."""
_ROAD_NORMAL: Final = np.array([0.0, 0.0, 1.0])


def write(dataset: Dataset, out: Path, console: Console) -> None:
    """Write every split of a dataset to a folder of `out`.

    Raises:
        UserError: An image has no camera, or a vehicle has no 3D box.
    """
    distorted = 0
    for split in dataset.splits:
        file = dataset.read(split)
        labels_by_image = file.labels_by_image()
        folder, index = out / split, []
        for number, image in enumerate(console.bar(file.images, unit="image", label=f"writing {split}")):
            where = f"{dataset.root}: {split}: image {image.id}"
            if image.camera is None:
                raise UserError(f"{where}: camera: missing, but KITTI's labels are in its frame")
            distorted += image.camera.distortion.model != "none"
            suffix = PurePosixPath(image.file_name).suffix
            place_file(dataset.root / image.file_name, folder / "image_2" / f"{number:06d}{suffix}")
            labels, rotations = _labels(where, labels_by_image[image.id], image.camera)
            texts = {
                "label_2": "".join(labels),
                "rotation": "".join(rotations),
                "calib": _calibration(image.camera),
                "denorm": " ".join(f"{v:.9g}" for v in road_plane(image.camera)) + "\n",
            }
            for kind, text in texts.items():
                write_text(folder / kind / f"{number:06d}.txt", text)
            index.append(f"{number:06d} {image.file_name}\n")
        write_text(folder / "index.txt", "".join(index))
    if distorted:
        console.say(f"{distorted} images have a distorted lens, which KITTI's calibration cannot express")


def road_plane(camera: Camera) -> Array:
    """Return a, b, c, d (4,) of the world's z = 0 in the camera frame.

    The unit normal points up, d is the camera's height.
    """
    normal = camera.T_camera_world[:3, :3] @ _ROAD_NORMAL
    return np.append(normal, -normal @ camera.T_camera_world[:3, 3])


def levelling(plane: Array) -> Array:
    """Return the smallest rotation (3, 3) that takes the y axis to the plane's downward normal."""
    down = -plane[:3] / np.linalg.norm(plane[:3])
    y = np.array([0.0, 1.0, 0.0])
    axis, cosine = np.cross(y, down), float(y @ down)
    cross = np.array([[0, -axis[2], axis[1]], [axis[2], 0, -axis[0]], [-axis[1], axis[0], 0]])
    return np.asarray(np.eye(3) + cross + cross @ cross / (1 + cosine))


def _labels(where: str, road_users: Sequence[Annotation | RoadUser], camera: Camera) -> tuple[list[str], list[str]]:
    """Return a row of labels and a row of rotations per road user; an ignored road user becomes a DontCare region."""
    labels, rotations = [], []
    for vehicle in road_users:
        box_2d = " ".join(f"{v:.2f}" for v in boxes.xywh_to_xyxy(vehicle.bbox))
        if vehicle.ignored:
            labels.append(DONT_CARE.format(box_2d) + "\n")
            rotations.append("0 0 0 0 0 0 0 0 0\n")
            continue
        if vehicle.box_3d is None:
            raise UserError(f"{where}, annotation {vehicle.id}: box_3d: missing")
        bottom, turn, R = _placed(vehicle.box_3d, camera)
        length, width, height = vehicle.box_3d.size_lwh
        alpha = _wrapped(turn - float(np.arctan2(bottom[0], bottom[2])))
        occluded = int(np.searchsorted(OCCLUSION_SHARES, vehicle.occlusion or 0.0, side="right"))
        if isinstance(vehicle, Annotation):
            kind = KITTI_TYPES.get(vehicle.vehicle_type or "", "Car")
        else:
            kind = KITTI_RIDERS[vehicle.category]
        numbers = (height, width, length, *bottom, turn)
        labels.append(
            f"{kind} {vehicle.truncation or 0.0:.2f} {occluded} {alpha:.4f} {box_2d} "
            f"{' '.join(f'{v:.4f}' for v in numbers)}\n"
        )
        rotations.append(" ".join(f"{v:.9g}" for v in R.ravel()) + "\n")
    return labels, rotations


def _placed(box: Box3D, camera: Camera) -> tuple[Array, float, Array]:
    """Return a box in the camera frame: bottom centre, turn about the road's normal, and full rotation."""
    bottom = camera.to_camera(box.center - box.R @ [0.0, 0.0, box.size_lwh[2] / 2])
    R = camera.T_camera_world[:3, :3] @ box.R @ BOX_AXES
    ahead = levelling(road_plane(camera)).T @ R[:, 0]
    return bottom, float(np.arctan2(-ahead[2], ahead[0])), R


def _wrapped(angle: float) -> float:
    return float(np.arctan2(np.sin(angle), np.cos(angle)))


def _calibration(camera: Camera) -> str:
    K = camera.K.copy()
    K[:2, 2] -= 0.5  # this format has the centre of pixel i at i
    P = np.column_stack([K, np.zeros(3)])
    rows = {f"P{i}": P for i in range(4)}
    rows |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": np.eye(4)[:3], "Tr_imu_to_velo": np.eye(4)[:3]}
    return "".join(f"{name}: {' '.join(f'{v:.12e}' for v in values.ravel())}\n" for name, values in rows.items())
