"""Hardtops over the beds of pickups: a shell of its own behind the cabin, with panes and a glass hatch."""

from typing import Final

from skope.gen.mesh import Mesh
from skope.gen.vehicles.body_axes import LEFT_AXIS
from skope.gen.vehicles.lofted_surfaces import SIDE, WRAP, Plan
from skope.gen.vehicles.panels import rectangle_outline
from skope.gen.vehicles.shape import Shape
from skope.gen.vehicles.upright_shells import ROOF_CORNER_ROW, Tower
from skope.types import Array

_BED_GAP_M: Final = 0.07
"""Gap between cabin and hardtop at the bed's edge, metres."""
_ABOVE: Final = 0.005
"""Height of the hardtop's foot over the bed's edge, metres."""


def canopy(s: Shape) -> tuple[Mesh, dict[str, Array]]:
    """The left half of a hardtop, and the rear roof's and rear window's corners."""
    front, rear = s.backlight_x - _BED_GAP_M, -s.length / 2 + s.tail_lean + 0.14
    low, high = s.deck_height + _ABOVE, s.height - 0.012
    plan = Plan(s.width / 2 - 0.085, front, rear, 0.0, 0.03, 0.06, 0.1)
    lean = [(0.0, 0.0, 0.0, 0.0), (0.12, 0.012, 0.0, 0.01), (1.0, 0.11, 0.05, 0.2)]
    shell, w, _ = Tower(plan, low, high, lean, edge=0.07, crown=0.03, stations=5, levels=4).surface("paint")
    tall, length = high - low, front - rear
    shell.draw(rectangle_outline(-1, 99, 0, low + 0.045), WRAP, "trim", layer=2)
    base, top = low + 0.16 * tall, low + 0.74 * tall
    start, stop = rear + 0.17 * length + 0.05, front - 0.1 * length
    for a, b in ((start, start + 0.42 * length), (start + 0.45 * length, stop)):
        shell.paint(rectangle_outline(a - 0.025, b + 0.025, base - 0.025, top + 0.025), SIDE, "trim", facing=LEFT_AXIS)
        shell.paint(rectangle_outline(a, b, base, top), SIDE, "glass_tinted", facing=LEFT_AXIS)
    end = float(w[-1])
    corner = end - s.width / 2 + 0.23
    shell.paint(rectangle_outline(corner - 0.03, end + 0.1, base - 0.03, top + 0.06), WRAP, "trim")
    shell.paint(rectangle_outline(corner, end + 0.1, base, top + 0.03), WRAP, "glass_tinted")
    shell.draw(rectangle_outline(end - 0.15, end + 0.1, top + 0.08, top + 0.11), WRAP, "brake_light", layer=2)
    points = {
        "roof_rear": shell.corner(ROOF_CORNER_ROW, rear=True),
        "rear_window_base": shell.place((corner, base), WRAP)[0],
    }
    return shell.half, points
