"""Left halves of the solids of heavy bodies: upright shells, prisms, barrels, pipes, mudguards, ladders."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, box, flat, grid, merged, tube
from skope.gen.vehicles.lofted_surfaces import CENTER, FLOOR, INNER, SIDE_START, Plan, Surface, metres_along
from skope.gen.vehicles.shape import Shape
from skope.types import Array


@dataclass(frozen=True)
class SolidSizes:
    """Shapes of wheel arches, roof edges and barrels."""

    arch_radius_wheels: float = 1.13
    """Radius of a wheel arch, in radii of its wheel."""
    roof_edge_rows: tuple[tuple[float, float, float], ...] = ((1.3, 0.14, 0.5), (1.65, 0.45, 0.84), (2.0, 1.0, 1.0))
    """Rows of the edge between wall and roof: row, shares of its radius inwards and up."""
    barrel_intervals: int = 12
    """Intervals around half a barrel."""


SOLID_SIZES: Final = SolidSizes()

ROOF_CORNER_ROW = SOLID_SIZES.roof_edge_rows[0][0]
"""Row of the edge with a roof's corners, which is visible from both ends."""


@dataclass(frozen=True)
class Tower:
    """Shell of a bus, cab or box body: walls between the heights `low` and `high` (metres), and a roof."""

    plan: Plan
    low: float
    high: float
    lean: Sequence[tuple[float, float, float, float]] = ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    """Share of the wall's height, and the insets of side, front and rear there, metres."""
    edge: float = 0.06
    """Radius between wall and roof, metres."""
    crown: float = 0.02
    """Height of the roof's middle above its sides, metres."""
    ridge: float = 0.0
    """Distance from its ends over which the roof rises to its crown, metres; 0: it rises from the outline, which
    flat ends fold."""
    hollow: float | None = None
    """Height of the floor of an open bed, metres; None: closed."""
    wall: float = 0.05
    """Thickness of an open bed's walls, metres."""
    well: float = 9.0
    """y of the inner side of wheel wells, metres."""
    stations: int = 9
    levels: int = 4
    """Rows of the wall in addition to those of `lean`."""

    def surface(self, material: str) -> tuple[Surface, Array, Array]:
        """Return the left half, W of its columns, and the outline (columns, 2) at half height."""
        stations = np.linspace(0, 1, self.stations)
        top = self.high - self.edge - (0 if self.hollow is not None else self.crown)
        shares = np.unique(np.r_[[row[0] for row in self.lean], np.linspace(0, 1, self.levels)])
        inset = [np.interp(shares, [r[0] for r in self.lean], [r[k] for r in self.lean]) for k in (1, 2, 3)]
        walls = [self._inset_plan(*values) for values in zip(*inset, strict=True)]
        outlines = [plan.outline(stations) for plan in walls]
        bottom = outlines[0]
        rows = [
            np.column_stack([bottom[:, 0], y, 0 * y + self.low])
            for y in (0 * bottom[:, 1], np.minimum(bottom[:, 1], self.well))
        ]
        rows += [
            np.column_stack([outline, np.full(len(outline), self.low + (top - self.low) * share)])
            for outline, share in zip(outlines, shares, strict=True)
        ]
        levels = [FLOOR, INNER, *shares]
        for level, inward, up in SOLID_SIZES.roof_edge_rows:
            plan = _shrunk_plan(walls[-1], inward * self.edge)
            rows.append(np.column_stack([plan.outline(stations), np.full(len(bottom), top + up * self.edge)]))
            levels.append(level)
        edge = rows[-1]
        if self.hollow is not None:
            inner = _shrunk_plan(walls[-1], self.edge + self.wall).outline(stations)
            for level, height, share in ((2.1, self.high, 1.0), (2.2, self.hollow, 1.0), (CENTER, self.hollow, 0.0)):
                rows.append(np.column_stack([inner * [1, share], np.full(len(inner), height)]))
                levels.append(level)
        else:
            for level, share in ((2.5, 0.5), (CENTER, 0.0)):
                rise = self.crown * (1 - share**2) * (edge[:, 1] / edge[:, 1].max()) ** 1.5
                if self.ridge:
                    away = np.minimum(edge[:, 0] - edge[:, 0].min(), edge[:, 0].max() - edge[:, 0])
                    rise = self.crown * (1 - share**2) * np.clip(away / self.ridge, 0, 1)
                rows.append(edge * [1, share, 1] + np.stack([0 * rise, 0 * rise, rise], axis=-1))
                levels.append(level)
        middle = outlines[len(outlines) // 2]
        w = metres_along(middle)
        return Surface(rows, levels, w, material), w, middle

    def _inset_plan(self, side: float, front: float, rear: float) -> Plan:
        p = self.plan
        return replace(p, half_width=p.half_width - side, front=p.front - front, rear=p.rear + rear)


def _shrunk_plan(plan: Plan, inset: float) -> Plan:
    return replace(
        plan,
        half_width=plan.half_width - inset,
        front=plan.front - inset,
        rear=plan.rear + inset,
        front_radius=max(plan.front_radius - inset * 0.6, 0.01),
        rear_radius=max(plan.rear_radius - inset * 0.6, 0.01),
    )


def corner_w(w: Array, rear: bool = False) -> float:
    """Return the distance along a shell's outline to the middle of its front or rear corner, metres.

    Args:
        w: (columns,) distance of each column along the outline, metres.
        rear: Whether to use the rear corner.
    """
    middle = SIDE_START - 2
    return float(w[len(w) - 1 - middle] if rear else w[middle])


def arch(axle: float, s: Shape) -> Array:
    """Return the polygon of a wheel arch in side view, around an axle's x."""
    angle = np.linspace(0, np.pi, 12)
    radius = SOLID_SIZES.arch_radius_wheels * s.wheel_radius
    arc = np.stack([axle + radius * np.cos(angle), s.wheel_radius + radius * np.sin(angle)], axis=-1)
    return np.array([(axle + radius, -0.2), *arc, (axle - radius, -0.2)])


def prism(outline: ArrayLike, half_width: float, material: str, *, inner: float = 0.0) -> Mesh:
    """Return a prism: a convex outline (N, 2), x and z, extruded from y = `inner` to `half_width`.

    It is open in the middle if `inner` is 0.
    """
    p = np.asarray(outline, dtype=np.float64)
    if (p[:, 0] * np.roll(p[:, 1], -1) - np.roll(p[:, 0], -1) * p[:, 1]).sum() > 0:
        p = p[::-1]
    # Clockwise in x and z, which is counter-clockwise seen from the left.
    near, far = (np.column_stack([p[:, 0], np.full(len(p), y), p[:, 1]]) for y in (inner, half_width))
    ends = [far] if inner == 0 else [far, near[::-1]]
    sides = [np.array([near[i], near[j], far[j], far[i]]) for i, j in _pairs(len(p))]
    return flat([*ends, *sides], material)


def _pairs(count: int) -> list[tuple[int, int]]:
    return [(i, (i + 1) % count) for i in range(count)]


def barrel(sections: ArrayLike, materials: Sequence[str] | str, *, square: float = 2.0, sharp: bool = False) -> Mesh:
    """Return the left half of a body with superelliptic sections along x.

    Args:
        sections: (N, 4) with ascending x: x, height of the middle, half width, half height; ends without extent close
            it.
        materials: One for all, or one for each of the N - 1 parts between two sections.
        square: Exponent of the superellipse: 2 for an ellipse, more for a box with round edges.
        sharp: Whether each section is a sharp edge.
    """
    s = np.asarray(sections, dtype=np.float64)
    names = [materials] * (len(s) - 1) if isinstance(materials, str) else list(materials)
    rings = np.stack([ring(*section, square=square) for section in s])
    if not sharp:
        return grid(rings, [[name] * SOLID_SIZES.barrel_intervals for name in names])
    return merged([grid(rings[k : k + 2], [[name] * SOLID_SIZES.barrel_intervals]) for k, name in enumerate(names)])


def ring(x: float, z: float, half_width: float, half_height: float, *, square: float = 2.0) -> Array:
    """Return the left half (13, 3) of a barrel's section, from the bottom upwards."""
    turn = np.linspace(-np.pi / 2, np.pi / 2, SOLID_SIZES.barrel_intervals + 1)
    c, s = np.cos(turn).clip(0), np.sin(turn)
    up = np.sign(s) * np.abs(s) ** (2 / square)
    return np.column_stack([np.full(len(turn), x), half_width * c ** (2 / square), z + half_height * up])


def pipe(start: ArrayLike, end: ArrayLike, radius: float, material: str, *, sides: int = 8) -> Mesh:
    """Return a round bar with flat ends."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    bar = tube([a, b], (radius, radius), material, sides)
    rims = bar.vertices.reshape(2, sides + 1, 3)[:, :-1]
    return merged([bar, flat([rims[0][::-1], rims[1]], material)])


def beam(start: ArrayLike, end: ArrayLike, half_width: float, half_height: float, material: str) -> Mesh:
    """Return a bar with a rectangular section between two points in a plane of constant y."""
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    along = (b - a)[[0, 2]] / np.hypot(*(b - a)[[0, 2]])
    across = np.array([-along[1], along[0]]) * half_height
    outline = [a[[0, 2]] - across, b[[0, 2]] - across, b[[0, 2]] + across, a[[0, 2]] + across]
    low = a[1] - half_width
    return prism(outline, a[1] + half_width, material, inner=low if low > 1e-6 else 0.0)


def mudguard(
    center: tuple[float, float], radius: float, y: tuple[float, float], material: str, *, reach_deg: float = 78.0
) -> Mesh:
    """Return a curved guard over a wheel at x, z, between two y, up to `reach_deg` on either side of its top."""
    turn = np.radians(np.linspace(-reach_deg, reach_deg, 9))
    arcs = [
        np.column_stack([center[0] + r * np.sin(turn), 0 * turn, center[1] + r * np.cos(turn)])
        for r in (radius, radius + 0.03)
    ]
    inner, outer = ([arc + [0, at, 0] for at in y] for arc in arcs)
    skins = [
        grid([outer[0], outer[1]], [[material] * 8]),
        grid([inner[1], inner[0]], [[material] * 8]),
        grid([outer[1], inner[1]], [[material] * 8]),
        grid([inner[0], outer[0]], [[material] * 8]),
    ]
    ends = [[outer[0][k], outer[1][k], inner[1][k], inner[0][k]] for k in (0, -1)]
    return merged([*skins, flat([ends[0], ends[1][::-1]], material)])


def ladder(x: float, y: tuple[float, float], low: float, high: float, material: str) -> Mesh:
    """Return an upright ladder across the vehicle at x, between two y.

    If it begins at the middle, it is half a ladder.
    """
    rails = [box((x - 0.02, at - 0.02, low), (x + 0.02, at + 0.02, high), material) for at in y if at > 0]
    rungs = [
        box((x - 0.015, y[0], z), (x + 0.015, y[1], z + 0.03), material)
        for z in np.arange(low + 0.15, high - 0.05, 0.3).tolist()
    ]
    return merged([*rails, *rungs])
