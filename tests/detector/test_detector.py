"""Building, initialising, saving, loading and running the detector."""

import functools
import json
import struct
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torchvision.models.detection import KeypointRCNN, keypointrcnn_resnet50_fpn
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.backbone_utils import resnet_fpn_backbone
from torchvision.models.detection.roi_heads import heatmaps_to_keypoints, keypoints_to_heatmap
from torchvision.ops import FrozenBatchNorm2d

from skope import keypoints
from skope.detector import weights
from skope.detector.build import NETWORK_DEFAULTS, DetectorConfig, box_passes_of, build
from skope.detector.checkpoint import checkpoint_name, find_checkpoint, load_weights, save_weights
from skope.detector.detect import detect, detect_on_boxes
from skope.detector.device import choose_device
from skope.errors import UserError
from tests.train.conftest import shrink

SMALL = {"min_size": 96, "max_size": 160}
BAD_ANCHORS = [{"anchors": value} for value in (7, [16, 32, 64, 128], [32, 16, 64, 128, 256], [2, 16, 32, 64, 1e2])]


def config(norm: str = "batch", eps: float = 1e-5) -> DetectorConfig:
    return DetectorConfig(norm=norm, norm_eps=eps, **SMALL)


def image(height: int = 96, width: int = 128) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


def body_outputs(model: torch.nn.Module) -> torch.Tensor:
    pixels = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        return model.eval().backbone(pixels)["0"]


def use_uneven_statistics(model: torch.nn.Module) -> None:
    """Statistics unlike 0 and 1, so that a lost one, or another eps, shows in the outputs."""
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for name, buffer in model.named_buffers():
            if name.endswith("running_var"):
                buffer.copy_(torch.rand(buffer.shape, generator=generator) * 2e-4 + 1e-5)
                buffer.mul_(2e4)
            if name.endswith("running_mean"):
                buffer.copy_(torch.randn(buffer.shape, generator=generator) * 0.1)


@pytest.fixture(scope="module")
def model() -> KeypointRCNN:
    torch.manual_seed(0)
    return build(config())


