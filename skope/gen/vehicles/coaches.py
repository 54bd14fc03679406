"""Further buses with a layout of windows, doors, signs and roof equipment.

They are low-floor city buses, coaches, double-deckers and school buses, and also step vans, which use the same builder.
"""

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, merged
from skope.gen.vehicles import front, rear
from skope.gen.vehicles.bus import BusBody
from skope.gen.vehicles.car import CarBody
from skope.gen.vehicles.lofted_surfaces import SIDE_AXES, WRAP_AXES, Plan, Surface
from skope.gen.vehicles.panels import (
    MARKER_MATERIAL,
    PANEL_LIMITS,
    disc,
    draw_graphics,
    draw_on_left,
    draw_upper_markers,
    grown,
    rectangle_outline,
)
from skope.gen.vehicles.parts import arm_mirror
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import ROOF_CORNER_ROW, Tower, corner_w, pipe
from skope.gen.vehicles.wheels import steel_wheel
from skope.types import Array

_BUMPER_LIP: Final = 0.07
"""Share of the wall's height below which the front and rear bend inwards."""


@dataclass(frozen=True)
class BusLayout:
    """Layout of a bus, metres. Heights are below the roof unless stated otherwise."""

    windows: float
    """Upper edge of the side windows."""
    pane: float
    """Approximate length of a side window."""
    screen: float
    """Upper edge of the windscreen."""
    rear_window: tuple[float, float]
    """Lower and upper edge of the rear window."""
    doors: tuple[tuple[float, float], ...]
    """Doors on the right: position as a share of the distance from the front to the rear axle, and width. A negative
    position is ahead of the front axle."""
    material: str = "glass"
    """Material of the side windows."""
    sign: bool = False
    """Whether there are destination signs above the windscreen, beside the first door and at the rear."""
    pod: float = 0.0
    """Height of the equipment on the roof: air conditioning, batteries."""
    flaps: bool = False
    """Whether there are luggage doors along the sides."""
    upper: tuple[float, float] | None = None
    """Lower and upper edge of the windows of a second deck; None: one deck."""


