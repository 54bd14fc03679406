"""Files to read from, in a folder or in an archive."""

import unicodedata
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Final, Protocol

from skope.errors import UserError
from skope.gen.formats import file_name_rules
from skope.gen.formats.archive import Archive, added_by_system, opened

_LARGEST_BYTES: Final = {".json": 1 << 31}
_LARGEST_OTHER: Final = 1 << 28
"""Bytes of a file that is unpacked into memory."""


class Files(Protocol):
    """Names with forward slashes, relative to where they lie.

    A name finds the file of that name in any Unicode normal form: some systems store letters and their accents apart.
    Hidden files, and what operating systems add, are not among them.
    """

    where: Path

    def names(self, folder: str, suffix: str) -> list[str]:
        """Names of the files with that suffix that lie right in a folder ("" for the first one)."""
        ...

    def folders(self) -> list[str]:
        """Names of the folders right below the first one."""
        ...

    def has(self, name: str) -> bool:
        """Whether there is such a file."""
        ...

    def find(self, name: str) -> Path | bytes | None:
        """A file's path or content; None when it is not there."""
        ...


class InFolder:
    """Files below a folder."""

    def __init__(self, where: Path) -> None:
        self.where = where
        self._listed = lru_cache(maxsize=256)(_by_composed_names)

    def names(self, folder: str, suffix: str) -> list[str]:
        found = (path for path in (self.where / folder).glob(f"*{suffix}") if not added_by_system(path.name))
        return sorted(path.relative_to(self.where).as_posix() for path in found)

    def folders(self) -> list[str]:
        return sorted(path.name for path in self.where.iterdir() if path.is_dir() and not added_by_system(path.name))

    def has(self, name: str) -> bool:
        return self.find(name) is not None

    def find(self, name: str) -> Path | None:
        path = self.where / name
        if path.is_file():
            return path
        if name.isascii():
            return None
        path = self.where
        for part in PurePosixPath(name).parts:
            path = path / self._listed(path).get(_composed(part), part)
        return path if path.is_file() else None


class InArchive:
    """Files of a zip archive. Where all of them lie in one folder, names are relative to that."""

    def __init__(self, archive: Archive) -> None:
        self.where, self._archive = archive.path, archive
        tops = {name.partition("/")[0] for name in archive.names}
        self._top = f"{tops.pop()}/" if len(tops) == 1 and all("/" in name for name in archive.names) else ""
        if self._top in ("annotations/", "images/") or file_name_rules.named_split(self._top.rstrip("/")):
            self._top = ""
        self._names = {_composed(name.removeprefix(self._top)): name for name in archive.names}

    def names(self, folder: str, suffix: str) -> list[str]:
        start = f"{folder}/" if folder else ""
        return sorted(
            name
            for name in self._names
            if name.startswith(start) and name.endswith(suffix) and "/" not in name.removeprefix(start)
        )

    def folders(self) -> list[str]:
        return sorted({name.partition("/")[0] for name in self._names if "/" in name})

    def has(self, name: str) -> bool:
        return _composed(name) in self._names

    def find(self, name: str) -> bytes | None:
        limit = _LARGEST_BYTES.get(PurePosixPath(name).suffix, _LARGEST_OTHER)
        member = self._names.get(_composed(name))
        return None if member is None else self._archive.read(member, limit)


def _composed(name: str) -> str:
    return name if name.isascii() else unicodedata.normalize("NFC", name)


def _by_composed_names(folder: Path) -> dict[str, str]:
    """Names of what lies in a folder, by their composed forms."""
    try:
        return {_composed(path.name): path.name for path in folder.iterdir()}
    except OSError:
        return {}


def first(files: Files, names: Iterable[str]) -> Path | bytes | None:
    """The first of several files that is there."""
    return next((found for name in names if (found := files.find(name)) is not None), None)


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