@pytest.fixture(scope="module")
def checkpoint(model: KeypointRCNN, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / checkpoint_name(3)
    save_weights(path, model, config(), {"epoch": 3})
    return path


@pytest.fixture(scope="module")
def small_model() -> KeypointRCNN:
    """A model of few weights, for what does not depend on how many they are."""
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        return build(config())


@pytest.fixture(scope="module")
def small_checkpoint(small_model: KeypointRCNN, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("small") / checkpoint_name(3)
    save_weights(path, small_model, config(), {"epoch": 3})
    return path


def test_a_checkpoint_loads_with_equal_outputs(model: KeypointRCNN, checkpoint: Path) -> None:
    loaded, loaded_config, metadata = load_weights(checkpoint, "cpu")
    assert (loaded_config, metadata) == (config(), {"epoch": 3})
    assert torch.equal(body_outputs(loaded), body_outputs(model))
    (ours,), (theirs,) = (detect(m, [image()], "cpu", min_score=0.0, max_detections=3) for m in (model, loaded))
    assert np.array_equal(ours.keypoints, theirs.keypoints)


@pytest.mark.parametrize(("norm", "eps"), [("batch", 1e-5), ("frozen", 1e-5), ("frozen", 0.0)])
def test_weights_load_strictly_into_stock_torchvision_and_back(norm: str, eps: float, tmp_path: Path) -> None:
    ours = build(config(norm, eps))
    use_uneven_statistics(ours)
    save_weights(tmp_path / "a.safetensors", ours, config(norm, eps), {})
    stock = keypointrcnn_resnet50_fpn(weights=None, weights_backbone=None, num_classes=2, num_keypoints=keypoints.K)
    stock.load_state_dict(load_file(tmp_path / "a.safetensors"), strict=True)
    if eps != 1e-5:
        for module in stock.modules():
            if isinstance(module, torch.nn.BatchNorm2d):
                module.eps = eps
    torch.testing.assert_close(body_outputs(stock), body_outputs(ours), rtol=1e-4, atol=1e-4)
    loaded, _, _ = load_weights(tmp_path / "a.safetensors", "cpu")
    assert torch.equal(body_outputs(loaded), body_outputs(ours))
    loaded.load_state_dict(stock.state_dict(), strict=True)
    assert torch.equal(body_outputs(loaded), body_outputs(ours))


def test_anchors_are_part_of_the_checkpoint(tmp_path: Path) -> None:
    """A strict load into a stock model succeeds with other anchors too, but what it finds then is another thing."""
    own = replace(config("frozen"), anchors=(8, 16, 40, 64, 96))
    torch.manual_seed(2)
    ours = build(own)
    path = tmp_path / "a.safetensors"
    save_weights(path, ours, own, {})
    loaded, chosen, _ = load_weights(path, "cpu")
    assert chosen == own
    generator = AnchorGenerator(((8,), (16,), (40,), (64,), (96,)), ((0.5, 1.0, 2.0),) * 5)
    pixels = [torch.rand(3, 96, 128, generator=torch.Generator().manual_seed(0))]
    found = {}
    for name, anchors in (("same", generator), ("torchvision's", None)):
        norm = functools.partial(FrozenBatchNorm2d, eps=1e-5)
        backbone = resnet_fpn_backbone(backbone_name="resnet50", weights=None, norm_layer=norm)
        sizes = {"min_size": 96, "max_size": 160, "box_score_thresh": 0.0, "box_detections_per_img": 8}
        sizes["rpn_post_nms_top_n_test"] = NETWORK_DEFAULTS.proposals
        stock = KeypointRCNN(backbone, 2, num_keypoints=33, rpn_anchor_generator=anchors, **sizes).eval()
        stock.load_state_dict(load_file(path), strict=True)
        with torch.inference_mode():
            found[name] = stock(pixels)[0]["boxes"]
    loaded.roi_heads.score_thresh, loaded.roi_heads.detections_per_img = 0.0, 8
    with torch.inference_mode():
        (here,) = loaded(pixels)
    assert len(here["boxes"]) == 8
    torch.testing.assert_close(here["boxes"], found["same"])
    assert not torch.equal(here["boxes"], found["torchvision's"])


def edited_header(path: Path, out: Path, **changes: Any) -> Path:
    """A copy of a checkpoint with other fields in skope's header."""
    data = path.read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8 : 8 + size])
    ours = {**json.loads(header["__metadata__"]["skope"]), **changes}
    header["__metadata__"]["skope"] = json.dumps(ours)
    encoded = json.dumps(header).encode()
    encoded += b" " * (-len(encoded) % 8)
    out.write_bytes(struct.pack("<Q", len(encoded)) + encoded + data[8 + size :])
    return out


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"num_keypoints": 17}, "num_keypoints: expected 33, got 17"),
        ({"scheme": "coco17"}, "scheme: 'coco17' is not one of skope33, skope3d"),
        ({"config": {"norm": "batch"}}, "scheme: None is not one of"),
        ({"config": {**config().to_dict(), "norm": "group"}}, "norm: 'group' is not one of"),
    ],
)
def test_a_checkpoint_of_something_else_is_refused(
    small_checkpoint: Path, tmp_path: Path, changes: dict[str, Any], words: str
) -> None:
    path = edited_header(small_checkpoint, tmp_path / "other.safetensors", **changes)
    with pytest.raises(UserError, match=words) as caught:
        load_weights(path, "cpu")
    assert str(path) in str(caught.value)