class LaidOutBus(BusBody):
    """Bus with a layout. `shape.belt_height` is the side windows' lower edge, `shape.hood_height` the windscreen's."""

    layout: BusLayout
    ridge = 0.9

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        super().__init__(replace(shape, height=shape.height - self.layout.pod), style)

    @property
    def lit_inside(self) -> bool:
        return self.layout.sign and super().lit_inside

    def _carved_axles(self) -> tuple[float, ...]:
        s = self.shape
        return s.front_axle_x, s.rear_axle_x, *(s.rear_axle_x + ahead for ahead in self.style.axles)

    def _build_half(self, *, doors: bool) -> Mesh:
        s = self.shape
        wheel = steel_wheel(s.wheel_radius, s.wheel_width)
        # The wheels of the axles between the outer axles are not separate parts.
        inner = [wheel.moved((s.rear_axle_x + ahead, s.track / 2, s.wheel_radius)) for ahead in self.style.axles]
        pods = self._pods() if self.layout.pod else []
        return merged([super()._build_half(doors=doors), *inner, *pods])

    def _pods(self) -> list[Mesh]:
        s, high = self.shape, self.shape.height + self.layout.pod
        places = ((self.nose - 2.4, 2.6), (self.end + 3.6, 2.2)) if self.layout.sign else ((0.4, 2.4),)
        half, material = (s.width / 2 - 0.3, "paint") if self.layout.sign else (s.width / 2 - 0.55, "rail")
        out = []
        for x, long in places:
            plan = Plan(half, x + long / 2, x - long / 2, 0.0, 0.0, 0.14, 0.14)
            lean = [(0.0, 0.0, 0.0, 0.0), (1.0, 0.04, 0.14, 0.08)]
            out.append(Tower(plan, s.height - 0.12, high, lean, edge=0.05, crown=0.02, stations=3).surface(material)[0])
        return [shell.half for shell in out]

    def _mirror(self) -> tuple[Mesh, Array]:
        s = self.shape
        if not self.layout.flaps:
            return arm_mirror((self.nose - 0.46, s.width / 2 - 0.05, 1.75), "trim", reach=0.25, high=0.5, sunk=0.1)
        # A coach's mirror hangs from an arm at the upper corner.
        root = (self.nose - 0.55, s.width / 2 - 0.1, s.height - 1.4)
        housing, tip = arm_mirror(root, "trim", reach=0.3, high=0.6, sunk=0.12)
        elbow = (root[0] + 0.06, tip[1] - 0.09, s.height - 0.5)
        arms = [
            pipe((root[0] - 0.2, s.width / 2 - 0.42, s.height - 0.32), elbow, 0.04, "trim"),
            pipe(elbow, (root[0], tip[1] - 0.09, tip[2] + 0.25), 0.04, "trim"),
        ]
        return merged([housing, *arms]), tip

    def _draw_details(self, shell: Surface, w: Array, doors: bool) -> list[Mesh]:
        s, end = self.shape, float(w[-1])
        self._draw_livery(shell, end)
        shell.paint(rectangle_outline(-1, end + 1, 0, s.clearance + 0.14), WRAP_AXES, "trim")
        self._draw_windscreen(shell, corner_w(w))
        self._draw_side_windows(shell)
        if self.layout.flaps:
            self._draw_flaps(shell)
        for share, wide in self.layout.doors if doors else ():
            self._draw_door(shell, s.front_axle_x - share * s.wheelbase, wide)
        self._draw_rear_window(shell, corner_w(w, rear=True), end)
        out = self._draw_front(shell, w)
        out += rear.draw_rear(shell, w, s, replace(self.style, family="bus"), self.points)
        if s.width > PANEL_LIMITS.marked_from_m:
            draw_upper_markers(shell, s.width / 2 - 0.1, s.height - 0.25, end)
        for at in np.arange(self.end + 1.2, self.nose - 1.2, 1.9).tolist():
            shell.draw(
                rectangle_outline(at - 0.05, at + 0.05, s.clearance + 0.32, s.clearance + 0.37),
                SIDE_AXES,
                MARKER_MATERIAL,
                layer=3,
            )
        back = corner_w(w, rear=True)
        self.points |= {
            "trunk_rear": shell.place((back, self._waist - 0.05), WRAP_AXES)[0],
            "bumper_rear": shell.corner(_BUMPER_LIP, rear=True),
        }
        return out

    @property
    def _waist(self) -> float:
        """Height of the upper edge of the engine's flap at the rear, metres."""
        return min(self.shape.belt_height, 1.3)

    def _draw_front(self, shell: Surface, w: Array) -> list[Mesh]:
        s, screen = self.shape, corner_w(w)
        self.points |= {
            "hood_front": shell.place((screen - 0.14, s.hood_height - 0.12), WRAP_AXES)[0],
            "bumper_front": shell.corner(_BUMPER_LIP),
        }
        return front.draw_front(shell, w, s, replace(self.style, family="bus"), self.points)

    def _draw_livery(self, shell: Surface, end: float) -> None:
        s = self.shape
        rng = np.random.default_rng(int(s.length * 1e4))
        kind = int(rng.integers(4))
        if kind == 0:
            shell.paint(rectangle_outline(-1, end + 1, 0, s.belt_height - 0.16), WRAP_AXES, "livery")
        elif kind == 1:
            start = s.rear_axle_x + float(rng.uniform(0.8, 3.0))
            sweep = [(start, 0.0), (start - 2.2, s.height + 0.2), (-99, s.height + 0.2), (-99, 0.0)]
            shell.paint(sweep, SIDE_AXES, "livery")
        elif kind == 2:
            draw_graphics(shell, (self.end + 0.8, self.nose - 0.9), (s.clearance + 0.2, s.belt_height - 0.1), rng)
        if self.layout.upper and rng.uniform() < 0.5:
            low, high = s.height - self.layout.windows + 0.12, s.height - self.layout.upper[0] - 0.12
            draw_graphics(shell, (self.end + 1.0, self.nose - 1.2), (low, high), rng)

    def _draw_windscreen(self, shell: Surface, screen: float) -> None:
        s, layout = self.shape, self.layout
        low, high = s.hood_height, s.height - layout.screen
        # A dark frame around the glass contains the sign.
        band = high + (0.34 if layout.sign else 0.1)
        screen -= 0.02
        shell.paint(rectangle_outline(-0.1, screen + 0.06, low - 0.05, band), WRAP_AXES, "trim")
        shell.paint(rectangle_outline(-0.1, screen, low, high), WRAP_AXES, "glass")
        if layout.sign:
            self._draw_sign(shell, 0.0, high + 0.05, band - 0.06)
        for start, stop in ((0.06, 0.8), (0.35, screen - 0.05)):
            shell.line([(start, low - 0.01), (stop, low + 0.14)], WRAP_AXES, width=0.022, layer=4)
        top = band
        if layout.upper:
            sill, top = s.height - layout.upper[0], s.height - layout.upper[1] + 0.14
            shell.paint(rectangle_outline(-0.1, screen + 0.06, sill - 0.05, top), WRAP_AXES, "trim")
            shell.paint(rectangle_outline(-0.1, screen, sill, top - 0.06), WRAP_AXES, "glass_tinted")
        self.points |= {
            "roof_front": shell.place((screen + 0.06, top), WRAP_AXES)[0],
            "windscreen_base": shell.place((screen, low), WRAP_AXES)[0],
        }

    def _draw_sign(self, shell: Surface, middle: float, low: float, high: float) -> None:
        shell.draw(rectangle_outline(middle - 0.85, middle + 0.85, low, high), WRAP_AXES, "grille")
        for at in np.arange(-0.7, 0.7, 0.12).tolist():
            if abs(at) > 0.09:
                shell.draw(
                    rectangle_outline(middle + at, middle + at + 0.085, low + 0.04, high - 0.04),
                    WRAP_AXES,
                    "display",
                    layer=2,
                )

    def _draw_side_windows(self, shell: Surface) -> None:
        s, layout = self.shape, self.layout
        start, stop = self.nose - 0.62, self.end + 0.5
        bands = [(s.belt_height, s.height - layout.windows)]
        if layout.upper:
            bands.append((s.height - layout.upper[0], s.height - layout.upper[1]))
        count = round((start - stop) / layout.pane) + 1
        posts = np.linspace(stop, start, count)
        for k, (low, high) in enumerate(bands):
            shell.paint(
                rectangle_outline(stop - 0.06, start + 0.06, low - 0.05, high + 0.05),
                SIDE_AXES,
                "trim",
                facing=PANEL_LIMITS.left_axis,
            )
            glass = self._window("glass_tinted" if k else layout.material)
            for a, b in pairwise(posts):
                shell.paint(
                    rectangle_outline(a + 0.03, b - 0.03, low, high), SIDE_AXES, glass, facing=PANEL_LIMITS.left_axis
                )
        post = posts[-2]
        self.points["beltline"] = shell.place((post, s.belt_height - 0.05), SIDE_AXES)[0]

    def _draw_flaps(self, shell: Surface) -> None:
        """Draw doors of the luggage hold between the axles, and of the engine at the rear."""
        s = self.shape
        low, high = s.clearance + 0.2, s.belt_height - 0.3
        reach = 1.2 * s.wheel_radius
        last = s.rear_axle_x + max(self.style.axles, default=0.0)
        for x in np.linspace(last + reach + 0.1, s.front_axle_x - reach - 0.1, 6):
            shell.line([(x, low), (x, high)], SIDE_AXES, width=0.014, layer=7, facing=PANEL_LIMITS.left_axis)
        for z in (low, high):
            shell.line(
                [(self.end + 0.4, z), (self.nose - 0.6, z)],
                SIDE_AXES,
                width=0.014,
                layer=7,
                facing=PANEL_LIMITS.left_axis,
            )

    def _draw_rear_window(self, shell: Surface, corner: float, end: float) -> None:
        s, layout = self.shape, self.layout
        low, high = (s.height - edge for edge in layout.rear_window)
        glass = end - corner - 0.12
        shell.paint(rectangle_outline(end - glass - 0.05, end + 0.1, low - 0.05, high + 0.06), WRAP_AXES, "trim")
        shell.paint(rectangle_outline(end - glass, end + 0.1, low, high), WRAP_AXES, "glass_tinted")
        shell.draw(rectangle_outline(end - 0.16, end + 0.1, high + 0.1, high + 0.14), WRAP_AXES, "brake_light", layer=2)
        base = s.clearance + 0.62
        if self._waist - 0.1 > base + 0.1:
            shell.sink(
                rectangle_outline(end - 0.8, end + 0.1, base, self._waist - 0.1), WRAP_AXES, 0.02, "grille_slats"
            )
        for level in (s.clearance + 0.3, self._waist + 0.05):
            shell.line([(end - 0.95, level), (end + 0.1, level)], WRAP_AXES, width=0.014, layer=3)
        if layout.sign:
            shell.draw(rectangle_outline(end - 0.3, end + 0.1, low + 0.08, low + 0.3), WRAP_AXES, "display", layer=4)
        self.points |= {
            "roof_rear": shell.place((end - glass, high), WRAP_AXES)[0],
            "rear_window_base": shell.place((end - glass, low), WRAP_AXES)[0],
        }

    def _draw_door(self, shell: Surface, x: float, width: float) -> None:
        """Draw a door of two glass leaves, as high as the lower windows."""
        low, high = self.shape.clearance + 0.1, self.shape.height - self.layout.windows + 0.02
        half = width / 2
        shell.paint(rectangle_outline(x - half, x + half, low, high), SIDE_AXES, "trim", facing=PANEL_LIMITS.left_axis)
        leaves = ((x - half, x), (x, x + half)) if width > 1 else ((x - half, x + half),)
        for a, b in leaves:
            shell.paint(
                grown(rectangle_outline(a, b, low + 0.06, high - 0.04), -0.045),
                SIDE_AXES,
                self._window("glass"),
                facing=PANEL_LIMITS.left_axis,
            )


