"""Statistics of a dataset by split: number, size, distance and occlusion of vehicles."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope.dataset import shards
from skope.dataset.folder import Dataset
from skope.files.atomic import replacing
from skope.keypoints import K
from skope.schema import CATEGORY_NAMES, Annotation, AnnotationFile, Image
from skope.terminal.console import text_table

OPTIONAL_NUMBERS: Final = ("bend_deg", "road_users")
"""Numbers that are present in some datasets only."""
MEASURED_IMAGES: Final = 200
"""Number of images per split, evenly spread, for the brightness."""
_SPLIT_COLORS: Final = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#000000")
"""Colours of splits in plots: those of Okabe and Ito, which colour-blind readers can distinguish."""
_SPLIT_LINES: Final = ("solid", "dashed", "dotted", "dashdot", "solid")
"""Line styles of splits in plots, so that no difference depends on colour alone."""


@dataclass(frozen=True)
class SplitStats:
    """Statistics of one split. They are of its ground truth unless stated otherwise. Quartiles are (25%, 50%, 75%)."""

    images: int
    sites: int
    vehicles: int
    """Number of ground-truth boxes."""
    ignored: int
    tracks: int
    """Number of distinct vehicles, by site, recording and track id; vehicles without a track id are not counted."""
    per_image: float
    distance_m: tuple[float, float, float]
    box_height_px: tuple[float, float, float]
    occluded: float
    """Mean hidden share of the silhouette."""
    crowded: float
    """Share of the vehicles with more than a tenth of the silhouette hidden."""
    visible_points: float
    """Mean share of the 33 keypoints that are visible."""
    brightness: float
    """Mean grey level, 0 to 255."""
    types: Mapping[str, int]
    bend_deg: tuple[float, float, float] | None = None
    """Quartiles of the absolute angle between an articulated vehicle and its trailer, degrees; None without such
    vehicles."""
    road_users: Mapping[str, "CategoryStats"] | None = None
    """Statistics of each labelled category without keypoints; None if only vehicles are labelled."""

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as JSON values; null if there was nothing to count."""
        values = {name: _without_nan(value) for name, value in asdict(self).items()}
        if self.road_users is not None:
            values["road_users"] = {name: category_stats.to_dict() for name, category_stats in self.road_users.items()}
        return {name: value for name, value in values.items() if value is not None or name not in OPTIONAL_NUMBERS}


