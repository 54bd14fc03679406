"""Pictures drawn into the camera's image: its horizon, grid and typical boxes, to judge a camera by; and tracks.

Under the right camera lanes have their true width everywhere, and boxes stand on their wheels.
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
    """Appearance of the picture of a camera's calibration."""

    labelled_share: float = 0.05
    """Boxes longer than this share of the image width are labelled. Distant boxes lie close together."""
    line_px: int = 2
    """Lines of boxes, pixels."""
    grid_m: tuple[int, ...] = (1, 2, 5, 10, 20, 50)
    """Distances of the grid's lines."""
    grid_lines: int = 12
    """The grid has about so many lines away from the camera."""
    across_m: float = 5.0
    """Lines along the way are so far apart at most: a lane and a half."""
    farthest_m: float = 150.0
    letters_px: int = 18
    """Distances are written so far apart at least, pixels."""
    grid_color: tuple[int, int, int] = (255, 255, 255)
    horizon_color: tuple[int, int, int] = (255, 120, 40)
    box_color: tuple[int, int, int] = (90, 235, 120)


CAMERA_PICTURE_SETTINGS: Final = CameraPictureSettings()


def overlay_frames(
    tracks: Sequence[Track], folder: Path, file: AnnotationFile, road_users: Sequence[Track] = ()
) -> Iterator[Pixels]:
    """The frames (H, W, 3) that were tracked, with the vehicles and other road users that are seen in them.

    Args:
        tracks: The tracks of vehicles.
        folder: Where the file of frames lies.
        file: The frames; `info` says where their footage is.
        road_users: The tracks of others.

    Raises:
        UserError: The footage is not said, not there any more, or cannot be read.
    """
    source = footage_of(folder, file.info)
    if source is None:
        raise UserError(f"{file.name}: does not say where its footage is, which --overlay draws into")
    place = {image.frame_index if image.frame_index is not None else i: i for i, image in enumerate(file.images)}
    present: dict[int, list[tuple[Track, int]]] = {}
    everybody: list[Track] = [*tracks, *road_users]
    for track in everybody:
        for i in np.flatnonzero(track.detected).tolist():
            present.setdefault(int(track.frames[i]), []).append((track, i))
    for image, pixels in open_footage(str(source)).frames():
        frame = place.get(-1 if image.frame_index is None else image.frame_index)
        if frame is not None:
            yield with_tracks_drawn(pixels, present.get(frame, []))


def with_tracks_drawn(pixels: Pixels, present: Sequence[tuple[Track, int]]) -> Pixels:
    """A copy of a frame (H, W, 3) with the tracks that are seen in it, each with its row there."""
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
"""Corners of a box that an edge joins; their numbers count in ends, sides and heights."""


def draw_camera_picture(scene: Scene, folder: Path) -> Pixels | None:
    """The frame with most vehicles, with what the camera says of it; None where its footage is not said.

    Args:
        scene: What `skope eval predict` found, with the camera and the road.
        folder: Where its file of frames lies.

    Raises:
        UserError: The footage is not there any more, or cannot be read.
    """
    source = footage_of(folder, scene.file.info)
    view = max(scene.views(score=KEPT_SCORE), key=lambda one: int((~one.interpolated).sum()), default=None)
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
    """Lines on the road every so many metres, along the way that the camera looks and across, and the horizon."""
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
