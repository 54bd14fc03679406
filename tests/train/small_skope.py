"""`skope` with small detectors, as a module that a process of its own runs."""

import pytest

from skope import cli
from tests.train.conftest import shrink

if __name__ == "__main__":
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        cli.main()
