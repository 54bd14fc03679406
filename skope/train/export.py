"""Other forms of a checkpoint: compact, which every command takes, and three for programs without skope.

`state_dict` is a file of tensors for torchvision's own Keypoint R-CNN, which `torchvision_code` builds. TorchScript and
ONNX take an `image` (3, H, W), float32 sRGB from 0 to 1, of any size, and answer, best first, in pixels of
that image: `boxes` (N, 4) xyxy, `scores` (N,) from 0 to 1, `keypoints` (N, 33, 2) x, y and `keypoint_scores` (N, 33)
from 0 to 1. Where the detector has learnt other categories than vehicles, `categories` (N,) follows, ids from 1 as in
`skope.schema.CATEGORIES`: of others than vehicles the keypoint scores are 0, and the keypoints mean nothing.
"""

import importlib.util
import io
import tempfile
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import torch
from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN

from skope import schema
from skope.dataset import image_selection
from skope.dataset.folder import open_dataset
from skope.detections import MIN_SCORE
from skope.detector import int8_ranges, weights
from skope.detector.checkpoint import checkpoint_bytes, find_checkpoint, full_state, load_weights
from skope.detector.device import choose_device
from skope.errors import UserError, one_of
from skope.files.output_folders import check_file, write_new
from skope.terminal.console import Console
from skope.train import input_moments
from skope.train.splits import SPLIT
from skope.train.torchvision_code import torchvision_code

EXPORT_SUFFIXES: Final = {
    "torchscript": ".torchscript.pt",
    "onnx": ".onnx",
    "compact": ".compact.safetensors",
    "state_dict": ".pth",
}
_BEGINS: Final[dict[str, Callable[[bytes], bool]]] = {
    "torchscript": lambda head: head.startswith(b"PK\x03\x04"),
    "onnx": lambda head: head.startswith(b"\x08"),
    "compact": lambda head: head[8:9] == b"{",
    "state_dict": lambda head: head.startswith(b"PK\x03\x04"),
}
"""Whether a file may be of a format, by its first bytes: a zip archive; the field ir_version; the header's length, then
the header."""
CALIBRATION_IMAGES: Final = 64
"""Of a dataset, that tell what the layers' inputs are."""
OUTPUTS: Final = ("boxes", "scores", "keypoints", "keypoint_scores")
CATEGORIES_OUTPUT: Final = "categories"

_OPSET: Final = 17
_TRACED_SIZE: Final = (360, 640)
"""Height and width of the image that ONNX export follows through the network; the written model takes any size."""


class Deployed(nn.Module):
    """A detector of one image whose answer is a tuple of tensors, `OUTPUTS`."""

    def __init__(self, model: KeypointRCNN) -> None:
        super().__init__()
        self.model = model

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Detect in one (3, H, W) image; returns `OUTPUTS`."""
        return _in_order(self.model([image])[0])


class _Scripted(Deployed):
    """`Deployed` around a scripted model, which answers with its losses too."""

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        return _in_order(self.model([image])[1][0])


class DeployedCategories(nn.Module):
    """A detector of one image and several categories, whose answer is `OUTPUTS` and `CATEGORIES_OUTPUT`."""

    ids: Tensor
    """Id of the category of each of the network's labels."""

    def __init__(self, model: KeypointRCNN, categories: Sequence[str]) -> None:
        super().__init__()
        self.model = model
        ids = [0, *(1 + schema.CATEGORIES.index(name) for name in categories)]
        self.register_buffer("ids", torch.tensor(ids), persistent=False)

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Detect in one (3, H, W) image; returns `OUTPUTS` and `CATEGORIES_OUTPUT`."""
        return _with_categories(self.model([image])[0], self.ids)


class _ScriptedCategories(DeployedCategories):
    """`DeployedCategories` around a scripted model, which answers with its losses too."""

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        return _with_categories(self.model([image])[1][0], self.ids)


def _with_categories(found: dict[str, Tensor], ids: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """`OUTPUTS` and `CATEGORIES_OUTPUT`, where `ids` are the categories of the network's labels."""
    boxes, scores, points, sure = _in_order(found)
    vehicles = (found["labels"] == 1).to(sure.dtype)
    return boxes, scores, points, sure * vehicles[:, None], ids[found["labels"]]


