"""Make a recording: drive a site's traffic past its camera."""

import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from importlib import metadata
from typing import Final

import numpy as np

import skope
from skope.camera import Camera
from skope.gen.scene import camera_sampling
from skope.gen.scene.conditions import Conditions, ranges
from skope.gen.scene.recording import RecordedVehicle, Recording, RecordingPlan
from skope.gen.scenery.build import scenery
from skope.gen.simulation.motion import Driven, drivable, reach
from skope.gen.simulation.parked import Parked, parked
from skope.gen.simulation.pedestrians import Present, Riders, Walkers
from skope.gen.simulation.physics import Pose, World, at_rest
from skope.gen.towns.layout import Layout
from skope.gen.towns.parking import Bay
from skope.gen.towns.sidewalks import sidewalks
from skope.gen.traffic.demand import in_town
from skope.gen.traffic.sumo import LAMPS, Snapshot, Traffic, step_for
from skope.gen.vehicles import FleetEntry, added, build, fleet, jittered
from skope.gen.vehicles.model import Vehicle

REACH: Final = 150.0
"""Vehicles nearer to the camera than this are simulated physically, metres."""
FARTHEST: Final = 600.0
"""Beyond that nothing is recorded, metres."""
SPECK: Final = 3.0
"""Nearer than that vehicles are recorded from where they are this high in the image, pixels."""
COMING: Final = 60.0
"""Vehicles are followed from this much farther away, metres: they take a second to come onto a way they can drive."""
BEHIND: Final = 40.0
"""Of what is behind the camera only what is nearer than this is recorded: it may throw shadows into the view."""
PARKED_REACH: Final = 120.0
"""Parked vehicles nearer to the camera than this are recorded, metres."""
CROWD_REACH: Final = 90.0
"""People on sidewalks nearer to the camera than this are recorded, metres."""
WARM_UP: Final = (60.0, 100.0)
"""Range of the traffic's time before a recording starts, seconds: the first vehicles have crossed the town by then."""
SETTLE: Final = 1.5
"""Seconds that the physics run before the first frame, so that springs have come to rest."""
ADDED_SHARE: Final = 0.1
"""How often an added model drives by, for each vehicle of the fleet."""
FLASH: Final = 0.667
"""Seconds from flash to flash of an indicator: 90 a minute, the middle of what UN Regulation 48 allows."""
LAMPS_ON_DEG: Final = 10.0
"""Vehicles drive with their lamps lit when the sun stands lower than this,"""
LAMPS_ON_VISIBILITY: Final = 1000.0
"""when one sees less far than this, metres, and in rain."""
TRACKS_PER_RECORDING: Final = 100_000


def versions() -> dict[str, str]:
    """Versions of what decides a recording's and a dataset's content."""
    packages = {
        "sumo": "libsumo",
        "pybullet": "pybullet",
        "numpy": "numpy",
        "opencv": "opencv-python-headless",
        "orjson": "orjson",  # how numbers are written
    }
    found = {}
    for name, package in packages.items():
        with suppress(metadata.PackageNotFoundError):  # what renders needs no traffic
            found[name] = metadata.version(package)
    return {"skope": skope.__version__, **found}


