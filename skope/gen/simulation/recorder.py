"""Record a simulation: frame by frame, the poses of all road users near a camera and of the parked vehicles in view."""

import math
import zlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from shapely import Polygon

from skope.camera.model import Camera
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.package_versions import versions
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import LAMP_BITS, RecordedVehicle, Recording, RecordingPlan
from skope.gen.simulation.pedestrians import PlacedBystander
from skope.gen.simulation.physics import Pose, at_rest
from skope.gen.simulation.smooth_paths import Driven
from skope.gen.towns.land_use import LAND_USE, Bay, Layout
from skope.gen.towns.regions import rectangle_polygon
from skope.gen.towns.town import Town
from skope.gen.traffic.sumo import Snapshot, Traffic
from skope.gen.vehicles import trailer_motion
from skope.gen.vehicles.fleet import FleetEntry, build_vehicle, fleet, jittered
from skope.gen.vehicles.model import Vehicle, straight_lwh
from skope.gen.vehicles.paints import draw_paint
from skope.types import Array


@dataclass(frozen=True)
class RecordingReach:
    """Distances within which road users are simulated and recorded, and settings of lamps and parked vehicles."""

    occupied_share: float = 0.5
    """Fraction of the parking bays that are occupied."""
    most_parked: int = 14
    """Maximum mean number of parked vehicles in view; larger car parks have a smaller fraction of occupied bays."""
    simulated_within_m: float = 150.0
    """Distance from the camera within which vehicles are simulated physically, metres."""
    recorded_within_m: float = 600.0
    """Maximum distance from the camera of recorded vehicles, metres."""
    speck_px: float = 3.0
    """Minimum height of a car in the image for vehicles beyond `simulated_within_m` to be recorded, pixels."""
    coming_m: float = 60.0
    """Distance beyond the recorded range at which vehicles start to be followed, metres.

    A vehicle needs about a second until its path is one that wheels can follow."""
    behind_m: float = 40.0
    """Maximum distance of recorded vehicles behind the camera, metres; they may cast shadows into the view."""
    parked_within_m: float = 120.0
    """Maximum distance from the camera of recorded parked vehicles, metres."""
    around_m: float = 25.0
    """Distance from the camera's view within which road users may cast shadows into it, metres."""
    around_at_night_m: float = 45.0
    """Distance from the camera's view within which road users with lit lamps may light it, metres."""
    flash_s: float = 0.667
    """Period of a flashing indicator, seconds: 90 flashes per minute, the middle of the range in UN Regulation 48."""
    daytime_lamps_share: float = 0.4
    """Fraction of the vehicles that drive with their headlamps on by day; applies only to recordings with views.

    The cameras of views are meant to differ like those of many countries."""
    unlit_share: float = 0.15
    """Fraction of cyclists without lights in the dark, and of motorcyclists without lights by day."""
    tracks_per_recording: int = 100_000
    """Offset between the track ids of a site's consecutive recordings; keeps the ids distinct."""


RECORDING_REACH: Final = RecordingReach()


@dataclass(frozen=True)
class Parked:
    """A vehicle parked in a bay."""

    name: str
    model: str
    color: str
    state: Driven

    def footprint(self, vehicle: Vehicle) -> Polygon:
        """Return the ground rectangle that the vehicle covers, world, metres."""
        length, width, _ = vehicle.size_lwh
        return rectangle_polygon(np.array(self.state.position[:2]), self.state.yaw, length, width)


