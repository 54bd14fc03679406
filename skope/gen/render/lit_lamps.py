"""Lit lamps of traffic lights, streets and vehicles.

The module draws traffic lights over a rendered image, selects the street lights that burn if only a share of them does,
and locates the lamps of vehicles.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.gen.mesh import Mesh
from skope.gen.scene.recording import LAMP_BITS, Moment, body_of
from skope.gen.scenery.build import Signal
from skope.gen.vehicles.model import MODEL_PARTS, Body
from skope.pictures.draw import DRAWING_STYLE
from skope.types import Array

_LAMP_OF_STATE: Final = {"r": 0, "u": 0, "y": 1, "g": 2, "s": 2}
"""The lamp that each SUMO state lights; other states light none."""


@dataclass(frozen=True)
class LampColors:
    """Colours and sizes of lit lamps, and common failures of street lights."""

    signal_colors: tuple[tuple[int, int, int], ...] = ((235, 40, 30), (250, 190, 40), (40, 220, 110))
    """Colours of traffic signals: red, amber, green (RGB)."""
    radius_m: float = 0.1
    """Radius of a lamp, metres."""
    cable_m: float = 55.0
    """Size of the areas in which street lights share a cable, so that they mostly fail together, metres."""
    cable_share: float = 0.65
    """Share of the cable in a lamp's chance of failure."""
    white: tuple[float, float, float] = (1.0, 0.96, 0.88)
    """Colour of white lamps."""
    red: tuple[float, float, float] = (1.0, 0.06, 0.03)
    """Colour of red lamps."""
    amber: tuple[float, float, float] = (1.0, 0.45, 0.03)
    """Colour of amber lamps."""
    middle_within_m: float = 0.12
    """Lamps within this distance of the vehicle's middle count as one, metres."""


LAMP_COLORS: Final = LampColors()


def lit_signals(
    camera: Camera, moment: Moment, signals: tuple[Signal, ...]
) -> Iterator[tuple[Array, Array, tuple[float, float, float]]]:
    """Yield position, direction and colour of the lit signal lamps that face the camera."""
    for signal, lamp in _lit_heads(camera, moment, signals):
        red, green, blue = ((value / 255) ** 2.2 for value in LAMP_COLORS.signal_colors[lamp])
        yield signal.lamps[lamp], signal.facing, (red, green, blue)


def _lit_heads(camera: Camera, moment: Moment, signals: tuple[Signal, ...]) -> Iterator[tuple[Signal, int]]:
    """Yield the signal heads that face the camera, with their lit lamp."""
    for signal in signals:
        lamp = _LAMP_OF_STATE.get(moment.signals[signal.program][signal.link].lower())
        if lamp is not None and (camera.position - signal.lamps[0]) @ signal.facing > 0:
            yield signal, lamp


def light_signals(
    rgb: NDArray[np.uint8],
    depth: NDArray[np.floating[Any]],
    camera: Camera,
    moment: Moment,
    signals: tuple[Signal, ...],
    fine: int = 1,
) -> None:
    """Draw the signal lamps that are lit, face the camera and are not hidden.

    Args:
        rgb: (H * fine, W * fine, 3), changed in place.
        depth: (H, W) metres.
        camera: The image's camera.
        moment: The moment to draw.
        signals: The town's traffic lights.
        fine: Pixels of `rgb` per pixel of `depth`, on each axis.
    """
    for signal, lamp in _lit_heads(camera, moment, signals):
        pixel, z, valid = camera.project(signal.lamps[lamp])
        if not valid or not camera.inside(pixel):
            continue
        at = pixel * fine
        if z < depth[int(at[1]), int(at[0])] + 0.3:
            radius = max(0.7, LAMP_COLORS.radius_m * camera.K[0, 0] / z * fine)
            center = np.rint((at - 0.5) * 2**DRAWING_STYLE.subpixel_bits).astype(int).tolist()
            cv2.circle(
                rgb,
                center,
                round(radius * 2**DRAWING_STYLE.subpixel_bits),
                LAMP_COLORS.signal_colors[lamp],
                -1,
                cv2.LINE_AA,
                DRAWING_STYLE.subpixel_bits,
            )


