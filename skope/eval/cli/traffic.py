"""`skope eval traffic`: counts, movements, speeds and conflicts from tracks."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from skope.dataset.folder import FRAMES_FILE, PREDICTIONS_FILE
from skope.detector import weights
from skope.errors import UserError
from skope.eval.cli.options import FastMachineOptions, data_option, output
from skope.files.atomic import sha256_of
from skope.files.output_folders import claim_output
from skope.terminal.command_options import DIR_METAVAR, FILE_METAVAR, LIST_METAVAR, SITE_FILE, TRAFFIC_FOLDER
from skope.terminal.console import Console

if TYPE_CHECKING:
    from skope.site.gates_zones_lanes import Gate
    from skope.site.site_file import SiteFile
    from skope.traffic.manual_count_file import ManualCount
    from skope.traffic.observation import Observation
    from skope.traffic.road_picture import EmptyRoadPicture
    from skope.traffic.traffic_report import TrafficReport

COMMAND_NAME: Final = "skope eval traffic"
START_TIME_FLAG: Final = "--start-time"


def traffic(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="TRACKS...",
            help="Output folders of `skope eval track`, for one or several recordings of one site; a video; or, "
            "without a camera, an output folder of `skope eval predict`.",
        ),
    ],
    *,
    site: Annotated[
        Path,
        data_option(metavar=FILE_METAVAR, help="Site file with gates, zones, lanes and settings (docs/own-road.md)."),
    ] = SITE_FILE,
    start_time: Annotated[
        list[str] | None,
        data_option(
            metavar="TIME",
            help="Start of the footage, as 2026-11-26T10:00:00. For several recordings give it once for each, in "
            "their order. The creation time of a video is not read.",
            show_default="start_time of the tracks (`skope eval track --start-time`, live streams), else the site file",
        ),
    ] = None,
    manual_count: Annotated[
        Path | None,
        data_option(
            metavar=FILE_METAVAR,
            help="CSV file of manual counts (gate,direction,class,begin,end,count). They narrow the count intervals; "
            "counts do not change.",
            show_default="none",
        ),
    ] = None,
    checkpoint: Annotated[
        Path, data_option(metavar="PATH", help="Detector for footage, as in `skope eval predict`.")
    ] = Path(weights.DEFAULT_WEIGHTS),
    export: Annotated[
        str,
        output(
            metavar=LIST_METAVAR,
            help="Additional output formats: excel, parquet, geojson, openlabel, otanalytics, ssam, sumo.",
            show_default="none",
        ),
    ] = "",
    out: Annotated[Path, output(metavar=DIR_METAVAR, help="Output folder.")] = TRAFFIC_FOLDER,
    hardware: FastMachineOptions,
    console: Console,
) -> None:
    """Measure traffic: counts by gate, turning movements, speeds, headways, queues and conflicts, with intervals."""
    from skope.site.site_file import read_site

    read = read_site(site)
    for key in read.unknown:
        console.warn(f"{site}: {key}: unknown; not used")
    for line in _report(sources, read, start_time or [], manual_count, out, export, checkpoint, hardware, console):
        console.result(line)


def _report(
    sources: list[str],
    site: "SiteFile",
    start_time: list[str],
    manual_count: Path | None,
    out: Path,
    export: str,
    checkpoint: Path,
    hardware: FastMachineOptions,
    console: Console,
) -> Iterator[str]:
    """Measure the sources: tracks in metres, detections in the image, or footage."""
    from skope.tracks.csv_file import TRACKS_CSV
    from skope.traffic.exports.formats import checked_formats
    from skope.traffic.observation import FOOTAGE_FILE

    formats = checked_formats(export, site, metres=True)
    folder = Path(sources[0])
    if len(sources) > 1 or (folder / TRACKS_CSV).is_file() or (folder.is_dir() and (folder / FOOTAGE_FILE).is_file()):
        return _report_of_tracks([Path(source) for source in sources], site, start_time, manual_count, out, formats)
    start = _only_begin(start_time, site)
    if (folder / FRAMES_FILE).is_file():
        return _report_in_image(folder, site, start, manual_count, out, export)
    return _report_of_footage(
        sources[0], site, start, manual_count, out, formats, export, checkpoint, hardware, console
    )


def _options(start_time: str | list[str] | None, manual_count: Path | None) -> dict[str, Any]:
    """Return the options that identify a run, in addition to its input files."""
    options: dict[str, Any] = {"start_time": start_time}
    if manual_count is not None:
        options["manual_count"] = sha256_of(manual_count)
    return options


def _report_of_tracks(
    folders: list[Path],
    site: "SiteFile",
    start_time: list[str],
    manual_count: Path | None,
    out: Path,
    formats: tuple[str, ...],
) -> Iterator[str]:
    """Measure the tracks of one or several recordings of the site."""
    from skope.tracks.csv_file import TRACKS_CSV
    from skope.traffic.gates import gates_on_road
    from skope.traffic.measure import measure
    from skope.traffic.observation import track_files
    from skope.traffic.recordings import read_recordings

    footage = read_recordings(folders, start_time, site, START_TIME_FLAG)
    observation, start = footage.observation, footage.start
    counted = _manual_counts_of(manual_count, site, gates_on_road(site.gates), start, observation)
    # With several recordings the files alone do not determine their start times.
    several = [
        f"{recording.begin.isoformat()} {sha256_of(recording.folder / TRACKS_CSV)[:12]}"
        for recording in footage.recordings
    ]
    options = _options(several or _isoformat(_only_begin(start_time, site)), manual_count)
    ordered = [recording.folder for recording in footage.recordings] or folders
    inputs = [*(path for folder in ordered for path in track_files(folder)), site.path]
    claim_output(out, COMMAND_NAME, inputs, options)
    further = _claimed(out, inputs, options, site, formats)
    report = measure(footage.tracks, observation, site, start, counted, recordings=footage.recordings)
    source = list(map(str, ordered)) if footage.recordings else str(folders[0])
    yield from _written(report, source, site, out, further, folders[0])


def _report_of_footage(
    source: str,
    site: "SiteFile",
    start: datetime | None,
    manual_count: Path | None,
    out: Path,
    formats: tuple[str, ...],
    export: str,
    checkpoint: Path,
    hardware: FastMachineOptions,
    console: Console,
) -> Iterator[str]:
    """Detect road users in a video and measure traffic: in metres with a camera, else at gates in the image."""
    from skope.eval.cli.tracked_footage import (
        SEEN_NAME,
        TRACKS_NAME,
        detected_footage,
        recorded_video,
        site_at_size,
        skipped_lines,
        tracked_footage,
    )
    from skope.tracks.csv_file import TRACKS_CSV, read_tracks
    from skope.traffic.exports.formats import checked_formats
    from skope.traffic.measure import measure
    from skope.traffic.observation import read_observation, track_files

    again = out / (SEEN_NAME if site.camera is None else TRACKS_NAME)
    if manual_count is not None:
        raise UserError(
            f"--manual-count: expected a folder, got footage; run `{COMMAND_NAME} {source} --site {site.path} --out "
            f"{out}` first, then `{COMMAND_NAME} {again} --site {site.path}` with --manual-count and another --out"
        )
    draw = f"`skope eval site {source} --site {site.path}`"
    if site.camera is None and not any(gate.pixels for gate in site.gates):
        raise UserError(
            f"{site.path}: gates: expected a gate drawn in the image (`pixels`), or a [camera] for metres, got "
            f"neither; use {draw} to draw gates and calibrate the camera"
        )
    if not site.gates:
        console.warn(
            f"{site.path}: has no gates: nothing will be counted; use {draw} to draw gates, then `{COMMAND_NAME} "
            f"{again}` to count without detecting again"
        )
    options = _options(_isoformat(start), None)
    if site.camera is None:
        checked_formats(export, site, metres=False)
    footage = recorded_video(source)
    site = site_at_size(site, footage, console)
    if site.camera is None:
        folder = detected_footage(footage, site, checkpoint, hardware, out, COMMAND_NAME, options, console)
        yield from _counted_in_image(folder, source, site, start, None, out, export, options)
        return
    folder = tracked_footage(footage, site, checkpoint, hardware, out, COMMAND_NAME, options, console)
    observation = read_observation(folder)
    tracks = read_tracks(folder / TRACKS_CSV)
    further = _claimed(out, [*track_files(folder), site.path], options, site, formats)
    report = _with_skipped(measure(tracks, observation, site, start), skipped_lines(out / SEEN_NAME))
    yield from _written(report, source, site, out, further, folder)


def _with_skipped(report: "TrafficReport", skipped: list[str]) -> "TrafficReport":
    """Return the report with a note on each part of the footage that could not be read."""
    return replace(report, notes=(*report.notes, *(f"not read in the footage: {line}" for line in skipped)))


def _claimed(
    out: Path, inputs: list[Path], options: dict[str, Any], site: "SiteFile", formats: tuple[str, ...]
) -> dict[str, Path]:
    """Claim a folder below `out` for each format. It is claimed separately because it may depend on the site's camera.

    Raises:
        UserError: A folder has the output of another run.
    """
    camera = None if site.camera is None else site.camera.camera.to_dict()
    for name in formats:
        claim_output(out / name, COMMAND_NAME, inputs, {**options, "camera": camera})
    return {name: out / name for name in formats}


def _written(
    report: "TrafficReport",
    source: str | list[str],
    site: "SiteFile",
    out: Path,
    further: dict[str, Path],
    tracks: Path | None = None,
    view: "EmptyRoadPicture | None" = None,
) -> Iterator[str]:
    """Write a report, and its additional formats to their folders; yield the lines to print.

    The background of the map is the image of the road in the folder `tracks`. The background of the gates is the camera
    image in `tracks`, or `view` without `tracks`.
    """
    from skope.traffic.exports.formats import write_format
    from skope.traffic.page.page import write_page
    from skope.traffic.road_picture import read_empty_road_picture, read_road_picture
    from skope.traffic.traffic_report import report_lines
    from skope.traffic.write_report import write_traffic_report

    # Camera of the tracks, at the size of the footage. Several recordings may have different cameras.
    camera = report.observation.camera or (site.camera.camera if site.camera else None)
    for name, folder in further.items():
        for path in write_format(name, folder, report, camera):
            yield f"wrote {path}"
    road = None if tracks is None else read_road_picture(tracks)
    view = view if tracks is None else read_empty_road_picture(tracks)
    source_text = ", ".join([source] if isinstance(source, str) else source)
    for path in (
        write_page(out, report, tracks=source_text, road=road, camera=camera, view=view),
        *write_traffic_report(out, report, tracks=source, revision=site.revision),
    ):
        yield f"wrote {path}"
    yield from report_lines(report)
    for line in report.notes:
        yield f"note: {line}"


def _report_in_image(
    folder: Path,
    site: "SiteFile",
    start: datetime | None,
    manual_count: Path | None,
    out: Path,
    export: str,
) -> Iterator[str]:
    """Count tracks of `skope eval predict` at gates in the image.

    Raises:
        UserError: The site has no such gates, or they were drawn in an image of another aspect ratio.
    """
    from skope.dataset import coco
    from skope.eval.cli.tracked_footage import gates_at_size

    if not any(gate.pixels for gate in site.gates):
        raise UserError(
            f"{folder}: contains detections in pixels: with a known camera, run `skope eval track {folder}` for tracks "
            f"in metres; without, {site.path} needs gates with `pixels`"
        )
    images = coco.read(folder / FRAMES_FILE).images
    if images:
        site = gates_at_size(site, (images[0].width, images[0].height))
    options = _options(_isoformat(start), manual_count)
    yield from _counted_in_image(folder, str(folder), site, start, manual_count, out, export, options, claim=True)


def _counted_in_image(
    folder: Path,
    source: str,
    site: "SiteFile",
    start: datetime | None,
    manual_count: Path | None,
    out: Path,
    export: str,
    options: dict[str, Any],
    *,
    claim: bool = False,
) -> Iterator[str]:
    """Count the detections in a folder at the site's gates, in pixels of its images.

    `claim`: whether the output folder must still be claimed.
    """
    from skope.dataset import coco
    from skope.eval.cli.tracked_footage import skipped_lines
    from skope.tracking.ground_view import empty_road
    from skope.tracking.image_trajectories import read_image_trajectories
    from skope.traffic.exports.formats import checked_formats
    from skope.traffic.gates import gates_in_image
    from skope.traffic.image_counts import count_in_image
    from skope.traffic.recordings import begin_of
    from skope.traffic.road_picture import empty_road_picture

    formats = checked_formats(export, site, metres=False)
    gates = gates_in_image(site.gates)
    tracks, observation, notes = read_image_trajectories(folder, gates)
    begin = begin_of(start, observation, site)
    counted = _manual_counts_of(manual_count, site, gates, begin, observation)
    inputs = [folder / FRAMES_FILE, folder / PREDICTIONS_FILE, site.path]
    if claim:
        claim_output(out, COMMAND_NAME, inputs, options)
    further = _claimed(out, inputs, options, site, formats)
    report = _with_skipped(count_in_image(tracks, observation, site, begin, counted), skipped_lines(folder))
    if site.camera is not None:
        # Without this note a reader could take the counts for those of the site's camera.
        notes = [
            f"the site file has a camera, but {folder} has detections in pixels: run `skope eval track {folder}` with "
            f"--camera and --out TRACKS, then `{COMMAND_NAME} TRACKS --site {site.path}`",
            *notes,
        ]
    report = replace(report, notes=(*report.notes, *notes))
    try:
        road = empty_road(folder, coco.read(folder / FRAMES_FILE))
        view = None if road is None else empty_road_picture(road, observation.times_s)
    except UserError as error:
        view = None
        yield f"note: the page has no image of the road: {error}"
    yield from _written(report, source, site, out, further, view=view)


def _manual_counts_of(
    path: Path | None, site: "SiteFile", gates: "Sequence[Gate]", start: datetime | None, observation: "Observation"
) -> "tuple[ManualCount, ...]":
    """Return the counts of `--manual-count`, if given.

    Raises:
        UserError: The file is invalid. The message names file, line and column.
    """
    from skope.traffic.counting_intervals import local_start
    from skope.traffic.manual_count_file import read_manual_counts

    if path is None:
        return ()
    begin = local_start(site) if start is None else start
    return read_manual_counts(path, gates, site.traffic, begin, observation)


def _isoformat(time: datetime | None) -> str | None:
    return None if time is None else time.isoformat()


def _only_begin(start_time: list[str], site: "SiteFile") -> datetime | None:
    """Return the `--start-time` of one recording. Raises UserError if several are given, or the text is not a time."""
    from skope.traffic.recordings import parse_start_time

    if len(start_time) > 1:
        raise UserError(f"{START_TIME_FLAG}: expected one time for one recording, got {len(start_time)}")
    return parse_start_time(start_time[0], site, START_TIME_FLAG) if start_time else None
