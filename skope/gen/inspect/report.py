"""Report page of a dataset: a gallery of few of its images with filters, numbers, plots, and the card."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.gen.inspect.report_layers import LAYER_TITLES, SHOWN_LAYERS, ShownPhoto, filter_kind, shown_photo
from skope.gen.inspect.stats import SplitStats, rows, split_stats
from skope.gen.output import card_text
from skope.keypoints import Scheme
from skope.page.charts import Axes, Line, histogram
from skope.page.svg import tag
from skope.page.templates import ShareCell, Table, percent_text, render
from skope.page.vehicle_outline import Point, outline
from skope.schema import Annotation, AnnotationFile, Image, RoadUser
from skope.terminal.console import Console

_BAND_COUNT: Final = 20


@dataclass(frozen=True)
class Spread:
    """Distributions of a split's ground truth, for the plots."""

    distance_m: NDArray[np.float64]
    height_px: NDArray[np.float64]
    hidden: NDArray[np.float64]
    visible: NDArray[np.int64]
    """(33,) number of vehicles on which each keypoint is visible."""
    vehicles: int
    weather: Mapping[str, int]
    """Number of images by weather."""
    types: Mapping[str, int]
    """Number of vehicles by type."""


def spread_of(file: AnnotationFile) -> Spread:
    """Return the ground truth of a split's file for the plots."""
    known = [a for a in file.annotations if not a.ignored]
    visible = np.array([a.keypoints[:, 2] == 2 for a in known], dtype=np.int64).reshape(-1, keypoints.K)
    return Spread(
        distance_m=_known_values(known, lambda a: a.distance),
        height_px=_known_values(known, lambda a: float(a.bbox[3])),
        hidden=_known_values(known, lambda a: a.occlusion),
        visible=visible.sum(axis=0),
        vehicles=len(known),
        weather=Counter(image.weather or "unknown" for image in file.images),
        types=Counter(a.vehicle_type or "unknown" for a in known),
    )


def _known_values(known: Sequence[Annotation], value: Callable[[Annotation], float | None]) -> NDArray[np.float64]:
    return np.array([v for a in known if (v := value(a)) is not None], dtype=np.float64)


def spread_plots(spreads: Mapping[str, Spread], scheme: Scheme) -> list[str | Table]:
    """Return figures and tables, as parts of a page."""
    distance = {split: of.distance_m for split, of in spreads.items()}
    height = {split: of.height_px for split, of in spreads.items()}
    hidden = {split: of.hidden for split, of in spreads.items()}
    return [
        *_histogram("Distance of vehicles", "distance, m", distance, _axis_end(distance, 20)),
        *_histogram("Height of their boxes", "box height, px", height, _axis_end(height, 50)),
        *_histogram("Share of them that other objects hide", "hidden share", hidden, 1.0),
        _bars("Weather", "images", [of.weather for of in spreads.values()]),
        _bars("Vehicle types", "vehicles", [of.types for of in spreads.values()]),
        _visible(list(spreads.values()), scheme),
    ]


def _axis_end(values: Mapping[str, NDArray[np.float64]], step: float) -> float:
    """Return the upper end of an axis: a multiple of `step` above all but the largest hundredth of the values."""
    every = np.concatenate(list(values.values()))
    return max(step, math.ceil(np.quantile(every, 0.99) / step) * step) if every.size else step


def _histogram(title: str, unit: str, values: Mapping[str, NDArray[np.float64]], end: float) -> list[str]:
    """Return bars of each split: the share of its vehicles in each band; nothing if no split has a value."""
    bands = np.linspace(0, end, _BAND_COUNT + 1)
    middles = ((bands[1:] + bands[:-1]) / 2).tolist()
    lines = [
        Line(
            name=f"{split} ({len(split_values)})",
            x=middles,
            y=(np.histogram(split_values, bands)[0] / len(split_values)).tolist(),
        )
        for split, split_values in values.items()
        if len(split_values)
    ]
    if not lines:
        return []
    highest = max(y for line in lines for y in line.y if y is not None)
    top = next(step for step in (0.05, 0.1, 0.2, 0.25, 0.5, 1.0) if step >= highest)
    axes = Axes(x_label=unit, y_label="share of vehicles", x_end=end, y_end=top)
    return [histogram(title, axes, lines)]


def _bars(title: str, unit: str, groups: Sequence[Mapping[str, int]]) -> str | Table:
    counts = sum((Counter(group) for group in groups), Counter())
    total = max(1, counts.total())
    if len(counts) == 1:
        ((name, count),) = counts.items()
        return tag("p", tag("b", f"{title}: "), f"{name} ({count} {unit})")
    rows = [[name, count, ShareCell(count / total)] for name, count in counts.most_common()]
    return Table(caption=title, head=(title.lower(), unit, "%"), rows=rows, sortable=True)


def _visible(spreads: Sequence[Spread], scheme: Scheme) -> str:
    seen, vehicles = sum(of.visible for of in spreads), sum(of.vehicles for of in spreads)
    points = {}
    for name, count in zip(scheme.names, np.asarray(seen).tolist(), strict=True):
        part = count / vehicles if vehicles else None
        points[name] = Point(
            share=part, tip=f"visible on {count} of {vehicles}", cells=(str(count), percent_text(part))
        )
    title = "Share of the vehicles on which each keypoint is visible"
    return outline(title, points, ("visible", "of vehicles"))


