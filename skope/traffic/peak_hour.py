"""Peak hour and peak-hour factor of each gate direction and of the whole site.

The peak-hour factor is the volume of the peak hour over four times the highest volume of 15 minutes in it (Highway
Capacity Manual). Only fully observed intervals are used.
"""

import bisect
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any, Final

from skope.schema import VEHICLE_CATEGORY
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import ALL_CLASSES, classes_of, observed_word, row_classes
from skope.traffic.traffic_report import TrafficReport


@dataclass(frozen=True)
class PeakPeriods:
    """Periods of the peak hour factor."""

    hour_minutes: int = 60
    quarter_minutes: int = 15
    rounding_s: float = 1e-6
    """Rounding of times, seconds."""
    factor_digits: int = 3


PEAK_PERIODS: Final = PeakPeriods()


@dataclass(frozen=True, kw_only=True)
class PeakHour:
    """The 60 minutes with the highest volume, at a gate and direction or at the whole site."""

    gate: str
    """Empty for the whole site: each road user counts once, at the first gate that it crosses."""
    direction: str
    class_name: str
    """`VEHICLE_CATEGORY` (more than two wheels), or `ALL_CLASSES` if the site counts no others, or no vehicles."""
    begin_s: float
    """Start of the hour, seconds of the footage."""
    end_s: float
    begin: datetime | None
    """Start of the hour in the site's time zone; None if the time of the footage is not known."""
    end: datetime | None
    volume: int
    """Number of road users counted in the hour."""
    highest_15_minutes: int | None
    """Highest volume of 15 consecutive minutes of the hour; None if no intervals make up 15 minutes."""

    @property
    def factor(self) -> float | None:
        """Peak-hour factor, 0.25 to 1; None without a volume of 15 minutes, or if nothing was counted."""
        return self.volume / (4 * self.highest_15_minutes) if self.highest_15_minutes else None


