"""Passenger cars, vans and pickups: a lower body and a greenhouse, both lofts, with panels drawn on them."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, merged
from skope.gen.vehicles import front, parts, rear
from skope.gen.vehicles.cabin import Greenhouse, canopy
from skope.gen.vehicles.interior import interior
from skope.gen.vehicles.lofted_surfaces import (
    BOTTOM,
    CENTER,
    FLOOR,
    INNER,
    ROW_AXES,
    SHOULDER,
    SIDE_AXES,
    SIDE_START,
    TOP_AXES,
    WRAP_AXES,
    Plan,
    Surface,
    metres_along,
)
from skope.gen.vehicles.panels import draw_decal, rectangle_outline
from skope.gen.vehicles.parts import arm_mirror
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import SOLID_SIZES
from skope.gen.vehicles.triangle_cuts import clipped, rear_wall
from skope.types import Array


@dataclass(frozen=True)
class CarSizes:
    """Sizes of cars."""

    arch_trim_m: float = 0.07
    """Width of the trim around a wheel arch, metres."""
    well_gap_m: float = 0.05
    """Gap between a wheel's inner face and its well, metres."""
    trim_top_row: float = 0.25
    """Upper row of cladding and low dark bumpers."""
    crown_m: float = 0.035
    """Height of the hood's middle above its edge, metres."""
    cab_end_m: float = 0.06
    """Length of a cab behind its rear window, metres, if the rest of the body is missing."""


CAR_SIZES: Final = CarSizes()

_SILL, _LEDGE = 0.16, 0.40
"""Rows of the sill's edge, and of the bumpers' upper edge."""
BODY_PROFILE: Final = np.array(
    [  # row, share of the height, insets of side, front and rear, height above the shoulder
        [0.00, 0.00, 0.090, 0.110, 0.085, 0],
        [0.07, 0.07, 0.036, 0.040, 0.030, 0],
        [0.16, 0.16, 0.010, 0.008, 0.006, 0],
        [0.25, 0.25, 0.024, 0.000, 0.000, 0],
        [0.40, 0.40, 0.026, 0.004, 0.000, 0],
        [0.44, 0.44, 0.025, 0.024, 0.034, 0],
        [0.62, 0.62, 0.016, 0.030, 0.036, 0],
        [0.79, 0.79, 0.000, 0.044, 0.040, 0],
        [0.88, 0.88, 0.017, 0.066, 0.052, 0],
        [1.00, 1.00, 0.034, 0.105, 0.075, 0],
        [1.40, 1.00, 0.050, 0.140, 0.098, 0.016],
        [2.00, 1.00, 0.092, 0.205, 0.150, 0.029],
    ]
)
SOFT_SIDE: Final = np.array([0, 0, 0, -0.012, -0.018, -0.02, -0.014, 0.006, -0.004, 0, 0, 0])
"""Extra inset of the side of a body without a shoulder line, added to `BODY_PROFILE`, metres."""
_DECK_RIM_ROWS, _PIT, _OUTER, _INNER = 2.1, 2.2, 2.4, 2.6
"""Rows of the deck around a bed or the cabin, and of the hood's creases."""


