"""`skope eval compare`: evaluations side by side."""

from pathlib import Path
from typing import Annotated

import typer

from skope.eval.cli.options import PROTOCOL_CHOICES
from skope.terminal.command_options import FILE_METAVAR, option
from skope.terminal.console import Console


def compare_runs(
    folders: Annotated[
        list[Path], typer.Argument(metavar="FOLDER", help="Folders that `skope eval` wrote (its --out).")
    ],
    console: Console,
    protocol: Annotated[str, option(choices=PROTOCOL_CHOICES, help="What the table shows.")] = "pooled",
    out: Annotated[Path | None, option(metavar=FILE_METAVAR, help="Also write everything to this JSON file.")] = None,
) -> None:
    """Put evaluations side by side, with paired intervals of their differences from the first."""
    from skope.eval.report import compare
    from skope.files.json_files import json_bytes
    from skope.files.output_folders import write_new

    document = compare.compare(folders)
    text = compare.render_comparison(document, protocol)
    if out:
        write_new(out, json_bytes(document))
    console.result(text)
