"""Random looks of labelled people: bodies, clothes, helmets, loads, passengers and what they ride."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from skope.gen.bystanders.luggage import LUGGAGE_KINDS
from skope.gen.bystanders.people import Look
from skope.gen.bystanders.riding import MACHINES

_MACHINE_SHARES: Final = {"cyclist": (0.75, 0.25), "motorcyclist": (0.40, 0.38, 0.22)}
_LOAD_SHARES: Final[Mapping[str, Mapping[str, float]]] = {
    "pedestrian": {"backpack": 0.22, "shopping bag": 0.16, "suitcase": 0.04, "pushchair": 0.05},
    "cyclist": {"backpack": 0.20, "panniers": 0.10, "basket": 0.08, "delivery box": 0.10, "trailer": 0.04},
    "motorcyclist": {"backpack": 0.12, "panniers": 0.10, "delivery box": 0.14, "top case": 0.16},
}
_UMBRELLAS: Final = 0.45
"""Share of people on foot with an umbrella in rain."""
_HELMETS: Final = 0.55
"""Share of cyclists with a helmet."""
_PASSENGERS: Final = {"cyclist": 0.06, "motorcyclist": 0.18}
_LEAST_RIDER_M: Final = {"cyclist": 1.25, "motorcyclist": 1.55}
"""Height of the smallest rider, metres."""


def draw_look(kind: str, rng: np.random.Generator, *, raining: bool = False) -> Look:
    """Draw a jointed body of a kind of `skope.gen.bystanders.bystander.BYSTANDER_KINDS`."""
    look = replace(Look.drawn(rng), bag=0.0, palette=float(rng.integers(2**40)), jointed=1.0)
    shares = dict(_LOAD_SHARES[kind])
    if kind == "pedestrian" and raining:
        shares["umbrella"] = _UMBRELLAS
    names, p = list(shares), np.array(list(shares.values()))
    k = int(np.searchsorted(np.cumsum(p), rng.random()))
    load = LUGGAGE_KINDS.index(names[k]) if k < len(names) else 0
    helmet, second = rng.random() < _HELMETS, rng.random() < _PASSENGERS.get(kind, 0.0)
    machine = int(rng.choice(len(_MACHINE_SHARES[kind]), p=_MACHINE_SHARES[kind])) if kind in MACHINES else 0
    if kind == "cyclist" and MACHINES[kind][machine] == "racing bicycle":
        # Nobody hangs a child's seat or bags on a racing bicycle.
        second, load = False, load if LUGGAGE_KINDS[load] == "backpack" else 0
    if kind == "motorcyclist" and second and LUGGAGE_KINDS[load] == "delivery box":
        load = 0  # the passenger sits there
    return replace(
        look,
        height=max(look.height, _LEAST_RIDER_M.get(kind, 0.0)),
        load=float(load),
        helmet=float(helmet and kind == "cyclist"),
        passenger=float(second and look.height > 1.5),
        machine=float(machine),
    )
