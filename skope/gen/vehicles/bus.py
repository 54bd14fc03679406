"""City buses: an upright shell with large windows, doors on the right and a destination sign.

Articulated buses have two.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box, from_triangles, grid, merged
from skope.gen.vehicles import front, parts, rear
from skope.gen.vehicles.interior import interior, seats
from skope.gen.vehicles.lofted_surfaces import SIDE_AXES, WRAP_AXES, Plan, Surface
from skope.gen.vehicles.panels import PANEL_LIMITS, REAR_MARKER, draw_upper_markers, grown, rectangle_outline
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.gen.vehicles.solids import Tower, arch, corner_w
from skope.types import Array


@dataclass(frozen=True)
class BusSizes:
    """Sizes of buses."""

    bellows_corner_m: float = 0.03
    """Radius of the corners of an end at the bellows, metres."""
    bellows_overlap_m: float = 0.5
    """Overlap of each half of the bellows beyond the hinge, metres. The halves stay closed up to 45 degrees."""
    folds: int = 7
    """Number of folds of the bellows."""
    bumper_lip: float = 0.07
    """Share of the wall's height at which front and rear turn under: the lower edge of the bumpers."""


BUS_SIZES: Final = BusSizes()


class BusBody:
    """Surfaces of a bus. `mesh` is the body without wheels; `points` the left keypoints by stem.

    Its roof points are the upper corners of the windscreen's frame and of the rear window. An articulated bus has two
    bodies: the half in front of the hinge and, with `rear_half`, the half behind it, which has one axle in its shape.
    """

    ridge = 0.0
    """The value for `Tower.ridge`."""

    def __init__(self, shape: Shape, style: VehicleStyle, *, rear_half: bool = False) -> None:
        self.shape, self.style = shape, style
        self.has_front, self.has_rear = not rear_half, rear_half or style.trailer != "bus"
        self.points: dict[str, Array] = {}
        self.nose, self.end = self._nose(), -shape.length / 2
        self._right = self._build_half(doors=True)
        self._left = self._build_half(doors=False)

    def _nose(self) -> float:
        """x of the front of the passenger compartment."""
        return self.shape.length / 2

    @property
    def lit_inside(self) -> bool:
        """Whether the interior light burns at night.

        The choice follows from the width, which both halves of a bus share.
        """
        return int(self.shape.width * 1e4) % 4 != 1

    def _window(self, material: str) -> str:
        """Return the material of side windows and doors: "glass_lit" if the interior light burns, else `material`."""
        return "glass_lit" if self.lit_inside else material

    @cached_property
    def mesh(self) -> Mesh:
        return merged([self._left, self._right.mirrored()])

    @cached_property
    def interior(self) -> Mesh:
        inside = self._seats()
        if not self.lit_inside:
            return inside
        s = self.shape
        low, high = (self.end + 1.0, -0.12, s.height - 0.32), (self.nose - 1.6, 0.12, s.height - 0.28)
        names = tuple("seat_lit" if name == "seat" else name for name in inside.materials)
        return merged([replace(inside, materials=names), box(low, high, "cabin_light")])

    def _seats(self) -> Mesh:
        """Return seats, dashboard and driver."""
        s = self.shape
        rows = 5
        if not self.has_front:
            ground = (s.width / 2 - 0.09, s.clearance + 0.14)
            return seats(self.nose - 1.1, self.end + 0.9, s.belt_height - 0.3, s.width / 2 - 0.3, ground)
        return interior(
            cowl=self.nose - 0.3,
            floor=s.belt_height - 0.3,
            belt=s.belt_height,
            roof=s.height,
            half_width=s.width / 2 - 0.3,
            driver=self.nose - 1.25,
            rows=rows,
            pitch=(s.length - 2.4) / rows,
            ground=(self.end + 0.3, s.width / 2 - 0.09, s.clearance + 0.14),
        )

    def _build_half(self, *, doors: bool) -> Mesh:
        s = self.shape
        has_front, has_rear = self.has_front, self.has_rear
        rounds = (s.nose_round if has_front else 0.0, s.tail_round if has_rear else 0.0)
        corners = (
            0.26 if has_front else BUS_SIZES.bellows_corner_m,
            0.2 if has_rear else BUS_SIZES.bellows_corner_m,
            0.03 if has_front else 0.0,
            0.02 if has_rear else 0.0,
        )
        plan = Plan(s.width / 2, self.nose, self.end, *rounds, *corners)
        belt = (s.belt_height - s.clearance) / (s.height - s.clearance)
        lean = [
            (0.0, 0.03, 0.06, 0.05),
            (BUS_SIZES.bumper_lip, 0.0, 0.0, 0.0),
            (belt, 0.0, 0.02, 0.01),
            (1.0, s.roof_inset, 0.02 + s.screen_run, 0.05),
        ]
        lean = [(share, side, ahead * has_front, behind * has_rear) for share, side, ahead, behind in lean]
        well = s.track / 2 - s.wheel_width / 2 - 0.06
        tower = Tower(
            plan, s.clearance, s.height, lean, edge=0.16, crown=0.05, ridge=self.ridge, well=well, stations=9, levels=3
        )
        shell, w, _ = tower.surface("paint")
        out: list[Mesh] = []
        for axle in self._carved_axles() if has_front else (s.rear_axle_x,):
            lining, rim = shell.carve_well(arch(axle, s), well)
            out += [lining, parts.arch_lip(rim, (axle, s.wheel_radius), "trim", shell.side)]
        out += self._draw_details(shell, w, doors)
        if not (has_front and has_rear):
            out.append(_bellows(s, self.end, -1.0) if has_front else _bellows(s, self.nose, 1.0))
        if not has_front:
            return merged([shell.half, *out])
        mirror, self.points["mirror"] = self._mirror()
        return merged([shell.half, mirror, *out])

    def _carved_axles(self) -> tuple[float, ...]:
        """Return x of the axles with wheel wells."""
        return self.shape.front_axle_x, self.shape.rear_axle_x

    def _mirror(self) -> tuple[Mesh, Array]:
        """Return a mirror and its outer tip."""
        return parts.mirror((self.nose - 0.3, self.shape.width / 2 - 0.03, 2.0), True, "trim")

    def _draw_details(self, shell: Surface, w: Array, doors: bool) -> list[Mesh]:
        """Draw livery, windows, doors, signs and lamps; return the parts that project from the shell."""
        s, end = self.shape, float(w[-1])
        self._draw_livery(shell, end)
        shell.draw(rectangle_outline(-1, end + 1, 0, s.clearance + 0.14), WRAP_AXES, "trim")
        if self.has_front:
            self._draw_windscreen(shell, corner_w(w))
        self._draw_side_windows(shell)
        for at in self._door_places() if doors else ():
            self._draw_door(shell, at, 1.15)
        if self.has_rear:
            self._draw_rear_window(shell, corner_w(w, rear=True), end)
        out = []
        if self.has_front:
            out += front.draw_front(shell, w, s, self.style, self.points)
        if self.has_rear:
            out += rear.draw_rear(shell, w, s, self.style, self.points)
        screen = corner_w(w)
        if self.has_front:
            self.points |= {
                "hood_front": shell.place((screen - 0.14, s.belt_height - 0.13), WRAP_AXES)[0],
                "bumper_front": shell.corner(BUS_SIZES.bumper_lip),
            }
        if self.has_rear:
            self.points |= {
                "trunk_rear": shell.place((corner_w(w, rear=True), s.belt_height - 0.05), WRAP_AXES)[0],
                "bumper_rear": shell.corner(BUS_SIZES.bumper_lip, rear=True),
            }
        return out

    def _door_places(self) -> list[float]:
        """Return x of the middle of each door."""
        s = self.shape
        if not self.has_front:
            return [(self.nose + s.rear_axle_x + s.wheel_radius) / 2]
        middle = (s.front_axle_x + s.rear_axle_x) / 2
        first = s.front_axle_x + s.wheel_radius * 1.15 + 0.85
        return [first, middle, *([s.rear_axle_x - 1.6] if s.length > 11 else [])]

    def _draw_livery(self, shell: Surface, end: float) -> None:
        """Draw two tones: below the windows, or from the middle to the rear."""
        s = self.shape
        if self.style.soft:
            shell.paint(rectangle_outline(-1, end + 1, 0, s.belt_height - 0.16), WRAP_AXES, "livery")
            return
        start = s.rear_axle_x + 1.2 if self.has_front else 99.0
        sweep = [(start, 0.0), (start - 2.2, s.height + 0.2), (-99, s.height + 0.2), (-99, 0.0)]
        shell.paint(sweep, SIDE_AXES, "livery")

    def _draw_windscreen(self, shell: Surface, screen: float) -> None:
        s = self.shape
        low, high, band = s.belt_height, s.height - 0.5, s.height - 0.3
        screen -= 0.02
        shell.paint(rectangle_outline(-0.1, screen + 0.06, low - 0.13, band), WRAP_AXES, "trim")
        shell.paint(rectangle_outline(-0.1, screen, low - 0.08, high - 0.02), WRAP_AXES, "glass")
        shell.draw(rectangle_outline(-0.1, 0.75, high + 0.04, band - 0.04), WRAP_AXES, "grille")
        draw_upper_markers(shell, s.width / 2 - 0.1, s.height - 0.25)
        for at in (0.05, 0.2, 0.29, 0.42, 0.55):
            shell.draw(rectangle_outline(at, at + 0.075, high + 0.075, band - 0.075), WRAP_AXES, "display", layer=2)
        for start, stop in ((0.06, 0.75), (0.35, screen - 0.05)):
            shell.line([(start, low - 0.09), (stop, low + 0.06)], WRAP_AXES, width=0.022, layer=4)
        self.points |= {
            "roof_front": shell.place((screen + 0.06, band), WRAP_AXES)[0],
            "windscreen_base": shell.place((screen, low - 0.08), WRAP_AXES)[0],
        }

    def _draw_side_windows(self, shell: Surface) -> None:
        s = self.shape
        low, high = s.belt_height, s.height - 0.5
        start = self.nose - (0.62 if self.has_front else 0.3)
        stop = self.end + (0.5 if self.has_rear else 0.3)
        band = rectangle_outline(stop - 0.06, start + 0.06, low - 0.05, high + 0.05)
        shell.paint(band, SIDE_AXES, "trim", facing=PANEL_LIMITS.left_axis)
        posts = np.linspace(stop, start, round((start - stop) / 1.45) + 1)
        for a, b in pairwise(posts):
            shell.paint(
                rectangle_outline(a + 0.03, b - 0.03, low, high),
                SIDE_AXES,
                self._window("glass"),
                facing=PANEL_LIMITS.left_axis,
            )
        post = posts[np.abs(posts - (start + stop) / 2).argmin()]
        if self.has_front:
            self.points["beltline"] = shell.place((post, low - 0.05), SIDE_AXES)[0]

    def _draw_rear_window(self, shell: Surface, corner: float, end: float) -> None:
        s = self.shape
        low, high = s.belt_height + 0.5, s.height - 0.5
        glass = end - corner - 0.12
        shell.paint(rectangle_outline(end - glass - 0.05, end + 0.1, low - 0.05, high + 0.06), WRAP_AXES, "trim")
        shell.paint(rectangle_outline(end - glass, end + 0.1, low, high), WRAP_AXES, "glass")
        shell.draw(rectangle_outline(end - 0.16, end + 0.1, high + 0.1, high + 0.14), WRAP_AXES, "brake_light")
        edge = corner + 0.12
        shell.draw(
            rectangle_outline(edge, edge + 0.12, s.height - 0.28, s.height - 0.23), WRAP_AXES, REAR_MARKER, layer=3
        )
        vent = rectangle_outline(end - 0.8, end + 0.1, s.clearance + 0.62, s.belt_height + 0.2)
        shell.sink(vent, WRAP_AXES, 0.02, "grille_slats")
        for level in (s.clearance + 0.3, s.belt_height + 0.34):
            shell.line([(end - 0.95, level), (end + 0.1, level)], WRAP_AXES, width=0.014)
        self.points |= {
            "roof_rear": shell.place((end - glass, high), WRAP_AXES)[0],
            "rear_window_base": shell.place((end - glass, low), WRAP_AXES)[0],
        }

    def _draw_door(self, shell: Surface, x: float, width: float) -> None:
        """Draw a double-leaf glass door."""
        low, high = self.shape.clearance + 0.1, self.shape.height - 0.45
        half = width / 2
        whole = rectangle_outline(x - half, x + half, low, high)
        shell.paint(whole, SIDE_AXES, "trim", facing=PANEL_LIMITS.left_axis)
        for a, b in ((x - half, x), (x, x + half)):
            shell.paint(
                grown(rectangle_outline(a, b, low + 0.06, high - 0.04), -0.045),
                SIDE_AXES,
                self._window("glass"),
                facing=PANEL_LIMITS.left_axis,
            )


