"""What a run has found so far, line by line, so that a stopped one goes on."""

import json
from pathlib import Path
from typing import Any

from skope.errors import UserError


class Progress:
    """Rows (JSON values) of a run in a file that is there only until the run is done.

    The file belongs to the work that its folder was claimed for: what is in it counts. Raises UserError where it
    cannot be written.
    """

    def __init__(self, path: Path, *, fresh: bool = False) -> None:
        self._path = path
        self.rows: list[Any] = []
        """Those that an earlier run left behind; none if `fresh`."""
        whole = []
        for line in path.read_text(encoding="utf-8").splitlines() if path.is_file() and not fresh else []:
            try:
                self.rows.append(json.loads(line))
            except json.JSONDecodeError:  # the line that was being written
                break
            whole.append(line + "\n")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text("".join(whole), encoding="utf-8")
        except OSError as error:
            raise UserError(f"{path.parent}: cannot be written: {error.strerror or error}") from None

    def add(self, row: Any) -> None:
        """Write a row down."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def end(self) -> None:
        """The run is done: its files say what was found."""
        self._path.unlink()
