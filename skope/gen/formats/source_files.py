"""Files to read from, in a folder or in an archive. Zip archives are of strangers: they are read with limits, and
without letting a member's name mean anything but a name.

Names are read as their writers meant them: with backslashes, as some programs of Windows write them, and in UTF-8 where
the flag that says so is missing. What operating systems add (`__MACOSX/`, hidden files, thumbnails) is left alone.
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
    """Largest ratio of unpacked to packed size of a member larger than `free_bytes`."""
    free_bytes: int = 1 << 20
    """Bytes up to which a member is unpacked whatever its ratio."""
    largest_member_bytes: int = 64 << 30
    """Bytes of the largest member."""
    chunk_bytes: int = 1 << 20
    """Bytes that are read at once."""
    utf8_flag: int = 0x800
    link_kind: int = 0o120000
    kind_mask: int = 0o170000
    largest_in_memory_bytes: int = 1 << 28
    """Bytes of a file that is unpacked into memory."""


ARCHIVE_LIMITS: Final = ArchiveLimits()

_OF_SYSTEMS: Final = ("__MACOSX", "Thumbs.db", "desktop.ini")


class Archive:
    """A zip file whose directory was checked; members are read whole into memory or streamed to a file."""

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
                raise UserError(f"{path}: member {name} stands twice")
            else:
                self._infos[name] = info

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the files, in the archive's order."""
        return tuple(self._infos)

    def __contains__(self, name: str) -> bool:
        return name in self._infos

    def read(self, name: str, limit: int) -> bytes:
        """A member's bytes; a UserError when there is none, or it is broken or longer than `limit`."""
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
            raise UserError(f"{where}: {info.compress_size} bytes would unpack to {info.file_size}: refused")


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """An archive to read from; a UserError names the file when it is none, or one that is not to be trusted."""
    try:
        file = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        kind = "a zip archive without its end, so truncated" if _begins_as_zip(path) else "not a zip archive"
        raise UserError(f"{path}: {kind} ({error})") from None
    with file:
        yield Archive(path, file)


def _begins_as_zip(path: Path) -> bool:
    """Whether a file begins as zip archives do."""
    with suppress(OSError), path.open("rb") as file:
        return file.read(4) == b"PK\x03\x04"
    return False


def _member_name(info: zipfile.ZipInfo) -> str:
    """A member's name with forward slashes; a folder's ends in one."""
    name = info.orig_filename
    if not info.flag_bits & ARCHIVE_LIMITS.utf8_flag:  # then zipfile has taken its bytes for those of an old code page
        with suppress(UnicodeError):
            name = name.encode("cp437").decode("utf-8")
    name = name.replace("\\", "/")
    while name.startswith("./"):
        name = name.removeprefix("./").lstrip("/")
    return name


def _fault_of_name(name: str) -> str:
    """Why a name is none for a file below a folder, in words."""
    leads_out = name.startswith("/") or ".." in name.split("/") or re.match(r"[A-Za-z]:", name)
    return "leads out of the archive" if leads_out else "cannot be a file's (control characters, or too long)"


def added_by_system(name: str) -> bool:
    """Whether a path with forward slashes is that of a file which no person put there."""
    parts = [part for part in name.split("/") if part]
    return any(part.startswith(".") or part in _OF_SYSTEMS for part in parts)


def zipped(folder: Path, target: Path) -> None:
    """Write the files of a folder as an archive, equal files as equal bytes; pictures do not shrink any further."""
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
        limit = _LARGEST_BYTES.get(PurePosixPath(name).suffix, ARCHIVE_LIMITS.largest_in_memory_bytes)
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
