"""Tables that people open in a spreadsheet: text stays text, numbers stay numbers, and both are read back."""

import codecs
import csv
import math
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.errors import UserError
from skope.files.csv_files import read_csv, write_csv

DANGEROUS = ("=1+1", "+in", "-out", "@ein", "\tx", "\rx", "\nx", "＝1", "＋1", "－1", "＠x")
"""Texts that a spreadsheet may run as a formula."""
PLAIN = ("", "north", "1-2", "Süd, Straße 1", 'aus "B"', "'quoted'", "'", "a=b", "東", " =x")
ESCAPED = ("'=1", "''=1", "'-", "'@")
"""Texts that look as if they had been escaped."""


def cells(path: Path) -> list[list[str]]:
    """All rows as another program has them."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        return list(csv.reader(file))


@pytest.mark.parametrize("text", DANGEROUS)
def test_text_never_begins_like_a_formula(tmp_path: Path, text: str) -> None:
    write_csv(tmp_path / "a.csv", ("name",), [[text]])
    assert cells(tmp_path / "a.csv") == [["name"], ["'" + text]]


@pytest.mark.parametrize("text", PLAIN)
def test_other_text_is_written_as_it_is(tmp_path: Path, text: str) -> None:
    write_csv(tmp_path / "a.csv", ("name", "number"), [[text, 1]])
    assert cells(tmp_path / "a.csv")[1:] == [[text, "1"]]


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (-5, "-5"),
        (-0.25, "-0.250"),
        (np.float64(-1.5), "-1.500"),
        (np.int64(-2), "-2"),
        (1e-9, "0.000"),
        (math.nan, ""),
        (math.inf, ""),
        (None, ""),
        (datetime(2026, 11, 26, 10, tzinfo=UTC), "2026-11-26T10:00:00+00:00"),
        (datetime(2026, 11, 26, 10, 0, 0, 250_000, tzinfo=UTC), "2026-11-26T10:00:00.250+00:00"),
    ],
)
def test_numbers_and_times_are_no_text(tmp_path: Path, value: Any, expected: str) -> None:
    write_csv(tmp_path / "a.csv", ("a", "b"), [[value, "x"]], digits=3)
    assert cells(tmp_path / "a.csv")[1:] == [[expected, "x"]]


def test_numbers_keep_all_digits_by_default(tmp_path: Path) -> None:
    write_csv(tmp_path / "a.csv", ("a",), [[-0.1234567]])
    assert cells(tmp_path / "a.csv")[1:] == [["-0.1234567"]]


@pytest.mark.parametrize("mark", [True, False])
def test_what_is_read_equals_what_was_written(tmp_path: Path, mark: bool) -> None:
    texts = [*DANGEROUS, *PLAIN, *ESCAPED]
    path = tmp_path / "a.csv"
    write_csv(path, ("näme", "number"), ([text, -k] for k, text in enumerate(texts)), byte_order_mark=mark)
    assert path.read_bytes().startswith(codecs.BOM_UTF8) == mark
    names, rows = read_csv(path)
    assert names == ["näme", "number"]
    assert [row["näme"] for row in rows] == texts
    assert [row["number"] for row in rows] == [str(-k) for k in range(len(texts))]


def test_a_file_that_is_no_table_is_rejected_by_name(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"gate\n\xff\n")
    with pytest.raises(UserError, match=r"a\.csv: not UTF-8 text"):
        read_csv(path)
    path.write_text("gate\n" + "x" * (csv.field_size_limit() + 1))
    with pytest.raises(UserError, match=r"a\.csv: not CSV"):
        read_csv(path)
