"""Detectors of several categories: what their labels mean, and that keypoints are those of vehicles alone."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torchvision.models.detection import KeypointRCNN, keypointrcnn_resnet50_fpn

from skope import schema
from skope.detections import RoadUserDetections
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import load_weights, save_weights
from skope.detector.detect import as_tensor, detect
from skope.errors import UserError
from tests.train.conftest import shrink

ONE = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160)
FOUR = replace(ONE, categories=schema.CATEGORY_NAMES)
PEOPLE = replace(ONE, categories=("vehicle", "pedestrian"))
IMAGES = [np.random.default_rng(i).integers(0, 256, (96, 128, 3), dtype=np.uint8) for i in range(2)]


class _Drawn(torch.nn.Module):
    """In place of the box predictor: random logits, so that each category is found somewhere."""

    def __init__(self, classes: int) -> None:
        super().__init__()
        self.classes = classes

    def forward(self, regions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        draw = torch.Generator().manual_seed(0)
        logits = 2 * torch.randn(len(regions), self.classes, generator=draw)
        return logits, torch.randn(len(regions), 4 * self.classes, generator=draw)


def small(config: DetectorConfig) -> KeypointRCNN:
    with pytest.MonkeyPatch.context() as patch, torch.random.fork_rng():
        shrink(patch)
        torch.manual_seed(0)
        return build(config).eval()


def drawn(config: DetectorConfig) -> KeypointRCNN:
    """A small detector that finds something of each category."""
    model = small(config)
    model.roi_heads.box_predictor = _Drawn(1 + len(config.categories))
    return model


def test_a_config_names_categories_where_there_are_others_than_vehicles() -> None:
    assert "categories" not in ONE.to_dict()
    assert DetectorConfig.from_dict(ONE.to_dict()) == ONE
    assert DetectorConfig.from_dict({**FOUR.to_dict(), "categories": list(schema.CATEGORY_NAMES)}) == FOUR
    assert replace(ONE, categories=("pedestrian", "vehicle")).categories == ("vehicle", "pedestrian")
    for wrong in (("vehicle", "car"), ("pedestrian",), "vehicle", None):
        with pytest.raises(UserError, match="categories"):
            DetectorConfig.from_dict({**ONE.to_dict(), "categories": wrong})


def test_a_checkpoint_of_five_classes_loads_strictly_into_torchvision_and_back(tmp_path: Path) -> None:
    torch.manual_seed(0)
    save_weights(tmp_path / "four.safetensors", build(FOUR), FOUR, {})
    stock = keypointrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_classes=5, num_keypoints=33)
    stock.load_state_dict(load_file(tmp_path / "four.safetensors"), strict=True)
    loaded, config, _ = load_weights(tmp_path / "four.safetensors", "cpu")
    assert config == FOUR
    loaded.load_state_dict(stock.state_dict(), strict=True)


def test_a_checkpoint_whose_header_names_other_categories_than_its_tensors_have_is_refused(tmp_path: Path) -> None:
    save_weights(tmp_path / "a.safetensors", small(FOUR), PEOPLE, {})
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        with pytest.raises(UserError, match=r"box_predictor.*expected \(3"):
            load_weights(tmp_path / "a.safetensors", "cpu")


@pytest.mark.parametrize("config", [FOUR, PEOPLE])
def test_detections_are_torchvisions_with_vehicles_apart(config: DetectorConfig) -> None:
    model = drawn(config)
    found = detect(model, IMAGES, "cpu", min_score=0.3, max_detections=40, categories=config.categories)
    model.roi_heads.score_thresh, model.roi_heads.detections_per_img = 0.3, 40
    with torch.inference_mode():
        expected = model([as_tensor(image, "cpu") for image in IMAGES])
    assert {int(label) for one in expected for label in one["labels"]} == set(range(1, 1 + len(config.categories)))
    for ours, theirs in zip(found, expected, strict=True):
        vehicles = theirs["labels"] == 1
        torch.testing.assert_close(torch.from_numpy(ours.boxes_xyxy).float(), theirs["boxes"][vehicles])
        torch.testing.assert_close(torch.from_numpy(ours.scores).float(), theirs["scores"][vehicles])
        assert ours.keypoints.shape == (int(vehicles.sum()), 33, 3)
        users = ours.road_users
        torch.testing.assert_close(torch.from_numpy(users.boxes_xyxy).float(), theirs["boxes"][~vehicles])
        torch.testing.assert_close(torch.from_numpy(users.scores).float(), theirs["scores"][~vehicles])
        names = [schema.CATEGORY_NAMES[i - 1] for i in users.categories.tolist()]
        assert names == [config.categories[int(label) - 1] for label in theirs["labels"][~vehicles]]


def test_only_vehicles_go_through_the_keypoint_head() -> None:
    model, seen = drawn(FOUR), []
    hook = model.roi_heads.keypoint_head.register_forward_pre_hook(lambda _, inputs: seen.append(len(inputs[0])))
    (found,) = detect(model, IMAGES[:1], "cpu", min_score=0.3, categories=FOUR.categories)
    hook.remove()
    assert len(found.road_users) > 0
    assert seen == [len(found)]


def test_categories_have_to_be_those_of_the_network() -> None:
    with pytest.raises(ValueError, match="the network has 4, got vehicle"):
        detect(small(FOUR), IMAGES, "cpu")


def test_detections_above_a_score_and_as_results() -> None:
    users = RoadUserDetections(np.array([[1.0, 2, 4, 8], [0, 0, 2, 2]]), np.array([0.9, 0.4]), np.array([4, 2]))
    (found,) = detect(drawn(ONE), IMAGES[:1], "cpu", min_score=0.3)
    assert len(found.road_users) == 0
    both = replace(found, road_users=users).above(0.5)
    assert len(both) == int((found.scores > 0.5).sum())
    (result,) = both.road_users.to_results(7)
    assert (result.image_id, result.category, result.score, result.bbox.tolist()) == (
        7,
        "pedestrian",
        0.9,
        [1, 2, 3, 6],
    )
