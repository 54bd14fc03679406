"""What a run has found so far, line by line, so that a stopped one goes on."""

import json
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
        self.rows: list[dict[str, Any]] = []
        """Those that an earlier run left behind, objects with these `fields`, up to the first damaged one."""
        whole = []
        for line in path.read_bytes().splitlines() if path.is_file() else []:
            try:
                row = json.loads(line)
            except ValueError:  # the line that was being written
                break
            if not isinstance(row, dict) or set(row) != set(fields):
                break
            self.rows.append(row)
            whole.append(line + b"\n")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(b"".join(whole))
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be written: {error.strerror or error}") from None

    def add(self, row: dict[str, Any]) -> None:
        """Write a row down."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def end(self) -> None:
        """The run is done: its files say what was found."""
        self._path.unlink()
