"""Trucks: a cab over the engine, a frame with its axles, and a box, curtain, flatbed or tipper behind."""

from dataclasses import replace
from functools import cached_property

import numpy as np

from skope.gen.mesh import Mesh, box, merged, quads
from skope.gen.vehicles import front, parts
from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.cargo import CargoSpace
from skope.gen.vehicles.cargo_bodies import CARGO_BODIES
from skope.gen.vehicles.interior import interior
from skope.gen.vehicles.liveries import FRONT_MARKER, MARKED_FROM_M, draw_upper_markers
from skope.gen.vehicles.lofted_surfaces import SIDE, WRAP, Plan, Surface
from skope.gen.vehicles.long_hood import exhaust_stack, long_hood
from skope.gen.vehicles.lorry_parts import axle, cargo_body, side_guard, underrun_bar
from skope.gen.vehicles.mirrors import arm_mirror
from skope.gen.vehicles.panels import grown, rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.truck_faces import draw_face
from skope.gen.vehicles.upright_shells import ARCH_RADIUS_WHEELS, Tower, arch, corner_w
from skope.types import Array

_BODY_GAP_M = 0.09
"""Gap between cab and body, metres."""
_FRONT_LIP = 0.06
"""Share of the wall's height at which the front turns under: the lower edge of the bumper."""
_CREW_CAB = 2.5
"""Length above which a cab has a second row of seats, metres."""
_SCREEN = 1.45
"""Greatest height of a windscreen, metres."""
_GUARDED = 0.6
"""Least room between the axles that is worth a tank and guards, metres."""


