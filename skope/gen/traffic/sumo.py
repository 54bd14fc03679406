"""Traffic by SUMO (libsumo): where every road user is at each step.

The only module that imports libsumo. SUMO places a vehicle by the middle of its front bumper and measures angles as
compass degrees; both are converted here, once.
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
from typing import Final, NamedTuple

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
    """Steps of SUMO, and what is kept of each vehicle."""

    default_s: float = 0.025
    """Default length of a step, seconds."""
    lengths_ms: tuple[int, int, int, int] = (25, 20, 10, 5)
    """Lengths that a step can have, ms: SUMO counts whole milliseconds and its drivers act every 100 of them."""
    road_behind_step_m: float = 0.05
    """Spacing of the places that are kept of the road behind a vehicle, metres."""
    road_behind_m: float = 25.0
    """Length of the road behind a vehicle that is kept, metres."""
    watch_every: int = 4
    """Steps between two checks of whether a vehicle that is not reported has come into the watched area."""
    lane_point_share: float = math.sqrt(0.5)
    """Distance of the lane point from the rear axle, as a share of the wheelbase. The lane point of a vehicle is the
    one that is kept on the middle of the lane; with this share the front axle runs as far outside in curves as the rear
    axle inside."""


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
"""SUMO's options: vehicles never vanish from a jam, and change lanes sideways in 0.6 m steps."""


def step_for(interval: float) -> float:
    """Length of the longest step, seconds, that divides `interval`, the seconds between frames.

    Raises UserError where no length that SUMO can run with does.
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
    """From the rear axle forwards to the lane point (see `SUMO_STEPS.lane_point_share`)."""
    middle: float
    """From the rear axle forwards to the vehicle's middle."""
    front_axle: float
    """From the front bumper back to the front axle."""
    hitch: Hitch | None = None
    """The trailer of an articulated vehicle."""

    @classmethod
    def of(cls, vehicle: Vehicle) -> "Chassis":
        """The distances of a vehicle."""
        shape = vehicle.shape
        lane_point = SUMO_STEPS.lane_point_share * shape.wheelbase
        return cls(shape.wheelbase, lane_point, -shape.rear_axle_x, shape.front_overhang, Hitch.of(vehicle))


class SumoTrailer(NamedTuple):
    """Trailer of an articulated vehicle, which follows it along the middle of its lane."""

    yaw: float
    """Heading, counter-clockwise from east, radians."""
    height: float
    """Height of the road under its axles, metres."""


class SumoVehicle(NamedTuple):
    """State of a vehicle in SUMO at one step; there are tens of thousands in a recording, hence a tuple."""

    chassis: Chassis
    lane_point: tuple[float, float]
    """World x and y of the vehicle's lane point (see `SUMO_STEPS.lane_point_share`), metres."""
    driven: float
    """Distance that the vehicle has driven since it was first seen, metres."""
    height: float
    """Height of the road under the vehicle's middle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road from axle to axle, uphill positive, radians."""
    speed: float
    """m/s."""
    lamps: int
    """Lamps that are lit, as bits of `LAMP_BITS`."""
    trailer: SumoTrailer | None = None


@dataclass(frozen=True)
class SumoRider:
    """State of a bicycle or motorcycle in SUMO at one step."""

    position: tuple[float, float, float]
    """World: on the road under the middle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road, uphill positive, radians."""
    speed: float
    """m/s."""


@dataclass(frozen=True)
class Snapshot:
    """Everything that moves in SUMO at one step, by name."""

    time: float
    """Seconds since the simulation began."""
    vehicles: Mapping[str, SumoVehicle]
    riders: Mapping[str, SumoRider]
    signals: Mapping[str, str]
    """SUMO's state string of each signal program."""


_Place = tuple[float, float, float]


