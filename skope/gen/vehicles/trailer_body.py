"""Trailers: box, curtain, container or tank behind a kingpin or at a drawbar, and the rear half of a bus."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box, grid, merged, tube
from skope.gen.vehicles import parts
from skope.gen.vehicles.bus import BusBody
from skope.gen.vehicles.lorry_parts import axle, cargo_body, side_guard, underrun_bar
from skope.gen.vehicles.panels import Points
from skope.gen.vehicles.shape import Shape, VehicleStyle
from skope.types import Array


@dataclass(frozen=True)
class TrailerSizes:
    """Sizes of trailers."""

    frame_depth_m: float = 0.42
    """Depth of a trailer's frame under its floor, metres."""
    neck_m: float = 0.13
    """Depth of a semi-trailer's frame above the tractor, metres."""
    landing_gear_m: float = 2.5
    """Distance of a semi-trailer's landing gear behind the kingpin, metres."""
    strap_m: float = 0.62
    """Distance between a curtain's straps, metres."""
    corrugation_m: float = 0.278
    """Distance between a container's corrugations, metres."""
    dome_m: float = 0.34
    """Depth of a tank's ends, metres."""
    dome_rings: tuple[tuple[float, float], ...] = (
        (0.0, 0.0),
        (0.3, 0.05),
        (0.55, 0.16),
        (0.78, 0.37),
        (0.93, 0.64),
        (1.0, 1.0),
    )
    """Ends of a tank, from the tip: size of the cross-section and distance from the tip, as shares."""
    dome_normals: tuple[tuple[float, float], ...] = (
        (1.0, 0.0),
        (0.95, 0.3),
        (0.85, 0.53),
        (0.65, 0.76),
        (0.37, 0.93),
        (0.0, 1.0),
    )
    """Normals of a tank's ends at these sections: components along the tank and outwards."""


TRAILER_SIZES: Final = TrailerSizes()


