"""Traffic by SUMO (libsumo): where every road user is at each step.

The only module that imports libsumo. SUMO places a vehicle by the middle of its front bumper and measures angles as
compass degrees; both are converted here, once.
"""

import math
import tempfile
from bisect import bisect
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from skope.errors import UserError
from skope.gen.demand import RIDERS, Trip, trips, write_types
from skope.gen.flows import scheduled
from skope.gen.vehicles import FleetEntry

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
_TRAIL_EVERY: Final = 4
"""Steps between the heights that are kept while nobody watches."""
_TRAIL: Final = 25.0
"""How far back they are kept, metres."""


def step_for(interval: float) -> float:
    """The longest step that frames `interval` seconds apart are whole numbers of; UserError when there is none."""
    milliseconds = round(1000 * interval)
    fits = [ms for ms in _STEPS_MS if milliseconds >= ms and milliseconds % ms == 0]
    if not fits or abs(1000 * interval - milliseconds) > 1e-6:
        raise UserError(f"--interval: expected a multiple of 0.005 seconds, got {interval:g}")
    return fits[0] / 1000


@dataclass(frozen=True)
class Driven:
    """One vehicle at one step."""

    position: tuple[float, float, float]
    """World: under the middle of the vehicle, on the line through its axles' places on the road, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road from axle to axle, uphill positive, radians."""
    speed: float
    lamps: int


@dataclass(frozen=True)
class Ridden:
    """Somebody on two wheels at one step."""

    position: tuple[float, float, float]
    """World: on the road under the middle, metres."""
    yaw: float
    pitch: float
    speed: float


@dataclass(frozen=True)
class Snapshot:
    time: float
    vehicles: Mapping[str, Driven]
    riders: Mapping[str, Ridden]
    signals: Mapping[str, str]
    """SUMO's state string of each signal program."""


class _Trail:
    """Heights of the road that a vehicle's front bumper has passed, by the distance driven."""

    def __init__(self, height: float, slope: float) -> None:
        self._driven = [-_TRAIL, 0.0]
        self._height = [height - _TRAIL * math.sin(slope), height]

    def add(self, driven: float, height: float) -> None:
        if driven - self._driven[-1] >= _TRAIL_STEP:
            self._driven.append(driven)
            self._height.append(height)
            if driven - self._driven[0] > 2 * _TRAIL:
                first = next(i for i, at in enumerate(self._driven) if at > driven - _TRAIL) - 1
                del self._driven[:first], self._height[:first]

    def height(self, driven: float) -> float:
        after = min(bisect(self._driven, driven), len(self._driven) - 1)
        start, end = self._driven[after - 1], self._driven[after]
        low, high = self._height[after - 1], self._height[after]
        return low + (high - low) * min((driven - start) / (end - start), 1.0)


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
    ) -> None:
        """`flows` is a route file's text, in place of a density; with `passing`, that is of those over such edges."""
        self._network, self._fleet, self._step = network, fleet, step
        # Drawn before the trips, of which a longer recording has more: it begins like a shorter one.
        self._seed = int(rng.integers(1, 2**30))
        planned = (
            scheduled(flows, network, fleet, duration=duration, rng=rng)
            if flows
            else trips(network, fleet, vehicles_per_hour=vehicles_per_hour, duration=duration, rng=rng, passing=passing)
        )
        self.trips: Mapping[str, Trip] = {trip.name: trip for trip in planned}
        self._trails: dict[str, _Trail] = {}

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
        """Go on by some steps, which nobody watches."""
        vehicle = self._sumo.vehicle
        for k in range(steps):
            self._sumo.simulationStep()
            if k % _TRAIL_EVERY == 0:
                for name in vehicle.getIDList():
                    self._trail(name, vehicle.getDistance(name), vehicle.getPosition3D(name)[2])

    def _trail(self, name: str, driven: float, height: float) -> _Trail:
        """A vehicle's trail with its present place in it."""
        if name not in self._trails:
            self._trails[name] = _Trail(height, math.radians(self._sumo.vehicle.getSlope(name)))
        self._trails[name].add(driven, height)
        return self._trails[name]

    def step(self) -> Snapshot:
        """Go on by a step and say where everyone is."""
        sumo = self._sumo
        sumo.simulationStep()
        present = sumo.vehicle.getIDList()
        for gone in self._trails.keys() - set(present):
            del self._trails[gone]
        riders = {name for name in present if self.trips[name].model in RIDERS}
        return Snapshot(
            sumo.simulation.getTime(),
            {name: self._driven(name) for name in present if name not in riders},
            {name: self._ridden(name) for name in riders},
            {name: sumo.trafficlight.getRedYellowGreenState(name) for name in sumo.trafficlight.getIDList()},
        )

    def _driven(self, name: str) -> Driven:
        vehicle = self._sumo.vehicle
        x, y, z = vehicle.getPosition3D(name)
        yaw = math.radians(90.0 - vehicle.getAngle(name))
        shape = self._fleet[self.trips[name].model].vehicle.shape
        front, rear = (shape.length / 2 - axle for axle in (shape.front_axle_x, shape.rear_axle_x))
        ahead, behind = self._heights(name, z, (front, rear))
        pitch = math.atan2(ahead - behind, rear - front)
        back = shape.length / 2 * math.cos(pitch)
        middle = behind + (rear - shape.length / 2) / (rear - front) * (ahead - behind)
        position = (x - back * math.cos(yaw), y - back * math.sin(yaw), middle)
        lamps = sum(ours for theirs, ours in _SUMO_LAMPS.items() if vehicle.getSignals(name) & theirs)
        return Driven(position, yaw, pitch, vehicle.getSpeed(name), lamps)

    def _ridden(self, name: str) -> Ridden:
        vehicle = self._sumo.vehicle
        x, y, z = vehicle.getPosition3D(name)
        yaw = math.radians(90.0 - vehicle.getAngle(name))
        length = vehicle.getLength(name)
        ahead, behind = self._heights(name, z, (0.2 * length, 0.8 * length))
        back, pitch = length / 2, math.atan2(ahead - behind, 0.6 * length)
        position = (x - back * math.cos(yaw), y - back * math.sin(yaw), (ahead + behind) / 2)
        return Ridden(position, yaw, pitch, vehicle.getSpeed(name))

    def _heights(self, name: str, height: float, behind: tuple[float, ...]) -> list[float]:
        """Heights of the road at some distances behind a front bumper at `height`, where it has been before."""
        driven = self._sumo.vehicle.getDistance(name)
        trail = self._trail(name, driven, height)
        return [trail.height(driven - back) for back in behind]
