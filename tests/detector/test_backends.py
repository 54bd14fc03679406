"""Other runtimes find what torch finds; what is missing or broken is one line."""

import json
import subprocess
import sys
from collections import OrderedDict
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from torchvision.models.detection import KeypointRCNN
from torchvision.ops import MultiScaleRoIAlign

from skope import boxes
from skope.dataset.folder import read_image
from skope.detections import Detections
from skope.detector import int8_ranges, weights
from skope.detector.backends.network_parts import NetworkPart, RegionPooling, RunNetwork, hand_over, parts_of
from skope.detector.backends.prepare import convert, prepare
from skope.detector.backends.region_suppression import suppress_together
from skope.detector.checkpoint import find_checkpoint, load_weights
from skope.detector.detect import detect, detect_on_boxes
from skope.errors import UserError
from skope.schema import CATEGORY_NAMES
from skope.terminal.console import Console
from skope.types import Floats32

PICTURE = Path(__file__).parents[2] / "docs" / "noon.jpg"
"""A generated junction by day; six of its vehicles stand clear of one another."""
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def pixels() -> NDArray[np.uint8]:
    return read_image(PICTURE)


def shipped() -> KeypointRCNN:
    model, _, _ = load_weights(weights.path(weights.DEFAULT_WEIGHTS), CPU)
    model.transform.min_size, model.transform.max_size = (320,), 640
    return model


def found(model: KeypointRCNN, pixels: NDArray[np.uint8]) -> Detections:
    return detect(model, [pixels], CPU, min_score=0.3, categories=CATEGORY_NAMES)[0]


@pytest.fixture(scope="module")
def noted(pixels: NDArray[np.uint8]) -> tuple[Detections, dict[str, Any]]:
    """What torch finds, and the ranges of the layers' inputs meanwhile."""
    model = shipped()
    with int8_ranges.noted(model) as seen:
        answer = found(model, pixels)
    return answer, int8_ranges.to_metadata(model, seen)


@pytest.fixture(scope="module")
def by_torch(noted: tuple[Detections, dict[str, Any]]) -> Detections:
    return noted[0]


@pytest.fixture(scope="module")
def ranges(noted: tuple[Detections, dict[str, Any]]) -> dict[str, Any]:
    return noted[1]


class Limits(NamedTuple):
    overlap: float
    point_px: float
    score: float


EXACT, ROUNDED = Limits(0.9999, 0.02, 1e-4), Limits(0.8, 2.0, 0.1)
_IN_ITS_OWN = """
import json, sys
from pathlib import Path
import numpy as np, torch
from skope import dataset
from skope.terminal.console import Console
from skope.detector.backends.prepare import prepare
from tests.detector.test_backends import CPU, RUNTIMES, found, shipped
backend, picture, ranges, out = sys.argv[1:]
pixels, metadata = dataset.read_image(Path(picture)), json.loads(Path(ranges).read_text())
for precision in RUNTIMES[backend]:
    model = shipped()
    prepare(model, metadata, CPU, backend=backend, precision=precision, console=Console(quiet=True))
    left = [m for m in model.modules() if isinstance(m, torch.nn.Conv2d | torch.nn.Linear | torch.nn.ConvTranspose2d)]
    assert left == [], "torch multiplies nothing any more"
    found(model, np.ascontiguousarray(pixels[:, :300]))  # another size than the first one goes through another graph
    answer = found(model, pixels)
    np.savez(f"{out}/{precision}.npz", boxes_xyxy=answer.boxes_xyxy, scores=answer.scores, keypoints=answer.keypoints)
"""
RUNTIMES = {"openvino": {"float32": EXACT, "int8": ROUNDED}, "onnx": {"float32": EXACT}}
"""How near each comes to torch, by its number formats."""