def simulate(plan: RecordingPlan) -> Recording:
    """Run traffic and physics, and record every frame of the plan."""
    site = plan.site
    step = step_for(plan.interval)
    rng = np.random.default_rng([plan.seed, zlib.crc32(site.name.encode()), plan.index])
    warm_up = round(rng.uniform(*WARM_UP) / step)
    own = [plan.seed, zlib.crc32(site.name.encode()), plan.index]
    spans = ranges(site.weather, site.time_of_day, {**site.conditions, **plan.settings})
    conditions = Conditions.drawn(spans, np.random.default_rng([*own, 4]))
    camera = camera_sampling.drawn(
        site, plan.size, plan.fov_deg, conditions.distortion, plan.cameras, np.random.default_rng([*own, 5])
    )
    stride, settle, ahead = round(plan.interval / step), round(SETTLE / step), reach(step)
    models = _models(plan)
    log = _Recorder(camera, plan, models, lamps_on=lamps_on(conditions))
    paths = sidewalks(site.town, site.position[:2], CROWD_REACH)
    standing = parked(site.town, log.in_view(scenery(site.town).bays), models, np.random.default_rng([*own, 3]))
    log.park(standing)
    footprints = [one.footprint(models[one.model].vehicle) for one in standing]
    walkers = Walkers(paths, np.random.default_rng([*own, 1]), footprints)
    steps = settle + (plan.frames - 1) * stride + 1
    duration = (warm_up + steps + ahead) * step
    with (
        Traffic(
            site.town.network,
            models,
            vehicles_per_hour=site.vehicles_per_hour,
            duration=duration,
            rng=rng,
            flows=site.flows,
            passing=Layout.of(site.town).seen_by(site.road.camera, REACH) if site.road else frozenset(),
            step=step,
            watched=log.watches,
        ) as traffic,
        World(step) as world,
    ):
        riders = Riders({trip.name: trip.model for trip in traffic.trips.values()}, own)
        traffic.warm_up(warm_up - ahead)
        for k, (snapshot, driven) in enumerate(drivable(traffic.steps(steps + 2 * ahead), step)):
            near = log.near(driven, traffic)
            world.advance(near)
            riding = riders.follow(snapshot.riders, step)
            if k >= settle and (k - settle) % stride == 0:
                time = (k - settle) * step
                far = log.far(driven, traffic)
                poses = world.poses() | {name: at_rest(*placed) for name, placed in far.items()}
                log.add(time, near | far, poses, snapshot, traffic)
                log.add_others({**riding, **walkers.at(time)})
    return log.recording(plan, camera, conditions)


def _models(plan: RecordingPlan) -> dict[str, FleetEntry]:
    """What drives by: the fleet, where detectors train without what is held out, and what was added."""
    train = plan.site.split == "train"
    usual = {name: entry for name, entry in fleet().items() if not (train and entry.held_out)}
    models = in_town(usual, plan.site.town.name)
    share = ADDED_SHARE * sum(entry.share for entry in models.values())
    return models | {name: FleetEntry(added.load(name), share) for name in plan.vehicles}


def lamps_on(conditions: Conditions) -> bool:
    """Whether vehicles drive with their lamps lit."""
    seen = conditions.sun_elevation_deg >= LAMPS_ON_DEG and conditions.visibility_m >= LAMPS_ON_VISIBILITY
    return not seen or conditions.rain_mm_h > 0


def flashed(lamps: int, time: float, name: str) -> int:
    """The lamps that are lit at a time: indicators flash, each vehicle's in its own time."""
    indicators = LAMPS["indicator_left"] | LAMPS["indicator_right"]
    phase = zlib.crc32(name.encode()) / 2**32
    return lamps if (time / FLASH + phase) % 1 < 0.5 else lamps & ~indicators


