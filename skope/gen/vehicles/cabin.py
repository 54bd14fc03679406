"""Greenhouse of a car: pillars, panes and roof above the lower body as one loft; roof loads and hardtops over beds."""

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, box, grid, merged
from skope.gen.vehicles import parts
from skope.gen.vehicles.lofted_surfaces import (
    CENTER,
    FRONT_END,
    ROW_AXES,
    SIDE_AXES,
    SIDE_START,
    TOP_AXES,
    WRAP_AXES,
    Plan,
    Surface,
    T,
    X,
    metres_along,
)
from skope.gen.vehicles.panels import PANEL_LIMITS, rectangle_outline
from skope.gen.vehicles.rear import draw_taillight
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import ROOF_CORNER_ROW, Tower
from skope.types import Array

ROOF_LOAD_HEIGHTS_M: Final = {"box": 0.42, "bars": 0.05, "ladder": 0.12, "beacons": 0.13}
"""Height of each kind of load above the roof's highest point, metres."""
_BAR_HEIGHT_M: Final = ROOF_LOAD_HEIGHTS_M["bars"]


@dataclass(frozen=True)
class CabinSizes:
    """Sizes of a cabin, its roof and the parts on it."""

    box_ring: tuple[tuple[float, float], ...] = (
        (0.0, 0.0),
        (0.9, 0.0),
        (1.0, 0.12),
        (1.0, 0.5),
        (0.9, 0.88),
        (0.7, 1.0),
        (0.0, 1.0),
    )
    """Half of a luggage box's section, from the bottom centre to the top centre: shares of its width and height."""
    box_sections: tuple[tuple[float, float], ...] = (
        (1.0, 0.05),
        (0.98, 0.6),
        (0.8, 0.86),
        (0.4, 1.0),
        (-0.8, 1.0),
        (-0.97, 0.9),
        (-1.0, 0.05),
    )
    """Sections of a luggage box: share of half its length, from front to rear, and share of its largest section
    there."""
    bed_gap_m: float = 0.07
    """Gap between cabin and hardtop at the bed's edge, metres."""
    above_bed_m: float = 0.005
    """Height of the hardtop's foot above the bed's edge, metres."""
    surround_share: float = 0.03
    """Width of the dark surround of a pane, as a share of the pillars' height."""
    edge_rows: tuple[tuple[float, float, float], tuple[float, float, float]] = (
        (1.3, 0.015, 0.015),
        (1.65, 0.042, 0.027),
    )
    """Rows of the edge between pillars and roof: row, distance inwards, distance upwards, metres."""
    crown_m: float = 0.052
    """Height of the roof's centre line above its edge, metres."""
    screen_top: float = 0.985
    """Height of the upper edge of a screen, as a share of the pillars' height."""
    pillar_lamp_m: float = 0.17
    """Width of a lamp in the pillar, metres."""
    sunk_m: float = 0.012
    """Depth of the pillars' foot in the lower body, metres."""


CABIN_SIZES: Final = CabinSizes()


def roof_load(
    kind: str, front: float, rear: float, half_width: float, top: float, edge: Callable[[Array], Array]
) -> Mesh:
    """Return the left half of a load on a roof, metres.

    Args:
        kind: One of `ROOF_LOAD_HEIGHTS_M`.
        front: x of the roof's front end.
        rear: x of its rear end.
        half_width: Distance from the middle to the roof's edge.
        top: Height of the roof's highest point above the road.
        edge: Height of the roof's edge at x.
    """
    if kind == "beacons":
        return _beacons((front, rear), half_width, top, edge)
    high, length = top + _BAR_HEIGHT_M, front - rear
    places = np.array([front - 0.25 * length, front - 0.72 * length])
    parts = []
    for x, low in zip(places.tolist(), edge(places).tolist(), strict=True):
        foot = half_width - 0.07
        parts.append(box((x - 0.03, 0.0, high - 0.025), (x + 0.03, half_width - 0.02, high), "rail"))
        parts.append(box((x - 0.032, foot, low - 0.02), (x + 0.032, half_width - 0.02, high - 0.005), "trim"))
    middle, reach = float(places.mean()), min(0.95, 0.5 * length)
    if kind == "box":
        size = (reach, min(0.4, half_width - 0.12), ROOF_LOAD_HEIGHTS_M["box"] - _BAR_HEIGHT_M)
        parts.append(_box_shell((middle, 0.0, high), size, CABIN_SIZES.box_sections, "#222222"))
    if kind == "ladder":
        parts += _ladder((middle - reach - 0.2, middle + reach), high)
    return merged(parts)


