"""The first weights: published ones, a stock file, a checkpoint, random; equality is that of outputs."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file
from torchvision.models.detection import KeypointRCNN, keypointrcnn_resnet50_fpn
from torchvision.models.detection._utils import overwrite_eps
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone

from skope import keypoints
from skope.detector import weights
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import checkpoint_bytes, full_state, load_weights, save_weights
from skope.errors import UserError
from skope.train import init_weights
from skope.train.recipe import SHIPPED_RECIPES, SMALL_SIZE
from tests.detector.test_detector import SMALL, body_outputs, use_uneven_statistics

COCO_FILE = "keypointrcnn_resnet50_fpn_coco-fc266e95.pth"


def initialise(init: str, norm: str = "given", **more: str) -> tuple[KeypointRCNN, DetectorConfig, str]:
    return init_weights.initialise(init, norm=norm, trainable_layers=3, seed=0, **SMALL, **more)


def stock_coco() -> KeypointRCNN:
    """torchvision's model with COCO's 17 keypoints, normalised as its published weights are."""
    torch.manual_seed(5)
    stock = KeypointRCNN(resnet_fpn_backbone(backbone_name="resnet50", weights=None), num_classes=2, num_keypoints=17)
    use_uneven_statistics(stock)
    overwrite_eps(stock, 0.0)
    return stock


def test_auto_takes_coco_weights_from_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    stock = stock_coco()
    path = tmp_path / "hub" / "checkpoints" / COCO_FILE
    path.parent.mkdir(parents=True)
    torch.save(stock.state_dict(), path)

    model, chosen, words = initialise("auto")
    assert (chosen.norm, chosen.norm_eps, words) == ("frozen", 0.0, "weights trained on COCO")
    assert torch.equal(body_outputs(model), body_outputs(stock))
    assert model.roi_heads.keypoint_predictor.kps_score_lowres.out_channels == keypoints.K
    assert not model.backbone.body.layer1[0].conv1.weight.requires_grad
    assert model.backbone.body.layer2[0].conv1.weight.requires_grad

    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(UserError, match=COCO_FILE):
        initialise("auto")


@pytest.mark.usefixtures("small_network")
def test_without_a_cache_auto_takes_the_weights_of_the_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(weights, "WEIGHTS_FOLDER", tmp_path)
    assert initialise("auto")[2] == "random weights"  # while there are none
    config = DetectorConfig(norm="frozen", norm_eps=1e-3, **SMALL)
    packed = checkpoint_bytes(build(config), config, {}, packed=True)
    weights.path(weights.DEFAULT_WEIGHTS).write_bytes(packed)
    (model, chosen, words), (named, _, _) = initialise("auto"), initialise("road33")
    own, _, _ = load_weights(weights.path(weights.DEFAULT_WEIGHTS), "cpu")
    assert chosen == config
    assert words == "weights `road33` of the package"
    assert torch.equal(body_outputs(model), body_outputs(own))
    assert torch.equal(body_outputs(named), body_outputs(own))
    _, chosen, words = initialise("auto", scheme=keypoints.PUBLISHED)  # whose keypoints are others
    assert (chosen.norm, words) == ("batch", "random weights")


def test_random_weights_are_fixed_by_the_seed() -> None:
    before = torch.get_rng_state()
    (one, chosen, words), (two, _, _) = initialise("random"), initialise("random")
    assert chosen.norm == "batch"
    assert words == "random weights"
    assert torch.equal(one.roi_heads.box_head.fc7.weight, two.roi_heads.box_head.fc7.weight)
    assert torch.equal(before, torch.get_rng_state())
    assert all(parameter.requires_grad for parameter in one.parameters())


def test_a_failed_download_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise OSError("no route to host")

    monkeypatch.setenv("TORCH_HOME", str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", fail)
    for init in ("coco", "imagenet"):
        with pytest.raises(UserError, match=f"--init {init}: cannot download .*no route to host"):
            initialise(init)


def test_a_stock_file_fine_tunes_here(tmp_path: Path) -> None:
    """A file of torchvision's, as its reference scripts save it, keeps its outputs, 33 keypoints or COCO's 17."""
    stock = keypointrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_classes=2, num_keypoints=keypoints.K)
    use_uneven_statistics(stock)
    torch.save({"model": stock.state_dict(), "epoch": 3}, tmp_path / "a.pth")
    save_file(stock.state_dict(), tmp_path / "a.safetensors")
    for name in ("a.pth", "a.safetensors"):
        model, chosen, words = initialise(str(tmp_path / name))
        assert (chosen.norm, chosen.norm_eps) == ("batch", 1e-5)
        assert words == f"weights of {tmp_path / name}"
        assert torch.equal(body_outputs(model), body_outputs(stock))
        state = model.state_dict()
        assert all(torch.equal(tensor, state[key]) for key, tensor in stock.state_dict().items())
    frozen, chosen, _ = initialise(str(tmp_path / "a.pth"), norm="frozen")
    assert (chosen.norm, chosen.norm_eps) == ("frozen", 1e-5)
    torch.testing.assert_close(body_outputs(frozen), body_outputs(stock), rtol=1e-4, atol=1e-4)
    assert not frozen.backbone.body.conv1.weight.requires_grad

    coco = stock_coco()
    torch.save(coco.state_dict(), tmp_path / "b.pth")
    model, chosen, _ = initialise(str(tmp_path / "b.pth"))
    assert (chosen.norm, chosen.norm_eps) == ("frozen", 0.0)
    assert torch.equal(body_outputs(model), body_outputs(coco))
    assert model.roi_heads.keypoint_predictor.kps_score_lowres.out_channels == keypoints.K


def test_norm_and_eps_travel_with_a_checkpoint(tmp_path: Path) -> None:
    config = DetectorConfig(norm="frozen", norm_eps=1e-3, **SMALL)
    ours = build(config)
    use_uneven_statistics(ours)
    save_weights(tmp_path / "epoch_001.safetensors", ours, config, {})
    for init in (tmp_path, tmp_path / "epoch_001.safetensors"):
        model, chosen, _ = initialise(str(init))
        assert chosen == config
        assert torch.equal(body_outputs(model), body_outputs(ours))


def test_the_size_of_images_travels_with_a_checkpoint_unless_one_is_asked_for(tmp_path: Path) -> None:
    config = DetectorConfig(norm="frozen", norm_eps=1e-3, min_size=104, max_size=184)
    model = build(config)
    save_weights(tmp_path / "ours.safetensors", model, config, {})
    save_file(full_state(model), tmp_path / "stock.safetensors")

    def size(init: str, short: int | None, long: int | None) -> tuple[int, int]:
        _, chosen, _ = init_weights.initialise(
            init, norm="given", min_size=short, max_size=long, trainable_layers=3, seed=0
        )
        return chosen.min_size, chosen.max_size

    ours, stock = str(tmp_path / "ours.safetensors"), str(tmp_path / "stock.safetensors")
    assert (SHIPPED_RECIPES["laptop"].min_size, SHIPPED_RECIPES["laptop"].max_size) == (None, None)
    assert size(ours, None, None) == (104, 184)
    assert size(ours, 96, 160) == (96, 160)
    assert size(stock, None, None) == size("random", None, None) == SMALL_SIZE
    assert SHIPPED_RECIPES["laptop"].with_min_size(180).max_size == 320


def test_files_that_are_no_weights_are_one_line(tmp_path: Path) -> None:
    predictor = "roi_heads.keypoint_predictor.kps_score_lowres.weight"
    torch.save({predictor: torch.zeros(512, 24, 4, 4)}, tmp_path / "24.pth")
    torch.save({predictor: torch.zeros(512, 33, 4, 4)}, tmp_path / "part.pth")
    torch.save({"x": torch.zeros(1)}, tmp_path / "other.pth")
    torch.save({"x": 1}, tmp_path / "number.pth")
    torch.save(Path("/"), tmp_path / "object.pth")  # not unpickled
    (tmp_path / "junk.safetensors").write_bytes(b"junk")
    for name, words in [
        ("24.pth", "predicts 24 keypoints; expected 33, or COCO's 17"),
        ("part.pth", "not the weights of this model"),
        ("other.pth", "not the weights of a Keypoint R-CNN"),
        ("number.pth", "expected tensors by name"),
        ("object.pth", r"holds more than tensors \(pathlib\S*Path\).*torch.save\(checkpoint\[.model.\], NEW\)"),
        ("junk.safetensors", "not a safetensors file"),
        ("none.pth", "is neither a file nor one of auto, coco, imagenet, random"),
    ]:
        with pytest.raises(UserError, match=words) as caught:
            initialise(str(tmp_path / name))
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)
