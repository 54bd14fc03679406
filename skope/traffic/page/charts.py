"""Charts of the page: counts over time, speeds, headways, flows between gates, and the matrix of turning movements.

Each chart has its numbers as a table below.
"""

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from markupsafe import Markup

from skope.page.charts import Axes, Line, chart, histogram
from skope.page.svg import tag
from skope.page.templates import Cell, Table, piece
from skope.schema import VEHICLE_CATEGORY
from skope.tracks.track import KMH_PER_MPS
from skope.traffic.count_uncertainty import in_words
from skope.traffic.gate_counts import ALL_CLASSES, Count
from skope.traffic.gates import direction_names
from skope.traffic.page.count_tables import Block, interval_label, side_name, with_interval
from skope.traffic.speeds import MOTOR_CLASSES
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import NO_GATE, GateDirection, TurningMovementCount
from skope.types import Array


@dataclass(frozen=True)
class ChartStyle:
    """Sizes of the charts."""

    most_intervals: int = 100
    """Maximum number of intervals with a matrix each. The others are in turning_movements.csv."""
    diagram: float = 560.0
    """Side of the diagram of movements."""
    diagram_radius: float = 200.0
    """Radius of its circle."""
    widest_band: float = 26.0
    """Width of its widest band."""
    thinnest_band: float = 1.5
    """Width of its thinnest band."""
    gate_gap_deg: float = 14.0
    """Angle between the points where bands leave and enter a gate, degrees."""
    turn_inward: float = 0.25
    """Distance of a turn's band from the middle, as a share of the radius, at the band's middle."""
    u_turn_inward: float = 0.6
    """Distance of a U-turn's band from the middle, as a share of the radius."""
    speed_bin_kmh: float = 5.0
    """Width of a bin of speeds, km/h."""
    headway_bin_s: float = 1.0
    """Width of a bin of headways, seconds."""
    longest_headway_s: float = 20.0
    """Longest headway in the histogram, seconds."""
    fewest: int = 5
    """Minimum number of values for a histogram."""
    axis_parts: int = 5
    """Number of parts of an axis."""
    most_marks: int = 48
    """Maximum number of markers on a line."""
    most_lines: int = 4
    """Maximum number of lines in a chart."""


CHART_STYLE: Final = ChartStyle()

Pair = tuple[GateDirection, GateDirection]


def movement_matrices(report: TrafficReport, classes: Sequence[str]) -> list[Block]:
    """Return a matrix of the whole footage for each class, and matrices by interval in a collapsible section.

    Args:
        report: The report.
        classes: `ALL_CLASSES`, and `VEHICLE_CATEGORY` if others are counted too. The first one has matrices by
            interval.

    Returns:
        The blocks; empty if no road user was seen at two gates.
    """
    origins, destinations = _sides(report)
    if not origins:
        return []
    out: list[Block] = []
    for class_name in classes:
        counts = {(row.gate, row.direction): row for row in report.counts_total if row.class_name == class_name}
        cells = _cells(report.turning_total, class_name)
        caption = f"Movements of {_words(class_name)}, from row to column, with 90% intervals of the true number"
        out.append(_matrix(cells, origins, destinations, caption, counts))
    out.append(_about(report, origins, destinations))
    if len(report.intervals) > 1:
        by_interval = []
        for interval in report.intervals:
            rows = [row for row in report.turning if row.interval == interval]
            cells = _cells(rows, classes[0])
            if any(row.count for row in cells.values()):
                caption = f"{interval_label(report, interval)}: {_words(classes[0])}"
                by_interval.append(_matrix(cells, origins, destinations, caption, {}))
        more = f", the first {CHART_STYLE.most_intervals}" if len(by_interval) > CHART_STYLE.most_intervals else ""
        out.append(
            piece("tables_in_details", f"Movements by interval{more}", by_interval[: CHART_STYLE.most_intervals])
        )
    return out


def _words(class_name: str) -> str:
    return "vehicles (more than two wheels)" if class_name == VEHICLE_CATEGORY else "all road users"


def _sides(report: TrafficReport) -> tuple[list[GateDirection], list[GateDirection]]:
    """Return the gates and directions that are origins of movements, and those that are destinations."""
    pairs = [
        (row.origin, row.destination)
        for row in report.turning_total
        if row.count and NO_GATE not in (row.origin, row.destination)
    ]
    return list(dict.fromkeys(origin for origin, _ in pairs)), sorted(
        {destination for _, destination in pairs}, key=_order(report).index
    )


