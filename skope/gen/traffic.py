"""Traffic by SUMO (libsumo): random trips through a network, and where every vehicle is at each step.

The only module that imports libsumo. SUMO places a vehicle by the middle of its front bumper and measures angles as
compass degrees; both are converted here, once.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope.gen.vehicles import FleetEntry, draw_paint

Array = NDArray[np.float64]

STEP: Final = 0.025
"""Seconds a step. SUMO counts whole milliseconds, so 30 Hz itself cannot be had; 40 Hz divides the frame interval."""

LAMPS: Final = {"low_beam": 1, "brake": 2, "indicator_left": 4, "indicator_right": 8, "reverse": 16}
_SUMO_LAMPS: Final = {1: LAMPS["indicator_right"], 2: LAMPS["indicator_left"], 8: LAMPS["brake"]}

_HEAVY: Final = 3500.0
"""Mass above which a vehicle counts as a goods vehicle or a bus, kilograms."""
_HEAVY_SPEED: Final = 25.0
"""What their speed limiters allow, m/s."""


@dataclass(frozen=True)
class Driven:
    """One vehicle at one step."""

    position: tuple[float, float, float]
    """World: on the road under the middle of the vehicle, metres."""
    yaw: float
    """Heading, counter-clockwise from east, radians."""
    pitch: float
    """Slope of the road under the vehicle, uphill positive, radians."""
    speed: float
    lamps: int


@dataclass(frozen=True)
class Trip:
    """A vehicle that will enter the network."""

    name: str
    model: str
    color: str
    depart: float
    edges: tuple[str, ...]


@dataclass(frozen=True)
class Snapshot:
    time: float
    vehicles: Mapping[str, Driven]
    signals: Mapping[str, str]
    """SUMO's state string of each signal program."""


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
    ) -> None:
        self._network, self._fleet = network, fleet
        self._rate, self._duration, self._rng = vehicles_per_hour / 3600, duration, rng
        self.trips: dict[str, Trip] = {}

    def __enter__(self) -> "Traffic":
        import libsumo

        self._sumo = libsumo
        seed = int(self._rng.integers(1, 2**30))
        options = f"--step-length {STEP} --seed {seed} --no-step-log --no-warnings --time-to-teleport -1"
        options += " --collision.action none --lanechange.duration 3 --default.speeddev 0.08"
        libsumo.start(["sumo", "-n", str(self._network), *options.split()])
        self._add_types()
        self.trips = {trip.name: trip for trip in self._plan()}
        for trip in self.trips.values():
            route = f"route_{trip.name}"
            libsumo.route.add(route, trip.edges)
            libsumo.vehicle.add(
                trip.name, route, typeID=trip.model, depart=f"{trip.depart:.3f}", departLane="best", departSpeed="max"
            )
        return self

    def __exit__(self, *_: object) -> None:
        self._sumo.close()

    def _add_types(self) -> None:
        types = self._sumo.vehicletype
        for name, entry in self._fleet.items():
            length, width, height = entry.vehicle.size_lwh
            types.copy("DEFAULT_VEHTYPE", name)
            types.setLength(name, length)
            types.setWidth(name, width)
            types.setHeight(name, height)
            types.setMinGap(name, 2.0)
            types.setParameter(name, "carFollowModel", "IDM")
            heavy = entry.vehicle.mass > _HEAVY
            types.setAccel(name, 1.2 if heavy else 2.0)
            types.setDecel(name, 3.0 if heavy else 3.5)
            if heavy:
                types.setMaxSpeed(name, _HEAVY_SPEED)

    def _plan(self) -> Iterator[Trip]:
        """Poisson arrivals over all ways in, each to a random way out that is not the way back."""
        routes = self._routes()
        weights = np.array([weight for _, weight in routes])
        models, shares = list(self._fleet), np.array([entry.share for entry in self._fleet.values()])
        rng, time = self._rng, 0.0
        for i in range(100_000):
            time += rng.exponential(1 / self._rate)
            if time > self._duration:
                return
            route = routes[rng.choice(len(routes), p=weights / weights.sum())][0]
            model = models[rng.choice(len(models), p=shares / shares.sum())]
            yield Trip(f"v{i:05d}", model, draw_paint(self._fleet[model].vehicle, rng), time, route)

    def _routes(self) -> list[tuple[tuple[str, ...], float]]:
        """Every route from the network's rim to its rim, weighted by the lanes it starts and ends with."""
        import sumolib

        net = sumolib.net.readNet(str(self._network))
        ways_in = [edge for edge in net.getEdges() if not edge.getIncoming()]
        ways_out = [edge for edge in net.getEdges() if not edge.getOutgoing()]
        out = []
        for start in ways_in:
            for end in ways_out:
                path, _ = net.getShortestPath(start, end)
                if path is not None and start.getFromNode() is not end.getToNode():
                    edges = tuple(edge.getID() for edge in path)
                    out.append((edges, float(start.getLaneNumber() ** 2 * end.getLaneNumber())))
        return out

    def step(self) -> Snapshot:
        """Go on by `STEP` seconds and say where everyone is."""
        sumo = self._sumo
        sumo.simulationStep()
        vehicles = {name: self._driven(name) for name in sumo.vehicle.getIDList()}
        signals = {name: sumo.trafficlight.getRedYellowGreenState(name) for name in sumo.trafficlight.getIDList()}
        return Snapshot(sumo.simulation.getTime(), vehicles, signals)

    def _driven(self, name: str) -> Driven:
        vehicle = self._sumo.vehicle
        x, y, z = vehicle.getPosition3D(name)
        yaw = math.radians(90.0 - vehicle.getAngle(name))
        pitch = math.radians(vehicle.getSlope(name))
        back = self._fleet[self.trips[name].model].vehicle.shape.length / 2
        position = (
            x - back * math.cos(yaw) * math.cos(pitch),
            y - back * math.sin(yaw) * math.cos(pitch),
            z - back * math.sin(pitch),
        )
        lamps = sum(ours for theirs, ours in _SUMO_LAMPS.items() if vehicle.getSignals(name) & theirs)
        return Driven(position, yaw, pitch, vehicle.getSpeed(name), lamps)
