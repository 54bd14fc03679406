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
    """The lines of a table, its head first.

    Args:
        head: Titles of the columns.
        rows: Cells of each row, as they are to be shown.
        align: "l" or "r" for each column: at which side its cells stand; columns that are not named stand right.
    """
    from tabulate import tabulate  # only where something is printed

    sides = [COLUMN_ALIGNMENTS[side] for side in align.ljust(len(head), "r")]
    cells = [[str(cell) for cell in row] for row in rows]
    text = tabulate(cells, headers=list(head), tablefmt="plain", colalign=sides, disable_numparse=True)
    return [line.rstrip() for line in text.split("\n")]


T = TypeVar("T")

_QUIET_S: Final = 30.0
"""Maximum interval between progress lines in a log, seconds."""


@dataclass(frozen=True)
class Console:
    """Commentary and progress, which `--quiet` silences, and results, which it does not."""

    quiet: bool = False

    def say(self, text: str) -> None:
        """Print a line of commentary, unless quiet; above the bar where one is shown."""
        if not self.quiet:
            with tqdm.external_write_mode():
                typer.echo(text)

    def warn(self, text: str) -> None:
        """Print a line on something that may make a result wrong, always, and beside the results: on standard error."""
        with tqdm.external_write_mode():
            typer.echo(f"warning: {text}", err=True)

    def result(self, text: str) -> None:
        """Print a line that the command was run for, always."""
        typer.echo(text)

    def document(self, value: Any) -> None:
        """Print what the command was run for as one JSON document, always."""
        typer.echo(json.dumps(value, indent=1, allow_nan=False))

    def bar(self, items: Iterable[T] | None = None, *, total: int | None = None, unit: str, label: str) -> "tqdm[T]":
        """Make a progress bar with rate and time left; where there is no terminal it prints lines.

        Args:
            items: What it goes through; None: it is updated by hand.
            total: Number of steps; None: that of `items`, if it has a length.
            unit: What a step is, in the singular.
            label: What is being done.

        Returns:
            The bar, which gives the items; it draws nothing on a quiet console.
        """
        kind = tqdm if sys.stderr.isatty() else _Lines
        return kind(items, total=total, unit=unit, desc=label, disable=self.quiet, dynamic_ncols=True)


class SilentConsole(Console):
    """For callers in Python: what was found is what a function returns, and nothing is printed but warnings."""

    def __init__(self) -> None:
        super().__init__(quiet=True)

    def result(self, text: str) -> None:
        """Print nothing."""

    def document(self, value: Any) -> None:
        """Print nothing."""


class _Lines(tqdm):  # type: ignore[misc]
    """A bar for logs: a plain line each tenth of the way, or each half minute."""

    disable = True
    """Until tqdm has begun: an interrupt may come before that, and `close` after it."""

    def __init__(self, *args: Any, **options: Any) -> None:
        self._told, self._told_at = 0, time.monotonic()
        # tqdm must draw somewhere: here that is thrown away.
        super().__init__(*args, **{**options, "file": io.StringIO(), "mininterval": 0.5})

    def display(self, *_: Any, **__: Any) -> bool:
        """Called by tqdm whenever a bar would be drawn anew."""
        tenth = self.total and self.n - self._told >= self.total / 10
        if tenth or time.monotonic() - self._told_at >= _QUIET_S:
            self._tell()
        return True

    def close(self) -> None:
        if not self.disable and self.n != self._told:
            self._tell()
        super().close()

    def _tell(self) -> None:
        self._told, self._told_at = self.n, time.monotonic()
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
    """A number of things in words: 1 image, 2 images."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def disk_size(size: float) -> str:
    """Format a number of bytes: 7 MB, 1.4 GB."""
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"


def minutes(seconds: float) -> str:
    """A duration as people say it: 40 s, 12 min, 3.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 6000 else f"{seconds / 3600:.1f} h"
