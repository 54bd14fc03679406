"""Templates of pages: values are escaped, cells have notes and bars, and a page's script is one file."""

import re

import pytest

from skope.page.templates import Cell, ShareCell, Table, bundled_script, piece
from tests.html_page import Page


def test_values_are_text_wherever_they_stand() -> None:
    hostile = "</table><img src=x onerror=alert(1)>\"'"
    table = Table(caption=hostile, head=["a", hostile], rows=[[hostile, Cell(hostile, hostile)]], foot=[hostile, 1])
    page = Page(str(piece("table", table)))
    assert page.all("img") == []
    assert page.text.count("onerror") == 6
    assert page.all("div")[0]["aria-label"] == hostile


def test_cells_have_notes_and_bars() -> None:
    rows = [["a", Cell(5, "4 to 7"), Cell("–", None), ShareCell(0.25), ShareCell(None)]]
    markup = str(piece("table", Table(caption="t", head=list("abcde"), rows=rows)))
    assert re.findall("<td>(.*?)</td>", markup) == [
        "5 <small>4 to 7</small>",
        "–",
        '<span class="bar" style="--v:25.0%">25.0</span>',
        "–",
    ]


@pytest.mark.parametrize(("folded", "begins"), [(True, "<details><summary>t"), (False, '<details open=""><summary>t')])
def test_a_table_may_be_folded(folded: bool, begins: str) -> None:
    table = Table(caption="t", head=["a"], rows=[["b"]], folded=folded)
    assert str(piece("table", table)).strip().startswith(begins)


@pytest.mark.parametrize(
    ("block", "markup"),
    [("a<b", "<p>a&lt;b</p>"), (["a", "<"], "<ul><li>a</li><li>&lt;</li></ul>"), (piece("cell", "&"), "&amp;")],
)
def test_a_block_is_a_paragraph_a_list_or_markup(block: object, markup: str) -> None:
    assert str(piece("block", block)).strip() == markup


def test_a_script_holds_each_module_once_before_those_that_use_it() -> None:
    script = bundled_script("page/page.js", "traffic/page/manual_count.js")
    assert not re.search(r"^(import|export) ", script, re.MULTILINE)
    assert script.count("const byId =") == 1
    assert script.index("const byId =") < script.index("const unpacked =") < script.index("const root =")
