"""Pages from templates: HTML files below skope/, filled with escaped values.

base.html is the frame of all pages; pieces.html has their common macros.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from markupsafe import Markup, escape

if TYPE_CHECKING:
    from jinja2 import Environment

IMPORT_LINE: Final = re.compile(r'^import \{[^}]*\} from "\./([\w.]+)";\n', re.MULTILINE)
EXPORT_WORD: Final = re.compile(r"^export ", re.MULTILINE)
CODE_WORD: Final = re.compile(r"`([^`]+)`")


@dataclass(frozen=True)
class Cell:
    """Table cell with a note below its text."""

    text: object
    note: str | None


@dataclass(frozen=True)
class ShareCell:
    """Table cell with a share from 0 to 1, shown as per cent with a bar behind it; None: not available."""

    share: float | None


@dataclass(frozen=True, kw_only=True)
class Table:
    """Table of a page."""

    caption: str
    """Caption. For a sticky table it is only the accessible label, because it would scroll away: its title is above the
    table."""
    head: Sequence[str]
    rows: Sequence[Sequence[object]]
    """Cells of each row: texts, `Cell` or `ShareCell`; the first one is the row header."""
    foot: Sequence[object] = ()
    """Cells of a row of totals; empty for none."""
    sortable: bool = False
    """Whether headings are buttons that sort the table."""
    sticky: bool = False
    """Whether headings and the first column stay visible while the table scrolls; useful for long tables."""
    folded: bool | None = None
    """Whether a table in a collapsible section is initially closed; None: it is in no such section."""


def render(template: str | Path, **values: Any) -> str:
    """Write a page.

    Args:
        template: Path of its template below skope/; a `Path` can be any file.
        values: Values for the template; everything except `Markup` is escaped.
    """
    known = _environment()
    if isinstance(template, Path):
        return known.from_string(template.read_text(encoding="utf-8")).render(values)
    return known.get_template(template).render(values)


def piece(macro: str, *values: Any, **named: Any) -> Markup:
    """Return the markup of a macro of pieces.html."""
    return Markup(getattr(_environment().get_template("page/pieces.html").module, macro)(*values, **named))


@lru_cache
def _environment() -> "Environment":
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("skope", ""),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"code": _code, "number": number_text, "percent": percent_text}
    made.globals |= {"bundled": bundled_script, "text_of": text_of}
    return made


def text_of(path: str) -> Markup:
    """Return the text of a file below skope/, unchanged."""
    return Markup(resources.files("skope").joinpath(path).read_text(encoding="utf-8"))


def bundled_script(*entries: str) -> Markup:
    """Return one script for a single-file page: modules with all that they import, each in its own scope.

    Args:
        entries: Paths below skope/. Imported files are beside them, or in skope/page.
    """
    parts: dict[str, str] = {}

    def add(path: str) -> None:
        text = text_of(path)
        for name in IMPORT_LINE.findall(text):
            beside = f"{path.rpartition('/')[0]}/{name}"
            module = beside if resources.files("skope").joinpath(beside).is_file() else f"page/{name}"
            if module not in parts:
                add(module)
        body = EXPORT_WORD.sub("", IMPORT_LINE.sub("", text))
        parts[path] = f"{{\n{body}}}\n" if path in entries else body

    for entry in entries:
        add(entry)
    return Markup('"use strict";\n{\n' + "".join(parts.values()) + "}\n")


def _code(text: str) -> Markup:
    """Return a text as markup; parts in backticks become code."""
    return Markup(CODE_WORD.sub(r"<code>\1</code>", str(escape(text))))


def percent_text(value: float | None) -> str:
    """Return a share in per cent; "–" if it is not available."""
    return "–" if value is None else f"{100 * value:.1f} %"


def number_text(value: float | None, digits: int = 3) -> str:
    """Return a number with `digits` decimals; "–" for None."""
    return "–" if value is None else f"{value:.{digits}f}"
