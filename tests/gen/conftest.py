import fcntl
import os
import shutil
import subprocess
from pathlib import Path

import pytest

from tests.gen.small import gen


@pytest.fixture(scope="session")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small dataset made in one go by one process. The worker that wants it first makes it, the others copy it."""
    kept = Path(os.environ["SKOPE_CACHE"]) / "whole"
    with kept.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not kept.exists():
            made = tmp_path_factory.mktemp("gen") / "made"
            subprocess.run(gen(made, "--workers", "1"), check=True, capture_output=True)
            shutil.move(made, kept)
    return Path(shutil.copytree(kept, tmp_path_factory.mktemp("gen") / "whole"))
