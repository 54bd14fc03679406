"""Locks of files."""

import os
from concurrent.futures import ThreadPoolExecutor, wait
from pathlib import Path

import pytest

from skope.files.atomic import hold_lock
from tests.waiting import HANG_S


def test_a_lock_that_was_waited_for_is_that_of_the_file_that_others_see(tmp_path: Path) -> None:
    """A holder removes its file at the end: the lock of a removed file would keep nobody out."""
    path = tmp_path / "lock"
    first = hold_lock(path)
    with pytest.raises(BlockingIOError):
        hold_lock(path)
    with ThreadPoolExecutor(1) as pool:
        waiting = pool.submit(hold_lock, path, wait=True)
        assert not wait([waiting], timeout=0.2).done
        path.unlink()
        first.close()
        with waiting.result(timeout=HANG_S) as second:
            assert os.path.samestat(os.fstat(second.fileno()), path.stat())
            with pytest.raises(BlockingIOError):
                hold_lock(path)