def test_files_that_are_no_checkpoint_are_refused(
    small_checkpoint: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shrink(monkeypatch)
    junk, short, foreign, partial = (tmp_path / f"{name}.safetensors" for name in ("junk", "short", "foreign", "part"))
    junk.write_bytes(b"not a checkpoint at all")
    short.write_bytes(small_checkpoint.read_bytes()[:-100])
    save_file({"x": torch.zeros(1)}, foreign)
    edited_header(small_checkpoint, partial)
    state = load_file(partial)
    header = {"version": 1, "scheme": keypoints.SCHEME, "num_keypoints": 33, "metadata": {}}
    state.pop("backbone.body.conv1.weight")
    save_file(state, partial, metadata={"skope": json.dumps({**header, "config": config().to_dict()})})
    for path, words in [
        (junk, "not a safetensors file"),
        (short, "truncated"),
        (foreign, "not a checkpoint of skope"),
        (partial, "lacks 1 tensor"),
        (tmp_path / "none.safetensors", "no such checkpoint"),
    ]:
        with pytest.raises(UserError, match=words) as caught:
            load_weights(path, "cpu")
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)


def test_the_newest_checkpoint_of_a_run_is_found(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no checkpoint"):
        find_checkpoint(tmp_path)
    (tmp_path / "best.safetensors").touch()
    assert find_checkpoint(tmp_path).name == "best.safetensors"
    for name in ("epoch_009.safetensors", "epoch_1000.safetensors", "epoch_010.safetensors", "epoch_x.safetensors"):
        (tmp_path / name).touch()
    assert find_checkpoint(tmp_path).name == "epoch_1000.safetensors"
    assert find_checkpoint(tmp_path / "epoch_009.safetensors").name == "epoch_009.safetensors"
    with pytest.raises(UserError, match="no such"):
        find_checkpoint(tmp_path / "other")


@pytest.mark.parametrize(
    "field", [{"norm": "x"}, {"norm_eps": -1.0}, {"min_size": 0}, {"max_size": 90}, {"box_passes": 3}, *BAD_ANCHORS]
)
def test_a_bad_config_names_its_field(field: dict[str, Any]) -> None:
    with pytest.raises(UserError, match=next(iter(field))):
        DetectorConfig.from_dict({**config().to_dict(), **field})


def test_devices() -> None:
    assert choose_device("cpu") == torch.device("cpu")
    for name in ("tpu", "cuda:99"):
        with pytest.raises(UserError, match="device"):
            choose_device(name)


def test_detection_restores_the_model(model: KeypointRCNN) -> None:
    model.train()
    before = model.roi_heads.score_thresh, model.roi_heads.detections_per_img
    (found,) = detect(model, [image()], "cpu", min_score=0.0, max_detections=4)
    assert found.boxes_xyxy.shape == (4, 4)
    assert found.keypoints.shape == (4, keypoints.K, 3)
    assert ((found.keypoints[..., 2] >= 0) & (found.keypoints[..., 2] <= 1)).all()
    assert model.training
    assert (model.roi_heads.score_thresh, model.roi_heads.detections_per_img) == before


class _PeakAt(torch.nn.Module):
    """In place of the keypoint predictor: heat maps that peak in one cell."""

    row = col = 0

    def forward(self, regions: torch.Tensor) -> torch.Tensor:
        maps = torch.full((len(regions), keypoints.K, 56, 56), -9.0)
        maps[:, :, self.row, self.col] = 2.0
        return maps


def test_keypoints_on_boxes_have_no_bias(model: KeypointRCNN, monkeypatch: pytest.MonkeyPatch) -> None:
    """The centre of heat-map cell (c, r) of a box lies (c + 0.5) / 56 along it, in pixels of the original image."""
    peak = _PeakAt()
    monkeypatch.setitem(model.roi_heads._modules, "keypoint_predictor", peak)
    boxes = np.array([[10.0, 20.0, 122.0, 188.0], [100.0, 40.0, 212.0, 152.0]])
    for row, col in [(0, 0), (28, 5), (55, 55)]:
        peak.row, peak.col = row, col
        # 96 of 192 pixels high: the network sees half the size, the boxes as 56 x 84 and 56 x 56 pixels.
        points = detect_on_boxes(model, image(192, 256), boxes, "cpu")
        share = (np.array([col, row]) + 0.5) / 56
        errors = points[..., :2] - (boxes[:, :2] + share * (boxes[:, 2:] - boxes[:, :2]))[:, None]
        assert np.abs(errors[1]).max() < 1e-3
        assert np.abs(errors[0, :, 0]).max() < 1e-3
        assert np.abs(errors[0, :, 1]).max() < 1e-3
        assert points.shape == (2, keypoints.K, 3)
        assert points[1, :, 2] == pytest.approx(1 / (1 + np.exp(-2.0)))
    assert detect_on_boxes(model, image(), np.zeros((0, 4)), "cpu").shape == (0, keypoints.K, 3)


class _ToTheRight(torch.nn.Module):
    """In place of the box predictor: every box lies a tenth of its width further to the right."""

    def forward(self, regions: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        logits = torch.stack([torch.zeros(len(regions)), regions.mean(dim=1)], dim=1)
        return logits, torch.tensor([1.0, 0, 0, 0]).repeat(len(regions), 2)


def test_a_second_look_begins_at_the_box_that_was_found(
    small_model: KeypointRCNN, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(small_model.roi_heads._modules, "box_predictor", _ToTheRight())
    once, twice = [], []
    for passes, found in ((1, once), (2, twice)):
        monkeypatch.setattr(small_model, "box_passes", passes)
        found += detect(small_model, [image(), image(80, 120)], "cpu", min_score=0.0, max_detections=20)
    assert all(len(one.boxes_xyxy) for one in once)
    for one, two, width in zip(once, twice, (128, 120), strict=True):
        moved = one.boxes_xyxy.copy()
        moved[:, [0, 2]] += 0.1 * (moved[:, 2] - moved[:, 0])[:, None]
        assert np.allclose(two.boxes_xyxy, moved.clip(max=[width, 999, width, 999]), atol=1e-4)
        assert np.array_equal(two.scores, one.scores)


def test_how_often_the_box_head_looks_is_part_of_the_config(monkeypatch: pytest.MonkeyPatch) -> None:
    assert "box_passes" not in config().to_dict(), "what is torchvision's own is left out"
    twice = replace(config(), box_passes=2)
    assert DetectorConfig.from_dict(twice.to_dict()) == twice
    shrink(monkeypatch)
    assert [box_passes_of(build(one)) for one in (config(), twice)] == [1, 2]


def test_torchvision_codes_and_decodes_continuous_coordinates() -> None:
    """What training asks for, decoded as predictions are, comes back within half a cell and without a mean shift."""
    rng = np.random.default_rng(0)
    roi = torch.tensor([[10.0, 20.0, 66.0, 76.0]])
    truth = torch.tensor(rng.uniform([10, 20], [66, 76], (1, 2000, 2)), dtype=torch.float32)
    cells, valid = keypoints_to_heatmap(torch.cat([truth, torch.full((1, 2000, 1), 2.0)], dim=2), roi, 56)
    assert valid.all()
    maps = torch.zeros(1, 2000, 56 * 56).scatter_(2, cells[..., None], 1.0).reshape(1, 2000, 56, 56)
    found, _ = heatmaps_to_keypoints(maps, roi)
    errors = (found[..., :2] - truth)[0]
    assert errors.abs().max() < 0.5 + 1e-4
    assert errors.mean(dim=0).abs().max() < 0.03


def test_weights_of_the_package_go_by_their_name(
    small_model: KeypointRCNN, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(weights, "WEIGHTS_FOLDER", tmp_path / "package")
    with pytest.raises(UserError, match="no such checkpoint"):
        find_checkpoint(Path("road33"))
    save_weights(weights.path("road33"), small_model, config(), {})
    assert find_checkpoint(Path("road33")) == tmp_path / "package" / "road33.safetensors"
    with pytest.raises(UserError, match="road33 comes with skope"):
        find_checkpoint(Path("other"))
    own = Path("road33") / checkpoint_name(1)  # what a user calls so comes first
    save_weights(own, small_model, config(), {})
    assert find_checkpoint(Path("road33")) == own
