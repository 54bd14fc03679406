"""Page of a traffic report: one self-contained HTML file for reading and printing."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from markupsafe import Markup

from skope.camera.model import Camera
from skope.confidence_level import INTERVAL_SIGMAS
from skope.files.atomic import write_text
from skope.page.svg import tag
from skope.page.templates import Cell, Table, render
from skope.schema import VEHICLE_CATEGORY
from skope.terminal.console import counted
from skope.tracks.track import KMH_PER_MPS
from skope.traffic.count_uncertainty import in_words
from skope.traffic.left_out_crossings import left_out_crossings
from skope.traffic.length_bins import LENGTH_MODEL, NO_BIN
from skope.traffic.page.charts import (
    counts_over_time,
    flow_diagram,
    headway_histograms,
    movement_matrices,
    speed_histograms,
)
from skope.traffic.page.count_tables import (
    Block,
    all_by_interval,
    class_tables,
    peak_hour_table,
    side_name,
)
from skope.traffic.page.gates_in_picture import gates_in_picture
from skope.traffic.page.manual_count import manual_count_json
from skope.traffic.page.road_map import road_map
from skope.traffic.report_tables import clock
from skope.traffic.road_picture import EmptyRoadPicture, RoadPicture
from skope.traffic.speeds import MOTOR_TRAFFIC, SPEED_PERCENTILES, Percentile
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import TurningMovementCount
from skope.version import __version__

REPORT_FILE: Final = "report.html"


@dataclass(frozen=True)
class ReportPage:
    """Limits of the report page."""

    conflicts: int = 20
    """Maximum number of conflicts in the table."""
    seconds_to_minutes: float = 2.0
    """Observed time below which it is given in seconds, minutes."""
    hours_from_minutes: int = 120
    """Observed time from which it is given in hours, minutes."""
    most_left_out: int = 30
    """Maximum number of rows in a table of crossings that are not counted."""


REPORT_PAGE: Final = ReportPage()


def write_page(
    out: Path,
    report: TrafficReport,
    *,
    tracks: str,
    road: RoadPicture | None = None,
    camera: Camera | None = None,
    view: EmptyRoadPicture | None = None,
) -> Path:
    """Write a report as `report.html`.

    Args:
        out: The folder of the report.
        report: The report.
        tracks: Name of the folder or file that the tracks were read from.
        road: Image of the empty road from above, as the background of the tracks; None: not available.
        camera: The camera of the footage, for drawing gates over its video; None: not known.
        view: Image of the empty road from the camera, as the background of the gates; None: not available.

    Returns:
        Path of the file.
    """
    path = out / REPORT_FILE
    write_text(path, traffic_page(report, tracks=tracks, road=road, camera=camera, view=view))
    return path


def traffic_page(
    report: TrafficReport,
    *,
    tracks: str,
    road: RoadPicture | None = None,
    camera: Camera | None = None,
    view: EmptyRoadPicture | None = None,
) -> str:
    """Return the page of a report.

    Args:
        report: The report.
        tracks: Name of the folder or file that the tracks were read from.
        road: Image of the empty road from above, as the background of the tracks; None: not available.
        camera: The camera of the footage, for drawing gates over its video; None: not known.
        view: Image of the empty road from the camera, as the background of the gates; None: not available.

    Returns:
        The page as HTML.
    """
    sections: dict[str, list[Block]] = {
        "Counts": [*class_tables(report), *peak_hour_table(report), *_lengths(report)],
        "Movements": _movements(report),
        "Speeds": [*_speeds(report), *_figures(speed_histograms(report))] if report.metres else [],
        "Headways": _figures(headway_histograms(report)) if report.metres else [],
        "Over time": [*_figures(counts_over_time(report)), *all_by_interval(report)],
        "Conflicts": _conflicts(report) if report.metres else [],
        "Crossings that are not counted": _left_out(report),
        "Accuracy": _accuracy(report),
    }
    manual_count_data = manual_count_json(report, camera)
    return render(
        "traffic/page/report.html",
        title=f"Traffic: {report.observation.source or tracks}",
        what=_extent(report),
        drawings=[gates_in_picture(report, view, camera), road_map(report, road)],
        sections=sections,
        manual_count_data=manual_count_data,
        manual_count_scripts=["traffic/page/manual_count.js"] if manual_count_data else [],
        remarks=report.notes,
        colophon=f"skope {__version__}; tracks of {tracks}; intervals hold 90%",
    )


def _extent(report: TrafficReport) -> str:
    """Return sentences on the number of crossings and tracks, and on the observed time."""
    spans = report.observation.spans
    minutes = report.observation.observed_s / 60
    duration = f"{minutes:.1f} minutes" if minutes < REPORT_PAGE.hours_from_minutes else f"{minutes / 60:.1f} hours"
    if minutes < REPORT_PAGE.seconds_to_minutes:
        duration = f"{60 * minutes:.0f} s"
    gates = (
        f"{counted(len(report.crossings), 'crossing')} of {counted(len(report.gates), 'gate')}, "
        if report.gates
        else ""
    )
    extent = f"{gates}{counted(len(report.trajectories), 'track')} in {duration} of observation"
    begin = clock(report, float(spans[0, 0])) if len(spans) else None
    end = clock(report, float(spans[-1, 1])) if len(spans) else None
    if begin is None or end is None:
        return f"{extent}. The time of day is not known."
    zone = f", {report.site.time_zone}" if report.site.time_zone else ""
    return f"{extent}, from {begin:%Y-%m-%d %H:%M:%S} to {end:%Y-%m-%d %H:%M:%S}{zone}."


def _figures(found: Iterator[Markup]) -> list[Block]:
    every = list(found)
    return [tag("div", *every, class_="grid figures")] if every else []


def _without_repeats(report: TrafficReport, rows: Sequence[TurningMovementCount]) -> list[TurningMovementCount]:
    """Return the rows, without those of vehicles if only vehicles were counted: they would repeat those of all."""
    mixed = any(
        crossing.trajectory.category != VEHICLE_CATEGORY for crossing in (*report.crossings, *report.unseen.doubtful)
    )
    return [row for row in rows if mixed or row.class_name != VEHICLE_CATEGORY]


def _lengths(report: TrafficReport) -> list[Block]:
    """Return the table of vehicles by length, one row per gate and direction; empty if no length was measured."""
    cells: dict[tuple[str, str], list[Cell]] = {}
    for row in report.lengths_total:
        bounds = None if row.bin_name == NO_BIN else in_words(row.confidence_interval)
        cells.setdefault((row.gate, row.direction), []).append(Cell("–" if row.count is None else row.count, bounds))
    if not any(row.count for row in report.lengths_total):
        return []
    first, second = report.site.traffic.length_bins_m
    head = ["gate", f"short, up to {first:g} m", f"medium, up to {second:g} m", "long", "not sure"]
    untold = (
        f" (no intervals above {LENGTH_MODEL.longest_measured_m:g} m)"
        if second >= LENGTH_MODEL.longest_measured_m
        else ""
    )
    caption = f"Vehicles by length, with 90% intervals{untold}"
    return [
        Table(caption=caption, head=head, rows=[[side_name(side), *row_cells] for side, row_cells in cells.items()])
    ]


def _movements(report: TrafficReport) -> list[Block]:
    """Return matrices and diagram of movements; vehicles first if other classes are counted too."""
    rows = _without_repeats(report, report.turning_total)
    classes = sorted({row.class_name for row in rows}, key=lambda name: name != VEHICLE_CATEGORY)
    matrices = movement_matrices(report, classes)
    return [*matrices, flow_diagram(report)] if matrices else []


def _speeds(report: TrafficReport) -> list[Block]:
    """Return the table of speeds of all motor vehicles, and a folded table by class."""
    whole = [group for group in report.speeds if group.interval is None]
    groups = [group for group in whole if any(part.value is not None for part in group.percentiles.values())]
    rows, of_classes = (
        [
            [
                *(group.where.replace(" -> ", " → "), group.kind, group.class_name, group.number),
                *(_speed(group.percentiles[name]) for name in SPEED_PERCENTILES),
            ]
            for group in groups
            if (group.class_name == MOTOR_TRAFFIC) == together
        ]
        for together in (True, False)
    )
    head = ["where", "kind", "class", "vehicles", *(f"{name}, km/h" for name in SPEED_PERCENTILES)]
    shown = Table(caption="Speeds with enough vehicles (the others are in speeds.csv)", head=head, rows=rows)
    folded = Table(caption="Speeds by class", head=head, rows=of_classes, folded=True)
    return [table for table in (shown, folded) if table.rows]


def _speed(percentile: Percentile) -> Cell:
    if percentile.value is None or percentile.low is None or percentile.high is None:
        return Cell("–", None)
    return Cell(
        f"{percentile.value * KMH_PER_MPS:.1f}",
        f"{percentile.low * KMH_PER_MPS:.1f} to {percentile.high * KMH_PER_MPS:.1f}",
    )


def _left_out(report: TrafficReport) -> list[Block]:
    """Return a table for each gate and direction with many crossings that are not counted."""
    found = left_out_crossings(report)
    if not found:
        return []
    head = ["time", "track", "class", "reason"]
    parts: list[Block] = [
        "Crossings that were detected and not counted, and tracks that may have crossed undetected. They widen the 90% "
        "intervals. Gates with fewer than three of them are omitted, and so are tracks that were never confirmed or "
        'never moved. "Before" and "behind" a gate refer to the direction of travel.'
    ]
    for side, left_out in found.items():
        rows = []
        for crossing in left_out[: REPORT_PAGE.most_left_out]:
            moment = clock(report, crossing.time_s)
            when = f"{crossing.time_s:.1f}\u00a0s" if moment is None else f"{moment:%H:%M:%S}"
            rows.append([when, crossing.track, crossing.class_name, crossing.reason])
        caption = f"{side_name(side)}: {len(left_out)} crossings that are not counted"
        parts.append(Table(caption=caption, head=head, rows=rows))
        if len(left_out) > len(rows):
            parts.append(f"and {len(left_out) - len(rows)} more")
    return parts


def _conflicts(report: TrafficReport) -> list[Block]:
    found = report.conflicts.conflicts

    def severe(value: float) -> float:
        return math.inf if math.isnan(value) else value

    worst = sorted(found, key=lambda conflict: min(severe(conflict.ttc_s), severe(conflict.pet_ssam_s)))[
        : REPORT_PAGE.conflicts
    ]
    rows = []
    for conflict in worst:
        moment = clock(report, conflict.time_s)
        ttc = (
            "–"
            if math.isnan(conflict.ttc_s)
            else f"{conflict.ttc_s:.1f} ({conflict.ttc_low_s:.1f} to {_end(conflict.ttc_high_s)})"
        )
        pet = (
            "–"
            if math.isnan(conflict.pet_ssam_s)
            else f"{conflict.pet_ssam_s:.1f} ± {_upwards(INTERVAL_SIGMAS * conflict.pet_sigma_s):.1f}"
        )
        road_users = (
            f"{conflict.first.class_name} {conflict.first.number}, "
            f"{conflict.second.class_name} {conflict.second.number}"
        )
        when = f"{conflict.time_s:.1f} s" if moment is None else f"{moment:%H:%M:%S}"
        rows.append([when, road_users, conflict.kind, conflict.zone, ttc, pet])
    head = ["time", "road users", "type", "zone", "TTC, s", "PET (SSAM), s"]
    more = f": the {len(rows)} most severe of {len(found)}" if len(found) > len(rows) else ""
    caption = f"Conflicts{more}; use them to find locations, not as a count"
    return [Table(caption=caption, head=head, rows=rows)] if rows else []


def _upwards(value: float) -> float:
    """Return an uncertainty rounded up to one decimal, so that it does not become 0."""
    return math.ceil(10 * value) / 10 if math.isfinite(value) else value


def _end(value: float) -> str:
    return f"{value:.1f}" if math.isfinite(value) else "none"


def _accuracy(report: TrafficReport) -> list[Block]:
    """Return the table that compares manual and automatic counts."""
    rows = []
    for check in report.manual_count_checks:
        hand = check.hand
        begin, end = (
            f"{moment:%H:%M:%S}" if moment else f"{seconds:.0f} s"
            for moment, seconds in (
                (hand.interval.begin, hand.interval.begin_s),
                (hand.interval.end, hand.interval.end_s),
            )
        )
        off = "–" if not hand.number else f"{100 * (check.count - hand.number) / hand.number:+.0f} %"
        cells = (
            f"{begin} to {end}",
            str(hand.number),
            str(check.count),
            off,
            f"{check.geh:.1f}",
            in_words(check.confidence_interval),
        )
        rows.append([f"{hand.gate} ({hand.direction_name})", hand.class_name, *cells])
    if not rows:
        return [
            "No manual counts. Count 10 to 15 minutes at each gate and pass the file with --manual-count. This section "
            "then shows errors and GEH, and all count intervals are updated."
        ]
    errors = [abs(check.count - check.hand.number) for check in report.manual_count_checks]
    total = sum(check.hand.number for check in report.manual_count_checks)
    errors_text = f"Sum of the errors: {sum(errors)}, in manual counts of {total}"
    errors_text += (
        f"; GEH under 5 in {np.mean([check.geh < 5 for check in report.manual_count_checks]):.0%}." if rows else "."
    )
    head = ["gate", "class", "time", "manual", "counted", "error", "GEH", "90% interval without the manual count"]
    return [Table(caption="Manual counts", head=head, rows=rows), errors_text]
