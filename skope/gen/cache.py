"""Cache on disk of built towns and vehicles and of light, for other processes and later runs.

Files are named by a digest of everything that they depend on, written beside their place and renamed into it, and the
longest unused ones of a kind go when there are too many.
"""

import contextlib
import hashlib
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.errors import UserError
from skope.files.atomic import hold_lock, replacing

Arrays = Mapping[str, NDArray[Any]]


@dataclass(frozen=True)
class CacheLimits:
    """Size and age of the cache."""

    most_bytes: int = 2 * 1024**3
    """Largest size of the cache of each kind, bytes."""
    day_s: float = 86400.0
    """Seconds of a day."""


CACHE_LIMITS: Final = CacheLimits()

CACHED_SOURCES: Final = (".py", ".toml", ".xml", ".glsl")
CACHED_LIBRARIES: Final = ("numpy", "shapely", "sumolib", "fast-simplification")
"""Libraries that meshes are built with; another version of one makes the cache invalid."""


def cache_folder() -> Path:
    """$SKOPE_CACHE, or skope's folder in the user's cache."""
    own, users = os.environ.get("SKOPE_CACHE"), os.environ.get("XDG_CACHE_HOME")
    return Path(own) if own else (Path(users) if users else Path.home() / ".cache") / "skope"


def cached(kind: str, digest: str, make: Callable[[], Arrays]) -> Arrays:
    """The arrays of a kind stored under `digest`, or those of `make`, stored for the next time where that is possible.

    Of processes that want the same at once, one makes it and the others wait.
    """
    path = _place(kind, digest)
    stored = _load(path)
    if stored is None:
        with _alone(path):
            stored = _loaded_or_made(path, make)
    return stored


def cached_from_parts(
    kind: str, digest: str, parts: Sequence[Callable[[], Arrays]], join: Callable[[Sequence[Arrays]], Arrays]
) -> Arrays:
    """As `cached`, made of the arrays of all `parts` by `join`.

    Processes that want the same at once share the parts out among them.
    """
    path = _place(kind, digest)
    places = [_place(f"{kind}-part", f"{digest}_{k}") for k in range(len(parts))]
    done: dict[int, Arrays] = {}
    # First entries without a lock, then those of other processes, which may have been killed.
    for patient in (False, True):
        for k in sorted(set(range(len(parts))) - done.keys()):
            with _alone(places[k], patient=patient) as alone:
                if alone:
                    stored = _load(path)
                    if stored is not None:
                        _remove_all(places)  # what was made here since others ended
                        return stored
                    done[k] = _loaded_or_made(places[k], parts[k])
    whole = cached(kind, digest, lambda: join([done[k] for k in range(len(parts))]))
    _remove_all(places)
    return whole


def _remove_all(places: Sequence[Path]) -> None:
    for place in places:
        _remove(place)


def _place(kind: str, digest: str) -> Path:
    return cache_folder() / f"{kind}_{digest}.npz"


def _loaded_or_made(path: Path, make: Callable[[], Arrays]) -> Arrays:
    stored = _load(path)
    if stored is None:
        # In the order in memory that a file gives, or what is computed with it may differ in the last digit.
        stored = {name: np.ascontiguousarray(array) for name, array in make().items()}
        _store(path, stored)
    return stored


def digest_of(*parts: str) -> str:
    """A digest of `parts` and of the generator's sources and libraries: a name for what the cache keeps of them."""
    return hashlib.sha256("\n".join([_program_digest(), *parts]).encode()).hexdigest()[:24]


@cache
def _program_digest() -> str:
    """Digest of the generator's source files and of the versions of the libraries that meshes are built with."""
    digest = hashlib.sha256("\n".join(f"{name} {version(name)}" for name in CACHED_LIBRARIES).encode())
    root = Path(__file__).parents[1]
    files = [*root.glob("*.py"), *(path for path in (root / "gen").rglob("*") if path.suffix in CACHED_SOURCES)]
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()


def _load(path: Path) -> Arrays | None:
    # Absent, or damaged in one of numpy's and zip's many ways.
    with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
        with contextlib.suppress(OSError):  # what others own can be read all the same
            path.touch()
        return arrays
    return None


def _store(path: Path, arrays: Arrays) -> None:
    with contextlib.suppress(UserError, OSError):  # a cache that cannot be written is no cache
        with replacing(path) as temporary, temporary.open("wb") as out:
            np.savez(out, **arrays)  # type: ignore[arg-type]
        _shrink(path)


@contextlib.contextmanager
def _alone(path: Path, *, patient: bool = True) -> Iterator[bool]:
    """Keep other processes from building the same file, where the file system has locks.

    False where another process is building it and this one is not `patient`.
    """
    lock = path.with_suffix(".lock")
    alone = True
    with contextlib.ExitStack() as stack:
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            stack.enter_context(hold_lock(lock, wait=patient))
            stack.callback(_remove, lock)
        except BlockingIOError:
            alone = False
        except OSError:
            pass
        yield alone


def _remove(path: Path) -> None:
    with contextlib.suppress(OSError):
        path.unlink()


def _shrink(newest: Path) -> None:
    """Remove the longest unused files of the newest one's kind, and what killed processes left of it."""
    kind = newest.name.split("_")[0]
    for left in newest.parent.glob(f".{kind}_*.part*"):
        if time.time() - left.stat().st_mtime > CACHE_LIMITS.day_s:
            _remove(left)
    files = sorted(newest.parent.glob(f"{kind}_*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    total = 0
    for path in files:
        total += path.stat().st_size
        if total > CACHE_LIMITS.most_bytes and path != files[0]:
            _remove(path)
