"""Tables of a traffic report as Parquet, one file each, with types and missing values."""

import math
from datetime import datetime
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from typing import Any, Final

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.traffic.report_tables import ReportTable, report_tables
from skope.traffic.traffic_report import TrafficReport

BLOCK_ROWS: Final = 100_000
"""Number of rows that are written together. It bounds memory."""


def write_parquet(folder: Path, report: TrafficReport) -> list[Path]:
    """Write each table of a report as Parquet, a file of its name; returns the files.

    Raises:
        UserError: pyarrow is not installed.
    """
    check_parquet()
    return [_write(folder / f"{name}.parquet", table) for name, table in report_tables(report).items()]


def check_parquet() -> None:
    """Raise a UserError if pyarrow is not installed."""
    if find_spec("pyarrow") is None:
        raise UserError("parquet: needs pyarrow: pip install 'skope[parquet]'")


def _write(path: Path, table: ReportTable) -> Path:
    """Write a table. The first value of a column decides whether it has numbers, times or text."""
    import pyarrow as pa
    from pyarrow.parquet import ParquetWriter

    rows = iter(table.rows)
    first = list(islice(rows, BLOCK_ROWS))
    schema = pa.schema(
        [(name, _type_of([row[k] for row in first])) for k, name in enumerate(table.columns)],
    )
    with replacing(path) as temporary, ParquetWriter(str(temporary), schema) as writer:
        while True:
            columns = [
                pa.array([_cell(row[k], field.type) for row in first], field.type) for k, field in enumerate(schema)
            ]
            writer.write_table(pa.table(columns, schema=schema))
            first = list(islice(rows, BLOCK_ROWS))
            if not first:
                return path


def _type_of(values: list[Any]) -> Any:
    """Return the type of a column. It is integer only if all values are whole numbers."""
    import pyarrow as pa

    known = [value for value in values if value is not None]
    if known and all(isinstance(value, datetime) for value in known):
        return pa.timestamp("ms", tz="UTC")
    if known and all(type(value) is int for value in known):
        return pa.int64()
    if known and all(isinstance(value, int | float) for value in known):
        return pa.float64()
    return pa.string()


def _cell(value: Any, kind: Any) -> Any:
    import pyarrow as pa

    if value is None or (isinstance(value, float) and math.isnan(value)):
        return None
    return str(value) if kind == pa.string() else float(value) if kind == pa.float64() else value
