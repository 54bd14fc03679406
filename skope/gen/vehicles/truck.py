"""Trucks: a cab above the engine or behind a long hood, a frame with its axles, and a cargo body.

The body is a box, curtain, flatbed, tipper or one of `CARGO_BODIES`. Some lorries have the front of a car or van.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box, merged, quads, tube
from skope.gen.vehicles import front, parts
from skope.gen.vehicles.car import CarBody
from skope.gen.vehicles.closed_bodies import box_body, curtain_body, living_body, luton_body, mixer_body, tank_body
from skope.gen.vehicles.flatbeds import crane_body, dropside_body, flatbed_body
from skope.gen.vehicles.interior import interior
from skope.gen.vehicles.lofted_surfaces import BOTTOM, SIDE_AXES, WRAP_AXES, Plan, Surface
from skope.gen.vehicles.lorry_parts import Cargo, CargoSpace, axle, cargo_body, side_guard, underrun_bar
from skope.gen.vehicles.panels import (
    FRONT_MARKER,
    PANEL_LIMITS,
    Points,
    draw_upper_markers,
    grown,
    mirrored,
    rectangle_outline,
)
from skope.gen.vehicles.parts import arm_mirror
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import SOLID_SIZES, Tower, arch, corner_w
from skope.gen.vehicles.work_bodies import fire_body, hook_body, recovery_body, refuse_body, skip_body
from skope.types import Array

_FACE_KINDS: Final = ("", "slots", "mask", "shield", "ladder")
"""Kinds of faces; "" is one large grille."""


def draw_face(cab: Surface, kind: str, extent: tuple[float, float, float], s: Shape) -> None:
    """Draw the grille and trim on the front of a cab.

    Args:
        cab: The cab's shell.
        kind: One of `VehicleStyle.face`.
        extent: Half its width, its lower and its upper edge, metres.
        s: The vehicle's shape, which selects a face if the kind is "any".
    """
    half, low, high = extent
    if kind == "any":
        kind = _FACE_KINDS[int(s.length * 1e4) % len(_FACE_KINDS)]
    tall = high - low
    if kind == "slots":
        for k in range(3):
            base = low + (0.08 + 0.31 * k) * tall
            slot = rectangle_outline(-half + 0.06 * (2 - k), half - 0.06 * (2 - k), base, base + 0.2 * tall)
            cab.sink(slot, WRAP_AXES, 0.03, "grille_mesh", wall="gap")
    elif kind == "mask":
        cab.paint(rectangle_outline(-half - 0.1, half + 0.1, low - 0.04, high + 0.06), WRAP_AXES, "trim")
        cab.sink(mirrored([(0.62 * half, low + 0.05), (0.8 * half, low + 0.6 * tall)]), WRAP_AXES, 0.03, "grille_mesh")
        cab.draw(rectangle_outline(-half, half, high - 0.1, high - 0.07), WRAP_AXES, "chrome", layer=2)
    elif kind == "shield":
        outline = mirrored([(0.42 * half, low), (0.62 * half, low + 0.35 * tall), (0.55 * half, high)])
        cab.paint(grown(outline, 0.025), WRAP_AXES, "chrome")
        cab.sink(outline, WRAP_AXES, 0.03, "grille_bars", wall="gap")
    elif kind == "ladder":
        cab.paint(rectangle_outline(-half, half, low + 0.5 * tall, high), WRAP_AXES, "trim")
        for k in range(3):
            base = low + (0.54 + 0.15 * k) * tall
            cab.draw(rectangle_outline(-half + 0.03, half - 0.03, base, base + 0.06 * tall), WRAP_AXES, "rail", layer=2)
        cab.line([(-0.1, low + 0.42 * tall), (half, low + 0.42 * tall)], WRAP_AXES, width=0.014)
    else:
        grille = rectangle_outline(-half, half, low, high)
        cab.paint(grown(grille, 0.02), WRAP_AXES, "trim")
        cab.sink(grille, WRAP_AXES, 0.025, "grille_slats", wall="gap")


@dataclass(frozen=True)
class TruckSizes:
    """Sizes of trucks."""

    behind_bumper_m: float = 0.14
    """Distance of the grille behind the bumper's face, metres."""
    fender_share: float = 0.6
    """Share of the hood's height at which the fenders end and the hood becomes narrower."""
    body_gap_m: float = 0.09
    """Gap between cab and body, metres."""
    front_lip: float = 0.06
    """Share of the wall's height at which the front turns under: the lower edge of the bumper."""
    crew_cab_m: float = 2.5
    """Minimum length of a cab with a second row of seats, metres."""
    screen_height_m: float = 1.45
    """Maximum height of a windscreen, metres."""
    guarded_from_m: float = 0.6
    """Minimum distance between axles with a tank and guards, metres."""


