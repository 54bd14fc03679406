"""Tiles cover an image; what they show and what the whole image shows becomes one list of vehicles."""

import itertools
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope import boxes
from skope.dataset import coco
from skope.dataset.folder import read_image
from skope.detections import Detections, RoadUserDetections
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.detector.tiles import Tile, join_tiles, tiles_of
from skope.terminal.console import Console

WIDE = {"short": 640, "long": 1138}


@pytest.mark.parametrize("size", [(1920, 1080), (1080, 1920), (3840, 2160), (1300, 1290), (2000, 64), (1537, 811)])
def test_tiles_cover_the_image_and_overlap(size: tuple[int, int]) -> None:
    width, height = size
    tiles = tiles_of(width, height, **WIDE)
    times = np.zeros((height, width), dtype=int)
    for tile in tiles:
        assert tile.of(times).shape == (tile.height, tile.width), "inside the image"
        tile.of(times)[...] += 1
        short, long = sorted((tile.width, tile.height))
        assert short <= 640, "unscaled inside the network"
        assert long <= 1138, "unscaled inside the network"
    assert times.min() == 1
    for begins, of, side in ((0, width, "width"), (1, height, "height")):
        starts = sorted({(tile.x, tile.y)[begins] for tile in tiles})
        least = getattr(tiles[0], side)
        assert starts[-1] + least == of
        assert all(b - a <= 0.85 * least + 1 for a, b in itertools.pairwise(starts))


@pytest.mark.parametrize("size", [(640, 360), (1280, 720), (1138, 640), (800, 600)])
def test_an_image_that_enters_nearly_unscaled_has_none(size: tuple[int, int]) -> None:
    assert tiles_of(*size, **WIDE) == []


def seen(rectangles: np.ndarray, window: Tile, scores: np.ndarray, size: tuple[int, int]) -> Detections:
    """A detector that knows where vehicles are: it draws its box around what a window shows of each."""
    corner = np.array([window.x, window.y, window.x, window.y], dtype=float)
    cut = boxes.clip(rectangles - corner, window.width, window.height)
    there = boxes.area(cut) > 0.1 * boxes.area(rectangles)
    points = np.repeat((cut[there, :2] + cut[there, 2:])[:, None] / 2, 33, axis=1)
    return Detections(cut[there], scores[there], np.concatenate([points, np.ones((len(points), 33, 1))], axis=2), size)


