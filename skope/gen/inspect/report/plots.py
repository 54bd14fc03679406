"""The plots of a dataset: how far, how tall, how hidden and how visible its vehicles are, and in which weather."""

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from typing import Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints
from skope.keypoints import Scheme
from skope.page.charts import Axes, Line, histogram
from skope.page.html_pieces import percent_text, share_bar, table, tag
from skope.page.vehicle_outline import Point, outline
from skope.schema import Annotation, AnnotationFile

_BANDS: Final = 20


@dataclass(frozen=True)
class Spread:
    """Ground truth of a split, as the plots show it."""

    distance_m: NDArray[np.float64]
    height_px: NDArray[np.float64]
    hidden: NDArray[np.float64]
    visible: NDArray[np.int64]
    """(33,) of how many vehicles each keypoint is visible."""
    vehicles: int
    weather: Mapping[str, int]
    """Images."""
    types: Mapping[str, int]
    """Vehicles."""


def spread_of(file: AnnotationFile) -> Spread:
    """The values that the plots show, of the ground truth of a split's file."""
    known = [a for a in file.annotations if not a.ignored]
    visible = np.array([a.keypoints[:, 2] == 2 for a in known], dtype=np.int64).reshape(-1, keypoints.K)
    return Spread(
        distance_m=_values(known, lambda a: a.distance),
        height_px=_values(known, lambda a: float(a.bbox[3])),
        hidden=_values(known, lambda a: a.occlusion),
        visible=visible.sum(axis=0),
        vehicles=len(known),
        weather=Counter(image.weather or "unknown" for image in file.images),
        types=Counter(a.vehicle_type or "unknown" for a in known),
    )


def _values(known: Sequence[Annotation], value: Callable[[Annotation], float | None]) -> NDArray[np.float64]:
    return np.array([v for a in known if (v := value(a)) is not None], dtype=np.float64)


def spread_plots(spreads: Mapping[str, Spread], scheme: Scheme) -> list[str]:
    """Figures and tables, as parts of a page."""
    distance = {split: of.distance_m for split, of in spreads.items()}
    height = {split: of.height_px for split, of in spreads.items()}
    hidden = {split: of.hidden for split, of in spreads.items()}
    return [
        *_histogram("How far vehicles are", "distance, m", distance, _end(distance, 20)),
        *_histogram("How tall their boxes are", "box height, px", height, _end(height, 50)),
        *_histogram("How much something else hides of them", "hidden share", hidden, 1.0),
        _bars("Weather", "images", [of.weather for of in spreads.values()]),
        _bars("Vehicle types", "vehicles", [of.types for of in spreads.values()]),
        _visible(list(spreads.values()), scheme),
    ]


def _end(values: Mapping[str, NDArray[np.float64]], step: float) -> float:
    """Upper end of an axis: a multiple of `step` that all but the largest hundredth of the values lie below."""
    every = np.concatenate(list(values.values()))
    return max(step, math.ceil(np.quantile(every, 0.99) / step) * step) if every.size else step


def _histogram(title: str, unit: str, values: Mapping[str, NDArray[np.float64]], end: float) -> list[str]:
    """Bars for each split: the share of its vehicles in each band; nothing where no split has a value."""
    bands = np.linspace(0, end, _BANDS + 1)
    middles = ((bands[1:] + bands[:-1]) / 2).tolist()
    lines = [
        Line(name=f"{split} ({len(own)})", x=middles, y=(np.histogram(own, bands)[0] / len(own)).tolist())
        for split, own in values.items()
        if len(own)
    ]
    if not lines:
        return []
    highest = max(y for line in lines for y in line.y if y is not None)
    top = next(step for step in (0.05, 0.1, 0.2, 0.25, 0.5, 1.0) if step >= highest)
    axes = Axes(x_label=unit, y_label="share of vehicles", x_end=end, y_end=top)
    return [histogram(title, axes, lines)]


def _bars(title: str, unit: str, groups: Sequence[Mapping[str, int]]) -> str:
    counts = sum((Counter(group) for group in groups), Counter())
    total = max(1, counts.total())
    if len(counts) == 1:
        ((name, count),) = counts.items()
        return tag("p", tag("b", escape(f"{title}: ")), escape(f"{name} ({count} {unit})"))
    rows = [[escape(name), str(count), share_bar(count / total)] for name, count in counts.most_common()]
    return table((title.lower(), unit, "%"), rows, caption=title, sortable=True)


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
