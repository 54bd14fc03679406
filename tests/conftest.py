import contextlib
import os
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from typing import Any, Final

import pytest

from tests.chromium import Browser, chromium
from tests.few_directions import sitecustomize

WORKER: Final = "PYTEST_XDIST_WORKER" in os.environ
if WORKER:
    # There are as many workers as cores: more threads would wait for each other, and burn time while they do.
    os.environ.setdefault("OMP_NUM_THREADS", "1")

with suppress(ImportError):  # metrics and formats are worked on without it
    # Before OpenGL: torch crashes where Mesa's compiler was loaded before it.
    import torchvision  # noqa: F401


LONGEST: Final = (
    "train/test_exports.py",
    "gen/pipeline/test_generate.py",
    "gen/towns/test_networks.py",
    "test_examples.py",
    "test_notebooks.py",
    "gen/pipeline/test_dataset_store.py",
    "test_scripts.py",
    "eval/cli/test_footage.py",
    "gen/render/test_lens.py",
    "train/test_distributed.py",
    "gen/labels/test_annotate.py",
    "gen/render/test_render.py",
    "test_writers.py",
    "train/test_loop.py",
    "files/test_safe_names.py",
    "gen/vehicles/test_fleet.py",
    "gen/render/test_weather.py",
    "detector/test_road33.py",
    "detector/test_predictor.py",
    "gen/inspect/test_check.py",
    "gen/test_generation_site.py",
    "gen/traffic/test_sumo.py",
)
"""Files that take longest: a worker that began one of them last would be waited for."""


def pytest_configure() -> None:
    """Keep scenery and vehicles apart from the user's; workers and subprocesses share them, and light cheaply."""
    if not WORKER:
        os.environ["SKOPE_CACHE"] = tempfile.mkdtemp(prefix="skope-cache-")
        os.environ["SKOPE_VEHICLES"] = str(Path(os.environ["SKOPE_CACHE"]) / "vehicles")
        path = (str(Path(sitecustomize.__file__).parent), os.environ.get("PYTHONPATH", ""))
        os.environ["PYTHONPATH"] = os.pathsep.join(filter(None, path))


def pytest_unconfigure() -> None:
    if not WORKER:
        shutil.rmtree(os.environ.pop("SKOPE_CACHE"), ignore_errors=True)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Begin with the longest files."""
    here = Path(__file__).parent
    place = {here / name: k for k, name in enumerate(LONGEST)}
    assert all(path.is_file() for path in place)
    items.sort(key=lambda item: place.get(item.path, len(place)))


@pytest.fixture
def skope(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Any:
    """Run the command in an empty folder; returns exit code, standard output and standard error."""
    from skope import cli

    monkeypatch.chdir(tmp_path)
    # OpenVINO is tested for itself: it takes three seconds to begin.
    monkeypatch.setattr("skope.detector.network_settings.FASTEST_BACKEND", "torch")

    def call(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["skope", *map(str, args)])
        capsys.readouterr()
        code = 0
        try:
            cli.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        return code, *capsys.readouterr()

    return call


@pytest.fixture(scope="session")
def chromium_pages(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Callable[[], AbstractContextManager[Browser]]]:
    """What opens a page of one Chromium for all tests of a worker; each page is as in a browser of its own."""
    if shutil.which("chromium") is None:
        pytest.skip("needs chromium")
    with chromium(tmp_path_factory.mktemp("profile")) as pages:
        yield pages


@pytest.fixture(scope="session")
def random_weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the checkpoint of a small detector that has learned nothing; only `shrink` has it load."""
    import torch

    from skope.detector.build import DetectorConfig, build
    from skope.detector.checkpoint import checkpoint_name, save_weights
    from tests.train.conftest import shrink

    config = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96)
    with pytest.MonkeyPatch.context() as patch, torch.random.fork_rng(), torch.no_grad():
        shrink(patch)
        torch.manual_seed(0)
        model = build(config)
        # Scores that lie well apart, and a handful of detections that are worth reporting.
        model.roi_heads.box_predictor.cls_score.weight *= 10
        model.roi_heads.box_predictor.cls_score.bias[1] -= 2.5
    folder = tmp_path_factory.mktemp("run")
    save_weights(folder / checkpoint_name(1), model, config, {})
    return folder


@pytest.fixture
def random_run(random_weights: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The `random_weights`, in a process whose detectors are small: the whole network takes seconds to load."""
    from tests.train.conftest import shrink

    shrink(monkeypatch)
    return random_weights


def files_of(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture
def stops_after(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """A context in which predicting is interrupted as if by Ctrl-C after so many images."""
    from skope.detector.predictor import Predictor

    each = Predictor.each_ahead

    @contextlib.contextmanager
    def context(count: int) -> Any:
        def stops(self: Predictor, images: Any) -> Any:
            for i, pair in enumerate(each(self, images)):
                if i == count:
                    raise KeyboardInterrupt
                yield pair

        with monkeypatch.context() as patch:
            patch.setattr(Predictor, "each_ahead", stops)
            yield

    return context


@pytest.fixture(scope="session")
def random_categories(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the checkpoint of a small detector of four categories that has learned nothing, and finds some
    of each; only `shrink` has it load."""
    import torch

    from skope.detector.build import DetectorConfig, build
    from skope.detector.checkpoint import checkpoint_name, save_weights
    from skope.schema import CATEGORY_NAMES
    from tests.train.conftest import shrink

    config = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96, categories=CATEGORY_NAMES)
    with pytest.MonkeyPatch.context() as patch, torch.random.fork_rng(), torch.no_grad():
        shrink(patch)
        torch.manual_seed(0)
        model = build(config).eval()
        seen: list[torch.Tensor] = []
        hook = model.roi_heads.box_head.register_forward_hook(lambda *parts: seen.append(parts[2]))
        model([torch.rand(3, 64, 96)])
        hook.remove()
        # Regions differ little to random weights: what they differ by is what counts.
        predictor = model.roi_heads.box_predictor.cls_score
        predictor.weight *= 2 / (predictor.weight @ (seen[0] - seen[0].mean(dim=0)).T).std()
        predictor.bias.copy_(-predictor.weight @ seen[0].mean(dim=0))
        predictor.bias[0] += 1
    folder = tmp_path_factory.mktemp("categories")
    save_weights(folder / checkpoint_name(1), model, config, {})
    return folder


@pytest.fixture
def categories_run(random_categories: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The `random_categories`, in a process whose detectors are small."""
    from tests.train.conftest import shrink

    shrink(monkeypatch)
    return random_categories
