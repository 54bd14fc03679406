"""Bystanders, the road users other than vehicles: pedestrians, cyclists and motorcyclists.

A bystander is a body with four moving parts (as a vehicle has four wheels), or with up to seven if it is jointed.
Bystanders hide vehicles, and a detector must not confuse them with vehicles. Some datasets label them in their own
categories.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from skope.gen.bystanders.luggage import LUGGAGE_KINDS
from skope.gen.bystanders.people import Look, pedestrian, strides
from skope.gen.bystanders.riders import cyclist, motorcyclist, pedalled, rolled
from skope.gen.bystanders.riding import MACHINE_NAMES, bicycle, motorcycle, pedalling, riding
from skope.gen.bystanders.walking import walked, walker
from skope.gen.mesh import Mesh
from skope.gen.vehicles.model import simplified_parts
from skope.types import Array


@dataclass(frozen=True)
class BystanderShares:
    """Fractions of people with umbrellas and helmets, and the speed of riding."""

    riding_mps: float = 5.0
    """Speed of the riding pose that is used for bodies at rest, m/s; riders have both feet off the road at it."""
    umbrellas: float = 0.45
    """Fraction of pedestrians with an umbrella in rain."""
    helmets: float = 0.55
    """Fraction of cyclists with a helmet."""


BYSTANDER_SHARES: Final = BystanderShares()

FIGURE_MAKERS: Final[dict[str, tuple[Callable[[Look], tuple[Mesh, ...]], Callable[[Look, float], Array]]]] = {
    "pedestrian": (pedestrian, strides),
    "cyclist": (cyclist, pedalled),
    "motorcyclist": (motorcyclist, rolled),
}
JOINTED_MAKERS: Final[dict[str, tuple[Callable[[Look], tuple[Mesh, ...]], Callable[[Look, float, float], Array]]]] = {
    "pedestrian": (walker, walked),
    "cyclist": (bicycle, pedalling),
    "motorcyclist": (motorcycle, riding),
}
BYSTANDER_KINDS: Final = tuple(FIGURE_MAKERS)
CATEGORY_OF: Final = {"pedestrian": "pedestrian", "cyclist": "bicycle", "motorcyclist": "motorcycle"}
"""Category (of `skope.schema.CATEGORY_NAMES`) of each kind of bystander."""


@dataclass(frozen=True, eq=False)
class Bystander:
    """Body of a pedestrian, cyclist or motorcyclist."""

    kind: str
    """Kind of bystander, one of `BYSTANDER_KINDS`."""
    look: Look
    parts: tuple[Mesh, ...]
    """Body, then four moving parts (limbs or wheels), or up to seven if jointed; each moves about its own origin."""

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
        """Simplified parts for distant views."""
        return simplified_parts(self.parts)

    @property
    def jointed(self) -> bool:
        """Whether the knees bend. They bend if the body is labelled."""
        return self.look.jointed > 0.5

    def pose(self, travelled: float, speed: float = BYSTANDER_SHARES.riding_mps) -> Array:
        """Return the poses (P, 4, 4) of the moving parts in the body's frame after `travelled` metres at a speed
        (m/s)."""
        if self.jointed:
            return JOINTED_MAKERS[self.kind][1](self.look, travelled, speed)
        return FIGURE_MAKERS[self.kind][1](self.look, travelled)

    @property
    def _at_rest(self) -> Array:
        """Poses (P, 4, 4) of the moving parts of a person who stands, or sits on a two-wheeler."""
        return self.pose(0.0, 0.0 if self.kind == "pedestrian" else BYSTANDER_SHARES.riding_mps)

    @cached_property
    def box(self) -> Array:
        """(2, 3) lowest and highest corner of the box around the body at rest with any two-wheeler, in its frame."""
        at_rest = zip(self.parts, [np.eye(4), *self._at_rest], strict=True)
        points = np.concatenate([mesh.vertices @ T[:3, :3].T + T[:3, 3] for mesh, T in at_rest])
        return np.stack([points.min(axis=0), points.max(axis=0)])

    @property
    def extent(self) -> Array:
        """(2, 3) corners of a box that contains the body in every pose of its parts."""
        along, aside = (0.65, 0.3) if self.jointed else (0.4, 0.1)
        return self.box + [[-along, -aside, -0.1], [along, aside, 0.05]]

    @property
    def size_lwh(self) -> tuple[float, float, float]:
        if self.jointed:  # centred on the origin, as callers expect, including anything that is pulled or pushed
            length, width, _ = 2 * np.abs(self.box).max(axis=0)
            return float(length), float(width), float(self.box[1, 2])
        low, high = self.mesh.vertices.min(axis=0), self.mesh.vertices.max(axis=0)
        return float(high[0] - low[0]), float(high[1] - low[1]), float(high[2])


@lru_cache(maxsize=256)
def _build(kind: str, shape: tuple[tuple[str, float], ...]) -> Bystander:
    look = Look(**dict(shape))
    figures = JOINTED_MAKERS if look.jointed > 0.5 else FIGURE_MAKERS
    return Bystander(kind, look, tuple(figures[kind][0](look)))


def build_bystander(kind: str, shape: Mapping[str, float]) -> Bystander:
    """Return the bystander of a kind with the numbers of its appearance (see `Look`); equal ones are built once."""
    return _build(kind, tuple(sorted(shape.items())))


_MACHINE_SHARES: Final = {"cyclist": (0.75, 0.25), "motorcyclist": (0.40, 0.38, 0.22)}
_LOAD_SHARES: Final[Mapping[str, Mapping[str, float]]] = {
    "pedestrian": {"backpack": 0.22, "shopping bag": 0.16, "suitcase": 0.04, "pushchair": 0.05},
    "cyclist": {"backpack": 0.20, "panniers": 0.10, "basket": 0.08, "delivery box": 0.10, "trailer": 0.04},
    "motorcyclist": {"backpack": 0.12, "panniers": 0.10, "delivery box": 0.14, "top case": 0.16},
}
PASSENGER_SHARES: Final = {"cyclist": 0.06, "motorcyclist": 0.18}
_LEAST_RIDER_M: Final = {"cyclist": 1.25, "motorcyclist": 1.55}
"""Minimum height of riders by kind, metres."""


def draw_look(kind: str, rng: np.random.Generator, *, raining: bool = False) -> Look:
    """Sample the appearance of a jointed body of a kind in `skope.gen.bystanders.bystander.BYSTANDER_KINDS`."""
    look = replace(Look.drawn(rng), bag=0.0, palette=float(rng.integers(2**40)), jointed=1.0)
    shares = dict(_LOAD_SHARES[kind])
    if kind == "pedestrian" and raining:
        shares["umbrella"] = BYSTANDER_SHARES.umbrellas
    names, p = list(shares), np.array(list(shares.values()))
    k = int(np.searchsorted(np.cumsum(p), rng.random()))
    load = LUGGAGE_KINDS.index(names[k]) if k < len(names) else 0
    helmet, second = rng.random() < BYSTANDER_SHARES.helmets, rng.random() < PASSENGER_SHARES.get(kind, 0.0)
    machine = int(rng.choice(len(_MACHINE_SHARES[kind]), p=_MACHINE_SHARES[kind])) if kind in MACHINE_NAMES else 0
    if kind == "cyclist" and MACHINE_NAMES[kind][machine] == "racing bicycle":
        # Racing bicycles have no child seat and no bags.
        second, load = False, load if LUGGAGE_KINDS[load] == "backpack" else 0
    if kind == "motorcyclist" and second and LUGGAGE_KINDS[load] == "delivery box":
        load = 0  # the passenger sits there
    return replace(
        look,
        height=max(look.height, _LEAST_RIDER_M.get(kind, 0.0)),
        load=float(load),
        helmet=float(helmet and kind == "cyclist"),
        passenger=float(second and look.height > 1.5),
        machine=float(machine),
    )