class TrailerBody:
    """Surfaces of a trailer, in its own frame.

    `mesh` is the body without the wheels of its rearmost axle; `points` are the left keypoints. The trailer is built
    with its middle at x = 0, as vehicles are, and then moved behind the hinge.
    """

    def __init__(self, shape: Shape, style: VehicleStyle) -> None:
        length = shape.trailer_length
        self.shape = replace(shape, length=length, height=shape.trailer_height, box_height=shape.trailer_floor)
        self.style = style
        self._offset = shape.trailer_front - length / 2
        self._parts: list[Mesh] = []
        self._points: Points = {}
        self._bus: BusBody | None = None
        if style.trailer == "bus":
            overhang = length / 2 + self._offset + shape.trailer_axle
            bus_shape = replace(self.shape, front_overhang=overhang, wheelbase=0.0, hinge_gap=-shape.trailer_front)
            self._bus = BusBody(bus_shape, style, rear_half=True)
            self._points = self._bus.points
            return
        self._build_frame()
        if style.trailer == "tank":
            self._build_tank()
        else:
            self._build_cargo()

    @cached_property
    def mesh(self) -> Mesh:
        if self._bus:
            return self._bus.mesh.moved([self._offset, 0.0, 0.0])
        left = merged(self._parts)
        return merged([left, left.mirrored()]).moved([self._offset, 0.0, 0.0])

    @property
    def interior(self) -> Mesh | None:
        """Seats if there are windows, else None."""
        return self._bus.interior.moved([self._offset, 0.0, 0.0]) if self._bus else None

    @property
    def points(self) -> Points:
        return {stem: point + [self._offset, 0.0, 0.0] for stem, point in self._points.items()}

    def _build_frame(self) -> None:
        """Build rails, axles, guards, the support under the front, and the rear bumper with its lamps."""
        s, add = self.shape, self._parts.append
        front, end, hinge, floor = s.length / 2, -s.length / 2, -self._offset, s.box_height
        rearmost = hinge - s.trailer_axle
        axles = [rearmost, *(rearmost + ahead for ahead in self.style.trailer_axles)]
        for x in axles:
            self._parts += axle(s, x, wheel=x != rearmost, dual=False)
        ahead = max(axles) + s.wheel_radius + 0.15
        side = s.width / 2 - 0.06
        if s.trailer_front < 0:
            low = floor - 0.3
            add(box((end + 0.06, 0.0, low), (front - 0.05, 0.45, floor + 0.01), "under"))
            self._parts += _drawbar(front, hinge, s.hinge_height)
            guard = front - 0.1
        else:
            gear = hinge - TRAILER_SIZES.landing_gear_m
            add(box((end + 0.06, 0.0, floor - TRAILER_SIZES.frame_depth_m), (gear - 0.3, 0.45, floor + 0.01), "under"))
            add(box((gear - 0.32, 0.0, floor - TRAILER_SIZES.neck_m), (front - 0.12, 0.5, floor + 0.01), "under"))
            self._parts += _landing_gear(gear, floor)
            guard = gear - 0.35
        if self.style.trailer != "container":
            self._parts += side_guard(s, guard, ahead, side)
        self._parts += underrun_bar(s, self.style, self._points)

    def _build_cargo(self) -> None:
        """Build a box, with or without a cooling unit, a curtain or a container."""
        s = self.shape
        kind = "box" if self.style.trailer == "reefer" else self.style.trailer
        front, end = s.length / 2, -s.length / 2
        ribs = round(s.length / TRAILER_SIZES.strap_m) if kind == "curtain" else 0
        narrow = replace(s, width=s.width - 0.06) if kind == "container" else s
        half, points = cargo_body(narrow, kind, front, ribs=ribs)
        self._parts.append(half)
        self._points |= points
        if self.style.trailer == "reefer":
            self._parts += _cooling_unit(front, s.box_height + 0.95, s.height - 0.2)
        if kind == "container":
            y, low, high = narrow.width / 2, s.box_height + 0.16, s.height - 0.14
            for x in np.linspace(end + 0.3, front - 0.3, round((s.length - 0.6) / TRAILER_SIZES.corrugation_m)):
                self._parts.append(box((x - 0.07, y - 0.01, low), (x + 0.07, y + 0.024, high), "livery"))
            for x in (end + 0.03, front - 0.21):
                for z in (s.box_height + 0.01, s.height - 0.13):
                    self._parts.append(box((x, y - 0.1, z), (x + 0.18, y + 0.028, z + 0.12), "under"))

    def _build_tank(self) -> None:
        """Build an elliptical tank with a walkway on top, and hoses and a cabinet at its side."""
        s = self.shape
        front, end = s.length / 2, -s.length / 2
        low, high = s.box_height - 0.12, s.height - 0.12
        middle, tall, wide = (low + high) / 2, (high - low) / 2, s.width / 2 - 0.02
        skin, surface = _tank(s.length / 2, (wide, tall))
        self._parts.append(skin.moved([0.0, 0.0, middle]))
        for stem, ring, column in (("roof_rear", 5, 14), ("rear_window_base", 3, 13), ("trunk_rear", 3, 5)):
            self._points[stem] = surface[ring, column] + [0.0, 0.0, middle]
        self._parts += [
            box((end + 0.7, 0.0, high - 0.05), (front - 0.7, 0.32, high + 0.03), "under"),
            box((end + 0.7, 0.28, high + 0.03), (front - 0.7, 0.32, high + 0.12), "rail"),
            box((end + 0.09, 0.0, 0.75), (end + 0.5, s.width / 2 - 0.05, s.box_height + 0.06), "trim"),
        ]
        for x in np.linspace(end + 1.6, front - 1.6, 4):
            self._parts.append(box((x - 0.22, 0.0, high - 0.05), (x + 0.22, 0.24, high + 0.119), "rail"))
        for x in np.linspace(end + 1.2, front - 1.2, 5):
            self._parts.append(box((x - 0.05, 0.3, low - 0.12), (x + 0.05, wide * 0.72, middle - 0.62 * tall), "under"))
        hose = s.width / 2 - 0.16
        self._parts.append(tube([(front - 3.9, hose, 0.98), (end + 4.6, hose, 0.98)], [0.075] * 2, "rail", 8))
        self._parts.append(parts.block((front - 4.9, hose - 0.5, 0.55), (front - 4.0, hose + 0.1, 1.05), "trim", 0.05))


