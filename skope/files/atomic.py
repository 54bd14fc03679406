"""Read users' files, and write files and folders atomically, so that no partial file is mistaken for a complete one."""

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
    """Return UTF-8 text without a byte order mark, which some editors add; raise UnicodeDecodeError for other text."""
    return data.decode("utf-8-sig")


def read_text(path: Path) -> str:
    """Return the text of a user's file. Raises UserError if the file is missing or is not UTF-8."""
    try:
        return decoded(read_bytes(path))
    except UnicodeDecodeError:
        raise UserError(f"{path}: not UTF-8 text") from None


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal. Raises UserError if the file cannot be read."""
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
    """Yield a temporary path beside `path`; on success rename it to `path`, on failure remove it.

    The temporary name keeps the suffix, because encoders (OpenCV, numpy) choose the format by it.

    Raises:
        UserError: `path` cannot be written. Errors of other files, or of a closed pipe, keep their own names.
    """
    temporary = path.with_name(f".{path.stem}.{os.getpid()}.part{path.suffix}")
    try:
        with writing(path, temporary):
            path.parent.mkdir(parents=True, exist_ok=True)
            temporary.unlink(missing_ok=True)  # a symbolic link would be followed
            yield temporary
            temporary.replace(path)
    finally:
        with contextlib.suppress(OSError):  # if a parent is a file, even the check fails
            temporary.unlink()


def remove_leftovers(folder: Path) -> None:
    """Remove incomplete files of `replacing` that killed processes have left in a folder.

    Files of processes that still run are kept.
    """
    for path in folder.glob(".*.part*"):
        found = LEFTOVER_NAME.fullmatch(path.name)
        if found and path.is_file() and not _lives(int(found[1])):
            path.unlink(missing_ok=True)


def _lives(pid: int) -> bool:
    """Return whether a process with this id exists on this machine."""
    try:
        with contextlib.suppress(PermissionError, OverflowError):
            os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


@contextlib.contextmanager
def replacing_folder(path: Path, *, keep: bool = True) -> Iterator[Path]:
    """Yield a temporary folder beside `path`; on success it replaces `path`, unless that has the same content.

    On failure, or without `keep`, it is removed. If `path` is a link to a folder, that folder is replaced and the link
    stays.

    Raises:
        UserError: `path` is a file, or has other content.
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
    except UserError as error:  # messages name the file below `path`, not below the temporary folder
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
        written_paths = {written.absolute() for written in (path, *parts)}
        error_path = Path(os.fsdecode(error.filename)).absolute() if isinstance(error.filename, str | bytes) else None
        if (
            error_path is None
            or written_paths & {error_path, *error_path.parents}
            or error_path in path.absolute().parents
        ):
            raise unwritable(path, error) from error
        raise UserError(f"{error_path}: {error.strerror or error}") from error


def unwritable(path: Path, error: OSError) -> UserError:
    """Return the error for a file or folder `path` that cannot be written; it names a file in place of a folder."""
    misplaced = isinstance(error, FileExistsError | NotADirectoryError)
    file = file_in_place_of(path) if misplaced else None
    return UserError(f"{path}: cannot be written: {f'{file} is a file' if file else error.strerror or error}")


def file_in_place_of(folder: Path) -> Path | None:
    """Return the file that is in place of `folder` or of a folder above it; None if there is none."""
    for path in (folder, *folder.parents):
        with contextlib.suppress(OSError):  # a folder without read permission
            if path.exists() and not path.is_dir():
                return path
    return None


def same_content(first: Path, second: Path) -> bool:
    """Return whether two files have the same bytes, or two folders the same names with the same bytes."""
    if first.is_file() and second.is_file():
        same_size = first.stat().st_size == second.stat().st_size
        return first.samefile(second) or (same_size and sha256_of(first) == sha256_of(second))
    if not (first.is_dir() and second.is_dir()):
        return False
    names = {path.name for path in first.iterdir()}
    return names == {path.name for path in second.iterdir()} and all(
        same_content(first / name, second / name) for name in names
    )


def hold_lock(path: Path, *, wait: bool = False) -> IO[bytes]:
    """Open a file and hold its lock until the file is closed or the process ends in any way.

    A process may remove the file that it has locked. Another process that waited then holds a file without a name, and
    a third could lock a new file of that name. In this case the file is opened again.

    Args:
        path: The file; it is created if missing and keeps its content otherwise.
        wait: Whether to wait for a process that holds the lock.

    Returns:
        The file, open for reading from its start and for appending.

    Raises:
        BlockingIOError: Another process holds the lock, and `wait` is false.
        OSError: The file cannot be opened (for example because it is a symbolic link), or its file system has no locks.
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
    """Raise a UserError if a folder below `root` is a symbolic link to another place, where files would be written.

    Links to files are harmless, because files are replaced and removed by name.
    """
    whole = root.resolve()
    for folder, below, _ in os.walk(root):
        for path in (Path(folder, name) for name in below):
            if path.is_symlink() and not path.resolve().is_relative_to(whole):
                raise UserError(f"{path}: is a link that leads out of {root}: nothing is written or removed there")


def link(source: Path, target: Path) -> None:
    """Make `target` a hard link to `source`, or a copy if the file system does not support links.

    If `source` is a symbolic link, `target` becomes the file that it refers to, because the link may not be valid
    there.

    Raises:
        UserError: `source` does not exist, or another file exists at `target`.
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
