"""Costly parts of the detector as separate graphs, for another runtime to compute.

Three graphs contain nearly all of the arithmetic: from the image to the pyramid and its proposals, from box regions to
classes and offsets, and from vehicle regions to heat maps. Anchors, suppression, decoding of boxes and the upsampling
of heat maps remain torchvision's.

This module also pools regions (RoIAlign; He et al., 2017). On a CPU it is five times as fast as torchvision, which uses
one thread. Every pooled value is a weighted sum of values of one feature map, with the same weights for all channels.
With channels last, `embedding_bag` computes this: it gathers whole rows of memory in all threads.
"""

import io
import math
import warnings
from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Final

import torch
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN
from torchvision.ops.poolers import LevelMapper, MultiScaleRoIAlign

from skope.detector.network_settings import INPUT_NAME
from skope.types import Floats32


@dataclass(frozen=True)
class ExportShape:
    """Shapes and version of exported graphs."""

    canonical_px: tuple[int, int] = (224, 4)
    """Size of a region that is pooled from the level with this number, as in torchvision."""
    opset: int = 17
    """Version of ONNX's operators."""
    pyramid_levels: int = 5
    """Number of levels of the feature pyramid."""
    keypoint_factor: int = 2
    """Factor by which torchvision's keypoint predictor enlarges its maps."""


EXPORT_SHAPE: Final = ExportShape()


class RegionPooling(nn.Module):
    """Replacement for `MultiScaleRoIAlign` with the same arguments and, up to rounding, the same result."""

    def __init__(self, pool: MultiScaleRoIAlign) -> None:
        super().__init__()
        self.output_size: Sequence[int] = pool.output_size
        self._names, self._samples = pool.featmap_names, pool.sampling_ratio

    def forward(
        self, features: Mapping[str, Tensor], boxes: Sequence[Tensor], image_shapes: Sequence[tuple[int, int]]
    ) -> Tensor:
        """Pool regions.

        Args:
            features: (N, C, H, W) maps of N images, by name.
            boxes: (K, 4) xyxy of each image, pixels.
            image_shapes: Height and width of each image.

        Returns:
            (K of all images, C, *output_size), channels last in memory.
        """
        maps = [features[name] for name in self._names]
        tallest = max(height for height, _ in image_shapes)
        strides = [2 ** round(math.log2(tallest / feature_map.shape[2])) for feature_map in maps]
        first, last = (int(math.log2(stride)) for stride in (strides[0], strides[-1]))
        level_of = LevelMapper(first, last, *EXPORT_SHAPE.canonical_px)(list(boxes))
        image_of = torch.repeat_interleave(torch.tensor([len(image_boxes) for image_boxes in boxes]))
        together = torch.cat(list(boxes))
        cells = self.output_size[0] * self.output_size[1]
        out = torch.empty(len(together), cells, maps[0].shape[1])  # channels last
        for level, (feature_map, stride) in enumerate(zip(maps, strides, strict=True)):
            here = torch.where(level_of == level)[0]
            if len(here):
                out[here] = self._of_level(feature_map, together[here] / stride, image_of[here]).view(
                    len(here), cells, -1
                )
        return out.view(len(together), *self.output_size, maps[0].shape[1]).permute(0, 3, 1, 2)

    def _of_level(self, features: Tensor, regions: Tensor, image_of: Tensor) -> Tensor:
        """Return (K * cells, C) means over the samples of each cell of (K, 4) regions, in pixels of the map."""
        channels, height, width = features.shape[1:]
        rows = features.permute(0, 2, 3, 1).contiguous().view(-1, channels)
        down, across = self.output_size
        extent = (regions[:, 2:] - regions[:, :2]).clamp(min=1.0)
        x, x_share = self._taps(regions[:, 0], extent[:, 0], across, width)
        y, y_share = self._taps(regions[:, 1], extent[:, 1], down, height)
        # Axes: region, cell down, cell across, tap down, tap across.
        y = (y + (image_of * height)[:, None, None])[:, :, None, :, None]
        index = y * width + x[:, None, :, None, :]
        share = y_share[:, :, None, :, None] * x_share[:, None, :, None, :] / self._samples**2
        taps = (2 * self._samples) ** 2
        return nn.functional.embedding_bag(
            index.reshape(-1, taps).int(), rows, mode="sum", per_sample_weights=share.reshape(-1, taps)
        )

    def _taps(self, begin: Tensor, extent: Tensor, cells: int, size: int) -> tuple[Tensor, Tensor]:
        """Return (K, cells, 2 * samples) indices and weights of the two pixels of an axis around each sample."""
        count = cells * self._samples
        at = begin[:, None] + (torch.arange(count) + 0.5) * extent[:, None] / count
        inside = (at >= -1.0) & (at <= size)
        at = at.clamp(0.0, size - 1.0)
        low = at.int().clamp(max=size - 1)
        high = (low + 1).clamp(max=size - 1)
        share = at - low
        index = torch.stack([low, high], dim=-1)
        shares = torch.stack([1 - share, share], dim=-1) * inside[..., None]
        return index.view(len(begin), cells, -1), shares.view(len(begin), cells, -1)


