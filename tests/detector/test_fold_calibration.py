"""Scores that the weights themselves make probabilities."""

import copy
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor
from torchvision.models.detection.keypoint_rcnn import KeypointRCNNPredictor

from skope.detector import fit_score_calibration
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.detect import detect
from skope.detector.score_calibration import ScoreCalibration, path_beside
from skope.metrics.score_reliability import calibration_error, reliability
from skope.schema import AnnotationFile, Image, Result
from tests.samples import make_annotation


def test_the_two_numbers_are_found_again() -> None:
    rng = np.random.default_rng(0)
    logits = rng.normal(0, 4, 40_000)
    right = rng.random(40_000) < 1 / (1 + np.exp(-(0.6 * logits - 1.3)))
    scores = 1 / (1 + np.exp(-logits))
    fitted = fit_score_calibration.fit_boxes(scores, right)
    assert fitted == (pytest.approx(0.6, abs=0.02), pytest.approx(-1.3, abs=0.04))
    after = fit_score_calibration.calibrated(scores, *fitted)
    assert calibration_error(reliability(scores, right)) > 0.1
    assert calibration_error(reliability(after, right)) < 0.01
    sure = after > 0.9
    assert right[sure].mean() == pytest.approx(after[sure].mean(), abs=0.01)


def test_scores_that_float32_calls_1_do_not_flatten_the_rest() -> None:
    """A score of exactly 1 has no logit; taken for a very large one it would weigh more than all others."""
    rng = np.random.default_rng(1)
    logits = rng.normal(2, 3, 20_000)
    right = rng.random(20_000) < 1 / (1 + np.exp(-logits))
    scores = (1 / (1 + np.exp(-logits))).astype(np.float32).astype(np.float64)
    scores[np.flatnonzero(right)[:200]] = 1.0
    assert fit_score_calibration.fit_boxes(scores, right)[0] > 0.85


def test_what_counts_as_found() -> None:
    images = (Image(id=1, file_name="a.png", width=400, height=300),)
    vehicle, ignored = make_annotation(1, 1, (10, 10, 100, 80)), make_annotation(2, 1, (200, 10, 100, 80), iscrowd=1)
    file = AnnotationFile(images=images, annotations=(vehicle, ignored))
    boxes = {
        0.9: (12, 10, 100, 80),
        0.8: (10, 12, 100, 80),
        0.7: (205, 12, 90, 70),
        0.6: (10, 150, 60, 60),
        0.01: (0, 0, 9, 9),
    }
    results = [
        Result(image_id=1, score=score, bbox=np.array(box, dtype=float), keypoints=np.zeros((33, 3)))
        for score, box in boxes.items()
    ]
    scores, right = fit_score_calibration.vehicle_outcomes(file, results)
    # Found, found a second time, (on an ignored vehicle), nothing there, (too faint).
    assert scores.tolist() == [0.9, 0.8, 0.6]
    assert right.tolist() == [True, False, False]


def test_folded_weights_give_the_calibrated_scores(random_run: Path) -> None:
    model, _, _ = load_weights(find_checkpoint(random_run), "cpu")
    image = np.random.default_rng(2).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    (before,) = detect(model, [image], "cpu", min_score=0.0, max_detections=20)
    points = ScoreCalibration(scale=np.linspace(0.2, 1.7, 33), offset=np.linspace(-3, 2, 33), fitted_on={})
    folded = copy.deepcopy(model)
    fit_score_calibration.fold(folded, {1: (0.7, -0.4)}, points)
    (after,) = detect(folded, [image], "cpu", min_score=0.0, max_detections=20)
    assert len(before) == len(after) == 20
    np.testing.assert_allclose(after.boxes_xyxy, before.boxes_xyxy, atol=1e-3)
    np.testing.assert_allclose(after.scores, fit_score_calibration.calibrated(before.scores, 0.7, -0.4), atol=1e-5)
    np.testing.assert_allclose(after.keypoints[..., :2], before.keypoints[..., :2], atol=1e-3)
    np.testing.assert_allclose(after.keypoints[..., 2], points(before.keypoints)[..., 2], atol=1e-4)


def test_a_checkpoint_of_its_own(skope: Any, own_truth: tuple[Path, Path], tmp_path: Path) -> None:
    run, root = own_truth
    out = tmp_path / "calibrated.safetensors"
    common = ("--data", root, "--device", "cpu", "--score", "0.05", "--split", "train")
    code, said, err = skope("eval", "calibrate-scores", *common, "--checkpoint", run, "--last", "1", "--out", out)
    assert code == 0, err
    assert said.splitlines()[-1] == f"Wrote {out}"
    assert "vehicles, after: log loss" in said
    assert not path_beside(run / "epoch_001.safetensors").exists()
    assert skope("eval", *common, "--checkpoint", out, "--out", "after")[0] == 0
    assert json.loads(Path("after", "metrics.json").read_text())["calibrated"] is True


def _softmax(logits: torch.Tensor) -> np.ndarray:
    return torch.softmax(logits.double(), dim=-1).numpy()


@pytest.mark.parametrize("classes", [2, 5])
def test_folded_logits_of_each_category_are_the_calibrated_ones(classes: int) -> None:
    """Where each competes with the background alone."""
    torch.manual_seed(1)
    model: Any = SimpleNamespace(
        roi_heads=SimpleNamespace(
            box_predictor=FastRCNNPredictor(classes, classes), keypoint_predictor=KeypointRCNNPredictor(4, 33)
        )
    )
    box = model.roi_heads.box_predictor.cls_score
    folded = copy.deepcopy(model)
    points = ScoreCalibration(scale=np.ones(33), offset=np.zeros(33), fitted_on={})
    boxes = dict(list({1: (0.7, -0.4), 2: (1.3, 0.6), 3: (0.5, 0.1)}.items())[: classes - 1])
    fit_score_calibration.fold(folded, boxes, points)
    # The last of five has nothing of its own, and shares the vehicles' scale.
    for number, (scale, offset) in {**boxes, classes - 1: boxes.get(classes - 1, (0.7, 0.0))}.items():
        logits = torch.full((500, classes), -60.0)
        logits[:, [0, number]] = 5 * torch.randn(500, 2)
        with torch.inference_mode():
            regions = torch.linalg.solve(box.weight.double(), (logits - box.bias).double().T).T.float()
            before = _softmax(box(regions))[:, number]
            after = _softmax(folded.roi_heads.box_predictor.cls_score(regions))[:, number]
        assert before.std() > 0.3
        np.testing.assert_allclose(after, fit_score_calibration.calibrated(before, scale, offset), atol=2e-3)


def test_weights_of_one_class_are_folded_to_the_same_bits_as_ever() -> None:
    torch.manual_seed(2)
    box = FastRCNNPredictor(16, 2).cls_score
    model: Any = SimpleNamespace(
        roi_heads=SimpleNamespace(
            box_predictor=SimpleNamespace(cls_score=copy.deepcopy(box)), keypoint_predictor=KeypointRCNNPredictor(4, 33)
        )
    )
    points = ScoreCalibration(scale=np.ones(33), offset=np.zeros(33), fitted_on={})
    fit_score_calibration.fold(model, {1: (0.83, -0.37)}, points)
    with torch.no_grad():
        for parameter in (box.weight, box.bias):
            half = 0.83 * (parameter[1] - parameter[0]) / 2
            parameter.copy_(torch.stack([-half, half]))
        box.bias += torch.tensor([0.37 / 2, -0.37 / 2])
    folded = model.roi_heads.box_predictor.cls_score
    assert torch.equal(folded.weight, box.weight)
    assert torch.equal(folded.bias, box.bias)
