"""Counts over time, speeds and headways as charts, each with its numbers as a table below."""

import math
from collections.abc import Iterator
from typing import Final

import numpy as np

from skope.page.charts import Axes, Line, chart, histogram
from skope.tracks.track import KMH
from skope.traffic.gate_counts import ALL
from skope.traffic.gates import direction_names
from skope.traffic.speeds import MOTOR_CLASSES
from skope.traffic.traffic_report import TrafficReport

_SPEED_KMH: Final = 5.0
_HEADWAY_S: Final = 1.0
_LONGEST_S: Final = 20.0
"""Headways beyond this are no longer of vehicles that follow each other."""
_FEWEST: Final = 5
"""Fewer than these are no distribution."""
_PARTS: Final = 5
"""An axis has so many parts."""
_MARKS: Final = 48
"""A line has so many marks at most."""
_LINES: Final = 4
"""A chart tells so many lines apart."""


def counts_over_time(report: TrafficReport) -> Iterator[str]:
    """A figure for each gate: how many of all crossed it in each interval, as flows an hour."""
    if len(report.intervals) < 2:
        return
    for gate in report.gates:
        lines = []
        for name in direction_names(gate):
            rows = [
                one
                for one in report.counts
                if (one.gate, one.direction, one.lane, one.class_name) == (gate.name, name, ALL, ALL)
            ]
            hours = [(one.interval.begin_s + one.interval.end_s) / 2 / 3600 for one in rows]
            flows = [
                None if not one.count and not one.observed_s else _hourly(one.count, one.observed_s) for one in rows
            ]
            if any(flows):
                lines.append(Line(name=name, x=[max(0.0, hour) for hour in hours], y=flows))
        if lines:
            end = max(x for line in lines for x in line.x) or 1.0
            top = max(y for line in lines for y in line.y if y is not None)
            axes = Axes(x_label=_hours(report), y_label="road users an hour", x_end=_round(end), y_end=_whole(top))
            yield chart(f"{gate.name}: over time", axes, lines, every=math.ceil(len(report.intervals) / _MARKS))


def _hours(report: TrafficReport) -> str:
    """Label of hours: what they count from."""
    return "hours of the footage" if report.start is None else f"hours after {report.start:%H:%M:%S on %d %b %Y}"


def _hourly(count: int | None, observed_s: float) -> float | None:
    return None if count is None or observed_s <= 0 else count * 3600 / observed_s


def speed_histograms(report: TrafficReport) -> Iterator[str]:
    """A figure for each gate: how fast motor vehicles crossed it."""
    for gate in report.gates:
        groups = {
            name: [
                one.speed * KMH
                for one in report.crossings
                if (one.gate, one.direction_name) == (gate.name, name) and one.trajectory.class_name in MOTOR_CLASSES
            ]
            for name in direction_names(gate)
        }
        yield from _histogram(f"{gate.name}: speeds of motor vehicles", "km/h", groups, _SPEED_KMH)


def headway_histograms(report: TrafficReport) -> Iterator[str]:
    """A figure for each gate: how long after the one before vehicles crossed it."""
    for gate in report.gates:
        groups = {
            name: [
                one.headway_s
                for one in report.headways
                if (one.follower.gate, one.follower.direction_name) == (gate.name, name) and one.headway_s <= _LONGEST_S
            ]
            for name in direction_names(gate)
        }
        yield from _histogram(f"{gate.name}: headways up to {_LONGEST_S:g} s", "seconds", groups, _HEADWAY_S)


def _histogram(title: str, unit: str, groups: dict[str, list[float]], step: float) -> Iterator[str]:
    known = {name: np.array(values)[np.isfinite(values)] for name, values in groups.items() if values}
    enough = {name: values for name, values in known.items() if len(values) >= _FEWEST}
    if not enough:
        return
    # So long that the axis, which has five parts, has whole numbers.
    part = _PARTS * step
    end = part * max(1, math.ceil(max(float(values.max()) for values in enough.values()) / part + 1e-9))
    bands = np.arange(0, end + step / 2, step)
    middles = ((bands[:-1] + bands[1:]) / 2).tolist()
    lines = [
        Line(name=f"{name} ({len(values)})", x=middles, y=np.histogram(values, bands)[0].astype(float).tolist())
        for name, values in list(enough.items())[:_LINES]
    ]
    top = max(y for line in lines for y in line.y if y is not None)
    yield histogram(title, Axes(x_label=unit, y_label="how many", x_end=end, y_end=_whole(top)), lines)


def _whole(value: float) -> float:
    """A round number that is no smaller and has whole numbers at all parts of an axis."""
    return _PARTS * max(1.0, math.ceil(_round(value / _PARTS) - 1e-9))


def _round(value: float) -> float:
    """A round number that is no smaller."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step * power >= value - 1e-9)
