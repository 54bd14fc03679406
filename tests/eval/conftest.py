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
