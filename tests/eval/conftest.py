import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def files_of(folder: Path) -> dict[str, bytes]:
    """Contents of all files below a folder, by relative path."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


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


@pytest.fixture(scope="session")
def random_categories(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run folder with the checkpoint of a small detector of four categories that has learned nothing, and finds some
    of each; only `shrink` has it load."""
    import torch

    from skope.detector.build import DetectorConfig, build
    from skope.detector.checkpoint import checkpoint_name, save_weights
    from skope.schema import CATEGORIES
    from tests.train.conftest import shrink

    config = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96, categories=CATEGORIES)
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
