"""Common parts of lorries and trailers: the cargo space and its bodies, axles, and the underrun bar."""

from dataclasses import dataclass, field
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box
from skope.gen.vehicles import rear
from skope.gen.vehicles.lofted_surfaces import BOTTOM, ROW_AXES, SIDE_AXES, TOP_AXES, WRAP_AXES, Plan, Surface
from skope.gen.vehicles.panels import MARKER_MATERIAL, PANEL_LIMITS, Points, draw_upper_markers, rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import Tower, mudguard
from skope.gen.vehicles.wheels import steel_wheel
from skope.types import Array

BEACON_COLOR: Final = "#e8861a"
"""Colour of beacons and of moving parts."""


@dataclass(frozen=True)
class CargoSpace:
    """Space behind a cab from `end` to `ahead` (x), above the floor at `shape.box_height`."""

    shape: Shape
    style: VehicleStyle
    ahead: float
    end: float
    cab_height: float

    @property
    def half(self) -> float:
        return self.shape.width / 2

    @property
    def floor(self) -> float:
        return self.shape.box_height

    @property
    def rear_axle(self) -> float:
        return self.shape.rear_axle_x

    def rng(self) -> np.random.Generator:
        """Random generator of liveries and loads; its seed follows from the length, so that few vehicles are equal."""
        return np.random.default_rng(int(self.shape.length * 1e4))


@dataclass
class Cargo:
    """Left half of a cargo body, with its keypoints `roof_rear`, `rear_window_base` and `trunk_rear`."""

    parts: list[Mesh] = field(default_factory=list)
    points: dict[str, Array] = field(default_factory=dict)

    def mark(self, roof_rear: Array, rear_window_base: Array, trunk_rear: Array) -> None:
        """Record the keypoints (3,)."""
        self.points = {"roof_rear": roof_rear, "rear_window_base": rear_window_base, "trunk_rear": trunk_rear}


def mudguards(space: CargoSpace) -> list[Mesh]:
    """Return curved mudguards over the rear axles of a body that does not cover them."""
    s = space.shape
    y = (s.track / 2 - 1.6 * s.wheel_width, s.track / 2 + 0.6 * s.wheel_width)
    spread = 78.0 if not space.style.axles else 58.0
    axles = [space.rear_axle, *(space.rear_axle + ahead for ahead in space.style.axles)]
    return [mudguard((x, s.wheel_radius), s.wheel_radius + 0.09, y, "trim", reach_deg=spread) for x in axles]


SIDE_RIBS = {
    "box": (6, 0.014),
    "curtain": (9, 0.03),
    "flatbed": (4, 0.05),
    "tipper": (7, 0.09),
    "container": (0, 0.0),
}
"""Number and width of the ribs along the side of each kind of cargo body."""
_MARKER_STEP_M = 2.2
"""Distance between marker lamps along the sides, metres."""
_OPEN_SIDES_M = {"flatbed": 0.5, "tipper": 1.25}
"""Height of the sides of bodies without a roof, metres."""


def cargo_body(s: Shape, kind: str, ahead: float, *, ribs: int = 0) -> tuple[Mesh, Points]:
    """Return the left half of a cargo body from `ahead` to the rear end of a shape, and its keypoints.

    Args:
        s: The shape. The body's floor is at `box_height`, its roof at `height`.
        kind: "box", "curtain", "container", "flatbed" or "tipper".
        ahead: x of its front.
        ribs: Number of ribs along its side; 0: the number of its kind.
    """
    end = -s.length / 2
    high = s.box_height + _OPEN_SIDES_M[kind] if kind in _OPEN_SIDES_M else s.height
    closed = kind not in _OPEN_SIDES_M
    tower = Tower(
        Plan(s.width / 2, ahead, end, 0.0, 0.0, 0.05, 0.035),
        s.box_height,
        high,
        [(0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.012)],
        edge=0.05 if kind != "tipper" else 0.02,
        crown=0.015,
        hollow=None if closed else s.box_height + 0.1,
        stations=3,
        levels=2,
    )
    shell, w, _ = tower.surface("livery")
    last = float(w[-1])
    corner = last - s.width / 2
    sill, inset = s.box_height + 0.12, 0.11
    frame_material = "rail" if closed else "trim"
    shell.draw(rectangle_outline(-1, 99, 0, sill - 0.03), WRAP_AXES, frame_material)
    top = high - (0.16 if closed else 0.12)
    edge = corner + inset
    shell.line([(last + 0.1, sill), (edge, sill), (edge, top), (last + 0.1, top)], WRAP_AXES, width=0.02)
    if closed:
        _draw_doors(shell, last, edge, sill, top)
        shell.draw(rectangle_outline(-1, 99, high - 0.12, high - 0.06), WRAP_AXES, frame_material)
        if s.width > PANEL_LIMITS.marked_from_m:
            draw_upper_markers(shell, s.width / 2, high - 0.115, last)
    if kind != "tipper":
        for x in np.arange(end + 0.6, ahead - 0.3, _MARKER_STEP_M).tolist():
            shell.draw(
                rectangle_outline(x - 0.05, x + 0.05, sill - 0.1, sill - 0.05), SIDE_AXES, MARKER_MATERIAL, layer=4
            )
    count, wide = SIDE_RIBS[kind]
    for x in np.linspace(ahead - 0.25, end + 0.25, ribs or count):
        rib = rectangle_outline(x - wide / 2, x + wide / 2, sill, top + 0.04)
        shell.draw(rib, SIDE_AXES, "rail" if kind != "tipper" else "trim", facing=PANEL_LIMITS.left_axis)
    if not closed:
        shell.paint([(-99, -9), (99, -9), (99, 9), (-99, 9)], TOP_AXES, "bed", levels=(2.1, 3.0))
    return shell.half, {
        "roof_rear": shell.place((corner, high - tower.edge - (tower.crown if closed else 0)), WRAP_AXES)[0],
        "rear_window_base": shell.place((edge, top), WRAP_AXES)[0],
        "trunk_rear": shell.place((corner, BOTTOM), ROW_AXES)[0],
    }


