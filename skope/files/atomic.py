"""Read users' files, and write files and folders so that nothing half-written is ever taken for whole."""

import contextlib
import fcntl
import hashlib
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Final

from skope.errors import UserError


def decoded(data: bytes) -> str:
    """UTF-8 text, without the byte order mark that some editors put first; UnicodeDecodeError where it is none."""
    return data.decode("utf-8-sig")


def read_text(path: Path) -> str:
    """The text of a user's file in UTF-8; a UserError names a file that is missing or holds anything else."""
    try:
        return decoded(read_bytes(path))
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8 text") from None


def sha256_of(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal; a UserError names one that cannot be read."""
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None


LEFTOVER_NAME: Final = re.compile(r"\..*\.(\d+)\.part(?:\..*)?")
"""Names that `replacing` gives to incomplete files."""


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; on success rename it into place, on failure remove it.

    The temporary name keeps the suffix, because encoders (OpenCV, numpy) choose the format by it. Raises UserError
    where `path` cannot be written; an error that is of another file, or of a closed pipe, keeps its own name.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        with writing(path, temporary):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.unlink(missing_ok=True)  # a symbolic link would be written through
            yield temporary
            temporary.replace(path)
    finally:
        with contextlib.suppress(OSError):  # where a parent is a file, even looking for it fails
            temporary.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove what a process that was killed while it wrote by `replacing` has left in a folder.

    What a process that still lives is writing stays.
    """
    for path in folder.glob(".*.part*"):
        found = LEFTOVER_NAME.fullmatch(path.name)
        if found and path.is_file() and not _lives(int(found[1])):
            path.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    """Whether there is such a process on this machine."""
    try:
        with contextlib.suppress(PermissionError, OverflowError):
            os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@contextlib.contextmanager
def replacing_folder(path: Path, *, keep: bool = True) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success it takes its place, unless the same is there already.

    On failure, or without `keep`, it is removed. Raises UserError where `path` is a file, or holds anything else. Where
    `path` is a link to a folder, that folder is replaced and the link stays.
    """
    whole = path.resolve() if path.is_dir() else path.absolute()
    temporary = whole.with_name(f".{whole.name}.{os.getpid()}.part")
    try:
        with writing(path, temporary):
            if keep and os.path.lexists(path) and not path.is_dir():
                kind = "a file" if path.exists() else "a link to what is not there"
                raise UserError(f"{path}: is {kind}; choose another folder")
            temporary.mkdir(parents=True)
            yield temporary
            if not keep or same_content(path, temporary):
                return
            if path.is_dir() and any(path.iterdir()):
                raise UserError(
                    f"{path}: holds other files than these; choose another folder, or move its content away"
                )
            temporary.replace(whole)
    except UserError as error:  # what could not be written has its name below `path` for the user
        raise UserError(str(error).replace(str(temporary), str(path))) from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


@contextlib.contextmanager
def writing(path: Path, *parts: Path) -> Iterator[None]:
    """Turn errors while the file or folder `path` is written into a UserError that names it.

    Errors of other files that are read meanwhile keep their own names. A closed output pipe is not an error of `path`.
    `parts` are temporary paths that are renamed to `path`.
    """
    try:
        yield
    except BrokenPipeError:
        raise
    except OSError as error:
        own = {place.absolute() for place in (path, *parts)}
        other = Path(os.fsdecode(error.filename)).absolute() if isinstance(error.filename, str | bytes) else None
        if other is None or own & {other, *other.parents} or other in path.absolute().parents:
            raise unwritable(path, error) from error
        raise UserError(f"{other}: {error.strerror or error}") from error


def unwritable(path: Path, error: OSError) -> UserError:
    """The error to raise where the file or folder `path` cannot be written; says which file stands in a folder's
    place."""
    misplaced = isinstance(error, FileExistsError | NotADirectoryError)
    file = file_in_place_of(path) if misplaced else None
    return UserError(f"{path}: cannot be written: {f'{file} is a file' if file else error.strerror or error}")


def file_in_place_of(folder: Path) -> Path | None:
    """The file that stands where `folder`, or a folder above it, should be; None where nothing does."""
    for path in (folder, *folder.parents):
        with contextlib.suppress(OSError):  # a folder that may not be looked into
            if path.exists() and not path.is_dir():
                return path
    return None


def same_content(one: Path, other: Path) -> bool:
    """Whether two files have the same bytes, or two folders the same files and folders with the same bytes."""
    if one.is_file() and other.is_file():
        same_size = one.stat().st_size == other.stat().st_size
        return one.samefile(other) or (same_size and sha256_of(one) == sha256_of(other))
    if not (one.is_dir() and other.is_dir()):
        return False
    names = {path.name for path in one.iterdir()}
    return names == {path.name for path in other.iterdir()} and all(
        same_content(one / name, other / name) for name in names
    )


def hold_lock(path: Path, *, wait: bool = False) -> IO[bytes]:
    """Open a file and hold its lock until the file is closed or the process ends, however it ends.

    A process may remove the file that it held. Another one that waited then holds a file without a name, and a third
    one could hold a new file of this name. Such a file is opened again.

    Args:
        path: The file; it is made where it is missing, and keeps its content where it is there.
        wait: Whether to wait for a process that holds the lock.

    Returns:
        The file, open for reading from its begin and for appending.

    Raises:
        BlockingIOError: Another process holds the lock, and `wait` is false.
        OSError: The file cannot be opened (as where it is a symbolic link), or its file system has no locks.
    """
    while True:
        file = os.fdopen(os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NOFOLLOW, 0o666), "a+b")
        try:
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
            if path.exists() and os.path.samestat(os.fstat(file.fileno()), path.stat()):
                file.seek(0)
                return file
        except BaseException:
            file.close()
            raise
        file.close()


@contextlib.contextmanager
def locked(path: Path, busy: str) -> Iterator[None]:
    """Hold the lock of the file `path`, and remove the file at the end.

    Raises:
        UserError: Another process holds the lock; the message is `busy`.
    """
    try:
        file = hold_lock(path)
    except BlockingIOError:
        raise UserError(busy) from None
    with file:
        try:
            yield
        finally:
            path.unlink(missing_ok=True)


def no_links_out(root: Path) -> None:
    """Raise a UserError where a folder below `root` is a symbolic link to elsewhere: what is written would land there.

    Links to files are no danger: files are replaced and removed by their names.
    """
    whole = root.resolve()
    for folder, below, _ in os.walk(root):
        for path in (Path(folder, name) for name in below):
            if path.is_symlink() and not path.resolve().is_relative_to(whole):
                raise UserError(f"{path}: is a link that leads out of {root}: nothing is written or removed there")


def link(source: Path, target: Path) -> None:
    """Make `target` the same file as `source`, or a copy of it where the file system cannot link.

    Where `source` is a symbolic link, `target` becomes the file that it leads to: the link itself may lead nowhere from
    there. Raises UserError where `source` is not there, or another file at `target`.
    """
    if os.path.lexists(target):
        if same_content(source, target):
            return
        raise UserError(f"{target}: two different files would have this name ({source} is the second)")
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        target.hardlink_to(os.path.realpath(source, strict=True) if source.is_symlink() else source)
    except OSError:
        write_bytes(target, read_bytes(source))


def write_bytes(path: Path, data: bytes | memoryview) -> None:
    """Write a file atomically."""
    with replacing(path) as temporary:
        temporary.write_bytes(data)


def write_text(path: Path, text: str) -> None:
    """Write UTF-8 text atomically."""
    with replacing(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
