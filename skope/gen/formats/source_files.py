"""Files to read from, in a folder or in an archive."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Final, Protocol

from skope.errors import UserError
from skope.gen.formats.archive import Archive, opened

_LARGEST: Final = {".json": 1 << 31}
_LARGEST_OTHER: Final = 1 << 28
"""Bytes of a file that is unpacked into memory."""


class Files(Protocol):
    """Names with forward slashes, relative to where they lie."""

    where: Path

    def names(self, folder: str, suffix: str) -> list[str]:
        """Names of the files with that suffix that lie right in a folder."""
        ...

    def find(self, name: str) -> Path | bytes | None:
        """A file's path or content; None when it is not there."""
        ...


class InFolder:
    """Files below a folder."""

    def __init__(self, where: Path) -> None:
        self.where = where

    def names(self, folder: str, suffix: str) -> list[str]:
        found = (self.where / folder).glob(f"*{suffix}")
        return sorted(path.relative_to(self.where).as_posix() for path in found)

    def find(self, name: str) -> Path | bytes | None:
        path = self.where / name
        return path if path.is_file() else None


class InArchive:
    """Files of a zip archive."""

    def __init__(self, archive: Archive) -> None:
        self.where, self._archive = archive.path, archive

    def names(self, folder: str, suffix: str) -> list[str]:
        start = f"{folder}/" if folder else ""
        return sorted(
            name
            for name in self._archive.names
            if name.startswith(start) and name.endswith(suffix) and "/" not in name.removeprefix(start)
        )

    def find(self, name: str) -> Path | bytes | None:
        limit = _LARGEST.get(PurePosixPath(name).suffix, _LARGEST_OTHER)
        return self._archive.read(name, limit) if name in self._archive else None


@contextmanager
def files_at(path: Path) -> Iterator[Files]:
    """The files of a folder or zip archive."""
    if path.is_dir():
        yield InFolder(path)
    elif path.suffix.lower() == ".zip":
        with opened(path) as archive:
            yield InArchive(archive)
    else:
        raise UserError(f"{path}: {'expected a folder or a zip archive' if path.exists() else 'no such file'}")
