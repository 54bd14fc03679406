"""Filters of vehicles: type, hidden share and height of the box, in one number for each vehicle."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from skope.metrics.breakdown import HEIGHTS_PX, OCCLUSION_EDGES, band_names
from skope.metrics.match import box_of
from skope.schema import VEHICLE_TYPES, Annotation

UNKNOWN_VALUE: Final = "unknown"


@dataclass(frozen=True, kw_only=True)
class Quality:
    """A quality of vehicles that has few values."""

    name: str
    values: Sequence[str]


TYPE: Final = Quality(name="vehicle type", values=(*VEHICLE_TYPES, UNKNOWN_VALUE))
OCCLUSION: Final = Quality(name="hidden share", values=(*band_names(OCCLUSION_EDGES, "1"), UNKNOWN_VALUE))
HEIGHT_QUALITY: Final = Quality(name="height, px", values=tuple(band_names(HEIGHTS_PX)))
QUALITIES: Final = (TYPE, OCCLUSION, HEIGHT_QUALITY)


def kind_number(vehicle: Annotation, boxes: str) -> int:
    """The number that stands for a vehicle's values of all `QUALITIES`, the last one counting in ones.

    `boxes` is which box counts, "full" or "visible".
    """
    height = float(box_of(vehicle, boxes)[3])
    places = (
        TYPE.values.index(vehicle.vehicle_type or UNKNOWN_VALUE),
        _band(vehicle.occlusion, OCCLUSION_EDGES, OCCLUSION),
        _band(height, HEIGHTS_PX, HEIGHT_QUALITY),
    )
    number = 0
    for place, quality in zip(places, QUALITIES, strict=True):
        number = number * len(quality.values) + place
    return number


def _band(value: float | None, edges: Sequence[float], quality: Quality) -> int:
    return len(quality.values) - 1 if value is None else int(np.searchsorted(edges, value, side="right"))


def described() -> list[dict[str, Any]]:
    """`QUALITIES` as the page gets them."""
    return [{"name": quality.name, "values": list(quality.values)} for quality in QUALITIES]
