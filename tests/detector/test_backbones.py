"""Detectors with other backbones and widths than torchvision's: built, saved, multiplied otherwise, all the same."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import nn
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.ops import FrozenBatchNorm2d

from skope.detector import int8_ranges
from skope.detector.backbones import multiply_in, with_pyramid
from skope.detector.backends import bfloat16, prepare
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import checkpoint_bytes, load_weights, save_weights
from skope.detector.detect import detect_on_boxes
from skope.errors import UserError
from skope.terminal.console import Console
from skope.train.export import export
from skope.train.fold_batchnorm import fold_norms
from tests.detector.test_detector import SMALL, edited_header, use_uneven_statistics

LIGHT = ("resnet18", "mobilenet_v3_large")
NORMS = {"resnet18": 20, "mobilenet_v3_large": 46}
"""Convolutions with a norm in torchvision's models, but for what only classifies."""
NARROW = {"pyramid_width": 16, "keypoint_layers": 2, "keypoint_width": 24, "box_width": 32}
PIXELS = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
IMAGE = (255 * PIXELS[0].permute(1, 2, 0)).byte().numpy()
BOXES = [[5, 5, 60, 50], [30, 10, 90, 60]]


def config(backbone: str, norm: str = "frozen", **widths: int) -> DetectorConfig:
    return DetectorConfig(norm=norm, norm_eps=1e-3, **SMALL, backbone=backbone, **{**NARROW, **widths})


def network(backbone: str, norm: str = "frozen", trainable_layers: int = 5) -> KeypointRCNN:
    torch.manual_seed(0)
    model = build(config(backbone, norm), trainable_layers=trainable_layers).eval()
    use_uneven_statistics(model)
    return model


def maps(model: KeypointRCNN) -> dict[str, torch.Tensor]:
    with torch.inference_mode():
        found: dict[str, torch.Tensor] = model.backbone(PIXELS)
    return found


def logits(model: KeypointRCNN) -> np.ndarray[Any, Any]:
    p = detect_on_boxes(model, IMAGE, BOXES, "cpu")[..., 2]
    return np.log(p / (1 - p))


def test_a_resnet50_is_torchvisions_own_draw_by_draw() -> None:
    drawn = []
    for make in (
        lambda: with_pyramid("resnet50", 256, norm_layer=FrozenBatchNorm2d, trainable_stages=3),
        lambda: resnet_fpn_backbone(backbone_name="resnet50", weights=None, trainable_layers=3),
    ):
        torch.manual_seed(3)
        drawn.append((make(), torch.rand(1)))
    (ours, after), (stock, stock_after) = drawn
    assert torch.equal(after, stock_after)
    assert str(ours) == str(stock)
    assert all(torch.equal(one, two) for one, two in zip(ours.parameters(), stock.parameters(), strict=True))
    learning = [{name for name, p in each.named_parameters() if p.requires_grad} for each in (ours, stock)]
    assert learning[0] == learning[1]


@pytest.mark.parametrize(
    ("backbone", "frozen"), [("resnet18", "layer1.1.conv2"), ("mobilenet_v3_large", "3.block.2.0")]
)
def test_light_backbones_have_maps_of_strides_4_to_64(backbone: str, frozen: str) -> None:
    model = network(backbone, trainable_layers=3)
    assert {name: tuple(one.shape) for name, one in maps(model).items()} == {
        "0": (1, 16, 16, 24),
        "1": (1, 16, 8, 12),
        "2": (1, 16, 4, 6),
        "3": (1, 16, 2, 3),
        "pool": (1, 16, 1, 2),
    }
    # The first two of five stages do not learn: what is of strides 2 and 4.
    learning = [p.requires_grad for p in model.backbone.body.parameters()]
    assert learning == sorted(learning)
    names = [name for name, p in model.backbone.body.named_parameters() if not p.requires_grad]
    assert names[-1] == f"{frozen}.weight"
    assert all(p.requires_grad for p in build(config(backbone, "batch"), trainable_layers=3).parameters())


def test_a_config_names_what_is_not_torchvisions() -> None:
    stock = DetectorConfig(norm="frozen", norm_eps=1e-3, **SMALL)
    assert stock.stock
    assert stock.architecture == "ResNet50-FPN"
    assert not {"backbone", *NARROW} & stock.to_dict().keys()
    own = config("resnet18")
    assert own.to_dict().items() >= {"backbone": "resnet18", **NARROW}.items()
    assert DetectorConfig.from_dict(json.loads(json.dumps(own.to_dict()))) == own
    said = "ResNet18-FPN of 16 channels, keypoint head of 2 x 24 channels, box head of 32"
    assert (own.architecture, own.stock) == (said, False)


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("backbone", "vgg16", "'vgg16' is not one of resnet50, resnet18, mobilenet_v3_large"),
        ("pyramid_width", 8, "expected a whole number from 16 to 512, got 8"),
        ("keypoint_layers", True, "expected a whole number, got True"),
        ("keypoint_width", 1e9, "expected a whole number, got 1000000000.0"),
        ("box_width", None, "expected a whole number, got nothing"),
    ],
)
def test_a_wrong_config_is_refused_by_field(field: str, value: object, expected: str, tmp_path: Path) -> None:
    own = config("mobilenet_v3_large")
    save_weights(tmp_path / "a.safetensors", network("mobilenet_v3_large"), own, {})
    wrong = edited_header(
        tmp_path / "a.safetensors", tmp_path / "b.safetensors", config={**own.to_dict(), field: value}
    )
    with pytest.raises(UserError, match=f"b.safetensors: config: {field}: {expected}"):
        load_weights(wrong, "cpu")
    other = edited_header(tmp_path / "a.safetensors", tmp_path / "c.safetensors", config=config("resnet18").to_dict())
    with pytest.raises(UserError, match=r"c.safetensors: lacks \d+ tensor"):
        load_weights(other, "cpu")


