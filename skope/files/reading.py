"""Read users' files: what is missing or of another kind is a UserError that names the file."""

import hashlib
from pathlib import Path

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
