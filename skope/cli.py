"""The command line: mounts the three groups and turns users' errors into one line and exit code 2."""

import sys
from typing import Any

import typer
from typer.core import TyperGroup

from skope.errors import UserError
from skope.eval.cli.app import app as eval_app
from skope.gen.cli.app import app as gen_app
from skope.terminal.command_options import Commands
from skope.train.cli import app as train_app


class _Root(TyperGroup):
    """The `skope` command itself, which says that it was stopped: typer would end without a word."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("\nskope: stopped; the same command goes on from here, or begins again", err=True)
            raise typer.Exit(130) from None


app = Commands(
    cls=_Root,
    help="Synthetic roadside images with 33 keypoints per vehicle, a detector trained on them, and its measurement.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
app.add_typer(gen_app, name="gen")
app.add_typer(train_app, name="train")
app.add_typer(eval_app, name="eval")


@app.callback()
def _root() -> None:
    pass


def main() -> None:
    """Entry point of the `skope` command."""
    try:
        app()
    except UserError as error:
        typer.echo(f"skope: {error}", err=True)
        sys.exit(2)
