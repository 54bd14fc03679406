"""Road users beside the vehicles: people on foot, on bicycles and on motorcycles.

Each is a body with four moving parts, as a vehicle has four wheels. They hide vehicles, and a detector must not take
them for one; some datasets label them, in categories of their own.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from skope.gen.bystanders.people import Look, pedestrian, strides
from skope.gen.bystanders.riders import cyclist, motorcyclist, pedalled, rolled
from skope.gen.mesh import Mesh
from skope.gen.vehicles.model import simplified_parts
from skope.types import Array

_FIGURES: Final[dict[str, tuple[Callable[[Look], tuple[Mesh, ...]], Callable[[Look, float], Array]]]] = {
    "pedestrian": (pedestrian, strides),
    "cyclist": (cyclist, pedalled),
    "motorcyclist": (motorcyclist, rolled),
}
KINDS: Final = tuple(_FIGURES)
CATEGORY_OF: Final = {"pedestrian": "pedestrian", "cyclist": "bicycle", "motorcyclist": "motorcycle"}
"""The category (of `skope.schema.CATEGORIES`) of each kind."""


@dataclass(frozen=True, eq=False)
class Bystander:
    """The body of a pedestrian, cyclist or motorcyclist."""

    kind: str
    """One of `KINDS`."""
    look: Look
    parts: tuple[Mesh, ...]
    """Body, then four parts that move: limbs or wheels, each about its own origin."""

    @property
    def mesh(self) -> Mesh:
        return self.parts[0]

    @property
    def interior(self) -> None:
        return None

    @property
    def trailer(self) -> None:
        return None

    @cached_property
    def coarse(self) -> tuple[Mesh, ...]:
        """The parts for pictures from afar."""
        return simplified_parts(self.parts)

    def pose(self, travelled: float) -> Array:
        """(4, 4, 4) poses of the moving parts in the body's frame, after `travelled` metres."""
        return _FIGURES[self.kind][1](self.look, travelled)

    @cached_property
    def box(self) -> Array:
        """(2, 3) lowest and highest corner of the box around it at rest, with what is ridden, in the body's frame."""
        at_rest = zip(self.parts, [np.eye(4), *self.pose(0.0)], strict=True)
        points = np.concatenate([mesh.vertices @ T[:3, :3].T + T[:3, 3] for mesh, T in at_rest])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def extent(self) -> Array:
        """(2, 3) corners of a box around it, however its parts move."""
        return self.box + [[-0.4, -0.1, -0.1], [0.4, 0.1, 0.05]]

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        low, high = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        return float(high[0] - low[0]), float(high[1] - low[1]), float(high[2])


@lru_cache(maxsize=256)
def _build(kind: str, shape: tuple[tuple[str, float], ...]) -> Bystander:
    look = Look(**dict(shape))
    return Bystander(kind, look, tuple(_FIGURES[kind][0](look)))


def build(kind: str, shape: Mapping[str, float]) -> Bystander:
    """The bystander of a kind with a look's numbers (see `Look`); equal ones are built once."""
    return _build(kind, tuple(sorted(shape.items())))
