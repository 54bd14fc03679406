"""Homographies between parts of one picture that were moved by known amounts, and pictures that must be rejected."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skope.camera.motion.view_registration import register, transformed
from tests.camera.motion.test_image_shift import FOCAL, SIZE, picture, turned, with_traffic

K = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
CORNERS = np.array([[0, 0], [1, 0], [0, 1], [1, 1.0]]) * SIZE
Picture = NDArray[np.uint8]


def shifted(x: float, y: float) -> NDArray[np.float64]:
    return np.array([[1, 0, x], [0, 1, y], [0, 0, 1.0]])


def turned_and_zoomed(yaw: float, pitch: float, roll: float, zoom: float = 1.0) -> NDArray[np.float64]:
    """Homography of a camera that turns by angles in degrees and zooms."""
    return np.asarray(K @ np.diag([zoom, zoom, 1]) @ turned(*np.radians([yaw, pitch, roll])) @ np.linalg.inv(K))


def seen(H: NDArray[np.float64], frame: int, name: str = "noon.jpg") -> Picture:
    return with_traffic(picture(H, name), np.random.default_rng(frame), frame)


@pytest.mark.parametrize(
    "moved",
    [
        shifted(0, 0),
        shifted(24, 0),
        shifted(120, 30),
        turned_and_zoomed(0, 0, 1.5),
        turned_and_zoomed(0, 0, 12),
        turned_and_zoomed(-6, 2, -3),
        turned_and_zoomed(0, 0, 0, zoom=1.15),
        turned_and_zoomed(2, 0, 1, zoom=0.9),
    ],
)
def test_shifts_turns_and_zooms_are_found(moved: NDArray[np.float64]) -> None:
    found = register(seen(np.eye(3), 0), seen(moved, 1))
    assert found is not None
    off = np.linalg.norm(transformed(found.matrix, CORNERS) - transformed(moved, CORNERS), axis=1)
    assert off.max() < 0.25
    assert off.max() < 6 * max(found.corner_error_px, 0.02)
    assert found.residual_px < 0.2
    back = found.inverse().then(found)
    assert transformed(back.matrix, CORNERS) == pytest.approx(CORNERS, abs=1e-6)
    assert back.corner_error_px == pytest.approx(2**0.5 * found.corner_error_px)


def test_other_light_is_the_same_view() -> None:
    found = register(seen(np.eye(3), 0), seen(shifted(24, 5), 1, "low_sun.jpg"))
    assert found is not None
    assert transformed(found.matrix, CORNERS) - CORNERS == pytest.approx(np.full((4, 2), [24, 5]), abs=0.4)


def lorry(pixels: Picture) -> Picture:
    """A picture whose left half a lorry hides."""
    shades = np.random.default_rng(3).integers(0, 255, (12, 12, 3)).astype(np.uint8)
    out = pixels.copy()
    out[:, : SIZE[0] // 2 + 10] = cv2.resize(shades, (SIZE[0] // 2 + 10, SIZE[1]))
    return out


def stamped(pixels: Picture) -> Picture:
    """A dark picture with the camera's name and the time in it, which do not move with the view."""
    out = (pixels * 0.02).astype(np.uint8)
    for y, text in ((30, "CAMERA 12 NORTH JUNCTION"), (345, "2026-11-27 18:24:07.331")):
        cv2.putText(out, text, (10, y), cv2.FONT_HERSHEY_SIMPLEX, 0.9, (255, 255, 255), 2)
    return out


def test_what_does_not_surely_tell_a_homography_is_rejected() -> None:
    here, there = seen(np.eye(3), 0), seen(shifted(10, 0), 1)
    assert register(here, there) is not None
    assert register(here, seen(np.eye(3), 1, "own_road.jpg")) is None, "another scene"
    assert register(here, lorry(there)) is None, "half of it is hidden"
    assert register(here, (there * 0.02).astype(np.uint8)) is None, "dark"
    assert register(stamped(here), stamped(there)) is None, "only what is written in it can be seen"
    assert register(here, np.ascontiguousarray(there[:, ::-1])) is None, "mirrored"
    assert register(here, seen(shifted(350, 0), 1)) is None, "more than half of it is new"
    assert register(here, seen(turned_and_zoomed(0, 0, 0, zoom=1.5), 1)) is None, "less than half of it is left"
    assert register(here, np.full_like(here, 120)) is None, "nothing to be seen"
    assert register(here, there[:-2]) is None, "of another size"