@pytest.mark.parametrize("backend", ["openvino", pytest.param("onnx", marks=pytest.mark.slow)])
def test_a_runtime_finds_what_torch_finds(
    backend: str, by_torch: Detections, ranges: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "ranges.json").write_text(json.dumps(ranges))
    arguments = [backend, str(PICTURE), str(tmp_path / "ranges.json"), str(tmp_path)]
    # In a process of its own: pytest forks others later, which a process that has run OpenVINO may not survive.
    subprocess.run([sys.executable, "-c", _IN_ITS_OWN, *arguments], check=True, cwd=PICTURE.parents[1])
    sure = by_torch.above(0.9)
    assert len(sure) >= 5
    for precision, limits in RUNTIMES[backend].items():
        answer = Detections(**np.load(tmp_path / f"{precision}.npz"), size=by_torch.size)
        ious = boxes.iou(sure.boxes_xyxy, answer.boxes_xyxy)
        same = ious.argmax(axis=1)
        assert ious.max(axis=1).min() > limits.overlap
        assert np.abs(sure.scores - answer.scores[same]).max() < limits.score
        away = np.linalg.norm(sure.keypoints[..., :2] - answer.keypoints[same][..., :2], axis=-1)
        assert np.median(away) < limits.point_px
        if limits is EXACT:
            assert len(answer) == len(by_torch)


_IN_BOTH_ORDERS = """
import sys
from pathlib import Path
import numpy as np
from skope.dataset.folder import read_image
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.terminal.console import Console
wide = read_image(Path(sys.argv[1]))
images = [np.ascontiguousarray(part) for part in (wide[:, :700], wide[200:, :900])]
for one_size in (False, True):
    settings = Settings(backend="openvino", precision="int8", min_size=320, one_size=one_size)
    found = []
    for order in ([0, 1], [1, 0]):
        predictor = Predictor.load(Path("road33-lite"), settings, Console(quiet=True))
        found.append({i: predictor.detections([images[i]])[0] for i in order})
    for i in range(2):
        one, other = found[0][i], found[1][i]
        assert len(one) >= 2
        for name in ("boxes_xyxy", "scores", "keypoints"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), (one_size, i, name)
"""


def test_images_of_several_sizes_are_found_the_same_in_any_order() -> None:
    command = [sys.executable, "-c", _IN_BOTH_ORDERS, str(PICTURE)]
    subprocess.run(command, check=True, cwd=PICTURE.parents[1])


def test_parts_handed_over_to_torch_itself_answer_as_before(random_run: Path, pixels: NDArray[np.uint8]) -> None:
    """Also in an image without vehicles, of which no region reaches the heads."""

    def by_itself(part: NetworkPart) -> RunNetwork:
        def run(x: Floats32) -> list[Floats32]:
            out = part.module(torch.from_numpy(x))
            return [one.numpy() for one in (out if isinstance(out, tuple) else (out,))]

        return run

    pixels = pixels[:64, :96]
    before, after = (load_weights(find_checkpoint(random_run), CPU)[0] for _ in range(2))
    with torch.inference_mode():
        hand_over(after, {name: by_itself(part) for name, part in parts_of(after).items()})
    for least in (0.05, 0.9999):
        one, two = (detect(model, [pixels], CPU, min_score=least)[0] for model in (before, after))
        assert two.boxes_xyxy == pytest.approx(one.boxes_xyxy, abs=0.01)
        assert two.scores == pytest.approx(one.scores, abs=1e-5)
    assert len(two) == 0
    one, two = (detect_on_boxes(model, pixels, [[10, 10, 60, 50]], CPU) for model in (before, after))
    assert two[..., 2] == pytest.approx(one[..., 2], abs=1e-4)


def test_eight_bits_are_the_arithmetic_of_integers() -> None:
    """Of a small convolution and of a linear layer, multiplied out in whole numbers."""
    with torch.random.fork_rng():
        torch.manual_seed(3)
        layers = torch.nn.Sequential(torch.nn.Conv2d(3, 4, 3, padding=1, stride=2), torch.nn.Flatten())
        layers.append(torch.nn.Linear(4 * 3 * 3, 5))
        x = torch.randn(2, 3, 6, 6)
    exact = layers(x)
    weights_of = {name: layer.weight.detach().clone() for name, layer in layers.named_modules() if name in ("0", "2")}
    biases = {name: layers.get_submodule(name).bias.detach() for name in weights_of}
    ranges = {"0": (-3.0, 2.5), "2": (-1.5, 1.5)}
    convert(layers, ranges)
    rounded = layers(x)

    def whole(name: str, values: torch.Tensor) -> tuple[NDArray[np.int64], float, int]:
        low, high = ranges[name]
        step = (high - low) / 255
        zero = round(-low / step)
        return np.clip(np.round(values.detach().numpy() / step) + zero, 0, 255).astype(np.int64) - zero, step, zero

    def product(name: str, columns: torch.Tensor) -> NDArray[np.float64]:
        weight = weights_of[name].flatten(1).numpy()
        steps = np.abs(weight).max(axis=1) / 127
        inputs, step, _ = whole(name, columns)
        sums = inputs @ np.round(weight / steps[:, None]).astype(np.int64).T
        return sums * step * steps + biases[name].numpy()

    columns = torch.nn.functional.unfold(x, 3, padding=1, stride=2).transpose(1, 2)
    maps = product("0", columns).transpose(0, 2, 1)
    expected = product("2", torch.from_numpy(maps.reshape(2, -1)))
    assert rounded.detach().numpy() == pytest.approx(expected, abs=1e-4)
    assert 1e-4 < float((rounded - exact).detach().abs().max()) < 0.1


