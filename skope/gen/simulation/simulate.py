"""Simulate recordings: drive a site's traffic past its camera, or past several cameras in its town."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from shapely import Polygon

from skope.camera.model import Camera
from skope.gen.scene.camera_sampling import CAMERA_SAMPLING, CameraRanges, ViewSampler, sample_camera
from skope.gen.scene.conditions import Conditions, ranges
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.scenery.build import bays_of
from skope.gen.simulation.pedestrians import Riders, Walkers
from skope.gen.simulation.physics import World, at_rest
from skope.gen.simulation.recorder import RECORDING_REACH, Recorder, parked_vehicles
from skope.gen.simulation.smooth_paths import drivable, reach
from skope.gen.towns.land_use import sidewalks
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.town import Mast, Variant
from skope.gen.traffic.demand import USUAL_RIDERS, Riding, in_town
from skope.gen.traffic.sumo import Snapshot, Traffic, step_for
from skope.gen.vehicles import user_models
from skope.gen.vehicles.fleet import FleetEntry, fleet
from skope.gen.vehicles.model import Vehicle
from skope.types import Array, Range


@dataclass(frozen=True)
class SimulationTimes:
    """Times before a recording, and limits on its contents."""

    crowd_within_m: float = 90.0
    """Distance from the camera within which people on sidewalks are recorded, metres."""
    warm_up_s: tuple[float, float] = (60.0, 100.0)
    """Range of the warm-up time of the traffic before a recording, seconds; long enough to cross the town."""
    settle_s: float = 1.5
    """Time that the physics run before the first frame, seconds, so that the springs come to rest."""
    added_share: float = 0.1
    """Number of vehicles of each requested model per vehicle of the fleet, if no share is given."""
    lamps_on_deg: float = 10.0
    """Elevation of the sun below which vehicles drive with their lamps on, degrees."""
    lamps_on_visibility_m: float = 1000.0
    """Visibility below which vehicles drive with their lamps on, metres."""


SIMULATION_TIMES: Final = SimulationTimes()


def simulate(plan: RecordingPlan) -> Recording:
    """Simulate traffic (SUMO) and vehicle dynamics (pybullet) for one plan; see `simulate_together`."""
    (recording,) = simulate_together([plan])
    return recording


def simulate_together(plans: Sequence[RecordingPlan]) -> list[Recording]:
    """Simulate traffic (SUMO) and vehicle dynamics (pybullet) in front of one or several cameras.

    Args:
        plans: One plan, or all plans with the same `leader`, in order. The cameras of several plans are in different
            parts of the town, and their frames are at interleaved times. Equal plans give equal recordings.

    Returns:
        A recording for each plan, with all its frames.

    Raises:
        UserError: The interval is not a multiple of 5 ms, no drawn camera sees enough road, or the site's flows do not
            fit its network.
    """
    first = plans[0]
    site, step = first.site, step_for(first.interval)
    rng = first.shared_rng(Stream.TRAFFIC)
    warm_up = round(rng.uniform(*SIMULATION_TIMES.warm_up_s) / step)
    stride, settle, ahead = round(first.interval / step), round(SIMULATION_TIMES.settle_s / step), reach(step)
    starts = [settle + stride * k // len(plans) for k in range(len(plans))]
    steps = max(start + (plan.frames - 1) * stride for plan, start in zip(plans, starts, strict=True)) + 1
    models, conditions = _models(first), [_conditions(plan) for plan in plans]
    cameras = _Cameras(plans, conditions, models, starts, stride)
    with (
        Traffic(
            site.town.network,
            models,
            vehicles_per_hour=site.vehicles_per_hour,
            duration=(warm_up + steps + ahead) * step,
            rng=rng,
            flows=site.flows,
            passing=RoadGraph.of(site.town).seen_by(site.road.camera, RECORDING_REACH.simulated_within_m)
            if site.road
            else frozenset(),
            step=step,
            watched=cameras.watch,
            riders=Riding.drawn(first.shared_rng(Stream.RIDERS)) if first.variation.road_users else USUAL_RIDERS,
        ) as traffic,
        World(step) as world,
    ):
        kinds = {trip.name: trip.model for trip in traffic.trips.values()}
        riders = Riders(kinds, first.rng_of, jointed=first.variation.road_users)
        traffic.warm_up(warm_up - ahead)
        snapshots: Iterable[Snapshot] = traffic.steps(steps + 2 * ahead)
        if first.variation.views:
            snapshots = list(snapshots)
            cameras.choose(snapshots[ahead:])
        cameras.set_up()
        for k, (snapshot, driven) in enumerate(drivable(snapshots, step)):
            near = [recorder.near(driven, traffic) for recorder in cameras.recorders]
            world.advance({name: vehicle for of_camera in near for name, vehicle in of_camera.items()})
            riding = riders.follow(snapshot.riders, step)
            for recorder, driven_near, walkers, start, plan in zip(
                cameras.recorders, near, cameras.walkers, starts, plans, strict=True
            ):
                frame, between = divmod(k - start, stride)
                if not between and 0 <= frame < plan.frames:
                    time = frame * stride * step
                    far = recorder.far(driven, traffic)
                    poses = {name: at_rest(*placed) for name, placed in far.items()} | world.poses()
                    recorder.add(time, driven_near | far, poses, snapshot, traffic)
                    recorder.add_bystanders({**riding, **walkers.at(time)})
    return cameras.recordings()


class _Cameras:
    """Cameras of plans that share their traffic, with their recorders and pedestrians."""

    def __init__(
        self,
        plans: Sequence[RecordingPlan],
        conditions: Sequence[Conditions],
        models: Mapping[str, FleetEntry],
        starts: Sequence[int],
        stride: int,
    ) -> None:
        self.recorders: list[Recorder] = []
        self.walkers: list[Walkers] = []
        self._plans, self._conditions, self._models = list(plans), conditions, models
        self._starts, self._stride = starts, stride
        variation = plans[0].variation
        self._cameras = [] if variation.views else [self._site_camera(plans[0], conditions[0])]
        if variation.town_jitter and not variation.views:
            self._move_to(_variant(plans[0], ()))
        if self._cameras:
            self._add_recorders()

    def _site_camera(self, plan: RecordingPlan, conditions: Conditions) -> Camera:
        return sample_camera(plan.site, _camera_ranges(plan, conditions), plan.rng(Stream.CAMERA))

    def watch(self, x: float, y: float) -> bool:
        """Return whether a vehicle at a position (world, metres) may be recorded; True until cameras are chosen."""
        return not self.recorders or any(recorder.watches(x, y) for recorder in self.recorders)

    def choose(self, snapshots: Sequence[Snapshot]) -> None:
        """Place cameras where they see the traffic of `snapshots`, which begin at step 0."""
        sampler = ViewSampler(self._plans[0].site.town)
        masts = []
        for plan, conditions, start in zip(self._plans, self._conditions, self._starts, strict=True):
            times = [start + k * self._stride for k in range(plan.frames)]
            traffic = _places([snapshots[k] for k in times])
            largest = plan.variation.largest_vehicle or CAMERA_SAMPLING.largest_vehicle
            view = sampler.draw(traffic, _camera_ranges(plan, conditions), plan.rng(Stream.CAMERA), largest)
            self._cameras.append(view.camera)
            fov = 2 * math.atan(view.camera.width / 2 / view.camera.K[0, 0])
            masts.append(replace(view.mast, fov_deg=round(math.degrees(fov), 3)))
        self._move_to(_variant(self._plans[0], tuple(masts)))
        self._add_recorders()

    def _move_to(self, variant: Variant) -> None:
        """Switch all plans to a variant of their town."""
        self._plans = [
            replace(plan, site=replace(plan.site, town=replace(plan.site.town, variant=variant)))
            for plan in self._plans
        ]

    def _add_recorders(self) -> None:
        for plan, camera, conditions in zip(self._plans, self._cameras, self._conditions, strict=True):
            self.recorders.append(Recorder(camera, plan, self._models, lamps_on=lamps_on(conditions)))

    def set_up(self) -> None:
        """Add parked vehicles and pedestrians around the cameras."""
        town, first = self._plans[0].site.town, self._plans[0]
        in_view = {bay: None for recorder in self.recorders for bay in recorder.in_view(bays_of(town))}
        rng, most = first.shared_rng(Stream.PARKED_VEHICLES), RECORDING_REACH.most_parked * len(self._plans)
        standing = parked_vehicles(town, list(in_view), self._models, rng, most=most)
        footprints = [vehicle.footprint(self._models[vehicle.model].vehicle) for vehicle in standing]
        masts = town.variant.masts if town.variant else ()
        places = [mast.position for mast in masts] or [first.site.position]
        cameras = zip(self._plans, places, self.recorders, self._conditions, strict=True)
        for plan, (x, y, _), recorder, conditions in cameras:
            recorder.park(standing)
            paths = sidewalks(town, (x, y), SIMULATION_TIMES.crowd_within_m)
            self.walkers.append(_walkers(plan, paths, footprints, raining=conditions.rain_mm_h > 0))

    def recordings(self) -> list[Recording]:
        """Return the recordings, one per camera."""
        each = zip(self.recorders, self._plans, self._cameras, self._conditions, strict=True)
        return [recorder.recording(plan, camera, conditions) for recorder, plan, camera, conditions in each]


def _walkers(plan: RecordingPlan, paths: Sequence[Array], parked: Sequence[Polygon], *, raining: bool) -> Walkers:
    if plan.variation.road_users:
        return Walkers.labelled(paths, plan.rng(Stream.CROWDS), parked, raining=raining)
    return Walkers(paths, plan.rng(Stream.PEDESTRIANS), parked)


def _conditions(plan: RecordingPlan) -> Conditions:
    site, variation = plan.site, plan.variation
    at_night = variation.night if site.time_of_day == "night" else {}
    spans = ranges(site.weather, site.time_of_day, {**site.conditions, **variation.settings, **at_night})
    return Conditions.drawn(spans, plan.rng(Stream.CONDITIONS))


def _camera_ranges(plan: RecordingPlan, conditions: Conditions) -> CameraRanges:
    return CameraRanges(plan.size, plan.fov_deg, conditions.distortion, plan.variation.cameras)


def _variant(plan: RecordingPlan, masts: tuple[Mast, ...]) -> Variant:
    """Return the variant of a plan's town. It is the same for all plans that share their traffic."""

    def seed(stream: Stream) -> int:
        return int(plan.shared_rng(stream).integers(1, 2**31))

    variation = plan.variation

    def count(stream: Stream, span: Range | None) -> int:
        low, high = span or (0, 0)
        return int(plan.shared_rng(stream).integers(int(low), int(high) + 1))

    randomised = plan.shared_rng(Stream.RANDOMISED).random() < variation.randomised
    return Variant(
        seed(Stream.VARIANT) if variation.town_jitter else 0,
        masts,
        distractors=count(Stream.DISTRACTORS, variation.distractors),
        lit_objects=count(Stream.LIT_OBJECTS, variation.lit_objects),
        season=seed(Stream.SEASON) if variation.town_jitter and variation.seasons else 0,
        randomised=seed(Stream.RANDOMISED) if randomised else 0,
    )