def peak_hours(report: TrafficReport) -> list[PeakHour]:
    """Return the peak hour of the whole site, then of each gate and direction.

    The result is empty if `why_no_peak_hour` gives a reason. Among hours of the same volume the earliest is taken.
    Hours begin with an interval.
    """
    if not report.gates or why_no_peak_hour(report):
        return []
    minutes = report.site.traffic.interval_minutes
    class_name = peak_hour_class(report)
    hours = _observed_hours(report)
    found = []
    for (gate, direction), volumes in _volumes(report, class_name).items():
        first = max(hours, key=lambda k: sum(volumes[k : k + PEAK_PERIODS.hour_minutes // minutes]))
        hour_volumes = volumes[first : first + PEAK_PERIODS.hour_minutes // minutes]
        begin, end = report.intervals[first], report.intervals[first + len(hour_volumes) - 1]
        found.append(
            PeakHour(
                gate=gate,
                direction=direction,
                class_name=class_name,
                begin_s=begin.begin_s,
                end_s=end.end_s,
                begin=begin.begin,
                end=end.end,
                volume=sum(hour_volumes),
                highest_15_minutes=_highest_quarter(hour_volumes, minutes),
            )
        )
    return found


def peak_hour_class(report: TrafficReport) -> str:
    """Return `VEHICLE_CATEGORY`, or `ALL_CLASSES` if the site counts only vehicles, or none."""
    return VEHICLE_CATEGORY if VEHICLE_CATEGORY in row_classes(report.site.traffic) else ALL_CLASSES


def why_no_peak_hour(report: TrafficReport) -> str:
    """Return the reason why the peak hour is not available; empty if it is."""
    minutes = report.site.traffic.interval_minutes
    if PEAK_PERIODS.hour_minutes % minutes:
        return f"{minutes}-minute intervals do not divide an hour (traffic.interval_minutes)"
    if not _observed_hours(report):
        longest = max((len(run) for run in _observed_runs(report)), default=0) * minutes
        return (
            f"it needs 60 consecutive minutes of fully observed {minutes}-minute intervals; "
            f"the longest run is {longest} minutes"
        )
    return ""


def why_no_factor(report: TrafficReport) -> str:
    """Return the reason why peak hours have no peak-hour factor; empty if they have one."""
    minutes = report.site.traffic.interval_minutes
    if PEAK_PERIODS.quarter_minutes % minutes:
        return f"{minutes}-minute intervals do not divide 15 minutes (traffic.interval_minutes)"
    return ""


def peak_hours_in_json(report: TrafficReport) -> dict[str, Any]:
    """Entries of `summary.json`: the hours, or `not_available` with the reason."""
    if not report.gates:
        return {"not_available": "the site has no gates"}
    if reason := why_no_peak_hour(report):
        return {"not_available": reason}
    reason = why_no_factor(report)
    hours = [
        {
            "gate": hour.gate or None,
            "direction": hour.direction or None,
            "class": hour.class_name,
            "begin": None if hour.begin is None else hour.begin.isoformat(),
            "begin_s": round(hour.begin_s, 3),
            "volume": hour.volume,
            "highest_15_minutes": hour.highest_15_minutes,
            "factor": None if hour.factor is None else round(hour.factor, PEAK_PERIODS.factor_digits),
        }
        for hour in peak_hours(report)
    ]
    return {"hours": hours, **({"factor_not_available": reason} if reason else {})}


def _highest_quarter(volumes: Sequence[int], minutes: int) -> int | None:
    """Highest volume of 15 consecutive minutes, of volumes of intervals; None if intervals do not divide 15 minutes."""
    if PEAK_PERIODS.quarter_minutes % minutes:
        return None
    size = PEAK_PERIODS.quarter_minutes // minutes
    return max(sum(volumes[k : k + size]) for k in range(len(volumes) - size + 1))


def _observed_hours(report: TrafficReport) -> list[int]:
    """Indices of the intervals at which 60 fully observed minutes begin."""
    size = PEAK_PERIODS.hour_minutes // report.site.traffic.interval_minutes
    return [k for run in _observed_runs(report) for k in run[: max(0, len(run) - size + 1)]]


def _observed_runs(report: TrafficReport) -> Iterator[range]:
    """Runs of intervals that follow each other, are fully observed and of full length, as indices."""
    begin = 0
    for k in range(len(report.intervals) + 1):
        usable = k < len(report.intervals) and _is_full(report, report.intervals[k])
        follows = usable and (
            k == begin or abs(report.intervals[k].begin_s - report.intervals[k - 1].end_s) < PEAK_PERIODS.rounding_s
        )
        if follows:
            continue
        if k > begin:
            yield range(begin, k)
        begin = k if usable else k + 1


def _is_full(report: TrafficReport, interval: ClockInterval) -> bool:
    """Whether an interval was fully observed and is not cut short by a change of clocks."""
    seconds = interval.end_s - interval.begin_s
    full_length = abs(seconds - 60 * report.site.traffic.interval_minutes) < PEAK_PERIODS.rounding_s
    observed_s = report.observation.seconds_in(interval.begin_s, interval.end_s)
    return full_length and observed_word(interval, observed_s) == "full"


def _volumes(report: TrafficReport, class_name: str) -> dict[tuple[str, str], list[int]]:
    """Return counts by interval, for the whole site (empty names) and each gate and direction."""
    classes = classes_of(class_name, report.site.traffic)
    seen: set[int] = set()
    begins_s = [interval.begin_s for interval in report.intervals]
    site = [0] * len(begins_s)
    for crossing in sorted(report.crossings, key=lambda event: event.time_s):
        track = crossing.trajectory
        if track.class_name not in classes or track.number in seen:
            continue
        seen.add(track.number)
        site[max(0, bisect.bisect_right(begins_s, crossing.time_s) - 1)] += 1
    volumes = {("", ""): site}
    for row in report.counts:
        if (row.lane, row.class_name) == (ALL_CLASSES, class_name):
            volumes.setdefault((row.gate, row.direction), []).append(row.count or 0)
    return volumes
