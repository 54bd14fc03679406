"""Counts for SUMO's tools: turns and edges of routeSampler, detectors of flowrouter.

`edges` of a gate in the site file names the network edges that it crosses. Times are seconds from midnight of the day
on which the footage begins. If the time of day is not known, they are seconds from the start of the first interval.
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
"""Classes of heavy vehicles. Detectors distinguish light and heavy vehicles."""
GateSide = tuple[str, str]
"""A gate and a direction."""


def write_sumo(folder: Path, report: TrafficReport) -> list[Path]:
    """Write `turns.xml`, `edges.xml`, `detectors.xml` and `detectors.csv`; return the files.

    Counts are those of vehicles and motorcycles in fully observed intervals.

    Raises:
        UserError: No gate of the site has `edges`.
    """
    edges = edges_of(report.site)
    whole = [interval for interval in report.intervals if _observed(report, interval)]
    shift = _shift(report)
    written = [folder / name for name in ("turns.xml", "edges.xml", "detectors.xml", "detectors.csv")]
    write_text(written[0], _document("data", _turns(report, whole, edges, shift)))
    write_text(written[1], _document("data", _edges(report, whole, edges, shift)))
    write_text(written[2], _document("detectors", _detectors(edges)))
    write_text(written[3], "\n".join(_flows(report, whole, edges, shift)) + "\n")
    return written


def edges_of(site: "SiteParts") -> dict[GateSide, str]:
    """Return the edge of each gate and direction that has one.

    Raises:
        UserError: No gate has an edge.
    """
    edges = {
        (gate.name, direction): edge
        for gate in site.gates
        if gate.edges
        for direction, edge in zip(direction_names(gate), gate.edges, strict=True)
        if edge
    }
    if not edges:
        raise UserError("no gate of the site has edges; add the names of the SUMO network edges that each gate crosses")
    return edges


def _observed(report: TrafficReport, interval: ClockInterval) -> bool:
    return observed_word(interval, report.observation.seconds_in(interval.begin_s, interval.end_s)) == "full"


def _shift(report: TrafficReport) -> float:
    """Return the seconds to add to those of the footage, to count from midnight or from the first interval."""
    if not report.intervals:
        return 0.0
    first = report.intervals[0]
    if first.begin is None:
        return -first.begin_s
    midnight = first.begin.replace(hour=0, minute=0, second=0, microsecond=0)
    return (first.begin - midnight).total_seconds() - first.begin_s


def _document(name: str, lines: Iterator[str]) -> str:
    return "\n".join((f"<{name}>", *lines, f"</{name}>", ""))


def _interval(interval: ClockInterval, shift: float) -> str:
    return f'  <interval id="counts" begin="{interval.begin_s + shift:.0f}" end="{interval.end_s + shift:.0f}">'


def _turns(
    report: TrafficReport, whole: Sequence[ClockInterval], edges: dict[GateSide, str], shift: float
) -> Iterator[str]:
    """Yield elements with the numbers from edge to edge, by the interval of the first crossing."""
    for interval in whole:
        pairs = Counter(
            movement.sides
            for movement in report.movements
            if interval.begin_s <= movement.time_s < interval.end_s and movement.trajectory.class_name in MOTOR_CLASSES
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
    """Yield counts and mean speeds (km/h) of light and of heavy vehicles; -1 if there is no speed."""
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
        crossing
        for crossing in report.crossings
        if (crossing.gate, crossing.direction_name) == side
        and interval.begin_s <= crossing.time_s < interval.end_s
        and crossing.trajectory.class_name in classes
    ]


def _speed(crossings: Sequence[GateCrossing]) -> str:
    return f"{np.mean([crossing.speed for crossing in crossings]) * KMH_PER_MPS:.1f}" if crossings else "-1"
