"""World positions of the 33 keypoints of V vehicles in a moment, by rigid transform or by trilateration."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope import keypoints
from skope.gen.scene.recording import Moment, vehicle_body
from skope.gen.vehicles.model import ON_TRAILER, Vehicle, wheel_plane
from skope.types import Array

LOCALIZER_CHOICES: Final = ("rigid", "trilateration")


def transform(T_world_vehicle: Array, points: Array) -> Array:
    """Move points (V, 33, 3) from vehicle frames to the world by poses (V, 4, 4); return (V, 33, 3), metres."""
    return np.asarray(points @ T_world_vehicle[:, :3, :3].transpose(0, 2, 1) + T_world_vehicle[:, None, :3, 3])


def trilaterate(wheels: Array, distances: Array, side: Array) -> Array:
    """Compute world keypoints from their distances to the wheels.

    Solves |p - w_i| = d_i for all keypoints at once. The wheel centres of a vehicle lie (nearly) in one plane, in which
    the differences of the equations are linear. Least squares gives the position in the plane. The residual distances
    then give the squared height above the plane, clamped at 0; `side` gives its sign. (SKoPe3D, section on simulation.)

    Args:
        wheels: (V, 4, 3) wheel centres, world, metres.
        distances: (V, 33, 4) distance from each keypoint to each wheel, metres.
        side: (V, 33) side of the wheels' plane on which each keypoint lies, 1 or -1.

    Returns:
        (V, 33, 3) world, metres.
    """
    center, axes, normal = wheel_plane(wheels)
    centered = wheels - center[:, None]
    w = centered @ axes.transpose(0, 2, 1)  # (V, 4, 2) wheels in their plane
    # w_i . p = (|w_i|^2 - d_i^2) / 2 + an unknown constant, equal for all i, which subtracting the mean removes.
    right = ((centered**2).sum(-1)[:, None] - distances**2) / 2
    right = right - right.mean(-1, keepdims=True)
    foot = right @ np.linalg.pinv(w).transpose(0, 2, 1) @ axes  # (V, 33, 3) feet of the perpendiculars, in the plane
    across = ((foot[:, :, None] - centered[:, None]) ** 2).sum(-1)
    height = np.sqrt(np.maximum((distances**2 - across).mean(-1), 0.0)) * side
    return np.asarray(center[:, None] + foot + height[..., None] * normal[:, None])


def with_trailers(points: Array, moment: Moment, vehicles: Sequence[Vehicle]) -> Array:
    """Return a copy of world keypoints in which those on trailers follow the trailers' poses.

    Args:
        points: (V, 33, 3) keypoints, world, metres.
        moment: Poses of the road users in a frame.
        vehicles: The V vehicles.
    """
    out = points.copy()
    for i, vehicle in enumerate(vehicles):
        if vehicle.trailer is None:
            continue
        T = moment.T_world_trailer[i, 0]
        from_hinge = vehicle.points[ON_TRAILER] - vehicle.trailer.hinge * [1, 1, 0]
        out[i, ON_TRAILER] = from_hinge @ T[:3, :3].T + T[:3, 3]
    return out


def with_wheels(points: Array, wheels: Array) -> Array:
    """Return a copy of keypoints (V, 33, 3) in which the wheels (16 to 19) are the wheel centres (V, 4, 3), metres."""
    out = points.copy()
    out[:, list(keypoints.WHEELS)] = wheels
    return out


@dataclass(frozen=True, eq=False)
class WorldKeypoints:
    """World keypoints of the N vehicles of a moment."""

    vehicles: tuple[Vehicle, ...]
    points: Array
    """(N, 33, 3) keypoints, metres."""
    tested: Array
    """(N, 33, 3) points of the visibility test: the middle of a wheel's outer face, and all other keypoints."""
    difference: Array
    """(N, 33) distance between the results of trilateration and rigid transform, metres."""


def world_keypoints(moment: Moment, localizer: str) -> WorldKeypoints:
    """Compute the world positions of the keypoints of all N labelled vehicles of a moment.

    Args:
        moment: State of the road users in a frame.
        localizer: "rigid" (keypoints move with the chassis) or "trilateration" (from distances to the wheels).
    """
    moment = moment.labelled()
    vehicles = tuple(map(vehicle_body, moment.vehicles))
    if not vehicles:
        return WorldKeypoints((), *(np.zeros((0, keypoints.K, 3)),) * 2, np.zeros((0, keypoints.K)))
    wheels = moment.T_world_wheels
    centers = wheels[:, :, :3, 3]
    hitched = np.array([vehicle.trailer is not None for vehicle in vehicles])
    rigid = transform(moment.T_world_chassis, np.stack([vehicle.points for vehicle in vehicles]))
    sidecars = [vehicle.sidecar for vehicle in vehicles]
    free = trilaterate(centers, np.stack([s.distances for s in sidecars]), np.stack([s.side for s in sidecars]))
    rigid, free = with_trailers(rigid, moment, vehicles), with_trailers(free, moment, vehicles)
    # The rear wheels of an articulated vehicle are those of its trailer.
    wheels = wheels.copy()
    wheels[hitched, 2:] = moment.T_world_trailer[hitched, 1:]
    centers = wheels[:, :, :3, 3]
    points = with_wheels(rigid if localizer == "rigid" else free, centers)
    faces = np.stack([vehicle.wheel_face_offsets for vehicle in vehicles])
    outer = centers + np.einsum("nwij,nwj->nwi", wheels[:, :, :3, :3], faces)
    return WorldKeypoints(vehicles, points, with_wheels(points, outer), np.linalg.norm(rigid - free, axis=-1))
