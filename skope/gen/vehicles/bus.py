"""City buses: one upright shell with large windows, doors on the right, a destination sign."""

from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from skope.gen.mesh import Mesh, merged
from skope.gen.vehicles import lamps, parts
from skope.gen.vehicles.interior import interior
from skope.gen.vehicles.loft import BOTTOM, ROWS, SIDE, WRAP, Plan, Surface
from skope.gen.vehicles.shape import Shape, Style
from skope.gen.vehicles.tower import Tower, corner_w

Array = NDArray[np.float64]

_ARCH = 1.15


class BusBody:
    """The surfaces of a bus. `mesh` is the body without wheels; `points` the left keypoints by stem."""

    def __init__(self, shape: Shape, style: Style) -> None:
        self.shape, self.style = shape, style
        self.points: dict[str, Array] = {}
        self.front, self.end = shape.length / 2, -shape.length / 2
        self._right = self._half(doors=True)
        self._left = self._half(doors=False)

    @cached_property
    def mesh(self) -> Mesh:
        return merged([self._left, self._right.mirrored()])

    @cached_property
    def interior(self) -> Mesh:
        s = self.shape
        return interior(
            cowl=self.front - 0.3,
            floor=s.belt_height - 0.3,
            belt=s.belt_height,
            roof=s.height,
            half_width=s.width / 2 - 0.3,
            driver=self.front - 1.25,
            rows=5,
        )

    def _half(self, *, doors: bool) -> Mesh:
        s = self.shape
        plan = Plan(s.width / 2, self.front, self.end, s.nose_round, s.tail_round, 0.26, 0.2, 0.03, 0.02)
        belt = (s.belt_height - s.clearance) / (s.height - s.clearance)
        lean = [
            (0.0, 0.03, 0.06, 0.05),
            (0.07, 0.0, 0.0, 0.0),
            (belt, 0.0, 0.02, 0.01),
            (1.0, s.roof_inset, 0.02 + s.screen_run, 0.05),
        ]
        well = s.track / 2 - s.wheel_width / 2 - 0.06
        tower = Tower(plan, s.clearance, s.height, lean, edge=0.16, crown=0.05, well=well, stations=17)
        shell, w, _ = tower.surface("paint")
        self._draw(shell, w, doors)
        out: list[Mesh] = []
        for axle in (s.front_axle_x, s.rear_axle_x):
            lining, rim = shell.carve_well(_arch(axle, s), well)
            out += [lining, parts.arch_lip(rim, (axle, s.wheel_radius), "trim")]
        mirror, tip = parts.mirror((self.front - 0.24, s.width / 2 - 0.1, 1.95), True)
        self.points["mirror"] = tip
        return merged([shell.half, mirror, *out])

    def _draw(self, shell: Surface, w: Array, doors: bool) -> None:
        """Windows, doors, signs and lamps."""
        s = self.shape
        low, high = s.belt_height, s.height - 0.5
        corner, rear = corner_w(w), corner_w(w, rear=True)
        end = float(w[-1])
        trim = s.clearance + 0.14
        shell.paint([(-1, 0), (end + 1, 0), (end + 1, trim), (-1, trim)], WRAP, "trim")
        shell.paint(
            [
                (0, s.belt_height - 0.22),
                (end, s.belt_height - 0.22),
                (end, s.belt_height - 0.14),
                (0, s.belt_height - 0.14),
            ],
            WRAP,
            "box",
            facing=(0, 1, 0),
        )
        screen = corner - 0.02
        band = s.height - 0.3
        shell.paint(
            [(-0.1, low - 0.13), (screen + 0.06, low - 0.13), (screen + 0.06, band), (-0.1, band)], WRAP, "trim"
        )
        shell.paint(
            [(-0.1, low - 0.08), (screen, low - 0.08), (screen, high - 0.02), (-0.1, high - 0.02)], WRAP, "glass"
        )
        shell.paint(
            [(-0.1, high + 0.04), (0.75, high + 0.04), (0.75, band - 0.04), (-0.1, band - 0.04)], WRAP, "grille"
        )
        for at in (0.05, 0.2, 0.29, 0.42, 0.55):
            shell.paint(
                [(at, high + 0.075), (at + 0.075, high + 0.075), (at + 0.075, band - 0.075), (at, band - 0.075)],
                WRAP,
                "display",
            )
        start, stop = self.front - 0.62, self.end + 0.5
        shell.paint(
            [
                (stop - 0.06, low - 0.05),
                (start + 0.06, low - 0.05),
                (start + 0.06, high + 0.05),
                (stop - 0.06, high + 0.05),
            ],
            SIDE,
            "trim",
            facing=(0, 1, 0),
        )
        posts = np.linspace(stop, start, round((start - stop) / 1.45) + 1)
        for a, b in pairwise(posts):
            pane = [(a + 0.03, low), (b - 0.03, low), (b - 0.03, high), (a + 0.03, high)]
            shell.paint(pane, SIDE, "glass", facing=(0, 1, 0))
        if doors:
            middle = (s.front_axle_x + s.rear_axle_x) / 2
            for at in (
                s.front_axle_x + s.wheel_radius * _ARCH + 0.85,
                middle,
                *([s.rear_axle_x - 1.6] if s.length > 11 else []),
            ):
                self._door(shell, at, 1.15)
        lamps.draw_front(shell, w, s, self.style, self.points)
        lamps.draw_rear(shell, w, s, self.style, self.points)
        glass = end - rear + (-0.12)
        shell.paint(
            [
                (end - glass - 0.05, low + 0.45),
                (end + 0.1, low + 0.45),
                (end + 0.1, high + 0.06),
                (end - glass - 0.05, high + 0.06),
            ],
            WRAP,
            "trim",
        )
        shell.paint(
            [(end - glass, low + 0.5), (end + 0.1, low + 0.5), (end + 0.1, high), (end - glass, high)], WRAP, "glass"
        )
        for k in range(5):
            z = s.clearance + 0.42 + 0.075 * k
            shell.paint(
                [(end - 0.75, z), (end - 0.32, z), (end - 0.32, z + 0.035), (end - 0.75, z + 0.035)], WRAP, "grille"
            )
        self.points |= {
            "roof_front": shell.nearest((screen + 0.06, band), WRAP),
            "windscreen_base": shell.nearest((screen, low - 0.08), WRAP),
            "roof_rear": shell.nearest((end - glass, high), WRAP),
            "rear_window_base": shell.nearest((end - glass, low + 0.5), WRAP),
            "hood_front": shell.nearest((screen - 0.12, low - 0.13), WRAP),
            "trunk_rear": shell.nearest((rear, low - 0.05), WRAP),
            "bumper_front": shell.nearest((corner, BOTTOM), ROWS),
            "bumper_rear": shell.nearest((rear, BOTTOM), ROWS),
            "beltline": shell.nearest((posts[np.abs(posts - (start + stop) / 2).argmin()] + 0.03, low - 0.05), SIDE),
        }

    def _door(self, shell: Surface, x: float, width: float) -> None:
        """A double-leaf glass door."""
        s = self.shape
        low, high = s.clearance + 0.1, s.height - 0.45
        half = width / 2
        facing = (0.0, 1.0, 0.0)
        shell.paint([(x - half, low), (x + half, low), (x + half, high), (x - half, high)], SIDE, "trim", facing=facing)
        for a, b in ((x - half + 0.05, x - 0.03), (x + 0.03, x + half - 0.05)):
            shell.paint(
                [(a, low + 0.1), (b, low + 0.1), (b, high - 0.08), (a, high - 0.08)], SIDE, "glass", facing=facing
            )


def _arch(axle: float, s: Shape) -> Array:
    angle = np.linspace(0, np.pi, 13)
    radius = _ARCH * s.wheel_radius
    arc = np.stack([axle + radius * np.cos(angle), s.wheel_radius + radius * np.sin(angle)], axis=-1)
    return np.array([(axle + radius, -0.2), *arc, (axle - radius, -0.2)])
