"""Tiles cover an image; what they show and what the whole image shows becomes one list of vehicles."""

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope import boxes
from skope.console import Console
from skope.dataset import read_image
from skope.detector import Detections
from skope.eval.inference.predictor import Predictor
from skope.eval.inference.settings import Settings
from skope.eval.inference.tiles import Tile, joined, tiles_of
from tests.eval.inference.test_predict_footage import picture

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
    found = joined(whole, parts)
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
        assert len(joined(whole, [(Tile(0, 0, 300, 400), part)])) == left
    uncut = Detections(np.array([[150.0, 150, 200, 290]]), np.array([0.8]), one, (600, 400))
    assert len(joined(whole, [(Tile(0, 0, 600, 400), uncut)])) == 2


def test_a_predictor_joins_what_it_finds_in_each(random_run: Path, tmp_path: Path) -> None:
    image = read_image(picture(tmp_path / "a.png", (100, 150, 3)))
    settings, quiet = Settings(device="cpu", min_score=0.2), Console(quiet=True)
    plain = Predictor(random_run, settings, quiet)
    (whole,) = plain.detections([image])
    tiles = tiles_of(150, 100, short=plain.config.min_size, long=plain.config.max_size)
    assert len(tiles) == 4
    expected = joined(whole, [(tile, plain.detections([tile.of(image)])[0]) for tile in tiles])
    for batch_size in (1, 3):
        tiled = Predictor(random_run, replace(settings, tiles="auto", batch_size=batch_size), quiet)
        (found,) = tiled.detections([image])
        assert len(found) == len(expected) != len(whole)
        # Those of equal scores come in either order.
        assert np.sort(found.boxes_xyxy, axis=0) == pytest.approx(np.sort(expected.boxes_xyxy, axis=0), abs=0.05)


def test_tiles_are_an_option(skope: Any, random_run: Path) -> None:
    picture(Path("in/a.png"), (100, 150, 3))
    common = ("eval", "predict", "in", "--checkpoint", random_run, "--score", "0.2", "-q", "--out")
    assert skope(*common, "plain")[0] == skope(*common, "tiled", "--tiles", "auto")[0] == 0
    assert Path("plain/predictions.json").read_bytes() != Path("tiled/predictions.json").read_bytes()
    code, _, error = skope(*common, "plain", "--tiles", "auto")
    assert (code, error.count("\n")) == (2, 1)
    assert "tiles = none, now auto" in error
    assert skope(*common, "x", "--tiles", "some")[0] == 2
