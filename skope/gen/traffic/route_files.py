"""Traffic from a SUMO route file (.rou.xml), which sets departure times and routes; the vehicles are of the fleet.

The reader supports <route>, <vType> (its vClass), <vehicle>, <trip> and <flow>. A flow has begin, end and one of
number, period (a number or exp(rate)), vehsPerHour and probability. Routes are given by edges, by the name of a route,
or by from, to and via.
"""

import itertools
import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np

from skope.errors import UserError
from skope.gen.traffic.demand import RIDER_CLASSES, Trip, draw_name, driver_shares
from skope.gen.vehicles.fleet import FleetEntry
from skope.gen.vehicles.paints import draw_paint

_LIGHT_TYPES: Final = ("sedan", "hatchback", "city_car", "coupe", "wagon", "suv", "minivan", "pickup")
_OF_CLASS: Final[Mapping[str, tuple[str, ...]]] = {
    "passenger": _LIGHT_TYPES,
    "private": _LIGHT_TYPES,
    "taxi": ("sedan", "minivan", "wagon"),
    "delivery": ("van", "box_truck"),
    "truck": ("truck", "box_truck"),
    "trailer": ("truck", "articulated_truck"),
    "bus": ("bus", "articulated_bus"),
    "coach": ("bus",),
}
"""Vehicle types of the fleet for each vehicle class of SUMO; all other classes use all types."""
RIDERS_OF_CLASS: Final = {vehicle_class: name for name, vehicle_class in RIDER_CLASSES.items()} | {
    "moped": "motorcyclist"
}
EXPONENTIAL_PERIOD: Final = re.compile(r"exp\(([^)]+)\)")


@dataclass(frozen=True)
class FlowLimits:
    """Units and limits of flows."""

    hour_s: float = 3600.0
    """Seconds per hour."""
    most_per_hour: float = 1e5
    """Maximum number of vehicles per hour that a flow can request; no road carries more."""


FLOW_LIMITS: Final = FlowLimits()


@dataclass(frozen=True)
class _Flow:
    """Road users on one route that depart once, at regular intervals or at random."""

    vehicle_class: str
    """SUMO's vehicle class; empty if the file has none."""
    edges: tuple[str, ...]
    begin: float
    end: float
    period: float
    """Mean time between two departures, seconds; inf for a single departure at `begin`."""
    random: bool = False

    def departures(self, start: float, stop: float, rng: np.random.Generator) -> list[float]:
        """Sample the departure times within a time window, seconds."""
        low, high = max(start, self.begin), min(stop, self.end)
        if self.period == math.inf:
            return [self.begin] if start <= self.begin < stop else []
        if high <= low:
            return []
        if self.random:
            return sorted(rng.uniform(low, high, rng.poisson((high - low) / self.period)).tolist())
        first, last = (math.ceil((at - self.begin) / self.period - 1e-9) for at in (low, high))
        return [self.begin + k * self.period for k in range(first, last)]


def scheduled(
    text: str, network: Path, models: Mapping[str, FleetEntry], *, duration: float, rng: np.random.Generator
) -> Iterator[Trip]:
    """Yield the trips in a random window of `duration` seconds of a route file, with times from its start.

    The model of each vehicle is sampled among those of its class, by the shares of the fleet.

    Raises UserError if the text is not a valid route file for the network.
    """
    flows = streams(text, network)
    first, last = min(flow.begin for flow in flows), max(max(flow.begin, flow.end) for flow in flows)
    start = first + float(rng.uniform(0, max(last - first - duration, 0.0)))
    planned = sorted(
        (time, k) for k, flow in enumerate(flows) for time in flow.departures(start, start + duration, rng)
    )
    for i, (time, k) in enumerate(planned):
        model = _model(flows[k].vehicle_class, models, rng)
        color = draw_paint(models[model].vehicle, rng) if model in models else "black"
        yield Trip(f"v{i:05d}", model, draw_name(driver_shares(), rng), color, time - start, flows[k].edges)


def _model(vehicle_class: str, models: Mapping[str, FleetEntry], rng: np.random.Generator) -> str:
    if vehicle_class in RIDERS_OF_CLASS:
        return RIDERS_OF_CLASS[vehicle_class]
    types = _OF_CLASS.get(vehicle_class, ())
    fitting = {name: entry.share for name, entry in models.items() if entry.vehicle.vehicle_type in types}
    return draw_name(fitting or {name: entry.share for name, entry in models.items()}, rng)