def _tank(half_length: float, size: tuple[float, float]) -> tuple[Mesh, Array]:
    """Return the left half of an elliptical tank along x, with half its width and height.

    Returns:
        Its mesh, and points (rings, columns, 3) on it: from the rear's tip to the front's, from the bottom upwards.
    """
    turn = np.radians(np.arange(-90, 91, 10))
    unit = np.column_stack([np.cos(turn), np.sin(turn)])
    unit[[0, -1], 0] = 0.0
    outwards = unit / size / np.linalg.norm(unit / size, axis=1, keepdims=True)
    rings, normals = [], []
    for (share, deep), (along, across) in zip(TRAILER_SIZES.dome_rings, TRAILER_SIZES.dome_normals, strict=True):
        rings.append(
            np.column_stack([np.full(len(turn), TRAILER_SIZES.dome_m * deep - half_length), share * unit * size])
        )
        normals.append(np.column_stack([np.full(len(turn), -along), across * outwards]))
    flip = np.array([-1.0, 1.0, 1.0])
    surface = np.stack([*rings, *(ring * flip for ring in rings[::-1])])
    directions = np.stack([*normals, *(normal * flip for normal in normals[::-1])])
    # Counter-clockwise from outside: rows go down on the left side, columns forwards.
    skin = grid(surface.swapaxes(0, 1)[::-1], [["livery"] * (len(surface) - 1)] * (len(turn) - 1))
    skin = replace(skin, normals=directions.swapaxes(0, 1)[::-1].reshape(-1, 3))
    a, b, c = np.moveaxis(skin.vertices[skin.triangles], 1, 0)
    return skin.taken(np.linalg.norm(np.cross(b - a, c - a), axis=1) > 1e-9), surface


def _cooling_unit(front: float, low: float, high: float) -> list[Mesh]:
    """Return the left half of the cooling unit on a refrigerated box's front wall, with its grilles."""
    deep, wide = 0.42, 0.96
    behind, face = front + deep - 0.01, front + deep + 0.006
    slats = np.arange(low + 0.12, low + 0.7, 0.09)
    return [
        box((front - 0.02, 0.0, low), (front + deep, wide, high), "rail"),
        *(box((behind, 0.1, z), (face, wide - 0.1, z + 0.045), "gap") for z in slats),
        box((behind, 0.15, high - 0.5), (face, 0.75, high - 0.1), "gap"),
    ]


def _landing_gear(x: float, floor: float) -> list[Mesh]:
    """Return the left landing gear of a semi-trailer, raised, and its brace."""
    return [
        box((x - 0.08, 0.72, 0.52), (x + 0.08, 0.88, floor), "under"),
        box((x - 0.06, 0.74, 0.36), (x + 0.06, 0.86, 0.53), "rail"),
        box((x - 0.14, 0.68, 0.33), (x + 0.14, 0.92, 0.37), "under"),
        box((x - 0.04, 0.0, floor - 0.36), (x + 0.04, 0.73, floor - 0.26), "under"),
    ]


def _drawbar(front: float, hinge: float, height: float) -> list[Mesh]:
    """Return the left half of a drawbar from under a trailer's front to the hinge."""
    beam = [(front - 0.6, 0.4, height), (hinge - 0.25, 0.03, height)]
    return [
        tube(beam, [0.07] * 2, "under", 6),
        box((hinge - 0.5, 0.0, height - 0.06), (hinge + 0.08, 0.06, height + 0.06), "under"),
        box((front - 1.2, 0.0, height - 0.08), (front - 0.5, 0.43, height + 0.3), "under"),
    ]
