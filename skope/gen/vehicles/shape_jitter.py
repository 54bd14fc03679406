"""Shapes near a model's, so that no two vehicles of a dataset need to be alike."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Final

import numpy as np

from skope.errors import one_of
from skope.gen.vehicles.fleet import class_ranges, fleet, parametric
from skope.gen.vehicles.jittered_parts import draw_details
from skope.gen.vehicles.shape import Shape

_ALONG: Final = frozenset((
    "length", "wheelbase", "front_overhang", "cowl_setback", "screen_run", "backlight_run", "deck_length", "cab_length",
    "hood_length", "hinge_setback", "hinge_gap", "trailer_front", "trailer_length", "trailer_axle",
))  # fmt: skip
"""Dimensions along a vehicle, which are stretched together."""
_WIDTH_FIELDS: Final = frozenset(("width", "track", "headlight_inner", "taillight_inner", "roof_inset"))
"""Dimensions across a vehicle, which are stretched together."""
_UP: Final = frozenset((
    "height", "bumper_height", "headlight_low", "headlight_high", "taillight_low", "taillight_high",
    "hood_height", "cowl_height", "belt_height", "deck_height", "box_height", "clearance",
    "hinge_height", "trailer_floor", "trailer_height",
))  # fmt: skip
"""Dimensions upwards, which are stretched together."""
_STRETCH: Final = 0.025
"""Standard deviation of the share by which a jittered shape is longer, wider or higher than its model."""


def jittered(model: str, rng: np.random.Generator) -> Mapping[str, float]:
    """Shape parameters near a model's, within the ranges of its class: stretched along each axis, and slightly bent."""
    one_of("model", model, tuple(fleet()))
    vehicle = parametric(model)
    ranges = class_ranges(vehicle.size_class)
    whole = vehicle.shape.to_dict()
    scales = []
    for names in (_ALONG, _WIDTH_FIELDS, _UP):
        # One share for an axis, within what keeps all its dimensions in their ranges.
        bounds = [(ranges[name][0] / whole[name], ranges[name][1] / whole[name]) for name in names if name in ranges]
        low, high = max(bound[0] for bound in bounds), min(bound[1] for bound in bounds)
        scales.append((names, float(np.clip(1 + _STRETCH * rng.standard_normal(), low, high))))
    out = {}
    for name, value in whole.items():
        scale = next((scale for names, scale in scales if name in names), 1.0)
        out[name] = float(value * scale)
    for name in ("screen_run", "backlight_run", "roof_inset", "nose_round", "tail_round", "roof_droop", "nose_lean"):
        out[name] *= float(1 + 0.05 * np.clip(rng.standard_normal(), -2, 2))
    # A stream of its own: dimensions do not depend on how many details there are.
    own = rng.spawn(1)[0]
    _jitter_lamps(out, vehicle.style.family, own)
    return out | draw_details(vehicle.style, vehicle.vehicle_type, own)


def _jitter_lamps(shape: dict[str, float], family: str, rng: np.random.Generator) -> None:
    """Make the lamps of a car taller or flatter, wider or narrower, higher or lower."""
    if family != "car":
        return
    top = {"headlight": shape["hood_height"] - 0.03, "taillight": shape["deck_height"] - 0.03}
    for lamp, highest in top.items():
        low, high = shape[f"{lamp}_low"], shape[f"{lamp}_high"]
        middle = (low + high) / 2 + rng.uniform(-0.025, 0.025)
        half = (high - low) / 2 * rng.uniform(0.75, 1.25)
        shape[f"{lamp}_high"] = min(middle + half, max(high, highest))
        shape[f"{lamp}_low"] = shape[f"{lamp}_high"] - 2 * half
        shape[f"{lamp}_inner"] += rng.uniform(-0.04, 0.04)
        shape[f"{lamp}_wrap"] *= rng.uniform(0.7, 1.3)


assert {f.name for f in fields(Shape)} >= _ALONG | _WIDTH_FIELDS | _UP
