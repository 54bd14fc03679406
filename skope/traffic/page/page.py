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
        what=_what(report),
        drawings=[gates_in_picture(report, view, camera), road_map(report, road)],
        sections=sections,
        manual_count_data=manual_count_data,
        manual_count_scripts=["traffic/page/manual_count.js"] if manual_count_data else [],
        remarks=report.notes,
        colophon=f"skope {__version__}; tracks of {tracks}; intervals hold 90%",
    )


def _what(report: TrafficReport) -> str:
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
    told = f"{gates}{counted(len(report.trajectories), 'track')} in {duration} of observation"
    begin = clock(report, float(spans[0, 0])) if len(spans) else None
    end = clock(report, float(spans[-1, 1])) if len(spans) else None
    if begin is None or end is None:
        return f"{told}. The time of day is not known."
    zone = f", {report.site.time_zone}" if report.site.time_zone else ""
    return f"{told}, from {begin:%Y-%m-%d %H:%M:%S} to {end:%Y-%m-%d %H:%M:%S}{zone}."


def _figures(found: Iterator[Markup]) -> list[Block]:
    every = list(found)
    return [tag("div", *every, class_="grid figures")] if every else []


def _without_repeats(report: TrafficReport, rows: Sequence[TurningMovementCount]) -> list[TurningMovementCount]:
    """Return the rows, without those of vehicles if only vehicles were counted: they would repeat those of all."""
    mixed = any(one.trajectory.category != VEHICLE_CATEGORY for one in (*report.crossings, *report.unseen.doubtful))
    return [one for one in rows if mixed or one.class_name != VEHICLE_CATEGORY]


def _lengths(report: TrafficReport) -> list[Block]:
    """Return the table of vehicles by length, one row per gate and direction; empty if no length was measured."""
    cells: dict[tuple[str, str], list[Cell]] = {}
    for one in report.lengths_total:
        bounds = None if one.bin_name == NO_BIN else in_words(one.confidence_interval)
        cells.setdefault((one.gate, one.direction), []).append(Cell("–" if one.count is None else one.count, bounds))
    if not any(one.count for one in report.lengths_total):
        return []
    first, second = report.site.traffic.length_bins_m
    head = ["gate", f"short, up to {first:g} m", f"medium, up to {second:g} m", "long", "not sure"]
    untold = (
        f" (no intervals above {LENGTH_MODEL.longest_measured_m:g} m)"
        if second >= LENGTH_MODEL.longest_measured_m
        else ""
    )
    caption = f"Vehicles by length, with 90% intervals{untold}"
    return [Table(caption=caption, head=head, rows=[[side_name(side), *own] for side, own in cells.items()])]


def _movements(report: TrafficReport) -> list[Block]:
    """Return matrices and diagram of movements; vehicles first if other classes are counted too."""
    rows = _without_repeats(report, report.turning_total)
    classes = sorted({row.class_name for row in rows}, key=lambda name: name != VEHICLE_CATEGORY)
    matrices = movement_matrices(report, classes)
    return [*matrices, flow_diagram(report)] if matrices else []


def _speeds(report: TrafficReport) -> list[Block]:
    """Return the table of speeds of all motor vehicles, and a folded table by class."""
    whole = [one for one in report.speeds if one.interval is None]
    groups = [one for one in whole if any(part.value is not None for part in one.percentiles.values())]
    rows, of_classes = (
        [
            [
                *(one.where.replace(" -> ", " → "), one.kind, one.class_name, one.number),
                *(_speed(one.percentiles[name]) for name in SPEED_PERCENTILES),
            ]
            for one in groups
            if (one.class_name == MOTOR_TRAFFIC) == together
        ]
        for together in (True, False)
    )
    head = ["where", "kind", "class", "vehicles", *(f"{name}, km/h" for name in SPEED_PERCENTILES)]
    shown = Table(caption="Speeds with enough vehicles (the others are in speeds.csv)", head=head, rows=rows)
    folded = Table(caption="Speeds by class", head=head, rows=of_classes, folded=True)
    return [one for one in (shown, folded) if one.rows]


def _speed(one: Percentile) -> Cell:
    if one.value is None or one.low is None or one.high is None:
        return Cell("–", None)
    return Cell(f"{one.value * KMH_PER_MPS:.1f}", f"{one.low * KMH_PER_MPS:.1f} to {one.high * KMH_PER_MPS:.1f}")


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
        for one in left_out[: REPORT_PAGE.most_left_out]:
            moment = clock(report, one.time_s)
            when = f"{one.time_s:.1f}\u00a0s" if moment is None else f"{moment:%H:%M:%S}"
            rows.append([when, one.track, one.class_name, one.reason])
        caption = f"{side_name(side)}: {len(left_out)} crossings that are not counted"
        parts.append(Table(caption=caption, head=head, rows=rows))
        if len(left_out) > len(rows):
            parts.append(f"and {len(left_out) - len(rows)} more")
    return parts


def _conflicts(report: TrafficReport) -> list[Block]:
    found = report.conflicts.conflicts

    def severe(value: float) -> float:
        return math.inf if math.isnan(value) else value

    worst = sorted(found, key=lambda one: min(severe(one.ttc_s), severe(one.pet_ssam_s)))[: REPORT_PAGE.conflicts]
    rows = []
    for one in worst:
        moment = clock(report, one.time_s)
        ttc = "–" if math.isnan(one.ttc_s) else f"{one.ttc_s:.1f} ({one.ttc_low_s:.1f} to {_end(one.ttc_high_s)})"
        pet = (
            "–"
            if math.isnan(one.pet_ssam_s)
            else f"{one.pet_ssam_s:.1f} ± {_upwards(INTERVAL_SIGMAS * one.pet_sigma_s):.1f}"
        )
        who = f"{one.first.class_name} {one.first.number}, {one.second.class_name} {one.second.number}"
        when = f"{one.time_s:.1f} s" if moment is None else f"{moment:%H:%M:%S}"
        rows.append([when, who, one.kind, one.zone, ttc, pet])
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
    for one in report.manual_count_checks:
        hand = one.hand
        begin, end = (
            f"{moment:%H:%M:%S}" if moment else f"{seconds:.0f} s"
            for moment, seconds in (
                (hand.interval.begin, hand.interval.begin_s),
                (hand.interval.end, hand.interval.end_s),
            )
        )
        off = "–" if not hand.number else f"{100 * (one.count - hand.number) / hand.number:+.0f} %"
        cells = (
            f"{begin} to {end}",
            str(hand.number),
            str(one.count),
            off,
            f"{one.geh:.1f}",
            in_words(one.confidence_interval),
        )
        rows.append([f"{hand.gate} ({hand.direction_name})", hand.class_name, *cells])
    if not rows:
        return [
            "No manual counts. Count 10 to 15 minutes at each gate and pass the file with --manual-count. This section "
            "then shows errors and GEH, and all count intervals are updated."
        ]
    errors = [abs(one.count - one.hand.number) for one in report.manual_count_checks]
    total = sum(one.hand.number for one in report.manual_count_checks)
    said = f"Sum of the errors: {sum(errors)}, in manual counts of {total}"
    said += f"; GEH under 5 in {np.mean([one.geh < 5 for one in report.manual_count_checks]):.0%}." if rows else "."
    head = ["gate", "class", "time", "manual", "counted", "error", "GEH", "90% interval without the manual count"]
    return [Table(caption="Manual counts", head=head, rows=rows), said]
