"""Check names that come from files: a name is never a path, and a relative path never leaves its folder.

Names of sites, recordings, splits and files are checked here before they become part of a path. Names are sorted in
natural order (2 before 10).
"""

import os
import re
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, Final

from skope.errors import UserError


@dataclass(frozen=True)
class NameLimits:
    """Limits of names and paths."""

    name_bytes: int = 100
    """Maximum length of a name, bytes: two names and a suffix fit into a file name."""
    part_bytes: int = 255
    """Maximum length of a file name, bytes."""
    path_bytes: int = 2000
    """Maximum length of a path, bytes."""


NAME_LIMITS: Final = NameLimits()

UNSAFE_NAME: Final = re.compile(r"\A\.{0,2}\Z|\A[A-Za-z]:|[\x00-\x1f\x7f-\x9f\u2028\u2029/\\]")
"""Rejected names: empty text, a folder itself or its parent, a drive; control characters, line ends and separators."""


def name(field: str, value: Any) -> str:
    """Return `value` if it is a plain file name. Otherwise raise a UserError that names the field.

    Hidden names, which begin with a dot, are rejected.
    """
    if not isinstance(value, str) or value.startswith(".") or not _is_part(value, NAME_LIMITS.name_bytes):
        raise UserError(
            f"{field}: expected a name of up to {NAME_LIMITS.name_bytes} bytes without slashes, control "
            f"characters or a leading dot, got {_short(value)}"
        )
    return value


def relative(field: str, value: Any) -> str:
    """Return `value` if it is a path inside a dataset folder. Otherwise raise a UserError that names the field."""
    if not is_relative(value):
        raise UserError(f"{field}: expected a path inside the dataset folder, got {_short(value)}")
    return str(value)


def is_relative(value: Any) -> bool:
    """Return whether `value` is a path with forward slashes that stays inside the folder it is relative to."""
    if not isinstance(value, str) or len(value) > NAME_LIMITS.path_bytes:
        return False
    parts = PurePosixPath(value).parts
    return bool(parts) and all(_is_part(part, NAME_LIMITS.part_bytes) for part in parts)


def counting_order(path: Path | str) -> list[str | int]:
    """Return a key that sorts paths with their numbers in numerical order: 2.jpg before 10.jpg."""
    text = path.as_posix() if isinstance(path, Path) else path
    words = re.split(r"([0-9]+)", text)
    return [int(word) if i % 2 else word for i, word in enumerate(words)] + [text]


def for_opencv(path: Path | str) -> str:
    """Return a path as text for OpenCV.

    Raises UserError if the path is not UTF-8, because OpenCV would end the process.
    """
    return _in_utf8(path, "OpenCV")


def for_ffmpeg(path: Path | str) -> str:
    """Return a path as text for FFmpeg. Raises UserError if the path is not UTF-8."""
    return _in_utf8(path, "FFmpeg")


def _in_utf8(path: Path | str, program: str) -> str:
    try:
        str(path).encode()
    except UnicodeEncodeError:
        raise UserError(f"{path}: {program} takes no path that is not UTF-8; choose another name") from None
    return str(path)


def _is_part(text: str, most: int) -> bool:
    """Return whether text can be one component of a path with at most this many bytes."""
    try:
        return not UNSAFE_NAME.search(text) and len(os.fsencode(text)) <= most
    except UnicodeEncodeError:  # a lone surrogate, which no file system can store
        return False


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
