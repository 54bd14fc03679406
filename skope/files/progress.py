"""File of the results of an unfinished run, one per line, from which the run resumes."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from skope.errors import UserError
from skope.files.atomic import hold_lock, writing
from skope.files.json_files import json_bytes, parse_json


class Progress:
    """Rows (JSON objects) of a run in a file that exists only until the run is done.

    The file belongs to the run that the folder was claimed for, so its content is valid.

    Raises:
        UserError: The file cannot be written, or another run is writing it.
    """

    def __init__(self, path: Path, fields: tuple[str, ...]) -> None:
        self._path = path
        self._fields = set(fields)
        self.count = 0
        """Number of rows from an earlier run: objects with these `fields`, up to the first damaged one."""
        whole = 0
        with writing(self._path.parent):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._file = self._locked()
            for line in self._file:
                if self._row(line) is None:
                    break
                self.count += 1
                whole += len(line)
            self._file.truncate(whole)

    def _locked(self) -> IO[bytes]:
        """Open and lock the file until it is closed or the process ends."""
        try:
            return hold_lock(self._path)
        except BlockingIOError:
            raise UserError(f"{self._path.parent}: another run is at work here; wait for it, or stop it") from None

    def _row(self, line: bytes) -> dict[str, Any] | None:
        try:
            row = parse_json(line) if line.endswith(b"\n") else None
        except ValueError:  # the line that was being written when the run stopped
            return None
        return row if isinstance(row, dict) and set(row) == self._fields else None

    def rows(self) -> Iterator[dict[str, Any]]:
        """Yield all rows so far from the file, because those of an hour of footage do not fit into memory."""
        with self._path.open("rb") as file:
            for row in itertools.takewhile(lambda row: row is not None, map(self._row, file)):
                assert row is not None
                yield row

    def add(self, row: dict[str, Any]) -> None:
        """Append a row to the file."""
        with writing(self._path.parent):
            self._file.write(json_bytes(row) + b"\n")
            self._file.flush()

    def end(self) -> None:
        """Remove the file, because the run is complete."""
        self._path.unlink()
        self._file.close()
