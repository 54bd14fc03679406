"""Quadrilaterals collected by material, from which houses and street furniture are built."""

import itertools
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.mesh import Mesh, merged, quads
from skope.types import Array

BELOW_GROUND_M: Final = -0.4
"""Depth below the ground to which objects on it extend, metres (negative z)."""
TOWARDS_ROAD: Final = ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0))
"""Axes of a panel with its front towards +y."""
BOX_FACES: Final = {
    "-x": (0, 4, 6, 2),
    "+x": (1, 3, 7, 5),
    "-y": (0, 1, 5, 4),
    "+y": (3, 2, 6, 7),
    "-z": (0, 2, 3, 1),
    "+z": (4, 5, 7, 6),
}
"""Corners of a box's faces; bit 0 of a corner's number is x, bit 1 y, bit 2 z."""


class Solid:
    """Planar quadrilaterals, counter-clockwise from outside, metres, in their own right-handed frame."""

    def __init__(self) -> None:
        self._quads: dict[str, list[Array]] = {}

    def face(self, material: str, *corners: Sequence[float]) -> None:
        """Add a triangle or quadrilateral."""
        four = corners if len(corners) == 4 else (*corners, corners[-1])
        self.faces(material, np.array([four], dtype=np.float64))

    def faces(self, material: str, corners: Array) -> None:
        """Add quadrilaterals (N, 4, 3)."""
        self._quads.setdefault(material, []).append(corners)

    def pane(self, material: str, x: tuple[float, float], y: tuple[float, float], z: float) -> None:
        """Add a rectangle that faces +z."""
        self.face(material, (x[0], y[0], z), (x[1], y[0], z), (x[1], y[1], z), (x[0], y[1], z))

    def box(self, material: str, low: ArrayLike, high: ArrayLike, without: str = "") -> None:
        """Add an axis-aligned box without the faces in `without` (such as "-z +x")."""
        ends = np.array([low, high], dtype=np.float64)
        corners = np.array([[ends[i & 1, 0], ends[i >> 1 & 1, 1], ends[i >> 2, 2]] for i in range(8)])
        self.faces(material, corners[[index for name, index in BOX_FACES.items() if name not in without.split()]])

    def extrude(self, material: str, profile: Sequence[tuple[float, float]], x: tuple[float, float]) -> None:
        """Add a symmetric profile along x: half widths and heights from its open foot to its top."""
        low, high = x
        for (y0, z0), (y1, z1) in itertools.pairwise(profile):
            self.face(material, (high, y0, z0), (low, y0, z0), (low, y1, z1), (high, y1, z1))
            self.face(material, (low, -y0, z0), (high, -y0, z0), (high, -y1, z1), (low, -y1, z1))
            if z1 > z0:
                self.face(material, (low, y0, z0), (low, -y0, z0), (low, -y1, z1), (low, y1, z1))
                self.face(material, (high, -y0, z0), (high, y0, z0), (high, y1, z1), (high, -y1, z1))
        y, z = profile[-1]
        if y > 0:
            self.face(material, (low, -y, z), (high, -y, z), (high, y, z), (low, y, z))

    def recess(self, material: str, x: tuple[float, float], y: tuple[float, float], z: tuple[float, float]) -> None:
        """Add the four sides of a rectangular hole along z, visible from inside it."""
        (x0, x1), (y0, y1), (back, front) = x, y, z
        self.face(material, (x0, y0, front), (x0, y0, back), (x0, y1, back), (x0, y1, front))
        self.face(material, (x1, y0, back), (x1, y0, front), (x1, y1, front), (x1, y1, back))
        self.face(material, (x0, y0, front), (x1, y0, front), (x1, y0, back), (x0, y0, back))
        self.face(material, (x0, y1, back), (x1, y1, back), (x1, y1, front), (x0, y1, front))

    def add(self, other: "Solid", at: ArrayLike = (0.0, 0.0, 0.0)) -> None:
        """Add copies of another solid at one position (3,) or at several (N, 3)."""
        places = np.asarray(at, dtype=np.float64).reshape(-1, 1, 1, 3)
        for material, parts in other._quads.items():
            self.faces(material, (np.concatenate(parts)[None] + places).reshape(-1, 4, 3))

    def placed(self, origin: ArrayLike, axes: ArrayLike) -> "Solid":
        """Return the solid in another frame: the rows of `axes` (3, 3) are its x, y and z axes there."""
        out = Solid()
        for material, parts in self._quads.items():
            out.faces(material, np.concatenate(parts) @ np.asarray(axes, dtype=np.float64) + np.asarray(origin))
        return out

    def mesh(self) -> Mesh:
        return merged(quads(np.concatenate(parts), material) for material, parts in self._quads.items())
