"""Command line: mounts the three groups, and turns users' errors into one line and exit code 2."""

import sys
import warnings
from contextlib import nullcontext
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final, TextIO

import typer

from skope.errors import AssumptionWarning, UserError
from skope.eval.cli.app import app as eval_app
from skope.files.output_folders import replaceable_output
from skope.gen.cli.app import app as gen_app
from skope.terminal.command_options import DIR_METAVAR, CommandGroup, Commands, JsonOption, VersionOption, option
from skope.terminal.console import Console
from skope.train.cli import app as train_app


class _Root(CommandGroup):
    """The `skope` command itself; it reports an interrupt, at which typer would end silently."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            typer.echo("\nskope: stopped; run the same command again to resume or restart", err=True)
            raise typer.Exit(130) from None


HELP_TEXT: Final = "\n\n".join(
    (
        "Vehicles before fixed roadside cameras: synthetic images with 33 keypoints per vehicle, a detector that "
        "learns from them and comes with the package, and from footage tracks in metres, counts, speeds and conflicts.",
        "A dataset, a detector, its figures: skope gen, skope train, skope eval.",
        "A video to a report on traffic: skope eval predict, track, traffic; before that skope eval site draws camera "
        "and gates in the browser.",
    )
)
"""Text above the commands: purpose of the package, and order of the commands."""

app = Commands(
    cls=_Root,
    help=HELP_TEXT,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
for name, group, holds in (
    (
        "gen",
        gen_app,
        "Generate annotated roadside images: sites, vehicles, video; check, stats, show, report, view, convert, merge, "
        "doctor.",
    ),
    ("train", train_app, "Train a detector on them: export."),
    (
        "eval",
        eval_app,
        "Measure a detector: compare, view, calibrate-scores; and traffic: predict, track, pose, traffic, camera, "
        "site, station.",
    ),
):
    app.add_typer(group, name=name, short_help=holds)


@app.command(short_help="Check this machine: working and missing parts.")
def doctor(
    console: Console,
    pictures: Annotated[
        Path | None, option(metavar=DIR_METAVAR, help="Also simulate, and draw a test image with each renderer here.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Check what this machine has and lacks, and suggest fixes.

    Exit code 2 if a part is broken that a command needs.
    """
    from skope.doctor import STATUS_WORDS, examine

    findings = []
    drawn = (
        replaceable_output(pictures, "skope doctor", "the renderers", flag="--pictures") if pictures else nullcontext()
    )
    with drawn as folder:
        for finding in examine(folder):
            findings.append(finding)
            if not json:
                console.result(f"{STATUS_WORDS[finding.status]:<3} {finding.part:<17} {finding.text}")
    broken = [finding for finding in findings if finding.status == "broken"]
    if json:
        where = str(pictures) if pictures else None
        console.document({"works": not broken, "parts": [asdict(finding) for finding in findings], "pictures": where})
    elif broken:
        fails = dict.fromkeys(command for finding in broken for command in finding.fails)
        names = ", ".join(finding.part for finding in broken)
        console.result(f"not working: {names}; these commands fail: {', '.join(fails)}")
    else:
        console.result("all commands work" + ("" if pictures else "; --pictures DIR also draws test images"))
    if broken:
        raise typer.Exit(2)


_show_any_warning: Final = warnings.showwarning


def _show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: TextIO | None = None,
    line: str | None = None,
) -> None:
    """Print a warning on one line, without the position in the program."""
    if issubclass(category, AssumptionWarning):
        Console().warn(str(message))
    else:
        _show_any_warning(message, category, filename, lineno, file, line)


@app.callback()
def _root(version: VersionOption = False) -> None:
    pass


def main() -> None:
    """Entry point of the `skope` command."""
    warnings.showwarning = _show_warning
    try:
        app()
    except UserError as error:
        typer.echo(f"skope: {error}", err=True)
        sys.exit(2)