@pytest.mark.parametrize("backbone", LIGHT)
def test_a_checkpoint_loads_into_torchvisions_own_classes(
    backbone: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model, own = network(backbone, "batch"), config(backbone, "batch")
    path = tmp_path / "a.safetensors"
    save_weights(path, model, own, {})
    loaded, read, _ = load_weights(path, "cpu")
    assert read == own
    assert np.array_equal(logits(loaded), logits(model))
    export(path, "state_dict", tmp_path / "it's.pth", console=Console())
    names: dict[str, Any] = {}
    exec(capsys.readouterr().out, names)
    stock = names["model"]
    assert type(stock) is KeypointRCNN
    assert np.allclose(logits(stock), logits(model), atol=1e-3)
    stock.load_state_dict(load_file(path), strict=True)


@pytest.mark.parametrize("backbone", LIGHT)
def test_norms_fold_into_any_backbone(backbone: str) -> None:
    expected = maps(network(backbone))
    folded, given_up = network(backbone), network(backbone, "batch")
    names = list(folded.state_dict())
    assert fold_norms(folded.to(memory_format=torch.channels_last)) == NORMS[backbone]
    assert list(folded.state_dict()) == names
    multiply_in(given_up)
    assert not any(isinstance(module, FrozenBatchNorm2d | nn.BatchNorm2d) for module in given_up.modules())
    for model in (folded, given_up):
        for name, one in maps(model).items():
            torch.testing.assert_close(one, expected[name], rtol=1e-3, atol=1e-4 * float(expected[name].abs().max()))


def test_a_folded_mobilenet_learns_as_a_plain_one() -> None:
    """Its activations change what the convolutions answer in place, where the folded norm was."""
    gradients = []
    for fold in (False, True):
        model = network("mobilenet_v3_large", trainable_layers=3)
        if fold:
            fold_norms(model)
        sum(one.square().mean() for one in model.backbone(PIXELS).values()).backward()
        gradients.append({n: p.grad for n, p in model.backbone.named_parameters() if p.grad is not None})
    plain, folded = gradients
    assert plain.keys() == folded.keys()
    for name, gradient in plain.items():
        torch.testing.assert_close(folded[name], gradient, rtol=1e-2, atol=1e-3 * float(gradient.abs().max()))


@pytest.mark.parametrize("backbone", LIGHT)
def test_maps_in_bfloat16_are_much_the_same(backbone: str) -> None:
    model = network(backbone)
    expected = maps(model)
    bfloat16.convert(model)
    for name, one in maps(model).items():
        assert alike(one, expected[name]) > 0.99, name


def test_eight_bits_of_a_mobilenet_find_much_the_same(tmp_path: Path) -> None:
    """Weights that are packed, then layers whose products are taken in eight bits, those in groups too."""
    model, path = network("mobilenet_v3_large"), tmp_path / "a.safetensors"
    metadata, expected = ranges(model), logits(model)
    path.write_bytes(checkpoint_bytes(model, config("mobilenet_v3_large"), metadata, packed=True))
    assert path.stat().st_size < 1.2 * sum(p.numel() for p in model.parameters())
    packed, _, read = load_weights(path, "cpu")
    first, exact = (next(m for m in each.modules() if isinstance(m, nn.Conv2d)) for each in (packed, model))
    assert torch.equal(first.weight, exact.weight.half().float()), "the first convolution keeps 16 bits"
    assert alike(logits(packed), expected) > 0.999
    found = int8_ranges.read(packed, read)
    assert found is not None
    prepare.convert(packed, found)
    assert 0.95 < alike(logits(packed), expected) < 0.99999


def ranges(model: KeypointRCNN) -> dict[str, Any]:
    """A checkpoint's metadata with the ranges of a model's layers on the image."""
    model.roi_heads.score_thresh, model.roi_heads.detections_per_img = 0.0, 1
    with int8_ranges.noted(model) as seen, torch.inference_mode():
        model([PIXELS[0]])
    return int8_ranges.to_metadata(model, seen)


_BY_RUNTIMES = """
import sys
import torch
from skope.detector.backends.prepare import prepare
from skope.terminal.console import Console
from tests.detector.test_backbones import alike, logits, network, ranges
expected, quiet = logits(network(sys.argv[1])), Console(quiet=True)
for backend, precision in (("openvino", "float32"), ("openvino", "int8"), ("onnx", "float32")):
    model = network(sys.argv[1])
    prepare(model, ranges(model), torch.device("cpu"), backend=backend, precision=precision, console=quiet)
    assert alike(logits(model), expected) > (0.95 if precision == "int8" else 0.99999), (backend, precision)
"""


@pytest.mark.slow
@pytest.mark.parametrize("backbone", LIGHT)
def test_runtimes_compute_light_networks(backbone: str) -> None:
    # In a process of its own, as in test_backends.py.
    subprocess.run([sys.executable, "-c", _BY_RUNTIMES, backbone], check=True, cwd=Path(__file__).parents[2])


def alike(one: Any, two: Any) -> float:
    """Correlation of two arrays' values."""
    return float(np.corrcoef(np.ravel(one), np.ravel(two))[0, 1])
