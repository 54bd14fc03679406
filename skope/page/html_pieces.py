"""Small pieces of HTML and SVG that the charts, the gallery and the page are made of."""

from collections.abc import Sequence
from html import escape
from typing import Final

_VOID: Final = ("img",)
"""Elements that have no end."""


def tag(name: str, *children: str, **attributes: object) -> str:
    """Write an HTML element.

    Args:
        name: Name of the element.
        children: Markup inside it; elements that have no content ignore it.
        attributes: Attributes, which are escaped; None leaves one out, `class_` is class and `aria_label` aria-label.

    Returns:
        The element as markup.
    """
    written = "".join(
        f' {key.rstrip("_").replace("_", "-")}="{escape(str(value), quote=True)}"'
        for key, value in attributes.items()
        if value is not None
    )
    return f"<{name}{written}>" if name in _VOID else f"<{name}{written}>{''.join(children)}</{name}>"


def percent_text(value: float | None) -> str:
    """A share in percent, "–" where there was nothing to divide by."""
    return "–" if value is None else f"{100 * value:.1f} %"


def plain(value: float | None, digits: int = 3) -> str:
    """A number with `digits` decimals, "–" for None."""
    return "–" if value is None else f"{value:.{digits}f}"


def table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    *,
    caption: str,
    sortable: bool = False,
    foot: Sequence[str] = (),
    sticky: bool = False,
) -> str:
    """Write an HTML table.

    Args:
        head: Headings of the columns, plain text.
        rows: Cells of each row, markup; the first one is the row's header.
        caption: Plain text. Of a sticky table it is the label only, as it would scroll away: write a title above it.
        sortable: Headings are buttons, by which the page's script sorts.
        foot: Cells of a row of totals, markup; empty for none.
        sticky: Headings and the first column stay visible while the table scrolls in its box; useful for long tables.

    Returns:
        The table as markup, in a box that scrolls.
    """
    titles = [tag("button", escape(title), type="button") if sortable else escape(title) for title in head]
    top = tag("tr", *(tag("th", title, scope="col") for title in titles))
    body, total = (
        [tag("tr", tag("th", row[0], scope="row"), *(tag("td", cell) for cell in row[1:])) for row in part]
        for part in (rows, [foot] if foot else [])
    )
    inner = tag(
        "table",
        *([] if sticky else [tag("caption", escape(caption))]),
        tag("thead", top),
        tag("tbody", *body),
        *([tag("tfoot", *total)] if total else []),
        class_="sortable" if sortable else None,
    )
    return tag(
        "div", inner, class_="scroll sticky" if sticky else "scroll", tabindex=0, role="region", aria_label=caption
    )


def share_bar(value: float | None) -> str:
    """A share in percent with a bar behind it."""
    if value is None:
        return "–"
    return f'<span class="bar" style="--v:{100 * value:.1f}%">{100 * value:.1f}</span>'


def details(summary: str, *children: str, opened: bool = False) -> str:
    """Write a section that opens when its summary is clicked.

    Args:
        summary: The line that is always shown, plain text.
        children: Markup of the section.
        opened: Show the section from the beginning.

    Returns:
        The section as markup.
    """
    return tag("details", tag("summary", escape(summary)), *children, open="" if opened else None)
