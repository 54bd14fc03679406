"""Counts as SUMO's tools read them: routeSampler's turns and edges, flowrouter's detectors.

Gates say which edges of a network they lie across (`edges` of the site file). Times are seconds from the midnight of
the day on which the footage begins, or, where that is not known, from the first interval's beginning.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final
from xml.sax.saxutils import quoteattr

import numpy as np

from skope.errors import UserError
from skope.files.atomic import write_text
from skope.tracks.track import KMH_PER_MPS
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import observed_word
from skope.traffic.gates import GateCrossing, direction_names
from skope.traffic.speeds import MOTOR_CLASSES
from skope.traffic.traffic_report import TrafficReport

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts

HEAVY_CLASSES: Final = frozenset({"lorry", "bus"})
"""Detectors distinguish two kinds of vehicles."""
GateSide = tuple[str, str]
"""A gate and a direction."""


def write_sumo(folder: Path, report: TrafficReport) -> list[Path]:
    """Write `turns.xml`, `edges.xml`, `detectors.xml` and `detectors.csv`; returns the files.

    Counts are those of vehicles and motorcycles, of intervals of which all was observed.

    Raises:
        UserError: No gate says which edges it lies across.
    """
    edges = edges_of(report.site)
    whole = [one for one in report.intervals if _observed(report, one)]
    shift = _shift(report)
    written = [folder / name for name in ("turns.xml", "edges.xml", "detectors.xml", "detectors.csv")]
    write_text(written[0], _document("data", _turns(report, whole, edges, shift)))
    write_text(written[1], _document("data", _edges(report, whole, edges, shift)))
    write_text(written[2], _document("detectors", _detectors(edges)))
    write_text(written[3], "\n".join(_flows(report, whole, edges, shift)) + "\n")
    return written


def edges_of(site: "SiteParts") -> dict[GateSide, str]:
    """The edge of each gate and direction that has one. Raises UserError where none has."""
    edges = {
        (gate.name, direction): edge
        for gate in site.gates
        if gate.edges
        for direction, edge in zip(direction_names(gate), gate.edges, strict=True)
        if edge
    }
    if not edges:
        raise UserError("no gate of the site has edges, the names of a SUMO network's edges that it lies across")
    return edges


def _observed(report: TrafficReport, interval: ClockInterval) -> bool:
    return observed_word(interval, report.observation.seconds_in(interval.begin_s, interval.end_s)) == "full"


def _shift(report: TrafficReport) -> float:
    """Seconds to add to those of the footage: from midnight where the clock is known, else so that none is before 0."""
    if not report.intervals:
        return 0.0
    first = report.intervals[0]
    if first.begin is None:
        return -first.begin_s
    midnight = first.begin.replace(hour=0, minute=0, second=0, microsecond=0)
    return (first.begin - midnight).total_seconds() - first.begin_s


def _document(name: str, lines: Iterator[str]) -> str:
    return "\n".join((f"<{name}>", *lines, f"</{name}>", ""))


def _interval(one: ClockInterval, shift: float) -> str:
    return f'  <interval id="counts" begin="{one.begin_s + shift:.0f}" end="{one.end_s + shift:.0f}">'


def _turns(
    report: TrafficReport, whole: Sequence[ClockInterval], edges: dict[GateSide, str], shift: float
) -> Iterator[str]:
    """Elements with the numbers from edge to edge, in the interval of the first crossing, as in the matrix of
    movements."""
    for interval in whole:
        pairs = Counter(
            one.sides
            for one in report.movements
            if interval.begin_s <= one.time_s < interval.end_s and one.trajectory.class_name in MOTOR_CLASSES
        )
        yield _interval(interval, shift)
        for (origin, destination), number in sorted(pairs.items()):
            if origin in edges and destination in edges:
                ways = f"from={quoteattr(edges[origin])} to={quoteattr(edges[destination])}"
                yield f'    <edgeRelation {ways} count="{number}"/>'
        yield "  </interval>"


def _edges(
    report: TrafficReport, whole: Sequence[ClockInterval], edges: dict[GateSide, str], shift: float
) -> Iterator[str]:
    for interval in whole:
        yield _interval(interval, shift)
        for side, edge in edges.items():
            number = len(_crossed(report, interval, side, MOTOR_CLASSES))
            yield f'    <edge id={quoteattr(edge)} entered="{number}"/>'
        yield "  </interval>"


def _detectors(edges: dict[GateSide, str]) -> Iterator[str]:
    for edge in edges.values():
        name = quoteattr(edge)
        yield f'  <inductionLoop id={name} lane={quoteattr(edge + "_0")} pos="0" period="60" file="NUL"/>'


def _flows(
    report: TrafficReport, whole: Sequence[ClockInterval], edges: dict[GateSide, str], shift: float
) -> Iterator[str]:
    """Counts and mean speeds, km/h, of light and of heavy vehicles; -1 where nobody has a speed."""
    yield "Detector;Time;qPKW;qLKW;vPKW;vLKW"
    for interval in whole:
        minute = round((interval.begin_s + shift) / 60)
        for side, edge in edges.items():
            light, heavy = (
                _crossed(report, interval, side, kinds) for kinds in (MOTOR_CLASSES - HEAVY_CLASSES, HEAVY_CLASSES)
            )
            yield f"{edge};{minute};{len(light)};{len(heavy)};{_speed(light)};{_speed(heavy)}"


def _crossed(
    report: TrafficReport, interval: ClockInterval, side: GateSide, classes: frozenset[str]
) -> list[GateCrossing]:
    return [
        one
        for one in report.crossings
        if (one.gate, one.direction_name) == side
        and interval.begin_s <= one.time_s < interval.end_s
        and one.trajectory.class_name in classes
    ]


def _speed(crossings: Sequence[GateCrossing]) -> str:
    return f"{np.mean([one.speed for one in crossings]) * KMH_PER_MPS:.1f}" if crossings else "-1"
