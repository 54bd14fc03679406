import pytest
from torch import nn
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.keypoint_rcnn import KeypointRCNN, KeypointRCNNHeads, KeypointRCNNPredictor

from skope import detector


def shrink(patch: pytest.MonkeyPatch) -> None:
    """Have detectors made of the same parts with a quarter of the weights.

    Most of a short run is else spent on drawing, moving and saving 59 million weights.
    """

    def backbone(*, backbone_name: str, **options: object) -> nn.Module:
        assert backbone_name == "resnet50"
        return resnet_fpn_backbone(backbone_name="resnet18", **options)

    def network(backbone: nn.Module, *, num_classes: int, num_keypoints: int, **options: object) -> KeypointRCNN:
        return KeypointRCNN(
            backbone,
            box_head=TwoMLPHead(backbone.out_channels * 7 * 7, 64),
            box_predictor=FastRCNNPredictor(64, num_classes),
            keypoint_head=KeypointRCNNHeads(backbone.out_channels, (32, 32)),
            keypoint_predictor=KeypointRCNNPredictor(32, num_keypoints),
            **options,
        )

    patch.setattr(detector, "resnet_fpn_backbone", backbone)
    patch.setattr(detector, "KeypointRCNN", network)


@pytest.fixture
def small_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Small detectors, for tests of what happens around a network."""
    shrink(monkeypatch)
