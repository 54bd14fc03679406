"""Lines of Python with which a detector's tensors load into torchvision's own classes, without skope."""

from pathlib import Path

from skope import keypoints
from skope.detector.backbones import BACKBONES
from skope.detector.build import ASPECTS, BOX_CELLS, HEADS, MAX_DETECTIONS, PROPOSALS, DetectorConfig


def torchvision_code(path: Path, config: DetectorConfig) -> str:
    """Lines of Python that build torchvision's own model as `model` and load an exported state dict into it.

    Its anchors are no weights: with others a strict load succeeds as well, and the detections are wrong.
    """
    labels = "" if len(config.categories) == 1 else f"  # labels 1 to {len(config.categories)}: "
    labels += ", ".join(config.categories) if labels else ""
    sizes = ", ".join(f"({side},)" for side in config.anchors)
    imports, heads = _heads(config)
    kind = BACKBONES[config.backbone]
    layers = f".{kind.layers}" if kind.layers else ""
    return f"""\
import torch
from torchvision.models import {config.backbone}
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import BackboneWithFPN
{imports}from torchvision.ops import FrozenBatchNorm2d
norm = lambda width: FrozenBatchNorm2d(width, eps={config.norm_eps})
layers = {config.backbone}(weights=None, norm_layer=norm){layers}
backbone = BackboneWithFPN(
    layers, {kind.returned},
    in_channels_list={list(kind.channels)}, out_channels={config.pyramid_width})
anchors = AnchorGenerator(({sizes}), ({ASPECTS},) * {len(config.anchors)})
model = KeypointRCNN(
    backbone, {heads}, rpn_anchor_generator=anchors,
    min_size={config.min_size}, max_size={config.max_size}, box_detections_per_img={MAX_DETECTIONS},
    rpn_post_nms_top_n_test={PROPOSALS})
model.load_state_dict(torch.load({str(path)!r}))
model.eval(){labels}"""


def _heads(config: DetectorConfig) -> tuple[str, str]:
    """Lines of imports, and what `KeypointRCNN` is given for the heads."""
    classes = 1 + len(config.categories)
    if config.heads == HEADS:
        return "", f"num_classes={classes}, num_keypoints={keypoints.K}"
    imports = """\
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.keypoint_rcnn import KeypointRCNNHeads, KeypointRCNNPredictor
"""
    layers, width, box_width = config.heads
    return imports, (
        f"box_head=TwoMLPHead({config.pyramid_width * BOX_CELLS**2}, {box_width}),\n"
        f"    box_predictor=FastRCNNPredictor({box_width}, {classes}),\n"
        f"    keypoint_head=KeypointRCNNHeads({config.pyramid_width}, ({width},) * {layers}),\n"
        f"    keypoint_predictor=KeypointRCNNPredictor({width}, {keypoints.K})"
    )