class _RoadBehind:
    """The road behind a vehicle: where its front bumper was, (x, y, z) in metres, by the distance driven."""

    def __init__(self, begun: float, place: _Place, yaw: float, slope: float) -> None:
        """Start with the vehicle at `place`; `begun` are the metres it has driven by SUMO's count.

        The road before is assumed to be straight, with the heading `yaw` and the slope `slope`, radians.
        """
        self.begun = begun
        x, y, z = place
        level = SUMO_STEPS.road_behind_m * math.cos(slope)
        behind = (x - level * math.cos(yaw), y - level * math.sin(yaw), z - SUMO_STEPS.road_behind_m * math.sin(slope))
        self._driven = [-SUMO_STEPS.road_behind_m, 0.0]
        self._places = [behind, place]

    def add(self, driven: float, place: _Place) -> None:
        """Note the bumper's place after `driven` metres, and forget what lies too far back."""
        if driven - self._driven[-1] >= SUMO_STEPS.road_behind_step_m:
            self._driven.append(driven)
            self._places.append(place)
            if driven - self._driven[0] > 2 * SUMO_STEPS.road_behind_m:
                first = next(i for i, at in enumerate(self._driven) if at > driven - SUMO_STEPS.road_behind_m) - 1
                del self._driven[:first], self._places[:first]

    def at(self, driven: float) -> tuple[float, float]:
        """x and y of where the bumper was after `driven` metres, interpolated."""
        (ax, ay, _), (bx, by, _), share = self._around(driven)
        return ax + (bx - ax) * share, ay + (by - ay) * share

    def height(self, driven: float) -> float:
        """Height of the road where the bumper was after `driven` metres."""
        (_, _, az), (_, _, bz), share = self._around(driven)
        return az + (bz - az) * share

    def _around(self, driven: float) -> tuple[_Place, _Place, float]:
        """The known places before and after `driven` metres, and the share of the way from the one to the other."""
        known = self._driven
        after = bisect(known, driven)
        if after == len(known):
            after -= 1
        start = known[after - 1]
        share = (driven - start) / (known[after] - start)
        return self._places[after - 1], self._places[after], share if share < 1.0 else 1.0


class Traffic:
    """A running SUMO simulation; there can be one in a process at a time. Use as a context manager."""

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
        """Draw the traffic; SUMO starts when the context is entered.

        Args:
            network: Compiled SUMO network.
            fleet: Models that drive, by name.
            vehicles_per_hour: Traffic on all ways into the network together.
            duration: Seconds for which trips are drawn.
            rng: Draws trips, models, drivers and SUMO's seed.
            flows: Text of a SUMO route file, in place of `vehicles_per_hour`.
            passing: Edges; where given, `vehicles_per_hour` counts only trips over one of them.
            step: Length of a step, seconds.
            watched: Whether a place (world x, y in metres) is watched. A vehicle is reported from the first time that
                it comes to a watched place. Default: everywhere.
            riders: How many riders there are among those who are drawn, and how they ride.

        Raises:
            UserError: `flows` does not fit the network.
        """
        self._network, self._fleet, self._step, self._watched = network, fleet, step, watched
        self._riders = riders
        # Drawn before the trips: a longer recording draws more trips, and must still begin like a shorter one.
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
        import libsumo

        self._sumo = libsumo
        options = {
            **SUMO_OPTIONS,
            "step-length": self._step,
            "net-file": self._network,
            "seed": self._seed,
        }
        # In memory where the system can: SUMO takes a comma in the name of a folder for the end of the file's name.
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
        """Run some steps without reporting anything."""
        for _ in range(steps):
            self._go_on()

    def _go_on(self) -> tuple[str, ...]:
        """Run a step; returns the names of all vehicles in the network."""
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
        """The road behind a vehicle, its present place included, and the metres that it has driven."""
        vehicle = self._sumo.vehicle
        driven, place = vehicle.getDistance(name), vehicle.getPosition3D(name)
        road = self._roads_behind.get(name)
        if road is None:
            slope, yaw = math.radians(vehicle.getSlope(name)), math.radians(90.0 - vehicle.getAngle(name))
            road = self._roads_behind[name] = _RoadBehind(driven, place, yaw, slope)
        driven -= road.begun
        road.add(driven, place)
        chassis = self._chassis.get(self.trips[name].model)
        if chassis and chassis.hitch:
            self._draw_trailer(name, chassis, chassis.hitch, driven)
        return road, driven

    def _draw_trailer(self, name: str, chassis: Chassis, hitch: Hitch, driven: float) -> None:
        """Let a vehicle's trailer follow; from the network's rim on, so that it never is where none could be."""
        place = self._roads_behind[name].at(driven - chassis.front_axle - chassis.wheelbase + hitch.hinge)
        yaw = math.radians(90.0 - self._sumo.vehicle.getAngle(name))
        if name not in self._trailers:
            self._trailers[name] = Follower(hitch, *place, yaw)
        self._trailers[name].follow(*place, yaw)

    def steps(self, count: int) -> Iterator[Snapshot]:
        """Run some steps and report each; see `step`."""
        for _ in range(count):
            yield self.step()

    def step(self) -> Snapshot:
        """Run a step; returns where all reported vehicles and riders are, and the state of the signals."""
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
    """Bits of `LAMP_BITS` for the bits that SUMO has for a vehicle's signals."""
    return sum(ours for theirs, ours in _SUMO_LAMPS.items() if signals & theirs)