def _order(report: TrafficReport) -> list[GateDirection]:
    return list(dict.fromkeys((row.gate, row.direction) for row in report.counts_total))


def _cells(rows: Iterable[TurningMovementCount], class_name: str) -> dict[Pair, TurningMovementCount]:
    return {(row.origin, row.destination): row for row in rows if row.class_name == class_name}


def _matrix(
    cells: Mapping[Pair, TurningMovementCount],
    origins: Sequence[GateDirection],
    destinations: Sequence[GateDirection],
    caption: str,
    counts: Mapping[GateDirection, Count],
) -> Table:
    """Return one matrix with totals. `counts` has the counts of the gates, for the intervals of the totals."""

    def number(origin: GateDirection, destination: GateDirection) -> int:
        row = cells.get((origin, destination))
        return 0 if row is None or row.count is None else row.count

    def cell(origin: GateDirection, destination: GateDirection) -> Cell:
        row = cells.get((origin, destination))
        bounds = None if row is None or NO_GATE in (origin, destination) else in_words(row.confidence_interval)
        return Cell(number(origin, destination), bounds)

    def total(side: GateDirection, value: int) -> object:
        gate_row = counts.get(side)
        return with_interval(gate_row) if gate_row is not None and gate_row.count == value else value

    rows: list[list[object]] = [
        [
            side_name(origin),
            *(cell(origin, destination) for destination in (*destinations, NO_GATE)),
            total(origin, sum(number(origin, destination) for destination in (*destinations, NO_GATE))),
        ]
        for origin in origins
    ]
    entered = [number(NO_GATE, destination) for destination in destinations]
    rows.append(["not seen before", *entered, "–", sum(entered)])
    ends = [number(origin, NO_GATE) for origin in origins]
    columns = [sum(number(origin, destination) for origin in (*origins, NO_GATE)) for destination in destinations]
    foot = ["total", *map(total, destinations, columns), sum(ends), sum(columns) + sum(ends)]
    head = ["from", *(f"to {side_name(side)}" for side in destinations), "not seen after", "total"]
    return Table(caption=caption, head=head, rows=rows, foot=foot, sticky=True)


def _about(report: TrafficReport, origins: Sequence[GateDirection], destinations: Sequence[GateDirection]) -> str:
    text = (
        "The total of a row or column is the count of its gate and direction. A movement belongs to the interval of "
        "its first gate."
    )
    chosen = report.site.traffic.turning
    absent = [
        side_name((row.gate, row.direction))
        for row in report.counts_total
        if row.class_name == ALL_CLASSES
        and row.count
        and (row.gate, row.direction) not in (*origins, *destinations)
        and (chosen is None or row.gate in chosen)
    ]
    if absent:
        text += f" No road user was tracked between these gates and another gate: {', '.join(absent)}."
    return text


def flow_diagram(report: TrafficReport) -> Markup:
    """Return the diagram of movements; empty if no road user was seen at two gates."""
    vehicles = any(row.class_name == VEHICLE_CATEGORY for row in report.turning_total)
    whole = [
        row
        for row in report.turning_total
        if row.class_name == (VEHICLE_CATEGORY if vehicles else ALL_CLASSES)
        and row.count
        and NO_GATE not in (row.origin, row.destination)
    ]
    if not whole:
        return Markup()
    middles = {gate.name: np.mean(gate.line, axis=0) for gate in report.gates}
    used = {name for row in whole for name, _ in (row.origin, row.destination)}
    angles = _angles({name: middle for name, middle in middles.items() if name in used})
    most = max(row.count or 0 for row in whole)
    order = sorted({row.origin for row in whole})
    parts = [
        tag(
            "circle",
            cx=CHART_STYLE.diagram / 2,
            cy=CHART_STYLE.diagram / 2,
            r=CHART_STYLE.diagram_radius,
            class_="ring",
        )
    ]
    largest_first = sorted(whole, key=lambda row: -(row.count or 0))
    ranks: Counter[GateDirection] = Counter()
    numbers = []
    for row in largest_first:
        band, number = _band(row, angles, most, order.index(row.origin) % 4, ranks[row.origin])
        ranks[row.origin] += 1
        parts.append(band)
        numbers.append(number)
    parts += numbers
    parts += _names(angles)
    drawing = tag(
        "svg",
        *parts,
        viewBox=f"0 0 {CHART_STYLE.diagram:.0f} {CHART_STYLE.diagram:.0f}",
        role="img",
        tabindex=0,
        aria_label="Movements between gates. The numbers are in the table of movements.",
        class_="chart flows",
    )
    title = f"Movements{' of vehicles' if vehicles else ''}; the number of a band is at its origin"
    return piece("figure", title, drawing)


