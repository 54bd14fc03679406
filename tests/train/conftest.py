from collections.abc import Iterator
from dataclasses import replace

import pytest
from torch import nn
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.keypoint_rcnn import KeypointRCNNHeads, KeypointRCNNPredictor
from torchvision.models.resnet import Bottleneck, ResNet

from skope.detector.backbones import BACKBONE_CHOICES, NormLayer
from skope.detector.build import KeypointNetwork


def shrink(patch: pytest.MonkeyPatch, *, body: str = "thin", heads: int = 64) -> None:
    """Have detectors made of the same parts with an eighth of the weights.

    Most of a short run is else spent on drawing, moving and saving 59 million weights. The `thin` body has blocks of
    the same kind as ResNet50; "resnet18", of other blocks, learns sooner.
    """

    def thin(*, weights: None, norm_layer: NormLayer) -> ResNet:
        return ResNet(Bottleneck, [2, 2, 2, 2], width_per_group=16, norm_layer=norm_layer)

    kind = BACKBONE_CHOICES["resnet18"] if body == "resnet18" else replace(BACKBONE_CHOICES["resnet50"], make=thin)
    patch.setattr("skope.detector.backbones.BACKBONE_CHOICES", {**BACKBONE_CHOICES, "resnet50": kind})

    def network(
        backbone: nn.Module, *, num_classes: int | None = None, num_keypoints: int | None = None, **options: object
    ) -> KeypointNetwork:
        if num_classes is None or num_keypoints is None:  # heads of a size that a test has asked for
            return KeypointNetwork(backbone, **options)
        return KeypointNetwork(
            backbone,
            box_head=TwoMLPHead(backbone.out_channels * 7 * 7, heads),
            box_predictor=FastRCNNPredictor(heads, num_classes),
            keypoint_head=KeypointRCNNHeads(backbone.out_channels, (32, 32)),
            keypoint_predictor=KeypointRCNNPredictor(32, num_keypoints),
            **options,
        )

    patch.setattr("skope.detector.build.KeypointNetwork", network)


@pytest.fixture
def small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small detectors, for tests of what happens around a network."""
    shrink(monkeypatch)


@pytest.fixture(scope="module")
def small_detectors() -> Iterator[None]:
    """Small detectors for all of a module: they learn as well as large ones, in a third of the time."""
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch, body="resnet18", heads=256)
        yield
