"""Scenery's light on disk, so that processes and later runs need not work it out again.

Files are named by a digest of everything that they depend on, written beside their place and renamed into it, and the
longest unused ones go when there are too many: two processes at once do no harm, they only work twice.
"""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError
from skope.files import replacing

Arrays = dict[str, NDArray[np.float16]]

LIMIT_BYTES: Final = 2 * 1024**3


def folder() -> Path:
    """$SKOPE_CACHE, or skope's folder in the user's cache."""
    own = os.environ.get("SKOPE_CACHE")
    return Path(own) if own else Path(os.environ.get("XDG_CACHE_HOME", Path.home() / ".cache")) / "skope"


def cached(digest: str, make: Callable[[], Arrays]) -> Arrays:
    """The arrays stored under `digest`, or those of `make`, stored for the next time where that is possible."""
    path = folder() / f"light_{digest}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        path.touch()
        return arrays
    except Exception:  # absent, or damaged in one of numpy's and zip's many ways: made anew
        arrays = make()
    with contextlib.suppress(UserError, OSError):  # a cache that cannot be written is no cache
        with replacing(path) as temporary, temporary.open("wb") as out:
            np.savez(out, **arrays)  # type: ignore[arg-type]
        _shrink(path.parent)
    return arrays


def _shrink(root: Path) -> None:
    files = sorted(root.glob("light_*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for path in files:
        total += path.stat().st_size
        if total > LIMIT_BYTES and path != files[0]:
            path.unlink(missing_ok=True)
