"""`skope eval site`: calibrate a camera and draw a site in the browser."""

from pathlib import Path
from typing import Annotated, Any

import typer

from skope.errors import UserError
from skope.terminal.command_options import FILE_METAVAR, SITE_FILE, SIZE_METAVAR, PortOption, option
from skope.terminal.console import Console


def site(
    console: Console,
    footage: Annotated[
        str | None,
        typer.Argument(
            metavar="FOOTAGE",
            help="Image, folder of images or video of the camera. Not needed with --size, --points or an existing "
            "site file.",
        ),
    ] = None,
    site: Annotated[
        Path, option(metavar=FILE_METAVAR, help="Site file to open and save; it is created if missing.")
    ] = SITE_FILE,
    points: Annotated[
        Path | None,
        option(
            metavar=FILE_METAVAR,
            help="Initial points: OTVision's .otrfpts, or a CSV file with column,row,x,y,z.",
        ),
    ] = None,
    size: Annotated[
        str | None,
        option(metavar=SIZE_METAVAR, help="Size of the empty canvas if there is no footage.", show_default="800x600"),
    ] = None,
    port: PortOption = None,
) -> None:
    """Calibrate a camera and draw gates, zones and lanes in the browser; Ctrl-C ends it.

    Nothing leaves this machine, and nothing is written before you save.
    """
    from skope.camera.fit.camera_from_marks import image_size
    from skope.site.page.inputs import POINT_FILES, SiteFrames, loaded
    from skope.site.page.site_server import serve_site

    if footage is not None and size is not None:
        raise UserError("--size: is for an empty canvas; the footage has its own")
    if footage is None and size is None and points is None and not site.exists():
        raise UserError("FOOTAGE: needed; without any, --points and --size begin on an empty canvas")
    if footage is not None:
        frames = SiteFrames.of_footage(footage)
    else:
        width, height = image_size(size or "800x600")
        if not (16 <= width <= 8192 and 16 <= height <= 8192):
            raise UserError(f"--size: expected 16 to 8192 pixels, got {size}")
        frames = SiteFrames.canvas((width, height), points.name if points else "empty canvas")
    added: dict[str, Any] = {}
    if points is not None:
        if points.suffix.lower() not in POINT_FILES:
            raise UserError(f"--points: {points}: expected {' or '.join(POINT_FILES)}")
        if site.exists():
            raise UserError(f"--points: {site} is there already; load the points on the page, or choose another --site")
        found = loaded(points, frames.size)
        console.say(found.pop("said"))
        added = found
    serve_site(frames, site, added, port, console)
