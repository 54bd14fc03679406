"""Traffic simulation with SUMO (libsumo): the state of every road user at each step.

Only this module imports libsumo. SUMO uses the middle of the front bumper as the position of a vehicle, and compass
degrees as its angle. Both are converted here.
"""

import contextlib
import math
import os
import tempfile
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np

from skope.errors import UserError
from skope.gen.scene.recording import LAMP_BITS
from skope.gen.traffic.demand import RIDER_CLASSES, USUAL_RIDERS, Riding, Trip, trips, write_types
from skope.gen.traffic.route_files import scheduled
from skope.gen.vehicles.fleet import FleetEntry
from skope.gen.vehicles.model import Vehicle
from skope.gen.vehicles.trailer_motion import Follower, Hitch


@dataclass(frozen=True)
class SumoSteps:
    """Step lengths of SUMO, and the data kept for each vehicle."""

    default_s: float = 0.025
    """Default length of a step, seconds."""
    lengths_ms: tuple[int, int, int, int] = (25, 20, 10, 5)
    """Permitted lengths of a step, ms. SUMO counts whole milliseconds, and its drivers act every 100 ms."""
    road_behind_step_m: float = 0.05
    """Spacing of the stored points of the road behind a vehicle, metres."""
    road_behind_m: float = 25.0
    """Stored length of the road behind a vehicle, metres."""
    watch_every: int = 4
    """Number of steps between two checks of whether further vehicles have entered the watched area."""
    lane_point_share: float = math.sqrt(0.5)
    """Distance of the lane point from the rear axle, as a fraction of the wheelbase.

    The lane point of a vehicle is the point that is kept on the centre line of the lane. With this fraction, the front
    axle runs as far outside the centre line in curves as the rear axle runs inside."""


SUMO_STEPS: Final = SumoSteps()


_SUMO_LAMPS: Final = {1: LAMP_BITS["indicator_right"], 2: LAMP_BITS["indicator_left"], 8: LAMP_BITS["brake"]}

SUMO_OPTIONS: Final = {
    "no-step-log": "",
    "no-warnings": "",
    "time-to-teleport": -1,
    "collision.action": "none",
    "lateral-resolution": 0.6,
    "default.action-step-length": 0.1,
}
"""SUMO options: vehicles are never removed from a jam, and change lanes sideways in steps of 0.6 m."""


def step_for(interval: float) -> float:
    """Return the longest step, seconds, that divides `interval`, the time between frames in seconds.

    Raises UserError if no permitted step length divides it.
    """
    milliseconds = round(1000 * interval)
    fits = [ms for ms in SUMO_STEPS.lengths_ms if milliseconds >= ms and milliseconds % ms == 0]
    if not fits or abs(1000 * interval - milliseconds) > 1e-6:
        raise UserError(f"--interval: expected a multiple of 0.005 seconds, got {interval:g}")
    return fits[0] / 1000


@dataclass(frozen=True)
class Chassis:
    """Distances along a vehicle, metres."""

    wheelbase: float
    lane_point: float
    """Distance from the rear axle forwards to the lane point (see `SUMO_STEPS.lane_point_share`)."""
    middle: float
    """Distance from the rear axle forwards to the vehicle's middle."""
    front_axle: float
    """Distance from the front bumper back to the front axle."""
    hitch: Hitch | None = None
    """Trailer of an articulated vehicle; None for other vehicles."""

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Chassis":
        """Return the distances of a vehicle."""
        shape = vehicle.shape
        lane_point = SUMO_STEPS.lane_point_share * shape.wheelbase
        return cls(shape.wheelbase, lane_point, -shape.rear_axle_x, shape.front_overhang, Hitch.of(vehicle))


class SumoTrailer(NamedTuple):
    """Trailer of an articulated vehicle, following it along the centre line of its lane."""

    yaw: float
    """Heading, counter-clockwise from east, radians."""
    height: float
    """Height of the road under the trailer's axles, metres."""


