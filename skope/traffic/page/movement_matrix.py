"""Turning movements of the page as a matrix: rows are origins, columns are destinations."""

from collections.abc import Iterable, Mapping, Sequence
from html import escape
from typing import Final

from skope.page.html_pieces import details, tag
from skope.schema import VEHICLE
from skope.traffic.count_uncertainty import in_words
from skope.traffic.gate_counts import ALL, Count
from skope.traffic.page.count_tables import interval_label, side_name, titled_table, with_interval
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import NOWHERE, GateDirection, TurningCount

_MAX_INTERVALS: Final = 100
"""Maximum number of intervals with a matrix each; the others are in turning.csv."""
Pair = tuple[GateDirection, GateDirection]


def movement_matrices(report: TrafficReport, classes: Sequence[str]) -> list[str]:
    """A matrix of the whole footage for each class, and matrices by interval in a section that opens.

    Args:
        report: The report.
        classes: `ALL`, and `VEHICLE` if others are counted too; the first one has matrices by interval.

    Returns:
        Markup; empty if nobody was seen at two gates.
    """
    origins, destinations = _sides(report)
    if not origins:
        return []
    out = []
    for class_name in classes:
        counts = {(row.gate, row.direction): row for row in report.counts_total if row.class_name == class_name}
        cells = _cells(report.turning_total, class_name)
        caption = f"Movements of {_words(class_name)}, from row to column, with 90% intervals of the true number"
        out.append(_matrix(cells, origins, destinations, caption, counts))
    out.append(tag("p", escape(_about(report, origins, destinations))))
    if len(report.intervals) > 1:
        by_interval = []
        for interval in report.intervals:
            rows = [row for row in report.turning if row.interval == interval]
            cells = _cells(rows, classes[0])
            if any(row.count for row in cells.values()):
                caption = f"{interval_label(report, interval)}: {_words(classes[0])}"
                by_interval.append(_matrix(cells, origins, destinations, caption, {}))
        more = f", the first {_MAX_INTERVALS}" if len(by_interval) > _MAX_INTERVALS else ""
        out.append(details(f"Movements by interval{more}", *by_interval[:_MAX_INTERVALS]))
    return out


def _words(class_name: str) -> str:
    return "vehicles (more than two wheels)" if class_name == VEHICLE else "all road users"


def _sides(report: TrafficReport) -> tuple[list[GateDirection], list[GateDirection]]:
    """Gates and directions that somebody came from before another gate, and those that somebody went to."""
    pairs = [
        (row.origin, row.destination)
        for row in report.turning_total
        if row.count and NOWHERE not in (row.origin, row.destination)
    ]
    return list(dict.fromkeys(origin for origin, _ in pairs)), sorted(
        {destination for _, destination in pairs}, key=_order(report).index
    )


def _order(report: TrafficReport) -> list[GateDirection]:
    return list(dict.fromkeys((row.gate, row.direction) for row in report.counts_total))


def _cells(rows: Iterable[TurningCount], class_name: str) -> dict[Pair, TurningCount]:
    return {(row.origin, row.destination): row for row in rows if row.class_name == class_name}


def _matrix(
    cells: Mapping[Pair, TurningCount],
    origins: Sequence[GateDirection],
    destinations: Sequence[GateDirection],
    caption: str,
    counts: Mapping[GateDirection, Count],
) -> str:
    """One matrix with totals. `counts` holds the gates' counts, which give the intervals of the totals."""

    def number(origin: GateDirection, destination: GateDirection) -> int:
        row = cells.get((origin, destination))
        return 0 if row is None or row.count is None else row.count

    def cell(origin: GateDirection, destination: GateDirection) -> str:
        row = cells.get((origin, destination))
        bounds = "" if row is None or NOWHERE in (origin, destination) else f" <small>{in_words(row.expected)}</small>"
        return f"{number(origin, destination)}{bounds}"

    def total(side: GateDirection, value: int) -> str:
        own = counts.get(side)
        return with_interval(own) if own is not None and own.count == value else str(value)

    rows = [
        [
            escape(side_name(origin)),
            *(cell(origin, destination) for destination in (*destinations, NOWHERE)),
            total(origin, sum(number(origin, destination) for destination in (*destinations, NOWHERE))),
        ]
        for origin in origins
    ]
    entered = [number(NOWHERE, destination) for destination in destinations]
    rows.append(["not seen before", *map(str, entered), "–", str(sum(entered))])
    ends = [number(origin, NOWHERE) for origin in origins]
    columns = [sum(number(origin, destination) for origin in (*origins, NOWHERE)) for destination in destinations]
    foot = ["total", *map(total, destinations, columns), str(sum(ends)), str(sum(columns) + sum(ends))]
    head = ["from", *(f"to {side_name(side)}" for side in destinations), "not seen after", "total"]
    return titled_table(caption, head, rows, foot=foot)


def _about(report: TrafficReport, origins: Sequence[GateDirection], destinations: Sequence[GateDirection]) -> str:
    text = (
        "The total of a row or column is the count of its gate and direction. A movement belongs to the interval of "
        "its first gate."
    )
    chosen = report.site.traffic.turning
    absent = [
        side_name((row.gate, row.direction))
        for row in report.counts_total
        if row.class_name == ALL
        and row.count
        and (row.gate, row.direction) not in (*origins, *destinations)
        and (chosen is None or row.gate in chosen)
    ]
    if absent:
        text += f" Nobody was followed from these to another gate, or to these from another: {', '.join(absent)}."
    return text