def _bellows(s: Shape, end: float, sign: float) -> Mesh:
    """Return the left half of the folds from an end of a bus half at x = `end` to beyond the hinge.

    Ahead with `sign` 1.
    """
    reach = s.hinge_gap + BUS_SIZES.bellows_overlap_m
    # The rear half's folds are inside the front half's, so that the two never coincide.
    half, low, high = s.width / 2 - (0.1 if sign > 0 else 0.05), s.clearance + 0.1, s.height - 0.14
    outline = [(0.0, low), (half, low), (half, high - 0.3), (half - 0.07, high - 0.1), (half - 0.25, high), (0.0, high)]
    section = np.array(outline)
    inwards = np.array([(0.0, 1.0), (-1.0, 1.0), (-1.0, 0.0), (-0.8, -0.6), (-0.4, -1.0), (0.0, -1.0)])
    rows = []
    for k, x in enumerate(np.linspace(end, end + sign * reach, 2 * BUS_SIZES.folds + 1)):
        flat = section + (0.05 * inwards if k % 2 else 0.0)
        rows.append(np.column_stack([np.full(len(flat), x), flat]))
    # Counter-clockwise from outside: rows go towards the front, columns up the left side.
    points = np.stack(rows[::-1] if sign < 0 else rows)
    skin = grid(points, [["trim"] * (len(section) - 1)] * (2 * BUS_SIZES.folds))
    fan = [[0, i, i + 1] for i in range(1, len(section) - 1)]
    cap = from_triangles(rows[-1], fan if sign > 0 else [corners[::-1] for corners in fan], "trim")
    return merged([_creased(skin), cap])


def _creased(mesh: Mesh) -> Mesh:
    """Return the mesh with flat triangles."""
    corners = mesh.vertices[mesh.triangles].reshape(-1, 3)
    return from_triangles(corners, np.arange(len(corners)), mesh.materials[0])
