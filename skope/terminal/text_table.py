"""Tables of plain text, as commands print them."""

from collections.abc import Iterable, Sequence
from typing import Final

_ALIGNMENTS: Final = {"l": "left", "r": "right"}


def text_table(head: Sequence[str], rows: Iterable[Sequence[object]], align: str = "l") -> list[str]:
    """The lines of a table, its head first.

    Args:
        head: Titles of the columns.
        rows: Cells of each row, as they are to be shown.
        align: "l" or "r" for each column: at which side its cells stand; columns that are not named stand right.
    """
    from tabulate import tabulate  # only where something is printed

    sides = [_ALIGNMENTS[side] for side in align.ljust(len(head), "r")]
    cells = [[str(cell) for cell in row] for row in rows]
    text = tabulate(cells, headers=list(head), tablefmt="plain", colalign=sides, disable_numparse=True)
    return [line.rstrip() for line in text.split("\n")]
