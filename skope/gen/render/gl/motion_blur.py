"""Motion blur: how far vehicles move in the picture while the shutter is open."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.gen.render.gl.placed_vehicles import PlacedVehicle
from skope.gen.vehicles.model import straight_lwh
from skope.types import Array

LEAST_BLUR_PX: Final = 1.5
"""Vehicles that move less than this are drawn sharp, pixels."""


@dataclass(frozen=True, eq=False)
class Moving:
    """A vehicle that moves visibly while the shutter is open."""

    vehicle: PlacedVehicle
    way: Array
    """(2,) pixels."""
    nearest: float
    """Least depth of it, metres."""
    hull: Array
    """(N, 2) convex polygon around all pixels that it may blur into."""


def moving(
    placed: Iterable[PlacedVehicle],
    velocity: Array,
    shutter_s: float,
    camera: Camera,
    before: float = 0.5,
    after: float = -0.5,
) -> list[Moving]:
    """The vehicles that move visibly while the shutter is open.

    What is nearer than its own length is left sharp: its parts move in all directions.

    Args:
        placed: The vehicles that the image may show.
        velocity: (N, 3) of all vehicles in the frame, m/s.
        shutter_s: How long the shutter is open, seconds.
        camera: The image's camera.
        before: The shutter opens this much before the moment that is labelled, as a share of `shutter_s`.
        after: It closes this much before it; negative if after it.
    """
    out = []
    for one in placed:
        T, (length, _, height) = one.T_world_chassis, straight_lwh(one.vehicle)
        middle = T[:3, 3] + 0.5 * height * T[:3, 2]
        step = 0.5 * shutter_s * velocity[one.index]
        pixels, depth, valid = camera.project(np.stack([middle - step, middle + step]))
        way = pixels[1] - pixels[0]
        if valid.all() and depth.min() > length and way @ way > LEAST_BLUR_PX**2:
            swept = cv2.convexHull(np.concatenate([one.hull - before * way, one.hull - after * way]).astype(np.float32))
            # A trailer's end is a whole length away from where the vehicle is; others reach half of theirs.
            reach = (0.6 if one.vehicle.trailer is None else 1.0) * length
            out.append(Moving(one, way, float(depth.min()) - reach, swept[:, 0].astype(np.float64)))
    return out
