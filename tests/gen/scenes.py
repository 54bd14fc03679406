"""Small recordings made by hand or by a short simulation, for tests."""

from dataclasses import replace
from functools import cache

import numpy as np

from skope.camera.model import Camera
from skope.gen.bystanders import bystander
from skope.gen.bystanders.people import Look
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.recording import RecordedVehicle, Recording, RecordingPlan
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.sites import site
from skope.gen.towns.town import Town
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.fleet import fleet
from skope.gen.vehicles.trailer_motion import DrivenTrailer


def conditions(weather: str = "clear", **fields: float) -> Conditions:
    """A day at noon."""
    fixed = {"sun_elevation_deg": 55.0, "sun_azimuth_deg": 240.0, "clouds": float(weather != "clear")}
    camera = {"visibility_m": 8000.0, "exposure_ev": 0.0, "noise": 1.5, "vignetting": 0.1, "k1": 0.0}
    return Conditions(**{**fixed, **camera, **fields})


def pose(x: float, y: float, yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, x], [s, c, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]])


def standing(
    camera: Camera, vehicles: list[tuple[str, float, float, float]], weather: str = "clear", bend: float = 0.0
) -> Recording:
    """One frame of vehicles (model, x, y, yaw) standing in town 01, with their trailers bent by `bend` radians."""
    chassis = np.array([pose(x, y, yaw) for _, x, y, yaw in vehicles]).reshape(-1, 4, 4)
    models = [fleet()[model].vehicle for model, *_ in vehicles]
    wheels = np.tile(np.eye(4), (len(vehicles), 4, 1, 1))
    for i, vehicle in enumerate(models):
        wheels[i, :, :3, :3] = chassis[i, :3, :3]
        wheels[i, :, :3, 3] = vehicle.shape.wheel_centers() @ chassis[i, :3, :3].T + chassis[i, :3, 3]
    trailers = [
        trailer_motion.trailer_poses(vehicle, DrivenTrailer(yaw + bend, 0.0, 0.0), T)
        for vehicle, (*_, yaw), T in zip(models, vehicles, chassis, strict=True)
    ]
    count = len(vehicles)
    return Recording(
        town=Town("town01"),
        site="t01_mill_corner",
        name="00",
        split="train",
        camera=camera,
        weather=weather,
        time_of_day="noon",
        conditions=conditions(weather),
        seed=0,
        versions={},
        vehicles=tuple(
            RecordedVehicle(i + 1, vehicle.model, vehicle.shape.to_dict(), "blue") for i, vehicle in enumerate(models)
        ),
        times_s=np.array([0.0]),
        signals=({"crossing": "r" * 40},),
        frame=np.zeros(count, dtype=np.int32),
        vehicle=np.arange(count, dtype=np.int32),
        T_world_chassis=chassis,
        T_world_wheels=wheels,
        T_world_trailer=np.array(trailers).reshape(-1, 3, 4, 4),
        velocity=np.zeros((count, 3)),
        lamps=np.zeros(count, dtype=np.uint8),
    )


def with_people(recording: Recording, places: list[tuple[float, float, float]]) -> Recording:
    """The frame with large people who stand at places (x, y, yaw)."""
    body, count = bystander.build_bystander("pedestrian", Look(height=1.95, girth=1.3).to_dict()), len(places)
    chassis = np.array([pose(*place) for place in places])
    people = (
        RecordedVehicle(100 + i, "pedestrian", body.look.to_dict(), "black", labelled=False) for i in range(count)
    )
    before = len(recording.vehicles)
    return replace(
        recording,
        vehicles=(*recording.vehicles, *people),
        frame=np.zeros(before + count, dtype=np.int32),
        vehicle=np.arange(before + count, dtype=np.int32),
        T_world_chassis=np.concatenate([recording.T_world_chassis, chassis]),
        T_world_wheels=np.concatenate([recording.T_world_wheels, chassis[:, None] @ body.pose(0.0)]),
        T_world_trailer=None,
        velocity=np.zeros((before + count, 3)),
        lamps=np.zeros(before + count, dtype=np.uint8),
    )


@cache
def driven(name: str = "t01_mill_corner", frames: int = 4, seed: int = 3, fov_deg: float = 110) -> Recording:
    """A short simulated recording at 640x360."""
    return simulate(
        RecordingPlan(
            site=site(name), index=0, frames=frames, interval=0.5, size=(640, 360), fov_deg=fov_deg, seed=seed
        )
    )