def _in_order(found: dict[str, Tensor]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    return found["boxes"], found["scores"], found["keypoints"][:, :, :2], found["keypoints_scores"].sigmoid()


def export(checkpoint: Path, to: str, out: Path | None, *, data: Path | None = None, console: Console) -> Path:
    """Write a checkpoint in another form.

    Args:
        checkpoint: A file or a run folder.
        to: One of `EXPORT_SUFFIXES`.
        out: The file; None: beside the checkpoint.
        data: A dataset, whose training images tell what the layers' inputs are: a compact file's weights are rounded so
            that the layers' outputs change least, and the file says how large the inputs are, as eight bits need it.
        console: Says what is done.

    Returns:
        The file.

    Raises:
        UserError: The checkpoint or the dataset cannot be read, or something else is in the file's place.
    """
    one_of("--to", to, tuple(EXPORT_SUFFIXES))
    if data and to != "compact":
        raise UserError("--data is for --to compact")
    if to == "onnx" and importlib.util.find_spec("onnx") is None:
        raise UserError("--to onnx: needs the package onnx: pip install 'skope[onnx]'")
    path = find_checkpoint(checkpoint)
    folder = Path() if weights.shipped(path) else path.parent
    out = out or folder / (path.name.removesuffix(path.suffix) + EXPORT_SUFFIXES[to])
    check_file(out, _BEGINS[to])
    model, config, metadata = load_weights(path, "cpu")
    if to == "compact":
        # As in torchvision, trained weights come with frozen normalisation: the next training's batches may be small.
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
    """Second moments of the layers' inputs on some of a dataset's training images, where a GPU is there on it."""
    opened = open_dataset(data)
    images = image_selection.take(opened.read(SPLIT), CALIBRATION_IMAGES).images
    pixels = map(opened.image, images)
    seen = console.bar(pixels, total=len(images), unit="image", label="layers' inputs")
    return input_moments.gather(model.to(choose_device("auto")), seen, categories)


def _pickled(state: Mapping[str, Tensor]) -> bytes:
    # Through memory: where there is no room for a file, torch's own writer ends the process.
    buffer = io.BytesIO()
    torch.save(state, buffer)
    return buffer.getvalue()


def _torchscript(model: KeypointRCNN, categories: Sequence[str]) -> bytes:
    # Through memory: where there is no room for a file, torch's own writer ends the process.
    buffer = io.BytesIO()
    deployed = _Scripted(model) if len(categories) == 1 else _ScriptedCategories(model, categories)
    torch.jit.save(torch.jit.script(deployed.eval()), buffer)
    return buffer.getvalue()


def _onnx(model: KeypointRCNN, categories: Sequence[str]) -> bytes:
    alone = len(categories) == 1
    deployed = Deployed(model) if alone else DeployedCategories(model, categories)
    outputs = OUTPUTS if alone else (*OUTPUTS, CATEGORIES_OUTPUT)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.onnx"
        _to_onnx(deployed.eval(), outputs, path)
        return path.read_bytes()


def _to_onnx(deployed: nn.Module, outputs: Sequence[str], path: Path) -> None:
    image = torch.rand(3, *_TRACED_SIZE, generator=torch.Generator().manual_seed(0))
    torch.onnx.export(
        deployed,
        (image,),
        str(path),
        dynamo=False,
        opset_version=_OPSET,
        input_names=["image"],
        output_names=list(outputs),
        dynamic_axes={"image": {1: "height", 2: "width"}, **{name: {0: "found"} for name in outputs}},
    )
