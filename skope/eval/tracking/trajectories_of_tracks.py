"""Tracks in memory as `skope.traffic` takes them."""

from collections.abc import Sequence

import numpy as np

from skope.eval.tracking.ground_track import GroundTrack
from skope.eval.tracking.pedestrian_and_cycle_tracks import RoadUserTrack
from skope.eval.tracking.tracks import Track
from skope.schema import VEHICLE
from skope.traffic.trajectories import Trajectory


def trajectories_of_tracks(tracks: Sequence[GroundTrack]) -> list[Trajectory]:
    """The trajectories of tracks of vehicles and of other road users.

    Tracks have no numbers of their own before they are flagged: they are numbered from 1, in order.
    """
    return [_trajectory(track, number) for number, track in enumerate(tracks, start=1)]


def _trajectory(track: GroundTrack, number: int) -> Trajectory:
    vehicle = track if isinstance(track, Track) else None
    category = track.category if isinstance(track, RoadUserTrack) else VEHICLE
    heading = track.heading if isinstance(track, Track | RoadUserTrack) else np.full(len(track.times_s), np.nan)
    return Trajectory(
        number=number,
        category=category,
        class_name=vehicle.vehicle_class if vehicle else category,
        class_confidence=vehicle.class_confidence if vehicle else 1.0,
        times_s=track.times_s,
        place=track.position[:, :2],
        velocity=track.velocity,
        heading=heading,
        covariance=track.position_sigma[:, None, None] ** 2 * np.eye(2),
        speed_sigma=track.speed_sigma,
        located=track.located,
        length=float(vehicle.size_lwh[0]) if vehicle else None,
        width=float(vehicle.size_lwh[1]) if vehicle else None,
        confirmed=vehicle.confirmed if vehicle else True,
        flags=vehicle.flags if vehicle else (),
    )
