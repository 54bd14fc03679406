import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope import keypoints
from skope.camera.model import Camera
from skope.dataset.folder import read_image
from skope.detections import detections_of_results
from skope.errors import UserError
from skope.pictures import draw
from skope.schema import Annotation, Result
from skope.tracking.track_list import Tracks
from skope.traffic.observation import Observation
from tests.samples import make_annotation

GREY = np.full((360, 640, 3), 100, dtype=np.uint8)


def changed(image: draw.Pixels, before: draw.Pixels = GREY) -> tuple[int, int, int, int]:
    """x0, y0, x1, y1 of the pixels that differ."""
    rows, columns = np.nonzero((image != before).any(axis=2))
    return int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1


def only(index: int, x: float, y: float, v: int) -> Annotation:
    """A vehicle with one labelled keypoint."""
    points = np.zeros((keypoints.K, 3))
    points[index] = (x, y, v)
    return Annotation(id=1, image_id=1, bbox=np.array([100, 100, 200, 150]), keypoints=points, area=1)


def test_the_input_is_left_as_it_was() -> None:
    image = GREY.copy()
    draw.annotations(image, [make_annotation(1, 1, (40, 40, 90, 60))])
    assert np.array_equal(image, GREY)


def test_a_visible_point_is_filled_with_its_parts_colour_and_a_hidden_one_is_hollow() -> None:
    wheel = keypoints.INDEX["wheel_front_left"]
    # At 1080 lines the points are large enough to tell.
    large = np.full((1080, 1920, 3), 100, dtype=np.uint8)
    visible = draw.annotations(large, [only(wheel, 200.5, 180.5, 2)])
    hidden = draw.annotations(large, [only(wheel, 200.5, 180.5, 1)])
    absent = draw.annotations(large, [only(wheel, 0, 0, 0)])
    assert tuple(visible[180, 200]) == keypoints.COLORS[wheel]
    assert tuple(hidden[180, 200]) == (100, 100, 100)
    ring = hidden[176:185, 196:205].astype(int) - absent[176:185, 196:205]
    assert np.abs(ring).max() > 30


@pytest.mark.parametrize("scale", [1, 2, 3])
def test_a_point_is_drawn_around_its_own_pixels_centre(scale: int) -> None:
    with_point = draw.annotations(GREY, [only(32, 210.5, 160.5, 2)], scale=scale)
    without = draw.annotations(GREY, [only(32, 0, 0, 0)], scale=scale)
    assert with_point.shape == (360 * scale, 640 * scale, 3)
    x0, y0, x1, y1 = changed(with_point, without)
    assert (x0 + x1) / 2 == pytest.approx(210.5 * scale, abs=0.5)
    assert (y0 + y1) / 2 == pytest.approx(160.5 * scale, abs=0.5)


def test_a_box_is_drawn_on_its_edges() -> None:
    boxed = draw.annotations(GREY, [only(0, 0, 0, 0)])
    x0, _, x1, y1 = changed(boxed)
    assert (x0, x1, y1) == (pytest.approx(100, abs=2), pytest.approx(300, abs=2), pytest.approx(250, abs=2))
    assert (boxed[150:200, 150:250] == 100).all()


def test_an_ignored_vehicle_is_a_dashed_box_without_points() -> None:
    ignored = make_annotation(1, 1, (100, 100, 200, 150), iscrowd=1)
    image = draw.annotations(GREY, [ignored])
    assert (image[110:240, 110:290] == 100).all()
    edge = (image[249:252, 110:290] != 100).any(axis=(0, 2))
    assert 0.3 < edge.mean() < 0.7
    assert np.abs(np.diff(edge.astype(int))).sum() > 10


def test_results_are_drawn_and_stray_ones_do_no_harm() -> None:
    points = np.full((keypoints.K, 3), 0.9)
    points[:, :2] = np.random.default_rng(0).uniform(120, 200, (keypoints.K, 2))
    good = Result(image_id=1, score=0.97, bbox=np.array([110, 110, 100, 100]), keypoints=points)
    stray = Result(image_id=1, score=0.5, bbox=np.array([-1e12, 5, 2e12, 1e12]), keypoints=points * 1e12)
    below = Result(image_id=1, score=0.4, bbox=np.array([1e12, 1e12, 9, 9]), keypoints=points)
    image = draw.results(GREY, [good, stray, below])
    assert not np.array_equal(image, GREY)
    assert np.array_equal(draw.results(GREY, []), GREY)


