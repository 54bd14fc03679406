"""Vehicles that stand parked in a camera's view through a whole recording."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from shapely import Polygon

from skope.gen.simulation.smooth_paths import Driven
from skope.gen.towns.land_use import Layout
from skope.gen.towns.parking import BAY, Bay
from skope.gen.towns.regions import rectangle_polygon
from skope.gen.towns.town import Town
from skope.gen.vehicles.fleet import FleetEntry
from skope.gen.vehicles.model import Vehicle, straight_lwh
from skope.gen.vehicles.paints import draw_paint

OCCUPIED: Final = 0.5
"""Share of the bays that are taken."""
MOST_PARKED: Final = 14
"""Mean number of parked vehicles in view at most; in larger car parks a smaller share of the bays is taken."""


@dataclass(frozen=True)
class Parked:
    """A vehicle in a bay."""

    name: str
    model: str
    color: str
    state: Driven

    def footprint(self, vehicle: Vehicle) -> Polygon:
        """Rectangle of ground that the vehicle stands on, world, metres."""
        length, width, _ = vehicle.size_lwh
        return rectangle_polygon(np.array(self.state.position[:2]), self.state.yaw, length, width)


def parked_vehicles(
    town: Town,
    bays: Sequence[Bay],
    models: Mapping[str, FleetEntry],
    rng: np.random.Generator,
    *,
    most: int = MOST_PARKED,
) -> list[Parked]:
    """Draw parked vehicles for some of the bays, of models that fit, nose or tail first.

    Args:
        town: For the height of the ground.
        bays: Bays in view.
        models: Models that drive in the town, by name.
        rng: Draws bays, models, paints and places.
        most: Mean number of vehicles at most.
    """
    fitting = {name: entry.share for name, entry in models.items() if straight_lwh(entry.vehicle)[0] < BAY[0] + 0.2}
    if not bays or not fitting:
        return []
    layout = Layout.of(town)
    names, shares = list(fitting), np.array(list(fitting.values()))
    share, out = min(OCCUPIED, most / len(bays)), []
    for i, bay in enumerate(bays):
        if rng.random() > share:
            continue
        model = names[rng.choice(len(names), p=shares / shares.sum())]
        color = draw_paint(models[model].vehicle, rng)
        yaw = bay.heading + (math.pi if rng.random() < 0.4 else 0.0) + rng.normal(0, 0.02)
        place = np.array(bay.place) + rng.normal(0, 0.08, 2)
        out.append(Parked(f"b{i:04d}", model, color, _standing(layout, place, float(yaw))))
    return out


def _standing(layout: Layout, place: np.ndarray, yaw: float) -> Driven:
    """A vehicle that stands on the ground beside the road, level across."""
    ahead = 1.3 * np.array([math.cos(yaw), math.sin(yaw)])
    front, rear = (layout.height(layout.graph.world(at)) for at in (place + ahead, place - ahead))
    position = (float(place[0]), float(place[1]), (front + rear) / 2)
    return Driven(position, yaw, math.atan2(front - rear, 2.6), 0.0, 0)
