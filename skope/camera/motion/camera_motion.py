"""Camera shake during footage: the camera's turn in each frame, and the remaining uncertainty.

A vibrating mast or bracket turns its camera about a point that is near, compared with the distance to the road. The
image therefore moves as by a turn of the camera. At rest, the camera is as calibrated. The phase of the shake at which
the calibration image was taken is unknown, so the shake itself is part of the camera's uncertainty.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.camera.motion.image_shift import ImageMotion
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, UncertainCamera, values_of
from skope.errors import UserError
from skope.schema import Image
from skope.types import Array

MOTION_KEY: Final = "camera_motion"
"""Key in `info` of the frames: the camera shake (the result of `CameraMotion.to_dict`)."""
MOVED_REASON: Final = "camera_moved"
"""Reason for a vehicle without a position: the camera was moved after its calibration."""
TURN_ANGLES: Final = ("pitch", "roll", "yaw")
"""Camera parameters that a turn changes."""
_DIFFERENCE_STEPS: Final = np.array([0.5, 0.5, 1e-3])
"""Steps of numeric derivatives by x and y (pixels) and turn (radians)."""


@dataclass(frozen=True, eq=False)
class CameraMotion:
    """Shake of a camera during footage."""

    frames: Mapping[int, ImageMotion]
    """Displacement of the image from rest, by `Image.id`; frames without a known displacement are missing."""
    shake_sigmas: tuple[float, float, float]
    """Standard deviations of x and y (pixels) and of the turn (radians) over the footage."""

    @property
    def median_px(self) -> float:
        """Median distance of images from rest, pixels."""
        return float(np.median([math.hypot(motion.x, motion.y) for motion in self.frames.values()]))

    @property
    def largest_px(self) -> float:
        """Largest distance of images from rest, pixels."""
        return max(math.hypot(motion.x, motion.y) for motion in self.frames.values())

    def __str__(self) -> str:
        return (
            f"camera shake of {self.median_px:.1f} px in the median, {self.largest_px:.1f} px at most: "
            "corrected in each frame"
        )

    def camera_in(self, camera: Camera, image_id: int) -> Camera:
        """Return the camera in a frame, from the `camera` at rest; unchanged if the motion in the frame is unknown."""
        motion = self.frames.get(image_id)
        return camera if motion is None else turned_camera(camera, motion.x, motion.y, motion.turn)

    def stilled(self, camera: Camera | None, image: Image, pixels: Array) -> Array:
        """Move pixels of a frame to their position at rest.

        Args:
            camera: The camera at rest; None: the lens is unknown, and the image is moved and turned as a plane.
            image: The frame. If its motion is unknown, it counts as at rest.
            pixels: (..., 2) pixels in the frame.

        Returns:
            (..., 2) pixels in the image at rest; NaN beyond the lens.
        """
        motion = self.frames.get(image.id)
        if motion is None:
            return pixels
        if camera is None:
            middle = np.array([image.width, image.height]) / 2
            c, s = math.cos(motion.turn), math.sin(motion.turn)
            return np.asarray((pixels - middle - [motion.x, motion.y]) @ np.array([[c, -s], [s, c]]) + middle)
        camera = camera.resized((image.width, image.height))
        turned = self.camera_in(camera, image.id)
        rays, valid = turned.rays(pixels)
        away = rays @ turned.T_camera_world[:3, :3] + camera.position
        seen, _, before = camera.project(away)
        return np.where((valid & before)[..., None], seen, np.nan)

    def rest_in(self, camera: Camera, image_id: int) -> UncertainCamera:
        """Return the remaining uncertainty of the camera in a frame, independent from frame to frame."""
        motion = self.frames.get(image_id)
        sigmas = self.shake_sigmas if motion is None else (motion.sigma_px, motion.sigma_px, motion.sigma_turn)
        return UncertainCamera(self.camera_in(camera, image_id), TURN_ANGLES, covariance_of_turns(camera, sigmas))

    def at_rest(self, camera: Camera, known: UncertainCamera | None) -> UncertainCamera:
        """Return the uncertainty of the camera at rest, which was calibrated at an unknown phase of its shake."""
        known = known or UncertainCamera(camera, (), np.zeros((0, 0)))
        return known.of_camera(camera).widened({TURN_ANGLES: covariance_of_turns(camera, self.shake_sigmas)})

    def to_dict(self) -> dict[str, Any]:
        """Return the shake as JSON values, which `from_dict` reads: pixels to 0.0001, angles to 1e-7 radians."""
        rows = [
            [number, *(round(v, 4) for v in (motion.x, motion.y)), round(motion.turn, 7)]
            + [round(motion.sigma_px, 4), round(motion.sigma_turn, 7)]
            for number, motion in self.frames.items()
        ]
        return {
            "sway": [round(v, 7) for v in self.shake_sigmas],
            "median_px": round(self.median_px, 4),
            "columns": ["image_id", "x_px", "y_px", "turn", "sigma_px", "sigma_turn"],
            "frames": rows,
        }

    @classmethod
    def from_dict(cls, name: str, value: Mapping[str, Any]) -> "CameraMotion":
        """Read the result of `to_dict`.

        Raises UserError if the result is malformed. `name` (of the file) is used only in error messages.
        """
        try:
            rows = np.array(value["frames"], dtype=np.float64).reshape(-1, 6)
            x, y, turn = (float(v) for v in value["sway"])
        except (KeyError, TypeError, ValueError):
            rows, x, y, turn = np.full((0, 6), 0.0), math.nan, 0.0, 0.0
        if (
            not len(rows)
            or not np.isfinite(rows).all()
            or not np.isfinite([x, y, turn]).all()
            or (rows[:, 4:] < 0).any()
        ):
            raise UserError(f"{name}: info.{MOTION_KEY}: expected sway, and frames of six numbers each")
        return cls({int(row[0]): ImageMotion(*row[1:].tolist()) for row in rows}, (x, y, turn))


def motion_of_info(name: str, info: Mapping[str, Any]) -> CameraMotion | None:
    """Read the camera shake from the `info` of frames; None for a still camera.

    Raises UserError if the entry is malformed. `name` (of the file) is used only in error messages.
    """
    value = info.get(MOTION_KEY)
    return CameraMotion.from_dict(name, value) if isinstance(value, Mapping) else None


def turned_camera(camera: Camera, x: float, y: float, turn: float) -> Camera:
    """Turn a camera about itself so that its image moves and turns by given amounts.

    Args:
        camera: The camera at rest.
        x: Shift of the image's middle to the right, pixels.
        y: Shift of the image's middle downwards, pixels.
        turn: Turn of the image about that point, radians, from x towards y.
    """
    middle = np.array([camera.width, camera.height]) / 2
    rays = camera.rays(np.stack([middle, middle + [x, y]]))[0]
    before, after = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.cross(before, after)
    sine = float(np.linalg.norm(across))
    axis = across / sine if sine > 0 else across
    T = np.eye(4)
    T[:3, :3] = _rotation(after * turn) @ _rotation(axis * math.atan2(sine, float(before @ after)))
    return replace(camera, T_camera_world=T @ camera.T_camera_world)


def covariance_of_turns(camera: Camera, sigmas: tuple[float, float, float]) -> Array:
    """Return the (3, 3) covariance of pitch, roll and yaw from sigmas of x, y (pixels) and turn (radians)."""
    which = [CAMERA_PARAMETERS.index(name) for name in TURN_ANGLES]
    columns = []
    for step in np.diag(_DIFFERENCE_STEPS):
        ahead, behind = (values_of(turned_camera(camera, *(sign * step).tolist()))[which] for sign in (1, -1))
        away = ahead - behind
        columns.append((np.mod(away + np.pi, 2 * np.pi) - np.pi) / (2 * step.sum()))
    J = np.stack(columns, axis=1) * np.asarray(sigmas)
    return np.asarray(J @ J.T)


def _rotation(vector: Array) -> Array:
    """Return the (3, 3) rotation about a vector (3,) by its length in radians."""
    return np.asarray(cv2.Rodrigues(vector)[0], dtype=np.float64)
