"""A TOML file's tables, read key by key: whatever is wrong is a UserError that names file and key."""

import math
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final, Self

from skope.errors import UserError
from skope.field_checks import is_number
from skope.files.atomic import read_text

_LARGEST_NUMBER: Final = 1e300
_MOST_SHOWN: Final = 60
"""Letters of a wrong value that a message shows."""


class TomlTable:
    """A TOML table; `done` refuses the keys that were not read."""

    def __init__(self, path: Path, name: str, values: Mapping[str, Any], files: dict[str, Path] | None = None) -> None:
        """`files` collects the files that are named, by their keys."""
        self.path, self._name, self._values = path, name, dict(values)
        self.files: dict[str, Path] = {} if files is None else files
        self._asked: set[str] = set()

    @classmethod
    def read(cls, path: Path) -> Self:
        return cls.parse(path, read_text(path))

    @classmethod
    def parse(cls, path: Path, text: str) -> Self:
        """The table of a file's text; `path` is what messages name and what paths in it are relative to."""
        try:
            return cls(path, "", tomllib.loads(text))
        except ValueError as error:  # also of numbers with more digits than Python takes
            raise UserError(f"{path}: not valid TOML: {error}") from None
        except RecursionError:
            raise UserError(f"{path}: not valid TOML: nested too deeply") from None

    def wrong(self, key: str, text: str) -> UserError:
        where = ".".join(part for part in (self._name, key) if part)
        return UserError(f"{self.path}: {where}: {text}" if where else f"{self.path}: {text}")

    def __contains__(self, key: str) -> bool:
        self._asked.add(key)
        return key in self._values

    def value(self, key: str) -> Any:
        """The value of a key, of any type; None where the key is missing."""
        return self._values[key] if key in self else None

    def text(self, key: str, default: str = "") -> str:
        value = self.value(key) if key in self else default
        if not isinstance(value, str):
            raise self.wrong(key, f"expected a text, got {shown(value)}")
        return value

    def flag(self, key: str) -> bool:
        value = self.value(key) if key in self else False
        if not isinstance(value, bool):
            raise self.wrong(key, f"expected true or false, got {shown(value)}")
        return value

    def number(
        self, key: str, default: float | None = None, *, low: float = -math.inf, high: float = math.inf
    ) -> float:
        """Read a number.

        Args:
            key: Key of the table.
            default: Value of a key that is missing; None: it must be there.
            low: Least value.
            high: Largest value.

        Raises:
            UserError: The key is missing, or is no finite number in these limits.
        """
        if key not in self and default is not None:
            return default
        return self._checked(key, self.value(key), low, high)

    def _checked(self, key: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
        # Whole numbers have any length in TOML: those that no float holds are no numbers here.
        if not is_number(value) or abs(value) >= _LARGEST_NUMBER or not low <= value <= high:
            limits = "" if (low, high) == (-math.inf, math.inf) else f" from {low:g} to {high:g}"
            raise self.wrong(key, f"expected a number{limits}, got {shown(value)}" if key in self else "missing")
        return float(value)

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        value = self.value(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.wrong(key, f"expected {count} numbers, got {shown(value)}" if key in self else "missing")
        return tuple(self._checked(key, item) for item in value)

    def matrix(self, key: str, rows: int, columns: int) -> list[tuple[float, ...]]:
        """Read a matrix.

        Args:
            key: Key of the table.
            rows: Number of rows.
            columns: Number of columns.

        Returns:
            The rows.

        Raises:
            UserError: It is not a list of so many rows of numbers.
        """
        value = self.value(key)
        right = isinstance(value, list) and len(value) == rows
        if not right or any(not isinstance(row, list) or len(row) != columns for row in value):
            raise self.wrong(key, f"expected {rows} rows of {columns} numbers")
        return [tuple(self._checked(key, item) for item in row) for row in value]

    def file(self, key: str) -> Path | None:
        """The path of a file that is there, relative to this one."""
        if key not in self:
            return None
        path = self.path.parent / self.text(key)
        if not path.is_file():
            raise self.wrong(key, f"{path}: no such file")
        self.files[f"{self._name}.{key}".lstrip(".")] = path
        return path

    def table(self, key: str) -> "TomlTable":
        """A table in this one; an empty one when it is not there."""
        value = self.value(key) if key in self else {}
        if not isinstance(value, dict):
            raise self.wrong(key, "expected a table")
        return TomlTable(self.path, f"{self._name}.{key}".lstrip("."), value, self.files)

    def tables(self, key: str) -> list["TomlTable"]:
        """A list of tables."""
        values = self.value(key) if key in self else []
        if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
            raise self.wrong(key, "expected a list of tables")
        return [TomlTable(self.path, f"{self._name}.{key}".lstrip("."), value, self.files) for value in values]

    def rows(self, key: str) -> list["TomlTable"]:
        """A list of tables whose names in messages are numbered from 1, as in `gates[2]`."""
        numbered = enumerate(self.tables(key), start=1)
        return [TomlTable(row.path, f"{row._name}[{i}]", row._values, row.files) for i, row in numbered]

    @property
    def unread(self) -> tuple[str, ...]:
        """Names of the keys that nobody asked for, with the names of the tables that they are in."""
        return tuple(f"{self._name}.{key}".lstrip(".") for key in self._values if key not in self._asked)

    def done(self) -> None:
        unknown = [key for key in self._values if key not in self._asked]
        if unknown:
            raise self.wrong(unknown[0], f"unknown; known are {', '.join(sorted(self._asked))}")


def shown(value: Any) -> str:
    """A value in a message of one line."""
    try:
        text = repr(value)
    except ValueError:  # a whole number with more digits than Python writes
        return "a very long number"
    return text if len(text) <= _MOST_SHOWN else f"{text[:_MOST_SHOWN]}..."
