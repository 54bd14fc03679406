"""Tables of the page: counts by gate, class and interval, passenger-car equivalents, peak hours, omitted crossings.

A gate counts fewer crossings than tracks that pass its line; the reasons are listed.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import Final

from skope.page.svg import tag
from skope.page.templates import Cell, Table
from skope.schema import VEHICLE_CATEGORY
from skope.site.traffic_settings import OF_VEHICLES, UNKNOWN_CLASS
from skope.traffic.count_uncertainty import in_words
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import ALL_CLASSES, Count, interval_counts
from skope.traffic.measure import whole_footage
from skope.traffic.peak_hour import PeakHour, peak_hours, why_no_factor, why_no_peak_hour
from skope.traffic.traffic_report import TrafficReport

GateDirection = tuple[str, str]
Block = str | Table
"""A paragraph, a table, or markup (`Markup`) as it is."""


@dataclass(frozen=True)
class TableLimits:
    """Length of tables of counts."""

    most_intervals: int = 400
    """Maximum number of intervals in a table; the others are in counts.csv."""
    most_open_rows: int = 12
    """Tables with more rows are folded."""


TABLE_LIMITS: Final = TableLimits()


def side_name(side: GateDirection) -> str:
    """Name of a gate and direction, plain text."""
    return f"{side[0]} ({side[1]})"


def count_text(row: Count) -> str:
    """The count of a row; a dash if nothing was observed."""
    return "–" if row.count is None else str(row.count)


def with_interval(row: Count) -> Cell:
    """A count and its 90% interval below it."""
    return Cell(count_text(row), in_words(row.confidence_interval) if row.count is not None else row.observed)


def interval_label(report: TrafficReport, interval: ClockInterval) -> str:
    """Return the start of an interval as text without breaks: time, with the day if there are several, or minutes."""
    return _time(report, interval.begin, interval.begin_s)


def _time(report: TrafficReport, moment: datetime | None, seconds: float) -> str:
    if moment is None:
        return f"{seconds / 60:.0f}\u00a0min"
    first, last = report.intervals[0].begin, report.intervals[-1].begin
    several_days = first is not None and last is not None and first.date() != last.date()
    return moment.strftime("%a %d %b %H:%M" if several_days else "%H:%M").replace(" ", "\u00a0")


def class_tables(report: TrafficReport) -> list[Block]:
    """Counts by class of the whole footage, then a table by interval for each gate and direction."""
    whole = _class_rows(report)
    if not whole:
        return []
    found = [name for name in report.site.traffic.classes if any(rows[name].count for rows in whole.values())]
    groups = [name for name in (ALL_CLASSES, VEHICLE_CATEGORY) if all(name in rows for rows in whole.values())]
    groups = [ALL_CLASSES] if OF_VEHICLES.issuperset(found) else groups
    columns = [*groups, *found]
    has_pce = any(
        class_rows[ALL_CLASSES].count and class_rows[ALL_CLASSES].pce is not None for class_rows in whole.values()
    )
    rows = [
        [
            side_name(side),
            *(with_interval(class_rows[name]) for name in columns),
            *([_pce_text(class_rows[ALL_CLASSES])] if has_pce else []),
        ]
        for side, class_rows in whole.items()
    ]
    head = ["gate", *map(_heading, columns), *(["PCE"] if has_pce else [])]
    caption = "Counts by gate and class, with 90% intervals of the true number"
    return [
        Table(caption=caption, head=head, rows=rows, sticky=True),
        *([about] if (about := _about_pce(report, whole)) else []),
        *_by_interval(report, whole, groups),
    ]


def _class_rows(report: TrafficReport) -> dict[GateDirection, dict[str, Count]]:
    """Counts of the whole footage by gate and direction, and by class."""
    settings = report.site.traffic
    whole = [whole_footage(report.observation)]
    rows = interval_counts(report.crossings, report.gates, (), whole, report.observation, settings, report.unseen)
    found: dict[GateDirection, dict[str, Count]] = {}
    for row in rows:
        found.setdefault((row.gate, row.direction), {})[row.class_name] = row
    return found


def _heading(class_name: str) -> str:
    return {UNKNOWN_CLASS: "unknown class", VEHICLE_CATEGORY: "vehicles"}.get(class_name, class_name)


def _pce_text(row: Count) -> str:
    return "–" if row.pce is None else f"{row.pce:.1f}"


def _about_pce(report: TrafficReport, whole: dict[GateDirection, dict[str, Count]]) -> str:
    """Sentences on the passenger-car equivalents: the factors, or where and why there are none."""
    crossed = {side: rows for side, rows in whole.items() if rows[ALL_CLASSES].count}
    without = [side_name(side) for side, rows in crossed.items() if rows[ALL_CLASSES].pce is None]
    why = "fewer than half of the vehicles there have a known class"
    if len(without) == len(crossed):
        if not crossed:
            return ""
        why = why if report.metres else "without metres the class of vehicles is not known"
        return f"PCE (passenger-car equivalents) are not available: {why}."
    factors = ", ".join(f"{name} {factor:g}" for name, factor in report.site.traffic.pce.items())
    text = f"PCE: passenger-car equivalents (car 1, {factors}, pedestrian 0) of those counted, without an interval."
    if any(rows[UNKNOWN_CLASS].count for rows in crossed.values() if UNKNOWN_CLASS in rows):
        text += " A vehicle of unknown class has the mean factor of the other vehicles at the gate and direction."
    return text + (f" Not available at {', '.join(without)}: {why}." if without else "")


def _by_interval(
    report: TrafficReport, whole: dict[GateDirection, dict[str, Count]], groups: list[str]
) -> Iterator[Table]:
    """A folded table for each gate and direction: a row per interval, a column per class that occurs there."""
    intervals = report.intervals[: TABLE_LIMITS.most_intervals]
    if len(report.intervals) < 2:
        return
    cells: dict[tuple[GateDirection, float, str], Count] = {
        ((row.gate, row.direction), row.interval.begin_s, row.class_name): row
        for row in report.counts
        if row.lane == ALL_CLASSES
    }
    for side, totals in whole.items():
        if not totals[ALL_CLASSES].count:
            continue
        classes = [name for name in report.site.traffic.classes if totals[name].count]
        interval_rows = [
            {name: cells[side, interval.begin_s, name] for name in (*groups, *classes)} for interval in intervals
        ]
        has_pce = totals[ALL_CLASSES].pce is not None
        rows = [
            [
                _observed_label(report, interval, row[ALL_CLASSES]),
                *(with_interval(row[name]) for name in groups),
                *(count_text(row[name]) for name in classes),
                *([_pce_text(row[ALL_CLASSES])] if has_pce else []),
            ]
            for interval, row in zip(intervals, interval_rows, strict=True)
        ]
        foot = [
            "whole footage",
            *(with_interval(totals[name]) for name in (*groups, *classes)),
            *([_pce_text(totals[ALL_CLASSES])] if has_pce else []),
        ]
        head = ["from", *map(_heading, (*groups, *classes)), *(["PCE"] if has_pce else [])]
        more = (
            ""
            if len(report.intervals) <= TABLE_LIMITS.most_intervals
            else f", the first {TABLE_LIMITS.most_intervals} intervals"
        )
        caption = f"{side_name(side)}: counts by interval and class{more}"
        folded = len(rows) > TABLE_LIMITS.most_open_rows
        yield Table(caption=caption, head=head, rows=rows, foot=foot, sticky=True, folded=folded)


def _observed_label(report: TrafficReport, interval: ClockInterval, row: Count) -> Cell:
    """Begin of an interval, with a note if it was observed in part."""
    return Cell(interval_label(report, interval), "observed in part" if row.observed == "partial" else None)


def all_by_interval(report: TrafficReport) -> list[Block]:
    """Counts of all by interval: a row per interval, a column per gate and direction; empty for one interval."""
    all_rows = [row for row in report.counts if (row.lane, row.class_name) == (ALL_CLASSES, ALL_CLASSES)]
    sides = list(dict.fromkeys((row.gate, row.direction) for row in all_rows))
    if len(report.intervals) < 2 or not sides:
        return []
    cells = {(row.interval.begin_s, row.gate, row.direction): row for row in all_rows}
    rows = [
        [
            _observed_label(report, interval, cells[(interval.begin_s, *sides[0])]),
            *(with_interval(cells[(interval.begin_s, *side)]) for side in sides),
        ]
        for interval in report.intervals[: TABLE_LIMITS.most_intervals]
    ]
    caption, head = "Counts of all by interval, with 90% intervals", ["from", *map(side_name, sides)]
    return [
        Table(
            caption=caption, head=head, rows=rows, sticky=True, folded=len(rows) > TABLE_LIMITS.most_open_rows or None
        )
    ]


def _hour(report: TrafficReport, hour: PeakHour) -> str:
    """Begin and end of a peak hour; a dash if nothing was counted."""
    if not hour.volume:
        return "–"
    end = f"{hour.end_s / 60:.0f}\u00a0min" if hour.end is None else f"{hour.end:%H:%M}"
    return f"{_time(report, hour.begin, hour.begin_s)} to {end}"


def peak_hour_table(report: TrafficReport) -> list[Block]:
    """The peak hour and its factor for the site and each gate direction, or the reason why there is none."""
    if not report.gates:
        return []
    if reason := why_no_peak_hour(report):
        return [tag("h3", "Peak hour"), f"Not available: {reason}."]
    reason = why_no_factor(report)
    rows = [
        [
            side_name((hour.gate, hour.direction)) if hour.gate else "whole site",
            _hour(report, hour),
            hour.volume,
            "–" if hour.highest_15_minutes is None else hour.highest_15_minutes,
            "–" if hour.factor is None else f"{hour.factor:.2f}",
        ]
        for hour in peak_hours(report)
    ]
    vehicles = (
        "vehicles (more than two wheels)" if peak_hours(report)[0].class_name == VEHICLE_CATEGORY else "all road users"
    )
    notes = (
        "The peak-hour factor is the volume over four times the highest volume of 15 minutes in the hour. Only fully "
        "observed intervals are used. At the whole site each road user counts once, at its first gate."
    )
    why = f" The peak-hour factor is not available: {reason}." if reason else ""
    head = ["gate", "peak hour", "counted", "highest 15 minutes", "peak-hour factor"]
    return [
        tag("h3", "Peak hour"),
        Table(caption=f"Peak hour of {vehicles}", head=head, rows=rows),
        notes + why,
    ]
