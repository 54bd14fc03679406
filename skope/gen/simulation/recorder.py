"""Record a simulation: the poses of all road users that the camera can see, or may see soon, frame by frame, and of
vehicles that stand parked in its view."""

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
    """Distances up to which road users are simulated and recorded."""

    occupied_share: float = 0.5
    """Share of the bays that are taken."""
    most_parked: int = 14
    """Mean number of parked vehicles in view at most; in larger car parks a smaller share of the bays is taken."""
    simulated_within_m: float = 150.0
    """Vehicles nearer to the camera than this are simulated physically, metres."""
    recorded_within_m: float = 600.0
    """Vehicles farther from the camera than this are not recorded, metres."""
    speck_px: float = 3.0
    """Beyond `simulated_within_m`, vehicles are recorded where a car is at least this high in the image, pixels."""
    coming_m: float = 60.0
    """Vehicles are followed from this much farther away than they are recorded, metres: it takes them a second to come
    onto a way that wheels can follow."""
    behind_m: float = 40.0
    """Vehicles behind the camera are recorded up to this distance, metres: they may throw shadows into the view."""
    parked_within_m: float = 120.0
    """Parked vehicles nearer to the camera than this are recorded, metres."""
    around_m: float = 25.0
    """Road users that are this near to what a camera shows may throw shadows into it, metres."""
    around_at_night_m: float = 45.0
    """The same with lamps on, which light the road before them, metres."""
    flash_s: float = 0.667
    """Seconds from flash to flash of an indicator: 90 a minute, the middle of what UN Regulation 48 allows."""
    daytime_lamps_share: float = 0.4
    """Share of the vehicles that drive with their headlamps lit by day, where cameras are to differ as those of many
    countries do."""
    unlit_share: float = 0.15
    """Share of the cyclists who ride without lamps in the dark, and of the motorcyclists who do by day."""
    tracks_per_recording: int = 100_000
    """Track ids of a site's recordings are this far apart, so that they never meet."""


RECORDING_REACH: Final = RecordingReach()


@dataclass(frozen=True)
class Parked:
    """A vehicle in a bay."""

    name: str
    model: str
    color: str
    state: Driven

    def footprint(self, vehicle: Vehicle) -> Polygon:
        """Rectangle of ground that the vehicle stands on, world, metres."""
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
    """Draw parked vehicles for some of the bays, of models that fit, nose or tail first.

    Args:
        town: For the height of the ground.
        bays: Bays in view.
        models: Models that drive in the town, by name.
        rng: Draws bays, models, paints and places.
        most: Mean number of vehicles at most.
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
        place = np.array(bay.place) + rng.normal(0, 0.08, 2)
        out.append(Parked(f"b{i:04d}", model, color, _standing(layout, place, float(yaw))))
    return out


def _standing(layout: Layout, place: np.ndarray, yaw: float) -> Driven:
    """A vehicle that stands on the ground beside the road, level across."""
    ahead = 1.3 * np.array([math.cos(yaw), math.sin(yaw)])
    front, rear = (layout.height(layout.graph.world(at)) for at in (place + ahead, place - ahead))
    position = (float(place[0]), float(place[1]), (front + rear) / 2)
    return Driven(position, yaw, math.atan2(front - rear, 2.6), 0.0, 0)


def flashed(lamps: int, time: float, name: str) -> int:
    """The lamps that are lit at a time: indicators flash, with a phase that follows from the vehicle's name.

    Args:
        lamps: Bits of `LAMP_BITS` that are switched on.
        time: Seconds.
        name: The vehicle's name.
    """
    indicators = LAMP_BITS["indicator_left"] | LAMP_BITS["indicator_right"]
    phase = zlib.crc32(name.encode()) / 2**32
    return lamps if (time / RECORDING_REACH.flash_s + phase) % 1 < 0.5 else lamps & ~indicators


def _rider_lamps(kind: str, name: str, dark: bool) -> int:
    """The lamps that a labelled rider has lit: a bicycle's front lamp is one as vehicles have for backing up.

    Args:
        kind: Kind of the body.
        name: Name of the rider, whose habit follows from it.
        dark: Whether vehicles have their lamps lit.
    """
    unlit = zlib.crc32(f"{name} unlit".encode()) < RECORDING_REACH.unlit_share * 2**32
    if kind == "motorcyclist":
        return LAMP_BITS["low_beam"] if dark or not unlit else 0
    return LAMP_BITS["low_beam"] | LAMP_BITS["reverse"] if kind == "cyclist" and dark and not unlit else 0


def _half_view(camera: Camera) -> float:
    """The largest angle between a camera's axis and what its image shows, radians."""
    columns, rows = np.meshgrid(np.linspace(0, camera.width, 5), np.linspace(0, camera.height, 5))
    rays, valid = camera.rays(np.stack([columns, rows], axis=-1).reshape(-1, 2))
    if not valid.all():
        return math.pi
    return float(np.arccos(1 / np.linalg.norm(rays, axis=1).max()))


