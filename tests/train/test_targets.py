"""Whatever moves pixels moves boxes and keypoints: one lit pixel at a keypoint, and both arrive together."""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from skope import keypoints
from skope.train import augment
from skope.train.augment import AUGMENT_STEPS, Augment
from skope.train.targets import Vehicles

WIDTH, HEIGHT = 120, 90
NO_BOXES = np.zeros((0, 4))


def dot(k: int) -> tuple[np.ndarray, Vehicles, tuple[int, int]]:
    """A bright 5x5 spot on black around keypoint k, whose box is the spot."""
    col, row = 16 + 2 * k, 20 + k
    pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    pixels[row - 2 : row + 3, col - 2 : col + 3] = 255
    points = np.zeros((1, keypoints.K, 3))
    points[0, k] = [col + 0.5, row + 0.5, 2]
    box = np.array([[col - 2.0, row - 2, col + 3, row + 3]])
    return pixels, Vehicles(box, points, box + 1), (col, row)


def middle(pixels: np.ndarray, floor: float = 60.0) -> np.ndarray:
    """x, y of the light's centre, what is darker than `floor` left out."""
    light = pixels.astype(float).mean(axis=2)
    light = np.where(light > floor, light, 0)
    ys, xs = np.mgrid[: pixels.shape[0], : pixels.shape[1]] + 0.5
    return np.array([(light * xs).sum(), (light * ys).sum()]) / light.sum()


@pytest.mark.parametrize("k", range(keypoints.K))
def test_a_flip_moves_pixel_and_keypoint_together(k: int) -> None:
    pixels, vehicles, _ = dot(k)
    flipped_pixels, flipped = AUGMENT_STEPS["flip"](pixels, vehicles, np.random.default_rng(0))
    partner = keypoints.FLIP[k]
    assert flipped.keypoints[0, partner, :2] == pytest.approx(middle(flipped_pixels))
    assert flipped.keypoints[0, partner, 2] == 2
    assert not np.delete(flipped.keypoints[0], partner, axis=0).any()
    rows, cols = np.nonzero(flipped_pixels[..., 0])
    assert flipped.boxes_xyxy[0].tolist() == [cols.min(), rows.min(), cols.max() + 1, rows.max() + 1]
    assert flipped.ignored_xyxy[0].tolist() == [cols.min() - 1, rows.min() + 1, cols.max(), rows.max() + 2]
    back_pixels, back = AUGMENT_STEPS["flip"](flipped_pixels, flipped, np.random.default_rng(0))
    assert np.array_equal(back_pixels, pixels)
    assert np.array_equal(back.keypoints, vehicles.keypoints)
    assert np.array_equal(back.boxes_xyxy, vehicles.boxes_xyxy)


@pytest.mark.parametrize("k", range(keypoints.K))
def test_a_crop_moves_pixel_and_keypoint_together(k: int) -> None:
    stayed = left = 0
    for seed in range(24):
        pixels, vehicles, _ = dot(k)
        moved_pixels, moved = AUGMENT_STEPS["crop"](pixels, vehicles, np.random.default_rng(seed))
        assert moved_pixels.shape == pixels.shape
        inside = moved.keypoints[:, k, 2] == 2
        if not inside.any():
            left += 1
            assert not moved.keypoints.any()
            continue
        stayed += 1
        x, y = moved.keypoints[0, k, :2]
        assert moved_pixels[int(y), int(x)].min() > 60, "the lit pixel arrived elsewhere"
        box = moved.boxes_xyxy[0]
        if (box > 1).all() and (box[2:] < [WIDTH - 1, HEIGHT - 1]).all():
            around = moved_pixels[int(box[1]) - 1 : int(box[3]) + 2, int(box[0]) - 1 : int(box[2]) + 2]
            centre = middle(around) + [int(box[0]) - 1, int(box[1]) - 1]
            assert np.abs(centre - [x, y]).max() < 0.3
            assert (box[:2] + box[2:]) / 2 == pytest.approx([x, y])
    assert stayed > 2, (stayed, left)


@pytest.mark.parametrize("name", [name for name in AUGMENT_STEPS if name not in ("flip", "crop", "occluders")])
def test_the_others_leave_pixels_where_they_are(name: str) -> None:
    for k in range(keypoints.K):
        pixels, vehicles, (col, row) = dot(k)
        for seed in range(3):
            changed, same = AUGMENT_STEPS[name](pixels, vehicles, np.random.default_rng((seed, k)))
            assert same is vehicles
            assert (changed.shape, changed.dtype) == (pixels.shape, np.uint8)
            around = changed[row - 8 : row + 9, col - 8 : col + 9].astype(float).mean(axis=2)
            faint = around - np.median(around)
            # Streaks of rain apart, the brightest part is still centred on the keypoint.
            light = np.where(faint > 0.5 * faint[6:11, 6:11].max(), faint, 0)
            ys, xs = np.mgrid[-8:9, -8:9]
            shift = np.hypot((light * xs).sum(), (light * ys).sum()) / light.sum()
            # Of an image that is reduced to a fifth a cell has 5 pixels.
            assert shift < {"rain": 2.0, "resample": 1.25}.get(name, 0.7), (k, seed)