def _beacons(span: tuple[float, float], half_width: float, top: float, edge: Callable[[Array], Array]) -> Mesh:
    """Return bars of blue lamps across the roof, at its front and rear."""
    out = []
    for x in (span[0] - 0.28, span[1] + 0.25):
        half, high = half_width - 0.12, top + ROOF_LOAD_HEIGHTS_M["beacons"]
        low = float(edge(np.array([x])).item())
        out.append(box((x - 0.1, 0.0, low), (x + 0.1, half - 0.05, top + 0.03), "trim"))
        for y, stop, material in ((0.0, 0.22, "#d8d8d8"), (0.22, half, "#1b52d8")):
            out.append(box((x - 0.14, y, top + 0.02), (x + 0.14, stop, high), material))
    return merged(out)


def _ladder(span: tuple[float, float], low: float) -> list[Mesh]:
    start, end = span
    rungs = np.arange(start + 0.2, end - 0.1, 0.28).tolist()
    sides = [box((start, y, low), (end, y + 0.045, low + 0.07), "chrome") for y in (0.1, 0.42)]
    return sides + [box((x, 0.14, low + 0.02), (x + 0.035, 0.43, low + 0.05), "chrome") for x in rungs]


def antenna(kind: str, x: float, top: float, fin: str) -> Mesh:
    """Return the left half of an antenna on the middle of a roof, `top` high at `x`, metres.

    A fin is of material `fin`.
    """
    if kind == "rod":
        return box((x - 0.006, 0.0, top - 0.02), (x + 0.006, 0.006, top + 0.28), "trim")
    sections = ((1.0, 0.05), (0.5, 0.4), (-0.6, 1.0), (-0.9, 0.95), (-1.0, 0.05))
    return _box_shell((x, 0.0, top - 0.03), (0.1, 0.024, 0.075), sections, fin)


def _box_shell(
    at: tuple[float, float, float], size: tuple[float, float, float], sections: ArrayLike, material: str
) -> Mesh:
    """Return the left half of a closed shell with its bottom centre at `at`.

    Args:
        at: Position of the bottom centre, metres.
        size: Half its length, half its width, and its height, metres.
        sections: Sections along the shell, as `CabinSizes.box_sections`.
        material: Its material.
    """
    along, share = np.asarray(sections, dtype=np.float64).T[:, :, None]
    across, up = np.array(CABIN_SIZES.box_ring).T[:, None]
    points = np.stack(np.broadcast_arrays(along, share * across, share * up), axis=-1) * size + at
    return grid(points[::-1], [[material] * (len(CABIN_SIZES.box_ring) - 1)] * (points.shape[0] - 1))