def _rounded(values: Sequence[Array], number: type[np.floating[Any]]) -> Array:
    return np.array(values, dtype=number).astype(np.float64)


class Recorder:
    """Collects the frames of a recording; road users are numbered in the order in which they are first recorded."""

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
        """Vehicles near enough to be simulated physically, by name."""
        return self._within(0.0, RECORDING_REACH.simulated_within_m, everyone, traffic)

    def far(self, everyone: Mapping[str, Driven], traffic: Traffic) -> dict[str, tuple[Vehicle, Driven]]:
        """Vehicles that are recorded, but too far away to be worth simulating physically, by name."""
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
        """Whether a vehicle at a place (world, metres) is recorded, or may be soon."""
        east, north = x - self._eye[0], y - self._eye[1]
        away = math.hypot(east, north)
        ahead = east * self._ahead[0] + north * self._ahead[1]
        return away < RECORDING_REACH.coming_m + (
            self._reach if ahead > -RECORDING_REACH.coming_m else RECORDING_REACH.behind_m
        )

    def _distance(self, position: Sequence[float]) -> float:
        """Distance of a place (x, y, ...) from the camera on the map, metres; inf where the camera cannot see it."""
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
        """The paint of a vehicle: its own, or, where cameras share the traffic, one that is drawn for this camera."""
        if not self._plan.variation.views:
            return color
        if name not in self._paints:
            rng = self._plan.rng(Stream.PAINT, zlib.crc32(name.encode()))
            self._paints[name] = draw_paint(vehicle, rng, shades=True)
        return self._paints[name]

    def _daytime_lamps(self, name: str) -> int:
        """The lamps that a vehicle has lit by day too."""
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
        for name, (one, pose) in self._parked.items():
            shape = self._vehicles[name].shape.to_dict()
            color = self._paint(name, self._vehicles[name], one.color)
            self._note(frame, name, one.model, shape, color, pose, 0, parked=True)

    def in_view(self, bays: Iterable[Bay]) -> list[Bay]:
        """The bays near enough that vehicles parked in them are recorded."""
        return [bay for bay in bays if self._distance(bay.place) < RECORDING_REACH.parked_within_m]

    def park(self, vehicles: Iterable[Parked]) -> None:
        """Add parked vehicles, which are in every frame."""
        for one in vehicles:
            self._parked[one.name] = one, at_rest(self._vehicle(one.name, one.model), one.state)

    def add_others(self, others: Mapping[str, PlacedBystander]) -> None:
        """Add bystanders, by name, to the last frame that was added."""
        for name, other in others.items():
            if self._distance(other.T_world_body[:2, 3].tolist()) < RECORDING_REACH.simulated_within_m:
                parts, look = other.part_poses, other.body.look.to_dict()
                more = np.concatenate([parts[4:], trailer_motion.NO_TRAILER[: 7 - len(parts)]])
                pose = Pose(other.T_world_body, parts[:4], other.velocity, more)
                dark = bool(self._always)
                lamps = _rider_lamps(other.body.kind, name, dark) if other.body.jointed else self._always
                self._note(len(self._times) - 1, name, other.body.kind, look, "black", pose, lamps, labelled=False)

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
            one = RecordedVehicle(track, model, shape, color, parked=parked, labelled=labelled, recurs=recurs)
            self._entries.append(one)
        self._rows.append((frame, self._index[name], pose, lamps))

    def _shows(self, place: Array) -> bool:
        """Whether a road user at a place (3,) may be seen, or its shadow, or the light of its lamps."""
        away = place - self._eye_3d
        distance = float(np.linalg.norm(away))
        if distance <= self._around:
            return True
        aside = math.acos(min(1.0, max(-1.0, float(away @ self._axis) / distance)))
        return aside < self._half_view + math.asin(self._around / distance)

    def recording(self, plan: RecordingPlan, camera: Camera, conditions: Conditions) -> Recording:
        site, poses = plan.site, [row[2] for row in self._rows]
        # Many views must travel: their poses are kept to 24 bits, a hundredth of a millimetre.
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
