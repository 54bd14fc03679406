"""The command line: mounts the three groups and turns users' errors into one line and exit code 2."""

import sys

import typer

from skope.console import VersionOption
from skope.errors import UserError
from skope.eval.cli import app as eval_app
from skope.gen.cli import app as gen_app
from skope.train.cli import app as train_app

app = typer.Typer(
    help="Synthetic roadside images with 33 keypoints per vehicle, a detector trained on them, and its measurement.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    add_completion=False,
)
app.add_typer(gen_app, name="gen")
app.add_typer(train_app, name="train")
app.add_typer(eval_app, name="eval")


@app.callback()
def _root(version: VersionOption = False) -> None:
    pass


def main() -> None:
    """Entry point of the `skope` command."""
    try:
        app()
    except UserError as error:
        typer.echo(f"skope: {error}", err=True)
        sys.exit(2)
    except KeyboardInterrupt:
        typer.echo("skope: stopped; the same command goes on from here", err=True)
        sys.exit(130)