def _draw_doors(shell: Surface, end: float, edge: float, low: float, top: float) -> None:
    """Draw the gap between two doors, their bolts and hinges."""
    shell.line([(end, low), (end, top)], WRAP_AXES, width=0.016)
    for share in (0.28, 0.6):
        shell.draw(
            rectangle_outline(end - share - 0.012, end - share + 0.012, low + 0.05, top - 0.05),
            WRAP_AXES,
            "rail",
            layer=8,
        )
    for z in np.linspace(low + 0.3, top - 0.3, 4):
        shell.draw(rectangle_outline(edge, edge + 0.1, z, z + 0.05), WRAP_AXES, "rail", layer=2)


def axle(s: Shape, x: float, *, wheel: bool, dual: bool) -> list[Mesh]:
    """Return the left half of an axle at `x` with its guard.

    With `wheel` it has its outer wheel; with `dual` it has the inner wheel of twin tyres.
    """
    y, radius = s.track / 2, s.wheel_radius
    tyre = steel_wheel(radius, s.wheel_width)
    out = [box((x - 0.06, 0.0, radius - 0.06), (x + 0.06, y - 0.1, radius + 0.06), "under")]
    if wheel:
        out.append(tyre.moved((x, y, radius)))
    if dual:
        out.append(tyre.moved((x, y - s.wheel_width * 1.06, radius)))
    if s.box_height - 2 * radius > 0.1:
        low, high = (x - radius * 0.95, y - 0.36, 2 * radius + 0.04), (x + radius * 0.95, y + 0.14, 2 * radius + 0.075)
        out.append(box(low, high, "trim"))
    return out


def underrun_bar(s: Shape, style: VehicleStyle, points: Points) -> list[Mesh]:
    """Return the left half of the bar under the rear end, with lamps and plate; record its keypoints."""
    end = -s.length / 2
    bar = Plan(s.width / 2 - 0.02, end + 0.16, end, 0.0, 0.0, 0.02, 0.02)
    tower = Tower(bar, s.taillight_low - 0.06, s.taillight_high + 0.05, edge=0.012, crown=0.0, stations=3)
    shell, w, _ = tower.surface("trim")
    out = rear.draw_rear(shell, w, s, style, points)
    points["bumper_rear"] = shell.corner(BOTTOM, rear=True)
    return [*out, shell.half]


def side_guard(s: Shape, tank: float, behind: float, side: float) -> list[Mesh]:
    """Return rails on the left side with their posts, at y = `side`, from `behind` to the tank at x = `tank`."""
    low, high = s.clearance + 0.12, s.clearance + 0.42
    rails = [box((behind, side - 0.04, z), (tank - 0.1, side, z + 0.11), "rail") for z in (low, high)]
    posts = [
        box((x - 0.03, side - 0.07, low), (x + 0.03, side - 0.041, s.box_height), "under")
        for x in np.linspace(behind + 0.1, tank - 0.2, 3)
    ]
    markers = [
        box((x - 0.05, side - 0.01, high + 0.03), (x + 0.05, side + 0.006, high + 0.08), MARKER_MATERIAL)
        for x in np.arange(behind + 0.2, tank - 0.15, _MARKER_STEP_M)
    ]
    return rails + posts + markers
