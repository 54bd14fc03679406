"""Disk cache of built towns, vehicles and light, for other processes and later runs.

Each file is named by a digest of everything that its content depends on. It is written under a temporary name and then
renamed. If the files of a kind become too large, those that were not used for the longest time are removed.
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
    """Limits of the cache."""

    most_bytes: int = 2 * 1024**3
    """Maximum size of the cache of each kind, bytes."""
    day_s: float = 86400.0
    """Age above which unfinished files are removed, seconds (one day)."""


CACHE_LIMITS: Final = CacheLimits()

CACHED_SOURCES: Final = (".py", ".toml", ".xml", ".glsl")
CACHED_LIBRARIES: Final = ("numpy", "shapely", "sumolib", "fast-simplification")
"""Libraries that build the meshes; cached files of other versions are not used."""


def cache_folder() -> Path:
    """Return $SKOPE_CACHE, or skope's folder in the user's cache."""
    folder, user_folder = os.environ.get("SKOPE_CACHE"), os.environ.get("XDG_CACHE_HOME")
    return Path(folder) if folder else (Path(user_folder) if user_folder else Path.home() / ".cache") / "skope"


def cached(kind: str, digest: str, make: Callable[[], Arrays]) -> Arrays:
    """Return the arrays of a kind that are stored under `digest`, or make and store them.

    If several processes request the same arrays at once, one makes them and the others wait.
    """
    path = _path_of(kind, digest)
    stored = _load(path)
    if stored is None:
        with _alone(path):
            stored = _loaded_or_made(path, make)
    return stored


def cached_from_parts(
    kind: str, digest: str, parts: Sequence[Callable[[], Arrays]], join: Callable[[Sequence[Arrays]], Arrays]
) -> Arrays:
    """Return arrays as `cached` does; if they are not stored, `join` makes them from the arrays of all `parts`.

    If several processes request the same arrays at once, they share the parts.
    """
    path = _path_of(kind, digest)
    part_paths = [_path_of(f"{kind}-part", f"{digest}_{k}") for k in range(len(parts))]
    done: dict[int, Arrays] = {}
    # First the parts that no other process makes. Then the parts of other processes, which may have been killed.
    for patient in (False, True):
        for k in sorted(set(range(len(parts))) - done.keys()):
            with _alone(part_paths[k], patient=patient) as alone:
                if alone:
                    stored = _load(path)
                    if stored is not None:
                        _remove_all(part_paths)  # another process has finished meanwhile
                        return stored
                    done[k] = _loaded_or_made(part_paths[k], parts[k])
    whole = cached(kind, digest, lambda: join([done[k] for k in range(len(parts))]))
    _remove_all(part_paths)
    return whole


def _remove_all(paths: Sequence[Path]) -> None:
    for path in paths:
        _remove(path)


def _path_of(kind: str, digest: str) -> Path:
    return cache_folder() / f"{kind}_{digest}.npz"


def _loaded_or_made(path: Path, make: Callable[[], Arrays]) -> Arrays:
    stored = _load(path)
    if stored is None:
        # Arrays from a file are contiguous. Another memory layout could change the last digit of computed results.
        stored = {name: np.ascontiguousarray(array) for name, array in make().items()}
        _store(path, stored)
    return stored


def digest_of(*parts: str) -> str:
    """Return a digest of `parts` and of the generator's sources and libraries, which names files in the cache."""
    return hashlib.sha256("\n".join([_program_digest(), *parts]).encode()).hexdigest()[:24]


@cache
def _program_digest() -> str:
    """Return a digest of the generator's source files and of the versions of the libraries that build the meshes."""
    digest = hashlib.sha256("\n".join(f"{name} {version(name)}" for name in CACHED_LIBRARIES).encode())
    root = Path(__file__).parents[1]
    files = [*root.glob("*.py"), *(path for path in (root / "gen").rglob("*") if path.suffix in CACHED_SOURCES)]
    for path in sorted(files):
        digest.update(path.relative_to(root).as_posix().encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()


def _load(path: Path) -> Arrays | None:
    # The file may be missing or damaged; numpy and zipfile raise various exceptions.
    with contextlib.suppress(Exception), np.load(path, allow_pickle=False) as file:
        arrays = {name: file[name] for name in file.files}
        with contextlib.suppress(OSError):  # a file of another user can be read, but not touched
            path.touch()
        return arrays
    return None


def _store(path: Path, arrays: Arrays) -> None:
    with contextlib.suppress(UserError, OSError):  # without write permission, nothing is cached
        with replacing(path) as temporary, temporary.open("wb") as out:
            np.savez(out, **arrays)  # type: ignore[arg-type]
        _shrink(path)


@contextlib.contextmanager
def _alone(path: Path, *, patient: bool = True) -> Iterator[bool]:
    """Prevent other processes from building the same file, if the file system has locks.

    Yields:
        Whether this process may build it. False if another process is building it and `patient` is false.
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
    """Remove the least recently used files of the kind of `newest`, and unfinished files of killed processes."""
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
