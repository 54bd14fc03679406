"""Parts that replace those of the model in jittered vehicles, so that one model has many faces and rears."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Any, Final, NamedTuple

import numpy as np

from skope.errors import UserError
from skope.gen.vehicles.shape import DETAIL_NAMES, Shape, VehicleStyle

GLOSS_BLACK: Final = "#111111"
"""Gloss black of painted roofs and mirrors."""
HATCH_TYPES: Final = frozenset(("hatchback", "city_car", "wagon", "suv", "minivan"))


class Detail(NamedTuple):
    """Part with several kinds."""

    options: tuple[tuple[float, Mapping[str, Any]], ...]
    """Share of each option, relative to the others, and the fields of `VehicleStyle` that it replaces; the first
    option is the model's own part."""
    suits: Callable[[VehicleStyle, str], bool]
    """Return whether a vehicle of a style and type may have another kind than its model's."""


def _is_car(style: VehicleStyle, vehicle_type: str) -> bool:
    return style.family == "car"


def _is_private(style: VehicleStyle, vehicle_type: str) -> bool:
    return style.family == "car" and style.palette == "private"


def _is_any(style: VehicleStyle, vehicle_type: str) -> bool:
    return True


def _may_carry(style: VehicleStyle, vehicle_type: str) -> bool:
    return (
        style.family == "car"
        and not style.sign
        and style.load != "beacons"
        and vehicle_type in {*HATCH_TYPES, "sedan", "van"}
    )


def _is_hatch(style: VehicleStyle, vehicle_type: str) -> bool:
    return style.family == "car" and vehicle_type in HATCH_TYPES


def _has_rear_panes(style: VehicleStyle, vehicle_type: str) -> bool:
    return style.family == "car" and style.glazed == 1 and style.doors == 4


def _kinds(model_share: float, field: str, shares: Mapping[Any, float]) -> tuple[tuple[float, Mapping[str, Any]], ...]:
    """Return the model's own part, and one option per value of a field."""
    return (model_share, {}), *((share, {field: value}) for value, share in shares.items())


ALL_DETAILS: Final[dict[str, Detail]] = {
    "seams": Detail(_kinds(0, "soft_seams", {True: 1}), _is_car),
    "grille": Detail(
        _kinds(
            2,
            "grille",
            {
                "wide": 1, "shield": 1, "slim": 1.2, "split": 0.7, "hexagon": 1, "oval": 0.5, "bar": 0.8, "blocks": 0.6,
                "closed": 0.7, "frame": 1.6, "kidneys": 0.9, "tall": 0.8, "double": 1.2, "panel": 0.8, "strip": 0.7,
                "none": 0.8,
            },
        ),
        _is_car,
    ),
    "grille_frame": Detail(
        _kinds(4, "grille_frame", {"chrome": 3, "paint": 2.5, "gap": 2.5, "trim": 1}), _is_car
    ),
    "intake": Detail(
        _kinds(
            2,
            "intake",
            {"wide": 1, "triple": 1, "deep": 1, "slot": 1, "skid": 0.7, "plain": 0.6, "corners": 1.4, "mouth": 1.4},
        ),
        _is_car,
    ),
    "headlight": Detail(
        _kinds(
            2,
            "headlight",
            {
                "swept": 1, "hook": 1, "slim": 1, "drop": 0.9, "box": 0.7, "twin": 0.7, "round": 0.4, "ring": 0.5,
                "narrow": 1.2, "blade": 1.2, "tall": 0.8, "pixel": 0.5, "split": 0.9,
            },
        ),
        _is_any,
    ),
    "taillight": Detail(
        _kinds(
            2,
            "taillight",
            {
                "wide": 1, "tall": 1, "band": 0.8, "hook": 0.8, "bar": 1.4, "column": 1.1, "slim": 1, "rings": 0.5,
                "blade": 1, "clear": 0.7, "block": 0.8, "pillar": 8,
            },
        ),
        _is_car,
    ),
    "exhausts": Detail(_kinds(3, "exhausts", {"": 3, "pipes": 1.5, "blend": 1, "fins": 1, "middle": 0.6}), _is_car),
    "bumper": Detail(_kinds(6, "bumper", {"black": 1.5, "low": 2.5}), _is_car),
    "sills": Detail(
        (
            (5, {}), (2, {"cladding": True}), (1, {"cladding": False}), (2, {"sill": "paint"}),
            (0.7, {"sill": "chrome"}),
        ),
        _is_car,
    ),
    "roof": Detail(_kinds(8, "roof_tone", {GLOSS_BLACK: 1.6, "#eeeeee": 0.2}), _is_private),
    "pillars": Detail(_kinds(6, "pillar_tone", {"trim": 1.5, GLOSS_BLACK: 1.5}), _is_private),
    "bright": Detail(_kinds(5, "chrome", {True: 2, False: 2}), _is_car),
    "glass": Detail(_kinds(5, "tinted", {True: 2, False: 2}), _is_car),
    "mirrors": Detail(_kinds(6, "mirror", {"trim": 2, GLOSS_BLACK: 2, "paint": 1.5, "#bbbbbb": 0.4}), _is_car),
    "roof_load": Detail(
        (
            (12, {}), (0.6, {"load": "box"}), (1, {"load": "bars"}), (0.25, {"load": "ladder"}),
            (1.5, {"rails": True}), (1.5, {"rails": False}), (0.3, {"sign": True}),
        ),
        _may_carry,
    ),
    "antenna": Detail(_kinds(5, "antenna", {"fin": 4, "rod": 2}), _is_car),
    "plates": Detail(
        (
            (8, {}), (1.5, {"rear_plate": "plate_yellow"}),
            (1, {"front_plate": "plate_yellow", "rear_plate": "plate_yellow"}),
            (0.8, {"front_plate": ""}),
        ),
        _is_any,
    ),
    "plate_places": Detail(
        (
            (6, {}), (1.5, {"plate_steps": 1}), (1, {"plate_steps": -1}), (2, {"low_plate": True}),
            (1, {"low_plate": True, "plate_steps": 1}),
        ),
        _is_car,
    ),
    "badge": Detail(
        (
            (5, {}), (1, {"badge_size": 1.35}), (1, {"badge_size": 0.75}), (1, {"badge": GLOSS_BLACK}),
            (0.7, {"badge": "#224488"}), (0.5, {"badge": "#cc2222"}), (0.7, {"badge": "chrome", "badge_size": 1.7}),
        ),
        _is_any,
    ),
    "decal": Detail(
        _kinds(8, "decal", {"stripe": 0.3, "panel": 0.9, "letters": 1.2, "racing": 0.15}), _is_car
    ),
    "side": Detail(_kinds(3, "soft", {True: 1, False: 1}), _is_private),
    "hood": Detail(_kinds(3, "dome", {0.004: 1, 0.022: 1, 0.034: 1}), _is_private),
    "panes": Detail(
        _kinds(3, "panes", {(0.0, 1.0): 1, (0.0, 0.86, 0.89, 1.0): 1, (0.0, 0.8): 0.6, (0.0, 0.7, 0.74, 1.0): 0.6}),
        _has_rear_panes,
    ),
    "spoiler": Detail(_kinds(3, "spoiler", {True: 1, False: 1}), _is_hatch),
    "spokes": Detail(_kinds(3, "spokes", {4: 0.5, 5: 3, 6: 1, 7: 1, 9: 1, 10: 2, 12: 1, 14: 1, 18: 1}), _is_car),
}  # fmt: skip
"""All details by their name in `Details`."""


