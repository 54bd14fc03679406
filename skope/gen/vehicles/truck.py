"""Trucks: a cab over the engine, a frame with its axles, and a box, curtain, flatbed or tipper behind."""

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from skope.gen.mesh import Mesh, box, merged
from skope.gen.vehicles import lamps, parts
from skope.gen.vehicles.interior import interior
from skope.gen.vehicles.loft import BOTTOM, ROWS, SIDE, WRAP, Plan, rounded
from skope.gen.vehicles.shape import Shape, Style
from skope.gen.vehicles.tower import Tower, corner_w
from skope.gen.vehicles.wheels import steel_wheel

Array = NDArray[np.float64]

_GAP = 0.09
"""Between cab and body, metres."""
_ARCH = 1.13


class TruckBody:
    """The surfaces of a truck. `mesh` is the body without its four outer wheels; `points` the left keypoints."""

    def __init__(self, shape: Shape, style: Style) -> None:
        self.shape, self.style = shape, style
        self.points: dict[str, Array] = {}
        self.front, self.end = shape.length / 2, -shape.length / 2
        self.cab_rear = self.front - shape.cab_length
        high_body = style.body in ("box", "curtain")
        heavy = shape.wheel_radius > 0.45
        self.cab_height = min(shape.height - (0.35 if high_body else 0.0), 3.05 if heavy else 2.35)
        if not high_body:
            self.cab_height = shape.height
        self._parts: list[Mesh] = []
        self._cab()
        self._frame()
        self._cargo()

    @cached_property
    def mesh(self) -> Mesh:
        left = merged(self._parts)
        return merged([left, left.mirrored()])

    @cached_property
    def interior(self) -> Mesh:
        s = self.shape
        return interior(
            cowl=self.front - 0.22,
            floor=s.belt_height - 0.42,
            belt=s.belt_height,
            roof=self.cab_height,
            half_width=s.width / 2 - 0.2,
            driver=self.front - 1.1,
            rows=1,
        )

    def _cab(self) -> None:
        s = self.shape
        plan = Plan(s.width / 2, self.front, self.cab_rear, s.nose_round, 0.0, 0.2, 0.06, 0.05, 0.0)
        height = self.cab_height - s.clearance
        belt = (s.belt_height - s.clearance) / height
        lean = [
            (0.0, 0.03, 0.05, 0.0),
            (0.06, 0.0, 0.0, 0.0),
            (belt, 0.0, 0.035, 0.0),
            (1.0, s.roof_inset, 0.035 + s.screen_run, 0.02),
        ]
        well = s.track / 2 - s.wheel_width / 2 - 0.06
        tower = Tower(plan, s.clearance, self.cab_height, lean, edge=0.11, crown=0.04, well=well)
        cab, w, outline = tower.surface("paint")
        corner = corner_w(w)
        screen = corner - 0.05
        top = self.cab_height - 0.24
        base = s.belt_height - 0.02
        cab.paint(
            [(-0.2, base - 0.05), (screen + 0.05, base - 0.05), (screen + 0.05, top + 0.06), (-0.2, top + 0.06)],
            WRAP,
            "trim",
        )
        pane = cab.paint([(-0.2, base), (screen, base), (screen, top), (-0.2, top)], WRAP, "glass")
        assert len(pane)
        door = self.front - 0.2, self.front - min(1.35, s.cab_length - 0.32)
        window = [
            (door[0] - 0.12, base + 0.02),
            (door[1] + 0.06, base + 0.02),
            (door[1] + 0.06, top - 0.02),
            (door[0] - 0.24, top - 0.02),
        ]
        cab.paint(_grown(window, 0.035), SIDE, "trim", facing=(0, 1, 0))
        cab.paint(window, SIDE, "glass", facing=(0, 1, 0))
        sill = s.wheel_radius * (1 + _ARCH) + 0.04
        cab.line([(door[0] - 0.02, sill), (door[0] - 0.02, top + 0.06)], SIDE, width=0.014, facing=(0, 1, 0))
        cab.line([(door[1], sill), (door[1], top + 0.06)], SIDE, width=0.014, facing=(0, 1, 0))
        cab.line([(door[0], sill), (door[1], sill)], SIDE, width=0.014, facing=(0, 1, 0))
        low = s.bumper_height
        cab.paint([(-1, 0), (99, 0), (99, low - 0.06), (-1, low - 0.06)], WRAP, "trim")
        lamps.draw_front(cab, w, s, self.style, self.points)
        reach = screen - 0.12
        z = s.headlight_high + 0.14
        while z < base - 0.2:
            cab.paint(rounded([(-reach, z), (reach, z), (reach, z + 0.05), (-reach, z + 0.05)], 0.02), WRAP, "grille")
            z += 0.085
        lining, rim = cab.carve_well(_arch(s.front_axle_x, s), well)
        self._parts += [cab.half, lining, parts.arch_lip(rim, (s.front_axle_x, s.wheel_radius), "trim")]
        y = float(np.interp(-(door[1] + 0.12), -outline[:, 0], outline[:, 1]))
        self._parts.append(parts.handle((door[1] + 0.14, y - 0.012, base - 0.16)))
        mirror, tip = parts.mirror((self.front - 0.27, s.width / 2 - 0.06, base + 0.3), True)
        self._parts.append(mirror)
        self.points |= {
            "mirror": tip,
            "roof_front": cab.nearest((screen, top), WRAP),
            "windscreen_base": cab.nearest((screen, base), WRAP),
            "hood_front": cab.nearest((screen - 0.1, s.hood_height - 0.1), WRAP),
            "bumper_front": cab.nearest((corner, BOTTOM), ROWS),
            "beltline": cab.nearest((door[1] + 0.06, base + 0.02), SIDE),
        }

    def _frame(self) -> None:
        """Rails, tank, guards, axles with all but the four outer wheels, and the rear bumper with its lamps."""
        s, style = self.shape, self.style
        low, high = s.box_height - 0.3, s.box_height + 0.01
        add = self._parts.append
        add(box((self.end + 0.06, 0.0, low), (self.cab_rear + 0.3, 0.45, high), "under"))
        wheel = steel_wheel(s.wheel_radius, s.wheel_width)
        y = s.track / 2
        axles = [s.rear_axle_x, *(s.rear_axle_x + ahead for ahead in style.axles)]
        for x in axles:
            add(box((x - 0.06, 0.0, s.wheel_radius - 0.06), (x + 0.06, y - 0.1, s.wheel_radius + 0.06), "under"))
            if x != axles[0]:
                add(wheel.moved((x, y, s.wheel_radius)))
            if style.dual:
                add(wheel.moved((x, y - s.wheel_width * 1.06, s.wheel_radius)))
            if s.box_height - 2 * s.wheel_radius > 0.1:
                add(
                    box(
                        (x - s.wheel_radius * 0.95, y - 0.36, 2 * s.wheel_radius + 0.04),
                        (x + s.wheel_radius * 0.95, y + 0.14, 2 * s.wheel_radius + 0.075),
                        "trim",
                    )
                )
        ahead = max(axles) + s.wheel_radius + 0.12
        start = s.front_axle_x - s.wheel_radius - 0.3
        start = min(start, self.cab_rear - 0.12)
        side = s.width / 2 - 0.06
        tank = min(1.1, (start - ahead) * 0.45)
        add(_tank(start - tank, start, side - 0.3, low - 0.05))
        for z in (s.clearance + 0.12, s.clearance + 0.42):
            add(box((ahead, side - 0.04, z), (start - tank - 0.1, side, z + 0.11), "rail"))
        for x in np.linspace(ahead + 0.1, start - tank - 0.2, 3):
            add(box((x - 0.03, side - 0.07, s.clearance + 0.12), (x + 0.03, side - 0.041, s.box_height), "under"))
        bar = Plan(s.width / 2 - 0.02, self.end + 0.16, self.end, 0.0, 0.0, 0.02, 0.02)
        shell, w, _ = Tower(
            bar, s.taillight_low - 0.06, s.taillight_high + 0.05, edge=0.012, crown=0.0, stations=3
        ).surface("trim")
        lamps.draw_rear(shell, w, s, style, self.points)
        add(shell.half)
        corner = corner_w(w, rear=True)
        self.points["bumper_rear"] = shell.nearest((corner, BOTTOM), ROWS)

    def _cargo(self) -> None:
        s, body = self.shape, self.style.body
        open_top = {"flatbed": s.box_height + 0.5, "tipper": s.box_height + 1.25}
        high = open_top.get(body, s.height)
        material = {"box": "box", "curtain": "tarpaulin", "tipper": "paint", "flatbed": "paint"}[body]
        front = self.cab_rear - _GAP
        plan = Plan(s.width / 2, front, self.end, 0.0, 0.0, 0.05, 0.035)
        tower = Tower(
            plan,
            s.box_height,
            high,
            [(0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.012)],
            edge=0.05 if body != "tipper" else 0.02,
            crown=0.015,
            hollow=s.box_height + 0.1 if body in open_top else None,
            stations=3,
        )
        shell, w, _ = tower.surface(material)
        end = float(w[-1])
        corner = float(w[-1]) - (s.width / 2)
        sill = s.box_height + 0.12
        inset = 0.11
        frame = "rail" if body in ("box", "curtain") else "trim"
        shell.paint([(-1, 0), (99, 0), (99, sill - 0.03), (-1, sill - 0.03)], WRAP, frame)
        low, top = sill, high - (0.16 if body in ("box", "curtain") else 0.12)
        edge = end - s.width / 2 + inset
        shell.line([(end + 0.1, low), (edge, low), (edge, top), (end + 0.1, top)], WRAP, width=0.02)
        if body in ("box", "curtain"):
            shell.line([(end, low), (end, top)], WRAP, width=0.016)
            for share in (0.28, 0.6):
                shell.paint(
                    [
                        (end - share - 0.012, low + 0.05),
                        (end - share + 0.012, low + 0.05),
                        (end - share + 0.012, top - 0.05),
                        (end - share - 0.012, top - 0.05),
                    ],
                    WRAP,
                    "rail",
                )
            for z in np.linspace(low + 0.3, top - 0.3, 4):
                shell.paint([(edge, z), (edge + 0.1, z), (edge + 0.1, z + 0.05), (edge, z + 0.05)], WRAP, "rail")
            shell.paint([(-1, high - 0.12), (99, high - 0.12), (99, high - 0.06), (-1, high - 0.06)], WRAP, frame)
        count = {"box": 6, "curtain": 9, "flatbed": 4, "tipper": 7}[body]
        ribs = np.linspace(front - 0.25, self.end + 0.25, count)
        wide = {"box": 0.014, "curtain": 0.03, "flatbed": 0.05, "tipper": 0.09}[body]
        for x in ribs:
            shell.paint(
                [(x - wide / 2, sill), (x + wide / 2, sill), (x + wide / 2, top + 0.04), (x - wide / 2, top + 0.04)],
                SIDE,
                "rail" if body != "tipper" else "trim",
                facing=(0, 1, 0),
            )
        shell.paint(
            [(-99, -9), (99, -9), (99, 9), (-99, 9)], (0, 1), "bed" if body in open_top else material, levels=(2.1, 3.0)
        )
        self._parts.append(shell.half)
        self.points |= {
            "roof_rear": shell.nearest((corner, high - tower.edge - (0 if body in open_top else tower.crown)), WRAP),
            "rear_window_base": shell.nearest((edge, top), WRAP),
            "trunk_rear": shell.nearest((corner, BOTTOM), ROWS),
        }


def _arch(axle: float, s: Shape) -> Array:
    angle = np.linspace(0, np.pi, 13)
    radius = _ARCH * s.wheel_radius
    arc = np.stack([axle + radius * np.cos(angle), s.wheel_radius + radius * np.sin(angle)], axis=-1)
    return np.array([(axle + radius, -0.2), *arc, (axle - radius, -0.2)])


def _grown(polygon: list[tuple[float, float]], edge: float) -> Array:
    p = np.array(polygon)
    return np.asarray(p + np.sign(p - p.mean(axis=0)) * edge)


def _tank(rear: float, front: float, y: float, z: float) -> Mesh:
    """A fuel tank along the frame."""
    return parts.block((rear, y - 0.27, z - 0.27), (front, y + 0.27, z + 0.27), "chrome", 0.12)