def spread_out(images: Sequence[Image], count: int) -> list[int]:
    """Return ascending indices of at most `count` images: equal numbers per site, evenly spread over time."""
    groups: dict[tuple[str | None, str | None], list[int]] = {}
    for i, image in enumerate(images):
        groups.setdefault((image.split, image.site), []).append(i)
    ordered_groups = [sorted(group, key=lambda i: _time_of_image(images[i])) for group in groups.values()]
    chosen = [
        group[k]
        for group, share in zip(ordered_groups, _shares_of([len(g) for g in ordered_groups], count), strict=True)
        for k in _even_places(len(group), share)
    ]
    return sorted(chosen)


def _time_of_image(image: Image) -> tuple[str, int]:
    return image.recording or "", image.frame_index or 0


def _shares_of(sizes: Sequence[int], count: int) -> list[int]:
    """Return the number of each group, as equal as their sizes allow.

    If `count` is below the number of groups, some have one.
    """
    if count < len(sizes):
        having = set(_even_places(len(sizes), count))
        return [int(k in having) for k in range(len(sizes))]
    shares, left = [0] * len(sizes), min(count, sum(sizes))
    while left:
        open_ = [k for k, size in enumerate(sizes) if shares[k] < size]
        for k in [open_[j] for j in _even_places(len(open_), min(left, len(open_)))]:
            shares[k] += 1
            left -= 1
    return shares


def _even_places(size: int, count: int) -> list[int]:
    """Return `count` of `size` indices, evenly spread, each the middle of its part."""
    return [(2 * k + 1) * size // (2 * count) for k in range(count)]


ShownImage = tuple[Image, Sequence[Annotation | RoadUser]]

FILTER_TITLES: Final = {"split": "split", "site": "site", "weather": "weather", "type": "vehicle type"}


def write_dataset_report(dataset: Dataset, count: int, path: Path, console: Console) -> Path:
    """Write the page with at most `count` images to `path`, and return `path`; splits are read one at a time."""
    if count < 1:
        raise UserError(f"--max-images: expected a whole number from 1, got {count}")
    stats: dict[str, SplitStats] = {}
    spreads: dict[str, Spread] = {}
    candidates: list[ShownImage] = []
    for split in console.bar(dataset.splits, unit="split", label="reading"):
        file = dataset.read(split)
        stats[split], spreads[split] = split_stats(dataset, file), spread_of(file)
        labels_by_image = file.labels_by_image()
        # Files of other tools specify the split only in their name.
        images = [replace(image, split=image.split or split) for image in file.images]
        candidates += [(images[i], labels_by_image[images[i].id]) for i in spread_out(images, count)]
    if not candidates:
        raise UserError(f"{dataset.root}: has no images")
    chosen = [candidates[i] for i in spread_out([image for image, _ in candidates], count)]
    photos = [shown_photo(dataset, *pair) for pair in console.bar(chosen, unit="image", label="drawing")]
    write_text(path, _page(dataset, stats, spreads, chosen, photos))
    return path


def _page(
    dataset: Dataset,
    stats: Mapping[str, SplitStats],
    spreads: Mapping[str, Spread],
    chosen: Sequence[ShownImage],
    photos: Sequence[ShownPhoto],
) -> str:
    total = sum(of.images for of in stats.values())
    shown = f"All {total} images."
    if len(chosen) < total:
        shown = (
            f"{len(chosen)} of {total} images, spread evenly over splits, sites and recordings. Numbers and plots are "
            "of all."
        )
    name = dataset.root.resolve().name
    caption = "Ground truth only; distance and height: median and quartiles"
    numbers = [[row.strip(), *cells] for row, cells in rows(stats)]
    return render(
        "gen/inspect/report.html",
        title=f"skope gen: {name}",
        heading=card_text.DATASET_TITLE,
        name=name,
        summary=card_text.card_summary(dataset.card),
        shown=shown,
        layers={layer: words for layer, words in LAYER_TITLES.items() if _has(layer, chosen)},
        layers_on=SHOWN_LAYERS,
        filters={
            key: (words, counts) for key, words in FILTER_TITLES.items() if len(counts := _kinds(key, chosen)) > 1
        },
        photos=photos,
        numbers=Table(caption=caption, head=("", *stats), rows=numbers),
        plots=spread_plots(spreads, dataset.scheme),
        card=card_text.sections(dataset.card),
        limits=card_text.LIMITS_HEADING,
    )


def _kinds(key: str, chosen: Sequence[ShownImage]) -> Counter[str]:
    """Return the number of images per value of a filter."""
    counts = Counter[str]()
    for image, labels in chosen:
        if key == "type":
            counts.update({filter_kind(label) for label in labels if not label.ignored})
        else:
            counts.update(filter(None, [getattr(image, key)]))
    return counts


def _has(layer: str, chosen: Sequence[ShownImage]) -> bool:
    """Return whether any image has content on a layer."""
    every = [label for _, labels in chosen for label in labels]
    return {
        "boxes": True,
        "points": True,
        "boxes3d": any(label.box_3d is not None for label in every),
        "masks": any(isinstance(label.segmentation, Mapping) for label in every),
        "depth": any(image.depth_file_name for image, _ in chosen),
        "ignored": any(label.ignored for label in every),
    }[layer]
