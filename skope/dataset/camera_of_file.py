"""Read a camera from a file of any supported format, and scale a camera to an image size."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from skope.camera.calibration_files import camera_of_json, read_calibration
from skope.camera.model import Camera, same_aspect
from skope.dataset import coco
from skope.errors import UserError
from skope.files.json_files import read_json
from skope.schema import Image


def read_camera(path: Path, size: tuple[int, int] | None = None) -> tuple[Camera, bool]:
    """Read a camera from a file.

    Supported are files of `skope eval camera`, annotation files (the camera of their first image) and the calibrations
    of `skope.camera.calibration_files`.

    Args:
        path: The file.
        size: Image width and height, pixels; used if the file has no size.

    Returns:
        The camera, and whether the file has its pose. Without a pose the world is the camera's own frame.
    """
    if path.suffix.lower() == ".json":
        document = read_json(path)
        if isinstance(document, dict) and "images" in document:
            images = [image for image in coco.read(path).images if image.camera is not None]
            if not images:
                raise UserError(f"{path}: images: none has a camera")
            assert images[0].camera is not None
            return images[0].camera, True
        if isinstance(document, dict) and "T_camera_world" in document:
            return camera_of_json(path, document), True
    calibration = read_calibration(path)
    width_height = calibration.size or size
    if width_height is None:
        raise UserError(f"{path}: image size: missing")
    pose = np.eye(4) if calibration.T_camera_world is None else calibration.T_camera_world
    return Camera(*width_height, calibration.K, pose, calibration.distortion), calibration.T_camera_world is not None


def sized(camera: Camera, size: tuple[int, int], name: str) -> Camera:
    """Return the camera at the size of an image.

    Args:
        camera: The camera, with the aspect ratio of the image.
        size: Width and height of the image, pixels.
        name: Name of the image, for errors.

    Raises:
        UserError: The camera has another aspect ratio than the image.
    """
    camera_size = (camera.width, camera.height)
    if camera_size == size:
        return camera
    if not same_aspect(camera_size, size):
        raise UserError(
            f"{name}: image size: expected the aspect ratio of the camera, {camera_size[0]}x{camera_size[1]}, "
            f"got {size[0]}x{size[1]}"
        )
    return camera.resized(size)


def fitted_camera(camera: Camera, size: tuple[int, int], name: str, footage: str) -> tuple[Camera, str]:
    """Return a camera from a file at the size of the footage that it is used for.

    Args:
        camera: The camera.
        size: Width and height of the footage, pixels.
        name: Name of the camera's file, and its key if the file has several cameras, for messages.
        footage: Name of the footage, for messages.

    Returns:
        The camera, and a message that it was scaled; empty if the sizes are equal.

    Raises:
        UserError: The aspect ratios differ by more than 1%.
    """
    camera_size = (camera.width, camera.height)
    if not same_aspect(camera_size, size):
        raise UserError(
            f"{name}: image size: expected the aspect ratio of {footage}, {size[0]}x{size[1]}, "
            f"got {camera_size[0]}x{camera_size[1]}"
        )
    words = f"{name}: camera of {camera_size[0]}x{camera_size[1]}, scaled to the {size[0]}x{size[1]} of {footage}"
    return camera.resized(size), "" if camera_size == size else words


def with_camera(image: Image, camera: Camera | None) -> Image:
    """Return the image with `camera`, at its size, as its camera; unchanged for None."""
    if camera is None:
        return image
    return replace(image, camera=sized(camera, (image.width, image.height), image.file_name))
