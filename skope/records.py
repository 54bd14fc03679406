"""Reader of structured input: single values, tables of TOML files, and dataclasses from mappings.

Site files, recipes, cards of datasets, headers of weights, JSON files and arguments of Python functions are checked
here. A wrong value raises a UserError that names the field, what was expected and what was found.
"""

import difflib
import math
import tomllib
import types
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Final, Self, TypeGuard, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from skope.errors import UserError, one_of
from skope.files.atomic import read_text
from skope.types import Array, Pixels

T = TypeVar("T")


@dataclass(frozen=True)
class RecordLimits:
    """Limits of values and messages."""

    largest_number: float = 1e300
    """Largest absolute value of a number in a TOML file."""
    shown_letters: int = 60
    """Maximum number of letters of an invalid value in a message."""


RECORD_LIMITS: Final = RecordLimits()

NONE_WORD: Final = "none"
"""Text that stands for None, for which TOML has no value."""


# -------------------------------------------------------------------------------------------------------- single values


def is_number(value: Any) -> TypeGuard[float]:
    """Return whether a value is a finite number that a float can represent. True and False are not numbers."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        return False
    try:
        return math.isfinite(value)
    except OverflowError:  # a whole number can have any length
        return False


def check_number(name: str, value: Any, low: float = 0.0, high: float = math.inf) -> float:
    """Check a field that is a number.

    Args:
        name: The field; the message begins with it.
        value: Its value.
        low: Minimum.
        high: Maximum.

    Returns:
        `value`.

    Raises:
        UserError: `value` is not a finite number within the limits.
    """
    if not is_number(value) or not low <= value <= high:
        raise UserError(f"{name}: expected a number{_limits(low, high)}, got {shown(value)}")
    return value


def check_share(name: str, value: float | None) -> None:
    """Raise a UserError unless `value` is None or from 0 to 1."""
    if value is not None:
        check_number(name, value, 0.0, 1.0)


def check_whole(name: str, value: Any, low: int = 0, high: float = math.inf) -> int:
    """Check a field that is a whole number.

    Args:
        name: The field; the message begins with it.
        value: Its value.
        low: Minimum.
        high: Maximum.

    Returns:
        `value`.

    Raises:
        UserError: `value` is not a whole number within the limits. True and False are not numbers.
    """
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        raise UserError(f"{name}: expected a whole number{_limits(low, high)}, got {shown(value)}")
    return value


def check_choice(name: str, value: str | None, choices: tuple[str, ...]) -> None:
    """Raise a UserError that lists the choices unless `value` is None or one of them."""
    if value is not None:
        one_of(name, value, choices)


def check_array(name: str, value: Any, *shape: int) -> Array:
    """Check a field of numbers.

    Args:
        name: The field; the message begins with it.
        value: Numbers, with any nesting.
        shape: Shape of the result. The nesting of `value` may differ, but not the number of its numbers.

    Returns:
        `value` as float64 of that shape.

    Raises:
        UserError: `value` does not consist of that number of finite numbers.
    """
    try:
        result = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise UserError(f"{name}: expected numbers, got {str(value)[: RECORD_LIMITS.shown_letters]!r}") from None
    if result.size != math.prod(shape):
        expected = " x ".join(map(str, shape))
        raise UserError(f"{name}: expected {expected} numbers, got {result.size}")
    if not np.isfinite(result).all():
        raise UserError(f"{name}: not all numbers are finite")
    return result.reshape(shape)


def check_image(name: str, value: Any) -> Pixels:
    """Check an image that a caller gives as an array.

    Args:
        name: The argument; the message begins with it.
        value: (H, W, 3) RGB pixels of type uint8, with any strides. `bgr[..., ::-1]` has negative ones.

    Returns:
        The same pixels, row by row in memory. They are copied only if necessary.

    Raises:
        UserError: `value` is not an array, has another shape or type, or has no pixel.
    """
    expected = f"{name}: expected (H, W, 3) RGB pixels of type uint8"
    if not isinstance(value, np.ndarray):
        raise UserError(f"{expected}, got {'None' if value is None else type(value).__name__}")
    got = f"{expected}, got {value.shape} of type {value.dtype}"
    if value.ndim == 3 and value.shape[2] == 3:
        if value.dtype.kind == "f":
            raise UserError(f"{got}: for values from 0 to 1, give (255 * {name}).round().astype(numpy.uint8)")
        if not value.size:
            raise UserError(f"{got}: it is empty")
    if value.ndim != 3 or value.shape[2] != 3 or value.dtype != np.uint8:
        raise UserError(got)
    return np.ascontiguousarray(value)


def shown(value: Any) -> str:
    """Return a value as text for a one-line message."""
    if value is None:
        return "nothing"
    try:
        text = repr(value)
    except ValueError:  # a whole number with more digits than Python writes
        return "a very long number"
    return text if len(text) <= RECORD_LIMITS.shown_letters else f"{text[: RECORD_LIMITS.shown_letters]}..."


def _limits(low: float, high: float) -> str:
    """Return limits in words: " from 0 to 1", " from 0", or nothing."""
    words = "" if math.isinf(low) else f" from {low:g}"
    return words if math.isinf(high) else f"{words} to {high:g}"


# ---------------------------------------------------------------------------------------------- dataclasses of mappings


def dataclass_of(cls: type[T], values: Any, where: str, defaults: Mapping[str, Any] | None = None) -> T:
    """Build a dataclass from a mapping, with values converted to the types of its fields.

    Args:
        cls: The dataclass. Its fields may be int, float, bool, str, None, dataclasses, and tuples, mappings and unions
            of these.
        values: JSON or TOML values by the names of its fields. Lists become tuples, and mappings dataclasses.
        where: Name of the mapping in messages, for example "card.json: parameters".
        defaults: Values of fields that may be missing.

    Raises:
        UserError: A field is missing, unknown, or of another type.
    """
    if not isinstance(values, Mapping):
        raise UserError(f"{where.rstrip(': ')}: expected an object, got {shown(values)}")
    hints = get_type_hints(cls)
    known = [field.name for field in fields(cls)]  # type: ignore[arg-type]
    check_known(values, known, where)
    made = dict(defaults or {})
    for name in known:
        if name in values:
            made[name] = value_of(values[name], hints[name], _joined(where, name))
        elif name not in made:
            raise UserError(f"{_joined(where, name)}: missing")
    try:
        return cls(**made)
    except UserError as error:
        raise UserError(_joined(where, str(error))) from None


def check_known(values: Mapping[str, Any], known: Sequence[str], where: str) -> None:
    """Raise a UserError if a mapping has a key that is not among `known`; the message suggests one."""
    for name in values:
        if name not in known:
            close = difflib.get_close_matches(str(name), known, n=1)
            hint = f"did you mean {close[0]}?" if close else f"expected {', '.join(sorted(known))}"
            raise UserError(f"{_joined(where, name)}: unknown field; {hint}")


def with_values(base: T, values: Any, where: str) -> T:
    """Return a copy of a dataclass with other values, which are converted as by `dataclass_of`.

    A field that is itself a dataclass is changed, not replaced: its table may contain only some of its fields. The text
    "none" stands for None, for which TOML and flags have no value.
    """
    base_values = {field.name: getattr(base, field.name) for field in fields(base)}  # type: ignore[arg-type]
    hints = get_type_hints(type(base))
    if isinstance(values, Mapping):
        optional = [name for name in values if name in hints and type(None) in get_args(hints[name])]
        values = {**values, **{name: None for name in optional if values[name] == NONE_WORD}}
        values = {
            name: with_values(base_values[name], value, _joined(where, name))
            if is_dataclass(base_values.get(name))
            else value
            for name, value in values.items()
        }
    return dataclass_of(type(base), values, where, base_values)


def value_of(value: Any, hint: Any, where: str) -> Any:
    """Convert a JSON or TOML value to a type.

    Args:
        value: The value.
        hint: The type, as in the annotation of a dataclass field.
        where: Name of the field in messages.

    Raises:
        UserError: The value is not of this type.
    """
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    if type(None) in choices and value is None:
        return None
    for choice in choices:
        if is_dataclass(choice) and isinstance(value, choice):  # type: ignore[arg-type]
            return value
        if is_dataclass(choice) and isinstance(value, Mapping):
            return dataclass_of(choice, value, where)  # type: ignore[arg-type]
        if choice is float and is_number(value):
            return float(value)
        if choice is Any or (choice in (int, str, bool) and type(value) is choice):
            return value
        origin, items = get_origin(choice), get_args(choice)
        if origin is tuple and isinstance(value, list | tuple):
            kinds = items[:1] * len(value) if items[-1] is Ellipsis else items
            if len(kinds) == len(value):
                pairs = enumerate(zip(value, kinds, strict=True))
                return tuple(value_of(item, kind, f"{where}[{i}]") for i, (item, kind) in pairs)
        if origin is not None and issubclass(origin, Mapping) and isinstance(value, Mapping):
            return {str(key): value_of(item, items[1], _joined(where, key)) for key, item in value.items()}
    raise UserError(f"{where}: expected {' or '.join(map(_in_words, choices))}, got {shown(value)}")


def plain_values(made: Any) -> dict[str, Any]:
    """Return the fields of a dataclass as JSON values for `dataclass_of`. Tuples become lists."""
    values: dict[str, Any] = _plain(asdict(made))
    return values


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def _joined(where: str, name: str) -> str:
    """Return the path of a field; `where` may end in the separator that it needs."""
    return f"{where}{name}" if not where or where.endswith((" ", ".")) else f"{where}.{name}"


def _in_words(hint: Any) -> str:
    """Return the name of a type for messages."""
    words = {int: "a whole number", float: "a number", bool: "true or false", str: "text", type(None): NONE_WORD}
    if hint in words:
        return words[hint]
    if get_origin(hint) is tuple:
        first, last = get_args(hint)[0], get_args(hint)[-1]
        plural = {int: "whole numbers", float: "numbers", str: "texts"}.get(first, "values")
        return f"a list of {plural}" if last is Ellipsis else f"a list of {len(get_args(hint))} {plural}"
    return "an object"


# --------------------------------------------------------------------------------------------------------------- tables


class TomlTable:
    """Table of a TOML file, read key by key. Errors name file and key.

    `done` rejects keys that were not read.
    """

    def __init__(self, path: Path, name: str, values: Mapping[str, Any], files: dict[str, Path] | None = None) -> None:
        """Store a table; `files` collects the paths of the files that the table refers to, by key."""
        self.path, self._name, self._values = path, name, dict(values)
        self.files: dict[str, Path] = {} if files is None else files
        self._asked: set[str] = set()

    @classmethod
    def read(cls, path: Path) -> Self:
        """Return the table of a file."""
        return cls.parse(path, read_text(path))

    @classmethod
    def parse(cls, path: Path, text: str) -> Self:
        """Parse the text of a TOML file.

        `path` is used in error messages, and paths in the table are relative to its folder.
        """
        try:
            return cls(path, "", tomllib.loads(text))
        except ValueError as error:  # also a number with more digits than Python reads
            raise UserError(f"{path}: not valid TOML: {error}") from None
        except RecursionError:
            raise UserError(f"{path}: not valid TOML: nested too deeply") from None

    @property
    def values(self) -> Mapping[str, Any]:
        """Return all values by key."""
        return self._values

    def wrong(self, key: str, text: str) -> UserError:
        """Return an error at a key, for the caller to raise."""
        where = ".".join(part for part in (self._name, key) if part)
        return UserError(f"{self.path}: {where}: {text}" if where else f"{self.path}: {text}")

    def __contains__(self, key: str) -> bool:
        self._asked.add(key)
        return key in self._values

    def value(self, key: str) -> Any:
        """Return the value of a key, of any type; None if the key is missing."""
        return self._values[key] if key in self else None

    def text(self, key: str, default: str = "") -> str:
        """Return a text."""
        value = self.value(key) if key in self else default
        if not isinstance(value, str):
            raise self.wrong(key, f"expected a text, got {shown(value)}")
        return value

    def flag(self, key: str) -> bool:
        """Return true or false; false if the key is missing."""
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
            default: Value if the key is missing; None: the key is required.
            low: Minimum.
            high: Maximum.

        Raises:
            UserError: The key is missing, or its value is not a finite number within the limits.
        """
        if key not in self and default is not None:
            return default
        return self._checked(key, self.value(key), low, high)

    def _checked(self, key: str, value: Any, low: float = -math.inf, high: float = math.inf) -> float:
        if not is_number(value) or abs(value) >= RECORD_LIMITS.largest_number or not low <= value <= high:
            expected = f"expected a number{_limits(low, high)}, got {shown(value)}"
            raise self.wrong(key, expected if key in self else "missing")
        return float(value)

    def numbers(self, key: str, count: int) -> tuple[float, ...]:
        """Return `count` numbers. Raises UserError if there are more or fewer, or one is no number."""
        value = self.value(key)
        if not isinstance(value, list) or len(value) != count:
            raise self.wrong(key, f"expected {count} numbers, got {shown(value)}" if key in self else "missing")
        return tuple(self._checked(key, item) for item in value)

    def matrix(self, key: str, rows: int, columns: int) -> list[tuple[float, ...]]:
        """Return a list of rows of numbers. Raises UserError if their counts differ from `rows` and `columns`."""
        value = self.value(key)
        right = isinstance(value, list) and len(value) == rows
        if not right or any(not isinstance(row, list) or len(row) != columns for row in value):
            raise self.wrong(key, f"expected {rows} rows of {columns} numbers")
        return [tuple(self._checked(key, item) for item in row) for row in value]

    def file(self, key: str) -> Path | None:
        """Return the path of an existing file, relative to this one."""
        if key not in self:
            return None
        path = self.path.parent / self.text(key)
        if not path.is_file():
            raise self.wrong(key, f"{path}: no such file")
        self.files[self._within(key)] = path
        return path

    def table(self, key: str) -> "TomlTable":
        """Return a table in this one; an empty one if the key is missing."""
        value = self.value(key) if key in self else {}
        if not isinstance(value, dict):
            raise self.wrong(key, "expected a table")
        return TomlTable(self.path, self._within(key), value, self.files)

    def tables(self, key: str) -> list["TomlTable"]:
        """Return a list of tables."""
        values = self.value(key) if key in self else []
        if not isinstance(values, list) or not all(isinstance(value, dict) for value in values):
            raise self.wrong(key, "expected a list of tables")
        return [TomlTable(self.path, self._within(key), value, self.files) for value in values]

    def rows(self, key: str) -> list["TomlTable"]:
        """Return a list of tables. Error messages number them from 1, for example `gates[2]`."""
        numbered = enumerate(self.tables(key), start=1)
        return [TomlTable(row.path, f"{row._name}[{i}]", row._values, row.files) for i, row in numbered]

    def _within(self, key: str) -> str:
        return f"{self._name}.{key}".lstrip(".")

    @property
    def unread(self) -> tuple[str, ...]:
        """Return the keys that were not read, with the names of their tables."""
        return tuple(self._within(key) for key in self._values if key not in self._asked)

    def done(self) -> None:
        """Raise a UserError if the table has a key that was not read."""
        unknown = [key for key in self._values if key not in self._asked]
        if unknown:
            raise self.wrong(unknown[0], f"unknown; known are {', '.join(sorted(self._asked))}")