def parked_vehicles(
    town: Town,
    bays: Sequence[Bay],
    models: Mapping[str, FleetEntry],
    rng: np.random.Generator,
    *,
    most: int = RECORDING_REACH.most_parked,
) -> list[Parked]:
    """Sample parked vehicles for some of the bays, of models that fit, forwards or backwards.

    Args:
        town: Town, which gives the height of the ground.
        bays: Bays in view.
        models: Models that drive in the town, by name.
        rng: Random generator for bays, models, paints and positions.
        most: Maximum of the mean number of vehicles.
    """
    fitting = {
        name: entry.share for name, entry in models.items() if straight_lwh(entry.vehicle)[0] < LAND_USE.bay_m[0] + 0.2
    }
    if not bays or not fitting:
        return []
    layout = Layout.of(town)
    names, shares = list(fitting), np.array(list(fitting.values()))
    share, out = min(RECORDING_REACH.occupied_share, most / len(bays)), []
    for i, bay in enumerate(bays):
        if rng.random() > share:
            continue
        model = names[rng.choice(len(names), p=shares / shares.sum())]
        color = draw_paint(models[model].vehicle, rng)
        yaw = bay.heading + (math.pi if rng.random() < 0.4 else 0.0) + rng.normal(0, 0.02)
        position = np.array(bay.position) + rng.normal(0, 0.08, 2)
        out.append(Parked(f"b{i:04d}", model, color, _standing(layout, position, float(yaw))))
    return out


def _standing(layout: Layout, middle: np.ndarray, yaw: float) -> Driven:
    """Return the state of a vehicle that stands on the ground beside the road, level across."""
    ahead = 1.3 * np.array([math.cos(yaw), math.sin(yaw)])
    front, rear = (layout.height(layout.graph.world(at)) for at in (middle + ahead, middle - ahead))
    position = (float(middle[0]), float(middle[1]), (front + rear) / 2)
    return Driven(position, yaw, math.atan2(front - rear, 2.6), 0.0, 0)


def flashed(lamps: int, time: float, name: str) -> int:
    """Return the lamps that are lit at a time; indicators flash, with a phase that depends on the vehicle's name.

    Args:
        lamps: Switched-on lamps, as bits of `LAMP_BITS`.
        time: Time, seconds.
        name: Name of the vehicle.
    """
    indicators = LAMP_BITS["indicator_left"] | LAMP_BITS["indicator_right"]
    phase = zlib.crc32(name.encode()) / 2**32
    return lamps if (time / RECORDING_REACH.flash_s + phase) % 1 < 0.5 else lamps & ~indicators


def _rider_lamps(kind: str, name: str, dark: bool) -> int:
    """Return the lit lamps of a labelled rider; a bicycle's front lamp uses the bit of a vehicle's reversing lamp.

    Args:
        kind: Kind of the body.
        name: Name of the rider, which determines whether the rider uses lights.
        dark: Whether vehicles have their lamps on.
    """
    unlit = zlib.crc32(f"{name} unlit".encode()) < RECORDING_REACH.unlit_share * 2**32
    if kind == "motorcyclist":
        return LAMP_BITS["low_beam"] if dark or not unlit else 0
    return LAMP_BITS["low_beam"] | LAMP_BITS["reverse"] if kind == "cyclist" and dark and not unlit else 0


