"""A script with small detectors, as a module that a process of its own runs."""

import runpy
import sys

import pytest

from tests.train.conftest import shrink

if __name__ == "__main__":
    del sys.argv[0]
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        runpy.run_path(sys.argv[0], run_name="__main__")
