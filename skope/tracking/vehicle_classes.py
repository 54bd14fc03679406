"""Classes of vehicles that counts are made of: one for each track, with how sure it is."""

from collections.abc import Mapping
from typing import Final

VEHICLE_CLASS_NAMES: Final = ("car", "van", "lorry", "bus", "unknown")
OF_BODY_TYPE: Final[Mapping[str, str]] = {
    "van": "van",
    "box_truck": "lorry",
    "truck": "lorry",
    "articulated_truck": "lorry",
    "bus": "bus",
    "articulated_bus": "bus",
}
"""Classes of body types that are no cars."""
_INDEPENDENT: Final = 5.0
"""Poses of one vehicle are wrong together: a track has as much to say as so many that are independent, at most."""
_UNSURE: Final = 0.6
"""Confidence from which a class is named."""


def vehicle_class(body_types: Mapping[str, int]) -> tuple[str, float]:
    """The class of a track, of whose poses so many have each body type, and its confidence, 0 to 1.

    The share of the poses that agree is drawn towards a half, the more the fewer they are. A class that is less sure
    than `_UNSURE` is unknown.
    """
    votes = dict.fromkeys(VEHICLE_CLASS_NAMES, 0)
    for name, number in body_types.items():
        votes[OF_BODY_TYPE.get(name, "car")] += number
    total = sum(votes.values())
    best = max(votes, key=votes.__getitem__)
    independent = min(float(total), _INDEPENDENT)
    confidence = (votes[best] / max(1, total) * independent + 0.5) / (independent + 1)
    return (best if confidence >= _UNSURE else "unknown", confidence)
