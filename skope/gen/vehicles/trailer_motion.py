"""Motion of the trailers of articulated vehicles, and their poses in the world.

A trailer's axles roll along its heading, so that it turns towards the direction of the hinge's motion. The path of its
axle is the tractrix of the hinge's path. Several axles turn about the middle between them.
"""

import math
from typing import Final, NamedTuple

import numpy as np

from skope.gen.vehicles.model import Vehicle
from skope.types import Array

NO_TRAILER: Final = np.tile(np.eye(4), (3, 1, 1))
"""Placeholder for the poses of a trailer if there is none."""


class Hitch(NamedTuple):
    """Distances of an articulated vehicle, metres, and its maximum bend."""

    hinge: float
    """Distance from the vehicle's rear axle forwards to the hinge; negative behind it."""
    axle: float
    """Distance from the hinge back to the middle of the trailer's axles."""
    bend: float
    """Maximum angle between vehicle and trailer, radians."""

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Hitch | None":
        """Return the distances of a vehicle; None without a trailer."""
        trailer = vehicle.trailer
        if trailer is None:
            return None
        return Hitch(float(trailer.hinge[0]) - vehicle.shape.rear_axle_x, trailer.axle, trailer.bend)


class DrivenTrailer(NamedTuple):
    """State of a trailer at one step."""

    yaw: float
    """Heading, counter-clockwise from east, radians; not wrapped, so that turns add up."""
    height: float
    """Height of the road under its axles, metres."""
    rolled: float
    """Distance rolled by the middle of its axles, metres."""


class Follower:
    """Trailer behind a hinge that moves in the plane."""

    def __init__(self, hitch: Hitch, x: float, y: float, yaw: float) -> None:
        """Start with the hinge at (x, y), world, metres, and with the heading `yaw`, radians."""
        self._hitch, self._x, self._y = hitch, x, y
        self.yaw, self.rolled = yaw, 0.0

    def follow(self, x: float, y: float, vehicle_yaw: float) -> None:
        """Move the hinge straight to (x, y), metres.

        `vehicle_yaw`, radians, is the heading of the towing vehicle when the hinge is at (x, y). Let s be the distance
        that the hinge moves, and `axle` the distance from the hinge to the axle. The angle b between the trailer's
        heading and the hinge's course obeys db/ds = -sin(b) / axle. Therefore t = tan(b / 2) is multiplied by
        exp(-s / axle), and the wheels roll the integral of cos(b) over s. Beyond the maximum angle to the vehicle, the
        trailer is dragged sideways.
        """
        way, course = math.hypot(x - self._x, y - self._y), math.atan2(y - self._y, x - self._x)
        if way == 0:
            return
        axle, bend = self._hitch.axle, self._hitch.bend
        before = math.tan(math.remainder(course - self.yaw, 2 * math.pi) / 2)
        after = before * math.exp(-way / axle)
        self.rolled += way + axle * math.log((1 + after**2) / (1 + before**2))
        self.yaw += 2 * (math.atan(before) - math.atan(after))
        over = math.remainder(self.yaw - vehicle_yaw, 2 * math.pi)
        self.yaw += min(max(over, -bend), bend) - over
        self._x, self._y = x, y


def trailer_poses(vehicle: Vehicle, driven: DrivenTrailer | None, T_world_chassis: Array) -> Array:
    """Return world poses (3, 4, 4) of a vehicle's trailer and of its wheels, rear right and rear left.

    The trailer is on the hinge, has its axles on the road, and leans to the side as the towing vehicle does.
    """
    trailer = vehicle.trailer
    if trailer is None or driven is None:
        return NO_TRAILER
    R = T_world_chassis[:3, :3]
    hinge = R @ trailer.hinge + T_world_chassis[:3, 3]
    pitch = math.asin((hinge[2] - trailer.hinge[2] - driven.height) / trailer.axle)
    bend = driven.yaw - math.atan2(R[1, 0], R[0, 0])
    upright = _turned(driven.yaw, pitch, 0.0)
    T = np.tile(np.eye(4), (3, 1, 1))
    T[0, :3, :3] = _turned(driven.yaw, pitch, math.asin(R[2, 1]) * math.cos(bend))
    T[0, :3, 3] = hinge - T[0, :3, :3] @ [0.0, 0.0, trailer.hinge[2]]
    foot = hinge - upright @ [0.0, 0.0, trailer.hinge[2]]
    for T_wheel, center in zip(T[1:], trailer.wheel_centers, strict=True):
        # A wheel beside the middle rolls farther or less far while the trailer turns.
        spin = (driven.rolled - center[1] * driven.yaw) / vehicle.shape.wheel_radius
        c, s = math.cos(spin), math.sin(spin)
        T_wheel[:3, :3] = upright @ [[c, 0, s], [0, 1, 0], [-s, 0, c]]
        T_wheel[:3, 3] = foot + upright @ center
    return T


def _turned(yaw: float, pitch: float, roll: float) -> Array:
    """Return the rotation (3, 3) to a heading, up by `pitch`, with the left side raised by `roll`, radians."""
    x = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    y = np.array([-math.sin(yaw), math.cos(yaw), 0.0])
    up = np.cross(x, y)
    return np.column_stack([x, math.cos(roll) * y + math.sin(roll) * up, math.cos(roll) * up - math.sin(roll) * y])
