"""Values of the page's document, which may be anything that a browser sends, as what they should be."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

from skope.errors import UserError
from skope.records import is_number
from skope.site.mark_limits import LONGEST_NAME

NO_NAME: Final = f"expected a name of one line and up to {LONGEST_NAME} letters"
_MOST: Final = 500
"""Entries of a list that are taken: a person marks some dozens."""


def entries_of(document: Mapping[str, Any], kind: str) -> list[Mapping[str, Any]]:
    """A list of the document; a UserError where it is no list of objects."""
    value = document.get(kind, [])
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value) or len(value) > _MOST:
        raise UserError(f"{kind}: expected a list of up to {_MOST} objects")
    return value


def unique_names(entries: Sequence[Mapping[str, Any]]) -> list[str]:
    """A name for each entry, its own where no earlier one has it: messages of the solver name points."""
    out: list[str] = []
    for number, entry in enumerate(entries, start=1):
        own = entry.get("name")
        name = own.strip() if isinstance(own, str) and own.strip() else str(number)
        plain, again = name, 2
        while name in out:
            name, again = f"{plain} ({again})", again + 1
        out.append(name)
    return out


def is_name(value: Any) -> bool:
    """Whether something is a name of one line, in any script, and not too long to be shown."""
    return isinstance(value, str) and bool(value.strip()) and len(value) <= LONGEST_NAME and value.isprintable()


def number_or_none(value: Any) -> float | None:
    """A finite number, or None for anything else."""
    return float(value) if is_number(value) else None


def positions(value: Any, width: int) -> list[list[float]] | None:
    """Rows of `width` numbers each, or None for anything else."""
    if not isinstance(value, list) or len(value) > _MOST:
        return None
    rows = []
    for row in value:
        if not isinstance(row, list) or len(row) != width:
            return None
        numbers = [number_or_none(one) for one in row]
        if None in numbers:
            return None
        rows.append([one for one in numbers if one is not None])
    return rows