class _Recorder:
    """Collects frames; vehicles are numbered in the order in which they come near."""

    def __init__(
        self, camera: Camera, plan: RecordingPlan, models: Mapping[str, FleetEntry], *, lamps_on: bool
    ) -> None:
        self._plan, self._models = plan, models
        self._vehicles: dict[str, Vehicle] = {}
        self._eye, axis = camera.position[:2].tolist(), camera.T_camera_world[2, :2]
        self._ahead = (axis / max(float(np.linalg.norm(axis)), 1e-9)).tolist()
        self._reach = float(np.clip(1.5 * camera.K[0, 0] / SPECK, REACH, FARTHEST))
        self._always = LAMPS["low_beam"] if lamps_on else 0
        self._parked: dict[str, tuple[Parked, Pose]] = {}
        self._index: dict[str, int] = {}
        self._entries: list[RecordedVehicle] = []
        self._times: list[float] = []
        self._signals: list[dict[str, str]] = []
        self._rows: list[tuple[int, int, Pose, int]] = []
        self._first_track = plan.index * TRACKS_PER_RECORDING + 1

    def near(self, everyone: Mapping[str, Driven], traffic: Traffic) -> dict[str, tuple[Vehicle, Driven]]:
        """Vehicles that the physics are worth."""
        return self._within(0.0, REACH, everyone, traffic)

    def far(self, everyone: Mapping[str, Driven], traffic: Traffic) -> dict[str, tuple[Vehicle, Driven]]:
        """Vehicles so far away that it is enough to know where they are."""
        return self._within(REACH, self._reach, everyone, traffic)

    def _within(
        self, least: float, most: float, everyone: Mapping[str, Driven], traffic: Traffic
    ) -> dict[str, tuple[Vehicle, Driven]]:
        return {
            name: (self._vehicle(name, traffic.trips[name].model), driven)
            for name, driven in sorted(everyone.items())
            if least <= self._distance(driven.position) < most
        }

    def watches(self, x: float, y: float) -> bool:
        """Whether what drives at a place is recorded, or may be soon."""
        east, north = x - self._eye[0], y - self._eye[1]
        away = math.hypot(east, north)
        ahead = east * self._ahead[0] + north * self._ahead[1]
        return away < COMING + (self._reach if ahead > -COMING else BEHIND)

    def _distance(self, position: Sequence[float]) -> float:
        """How far a place (2 or more) is from the camera, metres; infinitely far when nothing of it can be seen."""
        east, north = position[0] - self._eye[0], position[1] - self._eye[1]
        away = math.hypot(east, north)
        return away if east * self._ahead[0] + north * self._ahead[1] > 0 or away < BEHIND else math.inf

    def _vehicle(self, name: str, model: str) -> Vehicle:
        if name not in self._vehicles:
            vehicle = self._models[model].vehicle
            if self._plan.shape_jitter and model in fleet():
                own = [self._plan.seed, zlib.crc32(self._plan.site.name.encode()), self._plan.index]
                shape = jittered(model, np.random.default_rng([*own, zlib.crc32(name.encode())]))
                vehicle = build(model, shape)
            self._vehicles[name] = vehicle
        return self._vehicles[name]

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
            lamps = flashed(driven.lamps, time, name) | self._always
            self._note(
                frame, name, vehicle.model, vehicle.shape.to_dict(), traffic.trips[name].color, poses[name], lamps
            )
        for name, (one, pose) in self._parked.items():
            shape = self._vehicles[name].shape.to_dict()
            self._note(frame, name, one.model, shape, one.color, pose, 0, parked=True)

    def in_view(self, bays: Iterable[Bay]) -> list[Bay]:
        """Bays whose vehicles are recorded."""
        return [bay for bay in bays if self._distance(bay.place) < PARKED_REACH]

    def park(self, vehicles: Iterable[Parked]) -> None:
        """Vehicles that are in every frame."""
        for one in vehicles:
            self._parked[one.name] = one, at_rest(self._vehicle(one.name, one.model), one.state)

    def add_others(self, others: Mapping[str, Present]) -> None:
        """Those who are not labelled, into the last frame."""
        for name, other in others.items():
            if self._distance(other.T_world_body[:2, 3].tolist()) < REACH:
                pose = Pose(other.T_world_body, other.part_poses, other.velocity)
                look = other.body.look.to_dict()
                self._note(
                    len(self._times) - 1, name, other.body.kind, look, "black", pose, self._always, labelled=False
                )

    def _note(
        self,
        frame: int,
        name: str,
        model: str,
        shape: Mapping[str, float],
        color: str,
        pose: Pose,
        lamps: int,
        *,
        labelled: bool = True,
        parked: bool = False,
    ) -> None:
        if name not in self._index:
            self._index[name] = len(self._entries)
            track = self._first_track + len(self._entries)
            self._entries.append(RecordedVehicle(track, model, shape, color, parked=parked, labelled=labelled))
        self._rows.append((frame, self._index[name], pose, lamps))

    def recording(self, plan: RecordingPlan, camera: Camera, conditions: Conditions) -> Recording:
        site, poses = plan.site, [row[2] for row in self._rows]
        return Recording(
            town=site.town,
            site=site.name,
            name=plan.take.name,
            split=site.split,
            camera=camera,
            weather=site.weather,
            time_of_day=site.time_of_day,
            conditions=conditions,
            seed=plan.seed,
            versions=versions(),
            vehicles=tuple(self._entries),
            times_s=np.array(self._times),
            signals=tuple(self._signals),
            frame=np.array([row[0] for row in self._rows], dtype=np.int32),
            vehicle=np.array([row[1] for row in self._rows], dtype=np.int32),
            T_world_chassis=np.array([pose.T_world_chassis for pose in poses]).reshape(-1, 4, 4),
            T_world_wheels=np.array([pose.T_world_wheels for pose in poses]).reshape(-1, 4, 4, 4),
            velocity=np.array([pose.velocity for pose in poses]).reshape(-1, 3),
            lamps=np.array([row[3] for row in self._rows], dtype=np.uint8),
        )
