"""Vehicles before a camera, made without any renderer: who stands where, and which keypoints face the camera."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.camera.model import Camera
from skope.pose.shape_model import fleet_shapes
from skope.schema import Annotation, AnnotationFile, Box3D, Image

Array = NDArray[np.float64]

CAMERA = Camera.looking([3, -2, 7], yaw=0.4, pitch_down=math.radians(15))
_SIDE = ("wheel", "mirror", "beltline")
_FRONT = ("headlight", "front_logo")
_REAR = ("taillight",)
_CORNERS = ("bumper", "hood_front", "trunk_rear")


@dataclass(frozen=True, eq=False)
class Scene:
    found: Array
    """(N, 33, 3) x, y, 1 where seen."""
    position: Array
    """(N, 2)"""
    yaw: Array

    def errors(self, poses: object) -> tuple[Array, Array]:
        """Metres and degrees (mod 360) of each vehicle."""
        metres = np.linalg.norm(poses.position[:, :2] - self.position, axis=1)  # type: ignore[attr-defined]
        turn = (poses.yaw - self.yaw + math.pi) % (2 * math.pi) - math.pi  # type: ignore[attr-defined]
        return metres, np.degrees(np.abs(turn))


def facing(points: Array, eye: Array) -> NDArray[np.bool_]:
    """Which keypoints (33, 3) a camera at `eye`, both in the vehicle frame, sees.

    Those of ends and sides that face it, and corners, where an end turns to a side, that do along their diagonal.
    """
    out = np.ones(keypoints.K, dtype=bool)
    for i, name in enumerate(keypoints.NAMES):
        if name.startswith(_SIDE):
            out[i] = (eye[1] - points[i, 1]) * np.sign(points[i, 1]) > 0
        elif name.startswith(_FRONT):
            out[i] = eye[0] > points[i, 0]
        elif name.startswith(_REAR):
            out[i] = eye[0] < points[i, 0]
        elif name.startswith(_CORNERS):
            out[i] = (eye[:2] - points[i, :2]) @ np.sign(points[i, :2]) > 0
    return out


def scene(
    shapes: list[Array],
    rng: np.random.Generator,
    *,
    noise: float,
    near: float = 8.0,
    far: float = 40.0,
    camera: Camera = CAMERA,
) -> Scene:
    """Vehicles with keypoints `shapes` (33, 3), one each, level on z = 0 at `near` to `far` metres, 8 points seen."""
    found, places, yaws = [], [], []
    for points in shapes:
        while True:
            distance, bearing = rng.uniform(near, far), camera.angles[0] + rng.uniform(-0.6, 0.6)
            reach = math.sqrt(max(distance**2 - camera.position[2] ** 2, 9.0))
            place = camera.position[:2] + reach * np.array([math.cos(bearing), math.sin(bearing)])
            yaw = rng.uniform(-math.pi, math.pi)
            c, s = math.cos(yaw), math.sin(yaw)
            R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            pixels, _, valid = camera.project(points @ R.T + [*place, 0])
            seen = valid & facing(points, (camera.position - [*place, 0]) @ R)
            pixels = pixels + rng.normal(0, noise, pixels.shape)
            seen &= camera.inside(pixels)
            if seen.sum() >= 8:
                break
        found.append(np.where(seen[:, None], np.concatenate([pixels, np.ones((len(points), 1))], axis=1), 0.0))
        places.append(place)
        yaws.append(yaw)
    return Scene(np.array(found), np.array(places), np.array(yaws))


def drive(
    seconds: float, fps: float, *, speeds: tuple[float, ...] = (12.0, 0.0), camera: Camera = CAMERA
) -> AnnotationFile:
    """Sedans on lanes across the camera's view, one for each speed (m/s), to the left; labelled as `skope gen` does."""
    shapes = fleet_shapes()
    row = shapes.mean[shapes.types.index("sedan")]
    points, size = row[:-1], row[-1]
    yaw = camera.angles[0] + math.pi / 2
    ahead, side = np.array([math.cos(yaw), math.sin(yaw), 0]), np.array([math.sin(yaw), -math.cos(yaw), 0])
    R = np.stack([ahead, -side, [0, 0, 1]], axis=1)
    images, annotations = [], []
    for frame in range(round(seconds * fps)):
        time = frame / fps
        images.append(
            Image(
                id=frame + 1,
                file_name=f"road/{frame:06d}",
                width=camera.width,
                height=camera.height,
                frame_index=frame,
                time_s=time,
                camera=camera,
            )
        )
        for k, speed in enumerate(speeds):
            start = [*camera.position[:2], 0] + side * (14 + 7 * k)
            place = start + ahead * (speed * (time - seconds / 2))
            pixels, _, valid = camera.project(points @ R.T + place)
            seen = valid & facing(points, (camera.position - place) @ R) & camera.inside(pixels)
            if seen.sum() < 8:
                continue
            low, high = pixels[seen].min(axis=0), pixels[seen].max(axis=0)
            annotations.append(
                Annotation(
                    id=len(annotations) + 1,
                    image_id=frame + 1,
                    bbox=np.concatenate([low, high - low]),
                    keypoints=np.where(seen[:, None], np.column_stack([pixels, 2 * seen]), 0.0),
                    area=float((high - low).prod()),
                    track_id=k + 1,
                    box_3d=Box3D(center=place + [0, 0, size[2] / 2], size_lwh=size, yaw=yaw, R=R),
                    velocity=speed * ahead,
                    occlusion=0.0,
                )
            )
    return AnnotationFile(images=tuple(images), annotations=tuple(annotations), name="road")
