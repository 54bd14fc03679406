"""Traffic demand of a town: vehicles, riders, drivers, routes and departure times, and SUMO's vehicle types.

A vehicle type sets the size of a vehicle, and how it follows others, keeps its lane and accelerates.
"""

import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from skope.gen.vehicles.fleet import FleetEntry
from skope.gen.vehicles.model import Vehicle, straight_lwh
from skope.gen.vehicles.paints import draw_paint

RIDER_CLASSES: Final = {"cyclist": "bicycle", "motorcyclist": "motorcycle"}
"""SUMO's vehicle class of each kind of rider of a two-wheeler."""
COMPANY_SHARES: Final = {"cyclist": 0.30, "motorcyclist": 0.12}
"""Probability that another rider follows a rider on the same route, by kind; at most three follow."""


@dataclass(frozen=True)
class DemandLimits:
    """Limits for heavy vehicles and groups of riders."""

    behind_s: float = 1.1
    """Time between the riders of a group, seconds."""
    heavy_from_kg: float = 3500.0
    """Mass above which a vehicle counts as a goods vehicle or a bus, kilograms."""
    heavy_mps: float = 25.0
    """Maximum speed of heavy vehicles, set by their speed limiters, m/s."""


DEMAND_LIMITS: Final = DemandLimits()


@dataclass(frozen=True)
class Trip:
    """A road user that will enter the network."""

    name: str
    model: str
    """Model of the fleet, or one of `RIDER_CLASSES`."""
    driver: str
    color: str
    depart: float
    """Departure time, seconds."""
    edges: tuple[str, ...]

    @property
    def type_id(self) -> str:
        return f"{self.model}.{self.driver}"


@dataclass(frozen=True)
class Riding:
    """Number of riders, and their riding style."""

    shares: Mapping[str, float]
    """Number of riders of each kind per vehicle."""
    narrow: bool = False
    """Whether riders pass between lanes, and some ride in groups."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Riding":
        """Sample the share of riders in traffic with labelled riders: from a few to a third of all road users."""
        return cls(
            {kind: float(np.exp(rng.uniform(np.log(0.03), np.log(0.25)))) for kind in RIDER_CLASSES}, narrow=True
        )


USUAL_RIDERS: Final = Riding({"cyclist": 0.03, "motorcyclist": 0.02})
"""Riders of a traffic in which they are not labelled."""


@cache
def kinds_of_drivers() -> Mapping[str, Mapping[str, Any]]:
    """Return the kinds of drivers in `drivers.toml` by name: their share and SUMO attributes."""
    return _table("drivers.toml")


@cache
def _vehicle_mix() -> Mapping[str, Mapping[str, float]]:
    """Return the shares of the vehicle types, by town."""
    return _table("vehicle_mix.toml")


def _table(name: str) -> Mapping[str, Any]:
    return tomllib.loads(resources.files("skope.gen.traffic").joinpath(name).read_text(encoding="utf-8"))


def in_town(models: Mapping[str, FleetEntry], town: str) -> dict[str, FleetEntry]:
    """Return the models with their shares in a town's traffic, or with the fleet's shares if the town has none."""
    shares: Mapping[str, float] = _vehicle_mix().get(town, {})
    if not shares:
        return dict(models)
    of_type: dict[str, float] = {}
    for entry in models.values():
        kind = entry.vehicle.vehicle_type
        of_type[kind] = of_type.get(kind, 0.0) + entry.share
    return {
        name: replace(entry, share=shares.get(entry.vehicle.vehicle_type, 0.0) * entry.share / of_type[kind])
        for name, entry in models.items()
        for kind in [entry.vehicle.vehicle_type]
    }


def trips(
    network: Path,
    models: Mapping[str, FleetEntry],
    *,
    vehicles_per_hour: float,
    duration: float,
    rng: np.random.Generator,
    passing: frozenset[str] = frozenset(),
    riders: Riding = USUAL_RIDERS,
) -> Iterator[Trip]:
    """Sample Poisson arrivals on all entries for `duration` seconds, each with a random exit that is not a U-turn.

    Args:
        network: SUMO network file.
        models: Models of the fleet with their shares.
        vehicles_per_hour: Arrival rate of all kinds together.
        duration: Duration, seconds.
        rng: Random generator for all draws.
        passing: Edges; each route uses at least one of them. Empty: any route.
        riders: Number of riders per vehicle, and their riding style.
    """
    routes = [way for way in ways(network) if not passing or not passing.isdisjoint(way[0])]
    weights = np.array([weight for _, weight in routes])
    ridden = sum(riders.shares.values()) * sum(entry.share for entry in models.values())
    users = {name: entry.share for name, entry in models.items()}
    users |= {name: ridden * share / sum(riders.shares.values()) for name, share in riders.shares.items()}
    drivers = driver_shares()
    time = 0.0
    for i in range(1_000_000):
        time += rng.exponential(3600 / vehicles_per_hour)
        if time > duration:
            return
        edges = routes[rng.choice(len(routes), p=weights / weights.sum())][0]
        model, driver = draw_name(users, rng), draw_name(drivers, rng)
        color = draw_paint(models[model].vehicle, rng) if model in models else "black"
        yield Trip(f"v{i:05d}", model, driver, color, time, edges)
        if riders.narrow and model in RIDER_CLASSES:
            for k in range(1, 4):
                if rng.random() >= COMPANY_SHARES[model]:
                    break
                yield Trip(f"v{i:05d}.{k}", model, driver, color, time + k * DEMAND_LIMITS.behind_s, edges)


def driver_shares() -> dict[str, float]:
    """Return the shares of the kinds of drivers."""
    return {name: row["share"] for name, row in kinds_of_drivers().items()}


def draw_name(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Sample a name with the given shares."""
    p = np.array(list(shares.values()))
    return list(shares)[rng.choice(len(p), p=p / p.sum())]


