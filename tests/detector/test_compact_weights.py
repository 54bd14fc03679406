"""Packed weights: how exact, how large, and that no damage goes unnoticed."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torchvision.models.detection import KeypointRCNN, keypointrcnn_resnet50_fpn

from skope import keypoints
from skope.detector import compact_weights
from skope.detector.build import NETWORK_DEFAULTS, DetectorConfig, build
from skope.detector.checkpoint import checkpoint_bytes, load_weights, read_checkpoint
from skope.detector.compact_weights import DamagedError
from skope.detector.detect import detect
from skope.errors import UserError

CONFIG = DetectorConfig(norm="frozen", norm_eps=1e-5, min_size=96, max_size=160)


def weights(**shapes: tuple[int, ...]) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(0)
    return {name: torch.randn(shape, generator=generator) for name, shape in shapes.items()}


def relative_error(now: torch.Tensor, before: torch.Tensor) -> float:
    now, before = now.detach(), before.detach()
    return float(((now - before).square().sum() / before.square().sum()).sqrt())


@pytest.mark.parametrize("most_bytes", [20_000, 40_000, 80_000])
def test_weights_are_rounded_to_their_channels_steps_within_the_bytes(most_bytes: int) -> None:
    state = weights(large=(64, 64, 3, 3), small=(32, 64, 1, 1), norm=(64,))
    state["large"] *= torch.logspace(-3, 3, 64).view(-1, 1, 1, 1)  # channels of all sizes
    state["count"] = torch.tensor(7)
    stored, kept = compact_weights.pack(state, most_bytes)
    back = compact_weights.unpack(stored, kept)
    assert back.keys() == state.keys()
    assert sum(len(stored[name]) for name in ("large", "small")) <= most_bytes
    assert torch.equal(back["norm"], state["norm"])
    assert torch.equal(back["count"], state["count"])
    for name in ("large", "small"):
        steps = stored[f"{name}.steps"].view(-1, *[1] * (state[name].ndim - 1))
        assert ((back[name] - state[name]).abs() <= steps * 0.5001).all()
        assert ((back[name] / steps).round().abs() <= 127).all()
        errors = [relative_error(a, b) for a, b in zip(back[name], state[name], strict=True)]
        assert max(errors) < 3 * min(errors)  # no channel pays for another's size


def test_more_bytes_make_less_error_and_all_that_are_given_are_used() -> None:
    state = weights(a=(128, 128, 3, 3), b=(64, 128))
    errors = []
    for most_bytes in (60_000, 80_000, 100_000):
        stored, kept = compact_weights.pack(state, most_bytes)
        assert 0.98 * most_bytes < len(stored["a"]) + len(stored["b"]) <= most_bytes
        errors.append(relative_error(compact_weights.unpack(stored, kept)["a"], state["a"]))
    assert errors[0] > 1.5 * errors[1] > 2 * errors[2]


def test_bytes_are_shared_so_that_the_sum_of_errors_is_least() -> None:
    """Against the same number of bytes with one factor for all tensors, large and small."""
    state = weights(large=(512, 512, 3, 3), small=(64, 64, 1, 1))
    stored, kept = compact_weights.pack(state, 1_200_000)
    back = compact_weights.unpack(stored, kept)
    ours = sum(relative_error(back[name], state[name]) ** 2 for name in state)
    step = float(stored["large.steps"].mean())
    alike = {name: (tensor / step).round() * step for name, tensor in state.items()}
    assert ours < 0.7 * sum(relative_error(alike[name], state[name]) ** 2 for name in state)


def test_channels_of_zeros_stay_zero_and_one_spike_does_not_overflow() -> None:
    state = weights(a=(8, 1000))
    state["a"][3] = 0
    state["a"][5, 7] = 1e4
    back = compact_weights.unpack(*compact_weights.pack(state, 4_000))["a"]
    assert (back[3] == 0).all()
    assert float(back[5, 7]) == pytest.approx(1e4, rel=1e-3)


@pytest.fixture(scope="module")
def model() -> KeypointRCNN:
    torch.manual_seed(0)
    return build(CONFIG).eval()


@pytest.fixture(scope="module")
def packed(model: KeypointRCNN, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("packed") / "a.compact.safetensors"
    path.write_bytes(checkpoint_bytes(model, CONFIG, {"epoch": 3}, packed=True))
    return path


def test_a_packed_detector_is_small_and_near(model: KeypointRCNN, packed: Path) -> None:
    assert packed.stat().st_size <= 35_000_000
    loaded, config, metadata = load_weights(packed, "cpu")
    assert (config, metadata) == (CONFIG, {"epoch": 3})
    before = model.state_dict()
    for name, tensor in loaded.state_dict().items():
        if before[name].ndim < 2:
            assert torch.equal(tensor, before[name])
        else:
            assert relative_error(tensor, before[name]) < 0.14
    assert relative_error(loaded.backbone.body.conv1.weight, model.backbone.body.conv1.weight) < 1e-3


def test_stock_torchvision_gives_the_same_detections(packed: Path) -> None:
    loaded, config, _ = load_weights(packed, "cpu")
    sizes = {
        "min_size": config.min_size,
        "max_size": config.max_size,
        "rpn_post_nms_top_n_test": NETWORK_DEFAULTS.proposals,
    }
    stock = keypointrcnn_resnet50_fpn(
        weights=None, weights_backbone=None, num_classes=2, num_keypoints=keypoints.K, **sizes
    )
    stock.load_state_dict(read_checkpoint(packed)[1], strict=True)
    pixels = np.random.default_rng(0).integers(0, 256, (96, 128, 3), dtype=np.uint8)
    ours, theirs = (detect(m, [pixels], "cpu", min_score=0.0, max_detections=5)[0] for m in (loaded, stock))
    assert len(ours.scores) == 5
    np.testing.assert_allclose(ours.boxes_xyxy, theirs.boxes_xyxy, atol=1e-3)
    np.testing.assert_allclose(ours.keypoints, theirs.keypoints, atol=1e-3)


def refusal(path: Path) -> str:
    """The one line with which a file is refused."""
    with pytest.raises(UserError) as caught:
        load_weights(path, "cpu")
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_no_flipped_bit_goes_unnoticed(packed: Path, tmp_path: Path) -> None:
    data, rng, path = packed.read_bytes(), np.random.default_rng(0), tmp_path / "flipped.safetensors"
    header = struct.unpack("<Q", data[:8])[0] + 8
    places = [*rng.integers(0, header, 15), *rng.integers(header, len(data), 10), len(data) - 1]
    for place in places:
        flipped = bytearray(data)
        flipped[place] ^= 1 << rng.integers(8)
        path.write_bytes(flipped)
        refusal(path)


def test_truncated_files_are_refused(packed: Path, tmp_path: Path) -> None:
    data, path = packed.read_bytes(), tmp_path / "short.safetensors"
    for size in (0, 4, 8, 100, 20_000, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:size])
        assert "not a safetensors file, or a truncated one" in refusal(path)
    path.write_bytes(data + b"x")
    assert "not a safetensors file" in refusal(path)


def tampered(path: Path, out: Path, **changes: Any) -> Path:
    """A copy with other values in skope's header and the checksum that these have."""
    with safe_open(path, framework="pt") as file:
        header = json.loads(file.metadata()["skope"]) | changes
    tensors = load_file(path)
    del header["sha256"]
    header["sha256"] = compact_weights.digest(tensors, header)
    save_file(tensors, out, metadata={"skope": json.dumps(header)})
    return out


