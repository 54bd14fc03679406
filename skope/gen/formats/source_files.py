"""Source files in a folder or in an archive.

Zip archives are not trusted. They are read with limits, and a member's name is only used as a name. Names are read as
their writers meant them. They may have backslashes, as some Windows programs write them, and be in UTF-8 without the
flag for it. Files that operating systems add (`__MACOSX/`, hidden files, thumbnails) are ignored.
"""

import re
import unicodedata
import zipfile
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePosixPath
from typing import Final, Protocol

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.files.safe_names import is_relative
from skope.gen.formats import file_name_rules


@dataclass(frozen=True)
class ArchiveLimits:
    """Limits of archives, and fields of their headers."""

    most_members: int = 2_000_000
    """Maximum number of members of an archive."""
    largest_ratio: int = 200
    """Maximum ratio of unpacked to packed size of a member larger than `free_bytes`."""
    free_bytes: int = 1 << 20
    """Maximum unpacked size of a member with any ratio, bytes."""
    largest_member_bytes: int = 64 << 30
    """Maximum size of a member, bytes."""
    chunk_bytes: int = 1 << 20
    """Number of bytes per read."""
    utf8_flag: int = 0x800
    link_kind: int = 0o120000
    kind_mask: int = 0o170000
    largest_in_memory_bytes: int = 1 << 28
    """Maximum size of a file that is unpacked to memory, bytes."""


ARCHIVE_LIMITS: Final = ArchiveLimits()

_OF_SYSTEMS: Final = ("__MACOSX", "Thumbs.db", "desktop.ini")


class Archive:
    """Zip file with a checked directory; members are read whole to memory or streamed to a file."""

    def __init__(self, path: Path, file: zipfile.ZipFile) -> None:
        self.path, self._file = path, file
        infos = file.infolist()
        if len(infos) > ARCHIVE_LIMITS.most_members:
            raise UserError(f"{path}: has {len(infos)} members, more than {ARCHIVE_LIMITS.most_members}")
        self._infos: dict[str, zipfile.ZipInfo] = {}
        self.folders: set[str] = set()
        for info in infos:
            name = _member_name(info)
            if not name and info.filename:  # the archive's own folder, ./
                continue
            if not is_relative(name):
                raise UserError(f"{path}: member {info.filename!r}: its name {_fault_of_name(name)}")
            if added_by_system(name):
                continue
            self._check(info)
            if name.endswith("/"):
                self.folders.add(name.rstrip("/"))
            elif name in self._infos:
                raise UserError(f"{path}: member {name} is a duplicate")
            else:
                self._infos[name] = info

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of the files, in the archive's order."""
        return tuple(self._infos)

    def __contains__(self, name: str) -> bool:
        return name in self._infos

    def read(self, name: str, limit: int) -> bytes:
        """Return a member's bytes.

        Raises:
            UserError: The member is missing, broken or longer than `limit`.
        """
        return b"".join(self._chunks(name, limit))

    def extract(self, name: str, target: Path) -> None:
        """Write a member to a file."""
        with replacing(target) as temporary, temporary.open("wb") as file:
            file.writelines(self._chunks(name, ARCHIVE_LIMITS.largest_member_bytes))

    def _chunks(self, name: str, limit: int) -> Iterator[bytes]:
        if name not in self._infos:
            raise UserError(f"{self.path}: has no member {name}")
        info, done = self._infos[name], 0
        if info.file_size > limit:
            raise UserError(f"{self.path}: member {name}: {info.file_size} bytes, more than {limit}")
        try:
            with self._file.open(info) as member:
                while chunk := member.read(ARCHIVE_LIMITS.chunk_bytes):
                    done += len(chunk)
                    yield chunk
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as error:
            raise UserError(f"{self.path}: member {name}: cannot be unpacked: {error or 'truncated'}") from None
        if done != info.file_size:
            raise UserError(f"{self.path}: member {name}: truncated")

    def _check(self, info: zipfile.ZipInfo) -> None:
        where = f"{self.path}: member {info.filename!r}"
        if info.external_attr >> 16 & ARCHIVE_LIMITS.kind_mask == ARCHIVE_LIMITS.link_kind:
            raise UserError(f"{where}: is a link")
        if info.flag_bits & 1:
            raise UserError(f"{where}: is encrypted")
        if info.file_size > max(ARCHIVE_LIMITS.free_bytes, ARCHIVE_LIMITS.largest_ratio * info.compress_size):
            raise UserError(f"{where}: {info.compress_size} bytes would unpack to {info.file_size}: rejected")


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """Open an archive for reading.

    Raises:
        UserError: The file is not an archive, or not safe to read.
    """
    try:
        file = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        kind = "a truncated zip archive (its end is missing)" if _begins_as_zip(path) else "not a zip archive"
        raise UserError(f"{path}: {kind} ({error})") from None
    with file:
        yield Archive(path, file)


