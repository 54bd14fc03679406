"""The detectors that come with skope: small, whole, one the default, and detectors of vehicles."""

import hashlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from skope import boxes, keypoints
from skope.dataset import coco
from skope.dataset.folder import PREDICTIONS_FILE
from skope.detections import Detections
from skope.detector import int8_ranges, weights
from skope.detector.build import build
from skope.detector.checkpoint import load_weights, read_checkpoint
from skope.detector.detect import detect
from skope.schema import CATEGORY_ID, CATEGORY_NAMES
from tests.samples import make_dataset

PICTURE = Path(__file__).parents[2] / "docs" / "noon.jpg"
"""A generated junction by day with more than six vehicles, most of them clear of one another."""
ROAD33 = weights.path(weights.DEFAULT_WEIGHTS)


@pytest.fixture(scope="module")
def picture() -> NDArray[np.uint8]:
    return cv2.imread(str(PICTURE))[:, :, ::-1].copy()


@pytest.fixture(scope="module")
def found(picture: NDArray[np.uint8]) -> Detections:
    model, _, _ = load_weights(ROAD33, "cpu")
    return detect(model, [picture], "cpu", categories=CATEGORY_NAMES)[0]


def test_loading_draws_no_weights_that_the_file_gives() -> None:
    before = torch.get_rng_state()
    load_weights(weights.path("road33-lite"), "cpu")
    assert torch.equal(torch.get_rng_state(), before)


@pytest.fixture(scope="module")
def found_at_once(picture: NDArray[np.uint8]) -> Detections:
    """Where the box head looks once, as torchvision's own does."""
    model, config, _ = load_weights(ROAD33, "cpu")
    once = build(replace(config, box_passes=1))
    once.load_state_dict(model.state_dict())
    return detect(once.eval(), [picture], "cpu", categories=CATEGORY_NAMES)[0]


@pytest.mark.parametrize(
    ("name", "most_bytes", "origin", "fewest"),
    [
        ("road33", 38_000_000, "the leg 6 of scripts/legs.toml", 59_000_000),
        ("road33-lite", 12_000_000, "training stage lite-3 of scripts/legs.toml, round 3", 12_500_000),
    ],
)
def test_it_is_small_enough_to_travel_and_says_where_it_is_from(
    name: str, most_bytes: int, origin: str, fewest: int
) -> None:
    file = weights.path(name)
    assert file.stat().st_size <= most_bytes
    header, state = read_checkpoint(file)
    assert header["scheme"] == keypoints.SCHEME
    assert header["metadata"]["origin"] == origin
    assert header["config"]["norm"] == "frozen"  # small batches of who goes on from it have no statistics
    assert header["config"]["categories"] == list(CATEGORY_NAMES)
    assert header["config"]["keypoint_edition"] == keypoints.EDITION
    assert header["metadata"]["calibrated"]["categories"] == list(CATEGORY_NAMES)
    assert hashlib.sha256(file.read_bytes()).hexdigest() in file.with_suffix(".md").read_text()
    assert int8_ranges.RANGES_KEY in header["metadata"]
    assert sum(tensor.numel() for tensor in state.values()) > fewest
    assert file.with_suffix(".md").read_text().startswith(f"# {name}\n")


def test_every_shipped_detector_is_one_that_a_live_stream_may_get() -> None:
    assert weights.names() == weights.BY_ACCURACY