class SumoVehicle(NamedTuple):
    """State of a vehicle in SUMO at one step; a tuple because a recording has tens of thousands of them."""

    chassis: Chassis
    lane_point: tuple[float, float]
    """World x and y of the vehicle's lane point (see `SUMO_STEPS.lane_point_share`), metres."""
    driven: float
    """Distance that the vehicle has travelled since it was first seen, metres."""
    height: float
    """Height of the road under the vehicle's middle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road from axle to axle, radians; uphill is positive."""
    speed: float
    """Speed, m/s."""
    lamps: int
    """Lit lamps, as bits of `LAMP_BITS`."""
    trailer: SumoTrailer | None = None


@dataclass(frozen=True)
class SumoRider:
    """State of a bicycle or motorcycle in SUMO at one step."""

    position: tuple[float, float, float]
    """World position on the road under the middle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road, radians; uphill is positive."""
    speed: float
    """Speed, m/s."""


@dataclass(frozen=True)
class Snapshot:
    """States of all moving road users in SUMO at one step, by name, and of the signals."""

    time: float
    """Time since the start of the simulation, seconds."""
    vehicles: Mapping[str, SumoVehicle]
    riders: Mapping[str, SumoRider]
    signals: Mapping[str, str]
    """SUMO state string of each signal program."""


_Point = tuple[float, float, float]


class _RoadBehind:
    """Road behind a vehicle: the positions (x, y, z) of its front bumper in metres, by travelled distance."""

    def __init__(self, begun: float, position: _Point, yaw: float, slope: float) -> None:
        """Start with the vehicle at `position`; `begun` is the distance that it has travelled in SUMO, metres.

        The road behind that point is assumed to be straight, with the heading `yaw` and the slope `slope`, radians.
        """
        self.begun = begun
        x, y, z = position
        level = SUMO_STEPS.road_behind_m * math.cos(slope)
        behind = (x - level * math.cos(yaw), y - level * math.sin(yaw), z - SUMO_STEPS.road_behind_m * math.sin(slope))
        self._driven = [-SUMO_STEPS.road_behind_m, 0.0]
        self._places = [behind, position]

    def add(self, driven: float, position: _Point) -> None:
        """Add the bumper's position after `driven` metres, and drop positions that are too far back."""
        if driven - self._driven[-1] >= SUMO_STEPS.road_behind_step_m:
            self._driven.append(driven)
            self._places.append(position)
            if driven - self._driven[0] > 2 * SUMO_STEPS.road_behind_m:
                first = next(i for i, at in enumerate(self._driven) if at > driven - SUMO_STEPS.road_behind_m) - 1
                del self._driven[:first], self._places[:first]

    def at(self, driven: float) -> tuple[float, float]:
        """Return the interpolated x and y of the bumper after `driven` metres."""
        (ax, ay, _), (bx, by, _), share = self._around(driven)
        return ax + (bx - ax) * share, ay + (by - ay) * share

    def height(self, driven: float) -> float:
        """Return the height of the road at the bumper after `driven` metres."""
        (_, _, az), (_, _, bz), share = self._around(driven)
        return az + (bz - az) * share

    def _around(self, driven: float) -> tuple[_Point, _Point, float]:
        """Return the stored positions before and after `driven` metres, and the interpolation weight of the second."""
        known = self._driven
        after = bisect(known, driven)
        if after == len(known):
            after -= 1
        start = known[after - 1]
        share = (driven - start) / (known[after] - start)
        return self._places[after - 1], self._places[after], share if share < 1.0 else 1.0


def load_libsumo() -> Any:
    """Return libsumo, without its warning about the version of pyarrow: skope does not use Arrow."""
    key = "LIBSUMO_AS_TRACI"
    before = os.environ.get(key)
    os.environ[key] = "quiet"
    try:
        import libsumo
    finally:
        if before is None:
            del os.environ[key]
        else:
            os.environ[key] = before
    return libsumo


