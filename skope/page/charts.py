"""Line charts and histograms as SVG, each with its numbers as a table below.

Lines differ in dashes and marker shape as well as in colour.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from markupsafe import Markup, escape

from skope.page.svg import tag
from skope.page.templates import Table, number_text, piece

PLOT_WIDTH, PLOT_HEIGHT = 460, 320
PLOT_LEFT, PLOT_RIGHT, PLOT_TOP, PLOT_BOTTOM = 48, 14, 14, 44
MARKER_NAMES: Final = ("circle", "square", "diamond", "triangle")
MARKER_PATHS: Final = {
    "circle": "M{0} {1}m-4 0a4 4 0 1 0 8 0a4 4 0 1 0-8 0",
    "square": "M{0} {1}m-3.6-3.6h7.2v7.2h-7.2z",
    "diamond": "M{0} {1}m0-5l5 5l-5 5l-5-5z",
    "triangle": "M{0} {1}m0-5l4.6 8h-9.2z",
}


@dataclass(frozen=True, kw_only=True)
class Line:
    """Line of a chart; points without y are omitted."""

    name: str
    x: Sequence[float]
    y: Sequence[float | None]
    notes: Sequence[str] = ()
    """Tooltip text for each point, after its coordinates."""


@dataclass(frozen=True, kw_only=True)
class Axes:
    """Labels and upper ends of a chart's axes, which begin at 0."""

    x_label: str
    y_label: str
    x_end: float = 1.0
    y_end: float = 1.0

    def to_drawing(self, x: float, y: float) -> tuple[float, float]:
        """Return the position of the point (x, y) in the drawing."""
        across, up = PLOT_WIDTH - PLOT_LEFT - PLOT_RIGHT, PLOT_HEIGHT - PLOT_TOP - PLOT_BOTTOM
        return round(PLOT_LEFT + x / self.x_end * across, 1), round(PLOT_TOP + (1 - y / self.y_end) * up, 1)


def chart(title: str, axes: Axes, lines: Sequence[Line], *, diagonal: bool = False, every: int = 1) -> Markup:
    """Draw a line chart; each marker shows its numbers.

    Args:
        title: Caption, plain text.
        axes: Labels and ends.
        lines: Up to four lines, in the order of their markers and colours.
        diagonal: Whether to draw the diagonal.
        every: Stride of the points that are marked and listed in the table.

    Returns:
        The figure as markup: drawing, legend and the numbers as a table.
    """
    parts = [_grid(axes)]
    if diagonal:
        (x0, y0), (x1, y1) = axes.to_drawing(0, 0), axes.to_drawing(axes.x_end, axes.y_end)
        parts.append(f'<path class="ideal" d="M{x0} {y0}L{x1} {y1}"/>')
    parts += [_line(i, line, axes, every) for i, line in enumerate(lines)]
    return _figure(title, axes, lines, parts, every)


def histogram(title: str, axes: Axes, groups: Sequence[Line]) -> Markup:
    """Draw a histogram with a bar for each band of each group.

    Args:
        title: Caption, plain text.
        axes: Labels and ends.
        groups: Groups of bars: `x` are the centres of bands of equal width, `y` the heights.

    Returns:
        The figure as markup: drawing, legend and the numbers as a table.
    """
    parts = [_grid(axes), *(_bars(i, group, axes) for i, group in enumerate(groups))]
    return _figure(title, axes, groups, parts, every=1)


def _figure(title: str, axes: Axes, lines: Sequence[Line], parts: Sequence[str], every: int) -> Markup:
    drawing = tag(
        "svg",
        Markup("".join(parts)),
        viewBox=f"0 0 {PLOT_WIDTH} {PLOT_HEIGHT}",
        role="img",
        aria_label=f"{title}. The numbers are in the table below.",
        tabindex=0,
        class_="chart",
    )
    legend = [_legend(i, line.name) for i, line in enumerate(lines)]
    return piece("figure", title, drawing, legend, _numbers(title, axes, lines, every))