TRUCK_SIZES: Final = TruckSizes()


def long_hood(s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Return the left half of a hood from the vehicle's front back to its cab; record the front's keypoints."""
    nose = s.length / 2
    half, top = s.width / 2 - 0.04, s.hood_height
    plan = Plan(half, nose - TRUCK_SIZES.behind_bumper_m, nose - s.hood_length - 0.06, 0.1, 0.0, 0.22, 0.04)
    lean = [
        (0.0, 0.03, 0.05, 0.0),
        (0.08, 0.0, 0.0, 0.0),
        (TRUCK_SIZES.fender_share, 0.02, 0.02, 0.0),
        (TRUCK_SIZES.fender_share + 0.07, 0.3, 0.05, 0.0),
        (1.0, 0.4, 0.16, 0.0),
    ]
    well = s.track / 2 - s.wheel_width / 2 - 0.06
    tower = Tower(plan, s.clearance, top, lean, edge=0.1, crown=0.05, well=well, stations=9, levels=4)
    hood, w, _ = tower.surface("paint")
    lining, rim = hood.carve_well(arch(s.front_axle_x, s), well)
    out = [lining, parts.arch_lip(rim, (s.front_axle_x, s.wheel_radius), "paint", hood.side)]
    out += front.draw_front(hood, w, s, style, points)
    grille = rectangle_outline(-0.44, 0.44, s.headlight_high + 0.04, top - 0.24)
    hood.paint(grown(grille, 0.04), WRAP_AXES, "chrome")
    hood.sink(grille, WRAP_AXES, 0.03, "grille_bars", wall="gap")
    points["hood_front"] = hood.place((0.56, top - 0.16), WRAP_AXES)[0]
    out.append(hood.half)
    bar = Plan(s.width / 2 - 0.01, nose, nose - 0.34, 0.07, 0.0, 0.12, 0.03)
    low, high = s.clearance + 0.02, s.headlight_low - 0.06
    bumper, _, _ = Tower(bar, low, high, edge=0.02, crown=0.0, stations=3).surface("chrome")
    out.append(bumper.half)
    points["bumper_front"] = bumper.corner(BOTTOM)
    return out


def exhaust_stack(x: float, y: float, low: float, high: float) -> list[Mesh]:
    """Return the upright chromed pipe behind the left side of a cab, with its muffler."""
    pipe = [np.array([x, y, z]) for z in (low, high)]
    muffler = [np.array([x, y, z]) for z in (low + 0.5, low + 1.4)]
    return [
        tube(pipe, [0.06, 0.06], "chrome", 10),
        tube(muffler, [0.11, 0.11], "chrome", 12),
        box((x - 0.11, y - 0.11, low - 0.05), (x + 0.11, y + 0.11, low + 0.5), "chrome"),
        box((x - 0.1, y - 0.1, low + 1.4), (x + 0.1, y + 0.1, low + 1.41), "chrome"),
        box((x - 0.05, y - 0.05, high - 0.02), (x + 0.05, y + 0.05, high - 0.01), "gap"),
    ]


CARGO_BODIES: Final[Mapping[str, Callable[[CargoSpace], Cargo]]] = {
    "panels": box_body,
    "sliding": curtain_body,
    "luton": luton_body,
    "living": living_body,
    "tank": tank_body,
    "mixer": mixer_body,
    "refuse": refuse_body,
    "hook": hook_body,
    "skip": skip_body,
    "fire": fire_body,
    "recovery": recovery_body,
    "platform": flatbed_body,
    "crane": crane_body,
    "dropside": dropside_body,
}


class TruckBody:
    """Surfaces of a truck. `mesh` is the body without its four outer wheels; `points` the left keypoints."""

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        self.shape, self.style = shape, style
        self.points: dict[str, Array] = {}
        self.nose, self.end = shape.length / 2, -shape.length / 2
        self.face = self.nose - shape.hood_length
        """x of the cab's front: the vehicle's front, unless there is a long nose."""
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
            (TRUCK_SIZES.front_lip, 0.0, 0.0, 0.0),
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
            # Under a high roof, the windscreen ends at the same height as under a low roof.
            top = min(top, base + TRUCK_SIZES.screen_height_m)
        if s.width > PANEL_LIMITS.marked_from_m and self.cab_height - top > 0.2:
            z = self.cab_height - (0.3 if self.cab_height - top > 0.4 else 0.2)
            draw_upper_markers(cab, s.width / 2 - 0.1, z)
            if self.style.face:
                cab.draw(rectangle_outline(0.19, 0.31, z, z + 0.05), WRAP_AXES, FRONT_MARKER, layer=3)
        if self.style.body == "tractor":  # space for a bed above the windscreen
            top = min(top, base + 1.05)
        screen = corner_w(w) - 0.05
        cab.paint(rectangle_outline(-0.2, screen + 0.05, base - 0.05, top + 0.06), WRAP_AXES, "trim")
        cab.paint(rectangle_outline(-0.2, screen, base, top), WRAP_AXES, "glass")
        for start, stop in ((0.04, 0.55), (0.5, screen - 0.06)):
            cab.line([(start, base - 0.02), (stop, base + 0.06)], WRAP_AXES, width=0.02, layer=4)
        # Painted panels are also clean in distant views, in which panels that float above the shell flicker.
        lay = cab.paint if self.style.face else cab.draw
        lay(rectangle_outline(-1, 99, 0, s.bumper_height - 0.1), WRAP_AXES, "trim")
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
            "roof_front": cab.place((screen, top), WRAP_AXES)[0],
            "windscreen_base": cab.place((screen, base), WRAP_AXES)[0],
        }
        if not s.hood_length:
            self.points |= {
                "hood_front": cab.place((screen - 0.1, s.hood_height - 0.1), WRAP_AXES)[0],
                "bumper_front": cab.corner(TRUCK_SIZES.front_lip),
            }

    def _cab_doors(self, cab: Surface, base: float, top: float) -> None:
        """Draw side windows, gaps around the doors, handles and steps."""
        s = self.shape
        ahead, behind = self.face - 0.2, self.face - min(1.35, s.cab_length - 0.32)
        window = [
            (ahead - 0.12, base + 0.02), (behind + 0.06, base + 0.02),
            (behind + 0.06, top - 0.02), (ahead - 0.24, top - 0.02),
        ]  # fmt: skip
        cab.paint(grown(np.array(window), 0.035), SIDE_AXES, "trim", facing=PANEL_LIMITS.left_axis)
        cab.paint(window, SIDE_AXES, "glass", facing=PANEL_LIMITS.left_axis)
        if s.cab_length > TRUCK_SIZES.crew_cab_m:
            second = rectangle_outline(self.cab_rear + 0.25, behind - 0.1, base + 0.02, top - 0.02)
            cab.paint(grown(second, 0.035), SIDE_AXES, "trim", facing=PANEL_LIMITS.left_axis)
            cab.paint(second, SIDE_AXES, "glass", facing=PANEL_LIMITS.left_axis)
        sill = s.wheel_radius * (1 + SOLID_SIZES.arch_radius_wheels) + 0.04
        for x in (ahead - 0.02, behind):
            cab.line([(x, sill), (x, top + 0.06)], SIDE_AXES, width=0.014, facing=PANEL_LIMITS.left_axis)
        cab.line([(ahead, sill), (behind, sill)], SIDE_AXES, width=0.014, facing=PANEL_LIMITS.left_axis)
        x, z = behind + 0.14, base - 0.16
        self._parts.append(parts.handle((x, cab.side(np.array([x, z])), z), "trim"))
        step = s.front_axle_x + SOLID_SIZES.arch_radius_wheels * s.wheel_radius
        if self.face - step > 0.5:
            for z in (s.clearance + 0.18, s.clearance + 0.45):
                tread = rectangle_outline(step + 0.06, self.face - 0.22, z, z + 0.1)
                cab.draw(tread, SIDE_AXES, "gap", facing=PANEL_LIMITS.left_axis)
        self.points["beltline"] = cab.place((behind + 0.06, base), SIDE_AXES)[0]

    def _add_cab_parts(self, screen: float, base: float, top: float) -> None:
        """Add mirrors, a visor above the windscreen, and a deflector before a high body."""
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
        """Build rails, tank, guards, axles with their inner wheels, and the rear bumper with its lamps."""
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
        """Add tank and side guards between the axles, under rails at the height `low`."""
        s, add = self.shape, self._parts.append
        ahead = max(axles) + s.wheel_radius + 0.12
        start = min([s.front_axle_x, *steered]) - s.wheel_radius - 0.3
        start = min(start, self.cab_rear - 0.12)
        if start - ahead < TRUCK_SIZES.guarded_from_m:
            return
        side = s.width / 2 - 0.06
        tank = min(1.1, (start - ahead) * 0.45)
        add(_tank(start - tank, start, side - 0.3, low - 0.05))
        self._parts += side_guard(s, start - tank, ahead, side)

    def _build_cargo(self) -> None:
        body, ahead = self.style.body, self.cab_rear - TRUCK_SIZES.body_gap_m
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
        """Build the plate of a semi-trailer, guards over the rear wheels, panels behind the cab, and steps."""
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
    """Return a prism from y = `inner` to y = `outer` over a convex polygon (x, z).

    The polygon is counter-clockwise seen from the right.
    """
    near, far = ([np.array([x, y, z]) for x, z in face] for y in (inner, outer))
    around = [[near[i], far[i], far[j], near[j]] for i, j in ((k, (k + 1) % len(face)) for k in range(len(face)))]
    return quads(np.array([near, far[::-1], *around]), "trim")


def _tank(rear: float, front: float, y: float, z: float) -> Mesh:
    """Return a fuel tank along the frame."""
    return parts.block((rear, y - 0.27, z - 0.27), (front, y + 0.27, z + 0.27), "chrome", 0.12)


_REAR_POINTS: Final = frozenset(
    ("taillight_outer", "taillight_inner", "bumper_rear", "trunk_rear", "roof_rear", "rear_window_base")
)
"""Keypoints of the cargo body and the frame, which the cab does not have."""


class ChassisCabBody(TruckBody):
    """Truck with the front of a car or van.

    The front is `shape.cab_length` long and narrower than the cargo body behind it.
    """

    @cached_property
    def interior(self) -> Mesh:
        return self._car.interior

    def _build_cab(self) -> None:
        s = self.shape
        cab_shape = replace(
            s, width=s.width * self.style.cab_width, height=self.cab_height, deck_length=s.length - s.cab_length
        )
        self._car = CarBody(cab_shape, replace(self.style, family="car", bed=True, palette="freight"))
        self._parts.append(self._car.front_half())
        self.points |= {name: point for name, point in self._car.points.items() if name not in _REAR_POINTS}