class Traffic:
    """A running SUMO simulation; at most one per process. Use as a context manager."""

    def __init__(
        self,
        network: Path,
        fleet: Mapping[str, FleetEntry],
        *,
        vehicles_per_hour: float,
        duration: float,
        rng: np.random.Generator,
        flows: str = "",
        passing: frozenset[str] = frozenset(),
        step: float = SUMO_STEPS.default_s,
        watched: Callable[[float, float], bool] = lambda x, y: True,
        riders: Riding = USUAL_RIDERS,
    ) -> None:
        """Sample the trips. SUMO starts when the context is entered.

        Args:
            network: Compiled SUMO network.
            fleet: Models in the traffic, by name.
            vehicles_per_hour: Total arrival rate on all entries of the network.
            duration: Time for which trips are sampled, seconds.
            rng: Random generator for trips, models, drivers and SUMO's seed.
            flows: Text of a SUMO route file, used instead of `vehicles_per_hour`.
            passing: Edges; if given, `vehicles_per_hour` counts only trips over at least one of them.
            step: Length of a step, seconds.
            watched: Function that returns whether a position (world x, y in metres) is watched. A vehicle is reported
                once it has entered a watched position. Default: everywhere.
            riders: Number of riders per vehicle in sampled traffic, and their riding style.

        Raises:
            UserError: `flows` does not fit the network.
        """
        self._network, self._fleet, self._step, self._watched = network, fleet, step, watched
        self._riders = riders
        # SUMO's seed is sampled before the trips, so a longer recording (with more trips) begins like a shorter one.
        self._seed = int(rng.integers(1, 2**30))
        planned = (
            scheduled(flows, network, fleet, duration=duration, rng=rng)
            if flows
            else trips(
                network,
                fleet,
                vehicles_per_hour=vehicles_per_hour,
                duration=duration,
                rng=rng,
                passing=passing,
                riders=riders,
            )
        )
        self.trips: Mapping[str, Trip] = {trip.name: trip for trip in planned}
        self._chassis = {name: Chassis.of(entry.vehicle) for name, entry in fleet.items()}
        self._roads_behind: dict[str, _RoadBehind] = {}
        self._trailers: dict[str, Follower] = {}
        self._reported: set[str] = set()
        self._steps = 0

    def __enter__(self) -> "Traffic":
        libsumo = self._sumo = load_libsumo()
        options = {
            **SUMO_OPTIONS,
            "step-length": self._step,
            "net-file": self._network,
            "seed": self._seed,
        }
        # In memory if possible, since SUMO takes a comma in a folder's name for the end of the file's name.
        with contextlib.ExitStack() as stack:
            if hasattr(os, "memfd_create"):
                file = stack.enter_context(os.fdopen(os.memfd_create("types"), "wb"))
                types = Path(f"/proc/self/fd/{file.fileno()}")
            else:
                types = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "types.add.xml"
            write_types(types, self._fleet, self._riders)
            options["additional-files"] = types
            pairs = ((f"--{name}", *([str(value)] if value != "" else [])) for name, value in options.items())
            libsumo.start(["sumo", *(word for pair in pairs for word in pair)])
        for trip in self.trips.values():
            route = f"route_{trip.name}"
            libsumo.route.add(route, trip.edges)
            libsumo.vehicle.add(
                trip.name, route, typeID=trip.type_id, depart=f"{trip.depart:.3f}", departLane="best", departSpeed="max"
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._sumo.close()

    def warm_up(self, steps: int) -> None:
        """Run a number of steps without reporting."""
        for _ in range(steps):
            self._go_on()

    def _go_on(self) -> tuple[str, ...]:
        """Run a step and return the names of all vehicles in the network."""
        sumo = self._sumo
        sumo.simulationStep()
        present: tuple[str, ...] = sumo.vehicle.getIDList()
        if self._steps % SUMO_STEPS.watch_every == 0:
            for gone in self._roads_behind.keys() - set(present):
                del self._roads_behind[gone]
                self._trailers.pop(gone, None)
            for name in present:
                self._road_behind(name)
                if name not in self._reported and self._watched(*sumo.vehicle.getPosition(name)):
                    self._reported.add(name)
        self._steps += 1
        return present

    def _road_behind(self, name: str) -> tuple[_RoadBehind, float]:
        """Return the road behind a vehicle, including its present position, and the distance travelled, metres."""
        vehicle = self._sumo.vehicle
        driven, position = vehicle.getDistance(name), vehicle.getPosition3D(name)
        road = self._roads_behind.get(name)
        if road is None:
            slope, yaw = math.radians(vehicle.getSlope(name)), math.radians(90.0 - vehicle.getAngle(name))
            road = self._roads_behind[name] = _RoadBehind(driven, position, yaw, slope)
        driven -= road.begun
        road.add(driven, position)
        chassis = self._chassis.get(self.trips[name].model)
        if chassis and chassis.hitch:
            self._draw_trailer(name, chassis, chassis.hitch, driven)
        return road, driven

    def _draw_trailer(self, name: str, chassis: Chassis, hitch: Hitch, driven: float) -> None:
        """Move a vehicle's trailer; it follows from the edge of the network on, so its pose is plausible."""
        position = self._roads_behind[name].at(driven - chassis.front_axle - chassis.wheelbase + hitch.hinge)
        yaw = math.radians(90.0 - self._sumo.vehicle.getAngle(name))
        if name not in self._trailers:
            self._trailers[name] = Follower(hitch, *position, yaw)
        self._trailers[name].follow(*position, yaw)

    def steps(self, count: int) -> Iterator[Snapshot]:
        """Run a number of steps and report each; see `step`."""
        for _ in range(count):
            yield self.step()

    def step(self) -> Snapshot:
        """Run a step and return the states of all reported vehicles and riders, and of the signals."""
        sumo = self._sumo
        present = [name for name in self._go_on() if name in self._reported]
        riders = {name for name in present if self.trips[name].model in RIDER_CLASSES}
        return Snapshot(
            sumo.simulation.getTime(),
            {name: self._vehicle_state(name) for name in present if name not in riders},
            {name: self._rider_state(name) for name in riders},
            {name: sumo.trafficlight.getRedYellowGreenState(name) for name in sumo.trafficlight.getIDList()},
        )

    def _vehicle_state(self, name: str) -> SumoVehicle:
        vehicle = self._sumo.vehicle
        chassis = self._chassis[self.trips[name].model]
        road, driven = self._road_behind(name)
        front = driven - chassis.front_axle
        rear = front - chassis.wheelbase
        ahead, behind = road.height(front), road.height(rear)
        slope = (ahead - behind) / chassis.wheelbase
        trailer = None
        if chassis.hitch:
            under = road.height(rear + chassis.hitch.hinge - chassis.hitch.axle)
            trailer = SumoTrailer(self._trailers[name].yaw, under)
        return SumoVehicle(
            chassis=chassis,
            lane_point=road.at(rear + chassis.lane_point),
            driven=driven,
            height=behind + chassis.middle * slope,
            yaw=math.radians(90.0 - vehicle.getAngle(name)),
            pitch=math.atan(slope),
            speed=vehicle.getSpeed(name),
            lamps=_lamps(vehicle.getSignals(name)),
            trailer=trailer,
        )

    def _rider_state(self, name: str) -> SumoRider:
        vehicle = self._sumo.vehicle
        x, y, _ = vehicle.getPosition3D(name)
        yaw = math.radians(90.0 - vehicle.getAngle(name))
        length = vehicle.getLength(name)
        road, driven = self._road_behind(name)
        ahead, behind = (road.height(driven - share * length) for share in (0.2, 0.8))
        back, pitch = length / 2, math.atan2(ahead - behind, 0.6 * length)
        position = (x - back * math.cos(yaw), y - back * math.sin(yaw), (ahead + behind) / 2)
        return SumoRider(position, yaw, pitch, vehicle.getSpeed(name))


@cache
def _lamps(signals: int) -> int:
    """Convert SUMO's signal bits of a vehicle to bits of `LAMP_BITS`."""
    return sum(ours for theirs, ours in _SUMO_LAMPS.items() if signals & theirs)
