"""The detector's costly parts, apart from what torchvision does between them, for another runtime to compute.

Three graphs hold nearly all of the arithmetic: from the image to the pyramid and its proposals, from the regions on
boxes to their classes and offsets, from the regions on vehicles to their heat maps. Anchors, suppression, the pooling
of regions, decoding of boxes and the upsampling of heat maps stay torchvision's own.
"""

import io
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN

from skope.detector.backends.handed_proposals import HandedProposals, PyramidWithProposals
from skope.detector.backends.region_pooling import RegionPooling
from skope.types import Floats32

RunNetwork = Callable[[Floats32], list[Floats32]]
"""Computes a part: its input, (N, ...), to its outputs. They may be overwritten by the next call."""

PYRAMID: Final = "pyramid"
BOX_HEAD: Final = "box_head"
KEYPOINT_HEAD: Final = "keypoint_head"

INPUT: Final = "x"
_OPSET: Final = 17
_PYRAMID_LEVELS: Final = 5
_UPSAMPLED: Final = 2
"""torchvision's keypoint predictor enlarges its maps by this factor."""


@dataclass(frozen=True)
class NetworkPart:
    """A part of the network."""

    module: nn.Module
    shape: tuple[int, ...]
    """Of its input; -1 stands for any number."""
    steady: bool = True
    """Whether its input mostly has one size, or one of few."""

    def to_onnx(self) -> bytes:
        """The part as an ONNX model with one input, `INPUT`."""
        example = torch.zeros([_EXAMPLE.get(i, 1) if size < 0 else size for i, size in enumerate(self.shape)])
        free = {i: f"size{i}" for i, size in enumerate(self.shape) if size < 0}
        buffer = io.BytesIO()
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # about tracing and the old exporter; tests compare the results
            torch.onnx.export(
                self.module.eval(),
                (example,),
                buffer,  # type: ignore[arg-type]  # the exporter that follows an example writes to memory too
                dynamo=False,
                opset_version=_OPSET,
                input_names=[INPUT],
                dynamic_axes={INPUT: free},
                do_constant_folding=False,
            )
        return buffer.getvalue()


_EXAMPLE: Final = {0: 1, 2: 128, 3: 192}
"""Sizes of the example along the axes that are free: images in a batch or regions, height and width."""


def parts_of(model: KeypointRCNN) -> dict[str, NetworkPart]:
    """The parts of a model on the CPU, by name."""
    heads = model.roi_heads
    channels = model.backbone.out_channels
    box, keypoint = heads.box_roi_pool.output_size, heads.keypoint_roi_pool.output_size
    return {
        PYRAMID: NetworkPart(_Pyramid(model), (-1, 3, -1, -1)),
        BOX_HEAD: NetworkPart(nn.Sequential(heads.box_head, heads.box_predictor), (-1, channels, *box)),
        KEYPOINT_HEAD: NetworkPart(
            nn.Sequential(heads.keypoint_head, heads.keypoint_predictor.kps_score_lowres),
            (-1, channels, *keypoint),
            steady=False,
        ),
    }


def hand_over(model: KeypointRCNN, runs: Mapping[str, RunNetwork]) -> None:
    """Let `runs` compute the parts of a model from now on; its own layers are given up."""
    heads = model.roi_heads
    pyramid = _HandedPyramid(runs[PYRAMID], model.backbone.out_channels)
    model.backbone, model.rpn.head = pyramid, HandedProposals(pyramid)
    heads.box_roi_pool = RegionPooling(heads.box_roi_pool)
    heads.keypoint_roi_pool = RegionPooling(heads.keypoint_roi_pool)
    heads.box_head, heads.box_predictor = nn.Identity(), _HandedBoxHead(runs[BOX_HEAD])
    heads.keypoint_head, heads.keypoint_predictor = _HandedKeypointHead(runs[KEYPOINT_HEAD]), _Upsampled()


class _Pyramid(nn.Module):
    """An image's feature maps, then the scores, then the offsets of the anchors on each of them."""

    def __init__(self, model: KeypointRCNN) -> None:
        super().__init__()
        self.backbone, self.head = model.backbone, model.rpn.head

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        features = list(self.backbone(images).values())
        scores, offsets = self.head(features)
        return (*features, *scores, *offsets)


class _HandedPyramid(PyramidWithProposals):
    def __init__(self, run: RunNetwork, out_channels: int) -> None:
        super().__init__(out_channels)
        self._run = run

    def forward(self, images: Tensor) -> OrderedDict[str, Tensor]:
        out = _computed(self._run, images)
        features, scores, offsets = (
            out[i : i + _PYRAMID_LEVELS] for i in range(0, 3 * _PYRAMID_LEVELS, _PYRAMID_LEVELS)
        )
        self.proposals = (scores, offsets)
        # As the pooling of regions wants them, which happens up to three times.
        rows = [one.contiguous(memory_format=torch.channels_last) for one in features]
        return OrderedDict(zip(("0", "1", "2", "3", "pool"), rows, strict=True))


class _HandedBoxHead(nn.Module):
    def __init__(self, run: RunNetwork) -> None:
        super().__init__()
        self._run = run

    def forward(self, regions: Tensor) -> tuple[Tensor, Tensor]:
        classes, offsets = _computed(self._run, regions)
        return classes, offsets


class _HandedKeypointHead(nn.Module):
    def __init__(self, run: RunNetwork) -> None:
        super().__init__()
        self._run = run

    def forward(self, regions: Tensor) -> Tensor:
        return _computed(self._run, regions)[0]


class _Upsampled(nn.Module):
    def forward(self, maps: Tensor) -> Tensor:
        return nn.functional.interpolate(
            maps, scale_factor=float(_UPSAMPLED), mode="bilinear", align_corners=False, recompute_scale_factor=False
        )


def _computed(run: RunNetwork, x: Tensor) -> list[Tensor]:
    if not len(x):  # runtimes refuse what is empty: one input tells the outputs' shapes
        return [out[:0] for out in _computed(run, x.new_zeros(1, *x.shape[1:]))]
    return [torch.from_numpy(array) for array in run(x.contiguous().numpy())]