class PyramidWithProposals(nn.Module):
    """Replaces the detector's backbone, and also stores the output of the proposal head (RPN).

    In subclasses, `forward` returns the feature maps of (N, 3, H, W) images by name.
    """

    def __init__(self, out_channels: int) -> None:
        super().__init__()
        self.out_channels = out_channels
        self.proposals: tuple[list[Tensor], list[Tensor]] = ([], [])
        """Return scores and offsets of the anchors for the most recent images."""


class HandedProposals(nn.Module):
    """Replacement for the proposals' head that returns what the pyramid has computed."""

    def __init__(self, pyramid: PyramidWithProposals) -> None:
        super().__init__()
        self._pyramid = (pyramid,)  # in a tuple, so that it is not a submodule

    def forward(self, features: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        return self._pyramid[0].proposals


RunNetwork = Callable[[Floats32], list[Floats32]]
"""Function that computes a part: input (N, ...) to outputs, which the next call may overwrite."""

PYRAMID_NAME: Final = "pyramid"
BOX_HEAD: Final = "box_head"
KEYPOINT_HEAD: Final = "keypoint_head"


@dataclass(frozen=True)
class NetworkPart:
    """Part of the network."""

    module: nn.Module
    shape: tuple[int, ...]
    """Shape of its input; -1 for a free axis."""
    steady: bool = True
    """Whether its input usually has one of a few sizes."""

    def to_onnx(self) -> bytes:
        """Return the part as an ONNX model with one input, `INPUT_NAME`."""
        example = torch.zeros([EXAMPLE_SIZES.get(i, 1) if size < 0 else size for i, size in enumerate(self.shape)])
        free = {i: f"size{i}" for i, size in enumerate(self.shape) if size < 0}
        buffer = io.BytesIO()
        with warnings.catch_warnings(), torch.no_grad():
            warnings.simplefilter("ignore")  # about tracing and the old exporter; tests compare the results
            torch.onnx.export(
                self.module.eval(),
                (example,),
                buffer,  # type: ignore[arg-type]  # the exporter that follows an example writes to memory too
                dynamo=False,
                opset_version=EXPORT_SHAPE.opset,
                input_names=[INPUT_NAME],
                dynamic_axes={INPUT_NAME: free},
                do_constant_folding=False,
            )
        return buffer.getvalue()


EXAMPLE_SIZES: Final = {0: 1, 2: 128, 3: 192}
"""Sizes of the example along the free axes: number of images or regions, height and width."""


def parts_of(model: KeypointRCNN) -> dict[str, NetworkPart]:
    """Return the parts of a model on the CPU, by name."""
    heads = model.roi_heads
    channels = model.backbone.out_channels
    box, keypoint = heads.box_roi_pool.output_size, heads.keypoint_roi_pool.output_size
    return {
        PYRAMID_NAME: NetworkPart(_Pyramid(model), (-1, 3, -1, -1)),
        BOX_HEAD: NetworkPart(
            nn.Sequential(_ChannelsFirst(), heads.box_head, heads.box_predictor), (-1, *box, channels), steady=False
        ),
        KEYPOINT_HEAD: NetworkPart(
            nn.Sequential(_ChannelsFirst(), heads.keypoint_head, heads.keypoint_predictor.kps_score_lowres),
            (-1, *keypoint, channels),
            steady=False,
        ),
    }


def hand_over(model: KeypointRCNN, runs: Mapping[str, RunNetwork]) -> None:
    """Make `runs` compute the parts of a model; its own layers are removed."""
    heads = model.roi_heads
    pyramid = _HandedPyramid(runs[PYRAMID_NAME], model.backbone.out_channels)
    model.backbone, model.rpn.head = pyramid, HandedProposals(pyramid)
    heads.box_roi_pool = RegionPooling(heads.box_roi_pool)
    heads.keypoint_roi_pool = RegionPooling(heads.keypoint_roi_pool)
    heads.box_head, heads.box_predictor = nn.Identity(), _HandedBoxHead(runs[BOX_HEAD])
    heads.keypoint_head, heads.keypoint_predictor = _HandedKeypointHead(runs[KEYPOINT_HEAD]), _Upsampled()


class _ChannelsFirst(nn.Module):
    """Return regions (N, C, H, W) from (N, H, W, C), the layout of pooled regions and of runtimes' convolutions."""

    def forward(self, regions: Tensor) -> Tensor:
        return regions.permute(0, 3, 1, 2)


class _Pyramid(nn.Module):
    """Return an image's feature maps (N, H, W, C), then the scores and the offsets of the anchors on each map."""

    def __init__(self, model: KeypointRCNN) -> None:
        super().__init__()
        self.backbone, self.head = model.backbone, model.rpn.head

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        features = list(self.backbone(images).values())
        scores, offsets = self.head(features)
        return (*(feature_map.permute(0, 2, 3, 1) for feature_map in features), *scores, *offsets)


class _HandedPyramid(PyramidWithProposals):
    def __init__(self, run: RunNetwork, out_channels: int) -> None:
        super().__init__(out_channels)
        self._run = run

    def forward(self, images: Tensor) -> OrderedDict[str, Tensor]:
        out = _computed(self._run, images)
        features, scores, offsets = (
            out[i : i + EXPORT_SHAPE.pyramid_levels]
            for i in range(0, 3 * EXPORT_SHAPE.pyramid_levels, EXPORT_SHAPE.pyramid_levels)
        )
        self.proposals = (scores, offsets)
        # In memory the channels stay last, as the pooling of regions needs them.
        maps = [feature_map.permute(0, 3, 1, 2) for feature_map in features]
        return OrderedDict(zip(("0", "1", "2", "3", "pool"), maps, strict=True))


class _HandedBoxHead(nn.Module):
    def __init__(self, run: RunNetwork) -> None:
        super().__init__()
        self._run = run

    def forward(self, regions: Tensor) -> tuple[Tensor, Tensor]:
        classes, offsets = _computed(self._run, regions.permute(0, 2, 3, 1))
        return classes, offsets


class _HandedKeypointHead(nn.Module):
    def __init__(self, run: RunNetwork) -> None:
        super().__init__()
        self._run = run

    def forward(self, regions: Tensor) -> Tensor:
        return _computed(self._run, regions.permute(0, 2, 3, 1))[0]


class _Upsampled(nn.Module):
    """Bilinear enlargement of heat maps, as torchvision's predictor does it; a product of matrices is faster."""

    def forward(self, maps: Tensor) -> Tensor:
        down, across = (_enlargement(cells) for cells in maps.shape[2:])
        return down @ maps @ across.T


@cache
def _enlargement(cells: int) -> Tensor:
    """Return the (2 * cells, cells) matrix that enlarges an axis of a heat map."""
    unit = torch.eye(cells)[None]
    size = EXPORT_SHAPE.keypoint_factor * cells
    return nn.functional.interpolate(unit, size=size, mode="linear", align_corners=False)[0].T.contiguous()


def _computed(run: RunNetwork, x: Tensor) -> list[Tensor]:
    if not len(x):  # Runtimes reject empty inputs: a single input gives the shapes of the outputs.
        return [out[:0] for out in _computed(run, x.new_zeros(1, *x.shape[1:]))]
    return [torch.from_numpy(array) for array in run(x.contiguous().numpy())]
