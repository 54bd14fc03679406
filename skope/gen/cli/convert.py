"""`skope gen convert` and `merge`: datasets in the formats of other tools, and joined."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from skope.console import Console, QuietOption, VersionOption
from skope.errors import UserError


def convert(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH", help="What to read, and last the new folder.")],
    to: Annotated[
        str | None, typer.Option(help="folder, shards, coco, cvat, kitti, mot, skope3d or yolo.", show_default="folder")
    ] = None,
    source: Annotated[
        str | None, typer.Option("--from", help="coco, cvat or skope3d.", show_default="a dataset folder")
    ] = None,
    map_file: Annotated[
        Path | None, typer.Option("--map", help="JSON: what the keypoints of --from skope3d are in scheme skope33.")
    ] = None,
    images: Annotated[
        Path | None, typer.Option(help="Where the images of --from coco or cvat lie, if not beside the annotations.")
    ] = None,
    keypoints: Annotated[
        str | None, typer.Option(help="Names of the keypoints of --to yolo, separated by commas.", show_default="all")
    ] = None,
    split: Annotated[str | None, typer.Option(help="Split for all that is read.")] = None,
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Write a dataset in another format, or make one of files of another format (see docs/formats.md)."""
    from skope.gen.formats.convert import ConversionOptions
    from skope.gen.formats.convert import convert as write

    *sources, out = paths
    if not sources:
        raise UserError(f"{out}: name what to read and then the new folder")
    console = Console(quiet)
    options = ConversionOptions(
        map=map_file, images=images, split=split, keypoints=tuple(keypoints.split(",")) if keypoints else ()
    )
    write(sources, out, read_as=source, write_as=to, options=options, console=console)
    console.result(f"wrote {out}" + (f"; next: {_check(out)}" if to in (None, "folder", "shards") else ""))


def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH", help="Datasets, and last the new folder.")],
    quiet: QuietOption = False,
    version: VersionOption = False,
) -> None:
    """Join datasets: ids numbered anew, sites kept apart, splits as they are, licences united."""
    from skope.gen.formats.merge import merge as join

    *sources, out = paths
    console = Console(quiet)
    join(sources, out, console)
    console.result(f"wrote {out}; next: {_check(out)}")


def _check(out: Path) -> str:
    return shlex.join(["skope", "gen", "check", str(out)])