def test_every_step_changes_a_real_looking_image_and_repeats() -> None:
    rng = np.random.default_rng(0)
    rough = rng.integers(40, 200, (9, 12, 3), dtype=np.uint8).repeat(10, axis=0).repeat(10, axis=1)
    pixels = np.clip(rough + rng.normal(0, 6, rough.shape), 0, 255).astype(np.uint8)
    eight = np.array([[10.0 * i, 20, 10 * i + 40, 50] for i in range(8)])  # of which a few get an occluder
    vehicles = Vehicles(eight, np.zeros((8, keypoints.K, 3)), NO_BOXES)
    for name in AUGMENT_STEPS:
        once = Augment(**{"flip": 0.0, name: 1.0})
        one, _ = once.apply(pixels, vehicles, np.random.default_rng(8))
        two, _ = once.apply(pixels, vehicles, np.random.default_rng(8))
        assert np.array_equal(one, two), name
        assert not np.array_equal(one, pixels), name
    never, same = Augment(flip=0.0).apply(pixels, vehicles, np.random.default_rng(8))
    assert never is pixels
    assert same is vehicles


def test_parts_of_an_image_have_all_scales_and_often_cut_vehicles(monkeypatch: pytest.MonkeyPatch) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    box = np.array([[50.0, 40, 62, 52]])
    vehicles = Vehicles(box, np.zeros((1, keypoints.K, 3)), NO_BOXES)
    cuts = {}
    for share in (0.25, 0.0):
        monkeypatch.setattr(augment, "CROP_RULES", replace(augment.CROP_RULES, cutting_share=share))
        scales = []
        for seed in range(400):
            _, moved = AUGMENT_STEPS["crop"](pixels, vehicles, np.random.default_rng(seed))
            for x0, y0, x1, y1 in [*moved.boxes_xyxy, *moved.ignored_xyxy]:
                if x0 > 0 and y0 > 0 and x1 < WIDTH and y1 < HEIGHT:
                    scales.append((x1 - x0) / 12)
                else:
                    cuts[share] = cuts.get(share, 0) + 1
        assert min(scales) == pytest.approx(0.3, abs=0.02)
        assert max(scales) == pytest.approx(2.5, abs=0.1)
    assert cuts[0.25] > 1.5 * cuts[0.0] > 0


@pytest.mark.parametrize("crop", [0.0, 1.0])
def test_reducing_first_shows_the_same_at_the_size_of_the_network(crop: float) -> None:
    rng = np.random.default_rng(0)
    smooth = rng.integers(0, 256, (9, 12, 3), dtype=np.uint8)
    pixels = np.asarray(cv2.resize(smooth, (320, 240), interpolation=cv2.INTER_CUBIC))
    points = np.full((1, keypoints.K, 3), [130.0, 110.0, 2.0])
    vehicles = Vehicles(np.array([[100.0, 90, 160, 130]]), points, NO_BOXES)
    plain, reduce = (Augment(crop=crop, reduce=share) for share in (0.0, 1.0))
    for seed in range(10):
        large, where = plain.apply(pixels, vehicles, np.random.default_rng(seed), 0.5)
        small, there = reduce.apply(pixels, vehicles, np.random.default_rng(seed), 0.5)
        assert (large.shape, small.shape) == ((240, 320, 3), (120, 160, 3))
        assert np.allclose(there.boxes_xyxy, where.boxes_xyxy / 2)
        assert np.allclose(there.keypoints[..., :2], where.keypoints[..., :2] / 2)
        expected = np.asarray(cv2.resize(large, (160, 120), interpolation=cv2.INTER_AREA)).astype(int)
        assert np.abs(small.astype(int) - expected).mean() < 2
    same, _ = reduce.apply(pixels, vehicles, np.random.default_rng(3), 1.5)
    assert same.shape == pixels.shape  # a smaller image is not enlarged


def test_around_a_reduced_image_nothing_can_be_made_out() -> None:
    pixels = np.zeros((200, 300, 3), np.uint8)
    pixels[::2] = 255  # the finest pattern, of which none is left
    none = Vehicles(NO_BOXES, np.zeros((0, keypoints.K, 3)), NO_BOXES)
    marked = Vehicles(np.array([[0.0, 0, 300, 200]]), np.zeros((1, keypoints.K, 3)), NO_BOXES)
    reduced = 0
    for seed in range(30):
        moved, _ = AUGMENT_STEPS["crop"](pixels, none, np.random.default_rng(seed))
        _, where = AUGMENT_STEPS["crop"](pixels, marked, np.random.default_rng(seed))
        x0, y0, x1, y1 = np.rint(where.boxes_xyxy[0]).astype(int)
        if (x1 - x0) * (y1 - y0) > 0.5 * 200 * 300:
            continue
        reduced += 1
        moved[max(y0 - 2, 0) : y1 + 2, max(x0 - 2, 0) : x1 + 2] = 127
        assert np.ptp(moved.astype(int)) <= 4
    assert reduced > 5


