"""Demand for traffic in a town: which vehicles, riders and drivers, ways through the network, when each sets out;
SUMO's types of vehicles: how large each is, how it follows others, keeps its lane and speeds up."""

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
"""Road users on two wheels, by SUMO's vehicle class."""
COMPANY_SHARES: Final = {"cyclist": 0.30, "motorcyclist": 0.12}
"""Share of the riders with somebody behind them who goes the same way."""


@dataclass(frozen=True)
class DemandLimits:
    """Heavy vehicles and groups of riders."""

    behind_s: float = 1.1
    """Seconds between riders of a group."""
    heavy_from_kg: float = 3500.0
    """Mass above which a vehicle counts as a goods vehicle or a bus, kilograms."""
    heavy_mps: float = 25.0
    """Speed that the limiters of heavy vehicles allow, m/s."""


DEMAND_LIMITS: Final = DemandLimits()


@dataclass(frozen=True)
class Trip:
    """A road user that will enter the network."""

    name: str
    model: str
    """A model of the fleet, or one of `RIDER_CLASSES`."""
    driver: str
    color: str
    depart: float
    """Seconds."""
    edges: tuple[str, ...]

    @property
    def type_id(self) -> str:
        return f"{self.model}.{self.driver}"


@dataclass(frozen=True)
class Riding:
    """Number of riders, and how they ride."""

    shares: Mapping[str, float]
    """Number of riders of each kind for one vehicle."""
    narrow: bool = False
    """Whether they pass between lanes, and some ride in groups."""

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> "Riding":
        """Draw the riders of a traffic in which they are labelled: from a few to a third of all."""
        return cls(
            {kind: float(np.exp(rng.uniform(np.log(0.03), np.log(0.25)))) for kind in RIDER_CLASSES}, narrow=True
        )


USUAL_RIDERS: Final = Riding({"cyclist": 0.03, "motorcyclist": 0.02})
"""Riders where they are not labelled."""


@cache
def kinds_of_drivers() -> Mapping[str, Mapping[str, Any]]:
    """The kinds of drivers by name, as drivers.toml has them: their share, and SUMO's attributes of how they drive."""
    return _table("drivers.toml")


@cache
def _vehicle_mix() -> Mapping[str, Mapping[str, float]]:
    """Shares of types of vehicles, by town."""
    return _table("vehicle_mix.toml")


def _table(name: str) -> Mapping[str, Any]:
    return tomllib.loads(resources.files("skope.gen.traffic").joinpath(name).read_text(encoding="utf-8"))


def in_town(models: Mapping[str, FleetEntry], town: str) -> dict[str, FleetEntry]:
    """The models with their shares in a town's traffic; as the fleet has them where the town's are not known."""
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
    """Poisson arrivals over all ways in for `duration` seconds, each to a random way out that is not the way back.

    Args:
        network: SUMO's network file.
        models: The fleet, with its shares.
        vehicles_per_hour: Arrivals of all kinds together.
        duration: Seconds.
        rng: Draws them.
        passing: Edges of which each way leads over one; empty: any way.
        riders: Number of those on two wheels for one vehicle, and how they ride.
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
    """Shares of the kinds of drivers."""
    return {name: row["share"] for name, row in kinds_of_drivers().items()}


def draw_name(shares: Mapping[str, float], rng: np.random.Generator) -> str:
    """Draw one of the names, by their shares."""
    p = np.array(list(shares.values()))
    return list(shares)[rng.choice(len(p), p=p / p.sum())]


@cache
def ways(network: Path) -> list[tuple[tuple[str, ...], float]]:
    """Every route from the network's rim to its rim, weighted by the lanes it starts and ends with."""
    import sumolib

    net = sumolib.net.readNet(str(network))
    edges = [edge for edge in net.getEdges() if edge.allows("passenger")]
    # Where a road ends, turning back may be allowed.
    ways_in = [e for e in edges if all(other.getFromNode() is e.getToNode() for other in e.getIncoming())]
    ways_out = [e for e in edges if all(other.getToNode() is e.getFromNode() for other in e.getOutgoing())]
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
"""SUMO's attributes of riders who pass between lanes and along queues, on top of their drivers' manners."""


def write_types(path: Path, models: Mapping[str, FleetEntry], riders: Riding = USUAL_RIDERS) -> None:
    """Write SUMO's vehicle types: each model with each kind of driver, and riders."""
    root = ElementTree.Element("additional")
    for driver, row in kinds_of_drivers().items():
        manner = {key: str(value) for key, value in row.items() if key != "share"}
        for name, entry in models.items():
            attributes = manner | _type_attributes(entry.vehicle)
            ElementTree.SubElement(root, "vType", {"id": f"{name}.{driver}", **attributes})
        for rider, vehicle_class in RIDER_CLASSES.items():
            own = {**manner, **(_NARROW_TYPES[rider] if riders.narrow else {})}
            ElementTree.SubElement(root, "vType", {"id": f"{rider}.{driver}", **own, "vClass": vehicle_class})
    ElementTree.ElementTree(root).write(path, encoding="utf-8")


def _type_attributes(vehicle: Vehicle) -> dict[str, str]:
    """Attributes of a vehicle's SUMO type: size, and how it follows others."""
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
