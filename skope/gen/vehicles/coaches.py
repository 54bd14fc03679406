"""Further buses: low-floor city buses, coaches, double-deckers, school buses; and step vans, which are built alike."""

from dataclasses import replace
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.car import CarBody
from skope.gen.vehicles.laid_out_bus import BusLayout, LaidOutBus
from skope.gen.vehicles.liveries import draw_graphics
from skope.gen.vehicles.lofted_surfaces import SIDE, WRAP, Surface
from skope.gen.vehicles.panels import disc, rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.upright_shells import ROOF_CORNER_ROW
from skope.types import Array

CITY: Final = BusLayout(
    windows=0.34, pane=1.5, screen=0.52, rear_window=(1.35, 0.55), doors=((-0.3, 1.25), (0.42, 1.3), (0.8, 1.3)),
    sign=True, pod=0.24,
)  # fmt: skip
COACH: Final = BusLayout(
    windows=0.42, pane=1.75, screen=0.3, rear_window=(1.2, 0.45), doors=((-0.27, 0.85), (0.5, 0.8)),
    material="glass_tinted", pod=0.16, flaps=True,
)  # fmt: skip
DOUBLE_DECK: Final = BusLayout(
    windows=2.15, pane=1.3, screen=2.0, rear_window=(1.5, 0.55), doors=((-0.32, 1.2), (0.4, 1.2)), sign=True,
    upper=(1.5, 0.5),
)  # fmt: skip
SCHOOL: Final = BusLayout(windows=0.62, pane=0.75, screen=0.45, rear_window=(1.25, 0.5), doors=((0.19, 0.85),))

STEP_ENTRY_LAYOUT: Final = BusLayout(windows=0.55, pane=1.0, screen=0.5, rear_window=(1.4, 0.5), doors=())


class CityBusBody(LaidOutBus):
    """A low-floor city bus."""

    layout = CITY


class CoachBody(LaidOutBus):
    """A coach, whose passengers sit over the hold."""

    layout = COACH


class DoubleDeckBody(LaidOutBus):
    """A bus with two decks."""

    layout = DOUBLE_DECK


class StepVanBody(LaidOutBus):
    """A delivery van with an upright front, doors that slide, and a shutter behind."""

    layout = STEP_ENTRY_LAYOUT

    def _draw_side_windows(self, shell: Surface) -> None:
        """The window and the gaps of the door; graphics on the panels behind."""
        s = self.shape
        high = s.height - self.layout.windows
        front, back = self.nose - 0.5, self.nose - 1.3
        shell.paint(
            rectangle_outline(back - 0.03, front + 0.03, s.belt_height - 0.03, high + 0.03),
            SIDE,
            "trim",
            facing=LEFT_AXIS,
        )
        shell.paint(rectangle_outline(back, front, s.belt_height, high), SIDE, "glass", facing=LEFT_AXIS)
        for x in (front + 0.12, back - 0.12):
            shell.line([(x, s.clearance + 0.16), (x, high + 0.12)], SIDE, width=0.016, layer=3, facing=LEFT_AXIS)
        for x in np.linspace(self.end + 0.35, back - 0.45, 5).tolist():
            shell.draw(
                rectangle_outline(x - 0.02, x + 0.02, s.belt_height - 0.3, s.height - 0.25),
                SIDE,
                "rail",
                layer=1,
                facing=LEFT_AXIS,
            )
        rng = np.random.default_rng(int(s.length * 1e4))
        draw_graphics(shell, (self.end + 0.4, back - 0.3), (s.belt_height - 0.25, s.height - 0.3), rng)
        shell.draw(
            rectangle_outline(self.end + 0.1, self.nose - 0.2, s.belt_height - 0.42, s.belt_height - 0.34),
            SIDE,
            "trim",
            layer=8,
            facing=LEFT_AXIS,
        )
        self.points["beltline"] = shell.place((back, s.belt_height), SIDE)[0]

    def _draw_rear_window(self, shell: Surface, corner: float, end: float) -> None:
        """A shutter in its frame, with a step below."""
        s = self.shape
        edge, low, high = corner + 0.22, s.clearance + 0.5, s.height - 0.42
        shell.line([(end + 0.1, low), (edge, low), (edge, high), (end + 0.1, high)], WRAP, "rail", width=0.04, layer=2)
        for z in np.arange(low + 0.2, high - 0.05, 0.22).tolist():
            shell.line([(edge, z), (end + 0.1, z)], WRAP, width=0.014, layer=3)
        shell.draw(rectangle_outline(edge + 0.2, end + 0.1, high + 0.08, high + 0.13), WRAP, "brake_light", layer=2)
        self.points |= {
            "roof_rear": shell.corner(ROOF_CORNER_ROW, rear=True),
            "rear_window_base": shell.place((edge, low + 0.02), WRAP)[0],
        }


class SchoolBusBody(LaidOutBus):
    """A bus behind a hood, with small windows, rub rails along the sides and flashing lamps over its screens."""

    layout = SCHOOL

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        own = replace(shape, width=shape.width * style.cab_width, height=shape.belt_height + 0.9)
        own = replace(own, deck_length=shape.length - shape.cab_length)
        self._car = CarBody(own, replace(style, family="car", bed=True, palette="freight"))
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
        """Dark rub rails."""
        s = self.shape
        for z in (s.clearance + 0.45, s.belt_height - 0.35, s.belt_height - 0.12):
            shell.draw(rectangle_outline(-1, end + 1, z, z + 0.06), WRAP, "gap", layer=3)
        for middle, sign in ((0.0, 1.0), (end, -1.0)):
            for away, tone in ((0.66, "#d21f1f"), (0.9, "#e8861a")):
                at = (middle + sign * away, s.height - 0.3)
                shell.draw(disc(at, 0.11, 12), WRAP, "gap", layer=3)
                shell.draw(disc(at, 0.085, 12), WRAP, tone, layer=5)

    def _draw_door(self, shell: Surface, x: float, width: float) -> None:
        """A door that interrupts the rub rails."""
        low, high = self.shape.clearance + 0.16, self.shape.height - self.layout.windows + 0.02
        door = rectangle_outline(x - width / 2, x + width / 2, low, high)
        shell.draw(door, SIDE, "trim", layer=5, facing=LEFT_AXIS)
        for bottom, top in ((low + 0.08, low + 0.42 * (high - low)), (low + 0.47 * (high - low), high - 0.05)):
            pane = rectangle_outline(x - width / 2 + 0.07, x + width / 2 - 0.07, bottom, top)
            shell.draw(pane, SIDE, "glass_tinted", layer=7, facing=LEFT_AXIS)