def _places(snapshots: Sequence[Snapshot]) -> Array:
    """Return the positions (F, V, 3) of vehicles on the road in snapshots, world; NaN for absent vehicles."""
    out = np.full((len(snapshots), max((len(s.vehicles) for s in snapshots), default=0), 3), np.nan)
    for row, snapshot in zip(out, snapshots, strict=True):
        for position, vehicle in zip(row, snapshot.vehicles.values(), strict=False):
            position[:] = (*vehicle.lane_point, vehicle.height)
    return out


def _models(plan: RecordingPlan) -> dict[str, FleetEntry]:
    """Return the models in the traffic: the fleet (without held-out models in the split `train`) and requested models.

    If a share is given, the requested models together have this share, in equal parts. The other models have the rest.
    """
    train = plan.site.split == "train"
    driving = fleet(further=plan.variation.further_models)
    usual = {name: entry for name, entry in driving.items() if not (train and entry.held_out)}
    models = in_town(usual, plan.site.town.name)
    asked = {name: _asked(name) for name in plan.vehicles}
    unrequested = {name: entry for name, entry in models.items() if name not in asked}
    total = sum(entry.share for entry in unrequested.values())
    if plan.vehicle_share is None:
        part = SIMULATION_TIMES.added_share * total
    elif plan.vehicle_share < 1:
        part = total * plan.vehicle_share / (1 - plan.vehicle_share) / len(asked)
    else:
        unrequested, part = {}, 1.0
    return unrequested | {name: FleetEntry(vehicle, part) for name, vehicle in asked.items()}


def _asked(name: str) -> Vehicle:
    """Return a requested model, of the fleet or of the user."""
    return fleet()[name].vehicle if name in fleet() else user_models.load_model(name)


def lamps_on(conditions: Conditions) -> bool:
    """Return whether vehicles drive with their lamps on: with a low sun, in poor visibility or in rain."""
    seen = (
        conditions.sun_elevation_deg >= SIMULATION_TIMES.lamps_on_deg
        and conditions.visibility_m >= SIMULATION_TIMES.lamps_on_visibility_m
    )
    return not seen or conditions.rain_mm_h > 0
