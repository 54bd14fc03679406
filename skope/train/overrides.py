"""Values of dataclasses from people: TOML files and `name=value` flags, checked against the fields' types."""

import difflib
import tomllib
import types
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from skope.errors import UserError
from skope.files.reading import read_text

T = TypeVar("T")

NONE_WORD = "none"
"""Ways in which people write None, for which TOML has no word."""


def read_toml(path: Path) -> dict[str, Any]:
    """The table of a TOML file; a missing or malformed one is a UserError that names it."""
    try:
        return tomllib.loads(read_text(path))
    except tomllib.TOMLDecodeError as error:
        raise UserError(f"{path}: not valid TOML: {error}") from None


def from_flags(flags: Sequence[str], where: str) -> dict[str, Any]:
    """Nested values of flags like `augment.blur=0.2`; a value is written as in TOML, text without quotes too."""
    values: dict[str, Any] = {}
    for flag in flags:
        name, equals, text = flag.partition("=")
        if not equals or not name.strip():
            raise UserError(f"{where} {flag}: expected name=value")
        *tables, leaf = name.strip().split(".")
        into = values
        for table in tables:
            into = into.setdefault(table, {})
        try:
            into[leaf] = tomllib.loads(f"value = {text}")["value"]
        except tomllib.TOMLDecodeError:
            into[leaf] = text.strip()
    return values


def with_values(base: T, values: Mapping[str, Any], where: str) -> T:
    """A copy of a dataclass with other values, nested tables for nested dataclasses.

    Raises UserError, beginning with `where` and the field, for unknown names and wrong types.
    """
    hints = get_type_hints(type(base))
    names = {field.name for field in fields(base)}  # type: ignore[arg-type]
    new: dict[str, Any] = {name: getattr(base, name) for name in names}
    for name, value in values.items():
        if name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            hint = f"; did you mean {close[0]}?" if close else f"; there are: {', '.join(sorted(names))}"
            raise UserError(f"{where}{name}: no such value{hint}")
        if is_dataclass(new[name]):
            if not isinstance(value, Mapping):
                raise UserError(f"{where}{name}: expected a table, got {value!r}")
            new[name] = with_values(new[name], value, f"{where}{name}.")
        else:
            new[name] = _typed(value, hints[name], f"{where}{name}")
    try:
        return type(base)(**new)
    except UserError as error:
        raise UserError(f"{where}{error}") from None


def _typed(value: Any, hint: Any, where: str) -> Any:
    choices = get_args(hint) if get_origin(hint) in (Union, types.UnionType) else (hint,)
    if type(None) in choices and value in (None, NONE_WORD):
        return None
    for choice in choices:
        if choice is float and isinstance(value, int | float) and not isinstance(value, bool):
            return float(value)
        if choice in (int, str, bool) and type(value) is choice:
            return value
        if get_origin(choice) is tuple and (items := _items(value, get_args(choice)[0])) is not None:
            return items
    words: dict[Any, str] = {
        int: "a whole number",
        float: "a number",
        bool: "true or false",
        str: "text",
        type(None): NONE_WORD,
        tuple[int, ...]: "a list of whole numbers",
        tuple[str, ...]: "a list of texts",
    }
    expected = " or ".join(words[choice] for choice in choices)
    raise UserError(f"{where}: expected {expected}, got {value!r}")


def _items(value: Any, kind: type) -> tuple[Any, ...] | None:
    """The texts or whole numbers of a list, or of one text with commas between them; None where it is no such list."""
    if isinstance(value, str):
        value = [item.strip() for item in value.split(",") if item.strip()]
        if kind is int and all(item.isdecimal() for item in value):
            value = [int(item) for item in value]
    if isinstance(value, list | tuple) and all(type(item) is kind for item in value):
        return tuple(value)
    return None
