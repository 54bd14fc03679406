"""Traffic by SUMO (libsumo): where every road user is at each step.

The only module that imports libsumo. SUMO places a vehicle by the middle of its front bumper and measures angles as
compass degrees; both are converted here, once.
"""

import math
import tempfile
from bisect import bisect
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np

from skope.errors import UserError
from skope.gen.traffic.demand import RIDERS, Trip, trips, write_types
from skope.gen.traffic.route_files import scheduled
from skope.gen.vehicles.fleet import FleetEntry
from skope.gen.vehicles.shape import Dimensions

STEP: Final = 0.025
"""Seconds a step, where the frames' interval is a multiple of it."""
_STEPS_MS: Final = (25, 20, 10, 5)
"""What a step can be: SUMO counts whole milliseconds and its drivers act every 100 of them."""

LAMPS: Final = {"low_beam": 1, "brake": 2, "indicator_left": 4, "indicator_right": 8, "reverse": 16}
_SUMO_LAMPS: Final = {1: LAMPS["indicator_right"], 2: LAMPS["indicator_left"], 8: LAMPS["brake"]}

_OPTIONS: Final = {
    **{"no-step-log": "", "no-warnings": "", "time-to-teleport": -1, "collision.action": "none"},
    **{"lateral-resolution": 0.6, "default.action-step-length": 0.1},
}
_TRAIL_STEP: Final = 0.05
"""Metres between the heights that are kept of the road that a vehicle has passed."""
_GLANCE: Final = 4
"""Steps from look to look at vehicles that are not reported."""
_TRAIL: Final = 25.0
"""How far back they are kept, metres."""


def step_for(interval: float) -> float:
    """The longest step that frames `interval` seconds apart are whole numbers of; UserError when there is none."""
    milliseconds = round(1000 * interval)
    fits = [ms for ms in _STEPS_MS if milliseconds >= ms and milliseconds % ms == 0]
    if not fits or abs(1000 * interval - milliseconds) > 1e-6:
        raise UserError(f"--interval: expected a multiple of 0.005 seconds, got {interval:g}")
    return fits[0] / 1000


GUIDE: Final = math.sqrt(0.5)
"""Where on the wheelbase the point is that is kept on the middle of the lane, from the rear axle: in curves the front
axle then runs as far outside as the rear axle inside."""


@dataclass(frozen=True)
class Chassis:
    """Places along a vehicle, metres."""

    wheelbase: float
    guide: float
    """Of the point that follows the lane, ahead of the rear axle."""
    middle: float
    """Of the vehicle's middle, ahead of the rear axle."""
    front_axle: float
    """Of the front axle, behind the front bumper."""

    @classmethod
    def of(cls, shape: Dimensions) -> "Chassis":
        return cls(shape.wheelbase, GUIDE * shape.wheelbase, -shape.rear_axle_x, shape.front_overhang)


@dataclass(frozen=True)
class SumoVehicle:
    """Where SUMO has a vehicle at one step."""

    chassis: Chassis
    guide: tuple[float, float]
    """World: the place on its way over which the point that follows the lane is, metres."""
    driven: float
    """How far it has come, metres."""
    height: float
    """Of the road under the vehicle's middle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road from axle to axle, uphill positive, radians."""
    speed: float
    lamps: int


@dataclass(frozen=True)
class SumoRider:
    """Somebody on two wheels at one step."""

    position: tuple[float, float, float]
    """World: on the road under the middle, metres."""
    yaw: float
    pitch: float
    speed: float


@dataclass(frozen=True)
class Snapshot:
    time: float
    vehicles: Mapping[str, SumoVehicle]
    riders: Mapping[str, SumoRider]
    signals: Mapping[str, str]
    """SUMO's state string of each signal program."""


