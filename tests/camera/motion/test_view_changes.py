"""Cuts, turned cameras and what only passes, in footage of generated pictures moved about."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skope.camera.motion.view_changes import ViewChange, ViewSamples, change_since, changes
from skope.dataset.folder import read_image
from skope.schema import Image

DOCS = Path(__file__).parents[3] / "docs"
SIZE = (640, 360)


def view(name: str, shift: tuple[int, int] = (0, 0)) -> NDArray[np.uint8]:
    picture = cv2.resize(read_image(DOCS / name), (SIZE[0] + 100, SIZE[1] + 100))
    x, y = 50 + shift[0], 50 + shift[1]
    return np.ascontiguousarray(picture[y : y + SIZE[1], x : x + SIZE[0]])


def looks_of(pictures: list[NDArray[np.uint8]], fps: float = 5.0) -> list[tuple[float, str]]:
    """Small images of footage with noise, in which boxes drive by and the light changes."""
    rng = np.random.default_rng(0)

    def frames() -> list[tuple[Image, NDArray[np.uint8]]]:
        out = []
        for i, picture in enumerate(pictures):
            shown = picture.astype(np.float64) * (1 - 0.3 * i / len(pictures)) + rng.normal(0, 6, picture.shape)
            for k in range(4):
                x = (19 * i * (k + 1) + 200 * k) % SIZE[0]
                shown[150 + 30 * k : 180 + 30 * k, x : x + 65] = rng.uniform(0, 255, 3)
            number = i + 1
            image = Image(id=number, file_name=f"{number}.jpg", width=SIZE[0], height=SIZE[1], time_s=i / fps)
            out.append((image, np.clip(shown, 0, 255).astype(np.uint8)))
        return out

    looks = ViewSamples()
    times = {image.id: image.time_s for image, _ in looks.watch(frames()) if image.time_s is not None}
    return [(times[number], look) for number, look in looks.taken.items()]


def seen(pictures: list[NDArray[np.uint8]], fps: float = 5.0) -> list[ViewChange]:
    """The changes in such footage."""
    return changes(looks_of(pictures, fps))


@pytest.mark.parametrize(("shift", "wanted"), [((0, 0), []), ((20, 0), [20 / 640]), ((-7, 5), [np.hypot(7, 5) / 640])])
def test_a_camera_that_was_turned_before_the_footage_is_told(shift: tuple[int, int], wanted: list[float]) -> None:
    before = looks_of([view("noon.jpg")] * 25)[-1][1]
    found = change_since(before, looks_of([view("noon.jpg", shift)] * 25))
    assert [change.shift for change in found] == pytest.approx(wanted, abs=0.002)
    assert [change.time_s for change in found] == [0.0] * len(wanted)
    assert not any(change.cut for change in found)


def test_footage_too_short_for_a_change_tells_none() -> None:
    before = looks_of([view("noon.jpg")] * 25)[-1][1]
    assert change_since(before, looks_of([view("noon.jpg", (20, 0))] * 5)) == []
    assert change_since(before, []) == []


def test_a_view_that_stays_does_not_change() -> None:
    assert seen([view("noon.jpg")] * 50) == []


def test_a_cut_is_told() -> None:
    (change,) = seen([view("noon.jpg")] * 25 + [view("own_road.jpg")] * 25)
    assert change.cut
    assert change.time_s == pytest.approx(5.0, abs=0.5)
    assert str(change).startswith("the view cuts to another view at 5")


@pytest.mark.parametrize("shift", [(20, 0), (-7, 5)])
def test_a_turned_camera_is_told_with_how_far(shift: tuple[int, int]) -> None:
    (change,) = seen([view("noon.jpg")] * 25 + [view("noon.jpg", shift)] * 25)
    assert not change.cut
    assert change.time_s == pytest.approx(5.0, abs=0.5)
    assert change.shift * SIZE[0] == pytest.approx(np.hypot(*shift), abs=2)


def test_what_passes_is_no_other_view() -> None:
    """A lorry before the lens for a second, and a gust of wind."""
    still = [view("noon.jpg")] * 20
    assert seen([*still, *[np.full((*SIZE[::-1], 3), 90, dtype=np.uint8)] * 6, *still]) == []
    assert seen([*still, *[view("noon.jpg", (12, 3))] * 5, *still]) == []
