import subprocess
from pathlib import Path

import pytest

from tests.gen.small import gen


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset made in one go by one process."""
    out = tmp_path_factory.mktemp("gen") / "whole"
    subprocess.run(gen(out, "--workers", "1"), check=True, capture_output=True)
    return out
