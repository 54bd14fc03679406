"""Export checkpoints to a compact format for skope, and to three formats for programs without skope.

`state_dict` is a file of tensors for torchvision's own Keypoint R-CNN, which `torchvision_code` builds. TorchScript and
ONNX take an `image` (3, H, W), float32 sRGB from 0 to 1, of any size. They return, best first and in pixels of that
image: `boxes` (N, 4) xyxy, `scores` (N,) from 0 to 1, `keypoints` (N, 33, 2) x, y and `keypoint_scores` (N, 33) from 0
to 1. If the detector has other categories than vehicles, `categories` (N,) follows, ids from 1 as in
`skope.schema.CATEGORY_NAMES`. Keypoints of other categories than vehicles are (0, 0) with score 0, as in COCO.

Rounding to compact weights uses second moments of the layers' inputs, gathered from images.
"""

import importlib.util
import io
import tempfile
import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN

from skope import keypoints, schema
from skope.dataset import image_selection
from skope.dataset.folder import open_dataset
from skope.detector import int8_ranges, weights
from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.build import NETWORK_DEFAULTS, DetectorConfig
from skope.detector.checkpoint import checkpoint_bytes, find_checkpoint, full_state, load_weights
from skope.detector.detect import detect
from skope.detector.device import choose_device
from skope.detector.network_settings import MIN_SCORE
from skope.errors import UserError, one_of
from skope.files.output_folders import check_file, write_new
from skope.schema import VEHICLE_ALONE
from skope.terminal.console import Console
from skope.train.splits import TRAINING_SPLIT


def torchvision_code(path: Path, config: DetectorConfig) -> str:
    """Return Python code that builds torchvision's own model as `model` and loads an exported state dict into it.

    The anchors are not part of the state dict: a strict load also succeeds with different anchors, but the detections
    are then wrong.
    """
    labels = "" if len(config.categories) == 1 else f"  # labels 1 to {len(config.categories)}: "
    labels += ", ".join(config.categories) if labels else ""
    sizes = ", ".join(f"({side},)" for side in config.anchors)
    imports, heads = _heads(config)
    kind = BACKBONE_CHOICES[config.backbone]
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
anchors = AnchorGenerator(({sizes}), ({NETWORK_DEFAULTS.aspects},) * {len(config.anchors)})
model = KeypointRCNN(
    backbone, {heads}, rpn_anchor_generator=anchors,
    min_size={config.min_size}, max_size={config.max_size}, box_detections_per_img={NETWORK_DEFAULTS.max_detections},
    rpn_post_nms_top_n_test={NETWORK_DEFAULTS.proposals})
model.load_state_dict(torch.load({str(path)!r}))
model.eval(){labels}"""


def _heads(config: DetectorConfig) -> tuple[str, str]:
    """Return lines of imports, and the arguments of `KeypointRCNN` for the heads."""
    classes = 1 + len(config.categories)
    if config.heads == NETWORK_DEFAULTS.heads:
        return "", f"num_classes={classes}, num_keypoints={keypoints.K}"
    imports = """\
from torchvision.models.detection.faster_rcnn import FastRCNNPredictor, TwoMLPHead
from torchvision.models.detection.keypoint_rcnn import KeypointRCNNHeads, KeypointRCNNPredictor
"""
    layers, width, box_width = config.heads
    return imports, (
        f"box_head=TwoMLPHead({config.pyramid_width * NETWORK_DEFAULTS.box_cells**2}, {box_width}),\n"
        f"    box_predictor=FastRCNNPredictor({box_width}, {classes}),\n"
        f"    keypoint_head=KeypointRCNNHeads({config.pyramid_width}, ({width},) * {layers}),\n"
        f"    keypoint_predictor=KeypointRCNNPredictor({width}, {keypoints.K})"
    )


@dataclass(frozen=True)
class ExportSampling:
    """Samples for rounding, and the traced image."""

    per_call: int = 256
    """Number of positions, or regions, from each call of a layer."""
    images: int = 64
    """Number of images of a dataset that provide the layers' inputs."""
    opset: int = 17
    """Version of ONNX's operators."""
    traced_size: tuple[int, int] = (360, 640)
    """Height and width of the traced image. The exported model takes any size."""


EXPORT_SAMPLING: Final = ExportSampling()