class _Rare(NamedTuple):
    """Options that are rare on vehicles other than those for which they are usual."""

    options: slice
    factor: float
    """Factor on the options' share on other vehicles."""
    usual: Callable[[VehicleStyle, str], bool]


RARE_DETAILS: Final = {
    "decal": _Rare(slice(1, None), 0.15, lambda style, _: style.palette != "private"),
    "sills": _Rare(slice(1, 2), 0.2, lambda _, kind: kind in ("suv", "pickup", "van", "wagon")),
    "taillight": _Rare(slice(-1, None), 0, lambda _, kind: kind == "van"),
    "roof_load": _Rare(slice(3, 4), 0.15, lambda _, kind: kind == "van"),
}
"""Options in `ALL_DETAILS` that are rare or absent on vehicles for which `usual` is false, by the detail's name."""
DIRTY_SHARE: Final = 0.45
"""Share of vehicles that are dirty."""


def draw_details(style: VehicleStyle, vehicle_type: str, rng: np.random.Generator) -> dict[str, float]:
    """Return random options for a vehicle of a style and type, by name of `Details`, without the model's own parts."""
    out = {}
    for name, detail in ALL_DETAILS.items():
        shares = np.array([share for share, _ in detail.options], dtype=np.float64)
        if name in RARE_DETAILS and not RARE_DETAILS[name].usual(style, vehicle_type):
            shares[RARE_DETAILS[name].options] *= RARE_DETAILS[name].factor
        choice = float(rng.choice(len(shares), p=shares / shares.sum()))
        if choice and detail.suits(style, vehicle_type):
            out[name] = choice
    dirt = float(rng.uniform(0.1, 1.0)) ** 2
    if rng.uniform() < DIRTY_SHARE:
        out["dirt"] = dirt
    return out


def styled(style: VehicleStyle, shape: Shape) -> VehicleStyle:
    """Return a model's style with the parts that a shape's details select.

    Raises:
        UserError: A detail has no option of that number, or `dirt` is out of range.
    """
    changes: dict[str, Any] = {}
    for name, detail in ALL_DETAILS.items():
        choice, count = getattr(shape, name), len(detail.options)
        if choice not in range(count):
            raise UserError(f"shape: {name}: expected a whole number from 0 to {count - 1}, got {choice}")
        changes |= detail.options[int(choice)][1]
    if not 0 <= shape.dirt <= 1:
        raise UserError(f"shape: dirt: expected 0 to 1, got {shape.dirt}")
    return replace(style, **changes) if changes else style


assert {*ALL_DETAILS, "dirt"} == DETAIL_NAMES
assert {key for detail in ALL_DETAILS.values() for _, option in detail.options for key in option} <= {
    f.name for f in fields(VehicleStyle)
}
