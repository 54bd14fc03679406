import sys
import tempfile
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

with suppress(ImportError):  # metrics and formats are worked on without it
    # Before OpenGL: torch crashes where Mesa's compiler was loaded before it.
    import torchvision  # noqa: F401


@pytest.fixture(scope="session", autouse=True)
def cheap_scenery() -> Iterator[None]:
    """Keep the tests' scenery out of the user's cache (subprocesses inherit it), and light it from few directions."""
    from skope.gen.render.gl import light

    with tempfile.TemporaryDirectory(prefix="skope-cache-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKOPE_CACHE", folder)
        patch.setattr(light, "SAMPLES", 4)
        yield


@pytest.fixture
def skope(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Any:
    """Run the command in an empty folder; returns exit code, standard output and standard error."""
    from skope import cli

    monkeypatch.chdir(tmp_path)

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
def random_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the checkpoint of a small-input detector that has learned nothing."""
    import torch

    from skope import detector

    torch.manual_seed(0)
    config = detector.DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96)
    model = detector.build(config)
    with torch.no_grad():
        # Leaves a handful of the 300 detections that random weights make: their keypoints take most of the time.
        model.roi_heads.box_predictor.cls_score.bias[1] -= 4.2
    folder = tmp_path_factory.mktemp("run")
    detector.save_weights(folder / detector.checkpoint_name(1), model, config, {})
    return folder
