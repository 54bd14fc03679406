import os
import tempfile
from collections.abc import Iterator

import pytest


@pytest.fixture(scope="session", autouse=True)
def own_cache() -> Iterator[None]:
    """Keep the tests' scenery out of the user's cache; subprocesses inherit it."""
    with tempfile.TemporaryDirectory(prefix="skope-cache-") as folder:
        os.environ["SKOPE_CACHE"] = folder
        yield
        del os.environ["SKOPE_CACHE"]