def _grid(axes: Axes) -> str:
    marks = []
    for i in range(6):
        x, y = axes.x_end * i / 5, axes.y_end * i / 5
        (px, bottom), (left, py) = axes.to_drawing(x, 0), axes.to_drawing(0, y)
        marks.append(f'<path class="grid" d="M{px} {PLOT_TOP}V{bottom}M{left} {py}H{PLOT_WIDTH - PLOT_RIGHT}"/>')
        marks.append(f'<text x="{px}" y="{bottom + 16}" text-anchor="middle">{x:g}</text>')
        marks.append(f'<text x="{left - 6}" y="{py + 4}" text-anchor="end">{y:g}</text>')
    middle = PLOT_TOP + (PLOT_HEIGHT - PLOT_TOP - PLOT_BOTTOM) / 2
    across = (PLOT_LEFT + PLOT_WIDTH - PLOT_RIGHT) / 2
    marks.append(
        f'<text x="{across}" y="{PLOT_HEIGHT - 8}" text-anchor="middle">{escape(axes.x_label)}</text>'
        f'<text transform="translate(12 {middle}) rotate(-90)" text-anchor="middle">{escape(axes.y_label)}</text>'
    )
    return "".join(marks)


def _known(line: Line) -> list[tuple[int, float, float]]:
    return [(i, x, y) for i, (x, y) in enumerate(zip(line.x, line.y, strict=True)) if y is not None]


def _line(number: int, line: Line, axes: Axes, every: int) -> str:
    points = [(i, *axes.to_drawing(x, y), x, y) for i, x, y in _known(line)]
    if not points:
        return ""
    path = "M" + "L".join(f"{px} {py}" for _, px, py, _, _ in points)
    out = [f'<path class="line s{number % 4}" d="{path}"/>']
    for i, px, py, x, y in points:
        if i % every == 0:
            note = f"; {line.notes[i]}" if line.notes else ""
            tip = f"{line.name}: {axes.x_label} {x:.3g}, {axes.y_label} {y:.3f}{note}"
            shape = MARKER_PATHS[MARKER_NAMES[number % 4]].format(px, py)
            out.append(f'<path class="mark s{number % 4}" d="{shape}" data-tip="{escape(tip)}"/>')
    return "".join(out)


def _bars(number: int, group: Line, axes: Axes) -> str:
    """Draw the outline of a group of bars, filled faintly, with a tooltip for each bar."""
    half = (group.x[1] - group.x[0]) / 2
    known = _known(group)
    corners = [axes.to_drawing(x + side, y) for _, x, y in known for side in (-half, half)]
    first, last = axes.to_drawing(group.x[0] - half, 0), axes.to_drawing(group.x[-1] + half, 0)
    outline = "M" + "L".join(f"{px} {py}" for px, py in [first, *corners, last])
    out = [f'<path class="band s{number % 4}" d="{outline}"/>']
    for _, x, y in known:
        px, py = axes.to_drawing(x, y)
        tip = f"{group.name}: {axes.x_label} {x - half:.3g} to {x + half:.3g}, {axes.y_label} {y:.3f}"
        shape = MARKER_PATHS[MARKER_NAMES[number % 4]].format(px, py)
        if y > 0:
            out.append(f'<path class="mark s{number % 4}" d="{shape}" data-tip="{escape(tip)}"/>')
    return "".join(out)


def _legend(number: int, name: str) -> Markup:
    shape = MARKER_PATHS[MARKER_NAMES[number % 4]].format(17, 6)
    sample = (
        tag("path", class_=f"line s{number % 4}", d="M1 6H33"),
        tag("path", class_=f"mark s{number % 4}", d=shape),
    )
    return tag("svg", *sample, viewBox="0 0 34 12", aria_hidden="true") + escape(name)


def _numbers(title: str, axes: Axes, lines: Sequence[Line], every: int) -> Table:
    xs = sorted({x for line in lines for i, x, _ in _known(line) if i % every == 0})
    values = [{x: y for _, x, y in _known(line)} for line in lines]
    rows = [[f"{x:.3g}", *(number_text(of.get(x)) for of in values)] for x in xs]
    return Table(caption=title, head=[axes.x_label, *(line.name for line in lines)], rows=rows)
