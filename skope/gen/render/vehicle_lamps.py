"""The lamps of vehicles: where they are on a body, and which of them are lit."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh
from skope.gen.scene.lamps import LAMPS
from skope.gen.scene.recording import Moment
from skope.gen.scene.road_user_bodies import body_of
from skope.gen.vehicles.model import TRAILER_PART, Body
from skope.types import Array

_WHITE_LIGHT: Final = (1.0, 0.96, 0.88)
_RED: Final = (1.0, 0.06, 0.03)
_AMBER: Final = (1.0, 0.45, 0.03)
_LAMP_KINDS: Final = {
    "headlight": ("low_beam", _WHITE_LIGHT, 1.6),
    "taillight": ("low_beam", _RED, 0.3),
    "brake_light": ("brake", _RED, 0.8),
    "indicator_left": ("indicator_left", _AMBER, 0.5),
    "indicator_right": ("indicator_right", _AMBER, 0.5),
    "reverse_light": ("reverse", _WHITE_LIGHT, 0.25),
    "marker_white": ("low_beam", _WHITE_LIGHT, 0.08),
    "marker_red": ("low_beam", _RED, 0.08),
    "sign": ("low_beam", _AMBER, 0.1),
    "sign_taxi_red": ("low_beam", _RED, 0.15),
    "sign_taxi_green": ("low_beam", (0.06, 1.0, 0.3), 0.15),
}
"""Lamps by material: what lights them, their colour, their luminous intensity straight ahead."""
_MIDDLE_WITHIN_M: Final = 0.12
"""Lamps nearer to the vehicle's middle than this count as one, metres."""


@dataclass(frozen=True, eq=False)
class Lamp:
    material: str
    center: Array
    """(3,) in the frame of its part, the vehicle's or its trailer's."""
    facing: Array
    """(3,) unit."""
    part: int = 0
    """Index of its part, see `Body.parts`."""


@dataclass(frozen=True, eq=False)
class Lit:
    """A lamp that is lit, in the world."""

    index: int
    """Index of its vehicle in the frame."""
    center: Array
    facing: Array
    color: tuple[float, float, float]
    intensity: float


@lru_cache(maxsize=512)
def lamps_of(body: Body) -> tuple[Lamp, ...]:
    """The lamps of a body and its trailer."""
    trailer = tuple(_lamps_of(body.trailer.mesh, TRAILER_PART)) if body.trailer else ()
    return (*_lamps_of(body.mesh, 0), *trailer)


def _lamps_of(mesh: Mesh, part_index: int) -> Iterator[Lamp]:
    """The lamps of a mesh: its triangles of a lamp's material at one end and on one side."""
    for material, part in mesh.by_material().items():
        if material not in _LAMP_KINDS:
            continue
        corners = part.vertices[part.triangles]
        middle = corners.mean(axis=1)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        end = np.sign(middle[:, 0])
        side = np.where(np.abs(middle[:, 1]) < _MIDDLE_WITHIN_M, 0.0, np.sign(middle[:, 1]))
        for where in sorted({(a, b) for a, b in zip(end.tolist(), side.tolist(), strict=True)}):
            chosen = (end == where[0]) & (side == where[1])
            area = np.linalg.norm(normal[chosen], axis=1)
            facing = normal[chosen].sum(axis=0)
            if area.sum() > 0 and np.linalg.norm(facing) > 0:
                center = (middle[chosen] * area[:, None]).sum(axis=0) / area.sum()
                yield Lamp(material, center, facing / np.linalg.norm(facing), part_index)


def has_headlights(body: Body) -> bool:
    return any(lamp.material == "headlight" for lamp in lamps_of(body))


def lit_lamps(moment: Moment) -> Iterator[Lit]:
    """All lamps that are lit at a moment."""
    for i, (recorded, bits) in enumerate(zip(moment.vehicles, moment.lamps.tolist(), strict=True)):
        if not bits:
            continue
        T_world_parts = moment.part_poses(i)
        for lamp in lamps_of(body_of(recorded)):
            T = T_world_parts[lamp.part]
            name, color, intensity = _LAMP_KINDS[lamp.material]
            if bits & LAMPS[name]:
                yield Lit(i, T[:3, :3] @ lamp.center + T[:3, 3], T[:3, :3] @ lamp.facing, color, intensity)