def test_spectrum_keeps_what_is_shown() -> None:
    rng = np.random.default_rng(3)
    pixels = rng.integers(40, 200, (9, 12, 3), dtype=np.uint8).repeat(10, axis=0).repeat(10, axis=1)
    none = Vehicles(NO_BOXES, np.zeros((0, keypoints.K, 3)), NO_BOXES)
    for seed in range(10):
        changed, _ = AUGMENT_STEPS["spectrum"](pixels, none, np.random.default_rng(seed))
        assert np.abs(changed.mean(axis=(0, 1)) - pixels.mean(axis=(0, 1))).max() < 3
        assert np.corrcoef(changed.ravel(), pixels.ravel())[0, 1] > 0.5
        assert (np.abs(changed.astype(int) - pixels) > 4).mean() > 0.2


def test_noise_is_normal_and_alike_in_half_of_the_images() -> None:
    grey, none = np.full((200, 300, 3), 128, np.uint8), Vehicles(NO_BOXES, np.zeros((0, keypoints.K, 3)), NO_BOXES)
    alike, spreads = 0, []
    for seed in range(40):
        noisy, _ = AUGMENT_STEPS["noise"](grey, none, np.random.default_rng(seed))
        grain = noisy.astype(float) - 128
        alike += bool((grain == grain[..., :1]).all())
        spreads.append(grain.std())
        assert abs(grain.mean()) < 4 * spreads[-1] / np.sqrt(200 * 300)
        within = (np.abs(grain) <= spreads[-1]).mean()
        if spreads[-1] > 8:  # or whole levels are too coarse to tell
            assert within == pytest.approx(math.erf(math.sqrt(0.5)), abs=0.05)
    assert 10 < alike < 30
    assert min(spreads) > 1.9
    assert max(spreads) < 25.5


def test_clean_images_are_moved_and_nothing_more() -> None:
    pixels = np.zeros((40, 60, 3), np.uint8)
    pixels[:, :30] = 200
    none = Vehicles(NO_BOXES, np.zeros((0, keypoints.K, 3)), NO_BOXES)
    often = dict.fromkeys(AUGMENT_STEPS, 1.0) | {"crop": 0.0}
    for seed in range(4):
        clean, _ = Augment(**often, clean=1.0).apply(pixels, none, np.random.default_rng(seed))
        assert np.array_equal(clean, pixels[:, ::-1])
        other, _ = Augment(**often).apply(pixels, none, np.random.default_rng(seed))
        assert not np.array_equal(other, clean)


def test_infrared_is_grey() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    grey, _ = AUGMENT_STEPS["infrared"](
        pixels, Vehicles(NO_BOXES, np.zeros((0, keypoints.K, 3)), NO_BOXES), np.random.default_rng(1)
    )
    assert (grey == grey[..., :1]).all()


@pytest.mark.parametrize("k", range(keypoints.K))
def test_what_an_occluder_covers_is_hidden(k: int) -> None:
    hidden = 0
    for seed in range(8):
        pixels = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
        points = np.zeros((1, keypoints.K, 3))
        points[0, k] = [55 + k / 4, 45.5, 2]
        vehicles = Vehicles(np.array([[40.0, 30, 80, 62]]), points, NO_BOXES)
        covered_pixels, covered = AUGMENT_STEPS["occluders"](pixels, vehicles, np.random.default_rng((seed, k)))
        x, y, v = covered.keypoints[0, k]
        assert [x, y] == points[0, k, :2].tolist()
        under = bool(covered_pixels[int(y), int(x)].any())
        assert v == (1 if under else 2)
        assert np.array_equal(covered.boxes_xyxy, vehicles.boxes_xyxy)
        hidden += under
        assert covered.supervised("visible")[0, k].any() != under
        assert covered.supervised("all")[0, k, 2] == v
    assert not pixels.any()


def test_what_leaves_the_image() -> None:
    points = np.zeros((3, keypoints.K, 3))
    points[0, 0], points[0, 1], points[1, 2] = [12, 12, 2], [8, 12, 1], [2, 2, 2]
    boxes = np.array([[6.0, 6, 16, 16], [0, 0, 11, 11], [0, 0, 9, 9]])
    ignored = np.array([[0.0, 0, 5, 5], [20, 20, 90, 90]])
    moved = Vehicles(boxes, points, ignored).cropped((10, 10), (2, 2), 40, 30)
    assert moved.boxes_xyxy.tolist() == [[0, 0, 12, 12]]
    assert moved.keypoints[0, :3].tolist() == [[4, 4, 2], [0, 0, 0], [0, 0, 0]]
    # One per cent of the second is left, of the third nothing; the first ignored one has gone too.
    assert moved.ignored_xyxy.tolist() == [[20, 20, 40, 30], [0, 0, 2, 2]]
