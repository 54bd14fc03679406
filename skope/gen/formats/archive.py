"""Zip archives of strangers: read with limits, and without letting a member's name mean anything but a name."""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from skope.errors import UserError
from skope.files import replacing
from skope.safe_names import is_relative

MEMBERS: Final = 2_000_000
"""Most members of an archive."""
RATIO: Final = 200
"""Most times its packed size that a member larger than `FREE` may unpack to."""
FREE: Final = 1 << 20
LARGEST: Final = 64 << 30
"""Bytes of the largest member."""
_CHUNK: Final = 1 << 20
_LINK: Final = 0o120000
_KIND: Final = 0o170000


class Archive:
    """A zip file whose directory was checked; members are read whole into memory or streamed to a file."""

    def __init__(self, path: Path, file: zipfile.ZipFile) -> None:
        self.path, self._file = path, file
        infos = file.infolist()
        if len(infos) > MEMBERS:
            raise UserError(f"{path}: has {len(infos)} members, more than {MEMBERS}")
        self._infos: dict[str, zipfile.ZipInfo] = {}
        self.folders: set[str] = set()
        for info in infos:
            self._check(info)
            if info.is_dir():
                self.folders.add(info.filename.rstrip("/"))
            elif info.filename in self._infos:
                raise UserError(f"{path}: member {info.filename} stands twice")
            else:
                self._infos[info.filename] = info

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
            file.writelines(self._chunks(name, LARGEST))

    def _chunks(self, name: str, limit: int) -> Iterator[bytes]:
        if name not in self._infos:
            raise UserError(f"{self.path}: has no member {name}")
        info, done = self._infos[name], 0
        if info.file_size > limit:
            raise UserError(f"{self.path}: member {name}: {info.file_size} bytes, more than {limit}")
        try:
            with self._file.open(info) as member:
                while chunk := member.read(_CHUNK):
                    done += len(chunk)
                    yield chunk
        except (zipfile.BadZipFile, zlib.error, EOFError, OSError, NotImplementedError, RuntimeError) as error:
            raise UserError(f"{self.path}: member {name}: cannot be unpacked: {error or 'truncated'}") from None
        if done != info.file_size:
            raise UserError(f"{self.path}: member {name}: truncated")

    def _check(self, info: zipfile.ZipInfo) -> None:
        name, where = info.filename, f"{self.path}: member {info.filename!r}"
        if not is_relative(name):
            raise UserError(f"{where}: its name leads out of the archive")
        if info.external_attr >> 16 & _KIND == _LINK:
            raise UserError(f"{where}: is a link")
        if info.flag_bits & 1:
            raise UserError(f"{where}: is encrypted")
        if info.file_size > max(FREE, RATIO * info.compress_size):
            raise UserError(f"{where}: {info.compress_size} bytes would unpack to {info.file_size}: refused")


@contextmanager
def opened(path: Path) -> Iterator[Archive]:
    """An archive to read from; a UserError names the file when it is none, or one that is not to be trusted."""
    try:
        file = zipfile.ZipFile(path)
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (zipfile.BadZipFile, OSError, ValueError, NotImplementedError) as error:
        raise UserError(f"{path}: not a zip archive, or a truncated one ({error})") from None
    with file:
        yield Archive(path, file)


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
                    while chunk := source.read(_CHUNK):
                        member.write(chunk)
            elif not any(path.iterdir()):
                file.writestr(zipfile.ZipInfo(f"{name}/"), b"")