def gather(
    model: KeypointRCNN, images: Iterable[NDArray[np.uint8]], categories: Sequence[str] = VEHICLE_ALONE
) -> dict[str, Tensor]:
    """Measure second moments of the inputs of all convolutions and linear layers, by the names of their weights.

    Args:
        model: In evaluation mode, on the CPU or a GPU.
        images: (H, W, 3) RGB, dozens of typical images.
        categories: Names of the network's labels; only vehicles go through the keypoint head.

    Returns:
        Weight's name -> (N, N) float32 mean of x x^T, where N is the number of weights of an output channel and x lie
        in the order of `weight.flatten(1)`. Layers that no image reached and grouped convolutions are omitted.
    """
    layers = {name: module for name, module in model.named_modules() if _has_moments(module)}
    sums: dict[str, Tensor] = {}
    counts = dict.fromkeys(layers, 0)
    generator = torch.Generator().manual_seed(0)

    def add(name: str, module: nn.Module, inputs: tuple[Tensor, ...]) -> None:
        x = _sample(module, inputs[0].float(), generator)
        counts[name] += len(x)
        sums[name] = sums[name].addmm_(x.T, x) if name in sums else x.T @ x

    hooks = [module.register_forward_pre_hook(partial(add, name)) for name, module in layers.items()]
    device = next(model.parameters()).device
    try:
        for pixels in images:
            detect(model, [pixels], device, categories=categories)
    finally:
        for hook in hooks:
            hook.remove()
    return {f"{name}.weight": total / counts[name] for name, total in sums.items() if counts[name]}


def _has_moments(module: nn.Module) -> bool:
    return isinstance(module, nn.Linear) or (isinstance(module, nn.Conv2d) and module.groups == 1)


def _sample(module: nn.Module, x: Tensor, generator: torch.Generator) -> Tensor:
    """Return (M, N) inputs of some of the layer's outputs."""
    if not isinstance(module, nn.Conv2d):
        return x[_some(len(x), generator).to(x.device)]
    height, width = module.kernel_size
    stride, pad = module.stride[0], int(module.padding[0])
    across = (x.shape[3] + 2 * pad - width) // stride + 1
    down = (x.shape[2] + 2 * pad - height) // stride + 1
    chosen = _some(len(x) * down * across, generator).to(x.device)
    image, at = chosen // (down * across), chosen % (down * across)
    top, left = at // across * stride, at % across * stride
    padded = nn.functional.pad(x, (pad,) * 4)
    parts = [padded[image, :, top + i, left + j] for i in range(height) for j in range(width)]
    return torch.stack(parts, dim=2).flatten(1)


def _some(count: int, generator: torch.Generator) -> Tensor:
    if count <= EXPORT_SAMPLING.per_call:
        return torch.arange(count)
    return torch.randint(count, (EXPORT_SAMPLING.per_call,), generator=generator)


EXPORT_SUFFIXES: Final = {
    "torchscript": ".torchscript.pt",
    "onnx": ".onnx",
    "compact": ".compact.safetensors",
    "state_dict": ".pth",
}
FORMAT_MARKS: Final[dict[str, Callable[[bytes], bool]]] = {
    "torchscript": lambda head: head.startswith(b"PK\x03\x04"),
    "onnx": lambda head: head.startswith(b"\x08"),
    "compact": lambda head: head[8:9] == b"{",
    "state_dict": lambda head: head.startswith(b"PK\x03\x04"),
}
"""Return whether a file may have a format, by its first bytes: zip archive; field ir_version; length and header."""
OUTPUT_NAMES: Final = ("boxes", "scores", "keypoints", "keypoint_scores")
CATEGORIES_OUTPUT: Final = "categories"


class Deployed(nn.Module):
    """Detector for one image that returns a tuple of tensors, `OUTPUT_NAMES`."""

    def __init__(self, model: KeypointRCNN) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Detect in one (3, H, W) image; return `OUTPUT_NAMES`."""
        return _in_order(self.model([image])[0])


class _Scripted(Deployed):
    """`Deployed` around a scripted model, which also returns its losses."""

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _in_order(self.model([image])[1][0])


class DeployedCategories(nn.Module):
    """Detector for one image and several categories that returns `OUTPUT_NAMES` and `CATEGORIES_OUTPUT`."""

    ids: Tensor
    """Category id of each label of the network."""

    def __init__(self, model: KeypointRCNN, categories: Sequence[str]) -> None:
        super().__init__()
        self.model = model
        ids = [0, *(1 + schema.CATEGORY_NAMES.index(name) for name in categories)]
        self.register_buffer("ids", torch.tensor(ids), persistent=False)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Detect in one (3, H, W) image; return `OUTPUT_NAMES` and `CATEGORIES_OUTPUT`."""
        return _with_categories(self.model([image])[0], self.ids)


class _ScriptedCategories(DeployedCategories):
    """`DeployedCategories` around a scripted model, which also returns its losses."""

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return _with_categories(self.model([image])[1][0], self.ids)


