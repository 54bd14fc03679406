"""CSV files for spreadsheets: the only writer, and a reader that restores the text.

A spreadsheet runs a cell that begins with =, +, -, @, a tab or a line break as a formula, and a name in a site file can
begin like that. The writer puts an apostrophe before such text (OWASP, "CSV Injection"). Numbers are not text and stay
unchanged, including negative ones.
"""

import csv
import io
import math
import re
from collections.abc import Iterable, Sequence
from datetime import datetime
from pathlib import Path
from typing import IO, Any, Final

from skope.errors import UserError
from skope.files.atomic import read_text, replacing

FORMULA_START: Final = re.compile("'*[=+\\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")
"""Start of a text that a spreadsheet may execute.

Texts with apostrophes before it are included, because reading would otherwise drop these. The last four characters are
full-width =, +, - and @."""


def write_csv(
    path: Path,
    columns: Sequence[str],
    rows: Iterable[Sequence[Any]],
    *,
    digits: int | None = None,
    byte_order_mark: bool = True,
) -> None:
    """Write a table as a UTF-8 CSV file, atomically.

    Args:
        path: The file.
        columns: Names of the columns.
        rows: Cells of each row: text, numbers, times. None and non-finite numbers become empty cells.
        digits: Number of decimals of floats. Default: all of them.
        byte_order_mark: Whether the file begins with a byte order mark, which makes Excel read it as UTF-8. Useful for
            files that people open; omit it in files that programs read.

    Raises:
        UserError: The file cannot be written.
    """
    encoding = "utf-8-sig" if byte_order_mark else "utf-8"
    with replacing(path) as temporary, temporary.open("w", encoding=encoding, newline="") as file:
        # With this line terminator, csv quotes text with a carriage return.
        writer = csv.writer(_UnixLines(file), lineterminator="\r\n")
        writer.writerow(columns)
        writer.writerows([_cell(value, digits) for value in row] for row in rows)


class _UnixLines:
    """Text file with line feeds as line ends; each line is written in one call."""

    def __init__(self, file: IO[str]) -> None:
        self._file = file

    def write(self, line: str) -> None:
        self._file.write(line.removesuffix("\r\n") + "\n")


def _cell(value: Any, digits: int | None) -> str:
    if isinstance(value, str):
        return f"'{value}" if FORMULA_START.match(value) else value
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, float):
        return str(value) if digits is None else f"{value:.{digits}f}"
    if isinstance(value, datetime):
        return value.isoformat(timespec="milliseconds" if value.microsecond else "seconds")
    return str(value)


def read_csv(path: Path) -> tuple[list[str], list[dict[str | None, Any]]]:
    """Read a table from `write_csv` or from a user, with or without a byte order mark.

    Args:
        path: The file.

    Returns:
        The names of the columns, and the cells of each row by column. As with `csv.DictReader`, a missing cell is None,
        and cells beyond the columns are a list under None.

    Raises:
        UserError: The file cannot be read; the message names it.
    """
    try:
        reader = csv.DictReader(io.StringIO(read_text(path), newline=""))
        names, rows = list(reader.fieldnames or ()), list(reader)
    except csv.Error as error:
        raise UserError(f"{path}: not CSV: {error}") from None
    return names, [{name: _text(cell) for name, cell in row.items()} for row in rows]


def _text(cell: Any) -> Any:
    """Return the text of a cell without the apostrophe of `write_csv`."""
    return cell[1:] if isinstance(cell, str) and cell.startswith("'") and FORMULA_START.match(cell) else cell