def prediction(probability: float, side: float = 100.0) -> Result:
    """A vehicle with all keypoints on a grid, at the same probability."""
    points = np.full((keypoints.K, 3), probability)
    points[:, 0], points[:, 1] = 100 + side * (np.arange(33) % 6 + 0.5) / 6, 100 + side * (np.arange(33) // 6 + 0.5) / 6
    return Result(image_id=1, score=0.9, bbox=np.array([100, 100, side, side]), keypoints=points)


def test_predicted_points_are_as_strong_as_they_are_sure() -> None:
    inside = slice(104, 197), slice(104, 197)
    change = [
        np.abs(draw.results(GREY, [prediction(p)])[inside].astype(int) - 100).max(axis=2) for p in (0.1, 0.3, 0.9)
    ]
    assert not change[0].any()
    assert 40 < change[1].max() < 0.6 * change[2].max()
    assert (change[1] > 0).sum() < 0.7 * (change[2] > 0).sum()  # no skeleton between them


def test_small_predictions_have_no_skeleton() -> None:
    a, b = keypoints.SKELETON[0]
    for side, lines in ((30.0, False), (90.0, True)):
        left = np.tile([100 + 0.2 * side, 100 + side / 2, 0.9], (keypoints.K, 1))
        left[b, 0] = 100 + 0.8 * side
        one = Result(image_id=1, score=0.9, bbox=np.array([100, 100, side, side]), keypoints=left)
        pixels = draw.results(GREY, [one])
        middle = int(100 + side / 2)
        between = pixels[middle - 2 : middle + 2, middle - 2 : middle + 2]
        assert bool((between != 100).any()) is lines, (side, a)


def test_lines_grow_with_the_image() -> None:
    small, large = GREY, np.full((2160, 3840, 3), 100, dtype=np.uint8)
    for image, least, most in ((small, 1, 3), (large, 4, 7)):
        drawn = draw.annotations(image, [only(0, 0, 0, 0)])
        width = int((drawn[200, 80:120] != 100).any(axis=1).sum())
        assert least <= width <= most


def test_a_contact_sheet_has_a_cell_for_each_image() -> None:
    tiles = [np.full((10, 20, 3), value, dtype=np.uint8) for value in (50, 100, 150)]
    sheet = draw.contact_sheet(tiles, columns=2, gap=4)
    assert sheet.shape == (24, 44, 3)
    assert [int(sheet[y, x, 0]) for y, x in ((0, 0), (9, 43), (14, 0))] == [50, 100, 150]
    assert (sheet[10:14] == 16).all()
    assert draw.contact_sheet(tiles, columns=9).shape == (10, 68, 3)
    with pytest.raises(ValueError, match="at least one image"):
        draw.contact_sheet([], columns=2)


@pytest.mark.parametrize("width", [20, 640, 1920])
def test_a_caption_is_a_strip_above_the_image(width: int) -> None:
    image = np.full((40, width, 3), 100, dtype=np.uint8)
    out = draw.caption(image, "straße " * 40)
    assert out.shape[1] == width
    assert np.array_equal(out[-40:], image)
    assert out[:-40].max() > 200 or width == 20


def test_files_hold_rgb_in_the_right_order(tmp_path: Path) -> None:
    image = np.zeros((8, 8, 3), dtype=np.uint8)
    image[..., 0] = 200
    draw.write(tmp_path / "sub" / "a.png", image)
    assert cv2.imread(str(tmp_path / "sub" / "a.png"))[0, 0].tolist() == [0, 0, 200]
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot be written"):
        draw.write(tmp_path / "file" / "a.png", image)


def test_a_path_need_not_be_utf_8(tmp_path: Path) -> None:
    path = tmp_path / os.fsdecode(b"\xff") / "a.png"
    draw.write(path, GREY)
    assert np.array_equal(read_image(path), GREY)


VEHICLES = [only(0, 120.5, 130.5, 2)]
DRAWN: dict[str, Callable[[Any], draw.Pixels]] = {
    "annotations": lambda image: draw.annotations(image, VEHICLES),
    "annotations, enlarged": lambda image: draw.annotations(image, VEHICLES, scale=2),
    "numbered": lambda image: draw.numbered(image, VEHICLES),
    "results": lambda image: draw.results(image, [prediction(0.9)]),
    "boxes_3d": lambda image: draw.boxes_3d(image, VEHICLES, Camera.looking([0, 0, 6], yaw=0, pitch_down=0.3)),
    "masks": lambda image: draw.masks(image, VEHICLES),
    "occlusion": lambda image: draw.occlusion(image, VEHICLES),
    "caption": lambda image: draw.caption(image, "caption"),
    "contact_sheet": lambda image: draw.contact_sheet([image, image], 2),
    "Detections.draw": lambda image: detections_of_results([prediction(0.9)], (640, 360)).draw(image),
    "Tracks.draw": lambda image: Tracks([], Observation(times_s=np.zeros(1))).draw(image, 0),
}
"""Each public function that draws on an image."""


@pytest.mark.parametrize("name", DRAWN)
@pytest.mark.parametrize(
    "view",
    [lambda image: image[..., ::-1], np.flipud, lambda image: image[:, ::-1], np.asfortranarray],
    ids=["BGR", "upside down", "mirrored", "column order"],
)
def test_an_image_is_drawn_on_in_any_order_of_memory(name: str, view: Callable[[draw.Pixels], draw.Pixels]) -> None:
    image = view(np.random.default_rng(0).integers(0, 256, GREY.shape).astype(np.uint8))
    np.testing.assert_array_equal(DRAWN[name](image), DRAWN[name](image.copy(order="C")))


@pytest.mark.parametrize("image", [GREY[..., 0], GREY[:0], GREY / 255.0, None], ids=["grey", "empty", "float", "None"])
@pytest.mark.parametrize("name", DRAWN)
def test_no_image_is_drawn_on(name: str, image: Any) -> None:
    with pytest.raises(UserError, match=r"^image(s\[0\])?: expected \(H, W, 3\) RGB pixels of type uint8.*, got "):
        DRAWN[name](image)


def test_only_images_are_written(tmp_path: Path) -> None:
    draw.write(tmp_path / "a.png", np.flipud(GREY)[..., ::-1])
    assert np.array_equal(read_image(tmp_path / "a.png"), GREY)
    for image in (GREY[..., 0], GREY[:0], GREY / 255.0):
        with pytest.raises(UserError, match=r"^image: expected \(H, W, 3\) RGB pixels"):
            draw.write(tmp_path / "b.png", image)
    assert not (tmp_path / "b.png").exists()


def test_only_depths_are_coloured() -> None:
    metres = np.linspace(4, 80, 48, dtype=np.float32).reshape(6, 8)
    np.testing.assert_array_equal(draw.depth(metres[::-1]), draw.depth(metres)[::-1])
    for wrong in (metres[:0], metres[None], np.ones((6, 8), dtype=np.int64)):
        with pytest.raises(UserError, match=r"^metres: expected \(H, W\) numbers of a floating type, got \("):
            draw.depth(wrong)