def test_the_light_one_finds_the_same_vehicles() -> None:
    heavy, light = (load_weights(weights.path(name), "cpu")[0] for name in weights.BY_ACCURACY)
    best, away = [], []
    for name in ("noon", "low_sun", "fog", "rain_night"):
        image = cv2.imread(str(PICTURE.with_name(f"{name}.jpg")))[:, :, ::-1].copy()
        sure, other = (
            found[found.scores > score]
            for model, score in ((heavy, 0.9), (light, 0.5))
            for found in detect(model, [image], "cpu", categories=CATEGORY_NAMES)
        )
        overlap = boxes.iou(sure.boxes_xyxy, other.boxes_xyxy)
        best += overlap.max(axis=1, initial=0.0).tolist()
        for i, j in enumerate(overlap.argmax(axis=1)):
            both = (sure.keypoints[i, :, 2] > 0.7) & (other.keypoints[j, :, 2] > 0.7) & (overlap[i, j] > 0.6)
            size = np.sqrt(np.prod(sure.boxes_xyxy[i, 2:] - sure.boxes_xyxy[i, :2]))
            apart = sure.keypoints[i, both, :2] - other.keypoints[j, both, :2]
            away += (np.linalg.norm(apart, axis=1) / size).tolist()
    assert len(best) > 30
    assert np.mean(np.array(best) > 0.6) > 0.8
    assert np.median(away) < 0.05


def test_it_finds_vehicles_and_their_visible_keypoints(found: Detections) -> None:
    sure = found.scores > 0.9
    assert 6 <= sure.sum() < 20
    first = int(np.argmax(found.boxes_xyxy[:, 2] - found.boxes_xyxy[:, 0]))  # the car in front
    left, top, right, bottom = found.boxes_xyxy[first]
    assert (right - left) > 150
    assert sure[first]
    assert np.median(found.keypoints[first, :, 2]) > 0.8  # calibrated: a probability of being where it is said to be
    x, y, score = found.keypoints[first].T
    seen = score > 0.5
    assert (x[seen] > left - 1).all()
    assert (x[seen] < right + 1).all()
    assert (y[seen] > top - 1).all()
    assert (y[seen] < bottom + 1).all()
    height = dict(zip(keypoints.NAMES, y, strict=True))
    for corner in ("front_right", "front_left", "rear_right", "rear_left"):
        assert height[f"roof_{corner}"] < height[f"wheel_{corner}"]


def test_a_stock_torchvision_model_with_its_tensors_finds_the_same(
    picture: NDArray[np.uint8], found_at_once: Detections, skope: Any, tmp_path: Path
) -> None:
    """It is built by the lines that the export prints; its box head looks once, which is said."""
    code, lines, error = skope("train", "export", "road33", "--to", "state_dict", "--out", tmp_path / "road33.pth")
    assert (code, error) == (0, "")
    assert "without skope its box head looks once, not 2 times: looser boxes" in lines
    made: dict[str, Any] = {}
    exec(lines[lines.index("import torch") : lines.index("model.eval()")], made)
    with torch.inference_mode():
        own = made["model"].eval()([torch.from_numpy(picture).permute(2, 0, 1) / 255])[0]
    sure = (own["scores"] > 0.5) & (own["labels"] == CATEGORY_ID)
    expected = found_at_once[found_at_once.scores > 0.5]
    assert sure.sum() == len(expected) >= 6
    np.testing.assert_allclose(own["boxes"][sure].numpy(), expected.boxes_xyxy, atol=0.01)
    np.testing.assert_allclose(own["scores"][sure].numpy(), expected.scores, atol=1e-4)


def test_predict_runs_it_where_no_checkpoint_is_named(skope: Any, tmp_path: Path, found: Detections) -> None:
    code, _, error = skope("eval", "predict", PICTURE, "--precision", "float32", "--out", "seen", "--quiet")
    assert (code, error) == (0, "")
    written = coco.read_results(tmp_path / "seen" / PREDICTIONS_FILE)
    np.testing.assert_allclose([one.score for one in written], found.scores[found.scores > 0.5], atol=1e-4)


def test_eval_runs_it_where_there_is_no_run(skope: Any, tmp_path: Path) -> None:
    data = make_dataset(tmp_path / "data", images=1)
    assert skope("eval", "--data", data, "--split", "easy", "--device", "cpu")[0] == 0
    assert Path("runs/road33/eval/report.html").is_file()
    Path("runs/skope").mkdir()
    code, _, error = skope("eval", "--data", data, "--split", "easy")
    assert code == 2
    assert "runs/skope: no checkpoint in this folder" in error