def _begins_as_zip(path: Path) -> bool:
    """Return whether a file begins as zip archives do."""
    with suppress(OSError), path.open("rb") as file:
        return file.read(4) == b"PK\x03\x04"
    return False


def _member_name(info: zipfile.ZipInfo) -> str:
    """Return a member's name with forward slashes; a folder's name ends in one."""
    name = info.orig_filename
    if not info.flag_bits & ARCHIVE_LIMITS.utf8_flag:  # zipfile has decoded its bytes with an old code page
        with suppress(UnicodeError):
            name = name.encode("cp437").decode("utf-8")
    name = name.replace("\\", "/")
    while name.startswith("./"):
        name = name.removeprefix("./").lstrip("/")
    return name


def _fault_of_name(name: str) -> str:
    """Return why an invalid name cannot be that of a file below a folder, in words."""
    leads_out = name.startswith("/") or ".." in name.split("/") or re.match(r"[A-Za-z]:", name)
    return "leads out of the archive" if leads_out else "cannot be a file's (control characters, or too long)"


def added_by_system(name: str) -> bool:
    """Return whether a path with forward slashes is hidden, or that of a file that an operating system added."""
    parts = [part for part in name.split("/") if part]
    return any(part.startswith(".") or part in _OF_SYSTEMS for part in parts)


def zipped(folder: Path, target: Path) -> None:
    """Write the files of a folder as an archive; equal files give equal bytes. Images are not compressed further."""
    with replacing(target) as temporary, zipfile.ZipFile(temporary, "w") as file:
        for path in sorted(folder.rglob("*")):
            name = path.relative_to(folder).as_posix()
            if path.is_file():
                kind = zipfile.ZIP_STORED if path.suffix in (".jpg", ".png", ".avi") else zipfile.ZIP_DEFLATED
                info = zipfile.ZipInfo(name)
                info.compress_type = kind
                with path.open("rb") as source, file.open(info, "w", force_zip64=True) as member:
                    while chunk := source.read(ARCHIVE_LIMITS.chunk_bytes):
                        member.write(chunk)
            elif not any(path.iterdir()):
                file.writestr(zipfile.ZipInfo(f"{name}/"), b"")


_LARGEST_BYTES: Final = {".json": 1 << 31}


class Files(Protocol):
    """Files by name with forward slashes, relative to their folder.

    A name matches the file of that name in any Unicode normal form, because some systems store letters and accents
    separately. Hidden files, and files that operating systems add, are left out.
    """

    where: Path

    def names(self, folder: str, suffix: str) -> list[str]:
        """Return the names of the files with a suffix that are directly in a folder ("" for the top folder)."""
        ...

    def folders(self) -> list[str]:
        """Return the names of the folders directly below the top folder."""
        ...

    def has(self, name: str) -> bool:
        """Return whether the file exists."""
        ...

    def find(self, name: str) -> Path | bytes | None:
        """Return a file's path or content; None if it does not exist."""
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
    """Files of a zip archive. If all of them are in one folder, names are relative to that folder."""

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
        limit = _LARGEST_BYTES.get(PurePosixPath(name).suffix, ARCHIVE_LIMITS.largest_in_memory_bytes)
        member = self._names.get(_composed(name))
        return None if member is None else self._archive.read(member, limit)


def _composed(name: str) -> str:
    return name if name.isascii() else unicodedata.normalize("NFC", name)


def _by_composed_names(folder: Path) -> dict[str, str]:
    """Return the names of the entries of a folder, by their composed forms."""
    try:
        return {_composed(path.name): path.name for path in folder.iterdir()}
    except OSError:
        return {}


def first(files: Files, names: Iterable[str]) -> Path | bytes | None:
    """Return the first of several files that exists."""
    return next((found for name in names if (found := files.find(name)) is not None), None)


@contextmanager
def files_at(path: Path) -> Iterator[Files]:
    """Open the files of a folder or zip archive."""
    if path.is_dir():
        yield InFolder(path)
    elif path.suffix.lower() == ".zip":
        with opened(path) as archive:
            yield InArchive(archive)
    else:
        raise UserError(f"{path}: {'expected a folder or a zip archive' if path.exists() else 'no such file'}")
