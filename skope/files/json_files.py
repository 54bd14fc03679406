"""JSON as text and in files: strict when writing, tolerant of byte order marks when reading."""

import codecs
import contextlib
import json
from pathlib import Path
from typing import Any

from skope.errors import UserError
from skope.files.atomic import write_text


def json_bytes(value: Any) -> bytes:
    """Return compact JSON; NaN and infinities raise ValueError, because JSON does not have them."""
    import orjson

    with contextlib.suppress(TypeError):  # text that is not Unicode, such as some file names; more than 64 bits
        data = orjson.dumps(value)
        # orjson also writes null for NaN, which reads back as another value.
        if b"null" not in data or orjson.loads(data) == value:
            return data
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode()


def parse_json(data: bytes) -> Any:
    """Return the value of JSON text in UTF-8 (with or without a byte order mark), UTF-16 or UTF-32.

    Raises:
        json.JSONDecodeError: It is not JSON.
        UnicodeDecodeError: It is not in one of these encodings.
    """
    import orjson

    with contextlib.suppress(orjson.JSONDecodeError):
        return orjson.loads(data.removeprefix(codecs.BOM_UTF8))
    # NaN, which Python writes, is rejected by the caller, which knows the field's name.
    return json.loads(data)


def write_json(path: Path, value: Any) -> None:
    """Write indented JSON atomically; NaN and infinities, which JSON does not have, are rejected."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False) + "\n")


def read_json(path: Path) -> Any:
    """Read a JSON file. Raises UserError if the file is missing or malformed."""
    try:
        data = path.read_bytes()
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise UserError(f"{path}: is a folder, expected a JSON file") from None
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror or error}") from None
    try:
        return parse_json(data)
    except json.JSONDecodeError as error:
        raise UserError(f"{path}: not valid JSON: {error.msg} at line {error.lineno}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not valid JSON: not UTF-8 text") from None


def check_version(path: Path, found: Any, expected: int) -> None:
    """Reject a file of another version.

    Args:
        path: The file.
        found: Version in the file.
        expected: Supported version.

    Raises:
        UserError: They differ, or `found` is not a whole number.
    """
    if type(found) is not int or found != expected:
        raise UserError(f"{path}: version: expected {expected}, got {found!r:.60}")
