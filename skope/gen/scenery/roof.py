"""Roofs of houses: x along the ridge, z up, at a given height of the eaves; chimneys, dormers, gutters."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.gen.scenery.quads import Solid


@dataclass(frozen=True)
class RoofSizes:
    """Sizes of roofs."""

    overhang_m: float = 0.35
    """Overhang of the eaves beyond the walls, metres."""
    thickness_m: float = 0.14
    """Thickness of a roof, metres."""


ROOF_SIZES: Final = RoofSizes()


def gabled(half: tuple[float, float], eaves: float, rise: float, verge: float, material: str, walls: str) -> Solid:
    """Return a roof of two slopes over a house of `half` its length and depth.

    `rise` is the ridge's height above the eaves.
    """
    x, y = half
    pitch = rise / y
    out = Solid()
    for side in (1.0, -1.0):
        low, top = (side * (y + ROOF_SIZES.overhang_m), eaves - ROOF_SIZES.overhang_m * pitch), (0.0, eaves + rise)
        ends = (x + verge) * np.array([-1.0, 1.0]) * -side
        upper = [(ends[0], *low), (ends[1], *low), (ends[1], *top), (ends[0], *top)]
        upper_z = [(px, py, pz + ROOF_SIZES.thickness_m) for px, py, pz in upper]
        out.face(material, *upper_z)
        out.face("frame", *upper[::-1])
        out.face("frame", upper[0], upper[1], upper_z[1], upper_z[0])
        out.face("frame", upper[1], upper[2], upper_z[2], upper_z[1])
        out.face("frame", upper[3], upper[0], upper_z[0], upper_z[3])
    for sign in (1.0, -1.0):
        out.face(walls, (sign * x, -sign * y, eaves), (sign * x, sign * y, eaves), (sign * x, 0.0, eaves + rise))
    out.box(
        material,
        (-x - verge, -0.12, eaves + rise + 0.04),
        (x + verge, 0.12, eaves + rise + ROOF_SIZES.thickness_m + 0.06),
    )
    return out


def hipped(half: tuple[float, float], eaves: float, rise: float, material: str) -> Solid:
    """Return a roof that slopes to all four sides."""
    x, y = half[0] + ROOF_SIZES.overhang_m, half[1] + ROOF_SIZES.overhang_m
    low, top = eaves - 0.05, eaves + rise
    ridge = max(x - y, 0.3)
    a, b, c, d = (-x, -y, low), (x, -y, low), (x, y, low), (-x, y, low)
    e, f = (-ridge, 0.0, top), (ridge, 0.0, top)
    out = Solid()
    out.face(material, a, b, f, e)
    out.face(material, c, d, e, f)
    out.face(material, b, c, f)
    out.face(material, d, a, e)
    out.box("frame", (-x, -y, low - 0.16), (x, y, low), without="+z")
    return out


def flat_roof(half: tuple[float, float], eaves: float, parapet: float, walls: str, dressing: str) -> Solid:
    """Return a flat roof behind a parapet, with a plant room."""
    x, y = half
    t = 0.25
    out = Solid()
    out.pane("felt", (-x, x), (-y, y), eaves)
    top = eaves + parapet
    for low, high in (
        ((-x, y - t), (x, y)),
        ((-x, -y), (x, -y + t)),
        ((-x, -y + t), (-x + t, y - t)),
        ((x - t, -y + t), (x, y - t)),
    ):
        out.box(walls, (*low, eaves), (*high, top), without="-z +z")
        grow = 0.05
        out.box(dressing, (low[0] - grow, low[1] - grow, top), (high[0] + grow, high[1] + grow, top + 0.08))
    out.box("zinc", (-0.3 * x, -0.4 * y, eaves), (0.2 * x, 0.3 * y, eaves + 1.9), without="-z")
    for k in range(3):
        px = (0.35 + 0.2 * k) * x
        out.box("zinc", (px, -0.3 * y, eaves), (px + 0.8, -0.3 * y + 0.7, eaves + 0.7), without="-z")
    return out


def chimney(x: float, y: float, low: float, high: float, walls: str) -> Solid:
    out = Solid()
    out.box(walls, (x - 0.42, y - 0.28, low), (x + 0.42, y + 0.28, high), without="-z")
    out.box("dressing", (x - 0.48, y - 0.34, high - 0.12), (x + 0.48, y + 0.34, high + 0.02))
    for k in (-0.2, 0.2):
        out.box("tiles", (x + k - 0.1, y - 0.1, high + 0.02), (x + k + 0.1, y + 0.1, high + 0.4), without="-z")
        out.box("iron", (x + k - 0.07, y - 0.07, high + 0.4), (x + k + 0.07, y + 0.07, high + 0.41), without="-z")
    return out


def dormer(x: float, front: float, low: float, pitch: float, roof: str, frame: str) -> Solid:
    """Return a window under a small gable on the slope towards +y.

    Its face is at y = `front`, where the slope is at `low`.
    """
    w, h, rise = 0.75, 1.25, 0.5
    back = front - (h + rise) / pitch
    out = Solid()
    face = Solid()
    face.pane("window", (-0.5, 0.5), (0.2, h - 0.1), 0.02)
    face.pane(frame, (-0.5, -0.44), (0.2, h - 0.1), 0.04)
    face.pane(frame, (0.44, 0.5), (0.2, h - 0.1), 0.04)
    face.pane(frame, (-0.03, 0.03), (0.2, h - 0.1), 0.04)
    face.pane(frame, (-0.44, 0.44), (0.7, 0.75), 0.035)
    face.pane(frame, (-w, w), (0.0, h), 0.0)
    face.face(frame, (-w, h, 0.0), (w, h, 0.0), (0.0, h + rise, 0.0))
    out.add(face.placed((x, front, low), [(-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)]))
    eave, slope_back = low + h, front - h / pitch
    for s in (1.0, -1.0):
        cheek = [(x + s * w, front, low), (x + s * w, slope_back, eave), (x + s * w, front, eave)]
        out.face(roof, *(cheek if s < 0 else cheek[::-1]))
        o = 0.12
        edge = (x + s * (w + o), eave - o * rise / w)
        slope = [
            (edge[0], front + o, edge[1] + 0.03),
            (edge[0], slope_back, edge[1] + 0.03),
            (x, back, low + h + rise + 0.03),
            (x, front + o, low + h + rise + 0.03),
        ]
        out.face(roof, *(slope if s < 0 else slope[::-1]))
        out.face("frame", *(slope[::-1] if s < 0 else slope))
    return out


def roof_window(x: float, y: float, height: float, pitch: float) -> Solid:
    """Return a window in the slope towards +y, with its middle at `height`."""
    tilt = np.arctan(pitch)
    c, s = np.cos(tilt), np.sin(tilt)
    part = Solid()
    part.box("frame_dark", (-0.45, -0.6, 0.0), (0.45, 0.6, 0.06), without="-z")
    part.pane("window", (-0.37, 0.37), (-0.52, 0.52), 0.065)
    return part.placed((x, y, height), [(-1.0, 0.0, 0.0), (0.0, -c, s), (0.0, s, c)])


def gutters(half: tuple[float, float], eaves: float) -> Solid:
    """Return a gutter along each eave and a downpipe at its end."""
    x, y = half
    out = Solid()
    for side in (1.0, -1.0):
        a, b = sorted((side * (y + ROOF_SIZES.overhang_m), side * (y + ROOF_SIZES.overhang_m + 0.12)))
        out.box("zinc", (-x - 0.2, a, eaves - 0.3), (x + 0.2, b, eaves - 0.19))
        a, b = sorted((side * (y + 0.02), side * (y + 0.1)))
        end = side * (x - 0.15)
        out.box("zinc", (end - 0.04, a, 0.0), (end + 0.04, b, eaves - 0.2), without="-z")
        a, b = sorted((side * (y + 0.02), side * (y + ROOF_SIZES.overhang_m + 0.06)))
        out.box("zinc", (end - 0.04, a, eaves - 0.3), (end + 0.04, b, eaves - 0.22))
    return out
