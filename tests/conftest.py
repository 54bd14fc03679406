import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

# Before OpenGL: torch crashes where Mesa's compiler was loaded before it.
import torchvision  # noqa: F401

from skope import cli
from skope.gen.render.gl import light


@pytest.fixture(scope="session", autouse=True)
def cheap_scenery() -> Iterator[None]:
    """Keep the tests' scenery out of the user's cache (subprocesses inherit it), and light it from few directions."""
    with tempfile.TemporaryDirectory(prefix="skope-cache-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKOPE_CACHE", folder)
        patch.setattr(light, "SAMPLES", 4)
        yield


@pytest.fixture
def skope(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Any:
    """Run the command in an empty folder; returns exit code, standard output and standard error."""
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