def random_regions(count: int, generator: torch.Generator) -> torch.Tensor:
    """Boxes of all sizes in an image of 320 x 200, some beyond its edges."""
    corner = torch.rand(count, 2, generator=generator) * torch.tensor([360.0, 240.0]) - 20
    size = torch.exp(torch.rand(count, 2, generator=generator) * 6)
    return torch.cat([corner, corner + size], dim=1)


@pytest.mark.parametrize("output", [7, 14])
def test_regions_are_pooled_as_torchvision_pools_them(output: int) -> None:
    generator = torch.Generator().manual_seed(output)
    sizes = ((50, 80), (25, 40), (13, 20), (7, 10))
    maps = OrderedDict((str(i), torch.randn(2, 8, *size, generator=generator)) for i, size in enumerate(sizes))
    pool = MultiScaleRoIAlign(["0", "1", "2", "3"], output, 2)
    shapes = [(200, 320), (200, 320)]
    for counts in ((40, 60), (0, 5), (0, 0)):
        regions = [random_regions(count, generator) for count in counts]
        expected = pool(maps, regions, shapes)
        assert RegionPooling(pool)(maps, regions, shapes) == pytest.approx(expected, abs=1e-4)


class Said(Console):
    """A console that keeps what it is told."""

    def __init__(self) -> None:
        super().__init__(quiet=True)
        self.lines: list[str] = []

    def say(self, text: str) -> None:
        self.lines.append(text)


@pytest.fixture
def model(random_run: Path) -> KeypointRCNN:
    return load_weights(find_checkpoint(random_run), CPU)[0]


@pytest.fixture
def broken(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    module = ModuleType("openvino")
    module.__version__ = "2026.1.0-123"  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, "openvino", module)
    return module


def refusal(model: KeypointRCNN, **choice: Any) -> str:
    settings = {"backend": "openvino", "precision": "float32", "device": CPU, "metadata": {}, **choice}
    with pytest.raises(UserError) as caught:
        prepare(model, settings.pop("metadata"), settings.pop("device"), console=Said(), **settings)
    (line,) = str(caught.value).splitlines()
    return line


def test_a_missing_runtime_is_one_line_and_auto_takes_torch(
    model: KeypointRCNN, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "openvino", None)
    expected = "--backend openvino: openvino is not installed: pip install 'skope[openvino]'"
    assert refusal(model) == expected
    said = Said()
    assert prepare(model, {}, CPU, backend="auto", precision="float32", console=said) == "float32"
    assert said.lines == []