def _angles(middles: dict[str, Array]) -> dict[str, float]:
    """Return the angle of each gate around the centre of all gates, radians. Angles keep a minimum distance."""
    centre = np.mean(list(middles.values()), axis=0)
    found = {name: math.atan2(*(middle - centre)[::-1]) for name, middle in middles.items()}
    names = sorted(found, key=lambda name: found[name])
    least = min(math.radians(3 * CHART_STYLE.gate_gap_deg), 2 * math.pi / len(names))
    for _ in range(50):
        for before, after in zip(names, names[1:] + names[:1], strict=True):
            gap = (found[after] - found[before]) % (2 * math.pi)
            if len(names) > 1 and gap < least:
                found[before] -= (least - gap) / 2
                found[after] += (least - gap) / 2
    return found


def _at(angle: float, radius: float) -> tuple[float, float]:
    return CHART_STYLE.diagram / 2 + radius * math.cos(angle), CHART_STYLE.diagram / 2 - radius * math.sin(angle)


def _band(
    movement: TurningMovementCount, angles: dict[str, float], most: int, style: int, rank: int
) -> tuple[Markup, Markup]:
    """Return the band of a movement and its number.

    The number is farther along the band for each larger movement from the same gate and direction. Bands into a gate
    are to the right of bands out of it.
    """
    half = math.radians(CHART_STYLE.gate_gap_deg) / 2
    begin, end = angles[movement.origin[0]] + half, angles[movement.destination[0]] - half
    (ax, ay), (bx, by) = _at(begin, CHART_STYLE.diagram_radius), _at(end, CHART_STYLE.diagram_radius)
    inward = (
        CHART_STYLE.u_turn_inward if movement.origin[0] == movement.destination[0] else CHART_STYLE.turn_inward
    ) * CHART_STYLE.diagram_radius
    (cx, cy), (dx, dy) = _at(begin, inward), _at(end, inward)
    number = movement.count or 0
    width = max(CHART_STYLE.thinnest_band, CHART_STYLE.widest_band * number / most)
    tip = (
        f"{_side(movement.origin)} to {_side(movement.destination)}: {number} "
        f"({in_words(movement.confidence_interval)})"
    )
    path = f"M{ax:.1f} {ay:.1f}C{cx:.1f} {cy:.1f} {dx:.1f} {dy:.1f} {bx:.1f} {by:.1f}"
    t = min(0.16 + 0.14 * rank, 0.8)
    weights = ((1 - t) ** 3, 3 * (1 - t) ** 2 * t, 3 * (1 - t) * t**2, t**3)
    x = sum(w * v for w, v in zip(weights, (ax, cx, dx, bx), strict=True))
    y = sum(w * v for w, v in zip(weights, (ay, cy, dy, by), strict=True))
    band = tag("path", d=path, class_=f"flow s{style}", stroke_width=f"{width:.1f}", data_tip=tip)
    return band, tag("text", str(number), x=f"{x:.1f}", y=f"{y:.1f}", text_anchor="middle")


def _side(side: tuple[str, str]) -> str:
    return f"{side[0]} ({side[1]})"


def _names(angles: dict[str, float]) -> Iterator[Markup]:
    for name, angle in angles.items():
        x, y = _at(angle, CHART_STYLE.diagram_radius + 26)
        side = "middle" if abs(math.cos(angle)) < 0.4 else "start" if math.cos(angle) > 0 else "end"
        x += {"start": -14, "end": 14, "middle": 0}[side]
        yield tag("text", name, x=f"{x:.1f}", y=f"{y:.1f}", text_anchor=side, class_="gate")


