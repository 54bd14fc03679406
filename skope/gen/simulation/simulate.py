"""Simulate a recording: drive a site's traffic past its camera."""

from typing import Final

from skope.gen.scene import camera_sampling
from skope.gen.scene.conditions import Conditions, ranges
from skope.gen.scene.random_streams import Stream
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.scenery.build import scenery
from skope.gen.simulation.parked import parked
from skope.gen.simulation.pedestrians import Riders, Walkers
from skope.gen.simulation.physics import World, at_rest
from skope.gen.simulation.recorder import REACH, Recorder
from skope.gen.simulation.smooth_paths import drivable, reach
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.sidewalks import sidewalks
from skope.gen.traffic.demand import in_town
from skope.gen.traffic.sumo import Traffic, step_for
from skope.gen.vehicles import user_models
from skope.gen.vehicles.fleet import FleetEntry, fleet

CROWD_REACH: Final = 90.0
"""People on sidewalks nearer to the camera than this are recorded, metres."""
WARM_UP: Final = (60.0, 100.0)
"""Range of the time that traffic runs before a recording, seconds: the first vehicles have crossed the town by then."""
SETTLE: Final = 1.5
"""Time that the physics run before the first frame, seconds, so that springs have come to rest."""
ADDED_SHARE: Final = 0.1
"""Number of vehicles of each of the user's own models for one vehicle of the fleet."""
LAMPS_ON_DEG: Final = 10.0
"""Vehicles drive with their lamps lit when the sun's elevation is below this, degrees."""
LAMPS_ON_VISIBILITY: Final = 1000.0
"""Vehicles drive with their lamps lit when the visibility is below this, metres."""


def simulate(plan: RecordingPlan) -> Recording:
    """Simulate traffic (SUMO) and vehicle dynamics (pybullet) before a site's camera.

    Args:
        plan: Everything that decides the recording; equal plans give equal recordings.

    Returns:
        The recording, with all frames of the plan.

    Raises:
        UserError: The interval is no multiple of 5 ms, no camera that is drawn sees enough road, or the site's flows
            do not fit its network.
    """
    site = plan.site
    step = step_for(plan.interval)
    rng = plan.rng(Stream.TRAFFIC)
    warm_up = round(rng.uniform(*WARM_UP) / step)
    spans = ranges(site.weather, site.time_of_day, {**site.conditions, **plan.settings})
    conditions = Conditions.drawn(spans, plan.rng(Stream.CONDITIONS))
    camera = camera_sampling.drawn(
        site, plan.size, plan.fov_deg, conditions.distortion, plan.cameras, plan.rng(Stream.CAMERA)
    )
    stride, settle, ahead = round(plan.interval / step), round(SETTLE / step), reach(step)
    models = _models(plan)
    recorder = Recorder(camera, plan, models, lamps_on=lamps_on(conditions))
    paths = sidewalks(site.town, site.position[:2], CROWD_REACH)
    standing = parked(site.town, recorder.in_view(scenery(site.town).bays), models, plan.rng(Stream.PARKED_VEHICLES))
    recorder.park(standing)
    footprints = [one.footprint(models[one.model].vehicle) for one in standing]
    walkers = Walkers(paths, plan.rng(Stream.PEDESTRIANS), footprints)
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
            passing=RoadGraph.of(site.town).seen_by(site.road.camera, REACH) if site.road else frozenset(),
            step=step,
            watched=recorder.watches,
        ) as traffic,
        World(step) as world,
    ):
        riders = Riders({trip.name: trip.model for trip in traffic.trips.values()}, plan.rng_of)
        traffic.warm_up(warm_up - ahead)
        for k, (snapshot, driven) in enumerate(drivable(traffic.steps(steps + 2 * ahead), step)):
            near = recorder.near(driven, traffic)
            world.advance(near)
            riding = riders.follow(snapshot.riders, step)
            if k >= settle and (k - settle) % stride == 0:
                time = (k - settle) * step
                far = recorder.far(driven, traffic)
                poses = world.poses() | {name: at_rest(*placed) for name, placed in far.items()}
                recorder.add(time, near | far, poses, snapshot, traffic)
                recorder.add_others({**riding, **walkers.at(time)})
    return recorder.recording(plan, camera, conditions)


def _models(plan: RecordingPlan) -> dict[str, FleetEntry]:
    """Models that drive by: the fleet (in the split `train` without held-out models) and the user's own models."""
    train = plan.site.split == "train"
    usual = {name: entry for name, entry in fleet().items() if not (train and entry.held_out)}
    models = in_town(usual, plan.site.town.name)
    share = ADDED_SHARE * sum(entry.share for entry in models.values())
    return models | {name: FleetEntry(user_models.load(name), share) for name in plan.vehicles}


def lamps_on(conditions: Conditions) -> bool:
    """Whether vehicles drive with their lamps lit: at a low sun, in bad visibility and in rain."""
    seen = conditions.sun_elevation_deg >= LAMPS_ON_DEG and conditions.visibility_m >= LAMPS_ON_VISIBILITY
    return not seen or conditions.rain_mm_h > 0
