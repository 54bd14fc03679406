"""Keypoints of the vehicles of a moment where they are in the world."""

from dataclasses import dataclass

import numpy as np

from skope import keypoints
from skope.gen.labels.localize import transform, trilaterate, with_trailers, with_wheels
from skope.gen.scene.recording import Moment
from skope.gen.scene.road_user_bodies import vehicle_body
from skope.gen.vehicles.model import Vehicle
from skope.types import Array


@dataclass(frozen=True, eq=False)
class WorldKeypoints:
    """The keypoints of a moment's N vehicles in the world."""

    vehicles: tuple[Vehicle, ...]
    points: Array
    """(N, 33, 3) keypoints, metres."""
    tested: Array
    """(N, 33, 3) where visibility is tested: the keypoints, but for wheels the middle of the outer face."""
    difference: Array
    """(N, 33) distance between trilateration's and the rigid transform's answer, metres."""


def world_keypoints(moment: Moment, localizer: str) -> WorldKeypoints:
    """World positions of the keypoints of all N labelled vehicles of a moment.

    Args:
        moment: The frame.
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
    # The hindmost wheels of an articulated vehicle are its trailer's.
    wheels = wheels.copy()
    wheels[hitched, 2:] = moment.T_world_trailer[hitched, 1:]
    centers = wheels[:, :, :3, 3]
    points = with_wheels(rigid if localizer == "rigid" else free, centers)
    faces = np.stack([vehicle.wheel_face_offsets for vehicle in vehicles])
    outer = centers + np.einsum("nwij,nwj->nwi", wheels[:, :, :3, :3], faces)
    return WorldKeypoints(vehicles, points, with_wheels(points, outer), np.linalg.norm(rigid - free, axis=-1))
