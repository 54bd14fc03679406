"""Drawings in the camera's image: horizon, grid and typical boxes to judge a calibration by; and tracks.

With a correct camera, lanes have their true width everywhere, and boxes rest on the wheels of vehicles.
"""

import itertools
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.errors import UserError
from skope.metrics.thresholds import KEPT_SCORE
from skope.pictures.draw import DRAWING_STYLE
from skope.pose.keypoint_views import Scene, View
from skope.pose.pose_records import corners_of, locate_view
from skope.schema import AnnotationFile
from skope.tracking import map_signs
from skope.tracking.birdseye_video import put_text
from skope.tracking.ground_view import footage_of
from skope.tracks.track import Track
from skope.types import Array, Pixels
from skope.video.footage import FrameRange, open_footage


@dataclass(frozen=True)
class CameraPictureSettings:
    """Appearance of the image that shows a camera's calibration."""

    labelled_share: float = 0.05
    """Boxes longer than this share of the image width are labelled. Distant boxes lie close together."""
    line_px: int = 2
    """Line width of boxes, pixels."""
    grid_m: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Possible distances between grid lines, metres."""
    grid_lines: int = 12
    """Approximate number of grid lines away from the camera."""
    across_m: float = 5.0
    """Maximum distance between lines along the viewing direction, metres: a lane and a half."""
    farthest_m: float = 150.0
    letters_px: int = 18
    """Minimum distance between distance labels, pixels."""
    grid_color: tuple[int, int, int] = (255, 255, 255)
    horizon_color: tuple[int, int, int] = (255, 120, 40)
    box_color: tuple[int, int, int] = (90, 235, 120)


CAMERA_PICTURE_SETTINGS: Final = CameraPictureSettings()


def overlay_frames(
    tracks: Sequence[Track], folder: Path, file: AnnotationFile, road_users: Sequence[Track] = ()
) -> Iterator[Pixels]:
    """Yield the tracked frames (H, W, 3) with the detected vehicles and other road users drawn in them.

    Args:
        tracks: The tracks of vehicles.
        folder: Folder of the file of frames.
        file: The frames; `info` names their footage.
        road_users: The tracks of pedestrians and two-wheelers.

    Raises:
        UserError: The file does not name its footage, or the footage is missing or cannot be read.
    """
    source = footage_of(folder, file.info)
    if source is None:
        raise UserError(f"{file.name}: does not name its footage, which --overlay needs to draw into")
    numbers = {image.frame_index if image.frame_index is not None else i: i for i, image in enumerate(file.images)}
    present: dict[int, list[tuple[Track, int]]] = {}
    everybody: list[Track] = [*tracks, *road_users]
    for track in everybody:
        for i in np.flatnonzero(track.detected).tolist():
            present.setdefault(int(track.frames[i]), []).append((track, i))
    for image, pixels in open_footage(str(source)).frames():
        frame = numbers.get(-1 if image.frame_index is None else image.frame_index)
        if frame is not None:
            yield with_tracks_drawn(pixels, present.get(frame, []))


def with_tracks_drawn(pixels: Pixels, present: Sequence[tuple[Track, int]]) -> Pixels:
    """Return a copy of a frame (H, W, 3) with the tracks that are detected in it, each given with its row there."""
    picture = pixels.copy()
    for track, i in present:
        x, y, w, h = track.boxes[i].tolist()
        color = DRAWING_STYLE.palette[track.number % len(DRAWING_STYLE.palette)]
        corners = np.rint([[x, y], [x + w, y], [x + w, y + h], [x, y + h]]).astype(np.int32)
        cv2.polylines(picture, [corners], True, color, CAMERA_PICTURE_SETTINGS.line_px, cv2.LINE_AA)
        if max(w, h) < CAMERA_PICTURE_SETTINGS.labelled_share * picture.shape[1]:
            continue
        number, _, speed = map_signs.label(track, i).partition("  ")
        put_text(picture, "  ".join(filter(None, (f"{number} {track.class_name}", speed))), (round(x), round(y) - 5))
    return picture


BOX_EDGES: Final = tuple((a, b) for a, b in itertools.combinations(range(8), 2) if bin(a ^ b).count("1") == 1)
"""Pairs of corners that are joined by an edge of a box. Corners are numbered by end, side and height."""


def draw_camera_picture(scene: Scene, folder: Path) -> Pixels | None:
    """Draw the calibration into the frame with most vehicles; None if the file does not name its footage.

    Args:
        scene: Results of `skope eval predict`, with the camera and the road.
        folder: Folder of the file of frames.

    Raises:
        UserError: The footage is missing or cannot be read.
    """
    source = footage_of(folder, scene.file.info)
    view = max(scene.views(score=KEPT_SCORE), key=lambda candidate: int((~candidate.interpolated).sum()), default=None)
    if source is None or view is None:
        return None
    camera = scene.camera_of(view.image)
    picture = _frame(source, view)
    picture = np.asarray(0.75 * picture, dtype=np.uint8)
    _draw_grid(picture, camera)
    located = locate_view(view, scene)
    for i in np.flatnonzero(located.good).tolist():
        corners = corners_of(located.poses.T_world_vehicle[i], located.poses.size_lwh[i])
        for a, b in BOX_EDGES:
            _draw_line(picture, camera, corners[[a, b]], CAMERA_PICTURE_SETTINGS.box_color, 2)
    return picture


def _frame(source: Path, view: View) -> Pixels:
    index = view.image.frame_index
    start = 0.0 if view.image.time_s is None else max(0.0, view.image.time_s - 1.0)
    for image, pixels in open_footage(str(source), FrameRange(start_s=start)).frames():
        if image.frame_index == index or (index is None and image.file_name == view.image.file_name):
            return pixels.copy()
    raise UserError(f"{source}: frame {index} cannot be read")


def _draw_grid(picture: Pixels, camera: Camera) -> None:
    """Draw a grid on the road, along the viewing direction and across it, and the horizon."""
    yaw, _, _ = camera.angles
    ahead = np.array([math.cos(yaw), math.sin(yaw), 0.0])
    left = np.array([-ahead[1], ahead[0], 0.0])
    foot = np.array([*camera.position[:2], 0.0])
    reach = min(CAMERA_PICTURE_SETTINGS.farthest_m, 12 * float(camera.position[2]))
    step = next(
        (m for m in CAMERA_PICTURE_SETTINGS.grid_m if reach / m <= CAMERA_PICTURE_SETTINGS.grid_lines),
        CAMERA_PICTURE_SETTINGS.grid_m[-1],
    )
    away = np.arange(0.0, reach + 0.1, 0.5)
    side = np.arange(-reach / 2, reach / 2 + 0.1, 0.5)
    for k in np.arange(-reach / 2, reach / 2 + 0.1, min(step, CAMERA_PICTURE_SETTINGS.across_m)).tolist():
        _draw_line(picture, camera, foot + left * k + ahead * away[:, None], CAMERA_PICTURE_SETTINGS.grid_color, 1)
    below = picture.shape[0]
    for k in range(1, CAMERA_PICTURE_SETTINGS.grid_lines + 1):
        _draw_line(
            picture, camera, foot + ahead * k * step + left * side[:, None], CAMERA_PICTURE_SETTINGS.grid_color, 1
        )
        pixel, _, valid = camera.project((foot + ahead * k * step)[None])
        if valid[0] and camera.inside(pixel)[0] and pixel[0, 1] < below - CAMERA_PICTURE_SETTINGS.letters_px:
            below = float(pixel[0, 1])
            put_text(picture, f"{k * step} m", (round(float(pixel[0, 0])) + 4, round(float(pixel[0, 1])) - 3))
    turn = np.linspace(-math.pi / 2, math.pi / 2, 181)[:, None]
    far = foot + 1e6 * (np.cos(turn) * ahead + np.sin(turn) * left) + [0.0, 0.0, float(camera.position[2])]
    _draw_line(picture, camera, far, CAMERA_PICTURE_SETTINGS.horizon_color, 2)


def _draw_line(picture: Pixels, camera: Camera, points: Array, color: tuple[int, int, int], thick: int) -> None:
    pixels, _, valid = camera.project(points)
    height, width = picture.shape[:2]
    near = valid & (np.abs(pixels - [width / 2, height / 2]) < 2 * max(width, height)).all(axis=1)
    for a, b in itertools.pairwise(range(len(points))):
        if near[a] and near[b]:
            ends = np.rint(pixels[[a, b]]).astype(np.int32)
            cv2.polylines(picture, [ends], False, color, thick, cv2.LINE_AA)