class TruckBody:
    """The surfaces of a truck. `mesh` is the body without its four outer wheels; `points` the left keypoints."""

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        self.shape, self.style = shape, style
        self.points: dict[str, Array] = {}
        self.nose, self.end = shape.length / 2, -shape.length / 2
        self.face = self.nose - shape.hood_length
        """x of the cab's front: the vehicle's own, but for a long nose before it."""
        self.cab_rear = self.nose - shape.cab_length
        high_body = style.body in ("box", "curtain", "tractor")
        heavy = shape.wheel_radius > 0.45
        highest = 3.5 if style.body == "tractor" else 3.05 if heavy else 2.35
        self.cab_height = min(shape.height - (0.35 if high_body else 0.0), highest)
        if not high_body:
            self.cab_height = shape.height
        if style.cab_share:
            self.cab_height = style.cab_share * shape.height
        self._parts: list[Mesh] = []
        self._build_cab()
        self._build_frame()
        self._build_cargo()

    @cached_property
    def mesh(self) -> Mesh:
        left = merged(self._parts)
        return merged([left, left.mirrored()])

    @cached_property
    def interior(self) -> Mesh:
        s = self.shape
        return interior(
            cowl=self.face - 0.22,
            floor=s.belt_height - 0.42,
            belt=s.belt_height,
            roof=self.cab_height,
            half_width=s.width / 2 - 0.2,
            driver=self.face - 1.1,
            rows=1,
            ground=(self.cab_rear + 0.08, s.width / 2 - 0.1, s.belt_height - 0.44),
        )

    def _build_cab(self) -> None:
        s = self.shape
        plan = Plan(s.width / 2, self.face, self.cab_rear, s.nose_round, 0.0, 0.2, 0.06, 0.05, 0.0)
        belt = (s.belt_height - s.clearance) / (self.cab_height - s.clearance)
        lean = [
            (0.0, 0.03, 0.05, 0.0),
            (_FRONT_LIP, 0.0, 0.0, 0.0),
            (belt, 0.0, 0.035, 0.0),
            (1.0, s.roof_inset, 0.035 + s.screen_run, 0.02),
        ]
        well = s.track / 2 - s.wheel_width / 2 - 0.06
        tower = Tower(plan, s.clearance, self.cab_height, lean, edge=0.11, crown=0.04, well=well, stations=7, levels=5)
        if self.style.face:
            tower = replace(tower, ridge=0.5)
        cab, w, _ = tower.surface("paint")
        if not s.hood_length:
            lining, rim = cab.carve_well(arch(s.front_axle_x, s), well)
            self._parts += [lining, parts.arch_lip(rim, (s.front_axle_x, s.wheel_radius), "trim", cab.side)]
        base, top = s.belt_height - 0.02, self.cab_height - 0.24
        if self.style.face:
            # Under a high roof the windscreen ends where it would end under a low one.
            top = min(top, base + _SCREEN)
        if s.width > MARKED_FROM_M and self.cab_height - top > 0.2:
            z = self.cab_height - (0.3 if self.cab_height - top > 0.4 else 0.2)
            draw_upper_markers(cab, s.width / 2 - 0.1, z)
            if self.style.face:
                cab.draw(rectangle_outline(0.19, 0.31, z, z + 0.05), WRAP, FRONT_MARKER, layer=3)
        if self.style.body == "tractor":  # over the windscreen there is room for a bed
            top = min(top, base + 1.05)
        screen = corner_w(w) - 0.05
        cab.paint(rectangle_outline(-0.2, screen + 0.05, base - 0.05, top + 0.06), WRAP, "trim")
        cab.paint(rectangle_outline(-0.2, screen, base, top), WRAP, "glass")
        for start, stop in ((0.04, 0.55), (0.5, screen - 0.06)):
            cab.line([(start, base - 0.02), (stop, base + 0.06)], WRAP, width=0.02, layer=4)
        # Painted it also is clean from afar, where what hovers over the shell flickers.
        lay = cab.paint if self.style.face else cab.draw
        lay(rectangle_outline(-1, 99, 0, s.bumper_height - 0.1), WRAP, "trim")
        self._cab_doors(cab, base, top)
        if s.hood_length:
            self._parts += long_hood(s, self.style, self.points)
            self._parts += exhaust_stack(self.cab_rear - 0.16, s.width / 2 - 0.3, s.box_height, self.cab_height + 0.35)
        else:
            self._parts += front.draw_front(cab, w, s, self.style, self.points)
            draw_face(cab, self.style.face, (screen - 0.2, s.headlight_high + 0.1, base - 0.16), s)
        self._parts.append(cab.half)
        self._add_cab_parts(screen, base, top)
        self.points |= {
            "roof_front": cab.place((screen, top), WRAP)[0],
            "windscreen_base": cab.place((screen, base), WRAP)[0],
        }
        if not s.hood_length:
            self.points |= {
                "hood_front": cab.place((screen - 0.1, s.hood_height - 0.1), WRAP)[0],
                "bumper_front": cab.corner(_FRONT_LIP),
            }

    def _cab_doors(self, cab: Surface, base: float, top: float) -> None:
        """Side windows, gaps around the doors, handles, steps."""
        s = self.shape
        ahead, behind = self.face - 0.2, self.face - min(1.35, s.cab_length - 0.32)
        window = [
            (ahead - 0.12, base + 0.02), (behind + 0.06, base + 0.02),
            (behind + 0.06, top - 0.02), (ahead - 0.24, top - 0.02),
        ]  # fmt: skip
        cab.paint(grown(np.array(window), 0.035), SIDE, "trim", facing=LEFT_AXIS)
        cab.paint(window, SIDE, "glass", facing=LEFT_AXIS)
        if s.cab_length > _CREW_CAB:
            second = rectangle_outline(self.cab_rear + 0.25, behind - 0.1, base + 0.02, top - 0.02)
            cab.paint(grown(second, 0.035), SIDE, "trim", facing=LEFT_AXIS)
            cab.paint(second, SIDE, "glass", facing=LEFT_AXIS)
        sill = s.wheel_radius * (1 + ARCH_RADIUS_WHEELS) + 0.04
        for x in (ahead - 0.02, behind):
            cab.line([(x, sill), (x, top + 0.06)], SIDE, width=0.014, facing=LEFT_AXIS)
        cab.line([(ahead, sill), (behind, sill)], SIDE, width=0.014, facing=LEFT_AXIS)
        x, z = behind + 0.14, base - 0.16
        self._parts.append(parts.handle((x, cab.side(np.array([x, z])), z), "trim"))
        step = s.front_axle_x + ARCH_RADIUS_WHEELS * s.wheel_radius
        if self.face - step > 0.5:
            for z in (s.clearance + 0.18, s.clearance + 0.45):
                tread = rectangle_outline(step + 0.06, self.face - 0.22, z, z + 0.1)
                cab.draw(tread, SIDE, "gap", facing=LEFT_AXIS)
        self.points["beltline"] = cab.place((behind + 0.06, base), SIDE)[0]

    def _add_cab_parts(self, screen: float, base: float, top: float) -> None:
        """Mirrors, a visor over the windscreen, a deflector before a high body."""
        s = self.shape
        root = (self.face - 0.3, s.width / 2 - 0.03, base + 0.28)
        if self.style.arms:
            mirror, self.points["mirror"] = arm_mirror(root, "trim")
        else:
            mirror, self.points["mirror"] = parts.mirror(root, True, "trim")
        self._parts.append(mirror)
        edge = self.face - 0.035 - s.screen_run
        if s.wheel_radius > 0.45:
            low, high = (edge - 0.12, 0.0, top + 0.1), (edge + 0.12, s.width / 2 - 0.22, top + 0.14)
            self._parts.append(box(low, high, "gap"))
        over = s.height - self.cab_height
        if over > 0.25 and self.style.deflector:
            self._parts.append(
                parts.deflector(edge - 0.35, self.cab_rear + 0.1, s.width / 2 - 0.2, self.cab_height, over)
            )

    def _build_frame(self) -> None:
        """Rails, tank, guards, axles with all but the four outer wheels, and the rear bumper with its lamps."""
        s, style = self.shape, self.style
        low, high = s.box_height - (0.1 if style.skirts else 0.3), s.box_height + 0.01
        add = self._parts.append
        add(box((self.end + 0.06, 0.0, low), (self.cab_rear + 0.3, 0.45, high), "under"))
        steered = [s.front_axle_x - behind for behind in style.steered]
        axles = [s.rear_axle_x, *(s.rear_axle_x + ahead for ahead in style.axles)]
        for x in [*axles, *steered]:
            self._parts += axle(s, x, wheel=x != axles[0], dual=style.dual and x in axles)
        if not style.skirts:
            self._add_guards(axles, steered, low)
        self._parts += underrun_bar(s, replace(style, family="truck"), self.points)

    def _add_guards(self, axles: list[float], steered: list[float], low: float) -> None:
        """Tank and side guards between the axles, under rails at the height `low`."""
        s, add = self.shape, self._parts.append
        ahead = max(axles) + s.wheel_radius + 0.12
        start = min([s.front_axle_x, *steered]) - s.wheel_radius - 0.3
        start = min(start, self.cab_rear - 0.12)
        if start - ahead < _GUARDED:
            return
        side = s.width / 2 - 0.06
        tank = min(1.1, (start - ahead) * 0.45)
        add(_tank(start - tank, start, side - 0.3, low - 0.05))
        self._parts += side_guard(s, start - tank, ahead, side)

    def _build_cargo(self) -> None:
        body, ahead = self.style.body, self.cab_rear - _BODY_GAP_M
        if body == "tractor":
            self._build_fifth_wheel()
            return
        if body in CARGO_BODIES:
            cargo = CARGO_BODIES[body](CargoSpace(self.shape, self.style, ahead, self.end, self.cab_height))
            half, points = merged(cargo.parts), cargo.points
        else:
            half, points = cargo_body(self.shape, body, ahead)
        self._parts.append(half)
        self.points |= points

    def _build_fifth_wheel(self) -> None:
        """The plate that carries a semi-trailer, guards over the rear wheels, panels behind the cab, steps."""
        s, add = self.shape, self._parts.append
        x, z, frame = s.hinge_x, s.hinge_height, s.box_height
        add(box((x - 0.5, 0.0, z - 0.09), (x + 0.42, 0.46, z - 0.02), "under"))
        add(box((x - 0.25, 0.0, frame - 0.02), (x + 0.25, 0.42, z - 0.08), "under"))
        y, radius, top = s.track / 2, s.wheel_radius, 2 * s.wheel_radius + 0.03
        inner, outer = y - 0.42, y + 0.15
        add(box((s.rear_axle_x - 0.32, inner, top), (s.rear_axle_x + 0.32, outer, top + 0.03), "trim"))
        for sign in (-1, 1):
            start, stop = s.rear_axle_x + sign * 0.32, s.rear_axle_x + sign * (radius + 0.1)
            face = [(start, top + 0.03), (stop, top - 0.26), (stop, top - 0.29), (start, top)]
            add(_sheet(face[::-sign], inner, outer))
        side, behind = s.width / 2 - 0.03, self.cab_rear - 0.36
        low, high = s.clearance + 0.55, self.cab_height - 0.3
        if not s.hood_length:
            add(box((behind, side - 0.04, low), (self.cab_rear + 0.05, side, high), "paint"))
        add(box((behind - 0.45, 0.0, frame), (self.cab_rear - 0.02, 0.62, frame + 0.05), "rail"))


def _sheet(face: list[tuple[float, float]], inner: float, outer: float) -> Mesh:
    """A prism from y = `inner` to y = `outer` over a convex polygon (x, z), counter-clockwise seen from the right."""
    near, far = ([np.array([x, y, z]) for x, z in face] for y in (inner, outer))
    around = [[near[i], far[i], far[j], near[j]] for i, j in ((k, (k + 1) % len(face)) for k in range(len(face)))]
    return quads(np.array([near, far[::-1], *around]), "trim")


def _tank(rear: float, front: float, y: float, z: float) -> Mesh:
    """A fuel tank along the frame."""
    return parts.block((rear, y - 0.27, z - 0.27), (front, y + 0.27, z + 0.27), "chrome", 0.12)
