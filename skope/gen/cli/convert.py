"""`skope gen convert` and `merge`: datasets in the formats of other tools, and joined."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from skope.errors import UserError
from skope.terminal.command_options import DIR, FILE_METAVAR, LIST, option
from skope.terminal.console import Console

_WRITTEN = ("folder", "shards", "coco", "cvat", "kitti", "mot", "skope3d", "yolo")
_READ = ("coco", "cvat", "skope3d")


def convert(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH", help="What to read, and last the new folder.")],
    console: Console,
    to: Annotated[str | None, option(choices=_WRITTEN, help="Format to write.", show_default="folder")] = None,
    source: Annotated[
        str | None, option("--from", choices=_READ, help="Format to read.", show_default="a dataset folder")
    ] = None,
    map_file: Annotated[
        Path | None,
        option("--map", metavar=FILE_METAVAR, help="JSON: what the keypoints of --from skope3d are in scheme skope33."),
    ] = None,
    images: Annotated[
        Path | None,
        option(metavar=DIR, help="Where the images of --from coco or cvat lie.", show_default="beside the annotations"),
    ] = None,
    keypoints: Annotated[
        str | None, option(metavar=LIST, help="Names of the keypoints of --to yolo.", show_default="all")
    ] = None,
    split: Annotated[str | None, option(metavar="NAME", help="Split for all that is read.")] = None,
    stored_pixels: Annotated[
        bool, option("--stored-pixels", help="Labels of --from coco or cvat are of pixels as stored, before EXIF.")
    ] = False,
) -> None:
    """Write a dataset in another format, or make one of files of another format (see docs/formats.md)."""
    from skope.gen.formats.convert import ConversionOptions
    from skope.gen.formats.convert import convert_dataset as write

    *sources, out = paths
    if not sources:
        raise UserError(f"{out}: name what to read and then the new folder")
    options = ConversionOptions(
        map=map_file,
        images=images,
        split=split,
        stored_pixels=stored_pixels,
        keypoints=tuple(keypoints.split(",")) if keypoints else (),
    )
    write(sources, out, read_as=source, write_as=to, options=options, console=console)
    console.result(f"wrote {out}" + (f"; next: {_check(out)}" if to in (None, "folder", "shards") else ""))


def merge(
    paths: Annotated[list[Path], typer.Argument(metavar="PATH", help="Datasets, and last the new folder.")],
    console: Console,
    vehicles_alone: Annotated[
        bool, option("--vehicles-alone", help="Leave out labels of people on foot and on two wheels.")
    ] = False,
) -> None:
    """Join datasets: ids numbered anew, sites kept apart, splits as they are, licences united."""
    from skope.gen.formats.merge import merge as join

    *sources, out = paths
    join(sources, out, console, vehicles_alone=vehicles_alone)
    console.result(f"wrote {out}; next: {_check(out)}")


def _check(out: Path) -> str:
    return shlex.join(["skope", "gen", "check", str(out)])
