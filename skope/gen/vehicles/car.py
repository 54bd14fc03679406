"""Passenger cars, vans and pickups: a lower body and a greenhouse, both lofts, with panels drawn on them."""

from dataclasses import fields
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.gen.mesh import Mesh, merged
from skope.gen.vehicles import lamps, parts
from skope.gen.vehicles.interior import interior
from skope.gen.vehicles.loft import (
    BOTTOM,
    CENTER,
    FLOOR,
    FRONT_END,
    INNER,
    ROWS,
    SHOULDER,
    SIDE,
    SIDE_START,
    TOP,
    WRAP,
    Plan,
    Surface,
    T,
    W,
    Z,
    along,
)
from skope.gen.vehicles.shape import Shape, Style

Array = NDArray[np.float64]

ARCH: Final = 1.13
"""Radius of a wheel arch over that of its wheel."""
_WELL: Final = 0.05
"""Room between a wheel's inner face and its well, metres."""
_PROFILE: Final = np.array(
    [  # row, share of the height, how far side, front and rear stand in, height over the shoulder
        [0.00, 0.00, 0.075, 0.110, 0.080, 0],
        [0.08, 0.08, 0.028, 0.035, 0.025, 0],
        [0.18, 0.18, 0.010, 0.006, 0.004, 0],
        [0.30, 0.30, 0.006, 0.000, 0.000, 0],
        [0.42, 0.42, 0.012, 0.012, 0.012, 0],
        [0.54, 0.54, 0.008, 0.030, 0.026, 0],
        [0.66, 0.66, 0.000, 0.036, 0.030, 0],
        [0.78, 0.78, 0.003, 0.050, 0.036, 0],
        [0.90, 0.90, 0.014, 0.076, 0.050, 0],
        [1.00, 1.00, 0.030, 0.105, 0.070, 0],
        [1.30, 1.00, 0.042, 0.132, 0.090, 0.013],
        [1.65, 1.00, 0.062, 0.165, 0.115, 0.023],
        [2.00, 1.00, 0.090, 0.205, 0.150, 0.029],
    ]
)
_RIM, _PIT, _MIDDLE = 2.1, 2.2, 2.6
"""Rows of the deck around a bed or the cabin."""
_GLASS_ROWS: Final = (0.0, 0.08, 0.3, 0.55, 0.8, 0.94, 1.0)
_ROOF_ROWS: Final = ((1.3, 0.016, 0.016), (1.65, 0.045, 0.030), (2.0, 0.09, 0.038))
_CROWN: Final = 0.035
_GLASS_LOW, _GLASS_HIGH = 0.1, 0.93
_SCREEN_HIGH: Final = 0.985


