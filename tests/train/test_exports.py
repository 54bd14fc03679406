"""A trained detector in other forms: exported it answers alike."""

import importlib.util
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file
from torchvision.models.detection import KeypointRCNN

from skope.dataset.folder import read_image
from skope.detector.backbones import BACKBONE_CHOICES
from skope.detector.build import DetectorConfig, KeypointNetwork, build
from skope.detector.checkpoint import load_weights, read_checkpoint, save_weights
from skope.detector.network_settings import MIN_SCORE
from skope.errors import UserError
from skope.terminal.console import Console
from skope.train.export import OUTPUT_NAMES, Deployed, export
from tests import samples
from tests.train.test_loop import train
from tests.train.test_overfits import BY_HEART, scores_on_its_images

pytestmark = pytest.mark.usefixtures("small_detectors")


@pytest.fixture(scope="module")
def learnt(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """A dataset of one image, and a detector that has seen it often."""
    folder = tmp_path_factory.mktemp("learnt")
    data = samples.make_dataset(folder / "data", images=1, splits=("train",))
    # Longer than the whole network, from more regions and with wider box heads than other small ones: else the
    # processor's rounding decides how well it learns (0.45 to 1 of the points; so 0.94 to 1, by seed and processor).
    return data, train(data, folder / "run", replace(BY_HEART, epochs=50, learning_rate=0.02, keypoint_regions=16))


def test_overfits_one_image_from_random_weights(learnt: tuple[Path, Path]) -> None:
    """Targets, network and decoded coordinates agree from end to end."""
    (score,) = scores_on_its_images(*learnt)
    assert score > 0.9


def images(data: Path) -> list[torch.Tensor]:
    """The image that is known, and the same inside larger ones."""
    known = read_image(next((data / "images").rglob("*.png")))
    wider = [
        np.pad(known, ((0, down), (0, right), (0, 0)), mode="reflect") for down, right in ((0, 0), (10, 60), (50, 0))
    ]
    return [torch.as_tensor(pixels).permute(2, 0, 1).float() / 255 for pixels in wider]


Answer = tuple[torch.Tensor, ...]


@pytest.fixture(scope="module")
def expected(learnt: tuple[Path, Path]) -> list[Answer]:
    """What the detector itself answers for each of the `images`."""
    data, checkpoint = learnt
    model, _, _ = load_weights(checkpoint, "cpu")
    model.roi_heads.score_thresh = MIN_SCORE
    with torch.inference_mode():
        return [Deployed(model).eval()(image) for image in images(data)]


def check(answers: list[Answer], expected: list[Answer]) -> None:
    """What is surely found is the same to 0.1 px and a thousandth."""
    compared = 0
    for own, answer in zip(expected, answers, strict=True):
        sure = int((own[1] > 0.5).sum())
        compared += sure
        for name, one, other in zip(OUTPUT_NAMES, own, answer, strict=True):
            assert other.shape[1:] == one.shape[1:], name
            limit = 1e-3 if "score" in name else 0.1
            assert torch.allclose(one[:sure], other[:sure], rtol=0, atol=limit), name
    assert compared >= 3


def test_torchscript(learnt: tuple[Path, Path], expected: list[Answer]) -> None:
    data, checkpoint = learnt
    path = export(checkpoint.parent, "torchscript", None, console=Console(quiet=True))
    assert path == checkpoint.with_suffix(".torchscript.pt")
    model = torch.jit.load(str(path))  # type: ignore[no-untyped-call]
    with torch.inference_mode():
        check([model(image) for image in images(data)], expected)


def test_compact_weights_are_rounded_for_a_dataset(
    learnt: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data, checkpoint = learnt
    name = "backbone.body.layer4.1.conv2.weight"
    seen = []

    def gather(
        model: KeypointRCNN, images: Iterable[NDArray[np.uint8]], categories: Sequence[str]
    ) -> dict[str, torch.Tensor]:
        assert categories == ("vehicle",)
        seen.extend(images)
        size = model.state_dict()[name].flatten(1).shape[1]
        return {name: torch.full((size, size), 0.5) + torch.eye(size)}

    monkeypatch.setattr("skope.train.export.gather", gather)
    path = tmp_path / "rounded.safetensors"
    export(checkpoint, "compact", path, data=data, console=Console(quiet=True))
    (image,) = seen
    assert np.array_equal(image, read_image(next((data / "images").rglob("*.png"))))
    full, rounded = (read_checkpoint(one)[1][name].flatten(1) for one in (checkpoint, path))
    steps = load_file(path)[f"{name}.steps"][:, None]
    nearest = (full / steps).round() * steps
    # Inputs that all move together: the sum of the weights is what counts.
    errors = [(weights - full).sum(1).abs().mean() for weights in (rounded, nearest)]
    assert errors[0] < 0.2 * errors[1]


def test_state_dict(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The lines that are printed build torchvision's own model, whose detections are the same."""
    monkeypatch.setattr("skope.detector.backbones.BACKBONE_CHOICES", BACKBONE_CHOICES)  # of its own size
    monkeypatch.setattr("skope.detector.build.KeypointNetwork", KeypointNetwork)
    path = tmp_path / "other anchors.safetensors"
    anchors = (12, 24, 48, 96, 192)
    config = DetectorConfig(norm="frozen", norm_eps=1e-3, min_size=96, max_size=160, anchors=anchors)
    torch.manual_seed(1)
    save_weights(path, build(config), config, {})
    expected, _, _ = load_weights(path, "cpu")
    export(path, "state_dict", tmp_path / "it's.pth", console=Console())
    names: dict[str, Any] = {}
    exec(capsys.readouterr().out, names)
    assert type(names["model"]) is KeypointRCNN
    for model in (expected, names["model"]):
        model.roi_heads.score_thresh, model.roi_heads.detections_per_img = 0.0, 5
    image = torch.rand(3, 90, 140, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        (own,), (stock,) = expected([image]), names["model"]([image])
    assert len(own["boxes"]) == 5
    for name in ("boxes", "scores", "keypoints"):
        torch.testing.assert_close(stock[name], own[name], rtol=1e-4, atol=1e-3)


@pytest.mark.skipif(importlib.util.find_spec("onnx") is None, reason="needs the extra `onnx`")
def test_onnx(learnt: tuple[Path, Path], expected: list[Answer], tmp_path: Path) -> None:
    data, checkpoint = learnt
    runtime = pytest.importorskip("onnxruntime")
    path = export(checkpoint, "onnx", tmp_path / "model.onnx", console=Console(quiet=True))
    session = runtime.InferenceSession(str(path))
    assert [output.name for output in session.get_outputs()] == list(OUTPUT_NAMES)
    answers = [session.run(None, {"image": image.numpy()}) for image in images(data)]
    check([tuple(map(torch.as_tensor, answer)) for answer in answers], expected)


def test_mistakes_in_an_export_are_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(UserError, match="--to: 'coreml' is not one of torchscript, onnx"):
        export(tmp_path, "coreml", None, console=Console(quiet=True))
    with pytest.raises(UserError, match="--data is for --to compact"):
        export(tmp_path, "onnx", None, data=tmp_path, console=Console(quiet=True))
    with pytest.raises(UserError, match="no checkpoint in this folder"):
        export(tmp_path, "torchscript", None, console=Console(quiet=True))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match="--to onnx: needs the package onnx"):
        export(tmp_path, "onnx", None, console=Console(quiet=True))