def counts_over_time(report: TrafficReport) -> Iterator[Markup]:
    """Yield a figure for each gate: hourly flow of all road users by interval."""
    if len(report.intervals) < 2:
        return
    for gate in report.gates:
        lines = []
        for name in direction_names(gate):
            rows = [
                row
                for row in report.counts
                if (row.gate, row.direction, row.lane, row.class_name) == (gate.name, name, ALL_CLASSES, ALL_CLASSES)
            ]
            hours = [(row.interval.begin_s + row.interval.end_s) / 2 / 3600 for row in rows]
            flows = [
                None if not row.count and not row.observed_s else _hourly(row.count, row.observed_s) for row in rows
            ]
            if any(flows):
                lines.append(Line(name=name, x=[max(0.0, hour) for hour in hours], y=flows))
        if lines:
            end = max(x for line in lines for x in line.x) or 1.0
            top = max(y for line in lines for y in line.y if y is not None)
            axes = Axes(x_label=_hours(report), y_label="road users per hour", x_end=_round(end), y_end=_whole(top))
            yield chart(
                f"{gate.name}: over time", axes, lines, every=math.ceil(len(report.intervals) / CHART_STYLE.most_marks)
            )


def _hours(report: TrafficReport) -> str:
    """Return the axis label of hours, with their origin."""
    return "hours of the footage" if report.start is None else f"hours after {report.start:%H:%M:%S on %d %b %Y}"


def _hourly(count: int | None, observed_s: float) -> float | None:
    return None if count is None or observed_s <= 0 else count * 3600 / observed_s


def speed_histograms(report: TrafficReport) -> Iterator[Markup]:
    """Yield a figure for each gate: speeds of motor vehicles."""
    for gate in report.gates:
        groups = {
            name: [
                crossing.speed * KMH_PER_MPS
                for crossing in report.crossings
                if (crossing.gate, crossing.direction_name) == (gate.name, name)
                and crossing.trajectory.class_name in MOTOR_CLASSES
            ]
            for name in direction_names(gate)
        }
        yield from _histogram(f"{gate.name}: speeds of motor vehicles", "km/h", groups, CHART_STYLE.speed_bin_kmh)


def headway_histograms(report: TrafficReport) -> Iterator[Markup]:
    """Yield a figure for each gate: headways of vehicles."""
    for gate in report.gates:
        groups = {
            name: [
                headway.headway_s
                for headway in report.headways
                if (headway.follower.gate, headway.follower.direction_name) == (gate.name, name)
                and headway.headway_s <= CHART_STYLE.longest_headway_s
            ]
            for name in direction_names(gate)
        }
        yield from _histogram(
            f"{gate.name}: headways up to {CHART_STYLE.longest_headway_s:g} s",
            "seconds",
            groups,
            CHART_STYLE.headway_bin_s,
        )


def _histogram(title: str, unit: str, groups: dict[str, list[float]], step: float) -> Iterator[Markup]:
    known = {name: np.array(values)[np.isfinite(values)] for name, values in groups.items() if values}
    enough = {name: values for name, values in known.items() if len(values) >= CHART_STYLE.fewest}
    if not enough:
        return
    # The axis has five parts; its end is chosen so that all of them are at whole numbers.
    part = CHART_STYLE.axis_parts * step
    end = part * max(1, math.ceil(max(float(values.max()) for values in enough.values()) / part + 1e-9))
    bands = np.arange(0, end + step / 2, step)
    middles = ((bands[:-1] + bands[1:]) / 2).tolist()
    lines = [
        Line(name=f"{name} ({len(values)})", x=middles, y=np.histogram(values, bands)[0].astype(float).tolist())
        for name, values in list(enough.items())[: CHART_STYLE.most_lines]
    ]
    top = max(y for line in lines for y in line.y if y is not None)
    yield histogram(title, Axes(x_label=unit, y_label="number", x_end=end, y_end=_whole(top)), lines)


def _whole(value: float) -> float:
    """Return a round number that is not smaller and gives whole numbers at all parts of an axis."""
    return CHART_STYLE.axis_parts * max(1.0, math.ceil(_round(value / CHART_STYLE.axis_parts) - 1e-9))


def _round(value: float) -> float:
    """Return a round number that is not smaller."""
    if value <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return next(step * power for step in (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10) if step * power >= value - 1e-9)
