"""`skope eval traffic`: counts, movements, speeds and conflicts from tracks."""

from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import typer

from skope.dataset.folder import FRAMES, PREDICTIONS
from skope.detector import weights
from skope.errors import UserError
from skope.eval.cli.options import FastMachineOptions, data_option, output
from skope.files.output_folders import claim_output
from skope.files.reading import sha256_of
from skope.terminal.command_options import DIR, FILE, LIST, SITE_FILE, TRAFFIC
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.site.marks import Gate
    from skope.site.site_file import SiteFile
    from skope.traffic.hand_count_file import HandCount
    from skope.traffic.observation import Observation
    from skope.traffic.report import TrafficReport

_COMMAND: Final = "skope eval traffic"


def traffic(
    source: Annotated[
        str,
        typer.Argument(
            metavar="TRACKS",
            help="Folder that `skope eval track` wrote; a video, which is tracked first; or, without a camera, what "
            "`skope eval predict` wrote.",
        ),
    ],
    *,
    site: Annotated[
        Path, data_option(metavar=FILE, help="Site file with gates, zones, lanes and settings (docs/own-road.md).")
    ] = SITE_FILE,
    begins: Annotated[
        str | None,
        data_option(
            metavar="TIME", help="When the footage begins, as 2026-11-26T10:00:00.", show_default="as the site says"
        ),
    ] = None,
    hand_count: Annotated[
        Path | None,
        data_option(
            metavar=FILE,
            help="CSV of what was counted by hand (gate,direction,class,begin,end,count); intervals learn from it.",
            show_default="nothing",
        ),
    ] = None,
    checkpoint: Annotated[
        Path, data_option(metavar="PATH", help="Of footage: what to detect with, as `skope eval predict` takes it.")
    ] = Path(weights.DEFAULT),
    also: Annotated[
        str,
        output(
            metavar=LIST,
            help="Also the files of other programs: excel, parquet, geojson, openlabel, otanalytics, ssam, sumo.",
            show_default="none",
        ),
    ] = "",
    out: Annotated[Path, output(metavar=DIR, help="Where to write.")] = TRAFFIC,
    hardware: FastMachineOptions,
    console: Console,
) -> None:
    """Measure traffic: counts by gate, turning movements, speeds, headways, queues and conflicts, with intervals."""
    from skope.site.site_file import read_site
    from skope.traffic.exports.formats import checked_formats
    from skope.traffic.measure import measure
    from skope.traffic.observation import FOOTAGE, read_observation
    from skope.traffic.read_tracks import TRACKS_CSV, read_trajectories, track_files

    read = read_site(site)
    for key in read.unknown:
        console.warn(f"{site}: {key}: unknown; not used")
    start = _start(begins, read)
    formats = checked_formats(also, read, metres=True)
    folder = Path(source)
    options = {"begins": None if start is None else start.isoformat()}
    if hand_count is not None:
        options["hand_count"] = sha256_of(hand_count)
    if (folder / TRACKS_CSV).is_file() or (folder.is_dir() and (folder / FOOTAGE).is_file()):
        observation = read_observation(folder)
        tracks = read_trajectories(folder, observation)
        counted = _counted_by_hand(hand_count, read, read.gates, start, observation)
        claim_output(out, _COMMAND, [*track_files(folder), site], options)
    elif (folder / FRAMES).is_file():
        for line in _report_in_image(folder, read, start, hand_count, out, options, also):
            console.result(line)
        return
    else:
        from skope.eval.cli.tracked_footage import TRACKS, tracked_footage

        if hand_count is not None:
            raise UserError(
                f"--hand-count: needs tracks, not footage: `{_COMMAND} {source} --site {site} --out {out}` first, then "
                f"`{_COMMAND} {out / TRACKS}` with --hand-count and another --out"
            )
        counted = ()
        folder = tracked_footage(source, read, checkpoint, hardware, out, _COMMAND, options, console)
        observation = read_observation(folder)
        tracks = read_trajectories(folder, observation)
    further = _claimed(out, [*track_files(folder), site], options, read, formats)
    for line in _written(measure(tracks, observation, read, start, counted), source, read, out, further):
        console.result(line)


