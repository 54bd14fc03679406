import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skope import detector


def files_of(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


@pytest.fixture(scope="session")
def random_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the checkpoint of a small-input detector that has learned nothing."""
    import torch

    torch.manual_seed(0)
    config = detector.DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96)
    model = detector.build(config)
    with torch.no_grad():
        # Leaves a handful of the 300 detections that random weights make: their keypoints take most of the time.
        model.roi_heads.box_predictor.cls_score.bias[1] -= 4.2
    folder = tmp_path_factory.mktemp("run")
    detector.save_weights(folder / detector.checkpoint_name(1), model, config, {})
    return folder


@pytest.fixture
def stops_after(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Any]:
    """A context in which predicting is interrupted as if by Ctrl-C after so many images."""
    from skope.eval.inference.predictor import Predictor

    each = Predictor.each

    @contextlib.contextmanager
    def context(count: int) -> Any:
        def stops(self: Predictor, images: Any) -> Any:
            for i, pair in enumerate(each(self, images)):
                if i == count:
                    raise KeyboardInterrupt
                yield pair

        with monkeypatch.context() as patch:
            patch.setattr(Predictor, "each", stops)
            yield

    return context