@dataclass(frozen=True)
class CategoryStats:
    """Statistics of one category without keypoints in one split."""

    ground_truth: int
    ignored: int
    tracks: int
    """Number of distinct road users in the ground truth, by site, recording and track id."""
    distance_m: tuple[float, float, float]
    """Quartiles of the distance, as for vehicles, metres."""
    box_height_px: tuple[float, float, float]
    occluded: float
    """Mean hidden share of the silhouette."""

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers as JSON values."""
        return {name: _without_nan(value) for name, value in asdict(self).items()}


def _without_nan(value: Any) -> Any:
    if isinstance(value, tuple):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and math.isnan(value) else value


def split_stats(dataset: Dataset, file: AnnotationFile) -> SplitStats:
    """Return the statistics of one split.

    Args:
        dataset: Dataset with the images; at most `MEASURED_IMAGES` of them are read.
        file: Annotations of the split.
    """
    known = [annotation for annotation in file.annotations if not annotation.iscrowd]
    places = {image.id: (image.site, image.recording) for image in file.images}
    seen = np.array([(a.keypoints[:, 2] == 2).mean() for a in known])
    hidden = np.array([a.occlusion for a in known if a.occlusion is not None])
    bends = [math.degrees(abs(a.articulation)) for a in known if a.articulation is not None]
    return SplitStats(
        images=len(file.images),
        sites=len({site for site, _ in places.values() if site is not None}),
        vehicles=len(known),
        ignored=len(file.annotations) - len(known),
        tracks=len({(*places[a.image_id], a.track_id) for a in known if a.track_id is not None}),
        per_image=len(known) / max(len(file.images), 1),
        distance_m=_quartiles([a.distance for a in known if a.distance is not None]),
        box_height_px=_quartiles([float(a.bbox[3]) for a in known]),
        occluded=_mean(hidden),
        crowded=_mean(hidden > 0.1),
        visible_points=_mean(seen),
        brightness=_brightness(dataset, file.images),
        types=_types(known),
        bend_deg=_quartiles(bends) if bends else None,
        road_users={name: _category_stats(file, name, places) for name in file.categories[1:]} or None,
    )


def _category_stats(
    file: AnnotationFile, category: str, places: Mapping[int, tuple[str | None, str | None]]
) -> CategoryStats:
    """Return the statistics of one category; `places` has site and recording of each image."""
    every = [user for user in file.road_users if user.category == category]
    known = [user for user in every if not user.ignored]
    return CategoryStats(
        ground_truth=len(known),
        ignored=len(every) - len(known),
        tracks=len({(*places[user.image_id], user.track_id) for user in known if user.track_id is not None}),
        distance_m=_quartiles([user.distance for user in known if user.distance is not None]),
        box_height_px=_quartiles([float(user.bbox[3]) for user in known]),
        occluded=_mean(np.array([user.occlusion for user in known if user.occlusion is not None])),
    )


def _types(annotations: list[Annotation]) -> dict[str, int]:
    return dict(Counter(a.vehicle_type for a in annotations if a.vehicle_type).most_common())


def _brightness(dataset: Dataset, images: tuple[Image, ...]) -> float:
    chosen = sorted({round(i) for i in np.linspace(0, len(images) - 1, MEASURED_IMAGES)}) if images else []
    levels = []
    for i in chosen:
        data = np.frombuffer(shards.read(dataset.root / images[i].file_name), dtype=np.uint8)
        picture = cv2.imdecode(data, cv2.IMREAD_REDUCED_GRAYSCALE_8)
        if picture is not None:
            levels.append(float(picture.mean()))
    return _mean(np.array(levels))


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if len(values) else math.nan


def _quartiles(values: list[float]) -> tuple[float, float, float]:
    if not values:
        return (math.nan,) * 3
    low, middle, high = np.percentile(values, [25, 50, 75])
    return float(low), float(middle), float(high)


def stats_table(stats: Mapping[str, SplitStats]) -> list[str]:
    """Return the lines of a table with a column per split."""
    return text_table(["", *stats], [[name, *cells] for name, cells in rows(stats)])


def rows(stats: Mapping[str, SplitStats]) -> list[tuple[str, list[str]]]:
    """Return the rows of the table of splits: names and a cell per split."""
    columns, types = list(stats.values()), Counter[str]()
    for column in columns:
        types.update(column.types)
    cells: dict[str, Callable[[SplitStats], str]] = {
        "images": lambda s: str(s.images),
        "sites": lambda s: str(s.sites),
        "vehicles": lambda s: str(s.vehicles),
        "ignored": lambda s: str(s.ignored),
        "distinct vehicles": lambda s: str(s.tracks),
        "vehicles per image": lambda s: f"{s.per_image:.2f}",
        "distance, m": lambda s: _median(s.distance_m),
        "box height, px": lambda s: _median(s.box_height_px),
        "hidden share": lambda s: _known(s.occluded, ".3f"),
        "more than 10% hidden": lambda s: _known(s.crowded, ".1%"),
        "visible keypoints": lambda s: _known(s.visible_points, ".3f"),
        "brightness, of 255": lambda s: _known(s.brightness, ".0f"),
    }
    if any(s.bend_deg for s in columns):
        cells["bend of articulated vehicles, deg"] = lambda s: _median(s.bend_deg) if s.bend_deg else "-"
    return [
        *((name, [cell(s) for s in columns]) for name, cell in cells.items()),
        *((f"  {kind}", [str(s.types.get(kind, 0)) for s in columns]) for kind, _ in types.most_common()),
        *(
            row
            for name in CATEGORY_NAMES[1:]
            if any(name in (s.road_users or {}) for s in columns)
            for row in _rows_of(name, columns)
        ),
    ]


def _rows_of(category: str, columns: Sequence[SplitStats]) -> list[tuple[str, list[str]]]:
    """Return the rows on a category without keypoints."""
    cells: dict[str, Callable[[CategoryStats], str]] = {
        f"{category}s": lambda s: str(s.ground_truth),
        "  ignored": lambda s: str(s.ignored),
        "  distinct": lambda s: str(s.tracks),
        "  distance, m": lambda s: _median(s.distance_m),
        "  box height, px": lambda s: _median(s.box_height_px),
        "  hidden share": lambda s: _known(s.occluded, ".3f"),
    }
    category_stats = [(s.road_users or {}).get(category) for s in columns]
    return [(name, ["-" if stats is None else cell(stats) for stats in category_stats]) for name, cell in cells.items()]


def _median(values: tuple[float, float, float]) -> str:
    low, middle, high = values
    return "-" if math.isnan(middle) else f"{middle:.0f} ({low:.0f}-{high:.0f})"


def _known(value: float, form: str) -> str:
    """Return a number, or "-" if it is not available: files of other programs need not contain it."""
    return "-" if math.isnan(value) else format(value, form)


def plot(dataset: Dataset, out: Path) -> Path:
    """Draw distributions of every split to `out`/stats.png: distance, size, occlusion, keypoints, weather, types."""
    from matplotlib.figure import Figure

    files = {split: dataset.read(split) for split in dataset.splits}
    known = {split: [a for a in file.annotations if not a.iscrowd] for split, file in files.items()}
    figure = Figure(figsize=(15, 12), layout="constrained")
    axes = figure.subplots(3, 2)
    spreads: list[tuple[Any, str, Callable[[Annotation], float | None], NDArray[np.float64]]] = [
        (axes[0, 0], "distance, m", lambda a: a.distance, np.linspace(0, 160, 33)),
        (axes[0, 1], "box height, px", lambda a: float(a.bbox[3]), np.geomspace(8, 1080, 33)),
        (axes[1, 0], "hidden share", lambda a: a.occlusion, np.linspace(0, 1, 26)),
    ]
    for axis, title, value, bins in spreads:
        for number, (split, annotations) in enumerate(known.items()):
            values = [v for a in annotations if (v := value(a)) is not None]
            share = np.histogram(values, bins)[0] / max(1, len(values))
            style = {
                "linestyle": _SPLIT_LINES[number % len(_SPLIT_LINES)],
                "color": _SPLIT_COLORS[number % len(_SPLIT_COLORS)],
            }
            axis.stairs(share, bins, label=f"{split} ({len(values)})", linewidth=1.8, **style)
        axis.set(xlabel=title, ylabel="share of vehicles")
        axis.legend(frameon=False)
    axes[0, 1].set_xscale("log")
    seen = np.array([a.keypoints[:, 2] == 2 for annotations in known.values() for a in annotations]).reshape(-1, K)
    axes[1, 1].bar(range(K), seen.mean(axis=0) if len(seen) else np.zeros(K), color=_SPLIT_COLORS[0])
    axes[1, 1].set(
        xlabel="keypoint", ylabel="share of vehicles on which it is visible", xticks=range(0, K, 2), ylim=(0, 1)
    )
    weather = Counter(image.weather or "unknown" for file in files.values() for image in file.images)
    types = Counter(a.vehicle_type or "unknown" for annotations in known.values() for a in annotations)
    for axis, counts, unit in ((axes[2, 0], weather, "images"), (axes[2, 1], types, "vehicles")):
        names = [name for name, _ in counts.most_common()]
        axis.barh(names[::-1], [counts[name] for name in names[::-1]], color=_SPLIT_COLORS[0])
        axis.set_xlabel(unit)
    for axis in axes.flat:
        axis.spines[["top", "right"]].set_visible(False)
    path = out / "stats.png"
    with replacing(path) as temporary:
        figure.savefig(temporary, dpi=100)
    return path
