"""Traffic report as an Excel workbook: a summary sheet, and one sheet per table except trajectories.

Cells are numbers and times, not text, so that they can be sorted, filtered and summed. Times are local times of the
site, because Excel has no time zones. `begin_s` and `end_s` distinguish the repeated hour of a clock change. Names that
begin like a formula stay text.
"""

import math
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.traffic.count_uncertainty import in_cells
from skope.traffic.report_tables import ReportTable, report_tables
from skope.traffic.traffic_report import TrafficReport

if TYPE_CHECKING:
    from xlsxwriter.format import Format
    from xlsxwriter.workbook import Workbook
    from xlsxwriter.worksheet import Worksheet

EXCEL_FILE: Final = "traffic.xlsx"


@dataclass(frozen=True)
class ExcelLayout:
    """Layout of an Excel sheet."""

    most_rows: int = 1_048_575
    """Maximum number of rows below the row of names."""
    column_width: int = 16
    """Width of a column, characters."""
    digits: int = 3
    """Digits after the decimal point."""


EXCEL_LAYOUT: Final = ExcelLayout()

_LEFT_OUT: Final = frozenset({"trajectories"})
"""Tables without a sheet, because they have too many rows."""


def write_excel(folder: Path, report: TrafficReport) -> list[Path]:
    """Write a report as `traffic.xlsx`; returns the file.

    Raises:
        UserError: A table has more rows than a sheet; the message names it.
    """
    import xlsxwriter

    path = folder / EXCEL_FILE
    with replacing(path) as temporary:
        book = xlsxwriter.Workbook(str(temporary), {"constant_memory": True, "nan_inf_to_errors": False})
        try:
            formats = _Formats(book)
            _write_summary(book.add_worksheet("summary"), report, formats)
            for name, table in report_tables(report).items():
                if name not in _LEFT_OUT:
                    _write_table(book.add_worksheet(name), name, table, formats)
        finally:
            book.close()
    return [path]


class _Formats:
    """Formats of cells."""

    def __init__(self, book: "Workbook") -> None:
        self.head: Format = book.add_format({"bold": True, "bottom": 1, "text_wrap": True, "valign": "top"})
        self.time: Format = book.add_format({"num_format": "yyyy-mm-dd hh:mm:ss"})
        self.text: Format = book.add_format({"text_wrap": True, "valign": "top"})


def _write_table(sheet: "Worksheet", name: str, table: ReportTable, formats: _Formats) -> None:
    sheet.freeze_panes(1, 0)
    sheet.set_column(0, len(table.columns) - 1, EXCEL_LAYOUT.column_width)
    for column, title in enumerate(table.columns):
        sheet.write_string(0, column, title, formats.head)
    last = 0
    for last, row in enumerate(table.rows, start=1):
        if last > EXCEL_LAYOUT.most_rows:
            raise UserError(
                f"{name}: expected at most {EXCEL_LAYOUT.most_rows} rows (the limit of a sheet); measure a shorter time"
            )
        for column, value in enumerate(row):
            _write_cell(sheet, last, column, value, formats)
    sheet.autofilter(0, 0, last, len(table.columns) - 1)


def _write_cell(sheet: "Worksheet", row: int, column: int, value: Any, formats: _Formats) -> None:
    """Write one cell; write nothing for None or a number that is not finite."""
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return
    if isinstance(value, datetime):
        sheet.write_datetime(row, column, value.replace(tzinfo=None), formats.time)
    elif isinstance(value, int | float):
        sheet.write_number(row, column, round(float(value), EXCEL_LAYOUT.digits))
    else:
        sheet.write_string(row, column, str(value))


def _write_summary(sheet: "Worksheet", report: TrafficReport, formats: _Formats) -> None:
    """Write the summary: the footage, its counts, and notes on figures that are not available or doubtful."""
    sheet.set_column(0, 0, 30)
    sheet.set_column(1, 5, EXCEL_LAYOUT.column_width)
    observation = report.observation
    row = 0
    for title, value in (
        ("footage", observation.source),
        ("begins", report.start),
        ("time zone", report.site.time_zone),
        ("observed, seconds", observation.observed_s),
    ):
        sheet.write_string(row, 0, title, formats.head)
        _write_cell(sheet, row, 1, value, formats)
        row += 1
    row += 1
    for column, title in enumerate(("gate", "direction", "class", "count", "low (90%)", "high (90%)")):
        sheet.write_string(row, column, title, formats.head)
    for total in report.counts_total:
        row += 1
        for column, value in enumerate(
            (total.gate, total.direction, total.class_name, total.count, *in_cells(total.confidence_interval))
        ):
            _write_cell(sheet, row, column, value, formats)
    row += 2
    sheet.write_string(row, 0, "not measured, or to be distrusted", formats.head)
    for line in report.notes:
        row += 1
        sheet.write_string(row, 0, line)