def test_an_old_or_broken_runtime_is_one_line_and_auto_says_so(
    model: KeypointRCNN, broken: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Core:
        def read_model(self, onnx: bytes) -> None:
            raise RuntimeError("unsupported opset\nat frontend.cpp:12")

    broken.Core = Core
    assert refusal(model) == (
        "--backend openvino: openvino 2026.1.0 cannot compute the network (unsupported opset): "
        "pip install 'skope[openvino]'"
    )
    layers = int8_ranges.rounded_layers(model)
    ranges = {int8_ranges.RANGES_KEY: {name: [0.0, 1.0] for name in layers}}
    monkeypatch.setattr("skope.detector.device.has_bfloat16", lambda _: False)
    said = Said()
    assert prepare(model, ranges, CPU, backend="auto", precision="auto", console=said) == "float32"
    assert said.lines[0].endswith("(unsupported opset): pip install 'skope[openvino]'; torch computes instead")
    assert int8_ranges.rounded_layers(model) == layers, "no layer rounds any more"
    broken.__version__ = "2023.3.0"
    assert "openvino 2023.3.0 is too old, 2025.0 is the oldest that will do" in refusal(model)
    said = Said()
    assert prepare(model, {}, CPU, backend="auto", precision="float32", console=said) == "float32"
    assert said.lines == [
        "--backend openvino: openvino 2023.3.0 is too old, 2025.0 is the oldest that will do: "
        "pip install 'skope[openvino]'; torch computes instead"
    ]


@pytest.mark.usefixtures("broken")
def test_number_formats_that_are_not_there(model: KeypointRCNN) -> None:
    assert refusal(model, backend="onnx", precision="int8") == "--precision int8: backend onnx has float32"
    assert refusal(model, backend="torch", precision="int8") == "--precision int8: backend torch has bfloat16, float32"
    assert "the checkpoint does not say how large its layers' inputs become" in refusal(model, precision="int8")
    damaged = {int8_ranges.RANGES_KEY: {"backbone": [0, 1]}}
    assert "activation_ranges: expected the least and largest input of each of" in refusal(model, metadata=damaged)
    gpu = torch.device("cuda")
    assert refusal(model, device=gpu) == (
        "--backend openvino: computes on the CPU only; give --device cpu, or --backend torch"
    )


def test_the_command_names_what_computes(skope: Any, random_run: Path, pixels: NDArray[np.uint8]) -> None:
    image = Path("a.png")
    import cv2

    cv2.imwrite(str(image), pixels[:64, :96])
    code, said, err = skope("eval", "predict", image, "--checkpoint", random_run, "--backend", "onnx", "--out", "o")
    assert code == 0, err
    assert "in float32 by onnxruntime" in said
    code, out, err = skope("eval", "predict", image, "--checkpoint", random_run, "--precision", "int8", "--out", "p")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1
    assert not Path("p").exists()


SIGNAL_AFTER_DELETION = """
import gc, os, signal
import numpy as np
from torch import nn
from skope.detector.backends.network_parts import NetworkPart
from skope.detector.backends.runtimes import RUNTIME_CLASSES

runs = [RUNTIME_CLASSES["openvino"]().compile(NetworkPart(nn.Conv2d(3, 4, 3), (-1, 3, 8, 8)), "float32") for _ in "123"]
for k in range(3):
    runs[k](np.zeros((1, 3, 8, 8), np.float32))
for k in range(3):
    runs[k] = None
    gc.collect()
signal.signal(signal.SIGINT, lambda *_: print("received"))
os.kill(os.getpid(), signal.SIGINT)
"""


def test_signals_arrive_after_detectors_are_deleted() -> None:
    """A signal that crashes the process would lose what Ctrl-C saves."""
    pytest.importorskip("openvino")
    done = subprocess.run([sys.executable, "-c", SIGNAL_AFTER_DELETION], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "received\n"), done.stderr


@pytest.mark.parametrize("backend", ["openvino", "onnx", "together"])
def test_backends_find_other_road_users_too(backend: str, categories_run: Path) -> None:
    """Those that torch finds surely, of each category; only vehicles go through the keypoint head."""
    if backend in ("openvino", "onnx"):
        pytest.importorskip({"openvino": "openvino", "onnx": "onnxruntime"}[backend])
    pixels = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    before, after = (load_weights(find_checkpoint(categories_run), CPU)[0] for _ in range(2))
    if backend == "together":
        suppress_together(after)
    else:
        prepare(after, {}, CPU, backend=backend, precision="float32", console=Console(quiet=True))
    one, two = (detect(m, [pixels], CPU, min_score=0.2, categories=CATEGORY_NAMES)[0] for m in (before, after))
    assert len(one) > 2
    assert set(one.road_users.categories.tolist()) == {2, 3, 4}
    sure = one.road_users.of(one.road_users.scores > 0.21)
    for box, score, category in zip(sure.boxes_xyxy, sure.scores, sure.categories, strict=True):
        alike = two.road_users.of(two.road_users.categories == category)
        overlaps = boxes.iou(box, alike.boxes_xyxy)[0]
        assert overlaps.max() > 0.99
        assert alike.scores[overlaps.argmax()] == pytest.approx(score, abs=0.01)
    assert two.keypoints.shape == (len(two), 33, 3)
