"""Export formats of a traffic report for other programs, by name."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.camera.model import Camera
from skope.errors import UserError

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts
    from skope.traffic.traffic_report import TrafficReport

EXPORT_FORMATS: Final[Mapping[str, str]] = {
    "excel": "a workbook",
    "parquet": "tables with types",
    "geojson": "gates, tracks and conflicts on the map",
    "openlabel": "ASAM OpenLABEL",
    "otanalytics": "tracks and gates",
    "ssam": "FHWA's surrogate safety model",
    "sumo": "counts for routeSampler and flowrouter",
}
"""Formats by name, with a short description each."""
IN_PIXELS: Final = frozenset({"excel", "parquet", "otanalytics"})
"""Formats that do not need metres."""


def checked_formats(text: str, site: "SiteParts", *, metres: bool) -> tuple[str, ...]:
    """Read a list of formats.

    Args:
        text: Names with commas between.
        site: The site that is exported with the tracks.
        metres: Whether the tracks are in metres.

    Returns:
        The names, each once, in the order of `EXPORT_FORMATS`.

    Raises:
        UserError: A name is not a format, or the format needs metres, a library, or an entry of the site file that is
            missing.
    """
    from skope.site.world import on_earth
    from skope.traffic.exports.parquet import check_parquet
    from skope.traffic.exports.sumo import edges_of

    names = [name.strip() for name in text.split(",") if name.strip()]
    for name in names:
        if name not in EXPORT_FORMATS:
            raise UserError(f"--export: expected some of {', '.join(EXPORT_FORMATS)}, got {name!r:.40}")
        if not metres and name not in IN_PIXELS:
            raise UserError(f"--export: {name} needs metres, and positions are in pixels")
    if "geojson" in names:
        on_earth(site.world, np.zeros((1, 2)))
    if "sumo" in names:
        edges_of(site)
    if "parquet" in names:
        check_parquet()
    return tuple(name for name in EXPORT_FORMATS if name in names)


def write_format(name: str, folder: Path, report: "TrafficReport", camera: Camera | None) -> list[Path]:
    """Write a report in a format to a folder; return the files.

    Args:
        name: One of `EXPORT_FORMATS`.
        folder: The folder.
        report: The report.
        camera: The camera of the footage; None: not known.

    Raises:
        UserError: The report or the site lacks an entry that the format needs.
    """
    from skope.traffic.exports.excel import write_excel
    from skope.traffic.exports.geojson import write_geojson
    from skope.traffic.exports.openlabel import write_openlabel
    from skope.traffic.exports.otanalytics import write_otanalytics
    from skope.traffic.exports.parquet import write_parquet
    from skope.traffic.exports.ssam import write_ssam
    from skope.traffic.exports.sumo import write_sumo

    writers: dict[str, Callable[[Path, TrafficReport], list[Path]]] = {
        "excel": write_excel,
        "parquet": write_parquet,
        "geojson": write_geojson,
        "openlabel": write_openlabel,
        "otanalytics": lambda folder, report: write_otanalytics(folder, report, camera),
        "ssam": write_ssam,
        "sumo": write_sumo,
    }
    return writers[name](folder, report)
