"""Cameras that turn, zoom or are moved, by the homographies that their images of a road undergo."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.camera.motion.camera_motion import turned_camera
from skope.camera.motion.view_registration import ViewHomography
from skope.camera.uncertain_camera import UncertainCamera
from skope.pose.turned_view import turned_view

CAMERA = Camera.looking([3, -2, 7], yaw=0.4, pitch_down=math.radians(15), size=(640, 360))


def homography(after: Camera) -> ViewHomography:
    """What the images of road and houses undergo together, as well as a homography tells it."""
    u, v = np.meshgrid(np.linspace(5, 635, 20), np.linspace(5, 355, 14))
    before = np.stack([u, v], axis=-1).reshape(-1, 2)
    places = intersect_ground(CAMERA, before)
    rays, _ = CAMERA.rays(before)
    away = np.linalg.norm(places - CAMERA.position, axis=1)
    road = np.isfinite(away) & (away < 80)
    far = rays @ CAMERA.T_camera_world[:3, :3] * 80 + CAMERA.position
    seen, _, valid = after.project(np.where(road[:, None], places, far))
    matrix = cv2.findHomography(before[valid], seen[valid], 0)[0]
    return ViewHomography(np.asarray(matrix), 0.08, 0.1)


def zoomed(camera: Camera, zoom: float) -> Camera:
    K = camera.K.copy()
    K[:2, :2] *= zoom
    return replace(camera, K=K)


@pytest.mark.parametrize(("x", "y", "turn", "zoom"), [(24, 0, 0.026, 1), (-90, 30, -0.1, 1), (10, -4, 0.01, 1.12)])
def test_a_turn_and_a_zoom_are_found(x: float, y: float, turn: float, zoom: float) -> None:
    after = zoomed(turned_camera(CAMERA, x, y, turn), zoom)
    found = turned_view(CAMERA, homography(after))
    assert found is not None
    assert found.camera.T_camera_world == pytest.approx(after.T_camera_world, abs=1e-4)
    assert found.camera.position == pytest.approx(CAMERA.position, abs=1e-6)
    assert found.zoom == pytest.approx(zoom, abs=1e-3)
    assert found.off_px < 0.05
    wider = UncertainCamera(found.camera, ("z",), np.array([[1e-4]])).widened(found.added)
    assert set(wider.parameters) == {"focal", "x", "y", "z", "pitch", "roll", "yaw"}


def test_what_the_homography_does_not_tell_widens_the_camera() -> None:
    after = turned_camera(CAMERA, 24, 0, 0.026)
    known = UncertainCamera(after, ("z",), np.array([[1e-6]]))
    errors = []
    for corner_error_px in (0.05, 0.5):
        found = turned_view(CAMERA, replace(homography(after), corner_error_px=corner_error_px))
        assert found is not None
        errors.append(float(known.widened(found.added).place_error(np.array([320.0, 250.0]))))
    assert float(known.place_error(np.array([320.0, 250.0]))) < 0.2 * errors[0]
    assert errors[1] == pytest.approx(10 * errors[0], rel=0.1)


def test_a_camera_that_was_moved_is_no_turn() -> None:
    for step in ((0.0, 0.0, 1.0), (1.0, -1.0, 0.0)):
        T = CAMERA.T_camera_world.copy()
        T[:3, 3] -= T[:3, :3] @ step
        assert turned_view(CAMERA, homography(replace(CAMERA, T_camera_world=T))) is None


def test_without_a_road_near_by_a_turn_is_not_told_from_a_move() -> None:
    high = Camera.looking([0, 0, 500], yaw=0.4, pitch_down=1.2, size=(640, 360))
    assert turned_view(high, ViewHomography(np.eye(3), 0.05, 0.05)) is None