@pytest.mark.parametrize("seed", range(4))
def test_each_vehicle_is_there_once_and_whole(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = np.array([(x, y) for x in range(0, 1900, 90) for y in range(0, 1050, 70)], dtype=float)
    rectangles = np.hstack([places, places + rng.uniform(15, 60, (len(places), 2))]).clip(max=(1920, 1080, 1920, 1080))
    bus = np.array([[300, 200, 1300, 700.0]])  # larger than any tile's overlap
    rectangles = np.concatenate([rectangles[boxes.share_inside(rectangles, bus)[:, 0] == 0], bus])
    small = boxes.area(rectangles) < 900
    whole = seen(rectangles[~small], Tile(0, 0, 1920, 1080), np.full((~small).sum(), 0.99), (1920, 1080))
    tiles = tiles_of(1920, 1080, **WIDE)
    parts = [
        (tile, seen(rectangles, tile, rng.uniform(0.9, 0.98, len(rectangles)), (tile.width, tile.height)))
        for tile in tiles
    ]
    assert sum(len(part) for _, part in parts) > 1.2 * len(rectangles)
    found = join_tiles(whole, parts)
    assert found.size == (1920, 1080)
    assert sorted(map(tuple, found.boxes_xyxy.round(6))) == sorted(map(tuple, rectangles.round(6)))
    assert (np.diff(found.scores) <= 0).all()
    middles = (found.boxes_xyxy[:, :2] + found.boxes_xyxy[:, 2:]) / 2
    assert found.keypoints[:, 0, :2] == pytest.approx(middles)
    assert (found.keypoints[..., 2] == 1).all()


def test_a_part_of_what_the_tile_cuts_is_no_vehicle() -> None:
    bus, nose = [[100.0, 100, 500, 300]], [[250.0, 150, 297, 290]]
    one = np.zeros((1, 33, 3))
    whole = Detections(np.array(bus), np.array([0.9]), one, (600, 400))
    for score, left in ((0.8, 1), (0.95, 2)):  # what is surer than the whole vehicle stands before it
        part = Detections(np.array(nose), np.array([score]), one, (300, 400))
        assert len(join_tiles(whole, [(Tile(0, 0, 300, 400), part)])) == left
    uncut = Detections(np.array([[150.0, 150, 200, 290]]), np.array([0.8]), one, (600, 400))
    assert len(join_tiles(whole, [(Tile(0, 0, 600, 400), uncut)])) == 2


@pytest.fixture
def patches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Have detectors find bright patches, of 6 px and more inside a network whose short side is 64 px."""

    def run(self: Predictor, images: Sequence[np.ndarray]) -> list[Detections]:
        found = []
        for image in images:
            height, width = image.shape[:2]
            scale = min(self.config.min_size / min(height, width), self.config.max_size / max(height, width), 1.0)
            _, _, parts, _ = cv2.connectedComponentsWithStats((image[..., 0] > 200).astype(np.uint8))
            corners = np.array([[x, y, x + w, y + h] for x, y, w, h, _ in parts[1:] if scale * min(w, h) >= 6])
            rectangles = corners.reshape(-1, 4).astype(float)
            points = np.ones((len(rectangles), 33, 3))
            found.append(Detections(rectangles, np.full(len(rectangles), 0.9), points, (width, height)))
        return found

    monkeypatch.setattr(Predictor, "_run", run)


def patched(path: Path) -> list[list[float]]:
    """Writes an image of 150 x 100 px with patches of 8 px and a large one; returns their boxes, sorted."""
    rectangles = [[x, y, x + 8, y + 8] for x in range(2, 140, 21) for y in range(3, 60, 13)] + [[20, 66, 130, 96]]
    image = np.zeros((100, 150, 3), dtype=np.uint8)
    for left, top, right, bottom in rectangles:
        image[top:bottom, left:right] = 255
    path.parent.mkdir(exist_ok=True)
    cv2.imwrite(str(path), image)
    return sorted([float(edge) for edge in one] for one in rectangles)


@pytest.mark.usefixtures("patches")
def test_a_predictor_looks_at_tiles_too(random_run: Path, tmp_path: Path) -> None:
    truth = patched(tmp_path / "a.png")
    image = read_image(tmp_path / "a.png")
    settings, quiet = Settings(device="cpu"), Console(quiet=True)
    (plain,) = Predictor.load(random_run, settings, quiet).detections([image])
    assert plain.boxes_xyxy.tolist() == [[20, 66, 130, 96]]
    for batch_size in (1, 3):
        tiled = Predictor.load(random_run, replace(settings, tiles="auto", batch_size=batch_size), quiet)
        for found in tiled.detections([image, image]):
            assert sorted(found.boxes_xyxy.tolist()) == truth


@pytest.mark.usefixtures("patches")
def test_tiles_are_an_option(skope: Any, random_run: Path) -> None:
    truth = patched(Path("in/a.png"))
    common = ("eval", "predict", "in", "--checkpoint", random_run, "-q", "--out")
    assert skope(*common, "plain")[0] == skope(*common, "tiled", "--tiles", "auto")[0] == 0
    assert len(coco.read_results(Path("plain/predictions.json"))) == 1
    assert len(coco.read_results(Path("tiled/predictions.json"))) == len(truth)
    code, _, error = skope(*common, "plain", "--tiles", "auto")
    assert (code, error.count("\n")) == (2, 1)
    assert "tiles = none, now auto" in error
    assert skope(*common, "x", "--tiles", "some")[0] == 2


def people(*rows: tuple[float, float, float, float, float, int]) -> RoadUserDetections:
    """Road users of x, y, width, height, score and category."""
    table = np.array(rows, dtype=float).reshape(-1, 6)
    return RoadUserDetections(boxes.xywh_to_xyxy(table[:, :4]), table[:, 4], table[:, 5].astype(np.int64))


def nothing(size: tuple[int, int], users: RoadUserDetections) -> Detections:
    return Detections(np.zeros((0, 4)), np.zeros(0), np.zeros((0, 33, 3)), size, road_users=users)


def test_road_users_are_joined_by_category() -> None:
    """Each once, the surest box of each; what a tile's edge cuts is left to the whole image."""
    left, right = Tile(0, 0, 600, 400), Tile(400, 0, 600, 400)
    whole = nothing((1000, 400), people((100, 50, 20, 40, 0.5, 4), (590, 50, 40, 40, 0.6, 2)))
    parts = [
        (
            left,
            nothing(
                (600, 400), people((100, 50, 20, 40, 0.9, 4), (100, 50, 20, 40, 0.4, 2), (590, 50, 10, 40, 0.9, 2))
            ),
        ),
        (right, nothing((600, 400), people((300, 50, 16, 40, 0.7, 3)))),
    ]
    users = join_tiles(whole, parts).road_users
    found = zip(users.boxes_xyxy[:, 0].tolist(), users.scores.tolist(), users.categories.tolist(), strict=True)
    assert list(found) == [(100, 0.9, 4), (700, 0.7, 3), (590, 0.6, 2), (100, 0.4, 2)]


def test_a_part_of_a_rider_whom_a_tile_cuts_is_left_out() -> None:
    tile = Tile(0, 0, 600, 400)
    whole = nothing((1000, 400), people((560, 50, 80, 100, 0.9, 3)))
    part = people((562, 52, 30, 40, 0.8, 3), (562, 52, 30, 40, 0.7, 4))
    users = join_tiles(whole, [(tile, nothing((600, 400), part))]).road_users
    assert users.categories.tolist() == [3, 4]
    assert users.scores.tolist() == [0.9, 0.7]