def _half_view(camera: Camera) -> float:
    """Return the largest angle between a camera's axis and a ray in its image, radians."""
    columns, rows = np.meshgrid(np.linspace(0, camera.width, 5), np.linspace(0, camera.height, 5))
    rays, valid = camera.rays(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    if not valid.all():
        return math.pi
    return float(np.arccos(1 / np.linalg.norm(rays, axis=1).max()))


def _rounded(values: Sequence[Array], number: type[np.floating[Any]]) -> Array:
    return np.array(values, dtype=number).astype(np.float64)


class Recorder:
    """Collector of the frames of a recording; road users are numbered in the order of their first appearance."""

    def __init__(
        self, camera: Camera, plan: RecordingPlan, models: Mapping[str, FleetEntry], *, lamps_on: bool
    ) -> None:
        self._plan, self._models = plan, models
        self._vehicles: dict[str, Vehicle] = {}
        self._paints: dict[str, str] = {}
        self._eye, axis = camera.position[:2].tolist(), camera.T_camera_world[2, :2]
        self._ahead = (axis / max(float(np.linalg.norm(axis)), 1e-9)).tolist()
        self._reach = float(
            np.clip(
                1.5 * camera.K[0, 0] / RECORDING_REACH.speck_px,
                RECORDING_REACH.simulated_within_m,
                RECORDING_REACH.recorded_within_m,
            )
        )
        self._always = LAMP_BITS["low_beam"] if lamps_on else 0
        self._eye_3d, self._axis = camera.position, camera.T_camera_world[2, :3]
        self._half_view, self._around = (
            _half_view(camera),
            RECORDING_REACH.around_at_night_m if lamps_on else RECORDING_REACH.around_m,
        )
        self._parked: dict[str, tuple[Parked, Pose]] = {}
        self._index: dict[str, int] = {}
        self._entries: list[RecordedVehicle] = []
        self._times: list[float] = []
        self._signals: list[dict[str, str]] = []
        self._rows: list[tuple[int, int, Pose, int]] = []
        self._first_track = plan.index * RECORDING_REACH.tracks_per_recording + 1

    def near(self, everyone: Mapping[str, Driven], traffic: Traffic) -> dict[str, tuple[Vehicle, Driven]]:
        """Return the vehicles that are near enough to be simulated physically, by name."""
        return self._within(0.0, RECORDING_REACH.simulated_within_m, everyone, traffic)

    def far(self, everyone: Mapping[str, Driven], traffic: Traffic) -> dict[str, tuple[Vehicle, Driven]]:
        """Return the vehicles that are recorded but too far away to be simulated physically, by name."""
        return self._within(RECORDING_REACH.simulated_within_m, self._reach, everyone, traffic)

    def _within(
        self, least: float, most: float, everyone: Mapping[str, Driven], traffic: Traffic
    ) -> dict[str, tuple[Vehicle, Driven]]:
        return {
            name: (self._vehicle(name, traffic.trips[name].model), driven)
            for name, driven in sorted(everyone.items())
            if least <= self._distance(driven.position) < most
        }

    def watches(self, x: float, y: float) -> bool:
        """Return whether a vehicle at a position (world, metres) is recorded now, or may be soon."""
        east, north = x - self._eye[0], y - self._eye[1]
        away = math.hypot(east, north)
        ahead = east * self._ahead[0] + north * self._ahead[1]
        return away < RECORDING_REACH.coming_m + (
            self._reach if ahead > -RECORDING_REACH.coming_m else RECORDING_REACH.behind_m
        )

    def _distance(self, position: Sequence[float]) -> float:
        """Return the horizontal distance of a position (x, y, ...) from the camera, metres; inf if out of view."""
        east, north = position[0] - self._eye[0], position[1] - self._eye[1]
        away = math.hypot(east, north)
        return (
            away if east * self._ahead[0] + north * self._ahead[1] > 0 or away < RECORDING_REACH.behind_m else math.inf
        )

    def _vehicle(self, name: str, model: str) -> Vehicle:
        if name not in self._vehicles:
            vehicle = self._models[model].vehicle
            variation = self._plan.variation
            if variation.shape_jitter and model in fleet():
                vehicle = build_vehicle(
                    model, jittered(model, self._plan.shape_rng(name, model)), recurs=variation.views > 0
                )
            self._vehicles[name] = vehicle
        return self._vehicles[name]

    def _paint(self, name: str, vehicle: Vehicle, color: str) -> str:
        """Return a vehicle's paint. If several cameras share the traffic, it is sampled for this camera."""
        if not self._plan.variation.views:
            return color
        if name not in self._paints:
            rng = self._plan.rng(Stream.PAINT, zlib.crc32(name.encode()))
            self._paints[name] = draw_paint(vehicle, rng, shades=True)
        return self._paints[name]

    def _daytime_lamps(self, name: str) -> int:
        """Return the lamps that a vehicle also has on by day."""
        lit = (
            self._plan.variation.views
            and zlib.crc32(f"{name} by day".encode()) < RECORDING_REACH.daytime_lamps_share * 2**32
        )
        return LAMP_BITS["low_beam"] if lit else 0

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
            lamps = flashed(driven.lamps, time, name) | self._always | self._daytime_lamps(name)
            color = self._paint(name, vehicle, traffic.trips[name].color)
            self._note(frame, name, vehicle.model, vehicle.shape.to_dict(), color, poses[name], lamps)
        for name, (standing, pose) in self._parked.items():
            shape = self._vehicles[name].shape.to_dict()
            color = self._paint(name, self._vehicles[name], standing.color)
            self._note(frame, name, standing.model, shape, color, pose, 0, parked=True)

    def in_view(self, bays: Iterable[Bay]) -> list[Bay]:
        """Return the bays that are near enough for vehicles parked in them to be recorded."""
        return [bay for bay in bays if self._distance(bay.position) < RECORDING_REACH.parked_within_m]

    def park(self, vehicles: Iterable[Parked]) -> None:
        """Add parked vehicles, which appear in every frame."""
        for vehicle in vehicles:
            self._parked[vehicle.name] = vehicle, at_rest(self._vehicle(vehicle.name, vehicle.model), vehicle.state)

    def add_bystanders(self, bystanders: Mapping[str, PlacedBystander]) -> None:
        """Add bystanders, by name, to the last added frame."""
        for name, bystander in bystanders.items():
            if self._distance(bystander.T_world_body[:2, 3].tolist()) < RECORDING_REACH.simulated_within_m:
                parts, look = bystander.part_poses, bystander.body.look.to_dict()
                more = np.concatenate([parts[4:], trailer_motion.NO_TRAILER[: 7 - len(parts)]])
                pose = Pose(bystander.T_world_body, parts[:4], bystander.velocity, more)
                dark = bool(self._always)
                lamps = _rider_lamps(bystander.body.kind, name, dark) if bystander.body.jointed else self._always
                self._note(len(self._times) - 1, name, bystander.body.kind, look, "black", pose, lamps, labelled=False)

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
        if self._plan.variation.views and not self._shows(pose.T_world_chassis[:3, 3]):
            return
        if name not in self._index:
            self._index[name] = len(self._entries)
            track = self._first_track + len(self._entries)
            recurs = labelled and self._plan.variation.views > 0
            recorded = RecordedVehicle(track, model, shape, color, parked=parked, labelled=labelled, recurs=recurs)
            self._entries.append(recorded)
        self._rows.append((frame, self._index[name], pose, lamps))

    def _shows(self, position: Array) -> bool:
        """Return whether a road user at a position (3,), its shadow or the light of its lamps may be visible."""
        away = position - self._eye_3d
        distance = float(np.linalg.norm(away))
        if distance <= self._around:
            return True
        aside = math.acos(min(1.0, max(-1.0, float(away @ self._axis) / distance)))
        return aside < self._half_view + math.asin(self._around / distance)

    def recording(self, plan: RecordingPlan, camera: Camera, conditions: Conditions) -> Recording:
        site, poses = plan.site, [row[2] for row in self._rows]
        # Recordings of views are transferred in large numbers, so poses are kept to 24 bits (a hundredth of a
        # millimetre).
        number = np.float32 if plan.variation.views else np.float64
        trailers = _rounded([pose.T_world_trailer for pose in poses], number).reshape(-1, 3, 4, 4)
        return Recording(
            town=site.town,
            site=site.name,
            name=plan.info.name,
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
            T_world_chassis=_rounded([pose.T_world_chassis for pose in poses], number).reshape(-1, 4, 4),
            T_world_wheels=_rounded([pose.T_world_wheels for pose in poses], number).reshape(-1, 4, 4, 4),
            T_world_trailer=trailers if (trailers != np.eye(4)).any() else None,
            velocity=_rounded([pose.velocity for pose in poses], number).reshape(-1, 3),
            lamps=np.array([row[3] for row in self._rows], dtype=np.uint8),
            road_users=plan.variation.road_users,
        )
