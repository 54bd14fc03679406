"""Upright shells with rounded corners and edges: bus bodies, cabs over the engine, cargo boxes and beds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from skope.gen.vehicles.lofted_surfaces import CENTER, FLOOR, INNER, SIDE_START, Plan, Surface, metres_along
from skope.gen.vehicles.shape import Shape
from skope.types import Array

ARCH_RADIUS_WHEELS = 1.13
"""Radius of a wheel arch, in radii of its wheel."""
_ROOF_EDGE_ROWS = ((1.3, 0.14, 0.5), (1.65, 0.45, 0.84), (2.0, 1.0, 1.0))
"""Rows of the edge between wall and roof: shares of its radius inwards and up."""
ROOF_CORNER_ROW = _ROOF_EDGE_ROWS[0][0]
"""Row of the edge where a roof's corners are marked: visible from both ends."""


@dataclass(frozen=True)
class Tower:
    """An upright shell from `low` to `high`, metres."""

    plan: Plan
    low: float
    high: float
    lean: Sequence[tuple[float, float, float, float]] = ((0.0, 0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    """Share of the wall's height, and how far side, front and rear stand in there."""
    edge: float = 0.06
    """Radius between wall and roof."""
    crown: float = 0.02
    """Height of the roof's middle over its sides."""
    ridge: float = 0.0
    """Distance from its ends within which the roof rises to its crown; 0: from the outline, which flat ends fold."""
    hollow: float | None = None
    """Height of the floor, of an open bed."""
    wall: float = 0.05
    """Thickness of an open bed's walls."""
    well: float = 9.0
    """y of the inner side of wheel wells."""
    stations: int = 9
    levels: int = 4
    """Rows of the wall besides those of `lean`."""

    def surface(self, material: str) -> tuple[Surface, Array, Array]:
        """The left half; W of its columns; the outline (columns, 2) half way up."""
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
        for level, inward, up in _ROOF_EDGE_ROWS:
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
    """W in the middle of the front's or the rear's corner."""
    middle = SIDE_START - 2
    return float(w[len(w) - 1 - middle] if rear else w[middle])


def arch(axle: float, s: Shape) -> Array:
    """The polygon of a wheel arch seen from the side, around an axle's x."""
    angle = np.linspace(0, np.pi, 12)
    radius = ARCH_RADIUS_WHEELS * s.wheel_radius
    arc = np.stack([axle + radius * np.cos(angle), s.wheel_radius + radius * np.sin(angle)], axis=-1)
    return np.array([(axle + radius, -0.2), *arc, (axle - radius, -0.2)])