@cache
def ways(network: Path) -> list[tuple[tuple[str, ...], float]]:
    """Return every route across the network, weighted by the lanes of its first and last edge."""
    import sumolib

    net = sumolib.net.readNet(str(network))
    edges = [edge for edge in net.getEdges() if edge.allows("passenger")]
    # Turning back can be allowed at the end of a road.
    ways_in = [e for e in edges if all(incoming.getFromNode() is e.getToNode() for incoming in e.getIncoming())]
    ways_out = [e for e in edges if all(outgoing.getToNode() is e.getFromNode() for outgoing in e.getOutgoing())]
    out = []
    for start in ways_in:
        for end in ways_out:
            path, _ = net.getShortestPath(start, end, vClass="passenger")
            if path is not None and start.getFromNode() is not end.getToNode():
                ids = tuple(edge.getID() for edge in path)
                out.append((ids, float(start.getLaneNumber() ** 2 * end.getLaneNumber())))
    return out


_NARROW_TYPES: Final[Mapping[str, Mapping[str, str]]] = {
    "cyclist": {"latAlignment": "right", "minGapLat": "0.25", "maxSpeed": "7", "width": "0.65", "length": "1.8"},
    "motorcyclist": {
        "latAlignment": "arbitrary", "minGapLat": "0.15", "minGap": "1.0", "width": "0.75", "length": "2.1",
        "lcPushy": "0.8", "lcAssertive": "2", "lcSpeedGain": "5", "maxSpeedLat": "1.2", "accel": "3.5", "decel": "5",
    },
}  # fmt: skip
"""SUMO attributes of riders who pass between lanes and along queues, in addition to those of their drivers."""


def write_types(path: Path, models: Mapping[str, FleetEntry], riders: Riding = USUAL_RIDERS) -> None:
    """Write SUMO's vehicle types: each model and kind of rider with each kind of driver."""
    root = ElementTree.Element("additional")
    for driver, row in kinds_of_drivers().items():
        manner = {key: str(value) for key, value in row.items() if key != "share"}
        for name, entry in models.items():
            attributes = manner | _type_attributes(entry.vehicle)
            ElementTree.SubElement(root, "vType", {"id": f"{name}.{driver}", **attributes})
        for rider, vehicle_class in RIDER_CLASSES.items():
            rider_attributes = {**manner, **(_NARROW_TYPES[rider] if riders.narrow else {})}
            ElementTree.SubElement(
                root, "vType", {"id": f"{rider}.{driver}", **rider_attributes, "vClass": vehicle_class}
            )
    ElementTree.ElementTree(root).write(path, encoding="utf-8")


def _type_attributes(vehicle: Vehicle) -> dict[str, str]:
    """Return the attributes of a vehicle's SUMO type: its size, and how it follows others."""
    length, width, height = straight_lwh(vehicle)
    heavy = vehicle.mass > DEMAND_LIMITS.heavy_from_kg
    limited = {"maxSpeed": str(DEMAND_LIMITS.heavy_mps)} if heavy else {}
    return {
        "length": f"{length:.3f}",
        "width": f"{width:.3f}",
        "height": f"{height:.3f}",
        "carFollowModel": "IDM",
        "minGapLat": "0.5",
        "accel": "1.2" if heavy else "2.0",
        "decel": "3.0" if heavy else "3.5",
        **limited,
    }