CITY_BUS: Final = BusLayout(
    windows=0.34, pane=1.5, screen=0.52, rear_window=(1.35, 0.55), doors=((-0.3, 1.25), (0.42, 1.3), (0.8, 1.3)),
    sign=True, pod=0.24,
)  # fmt: skip
COACH_BUS: Final = BusLayout(
    windows=0.42, pane=1.75, screen=0.3, rear_window=(1.2, 0.45), doors=((-0.27, 0.85), (0.5, 0.8)),
    material="glass_tinted", pod=0.16, flaps=True,
)  # fmt: skip
DOUBLE_DECK: Final = BusLayout(
    windows=2.15, pane=1.3, screen=2.0, rear_window=(1.5, 0.55), doors=((-0.32, 1.2), (0.4, 1.2)), sign=True,
    upper=(1.5, 0.5),
)  # fmt: skip
SCHOOL_BUS: Final = BusLayout(windows=0.62, pane=0.75, screen=0.45, rear_window=(1.25, 0.5), doors=((0.19, 0.85),))

STEP_ENTRY_LAYOUT: Final = BusLayout(windows=0.55, pane=1.0, screen=0.5, rear_window=(1.4, 0.5), doors=())


class CityBusBody(LaidOutBus):
    """Low-floor city bus."""

    layout = CITY_BUS


