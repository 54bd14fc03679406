"""SUMO's types of vehicles: how large each is, and how it follows others, keeps its lane and speeds up."""

from collections.abc import Mapping
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

from skope.gen.traffic.demand import RIDERS, USUAL_RIDERS, Riding, kinds_of_drivers
from skope.gen.vehicles.fleet import FleetEntry
from skope.gen.vehicles.model import Vehicle, straight_lwh

HEAVY_FROM_KG: Final = 3500.0
"""Mass above which a vehicle counts as a goods vehicle or a bus, kilograms."""
_HEAVY_SPEED: Final = 25.0
"""Speed that the limiters of heavy vehicles allow, m/s."""
_NARROW: Final[Mapping[str, Mapping[str, str]]] = {
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
            attributes = manner | _attributes(entry.vehicle)
            ElementTree.SubElement(root, "vType", {"id": f"{name}.{driver}", **attributes})
        for rider, vehicle_class in RIDERS.items():
            own = {**manner, **(_NARROW[rider] if riders.narrow else {})}
            ElementTree.SubElement(root, "vType", {"id": f"{rider}.{driver}", **own, "vClass": vehicle_class})
    ElementTree.ElementTree(root).write(path, encoding="utf-8")


def _attributes(vehicle: Vehicle) -> dict[str, str]:
    """Attributes of a vehicle's SUMO type: size, and how it follows others."""
    length, width, height = straight_lwh(vehicle)
    heavy = vehicle.mass > HEAVY_FROM_KG
    limited = {"maxSpeed": str(_HEAVY_SPEED)} if heavy else {}
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
