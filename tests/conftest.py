import tempfile
from collections.abc import Iterator

import pytest

from skope.gen.render.gl import light


@pytest.fixture(scope="session", autouse=True)
def cheap_scenery() -> Iterator[None]:
    """Keep the tests' scenery out of the user's cache (subprocesses inherit it), and light it from few directions."""
    with tempfile.TemporaryDirectory(prefix="skope-cache-") as folder, pytest.MonkeyPatch.context() as patch:
        patch.setenv("SKOPE_CACHE", folder)
        patch.setattr(light, "SAMPLES", 4)
        yield
