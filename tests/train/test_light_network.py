"""Training with other backbones and widths than torchvision's: the first weights, a run, and going on from it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn
from torchvision.models import mobilenet_v3_large, resnet18
from typer.testing import CliRunner

from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import load_weights
from skope.errors import UserError
from skope.train import cli, export, init_weights
from skope.train.network_shape import NetworkShape
from tests import samples
from tests.detector.test_detector import SMALL

NARROW = NetworkShape(pyramid_width=16, keypoint_layers=1, keypoint_width=16, box_width=16)
FLAGS = [f"--set=network.{name}={value}" for name, value in NARROW.asked.items()]
MAKE = {"resnet18": resnet18, "mobilenet_v3_large": mobilenet_v3_large}


def initialise(init: str, backbone: str | None = None, **options: Any) -> tuple[nn.Module, DetectorConfig, str]:
    network = replace(NARROW, backbone=backbone)
    return init_weights.initialise(
        init, norm="given", trainable_layers=3, seed=0, **SMALL, **{"network": network, **options}
    )


@pytest.mark.parametrize("backbone", ["resnet18", "mobilenet_v3_large"])
def test_auto_takes_what_is_cached_of_imagenet_else_random_weights(
    backbone: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    _, chosen, words = initialise("auto", backbone)
    kind = BACKBONE_CHOICES[backbone]
    assert (chosen.backbone, chosen.norm, chosen.norm_eps, words) == (
        backbone,
        "batch",
        kind.norm_eps,
        "random weights",
    )
    file = tmp_path / "hub" / "checkpoints" / Path(kind.imagenet.url).name
    file.parent.mkdir(parents=True)
    torch.manual_seed(1)
    published = MAKE[backbone](weights=None)
    torch.save(published.state_dict(), file)
    for init in ("auto", "imagenet"):
        model, chosen, words = initialise(init, backbone)
        assert (chosen.norm, chosen.norm_eps, words) == ("frozen", kind.norm_eps, "a backbone trained on ImageNet")
        layers = published.get_submodule(kind.layers).state_dict()
        assert all(torch.equal(one, layers[name]) for name, one in model.backbone.body.state_dict().items())
        assert len({p.requires_grad for p in model.backbone.body.parameters()}) == 2


def test_weights_of_another_network_are_refused() -> None:
    for init in ("coco", "road33"):
        with pytest.raises(
            UserError, match=f"{init}.*: backbone: the recipe asks for resnet18, these .* have resnet50"
        ):
            initialise(init, "resnet18")
    with pytest.raises(UserError, match=r"road33.*: pyramid_width: the recipe asks for 16, these weights have 256"):
        initialise("road33")


def test_a_light_detector_is_trained_and_trained_on(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    flags = ["--data", str(data), "--device", "cpu", "--epochs", "1", "--recipe", "scratch", "--min-size", "64", *FLAGS]
    run = tmp_path / "run"
    done = CliRunner().invoke(cli.app, [*flags, "--backbone", "mobilenet_v3_large", "--out", str(run)])
    assert done.exit_code == 0, done.output
    said = "MobileNetV3-Large-FPN of 16 channels, keypoint head of 1 x 16 channels, box head of 16"
    assert f"network: {said}\n" in done.stdout
    assert f"torchvision's Keypoint R-CNN ({said}), one class" in (run / "README.md").read_text()
    model, config, _ = load_weights(run / "epoch_001.safetensors", "cpu")
    assert config.architecture == said
    resumed = CliRunner().invoke(cli.app, ["--out", str(run), "--resume", "--quiet", "--device", "cpu"])
    assert resumed.stdout.splitlines() == done.stdout.splitlines()[-1:]

    onwards, chosen, _ = initialise(str(run), network=NetworkShape())
    assert chosen.architecture == said
    assert torch.equal(onwards.backbone.body["0"][0].weight, model.backbone.body["0"][0].weight)
    other = CliRunner().invoke(
        cli.app, [*flags, "--init", str(run), "--backbone", "resnet18", "--out", str(tmp_path / "b")]
    )
    assert "backbone: the recipe asks for resnet18, these weights have mobilenet_v3_large" in str(other.exception)
    assert not (tmp_path / "b").exists()


def test_inputs_of_convolutions_in_groups_are_left_to_plain_rounding() -> None:
    torch.manual_seed(0)
    network = replace(NARROW, backbone="mobilenet_v3_large")
    model = build(DetectorConfig(norm="frozen", norm_eps=1e-3, **SMALL, **network.asked)).eval()
    model.roi_heads.score_thresh = 0.0
    moments = export.gather(model, [np.zeros((64, 96, 3), np.uint8)])
    sizes = {f"{n}.weight": m.weight[0].numel() for n, m in model.named_modules() if isinstance(m, nn.Conv2d)}
    grouped = {f"{n}.weight" for n, m in model.named_modules() if isinstance(m, nn.Conv2d) and m.groups > 1}
    assert len(grouped) == 15
    assert not grouped & moments.keys()
    assert all(moments[name].shape == (size, size) for name, size in sizes.items() if name in moments)
    assert "backbone.body.1.block.1.0.weight" in moments