def _claimed(
    out: Path, inputs: list[Path], options: dict[str, str | None], site: "SiteFile", formats: tuple[str, ...]
) -> dict[str, Path]:
    """A folder below `out` for each format: work of its own, as what lies there may depend on the site's camera.

    Raises UserError where one holds other work.
    """
    camera = None if site.camera is None else site.camera.camera.to_dict()
    for name in formats:
        claim_output(out / name, _COMMAND, inputs, {**options, "camera": camera})
    return {name: out / name for name in formats}


def _written(
    report: "TrafficReport", source: str, site: "SiteFile", out: Path, further: dict[str, Path]
) -> Iterator[str]:
    """Write a report, and in further formats to their folders; yields what was written and found."""
    from skope.traffic.exports.formats import write_format
    from skope.traffic.page.page import write_page
    from skope.traffic.report_text import report_lines
    from skope.traffic.write_report import write_report

    for name, folder in further.items():
        for path in write_format(name, folder, report, site.camera.camera if site.camera else None):
            yield f"wrote {path}"
    for path in (
        write_page(out, report, tracks=source),
        *write_report(out, report, tracks=source, revision=site.revision),
    ):
        yield f"wrote {path}"
    yield from report_lines(report)
    for line in report.refused:
        yield f"note: {line}"


def _report_in_image(
    folder: Path,
    site: "SiteFile",
    start: datetime | None,
    hand_count: Path | None,
    out: Path,
    options: dict[str, str | None],
    also: str,
) -> Iterator[str]:
    """Count by gates in the image what `skope eval predict` has followed.

    Raises UserError where the camera is known, or there are no such gates.
    """
    from skope.eval.tracking.image_trajectories import read_image_trajectories
    from skope.traffic.exports.formats import checked_formats
    from skope.traffic.image_counts import count_in_image

    if not site.image_gates:
        raise UserError(
            f"{folder}: holds what `skope eval predict` found, in pixels: `skope eval track {folder}` makes tracks in "
            f"metres of it where the camera is known; without, {site.path} needs image_gates"
        )
    formats = checked_formats(also, site, metres=False)
    tracks, observation = read_image_trajectories(folder)
    counted = _counted_by_hand(hand_count, site, site.image_gates, start, observation)
    inputs = [folder / FRAMES, folder / PREDICTIONS, site.path]
    claim_output(out, _COMMAND, inputs, options)
    further = _claimed(out, inputs, options, site, formats)
    report = count_in_image(tracks, observation, site, start, counted)
    yield from _written(report, str(folder), site, out, further)


def _counted_by_hand(
    path: Path | None, site: "SiteFile", gates: "Sequence[Gate]", start: datetime | None, observation: "Observation"
) -> "tuple[HandCount, ...]":
    """What `--hand-count` names; nothing where it names nothing. Raises UserError naming file, line and column."""
    from skope.traffic.clock import local_start
    from skope.traffic.hand_count_file import read_hand_counts

    if path is None:
        return ()
    begin = local_start(site) if start is None else start
    return read_hand_counts(path, gates, site.traffic, begin, observation)


def _start(text: str | None, site: "SiteFile") -> datetime | None:
    """The time that `--begins` gives, in the site's zone where it has none of its own.

    Raises UserError where it is none, or has no zone at all.
    """
    if text is None:
        return None
    from zoneinfo import ZoneInfo

    try:
        start = datetime.fromisoformat(text)
    except ValueError:
        raise UserError(f"--begins: expected a time like 2026-11-26T10:00:00, got {text!r:.40}") from None
    zone = ZoneInfo(site.time_zone) if site.time_zone else None
    if start.tzinfo is None and zone is None:
        raise UserError(f"--begins: {text} has no zone, as 2026-11-26T10:00:00+01:00 has, and {site.path} no time_zone")
    if start.tzinfo is None:
        return start.replace(tzinfo=zone)
    return start.astimezone(zone) if zone else start
