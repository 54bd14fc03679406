"""Counts of images and vehicles, for the dataset's card."""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

CountKind = tuple[str, str | None, str]
"""Kind under which a label is counted: "ground_truth" or "ignored", a vehicle's type, and the category."""


def count_kind(iscrowd: int, vehicle_type: str | None, category: str = "vehicle") -> CountKind:
    """The kind of a vehicle, by two fields of its annotation, or of another road user, by its category."""
    return "ignored" if iscrowd else "ground_truth", vehicle_type, category


def saved_kind(values: Sequence[Any]) -> CountKind:
    """A kind as JSON has it; what was begun before there were categories has vehicles alone."""
    status, vehicle_type = values[:2]
    return status, vehicle_type, values[2] if len(values) > 2 else "vehicle"


class Counts:
    """Counts for the card: images, ground truth and ignored vehicles by split, site, weather, type and reason.

    People on foot and on two wheels are counted apart, by category.
    """

    def __init__(self) -> None:
        self.images = self.labels = 0
        self.by: dict[str, defaultdict[str, Counter[str]]] = {
            group: defaultdict(Counter) for group in ("split", "site", "weather", "vehicle_type", "category")
        }
        self.tally: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()
        self.apart_m: list[float] = []
        self.most_apart_m = 0.0

    def add(self, places: Mapping[str, str | None], kinds: Iterable[CountKind], tally: Mapping[str, Any]) -> None:
        """Count an image with its labels; `places` name its split, site and weather.

        What is not known of an image or a vehicle is not counted.
        """
        known = [(group, name) for group, name in places.items() if name is not None]
        for group, name in known:
            self.by[group][name]["images"] += 1
        for (kind, type_, category), number in Counter(kinds).items():
            if category != "vehicle":
                self.by["category"][category][kind] += number
                continue
            for group, name in (*known, *([("vehicle_type", type_)] if type_ is not None else [])):
                self.by[group][name][kind] += number
        tally = dict(tally)
        self.ignored.update(tally.pop("ignored"))
        self.apart_m.append(tally.pop("apart_m", 0.0))
        self.most_apart_m = max(self.most_apart_m, tally.pop("most_apart_m", 0.0))
        self.tally.update(tally)

    def localizer_difference(self) -> dict[str, float | None]:
        """Difference between trilateration and the rigid transform, over all keypoints of vehicles in view, metres."""
        vehicles = self.tally["vehicles"]
        if not vehicles:
            return {"mean": None, "max": None}
        # The exact sum is the same in whatever order it was added up.
        return {"mean": round(math.fsum(self.apart_m) / vehicles, 6), "max": round(self.most_apart_m, 6)}

    def to_dict(self) -> dict[str, Any]:
        return {
            "images": self.images,
            "ground_truth": sum(counter["ground_truth"] for counter in self.by["split"].values()),
            "ignored": dict(sorted(self.ignored.items())),
            "by_split": self._table("split", "images", "ground_truth", "ignored"),
            "by_site": self._table("site", "images", "ground_truth", "ignored"),
            "by_weather": self._table("weather", "images", "ground_truth", "ignored"),
            "by_vehicle_type": self._table("vehicle_type", "ground_truth", "ignored"),
            **({"by_category": self._table("category", "ground_truth", "ignored")} if self.by["category"] else {}),
        }

    def _table(self, group: str, *columns: str) -> dict[str, dict[str, int]]:
        return {name: {column: counter[column] for column in columns} for name, counter in self.by[group].items()}
