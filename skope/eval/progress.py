"""What a run has found so far, line by line, so that a stopped one goes on."""

import itertools
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from skope.errors import UserError


class Progress:
    """Rows (JSON objects) of a run in a file that is there only until the run is done.

    The file belongs to the work that its folder was claimed for: what is in it counts. Raises UserError where it
    cannot be written.
    """

    def __init__(self, path: Path, fields: tuple[str, ...]) -> None:
        self._path = path
        self._fields = set(fields)
        self.count = 0
        """How many rows an earlier run left behind: objects with these `fields`, up to the first damaged one."""
        whole = 0
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.touch()
            with path.open("r+b") as file:
                for line in file:
                    if self._row(line) is None:
                        break
                    self.count += 1
                    whole += len(line)
                file.truncate(whole)
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be written: {error.strerror or error}") from None

    def _row(self, line: bytes) -> dict[str, Any] | None:
        try:
            row = json.loads(line) if line.endswith(b"\n") else None
        except ValueError:  # the line that was being written
            return None
        return row if isinstance(row, dict) and set(row) == self._fields else None

    def rows(self) -> Iterator[dict[str, Any]]:
        """All rows so far, from the file: of an hour of footage they are more than fits into memory."""
        with self._path.open("rb") as file:
            for row in itertools.takewhile(lambda row: row is not None, map(self._row, file)):
                assert row is not None
                yield row

    def add(self, row: dict[str, Any]) -> None:
        """Write a row down."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def end(self) -> None:
        """The run is done: its files say what was found."""
        self._path.unlink()