@cache
def streams(text: str, network: Path) -> tuple[_Flow, ...]:
    """Read the flows of a route file. Raises UserError with the invalid element, but without the name of the file."""
    if "<!DOCTYPE" in text:
        raise UserError("contains a DOCTYPE, which is not supported in route files; remove it")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise UserError(f"not XML: {error}") from None
    ways = _Ways(root, network)
    classes = {vehicle_type.get("id"): vehicle_type.get("vClass", "passenger") for vehicle_type in root.iter("vType")}
    out = []
    for element in root:
        if element.tag in ("vehicle", "trip", "flow"):
            try:
                begin, end, period, random = _times(element)
                if period < FLOW_LIMITS.hour_s / FLOW_LIMITS.most_per_hour:
                    raise ValueError(f"more than {FLOW_LIMITS.most_per_hour:.0f} vehicles per hour")
            except ValueError as error:
                raise UserError(f"{_name(element)}: {error}") from None
            kind = classes.get(element.get("type"), "")
            out.append(_Flow(kind, ways.of(element), begin, end, period, random))
    if not out:
        raise UserError("expected at least one vehicle, trip or flow, found none")
    return tuple(out)


def _name(element: ElementTree.Element) -> str:
    return f"{element.tag} {element.get('id', '?')!r}"


def _times(element: ElementTree.Element) -> tuple[float, float, float, bool]:
    """Return begin, end, mean period, and whether departures are random."""
    if element.tag != "flow":
        at = _number(element, "depart", "0")
        return at, at, math.inf, False
    begin, end = _number(element, "begin", "0"), _number(element, "end", "86400")
    if end <= begin:
        raise ValueError("end: expected a time after begin")
    if "number" in element.attrib:
        return begin, end, (end - begin) / max(_number(element, "number"), 1e-9), False
    if "vehsPerHour" in element.attrib:
        return begin, end, FLOW_LIMITS.hour_s / _number(element, "vehsPerHour"), False
    if "probability" in element.attrib:
        return begin, end, 1 / _number(element, "probability"), True
    if element.get("period", "").startswith("exp("):
        return begin, end, 1 / _rate(element.get("period", "")), True
    return begin, end, _number(element, "period"), False


def _rate(period: str) -> float:
    """Return the vehicles per second of `exp(rate)`."""
    match = EXPONENTIAL_PERIOD.fullmatch(period)
    try:
        rate = float(match[1]) if match else math.nan
    except ValueError:
        rate = math.nan
    if not 0 < rate < math.inf:
        raise ValueError(f"period: expected exp(vehicles per second, a positive number), got {period!r}")
    return rate


def _number(element: ElementTree.Element, name: str, default: str = "") -> float:
    try:
        value = float(element.get(name, default))
    except ValueError:
        raise ValueError(f"{name}: expected a number") from None
    if not math.isfinite(value) or value < 0 or (value == 0 and not default):
        raise ValueError(f"{name}: expected a positive number")
    return value


class _Ways:
    """Routes through a network, as given by the elements of a route file."""

    def __init__(self, root: ElementTree.Element, network: Path) -> None:
        import sumolib

        self._net: Any = sumolib.net.readNet(str(network))
        self._routes = {route.get("id"): route for route in root.iterfind("route")}

    def of(self, element: ElementTree.Element) -> tuple[str, ...]:
        route = element.find("route")
        route = self._routes.get(element.get("route")) if route is None else route
        if route is not None:
            return self._connected(element, self._checked(element, route.get("edges", "").split()))
        ends = [element.get("from", ""), *element.get("via", "").split(), element.get("to", "")]
        if not all(ends):
            raise UserError(f"{_name(element)}: expected a route of this file, or from and to")
        self._checked(element, ends)
        out = ends[:1]
        for a, b in itertools.pairwise(ends):
            path, _ = self._net.getShortestPath(self._net.getEdge(a), self._net.getEdge(b), vClass="passenger")
            if path is None:
                raise UserError(f"{_name(element)}: the network has no route from {a} to {b}")
            out += [edge.getID() for edge in path[1:]]
        return tuple(out)

    def _connected(self, element: ElementTree.Element, edges: tuple[str, ...]) -> tuple[str, ...]:
        for a, b in itertools.pairwise(edges):
            if self._net.getEdge(b) not in self._net.getEdge(a).getOutgoing():
                raise UserError(f"{_name(element)}: the network has no connection from {a} to {b}")
        return edges

    def _checked(self, element: ElementTree.Element, edges: list[str]) -> tuple[str, ...]:
        unknown = [edge for edge in edges if not self._net.hasEdge(edge)]
        if unknown or not edges:
            raise UserError(f"{_name(element)}: the network has no edge {unknown[0] if unknown else 'in its route'}")
        return tuple(edges)