def canopy(s: Shape) -> tuple[Mesh, dict[str, Array]]:
    """Return the left half of a hardtop, and the corners of its rear roof and rear window."""
    front, rear = s.backlight_x - CABIN_SIZES.bed_gap_m, -s.length / 2 + s.tail_lean + 0.14
    low, high = s.deck_height + CABIN_SIZES.above_bed_m, s.height - 0.012
    plan = Plan(s.width / 2 - 0.085, front, rear, 0.0, 0.03, 0.06, 0.1)
    lean = [(0.0, 0.0, 0.0, 0.0), (0.12, 0.012, 0.0, 0.01), (1.0, 0.11, 0.05, 0.2)]
    shell, w, _ = Tower(plan, low, high, lean, edge=0.07, crown=0.03, stations=5, levels=4).surface("paint")
    tall, length = high - low, front - rear
    shell.draw(rectangle_outline(-1, 99, 0, low + 0.045), WRAP_AXES, "trim", layer=2)
    base, top = low + 0.16 * tall, low + 0.74 * tall
    start, stop = rear + 0.17 * length + 0.05, front - 0.1 * length
    for a, b in ((start, start + 0.42 * length), (start + 0.45 * length, stop)):
        shell.paint(
            rectangle_outline(a - 0.025, b + 0.025, base - 0.025, top + 0.025),
            SIDE_AXES,
            "trim",
            facing=PANEL_LIMITS.left_axis,
        )
        shell.paint(rectangle_outline(a, b, base, top), SIDE_AXES, "glass_tinted", facing=PANEL_LIMITS.left_axis)
    end = float(w[-1])
    corner = end - s.width / 2 + 0.23
    shell.paint(rectangle_outline(corner - 0.03, end + 0.1, base - 0.03, top + 0.06), WRAP_AXES, "trim")
    shell.paint(rectangle_outline(corner, end + 0.1, base, top + 0.03), WRAP_AXES, "glass_tinted")
    shell.draw(rectangle_outline(end - 0.15, end + 0.1, top + 0.08, top + 0.11), WRAP_AXES, "brake_light", layer=2)
    points = {
        "roof_rear": shell.corner(ROOF_CORNER_ROW, rear=True),
        "rear_window_base": shell.place((corner, base), WRAP_AXES)[0],
    }
    return shell.half, points


_GLASS_LOW, _GLASS_HIGH = 0.1, 0.93
_GLASS_ROWS: Final = (0.0, _GLASS_LOW - CABIN_SIZES.surround_share, _GLASS_LOW, 0.38, 0.68, _GLASS_HIGH, 1.0)
"""Rows of the pillars. Panes end at rows, so that no triangle needs to be split there."""
_ROOF_CORNER_ROW: Final = CABIN_SIZES.edge_rows[0][0]
"""Row of the roof's rear corners: on the rounded edge, which is visible from the front and from the rear. The rear
window's corners lie lower on the rear face, where the roof hides them from the front."""
_ROOF_ROWS: Final = ((2.0, 0.84), (2.3, 0.55), (CENTER, 0.0))
"""Rows of the roof: row, and share of the distance from its centre line to its edge."""
_ROOF_SIGNS: Final = ("sign", "sign_taxi_red", "sign_taxi_green")
"""Materials of lit roof signs. The vehicle's length selects one."""


