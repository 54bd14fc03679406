"""Messages, results, tables and progress bars of commands."""

import io
import json
import sys
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import typer
from tqdm import tqdm

COLUMN_ALIGNMENTS: Final = {"l": "left", "r": "right"}


def text_table(head: Sequence[str], rows: Iterable[Sequence[object]], align: str = "l") -> list[str]:
    """Return the lines of a table, with its head first.

    Args:
        head: Titles of the columns.
        rows: Cells of each row, as texts.
        align: "l" or "r" for each column, the side at which its cells are aligned; further columns are aligned right.
    """
    from tabulate import tabulate  # imported only to print a table

    sides = [COLUMN_ALIGNMENTS[side] for side in align.ljust(len(head), "r")]
    cells = [[str(cell) for cell in row] for row in rows]
    text = tabulate(cells, headers=list(head), tablefmt="plain", colalign=sides, disable_numparse=True)
    return [line.rstrip() for line in text.split("\n")]


T = TypeVar("T")

_QUIET_S: Final = 30.0
"""Maximum interval between progress lines in a log, seconds."""


@dataclass(frozen=True)
class Console:
    """Output of a command: messages and progress, which `--quiet` silences, and results, which it does not."""

    quiet: bool = False

    def say(self, text: str) -> None:
        """Print a message, unless quiet; above the progress bar if there is one."""
        if not self.quiet:
            with tqdm.external_write_mode():
                typer.echo(text)

    def warn(self, text: str) -> None:
        """Print a warning that a result may be wrong, always, on standard error."""
        with tqdm.external_write_mode():
            typer.echo(f"warning: {text}", err=True)

    def result(self, text: str) -> None:
        """Print a line of the result, always."""
        typer.echo(text)

    def document(self, value: Any) -> None:
        """Print the result as one JSON document, always."""
        typer.echo(json.dumps(value, indent=1, allow_nan=False))

    def bar(self, items: Iterable[T] | None = None, *, total: int | None = None, unit: str, label: str) -> "tqdm[T]":
        """Return a progress bar with rate and remaining time; without a terminal it prints lines.

        Args:
            items: Items to iterate over; None: the caller updates the bar.
            total: Number of steps; None: that of `items`, if it has a length.
            unit: Name of a step, in the singular.
            label: Description of the activity.

        Returns:
            The bar, which yields the items; it draws nothing on a quiet console.
        """
        kind = tqdm if sys.stderr.isatty() else _Lines
        return kind(items, total=total, unit=unit, desc=label, disable=self.quiet, dynamic_ncols=True)


class SilentConsole(Console):
    """Console for callers in Python, which use return values: only warnings are printed."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def result(self, text: str) -> None:
        """Print nothing."""

    def document(self, value: Any) -> None:
        """Print nothing."""


class _Lines(tqdm):  # type: ignore[misc]
    """Progress bar for logs: a plain line for each tenth, or each half minute."""

    disable = True
    """True until tqdm has started, because an interrupt before that calls `close`."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._printed_count, self._printed_at = 0, time.monotonic()
        # tqdm must draw to some file, which is discarded.
        super().__init__(*args, **{**options, "file": io.StringIO(), "mininterval": 0.5})

    def display(self, *_: Any, **__: Any) -> bool:
        """Called by tqdm whenever a bar would be redrawn."""
        tenth = self.total and self.n - self._printed_count >= self.total / 10
        if tenth or time.monotonic() - self._printed_at >= _QUIET_S:
            self._tell()
        return True

    def close(self) -> None:
        if not self.disable and self.n != self._printed_count:
            self._tell()
        super().close()

    def _tell(self) -> None:
        self._printed_count, self._printed_at = self.n, time.monotonic()
        elapsed = self.format_dict["elapsed"]
        words = f"{self.desc}: {self.n}"
        if self.total:
            words += f" of {self.total} {self.unit}s ({self.n / self.total:.0%})"
            if 0 < self.n < self.total:
                words += f", {minutes(elapsed * (self.total - self.n) / self.n)} left"
        else:
            words += f" {self.unit}s in {minutes(elapsed)}"
        typer.echo(f"{words}, {self.postfix}" if self.postfix else words, err=True)


def counted(number: int, noun: str) -> str:
    """Return a count with its noun: 1 image, 2 images."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def disk_size(size: float) -> str:
    """Format a number of bytes: 7 MB, 1.4 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def minutes(seconds: float) -> str:
    """Return a duration in words: 40 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