class CoachBody(LaidOutBus):
    """Coach with seats above the luggage hold."""

    layout = COACH_BUS


class DoubleDeckBody(LaidOutBus):
    """Bus with two decks."""

    layout = DOUBLE_DECK


class StepVanBody(LaidOutBus):
    """Delivery van with an upright front, sliding doors and a shutter at the rear."""

    layout = STEP_ENTRY_LAYOUT

    def _draw_side_windows(self, shell: Surface) -> None:
        """Draw the window, the gaps of the door, and graphics on the panels behind."""
        s = self.shape
        high = s.height - self.layout.windows
        front, back = self.nose - 0.5, self.nose - 1.3
        shell.paint(
            rectangle_outline(back - 0.03, front + 0.03, s.belt_height - 0.03, high + 0.03),
            SIDE_AXES,
            "trim",
            facing=PANEL_LIMITS.left_axis,
        )
        shell.paint(
            rectangle_outline(back, front, s.belt_height, high), SIDE_AXES, "glass", facing=PANEL_LIMITS.left_axis
        )
        for x in (front + 0.12, back - 0.12):
            shell.line(
                [(x, s.clearance + 0.16), (x, high + 0.12)],
                SIDE_AXES,
                width=0.016,
                layer=3,
                facing=PANEL_LIMITS.left_axis,
            )
        for x in np.linspace(self.end + 0.35, back - 0.45, 5).tolist():
            draw_on_left(shell, (x - 0.02, x + 0.02, s.belt_height - 0.3, s.height - 0.25), "rail", layer=1)
        rng = np.random.default_rng(int(s.length * 1e4))
        draw_graphics(shell, (self.end + 0.4, back - 0.3), (s.belt_height - 0.25, s.height - 0.3), rng)
        draw_on_left(
            shell, (self.end + 0.1, self.nose - 0.2, s.belt_height - 0.42, s.belt_height - 0.34), "trim", layer=8
        )
        self.points["beltline"] = shell.place((back, s.belt_height), SIDE_AXES)[0]

    def _draw_rear_window(self, shell: Surface, corner: float, end: float) -> None:
        """Draw a shutter in its frame, with a step below."""
        s = self.shape
        edge, low, high = corner + 0.22, s.clearance + 0.5, s.height - 0.42
        shell.line(
            [(end + 0.1, low), (edge, low), (edge, high), (end + 0.1, high)], WRAP_AXES, "rail", width=0.04, layer=2
        )
        for z in np.arange(low + 0.2, high - 0.05, 0.22).tolist():
            shell.line([(edge, z), (end + 0.1, z)], WRAP_AXES, width=0.014, layer=3)
        shell.draw(
            rectangle_outline(edge + 0.2, end + 0.1, high + 0.08, high + 0.13), WRAP_AXES, "brake_light", layer=2
        )
        self.points |= {
            "roof_rear": shell.corner(ROOF_CORNER_ROW, rear=True),
            "rear_window_base": shell.place((edge, low + 0.02), WRAP_AXES)[0],
        }