class Greenhouse:
    """Left half of a greenhouse (windows, pillars and roof).

    `points` are its keypoints by name without side, and `parts` the parts that project from it.
    """

    def __init__(self, shape: Shape, style: VehicleStyle, deck: Callable[[Array, Array], Array]) -> None:
        """Build the greenhouse.

        Args:
            shape: Shape of the vehicle.
            style: Style of the vehicle.
            deck: Height of the lower body's top at positions x, y.
        """
        self.shape, self.style = shape, style
        self.hatch = shape.deck_length < 0.3
        self.points: dict[str, Array] = {}
        self.parts: list[Mesh] = []
        self._rear_pane_w = 0.0
        """W (metres along the shell) of the rear window's edge."""
        self.pillar_x = 0.0
        """x of the B-pillar at the belt, metres."""
        self.surface = self._build_shell(deck)
        self._draw_panes()
        if style.taillight == "pillar":
            self._draw_pillar_lamp()
        self._add_parts()

    def foot(self, inset: float) -> Array:
        """Return the left outline (N, 2) of its foot from front to rear, `inset` metres inside."""
        outline = self._plan(0.0).outline(np.linspace(0, 1, 3))
        keep = [0, FRONT_END, FRONT_END + 2, SIDE_START, SIDE_START + 2, SIDE_START + 4, -FRONT_END - 1, -1]
        middle = np.array([(outline[0, 0] + outline[-1, 0]) / 2, 0.0])
        chosen = outline[keep] - middle
        return np.asarray(middle + np.sign(chosen) * np.maximum(np.abs(chosen) - inset, 0))

    def _plan(self, t: float) -> Plan:
        """Return the horizontal section at a height, which is a share of the pillars' height."""
        s = self.shape
        half = s.width / 2 - 0.03 - s.shoulder_inset
        bow = 0.15 if s.width < 1.95 else 0.12
        base = Plan(half, s.cowl_x, s.backlight_x, bow, 0.07, 0.15, 0.15, 0.05, 0.05)
        roof = Plan(
            half - s.roof_inset, s.cowl_x - s.screen_run, s.backlight_x + s.backlight_run,
            0.07, 0.05, 0.15, 0.15, 0.025, 0.035,
        )  # fmt: skip
        share, bulge = min(t, 1.0), 4 * min(t, 1.0) * (1 - min(t, 1.0))
        values = {f.name: (1 - share) * getattr(base, f.name) + share * getattr(roof, f.name) for f in fields(Plan)}
        values["half_width"] += 0.022 * bulge
        values["front"] += 0.03 * bulge
        values["rear"] -= 0.03 * bulge
        return Plan(**values)

    def roof_edge(self, x: Array) -> Array:
        """Return the height of the roof's edge."""
        s = self.shape
        front, rear = s.cowl_x - s.screen_run, s.backlight_x + s.backlight_run
        middle = front + 0.4 * (rear - front)
        away = np.where(x > middle, (x - middle) / (front - middle), (x - middle) / (rear - middle))
        # A short roof slopes no more steeply than a long roof.
        droop = s.roof_droop * min((front - rear) / 1.6, 1.0)
        return np.asarray(
            s.height - CABIN_SIZES.edge_rows[-1][2] - CABIN_SIZES.crown_m - droop * np.minimum(np.abs(away), 1.1) ** 2
        )

    def _build_shell(self, deck: Callable[[Array, Array], Array]) -> Surface:
        stations = np.linspace(0, 1, 8)
        base, roof = (self._plan(t).outline(stations) for t in (0.0, 1.0))
        low, high = deck(base[:, 0], base[:, 1]) - CABIN_SIZES.sunk_m, self.roof_edge(roof[:, 0])
        rows = [np.column_stack([self._plan(t).outline(stations), low + (high - low) * t]) for t in _GLASS_ROWS]
        top = self._plan(1.0)
        for _, inset, over in CABIN_SIZES.edge_rows:
            plan = Plan(
                top.half_width - inset, top.front - inset * 1.6, top.rear + inset * 1.6,
                top.front_round, top.rear_round, 0.15, 0.15, top.front_taper, top.rear_taper,
            )  # fmt: skip
            rows.append(np.column_stack([plan.outline(stations), high + over]))
        edge = rows[-1]
        reach = min(0.4, 0.3 * float(np.ptp(edge[:, 0])))
        spine = np.clip(edge[:, 0], edge[:, 0].min() + reach, edge[:, 0].max() - reach)
        ridge = self.roof_edge(spine) + CABIN_SIZES.edge_rows[-1][2]
        for _, share in _ROOF_ROWS:
            x, z = (b + share * (a - b) for a, b in ((edge[:, 0], spine), (edge[:, 2], ridge)))
            rows.append(np.column_stack([x, share * edge[:, 1], z + CABIN_SIZES.crown_m * (1 - share**2.3)]))
        levels = [*_GLASS_ROWS, *(row[0] for row in CABIN_SIZES.edge_rows), *(row[0] for row in _ROOF_ROWS)]
        self._w = metres_along(self._plan(0.5).outline(stations))
        return Surface(rows, levels, self._w, "paint")

    def _draw_panes(self) -> None:
        """Draw windscreen, side panes and rear window, each in its dark surround."""
        s, style, glass, w = self.shape, self.style, self.surface, self._w
        last, total = len(w) - 1, float(w[-1])
        screen = float(w[FRONT_END + 2]) + 0.02
        # Under a high roof, panes end at the same height as under a low roof.
        room = s.height - s.belt_height
        if style.pillar_tone and style.glazed == 1:
            glass.paint(rectangle_outline(-1, total + 1, -1, 9), ROW_AXES, style.pillar_tone, levels=(0.0, 1.0))
        if style.roof_tone:
            glass.paint(rectangle_outline(-1, total + 1, -1, 9), ROW_AXES, style.roof_tone, levels=(1.0, CENTER))
        side_high, screen_high = min(_GLASS_HIGH, 0.82 / room), min(CABIN_SIZES.screen_top, 1.14 / room)
        self._draw_screen(-0.2, screen, _GLASS_LOW, screen_high, "glass")
        self._draw_side_panes(side_high)
        rear = total - float(w[last - FRONT_END - 1]) - (0.0 if not self.hatch else 0.02)
        low = _GLASS_LOW if not self.hatch or style.bed else 0.14
        high = 0.95 if not self.hatch else 0.9
        if style.glazed < 1:
            low, high, rear = 0.3, 0.84, rear - 0.08
        self._rear_pane_w = total - rear
        self._draw_screen(self._rear_pane_w, total + 0.2, low, high, "glass_tinted" if style.tinted else "glass")
        self.points |= {
            "roof_front": glass.place((screen, screen_high), ROW_AXES)[0],
            "windscreen_base": glass.place((screen, _GLASS_LOW), ROW_AXES)[0],
            "roof_rear": glass.corner(_ROOF_CORNER_ROW, rear=True),
            "rear_window_base": glass.place((total - rear, low), ROW_AXES)[0],
        }
        self._draw_wipers(screen, total - rear, low, high)
        if style.glazed < 1:
            glass.line([(total - 0.004, -0.1), (total - 0.004, high)], ROW_AXES, width=0.014)

    def _draw_side_panes(self, high: float) -> None:
        s, style, glass, w = self.shape, self.style, self.surface, self._w
        last = len(w) - 1
        ends = float(w[SIDE_START - 2]) + 0.01, float(w[last - SIDE_START]) + (0.03 if self.hatch else -0.1)
        low, over = _GLASS_LOW - CABIN_SIZES.surround_share, high + 0.02
        foot, head = (np.array([glass.place((end, t), ROW_AXES)[0][0] for end in ends]) for t in (low, over))

        def post(share: float, t: float, ahead: float = 0.0) -> tuple[float, float]:
            """Return a position on the window post at a share of the cabin's length, at height `t`, moved by `ahead`.

            The first and last posts slant like the windscreen and the rear window. The others are upright.
            """
            up = (t - low) / (over - low)
            slant = foot + up * (head - foot)
            x = foot[0] + share * (foot[1] - foot[0]) - 0.04 * up
            if share in (0.0, 1.0):
                x = slant[int(share)]
            return float(np.clip(x, slant[1], slant[0])) + ahead, t

        def pane(a: float, b: float, bottom: float, top: float, edge: float) -> list[tuple[float, float]]:
            return [post(a, bottom, -edge), post(b, bottom, edge), post(b, top, edge), post(a, top, -edge)]

        glass.paint(pane(0.0, style.glazed, low, over, 0.0), (X, T), "trim")
        edges = sorted([*style.panes, s.pillar, s.pillar])
        for first, second in zip(edges[::2], edges[1::2], strict=True):
            if second <= style.glazed + 1e-6:
                dark = style.tinted and first >= s.pillar - 1e-6
                material = "glass_tinted" if dark else "glass"
                glass.paint(pane(first, second, _GLASS_LOW, high, 0.028), (X, T), material)
        if style.chrome:
            glass.line([post(0.0, low), post(style.glazed, low)], (X, T), "chrome", width=0.03)
        if style.glazed < 1:
            glass.line([post(style.glazed, 0.0, -0.03), post(style.glazed, 1.0, -0.03)], (X, T), width=0.014)
        self.pillar_x = post(s.pillar, low)[0]

    def _draw_screen(self, start: float, end: float, low: float, high: float, material: str) -> None:
        """Draw a screen with its dark surround."""
        a, b = (start, end + CABIN_SIZES.surround_share) if start < 0 else (start - CABIN_SIZES.surround_share, end)
        self.surface.paint(
            rectangle_outline(a, b, low - CABIN_SIZES.surround_share, min(high + CABIN_SIZES.surround_share, 1.0)),
            ROW_AXES,
            "trim",
        )
        self.surface.paint(rectangle_outline(start, end, low, high), ROW_AXES, material)

    def _draw_pillar_lamp(self) -> None:
        """Draw a tail lamp on the pillar beside the rear window, as tall as a lamp below the window."""
        s, last = self.shape, len(self._w) - 1
        pane = self._rear_pane_w - CABIN_SIZES.surround_share
        outer = float(self._w[last - SIDE_START + 1])
        along = outer, max(min(outer + CABIN_SIZES.pillar_lamp_m, pane - 0.02), outer + 0.06)
        low = s.deck_height + 0.06
        under_roof = float(self.roof_edge(np.array([s.backlight_x + s.backlight_run])).item()) - 0.1
        up = low, min(low + s.taillight_high - s.taillight_low, under_roof)
        draw_taillight(self.surface, "pillar", along, up, self.points)

    def _draw_wipers(self, screen: float, rear: float, low: float, high: float) -> None:
        """Draw wipers, and the brake light behind the rear window."""
        glass, total = self.surface, float(self._w[-1])
        base = _GLASS_LOW - 0.035
        glass.line([(0.02, base), (screen - 0.2, base + 0.035)], ROW_AXES, width=0.02, layer=4)
        glass.line([(0.14, base), (screen - 0.1, base + 0.16)], ROW_AXES, width=0.017, layer=3)
        if self.hatch and self.style.glazed == 1:
            glass.line([(total - 0.02, low - 0.02), (rear + 0.22, low + 0.12)], ROW_AXES, width=0.022, layer=3)
        glass.draw(rectangle_outline(total - 0.14, total, high - 0.075, high - 0.035), ROW_AXES, "brake_light", layer=2)

    def _add_parts(self) -> None:
        s, style = self.shape, self.style
        front, rear = s.cowl_x - s.screen_run, s.backlight_x + s.backlight_run
        half = s.width / 2 - 0.03 - s.shoulder_inset - s.roof_inset
        if style.rails:
            xs = np.linspace(rear + 0.18, front - 0.3, 6)
            self.parts.append(parts.rail(np.column_stack([xs, np.full(6, half - 0.07), self.roof_edge(xs) + 0.032])))
        if style.spoiler:
            top = float(self.roof_edge(np.array([rear])).item()) + CABIN_SIZES.edge_rows[-1][2]
            self.parts.append(parts.spoiler(rear, top, half - 0.05, style.roof_tone or "paint"))
        if style.sign:
            tone = _ROOF_SIGNS[int(s.length * 1e4) % len(_ROOF_SIGNS)]
            self.parts.append(parts.roof_sign(front - 0.4 * (front - rear), s.height, tone))
        if style.load:
            self.parts.append(roof_load(style.load, front, rear, half, s.height, self.roof_edge))
        if style.antenna:
            x = np.array([rear + (0.22 if style.antenna == "fin" else 0.12)])
            top = float(self.surface.place((x.item(), 0.0), TOP_AXES, levels=(1.0, CENTER))[0][2])
            self.parts.append(antenna(style.antenna, x.item(), top, style.roof_tone or "paint"))