class _Trail:
    """The road that a vehicle's front bumper has passed: (x, y, z) by the distance driven."""

    def __init__(self, begun: float, place: tuple[float, float, float], yaw: float, slope: float) -> None:
        """`begun` is how far SUMO says that the vehicle had come when it was first looked at."""
        self.begun = begun
        x, y, z = place
        level = _TRAIL * math.cos(slope)
        behind = (x - level * math.cos(yaw), y - level * math.sin(yaw), z - _TRAIL * math.sin(slope))
        self._driven = [-_TRAIL, 0.0]
        self._places = [behind, place]

    def add(self, driven: float, place: tuple[float, float, float]) -> None:
        if driven - self._driven[-1] >= _TRAIL_STEP:
            self._driven.append(driven)
            self._places.append(place)
            if driven - self._driven[0] > 2 * _TRAIL:
                first = next(i for i, at in enumerate(self._driven) if at > driven - _TRAIL) - 1
                del self._driven[:first], self._places[:first]

    def at(self, driven: float) -> tuple[float, float, float]:
        """Where the bumper was when it had come so far."""
        after = min(bisect(self._driven, driven), len(self._driven) - 1)
        start, end = self._driven[after - 1], self._driven[after]
        (ax, ay, az), (bx, by, bz) = self._places[after - 1], self._places[after]
        share = min((driven - start) / (end - start), 1.0)
        return ax + (bx - ax) * share, ay + (by - ay) * share, az + (bz - az) * share


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
        step: float = STEP,
        watched: Callable[[float, float], bool] = lambda x, y: True,
    ) -> None:
        """`flows` is a route file's text, in place of a density; with `passing`, that is of those over such edges.

        A vehicle is reported from the first time that `watched` says of its place, metres, that somebody looks there.
        """
        self._network, self._fleet, self._step, self._watched = network, fleet, step, watched
        # Drawn before the trips, of which a longer recording has more: it begins like a shorter one.
        self._seed = int(rng.integers(1, 2**30))
        planned = (
            scheduled(flows, network, fleet, duration=duration, rng=rng)
            if flows
            else trips(network, fleet, vehicles_per_hour=vehicles_per_hour, duration=duration, rng=rng, passing=passing)
        )
        self.trips: Mapping[str, Trip] = {trip.name: trip for trip in planned}
        self._chassis = {name: Chassis.of(entry.vehicle.shape) for name, entry in fleet.items()}
        self._trails: dict[str, _Trail] = {}
        self._reported: set[str] = set()
        self._steps = 0

    def __enter__(self) -> "Traffic":
        import libsumo

        self._sumo = libsumo
        options = {
            **_OPTIONS,
            "step-length": self._step,
            "net-file": self._network,
            "seed": self._seed,
        }
        with tempfile.TemporaryDirectory() as folder:
            types = Path(folder) / "types.add.xml"
            write_types(types, self._fleet)
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
        """Go on by some steps, of which nothing is reported."""
        for _ in range(steps):
            self._go_on()

    def _go_on(self) -> tuple[str, ...]:
        """Go on by a step. Returns who is there."""
        sumo = self._sumo
        sumo.simulationStep()
        present: tuple[str, ...] = sumo.vehicle.getIDList()
        if self._steps % _GLANCE == 0:
            for gone in self._trails.keys() - set(present):
                del self._trails[gone]
            for name in present:
                self._trail(name)
                if name not in self._reported and self._watched(*sumo.vehicle.getPosition(name)):
                    self._reported.add(name)
        self._steps += 1
        return present

    def _trail(self, name: str) -> tuple[_Trail, float]:
        """A vehicle's trail with its present place in it, and how far it has driven."""
        vehicle = self._sumo.vehicle
        driven, place = vehicle.getDistance(name), vehicle.getPosition3D(name)
        if name not in self._trails:
            slope, yaw = math.radians(vehicle.getSlope(name)), math.radians(90.0 - vehicle.getAngle(name))
            self._trails[name] = _Trail(driven, place, yaw, slope)
        driven -= self._trails[name].begun
        self._trails[name].add(driven, place)
        return self._trails[name], driven

    def steps(self, count: int) -> Iterator[Snapshot]:
        """Go on by some steps, and say at each where everyone is."""
        for _ in range(count):
            yield self.step()

    def step(self) -> Snapshot:
        """Go on by a step and say where everyone is who is watched."""
        sumo = self._sumo
        present = [name for name in self._go_on() if name in self._reported]
        riders = {name for name in present if self.trips[name].model in RIDERS}
        return Snapshot(
            sumo.simulation.getTime(),
            {name: self._placed(name) for name in present if name not in riders},
            {name: self._ridden(name) for name in riders},
            {name: sumo.trafficlight.getRedYellowGreenState(name) for name in sumo.trafficlight.getIDList()},
        )

    def _placed(self, name: str) -> SumoVehicle:
        vehicle = self._sumo.vehicle
        chassis = self._chassis[self.trips[name].model]
        trail, driven = self._trail(name)
        front = driven - chassis.front_axle
        x, y, _ = trail.at(front - chassis.wheelbase + chassis.guide)
        ahead, behind = trail.at(front)[2], trail.at(front - chassis.wheelbase)[2]
        slope = (ahead - behind) / chassis.wheelbase
        return SumoVehicle(
            chassis=chassis,
            guide=(x, y),
            driven=driven,
            height=behind + chassis.middle * slope,
            yaw=math.radians(90.0 - vehicle.getAngle(name)),
            pitch=math.atan(slope),
            speed=vehicle.getSpeed(name),
            lamps=_lamps(vehicle.getSignals(name)),
        )

    def _ridden(self, name: str) -> SumoRider:
        vehicle = self._sumo.vehicle
        x, y, _ = vehicle.getPosition3D(name)
        yaw = math.radians(90.0 - vehicle.getAngle(name))
        length = vehicle.getLength(name)
        trail, driven = self._trail(name)
        ahead, behind = (trail.at(driven - share * length)[2] for share in (0.2, 0.8))
        back, pitch = length / 2, math.atan2(ahead - behind, 0.6 * length)
        position = (x - back * math.cos(yaw), y - back * math.sin(yaw), (ahead + behind) / 2)
        return SumoRider(position, yaw, pitch, vehicle.getSpeed(name))


@cache
def _lamps(signals: int) -> int:
    """SUMO's bits of a vehicle's signals as ours of `LAMPS`."""
    return sum(ours for theirs, ours in _SUMO_LAMPS.items() if signals & theirs)