def test_a_header_that_lies_is_refused_whatever_its_checksum(packed: Path, tmp_path: Path) -> None:
    with safe_open(packed, framework="pt") as file:
        kept = json.loads(file.metadata()["skope"])["packed"]
    name = "roi_heads.box_head.fc6.weight"
    for value, words in [
        ({**kept, name: {"kept": "integers", "shape": [1024, 1 << 22]}}, "is impossible"),
        ({**kept, name: {"kept": "integers", "shape": [1024, 12543]}}, "expected 12844032 weights, got another number"),
        ({**kept, name: {"kept": "integers", "shape": ["many"]}}, "damaged"),
        ({**kept, name: {"kept": "pickled", "shape": []}}, "damaged"),
        ({key: value for key, value in kept.items() if key != name}, "not those that the header lists"),
        ([], "damaged"),
        ({"x": 3}, "damaged"),
    ]:
        assert words in refusal(tampered(packed, tmp_path / "a.safetensors", packed=value)), value
    tampered(packed, tmp_path / "b.safetensors", config={**CONFIG.to_dict(), "min_size": 128})
    assert load_weights(tmp_path / "b.safetensors", "cpu")[1].min_size == 128  # what the checksum is for
    path = tmp_path / "c.safetensors"
    path.write_bytes(packed.read_bytes().replace(b'\\"min_size\\": 96', b'\\"min_size\\": 97'))
    assert "sha256 differs" in refusal(path)


def test_bytes_that_are_no_stream_are_named() -> None:
    stored, kept = compact_weights.pack(weights(a=(8, 100)), 500)
    stored["a"] = torch.full((50,), 200, dtype=torch.uint8)
    with pytest.raises(DamagedError, match="tensor a: cannot be unpacked"):
        compact_weights.unpack(stored, kept)
