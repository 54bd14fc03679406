"""Shift and turn of images that were moved by known amounts: by warps, and by turning the camera that saw a plane."""

import math
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skope.camera.motion.image_shift import ReferencePicture, SmallPicture
from skope.dataset.folder import read_image

DOCS = Path(__file__).parents[3] / "docs"
SIZE = (640, 360)
FOCAL = 420.0


def turned(yaw: float, pitch: float, roll: float) -> NDArray[np.float64]:
    """(3, 3) rotation of what a camera sees (OpenCV's axes), by angles about y, x and z."""
    out = np.eye(3)
    for axis, angle in zip(np.eye(3)[[1, 0, 2]], (yaw, pitch, roll), strict=True):
        out = cv2.Rodrigues(axis * angle)[0] @ out
    return out


def picture(H: NDArray[np.float64], name: str = "noon.jpg") -> NDArray[np.uint8]:
    """A part of a larger picture, moved by a homography of pixel coordinates in which centres are at halves."""
    large = cv2.resize(read_image(DOCS / name), (SIZE[0] + 200, SIZE[1] + 200), interpolation=cv2.INTER_AREA)
    halves = np.array([[1, 0, -0.5], [0, 1, -0.5], [0, 0, 1.0]])
    middle = np.array([[1, 0, -100.0], [0, 1, -100.0], [0, 0, 1.0]])
    return np.asarray(
        cv2.warpPerspective(large, halves @ H @ middle @ np.linalg.inv(halves), SIZE, flags=cv2.INTER_CUBIC)
    )


def with_traffic(pixels: NDArray[np.uint8], rng: np.random.Generator, k: int) -> NDArray[np.uint8]:
    shown = 0.8 * pixels.astype(np.float64) + rng.normal(0, 4, pixels.shape)
    for n in range(5):
        x = (90 * k + 130 * n) % (SIZE[0] - 80)
        shown[170 + 25 * n : 205 + 25 * n, x : x + 75] = rng.uniform(0, 255, (35, 75, 3))
    return np.clip(shown, 0, 255).astype(np.uint8)


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.2, -0.1), (1.0, 0.4), (-3.3, 2.6), (10.0, -4.0), (40.0, 5.0)])
def test_a_shift_is_measured_to_a_fraction_of_a_pixel(shift: tuple[float, float]) -> None:
    rng = np.random.default_rng(0)
    reference = ReferencePicture(SmallPicture.of(with_traffic(picture(np.eye(3)), rng, 0)))
    moved = np.eye(3)
    moved[:2, 2] = shift
    motion = reference.motion(SmallPicture.of(with_traffic(picture(moved), rng, 1)))
    assert motion is not None
    assert (motion.x, motion.y) == pytest.approx(shift, abs=0.12)
    assert abs(motion.x - shift[0]) < 4 * motion.sigma_px
    assert motion.sigma_px < 0.1
    assert abs(motion.turn) < 1e-3
    assert abs(motion.growth) < 2e-3


def test_another_hour_and_weather_are_no_shift() -> None:
    views = [read_image(DOCS / f"{name}.jpg") for name in ("noon", "low_sun", "fog", "rain_night")]  # of one camera
    for one in views:
        reference = ReferencePicture(SmallPicture.of(one))
        for other in views:
            motion = reference.motion(SmallPicture.of(other))
            assert motion is not None
            assert math.hypot(motion.x, motion.y) < 0.3
            assert abs(motion.turn) < 5e-4


@pytest.mark.parametrize("angles_deg", [(0.3, 0.0, 0.0), (0.5, -0.4, 0.6), (-2.0, 1.0, -1.5)])
def test_a_turned_camera_shifts_and_turns_its_image_as_its_rays_do(angles_deg: tuple[float, float, float]) -> None:
    K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    R = turned(*np.radians(angles_deg))
    rng = np.random.default_rng(0)
    reference = ReferencePicture(SmallPicture.of(with_traffic(picture(np.eye(3)), rng, 0)))
    motion = reference.motion(SmallPicture.of(with_traffic(picture(K @ R @ np.linalg.inv(K)), rng, 1)))
    ahead = K @ R @ [0, 0, 1]
    expected = ahead[:2] / ahead[2] - K[:2, 2]
    assert motion is not None
    assert (motion.x, motion.y) == pytest.approx(expected, abs=0.15)
    assert motion.turn == pytest.approx(math.radians(angles_deg[2]), abs=1e-3)


def test_another_view_has_no_shift() -> None:
    reference = ReferencePicture(SmallPicture.of(picture(np.eye(3))))
    assert reference.motion(SmallPicture.of(picture(np.eye(3), "own_road.jpg"))) is None
    assert reference.motion(SmallPicture.of(np.full((*SIZE[::-1], 3), 90, dtype=np.uint8))) is None
    with pytest.raises(ValueError, match="expected a picture of"):
        reference.motion(SmallPicture.of(np.zeros((10, 10, 3), dtype=np.uint8)))


def test_a_picture_with_nothing_in_it_tells_nothing() -> None:
    even = np.full((*SIZE[::-1], 3), 90, dtype=np.uint8)
    assert ReferencePicture(SmallPicture.of(even)).motion(SmallPicture.of(picture(np.eye(3)))) is None


@pytest.mark.parametrize("size", [(161, 3), (1000, 1), (3, 200)])
def test_a_strip_of_a_picture_is_no_error(size: tuple[int, int]) -> None:
    noise = SmallPicture.of(np.random.default_rng(0).integers(0, 256, (size[1], size[0], 3), dtype=np.uint8))
    assert ReferencePicture(noise).motion(noise) is None


def test_corners_are_followed_in_pixels_whose_centres_are_halves() -> None:
    """In a wide picture, which is made smaller for it, too."""
    large = np.asarray(cv2.resize(picture(np.eye(3)), (1280, 720), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
    moved = np.eye(3)
    moved[:2, 2] = (6.0, -4.0)
    other = np.asarray(cv2.warpAffine(large, moved[:2], (1280, 720), flags=cv2.INTER_CUBIC), dtype=np.uint8)
    followed = ReferencePicture(SmallPicture.of(large)).followed(SmallPicture.of(other))
    assert followed is not None
    assert np.median(followed.after - followed.before, axis=0) == pytest.approx([6, -4], abs=0.15)
    assert followed.sigma_px < 0.5