def light_signals_linear(
    light: NDArray[np.float32],
    depth: NDArray[np.floating[Any]],
    camera: Camera,
    moment: Moment,
    signals: tuple[Signal, ...],
    radiance: float,
) -> None:
    """Draw the signal lamps into linear light (H, W, 4), in place; `radiance` is the value of the brightest channel."""
    if not signals:
        return
    shown = np.zeros((*light.shape[:2], 3), dtype=np.uint8)
    light_signals(shown, depth, camera, moment, signals)
    rows, columns = np.nonzero(shown.any(axis=-1))
    light[rows, columns, :3] += radiance * (shown[rows, columns] / np.float32(255)) ** 2.2


def burning_street_lights(lamps: Array, share: float) -> Array:
    """Return the street lights (N, 5) that burn if `share` of them (0 to 1) do; the same lights at every call.

    Lights that do not burn are mostly neighbours, so that the road between them is dark.
    """
    if share >= 1:
        return lamps
    luck = LAMP_COLORS.cable_share * _hashed(np.floor(lamps[:, :2] / LAMP_COLORS.cable_m)) + (
        1 - LAMP_COLORS.cable_share
    ) * _hashed(lamps[:, :2])
    first = luck.argsort(kind="stable")[: round(share * len(lamps))]
    return lamps[np.sort(first)]


def _hashed(at: Array) -> Array:
    """Return pseudo-random numbers (N,) in 0..1 that depend on positions (N, 2)."""
    return np.asarray(np.abs(np.sin(at @ [12.9898, 78.233]) * 43758.5453) % 1.0)


_LAMP_KINDS: Final = {
    "headlight": ("low_beam", LAMP_COLORS.white, 1.6),
    "taillight": ("low_beam", LAMP_COLORS.red, 0.3),
    "brake_light": ("brake", LAMP_COLORS.red, 0.8),
    "indicator_left": ("indicator_left", LAMP_COLORS.amber, 0.5),
    "indicator_right": ("indicator_right", LAMP_COLORS.amber, 0.5),
    "reverse_light": ("reverse", LAMP_COLORS.white, 0.25),
    "marker_white": ("low_beam", LAMP_COLORS.white, 0.08),
    "marker_red": ("low_beam", LAMP_COLORS.red, 0.08),
    "sign": ("low_beam", LAMP_COLORS.amber, 0.1),
    "sign_taxi_red": ("low_beam", LAMP_COLORS.red, 0.15),
    "sign_taxi_green": ("low_beam", (0.06, 1.0, 0.3), 0.15),
}
"""Lamps by material: the switch that lights them, their colour, their luminous intensity straight ahead."""


@dataclass(frozen=True, eq=False)
class Lamp:
    material: str
    center: Array
    """(3,) position in the frame of its part, which is the vehicle or its trailer."""
    facing: Array
    """(3,) unit vector of the lamp's direction."""
    part: int = 0
    """Index of its part, see `Body.parts`."""


@dataclass(frozen=True, eq=False)
class Lit:
    """Lit lamp in the world."""

    index: int
    """Index of its vehicle in the frame."""
    center: Array
    facing: Array
    color: tuple[float, float, float]
    intensity: float


@lru_cache(maxsize=512)
def lamps_of(body: Body) -> tuple[Lamp, ...]:
    """Return the lamps of a body and its trailer."""
    trailer = tuple(_lamps_of(body.trailer.mesh, MODEL_PARTS.trailer_part)) if body.trailer else ()
    return (*_lamps_of(body.mesh, 0), *trailer)


def _lamps_of(mesh: Mesh, part_index: int) -> Iterator[Lamp]:
    """Yield the lamps of a mesh: its triangles of one lamp material at one end and on one side."""
    for material, part in mesh.by_material().items():
        if material not in _LAMP_KINDS:
            continue
        corners = part.vertices[part.triangles]
        middle = corners.mean(axis=1)
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        end = np.sign(middle[:, 0])
        side = np.where(np.abs(middle[:, 1]) < LAMP_COLORS.middle_within_m, 0.0, np.sign(middle[:, 1]))
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
    """Yield all lamps that are lit at a moment."""
    for i, (recorded, bits) in enumerate(zip(moment.vehicles, moment.lamps.tolist(), strict=True)):
        if not bits:
            continue
        T_world_parts = moment.part_poses(i)
        for lamp in lamps_of(body_of(recorded)):
            T = T_world_parts[lamp.part]
            name, color, intensity = _LAMP_KINDS[lamp.material]
            if bits & LAMP_BITS[name]:
                yield Lit(i, T[:3, :3] @ lamp.center + T[:3, 3], T[:3, :3] @ lamp.facing, color, intensity)
