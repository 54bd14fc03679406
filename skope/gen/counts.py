"""What a card counts."""

from collections import Counter
from typing import Any

from skope.gen.recording import Take


class Counts:
    """Counts for the card: images, ground truth and ignored vehicles by split, site, weather, type and reason."""

    def __init__(self) -> None:
        self.images = self.vehicles = 0
        self.by: dict[str, dict[str, Counter[str]]] = {"split": {}, "site": {}, "weather": {}, "vehicle_type": {}}
        self.tally: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()

    def add(self, take: Take, labels: dict[str, Any]) -> None:
        places = [("split", take.split), ("site", take.site), ("weather", labels["image"]["weather"])]
        for group, name in places:
            self.by[group].setdefault(name, Counter())["images"] += 1
        for annotation in labels["annotations"]:
            kind = "ignored" if annotation["iscrowd"] else "ground_truth"
            for group, name in (*places, ("vehicle_type", annotation["vehicle_type"])):
                self.by[group].setdefault(name, Counter())[kind] += 1
        tally = dict(labels["tally"])
        self.ignored.update(tally.pop("ignored"))
        self.tally.update(tally)

    def to_dict(self) -> dict[str, Any]:
        return {
            "images": self.images,
            "ground_truth": sum(counter["ground_truth"] for counter in self.by["split"].values()),
            "ignored": dict(sorted(self.ignored.items())),
            "by_split": self._table("split", "images", "ground_truth", "ignored"),
            "by_site": self._table("site", "images", "ground_truth", "ignored"),
            "by_weather": self._table("weather", "images", "ground_truth", "ignored"),
            "by_vehicle_type": self._table("vehicle_type", "ground_truth", "ignored"),
        }

    def _table(self, group: str, *columns: str) -> dict[str, dict[str, int]]:
        return {name: {column: counter[column] for column in columns} for name, counter in self.by[group].items()}