def _with_categories(found: dict[str, Tensor], ids: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return `OUTPUT_NAMES` and `CATEGORIES_OUTPUT`; `ids` are the category ids of the network's labels."""
    boxes, scores, points, sure = _in_order(found)
    vehicles = (found["labels"] == 1).to(sure.dtype)[:, None]
    return boxes, scores, points * vehicles[:, :, None], sure * vehicles, ids[found["labels"]]


def _in_order(found: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return found["boxes"], found["scores"], found["keypoints"][:, :, :2], found["keypoints_scores"].sigmoid()


def export(checkpoint: Path, to: str, out: Path | None, *, data: Path | None = None, console: Console) -> Path:
    """Export a checkpoint to another format.

    Args:
        checkpoint: A file or a run folder.
        to: One of `EXPORT_SUFFIXES`.
        out: The file; None for a file beside the checkpoint.
        data: A dataset. Its training images give the inputs of the layers: the weights of a compact file are rounded so
            that the outputs of the layers change least, and the file has the input ranges for int8.
        console: Receives messages.

    Returns:
        The file.

    Raises:
        UserError: The checkpoint or the dataset cannot be read, or the output path exists with other content.
    """
    one_of("--to", to, tuple(EXPORT_SUFFIXES))
    if data and to != "compact":
        raise UserError("--data is for --to compact")
    if to == "onnx" and importlib.util.find_spec("onnx") is None:
        raise UserError("--to onnx: needs the package onnx: pip install 'skope[onnx]'")
    path = find_checkpoint(checkpoint)
    folder = Path() if weights.shipped(path) else path.parent
    out = out or folder / (path.name.removesuffix(path.suffix) + EXPORT_SUFFIXES[to])
    check_file(out, FORMAT_MARKS[to])
    model, config, metadata = load_weights(path, "cpu")
    if to == "compact":
        # As in torchvision, trained weights get frozen normalisation, because batches of the next training may be
        # small.
        frozen = replace(config, norm="frozen")
        moments = None
        if data:
            with int8_ranges.noted(model) as ranges:
                moments = _moments(model, data, config.categories, console)
            metadata = {**metadata, **int8_ranges.to_metadata(model, ranges)}
        write_new(out, checkpoint_bytes(model, frozen, metadata, packed=True, moments=moments))
        return out
    if config.box_passes > 1:
        console.say(f"{path}: without skope its box head looks once, not {config.box_passes} times: looser boxes")
    if to == "state_dict":
        write_new(out, _pickled(full_state(model)))
        console.say(torchvision_code(out, config))
        return out
    model.roi_heads.score_thresh = MIN_SCORE
    console.say(f"{path}: short side {config.min_size}, long side at most {config.max_size} px")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about tracing and the old exporter; tests compare the results
        write_new(out, (_torchscript if to == "torchscript" else _onnx)(model, config.categories))
    return out


def _moments(model: KeypointRCNN, data: Path, categories: Sequence[str], console: Console) -> dict[str, Tensor]:
    """Return second moments of the layers' inputs on some training images of a dataset, on a GPU if there is one."""
    opened = open_dataset(data)
    images = image_selection.take(opened.read(TRAINING_SPLIT), EXPORT_SAMPLING.images).images
    pixels = map(opened.image, images)
    seen = console.bar(pixels, total=len(images), unit="image", label="layers' inputs")
    return gather(model.to(choose_device("auto")), seen, categories)


def _pickled(state: Mapping[str, Tensor]) -> bytes:
    # Through memory, because torch's own writer ends the process if the disk is full.
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def _torchscript(model: KeypointRCNN, categories: Sequence[str]) -> bytes:
    # Through memory, because torch's own writer ends the process if the disk is full.
    buffer = io.BytesIO()
    deployed = _Scripted(model) if len(categories) == 1 else _ScriptedCategories(model, categories)
    torch.jit.save(torch.jit.script(deployed.eval()), buffer)
    return buffer.getvalue()


def _onnx(model: KeypointRCNN, categories: Sequence[str]) -> bytes:
    alone = len(categories) == 1
    deployed = Deployed(model) if alone else DeployedCategories(model, categories)
    outputs = OUTPUT_NAMES if alone else (*OUTPUT_NAMES, CATEGORIES_OUTPUT)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        _to_onnx(deployed.eval(), outputs, path)
        return path.read_bytes()


def _to_onnx(deployed: nn.Module, outputs: Sequence[str], path: Path) -> None:
    image = torch.rand(3, *EXPORT_SAMPLING.traced_size, generator=torch.Generator().manual_seed(0))
    torch.onnx.export(
        deployed,
        (image,),
        str(path),
        dynamo=False,
        opset_version=EXPORT_SAMPLING.opset,
        input_names=["image"],
        output_names=list(outputs),
        dynamic_axes={"image": {1: "height", 2: "width"}, **{name: {0: "found"} for name in outputs}},
    )
