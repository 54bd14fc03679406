"""Make a recording: drive a site's traffic past its camera."""

import zlib
from importlib import metadata
from typing import Final

import numpy as np

import skope
from skope.camera import Camera
from skope.gen.conditions import Conditions, ranges
from skope.gen.recording import RecordedVehicle, Recording, RecordingPlan
from skope.gen.towns import network
from skope.gen.traffic import LAMPS, STEP, Driven, Snapshot, Traffic
from skope.gen.vehicles import Vehicle, fleet
from skope.gen.world import Pose, World

REACH: Final = 170.0
"""Vehicles nearer to the camera than this are simulated physically and recorded, metres."""
WARM_UP: Final = (60.0, 100.0)
"""Range of the traffic's time before a recording starts, seconds: the first vehicles have crossed the town by then."""
SETTLE: Final = 1.5
"""Seconds that the physics run before the first frame, so that springs have come to rest."""
LAMPS_ON_DEG: Final = 10.0
"""Vehicles drive with their lamps lit when the sun stands lower than this."""
TRACKS_PER_RECORDING: Final = 100_000


def versions() -> dict[str, str]:
    """Versions of what decides a recording's and a dataset's content."""
    packages = {"sumo": "libsumo", "pybullet": "pybullet", "numpy": "numpy", "opencv": "opencv-python-headless"}
    return {"skope": skope.__version__, **{name: metadata.version(package) for name, package in packages.items()}}


def simulate(plan: RecordingPlan) -> Recording:
    """Run traffic and physics, and record every frame of the plan."""
    site = plan.site
    rng = np.random.default_rng([plan.seed, zlib.crc32(site.name.encode()), plan.index])
    warm_up = round(rng.uniform(*WARM_UP) / STEP)
    conditions = Conditions.drawn(ranges(site.weather, site.time_of_day, plan.settings), rng)
    camera = site.camera(plan.size, plan.fov_deg, conditions.k1)
    stride, settle = round(plan.interval / STEP), round(SETTLE / STEP)
    log = _Log(camera, night=conditions.sun_elevation_deg < LAMPS_ON_DEG)
    duration = (warm_up + settle + plan.frames * stride) * STEP
    with (
        Traffic(
            network(site.town), fleet(), vehicles_per_hour=site.vehicles_per_hour, duration=duration, rng=rng
        ) as traffic,
        World(STEP) as world,
    ):
        for _ in range(warm_up):
            traffic.step()
        for k in range(settle + (plan.frames - 1) * stride + 1):
            snapshot = traffic.step()
            near = log.near(snapshot, traffic)
            world.advance(near)
            if k >= settle and (k - settle) % stride == 0:
                log.add((k - settle) * STEP, near, world.poses(), snapshot, traffic)
    return log.recording(plan, camera, conditions)


class _Log:
    """Collects frames; vehicles are numbered in the order in which they come near."""

    def __init__(self, camera: Camera, night: bool) -> None:
        self._eye = camera.position[:2]
        self._always = LAMPS["low_beam"] if night else 0
        self._index: dict[str, int] = {}
        self._entries: list[tuple[str, str]] = []
        self._times: list[float] = []
        self._signals: list[dict[str, str]] = []
        self._rows: list[tuple[int, int, Pose, int]] = []

    def near(self, snapshot: Snapshot, traffic: Traffic) -> dict[str, tuple[Vehicle, Driven]]:
        return {
            name: (fleet()[traffic.trips[name].model].vehicle, driven)
            for name, driven in sorted(snapshot.vehicles.items())
            if np.hypot(*(np.array(driven.position[:2]) - self._eye)) < REACH
        }

    def add(
        self,
        time: float,
        near: dict[str, tuple[Vehicle, Driven]],
        poses: dict[str, Pose],
        snapshot: Snapshot,
        traffic: Traffic,
    ) -> None:
        frame = len(self._times)
        self._times.append(round(time, 6))
        self._signals.append(dict(snapshot.signals))
        for name, (vehicle, driven) in near.items():
            if name not in self._index:
                self._index[name] = len(self._entries)
                self._entries.append((vehicle.model, traffic.trips[name].color))
            self._rows.append((frame, self._index[name], poses[name], driven.lamps | self._always))

    def recording(self, plan: RecordingPlan, camera: Camera, conditions: Conditions) -> Recording:
        site, poses = plan.site, [row[2] for row in self._rows]
        vehicles = tuple(
            RecordedVehicle(
                plan.index * TRACKS_PER_RECORDING + i + 1, model, fleet()[model].vehicle.shape.to_dict(), color
            )
            for i, (model, color) in enumerate(self._entries)
        )
        return Recording(
            town=site.town,
            site=site.name,
            name=plan.name,
            split=site.split,
            camera=camera,
            weather=site.weather,
            time_of_day=site.time_of_day,
            conditions=conditions,
            seed=plan.seed,
            versions=versions(),
            vehicles=vehicles,
            times_s=np.array(self._times),
            signals=tuple(self._signals),
            frame=np.array([row[0] for row in self._rows], dtype=np.int32),
            vehicle=np.array([row[1] for row in self._rows], dtype=np.int32),
            T_world_chassis=np.array([pose.T_world_chassis for pose in poses]).reshape(-1, 4, 4),
            T_world_wheels=np.array([pose.T_world_wheels for pose in poses]).reshape(-1, 4, 4, 4),
            velocity=np.array([pose.velocity for pose in poses]).reshape(-1, 3),
            lamps=np.array([row[3] for row in self._rows], dtype=np.uint8),
        )
