"""`skope eval view`: look through what a detector found."""

from pathlib import Path
from typing import Annotated

import typer

from skope.terminal.command_options import PortOption
from skope.terminal.console import Console


def view(
    results: Annotated[
        Path, typer.Argument(metavar="RESULTS", help="Folder that `skope eval` or `skope eval predict` wrote.")
    ],
    console: Console,
    port: PortOption = None,
) -> None:
    """Look through predictions beside ground truth in the browser, misses and false alarms first; Ctrl-C ends it."""
    from skope.eval.view.results_folder import read_results_folder
    from skope.viewer.server import serve

    serve(read_results_folder(results, console), port, console)