class CarBody:
    """Surfaces of a car. `mesh` is the body without wheels; `points` the left keypoints by stem, and the logo."""

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        self.shape, self.style = shape, style
        self.points: dict[str, Array] = {}
        self._parts: list[Mesh] = []
        self.well = shape.track / 2 - shape.wheel_width / 2 - CAR_SIZES.well_gap_m
        self.end = -shape.length / 2
        self._lower = self._lower_shell()
        self._greenhouse = Greenhouse(shape, style, self.deck)
        self._draw_lower()
        self._add_parts()
        self.points |= self._greenhouse.points
        if style.canopy:
            hardtop, corners = canopy(shape)
            self._parts.append(hardtop)
            self.points |= corners

    @cached_property
    def mesh(self) -> Mesh:
        left = merged([self._lower.half, self._greenhouse.surface.half, *self._greenhouse.parts, *self._parts])
        return merged([left, left.mirrored()])

    def front_half(self) -> Mesh:
        """Return the left half of the cab alone, closed at its rear."""
        behind = self.shape.backlight_x - CAR_SIZES.cab_end_m
        shell = clipped(self._lower.half, behind)
        house = self._greenhouse
        parts_ahead = [clipped(part, behind) for part in self._parts]
        return merged([shell, rear_wall(shell, behind, "paint"), *parts_ahead, house.surface.half, *house.parts])

    def hood_half(self, behind: float) -> Mesh:
        """Return the left half of the body ahead of x = `behind` below the windows; open there."""
        return merged([clipped(part, behind) for part in (self._lower.half, *self._parts[:-1])])

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

    # -------------------------------------------------------------------------------------------------------- shell

    def shoulder(self, x: Array) -> Array:
        """Return the height of the body's upper edge in side view: hood, window line and rear deck, metres."""
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
        # A hood slopes more steeply towards its front edge.
        before = np.clip((x - s.cowl_x) / max(s.length / 2 - s.cowl_x, 0.1), 0, 1)
        return np.asarray(line + 0.16 * (s.cowl_height - s.hood_height) * np.sin(np.pi * before))

    def deck(self, x: Array, y: Array) -> Array:
        """Return the height, metres, of the body's upper surface without windows and roof, at positions x and y."""
        edge = self._deck_edge
        half, z = (np.interp(-x, -edge[:, 0], edge[:, k]) for k in (1, 2))
        return np.asarray(z + self._deck_rise(x, half, np.clip(y / np.maximum(half, 1e-9), 0, 1)))

    def _deck_rise(self, x: Array, half: Array, share: Array) -> Array:
        """Return the height of the deck above its edges at a share of its half width: its crown and the hood's dome."""
        s = self.shape
        crown = CAR_SIZES.crown_m * (1 - share**2) * (half / self._deck_edge[:, 1].max()) ** 1.5
        ahead = np.clip((x - s.cowl_x + 0.1) / 0.25, 0, 1) * np.clip((s.length / 2 - s.nose_round - x) / 0.3, 0, 1)
        outer = self._crease(x)
        return np.asarray(crown + self.style.dome * ahead * np.clip((outer - share) / 0.11, 0, 1))

    def _crease(self, x: Array) -> Array:
        """Return the share of the deck's half width where the hood's crease runs; it runs towards the middle ahead."""
        s = self.shape
        before = np.clip((x - s.cowl_x) / max(s.length / 2 - s.cowl_x, 0.1), 0, 1)
        return np.asarray(0.84 - 0.2 * before)

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
            front_radius=min(
                0.22, s.front_overhang - SOLID_SIZES.arch_radius_wheels * s.wheel_radius - s.nose_round * 0.7
            ),
            rear_radius=0.17,
            front_taper=0.05,
            rear_taper=0.045,
        )

    def _pits(self) -> list[tuple[float, float, float]]:
        """Return x from, x to, and floor height of each hollow in the deck: the cabin and a bed."""
        s = self.shape
        well = SOLID_SIZES.arch_radius_wheels * s.wheel_radius + 0.04
        cabin = (max(s.backlight_x + 0.14, s.rear_axle_x + well), s.cowl_x - 0.28, self._pit_floor)
        if not self.style.bed:
            return [cabin]
        return [cabin, (self.end + 0.13, s.backlight_x - 0.08, max(s.deck_height - 0.5, s.wheel_radius + well))]

    def _stations(self) -> Array:
        """Return the positions of columns as shares of the side.

        They are around the wheels, at the pits' ends, and evenly between.
        """
        s = self.shape
        top = self._plan(*BODY_PROFILE[-1, 2:5])
        ends = top.outline(np.array([0.0, 1.0]))[[SIDE_START, -SIDE_START - 1], 0]
        reach = SOLID_SIZES.arch_radius_wheels * s.wheel_radius
        fixed = [x + d for pit in self._pits() for x in pit[:2] for d in (-0.004, 0.004)]
        free = [axle + k * reach for axle in (s.front_axle_x, s.rear_axle_x) for k in (-1.35, -0.8, 0, 0.8, 1.35)]
        free += list(np.linspace(s.rear_axle_x + 2.4 * reach, s.front_axle_x - 2.2 * reach, 3))
        chosen = list(fixed)
        for x in free:
            if ends[1] + 0.05 < x < ends[0] - 0.05 and min(abs(x - station) for station in chosen) > 0.05:
                chosen.append(x)
        shares = (np.array(sorted(chosen, reverse=True)) - ends[0]) / (ends[1] - ends[0])
        return np.concatenate([[0.0], shares[(shares > 0.01) & (shares < 0.99)], [1.0]])

    def _lower_shell(self) -> Surface:
        s, stations = self.shape, self._stations()
        sides = BODY_PROFILE[:, 2] + (SOFT_SIDE if self.style.soft else 0)
        # An arch projects from the body's side up to the shoulder line.
        outlines = [
            self._plan(side, *row[3:5]).outline(stations) for side, row in zip(sides, BODY_PROFILE, strict=True)
        ]
        for outline, side, row in zip(outlines, sides, BODY_PROFILE, strict=True):
            if 0.07 < row[0] < 0.7:
                outline[:, 1] += 0.9 * side * self._near_wheels(outline[:, 0]) * (outline[:, 1] > s.width / 4)
        bottom = outlines[0]
        lift = 0.05 * np.clip((np.abs(bottom[:, 0]) - 0.7 * s.length / 2) / (0.3 * s.length / 2), 0, 1)
        low = s.clearance + lift
        rows = [np.column_stack([bottom[:, 0], y, low]) for y in (0 * low, np.minimum(bottom[:, 1], self.well))]
        for row, outline in zip(BODY_PROFILE, outlines, strict=True):
            high = self.shoulder(outline[:, 0])
            rows.append(np.column_stack([outline, low + (high - low) * row[1] + row[5]]))
        self._deck_edge = rows[-1]
        rows += self._deck_rows()
        levels = [FLOOR, INNER, *BODY_PROFILE[:, 0], _DECK_RIM_ROWS, _PIT, _OUTER, _INNER, CENTER]
        self.outline = outlines[6]
        self.w = metres_along(self.outline)
        creases = {_SILL, _LEDGE, _OUTER, _INNER} | (set() if self.style.soft else {0.79})
        return Surface(rows, levels, self.w, "paint", creases=creases)

    def _near_wheels(self, x: Array) -> Array:
        s = self.shape
        reach = 1.3 * SOLID_SIZES.arch_radius_wheels * s.wheel_radius
        away = np.min([np.abs(x - axle) for axle in (s.front_axle_x, s.rear_axle_x)], axis=0) / reach
        return np.asarray(np.exp(-(away**4)))

    def _deck_rows(self) -> list[Array]:
        deck = self._deck_edge
        inside, floor = np.zeros(len(deck)), np.zeros(len(deck))
        for start, end, height in self._pits():
            within = (deck[:, 0] > start) & (deck[:, 0] < end)
            inside[within], floor[within] = 1, height
        crease = self._crease(deck[:, 0])
        levels = (
            (_DECK_RIM_ROWS, 0.012, 1.0), (_PIT, 0.022, 1.0), (_OUTER, 0, crease), (_INNER, 0, crease - 0.11),
            (CENTER, 0, 0.0),
        )  # fmt: skip
        rows = []
        for level, inset, share in levels:
            y = np.maximum(deck[:, 1] - inset, 0) * share
            z = deck[:, 2] + self._deck_rise(deck[:, 0], deck[:, 1], y / np.maximum(deck[:, 1], 1e-9))
            rows.append(np.column_stack([deck[:, 0], y, np.where((inside > 0) & (level >= _PIT), floor, z)]))
        return rows

    def w_of(self, x: float) -> float:
        """Return the distance from the start of the shell's outline, along it, to position x on the side, metres."""
        return float(np.interp(-x, -self.outline[SIDE_START:-SIDE_START, 0], self.w[SIDE_START:-SIDE_START]))

    def side_y(self, x: float) -> float:
        """Return y of the body's side at its middle height."""
        return float(np.interp(-x, -self.outline[:, 0], self.outline[:, 1]))

    # ------------------------------------------------------------------------------------------------------- panels

    def _draw_lower(self) -> None:
        s, lower, style = self.shape, self._lower, self.style
        # Wells first: if they cut through panels, their rims would have many more edges.
        for axle in (s.front_axle_x, s.rear_axle_x):
            self._carve_wheel_well(axle)
        lower.paint([(-9, -9), (9, -9), (9, 9), (-9, 9)], TOP_AXES, "under", levels=(FLOOR, BOTTOM))
        trim = CAR_SIZES.trim_top_row if style.cladding else 0.07
        if style.sill != "paint":
            lower.paint([(-1, -0.1), (99, -0.1), (99, trim), (-1, trim)], ROW_AXES, "trim")
        self._draw_tones()
        cabin = self._greenhouse.foot(0.03)
        lower.paint(
            np.vstack([cabin, [(cabin[-1, 0], -1), (cabin[0, 0], -1)]]),
            TOP_AXES,
            "dashboard",
            levels=(_DECK_RIM_ROWS, CENTER),
        )
        for (start, end, _), material, top in zip(self._pits(), ("dashboard", "bed"), (_PIT, CENTER), strict=False):
            ends = start - 0.02, end + 0.02
            hollow = [(ends[0], -9), (ends[1], -9), (ends[1], 9), (ends[0], 9)]
            lower.paint(hollow, TOP_AXES, material, levels=(_DECK_RIM_ROWS, top))
        self._draw_livery()
        draw_decal(lower, s, style)
        self._draw_doors()
        self._parts += front.draw_front(lower, self.w, s, style, self.points)
        self._parts += rear.draw_rear(lower, self.w, s, style, self.points)
        # Panels that are drawn before a sink would float above it.
        self._draw_hood()
        self.points |= {
            "bumper_front": lower.corner(_SILL),
            "bumper_rear": lower.corner(_SILL, rear=True),
            "hood_front": lower.corner(SHOULDER),
            "trunk_rear": lower.corner(SHOULDER, rear=True),
            "beltline": lower.place((self.w_of(self._greenhouse.pillar_x), SHOULDER), ROW_AXES)[0],
        }

    def _draw_tones(self) -> None:
        """Draw dark and bright lower parts: the bumpers and the sills' edge."""
        s, lower, style = self.shape, self._lower, self.style
        reach = SOLID_SIZES.arch_radius_wheels * s.wheel_radius
        ahead, behind = self.w_of(s.front_axle_x + reach), self.w_of(s.rear_axle_x - reach)
        if style.bumper:
            top = _LEDGE if style.bumper == "black" else CAR_SIZES.trim_top_row
            for start, stop in ((-1.0, ahead), (behind, 99.0)):
                lower.paint(rectangle_outline(start, stop, -0.1, top), ROW_AXES, "trim")
        if style.sill == "chrome":
            ends = self.w_of(s.front_axle_x - reach - 0.05), self.w_of(s.rear_axle_x + reach + 0.05)
            lower.line([(ends[0], _SILL), (ends[1], _SILL)], ROW_AXES, "chrome", width=0.03)

    def _carve_wheel_well(self, axle: float) -> None:
        s = self.shape
        radius = SOLID_SIZES.arch_radius_wheels * s.wheel_radius
        angle = np.linspace(0, np.pi, 12)
        arc = np.stack([axle + radius * np.cos(angle), s.wheel_radius + radius * np.sin(angle)], axis=-1)
        polygon = [(axle + radius, -0.2), *arc, (axle - radius, -0.2)]
        lining, rim = self._lower.carve_well(polygon, self.well)
        self._parts.append(lining)
        dark = self.style.cladding
        if self.style.soft_seams:
            # From 12 m away, a projecting lip would be a white arc in front of the dark well.
            if dark:
                self._draw_arch_trim(np.array([(axle + radius, 0.0), *arc, (axle - radius, 0.0)]), axle)
            return
        around, material = (axle, s.wheel_radius), "trim" if dark else "paint"
        lip = parts.arch_lip(rim, around, material, self._lower.side, 0.08 if dark else 0.034)
        self._parts.append(lip)

    def _draw_arch_trim(self, edge: Array, axle: float) -> None:
        """Draw dark trim on the body around a wheel arch with its edge through points (N, 2), x and z."""
        away = edge - [axle, self.shape.wheel_radius]
        away[:, 1] = np.maximum(away[:, 1], 0)
        away /= np.linalg.norm(away, axis=1, keepdims=True)
        inner, outer = edge - 0.01 * away, edge + CAR_SIZES.arch_trim_m * away
        for k in range(len(edge) - 1):
            self._lower.draw([inner[k], outer[k], outer[k + 1], inner[k + 1]], SIDE_AXES, "trim", layer=1.5)

    def _draw_livery(self) -> None:
        """Draw a stripe along the sides of vehicles that are not private."""
        s = self.shape
        low, high = {"taxi": (0.34, 0.24), "van": (0.46, 0.26)}.get(self.style.palette, (0.0, 0.0))
        ahead, behind = s.front_axle_x - SOLID_SIZES.arch_radius_wheels * s.wheel_radius - 0.12, self.end + 0.35
        if self.style.palette == "van":
            sweep = [(behind + 0.9, s.clearance + 0.2), (behind + 0.5, s.belt_height), (behind, s.belt_height)]
            self._lower.draw([(behind, s.clearance + 0.2), *sweep], SIDE_AXES, "livery", layer=0.5)
            behind += 0.55
        if low > 0:
            stripe = rectangle_outline(behind, ahead, s.belt_height - low, s.belt_height - high)
            self._lower.draw(stripe, SIDE_AXES, "livery", layer=0.5)

    def _seam(
        self,
        points: ArrayLike,
        projection: tuple[int, int],
        *,
        width: float = 0.009,
        levels: tuple[float, float] = (BOTTOM, SHOULDER),
    ) -> None:
        """Draw a gap between panels through points (N, 2) of a projection."""
        soft = self.style.soft_seams
        material, wide = ("seam", width + 0.008) if soft else ("gap", width)
        self._lower.line(points, projection, material, width=wide, levels=levels)

    def _draw_doors(self) -> None:
        """Draw gaps around the doors, the fuel flap, and handles."""
        s, style, lower = self.shape, self.style, self._lower
        reach = SOLID_SIZES.arch_radius_wheels * s.wheel_radius
        # A soft gap is pale on dark trim, so it ends above the trim.
        dark = style.soft_seams and style.cladding
        low = s.clearance + (CAR_SIZES.trim_top_row * (s.belt_height - s.clearance) + 0.03 if dark else 0.13)
        ahead = min(s.front_axle_x - reach - 0.1, s.cowl_x - 0.12)
        pillar = self._greenhouse.pillar_x
        last = s.rear_axle_x + reach * 0.55 if style.doors == 4 else pillar
        top = s.belt_height + 0.1
        shut = s.rear_axle_x + reach + 0.05
        self._seam([(ahead - 0.02, low), (ahead, low + 0.25), (ahead - 0.06, top)], SIDE_AXES)
        self._seam([(pillar, low), (pillar, top)], SIDE_AXES)
        if style.doors == 4:
            self._seam(
                [(shut, low), (shut, s.wheel_radius + 0.1), (last, s.wheel_radius + reach), (last, top)], SIDE_AXES
            )
            if style.sliding:
                lower.line(
                    [(pillar, s.belt_height - 0.16), (self.end + 0.4, s.belt_height - 0.14)], SIDE_AXES, width=0.02
                )
        self._seam([(ahead - 0.02, low), (max(shut, last) if style.doors == 4 else pillar, low)], SIDE_AXES)
        flap = np.array([s.rear_axle_x - 0.12, s.belt_height - 0.2])
        square = flap + 0.075 * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)])
        self._seam(square, SIDE_AXES, width=0.006)
        height = s.belt_height - 0.13
        for x in (pillar + 0.19, *([last + 0.22] if style.doors == 4 else [])):
            cup = np.array([(-0.06, -0.025), (0.06, -0.025), (0.06, 0.025), (-0.06, 0.025)])
            lower.draw(np.add([x, height], cup), SIDE_AXES, "gap")
            y = float(lower.place((x, height), SIDE_AXES)[0][1])
            self._parts.append(parts.handle((x, y, height), "chrome" if style.chrome else "paint"))

    def _draw_hood(self) -> None:
        """Draw gaps around the hood, along the bumpers, and around the trunk or tailgate."""
        s, w = self.shape, self.w
        y = s.width / 2 - 0.135
        ahead = s.length / 2 - s.nose_round - s.nose_lean - 0.12
        top = (SHOULDER, CENTER)
        self._seam([(s.cowl_x - 0.12, y), (ahead, y - 0.07)], TOP_AXES, levels=top, width=0.011)
        edge = s.hood_height - 0.012
        self._seam([(-0.1, edge), (float(w[SIDE_START - 3]), edge)], WRAP_AXES, width=0.011)
        arch = self.w_of(s.front_axle_x + SOLID_SIZES.arch_radius_wheels * s.wheel_radius)
        seam = (s.headlight_low + s.headlight_high) / 2 - 0.05
        self._seam([(arch, seam - 0.12), (float(w[SIDE_START - 2]), seam)], WRAP_AXES)
        end = float(w[-1])
        behind = self.w_of(s.rear_axle_x - SOLID_SIZES.arch_radius_wheels * s.wheel_radius)
        low = s.taillight_low - 0.03
        self._seam([(behind, low - 0.12), (end - s.taillight_inner - 0.2, low - 0.02)], WRAP_AXES)
        if s.deck_length > 0.3 and not self.style.bed:
            back = self.end + s.tail_round + s.tail_lean + 0.1
            self._seam([(s.backlight_x, y + 0.01), (back, y - 0.03)], TOP_AXES, levels=top, width=0.011)
        trunk = s.deck_length > 0.3
        side = end - s.taillight_inner + (0.02 if trunk else -0.16)
        low = s.taillight_low - 0.16 if trunk or self.style.bed else s.clearance + 0.3
        self._seam([(side, s.deck_height + 0.03), (side + 0.01, low), (end + 0.1, low)], WRAP_AXES, width=0.011)

    def _add_parts(self) -> None:
        s = self.shape
        tall = s.width > 1.95 and s.height > 2
        x = s.cowl_x - (0.3 if tall else 0.36)
        z = s.belt_height + (0.06 if tall else 0.035)
        y = self.side_y(x) - s.shoulder_inset - 0.03
        material = self.style.mirror or ("trim" if tall or self.style.cladding else "paint")
        if self.style.arms:
            beside = s.width / 2 * (1 / self.style.cab_width - 1)
            mirror, tip = arm_mirror((x, y, z), material, reach=0.26 + beside, high=0.24 * s.width, upright=False)
        else:
            mirror, tip = parts.mirror((x, y, z), tall, material)
        self._parts.append(mirror)
        self.points["mirror"] = tip