class CarBody:
    """The surfaces of a car. `mesh` is the body without wheels; `points` the left keypoints by stem, and the logo."""

    def __init__(self, shape: Shape, style: Style) -> None:
        self.shape, self.style = shape, style
        self.points: dict[str, Array] = {}
        self._parts: list[Mesh] = []
        self.well = shape.track / 2 - shape.wheel_width / 2 - _WELL
        self.end = -shape.length / 2
        self._lower = self._lower_shell()
        self._greenhouse = self._greenhouse_shell()
        self._draw_greenhouse()
        self._draw_lower()
        self._add_parts()

    @cached_property
    def mesh(self) -> Mesh:
        left = merged([self._lower.half, self._greenhouse.half, *self._parts])
        return merged([left, left.mirrored()])

    @cached_property
    def interior(self) -> Mesh:
        s = self.shape
        rows = 1 if self.style.bed or self.style.doors == 2 or self.style.glazed < 1 else 2
        return interior(
            cowl=s.cowl_x - 0.28,
            floor=self._pit_floor,
            belt=s.belt_height,
            roof=s.height,
            half_width=s.width / 2 - s.shoulder_inset - s.roof_inset - 0.08,
            driver=s.cowl_x - max(0.62 * s.screen_run, 0.3) - 0.55,
            rows=rows,
        )

    # -------------------------------------------------------------------------------------------------- lower body

    def shoulder(self, x: Array) -> Array:
        """Height of the shoulder: hood, belt and deck in one line."""
        s = self.shape
        knots = [self.end + 0.1, s.backlight_x - 0.05, s.backlight_x + 0.3, s.cowl_x - 0.35, s.cowl_x, s.length / 2]
        belt = s.belt_height + 0.02
        heights = [s.deck_height, belt if s.deck_length < 0.3 else (belt + s.deck_height) / 2, belt, s.belt_height]
        if self.style.bed:
            heights[:2] = [s.deck_height, s.deck_height]
        heights += [s.cowl_height, s.hood_height]
        spread = np.linspace(-0.12, 0.12, 5)
        smooth = [np.interp(x + d, knots, heights) for d in spread]
        line = np.mean(smooth, axis=0)
        # A hood falls more steeply towards its front edge.
        before = np.clip((x - s.cowl_x) / max(s.length / 2 - s.cowl_x, 0.1), 0, 1)
        return np.asarray(line + 0.16 * (s.cowl_height - s.hood_height) * np.sin(np.pi * before))

    @property
    def _pit_floor(self) -> float:
        return self.shape.belt_height - 0.38

    def _plan(self, side: float, front: float, rear: float) -> Plan:
        s = self.shape
        lean_front, lean_rear = s.nose_lean / 0.105, s.tail_lean / 0.07
        return Plan(
            half_width=s.width / 2 - side,
            front=s.length / 2 - front * lean_front,
            rear=self.end + rear * lean_rear,
            front_round=s.nose_round,
            rear_round=s.tail_round,
            front_radius=min(0.22, s.front_overhang - ARCH * s.wheel_radius - s.nose_round * 0.7),
            rear_radius=0.17,
            front_taper=0.05,
            rear_taper=0.045,
        )

    def _pits(self) -> list[tuple[float, float, float]]:
        """x from, to, and floor height of what is hollow in the deck: the cabin, a bed."""
        s = self.shape
        well = ARCH * s.wheel_radius + 0.04
        cabin = (max(s.backlight_x + 0.14, s.rear_axle_x + well), s.cowl_x - 0.28, self._pit_floor)
        if not self.style.bed:
            return [cabin]
        return [cabin, (self.end + 0.13, s.backlight_x - 0.08, max(s.deck_height - 0.5, s.wheel_radius + well))]

    def _lower_shell(self) -> Surface:
        s = self.shape
        top = self._plan(*_PROFILE[-1, 2:5])
        ends = top.outline(np.array([0.0, 1.0]))[[SIDE_START, -SIDE_START - 1], 0]
        xs = [s.front_axle_x, s.rear_axle_x] + [x for pit in self._pits() for x in (pit[0] - 0.004, pit[1] + 0.004)]
        xs += [x for pit in self._pits() for x in (pit[0] + 0.004, pit[1] - 0.004)]
        shares = (np.array(xs) - ends[0]) / (ends[1] - ends[0])
        stations = np.concatenate([np.linspace(0, 1, 15), shares[(shares > 0.01) & (shares < 0.99)]])
        stations = np.sort(stations)
        stations = stations[np.r_[True, np.diff(stations) > 0.001]]
        outlines = [self._plan(side, front, rear).outline(stations) for _, _, side, front, rear, _ in _PROFILE]
        bottom = outlines[0]
        lift = 0.05 * np.clip((np.abs(bottom[:, 0]) - 0.7 * s.length / 2) / (0.3 * s.length / 2), 0, 1)
        low = s.clearance + lift
        rows = [np.column_stack([bottom[:, 0], y, low]) for y in (0 * low, np.minimum(bottom[:, 1], self.well))]
        for (_, share, *_, over), outline in zip(_PROFILE, outlines, strict=True):
            high = self.shoulder(outline[:, 0])
            rows.append(np.column_stack([outline, low + (high - low) * share + over]))
        deck = rows[-1]
        inside = np.zeros(len(deck))
        floor = np.zeros(len(deck))
        for start, end, height in self._pits():
            within = (deck[:, 0] > start) & (deck[:, 0] < end)
            inside[within], floor[within] = 1, height
        for level, inset, share in ((_RIM, 0.012, 1.0), (_PIT, 0.022, 1.0), (_MIDDLE, 0.022, 0.55), (CENTER, 0, 0.0)):
            y = np.maximum(deck[:, 1] - inset, 0) * share
            bow = 1 - (y / np.maximum(deck[:, 1], 1e-9)) ** 2
            z = deck[:, 2] + _CROWN * bow * (deck[:, 1] / deck[:, 1].max()) ** 1.5
            z = np.where((inside > 0) & (level >= _PIT), floor, z)
            rows.append(np.column_stack([deck[:, 0], y, z]))
        levels = [FLOOR, INNER, *_PROFILE[:, 0], _RIM, _PIT, _MIDDLE, CENTER]
        self.w = along(outlines[4])
        self.outline = outlines[4]
        return Surface(rows, levels, self.w, "paint")

    def w_of(self, x: float) -> float:
        """W of a place on the side."""
        return float(np.interp(-x, -self.outline[SIDE_START:-SIDE_START, 0], self.w[SIDE_START:-SIDE_START]))

    def _draw_lower(self) -> None:
        s, lower, style = self.shape, self._lower, self.style
        everything = (FLOOR, BOTTOM)
        # Wells first: cut through panels, their rims would have many more edges.
        for axle in (s.front_axle_x, s.rear_axle_x):
            self._carve(axle)
        lower.paint([(-9, -9), (9, -9), (9, 9), (-9, 9)], TOP, "under", levels=everything)
        trim = s.bumper_height - 0.02 if style.cladding else s.clearance + 0.1
        lower.paint([(-1, 0), (99, 0), (99, trim), (-1, trim)], WRAP, "trim")
        ahead, behind = self.w_of(s.front_axle_x), self.w_of(s.rear_axle_x)
        for start, end in ((-1.0, ahead), (behind, 99.0)):
            lower.paint([(start, 0), (end, 0), (end, trim + 0.05), (start, trim + 0.05)], WRAP, "trim")
        hollows = [(s.backlight_x + 0.1, s.cowl_x - 0.2, "dashboard")]
        hollows += [(start - 0.02, end + 0.02, "bed") for start, end, _ in self._pits()[1:]]
        for start, end, material in hollows:
            lower.paint([(start, -9), (end, -9), (end, 9), (start, 9)], TOP, material, levels=(_RIM, CENTER))
        if style.cladding:
            self._clad()
        self._draw_doors()
        self._draw_hood()
        lamps.draw_front(lower, self.w, s, style, self.points)
        lamps.draw_rear(lower, self.w, s, style, self.points)
        corner, last = SIDE_START - 4, len(self.w) - 1
        self.points |= {
            "bumper_front": lower.nearest((self.w[corner], BOTTOM), (W, T)),
            "bumper_rear": lower.nearest((self.w[last - corner], BOTTOM), (W, T)),
            "hood_front": lower.nearest((self.w[corner], SHOULDER), (W, T)),
            "trunk_rear": lower.nearest((self.w[last - corner], SHOULDER), (W, T)),
            "beltline": lower.nearest((self.pillar_x, s.belt_height + 0.01, SHOULDER), (0, Z, T)),
        }

    def _carve(self, axle: float) -> None:
        s = self.shape
        radius = ARCH * s.wheel_radius
        angle = np.linspace(0, np.pi, 15)
        arc = np.stack([axle + radius * np.cos(angle), s.wheel_radius + radius * np.sin(angle)], axis=-1)
        polygon = [(axle + radius, -0.2), *arc, (axle - radius, -0.2)]
        lining, rim = self._lower.carve_well(polygon, self.well)
        material = "trim" if self.style.cladding else "paint"
        self._parts += [lining, parts.arch_lip(rim, (axle, s.wheel_radius), material)]

    def _clad(self) -> None:
        """Dark rings around the wheel arches."""
        s = self.shape
        wide = ARCH * s.wheel_radius + 0.065
        angle = np.linspace(0, np.pi, 8)
        for axle in (s.front_axle_x, s.rear_axle_x):
            ring = np.stack([axle + wide * np.cos(angle), s.wheel_radius + wide * np.sin(angle)], axis=-1)
            self._lower.paint([(axle + wide, -0.2), *ring, (axle - wide, -0.2)], SIDE, "trim")

    def _draw_doors(self) -> None:
        """Gaps around the doors, a crease's shadow along the sill, handles."""
        s, style, lower = self.shape, self.style, self._lower
        reach = ARCH * s.wheel_radius
        low = s.clearance + 0.13
        front = min(s.front_axle_x - reach - 0.1, s.cowl_x - 0.12)
        pillar = self.pillar_x
        last = s.rear_axle_x + reach * 0.55 if style.doors == 4 else pillar
        top = s.belt_height + 0.1
        lower.line([(front - 0.02, low), (front, low + 0.25), (front - 0.06, top)], SIDE)
        lower.line([(pillar, low), (pillar, top)], SIDE)
        shut = s.rear_axle_x + reach + 0.05
        if style.doors == 4:
            lower.line([(shut, low), (shut, s.wheel_radius + 0.1), (last, s.wheel_radius + reach), (last, top)], SIDE)
            if style.sliding:
                lower.line([(pillar, s.belt_height - 0.16), (self.end + 0.4, s.belt_height - 0.14)], SIDE, width=0.02)
        lower.line([(front - 0.02, low), (max(shut, last) if style.doors == 4 else pillar, low)], SIDE)
        flap = np.array([s.rear_axle_x - 0.12, s.belt_height - 0.2])
        square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
        lower.paint(flap + square * [0.085, 0.075], SIDE, "gap")
        lower.paint(flap + square * [0.079, 0.069], SIDE, "paint")
        height = s.belt_height - 0.14
        for x in (pillar + 0.17, *([last + 0.2] if style.doors == 4 else [])):
            at = lower.nearest((x, height), (0, Z))
            y = float(np.interp(-x, -self.outline[:, 0], self.outline[:, 1]))
            self._parts.append(parts.handle((x, max(y, at[1]) - 0.012, height)))

    def _draw_hood(self) -> None:
        """Gaps around the hood and the trunk or tailgate."""
        s, lower = self.shape, self._lower
        y = s.width / 2 - 0.155
        front = s.length / 2 - s.nose_round - s.nose_lean - 0.2
        top = (SHOULDER, CENTER)
        lower.line([(s.cowl_x - 0.1, y), (front, y - 0.06)], TOP, levels=top, width=0.012)
        edge = s.hood_height - 0.03
        lower.line([(-0.1, edge + 0.01), (self.w[SIDE_START - 5], edge)], WRAP, width=0.012)
        if s.deck_length > 0.3 and not self.style.bed:
            rear = self.end + s.tail_round + s.tail_lean + 0.1
            lower.line([(s.backlight_x, y + 0.02), (rear, y - 0.01)], TOP, levels=top, width=0.012)
        end = float(self.w[-1])
        side = end - s.taillight_inner + (0.02 if s.deck_length > 0.3 else -0.16)
        low = s.taillight_low - 0.16 if s.deck_length > 0.3 or self.style.bed else s.clearance + 0.27
        lower.line([(side, s.deck_height + 0.03), (side + 0.01, low), (end + 0.1, low)], WRAP, width=0.011)

    # -------------------------------------------------------------------------------------------------- greenhouse

    @property
    def pillar_x(self) -> float:
        """x of the B-pillar at the belt."""
        s = self.shape
        return s.cowl_x - 0.2 + (s.backlight_x + 0.1 - s.cowl_x + 0.2) * s.pillar

    def _glass_plan(self, t: float) -> Plan:
        """The greenhouse's section at a share of its height."""
        s = self.shape
        half = s.width / 2 - 0.03 - s.shoulder_inset
        bow = 0.15 if s.width < 1.95 else 0.12
        base = Plan(half, s.cowl_x, s.backlight_x, bow, 0.07, 0.15, 0.15, 0.05, 0.05)
        roof = Plan(
            *(half - s.roof_inset, s.cowl_x - s.screen_run, s.backlight_x + s.backlight_run),
            *(0.07, 0.05, 0.15, 0.15, 0.025, 0.035),
        )
        share, bulge = min(t, 1.0), 4 * min(t, 1.0) * (1 - min(t, 1.0))
        values = {f.name: (1 - share) * getattr(base, f.name) + share * getattr(roof, f.name) for f in fields(Plan)}
        values["half_width"] += 0.022 * bulge
        values["front"] += 0.03 * bulge
        values["rear"] -= 0.03 * bulge
        return Plan(**values)

    def _roof_edge(self, x: Array) -> Array:
        s = self.shape
        front, rear = s.cowl_x - s.screen_run, s.backlight_x + s.backlight_run
        middle = front + 0.38 * (rear - front)
        away = np.where(x > middle, (x - middle) / (front - middle), (x - middle) / (rear - middle))
        return np.asarray(s.height - _ROOF_ROWS[-1][2] - _CROWN - s.roof_droop * np.minimum(np.abs(away), 1.1) ** 2)

    def _greenhouse_shell(self) -> Surface:
        stations = np.linspace(0, 1, 9)
        base, roof = (self._glass_plan(t).outline(stations) for t in (0.0, 1.0))
        low, high = self.shoulder(base[:, 0]) - 0.02, self._roof_edge(roof[:, 0])
        rows = [np.column_stack([self._glass_plan(t).outline(stations), low + (high - low) * t]) for t in _GLASS_ROWS]
        top = self._glass_plan(1.0)
        for _, inset, over in _ROOF_ROWS:
            plan = Plan(
                *(top.half_width - inset, top.front - inset * 1.6, top.rear + inset * 1.6),
                *(top.front_round, top.rear_round, 0.15, 0.15, top.front_taper, top.rear_taper),
            )
            outline = plan.outline(stations)
            rows.append(np.column_stack([outline, high + over]))
        edge = rows[-1]
        for share in (0.66, 0.33, 0.0):
            bow = (1 - share**2) * (edge[:, 1] / edge[:, 1].max()) ** 1.5
            rows.append(edge * [1, share, 1] + np.stack([0 * bow, 0 * bow, _CROWN * bow], axis=-1))
        levels = [*_GLASS_ROWS, *(row[0] for row in _ROOF_ROWS), 2.3, 2.6, CENTER]
        self._glass_w = along(self._glass_plan(0.5).outline(stations))
        return Surface(rows, levels, self._glass_w, "paint")

    def _draw_greenhouse(self) -> None:
        s, style, glass, w = self.shape, self.style, self._greenhouse, self._glass_w
        last = len(w) - 1
        screen = float(w[FRONT_END + 2]) + 0.02
        # Under a high roof the panes end where they would end under a low one.
        room = s.height - s.belt_height
        side_high, screen_high = min(_GLASS_HIGH, 0.82 / room), min(_SCREEN_HIGH, 1.14 / room)
        self._pane(-0.2, screen, _GLASS_LOW - 0.02, screen_high, "glass")
        start, end = float(w[SIDE_START - 2]) + 0.01, float(w[last - SIDE_START + 2]) - 0.03
        if s.deck_length < 0.3:
            end = float(w[last - SIDE_START]) + 0.03
        span = end - start
        glazed = start + span * style.glazed
        lift = 0.0 if style.glazed < 1 else 0.035
        band = [
            (start, _GLASS_LOW - 0.03),
            (glazed, _GLASS_LOW - 0.03 + lift),
            (glazed, side_high + 0.02),
            (start, side_high + 0.02),
        ]
        glass.paint(band, ROWS, "trim")
        edges = sorted([*style.panes, s.pillar, s.pillar])
        for first, second in zip(edges[::2], edges[1::2], strict=True):
            a, b = start + span * first + 0.028, start + span * second - 0.028
            if second <= style.glazed + 1e-6:
                dark = style.tinted and first >= s.pillar - 1e-6
                base = _GLASS_LOW + 0.03 * np.array([first, second])
                corners = [(a, base[0]), (b, base[1]), (b, side_high), (a, side_high)]
                glass.paint(corners, ROWS, "glass_tinted" if dark else "glass")
        total = float(w[-1])
        rear = total - float(w[last - FRONT_END - 1]) - (0.0 if s.deck_length > 0.3 else 0.02)
        low = _GLASS_LOW if s.deck_length > 0.3 or style.bed else 0.14
        high = 0.95 if s.deck_length > 0.3 else 0.9
        if style.glazed < 1:
            low, high, rear = 0.3, 0.84, rear - 0.08
        self._pane(total - rear, total + 0.2, low, high, "glass_tinted" if style.tinted else "glass")
        self.points |= {
            "roof_front": glass.nearest((screen, screen_high), ROWS),
            "windscreen_base": glass.nearest((screen, _GLASS_LOW - 0.02), ROWS),
            "roof_rear": glass.nearest((total - rear, high), ROWS),
            "rear_window_base": glass.nearest((total - rear, low), ROWS),
        }
        if style.glazed < 1:
            split = start + span * style.glazed
            glass.line([(split + 0.02, 0.02), (split + 0.02, 0.98)], ROWS, width=0.014)
            glass.line([(total - 0.004, -0.1), (total - 0.004, high)], ROWS, width=0.014)

    def _pane(self, start: float, end: float, low: float, high: float, material: str) -> None:
        """A screen with its dark surround."""
        edge = 0.03
        a, b = (start, end) if start < 0 else (start - edge, end)
        b = b + edge if start < 0 else b
        surround = [(a, low - edge), (b, low - edge), (b, min(high + edge, 1.0)), (a, min(high + edge, 1.0))]
        self._greenhouse.paint(surround, ROWS, "trim")
        self._greenhouse.paint([(start, low), (end, low), (end, high), (start, high)], ROWS, material)

    # ------------------------------------------------------------------------------------------------------- parts

    def _add_parts(self) -> None:
        s, style = self.shape, self.style
        x = s.cowl_x - 0.3
        y = float(np.interp(-x, -self.outline[:, 0], self.outline[:, 1]))
        tall = s.width > 1.95 and s.height > 2
        mirror, tip = parts.mirror((x, y, s.belt_height + (0.16 if tall else 0.09)), tall)
        self._parts.append(mirror)
        self.points["mirror"] = tip
        if style.rails:
            front, rear = s.cowl_x - s.screen_run - 0.35, s.backlight_x + s.backlight_run + 0.25
            xs = np.linspace(rear, front, 7)
            width = s.width / 2 - 0.03 - s.shoulder_inset - s.roof_inset - 0.075
            self._parts.append(parts.rail(np.column_stack([xs, np.full(7, width), self._roof_edge(xs) + 0.03])))