class SchoolBusBody(LaidOutBus):
    """School bus with a hood, small windows, rub rails along the sides and flashing lamps above its screens."""

    layout = SCHOOL_BUS

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        cab_shape = replace(shape, width=shape.width * style.cab_width, height=shape.belt_height + 0.9)
        cab_shape = replace(cab_shape, deck_length=shape.length - shape.cab_length)
        self._car = CarBody(cab_shape, replace(style, family="car", bed=True, palette="freight"))
        super().__init__(shape, style)

    def _nose(self) -> float:
        return self.shape.cowl_x + 0.1

    def _carved_axles(self) -> tuple[float, ...]:
        return (self.shape.rear_axle_x,)

    def _draw_front(self, shell: Surface, w: Array) -> list[Mesh]:
        names = ("headlight_outer", "headlight_inner", "front_logo", "bumper_front", "hood_front")
        self.points |= {name: self._car.points[name] for name in names}
        return [self._car.hood_half(self.nose - 0.25)]

    def _draw_livery(self, shell: Surface, end: float) -> None:
        """Draw dark rub rails."""
        s = self.shape
        for z in (s.clearance + 0.45, s.belt_height - 0.35, s.belt_height - 0.12):
            shell.draw(rectangle_outline(-1, end + 1, z, z + 0.06), WRAP_AXES, "gap", layer=3)
        for middle, sign in ((0.0, 1.0), (end, -1.0)):
            for away, tone in ((0.66, "#d21f1f"), (0.9, "#e8861a")):
                at = (middle + sign * away, s.height - 0.3)
                shell.draw(disc(at, 0.11, 12), WRAP_AXES, "gap", layer=3)
                shell.draw(disc(at, 0.085, 12), WRAP_AXES, tone, layer=5)

    def _draw_door(self, shell: Surface, x: float, width: float) -> None:
        """Draw a door that interrupts the rub rails."""
        low, high = self.shape.clearance + 0.16, self.shape.height - self.layout.windows + 0.02
        door = rectangle_outline(x - width / 2, x + width / 2, low, high)
        shell.draw(door, SIDE_AXES, "trim", layer=5, facing=PANEL_LIMITS.left_axis)
        for bottom, top in ((low + 0.08, low + 0.42 * (high - low)), (low + 0.47 * (high - low), high - 0.05)):
            pane = rectangle_outline(x - width / 2 + 0.07, x + width / 2 - 0.07, bottom, top)
            shell.draw(pane, SIDE_AXES, "glass_tinted", layer=7, facing=PANEL_LIMITS.left_axis)
