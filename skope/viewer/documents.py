"""JSON documents for the page: compact rows of all images at once, vehicles of an image when it is shown, filters."""

import bisect
import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Final

import numpy as np

from skope.metrics import outcome_counts
from skope.metrics.breakdown import BREAKDOWN_BANDS, band_names
from skope.metrics.failures import false_detections, wrong_points
from skope.metrics.keypoint_outcomes import outcomes_at
from skope.metrics.match import box_of
from skope.metrics.pck_precision_recall import match_split
from skope.pictures import draw
from skope.schema import VEHICLE_TYPES, Annotation, Image, Result, RoadUser
from skope.types import Array, Integers
from skope.viewer.collection import Collection, Picture, ShownSplit

UNKNOWN_VALUE: Final = "unknown"


@dataclass(frozen=True, kw_only=True)
class Quality:
    """Property of a vehicle that has one of a few values. The page filters vehicles by it."""

    name: str
    values: Sequence[str]


TYPE_QUALITY: Final = Quality(name="vehicle type", values=(*VEHICLE_TYPES, UNKNOWN_VALUE))
OCCLUSION_QUALITY: Final = Quality(
    name="hidden share", values=(*band_names(BREAKDOWN_BANDS.occlusions, "1"), UNKNOWN_VALUE)
)
HEIGHT_QUALITY: Final = Quality(name="height, px", values=tuple(band_names(BREAKDOWN_BANDS.heights_px)))
ALL_QUALITIES: Final = (TYPE_QUALITY, OCCLUSION_QUALITY, HEIGHT_QUALITY)


def kind_number(vehicle: Annotation, boxes: str) -> int:
    """Return the number that encodes a vehicle's values of all `ALL_QUALITIES`; the last one is the least significant.

    `boxes` is the kind of box, "full" or "visible".
    """
    height = float(box_of(vehicle, boxes)[3])
    places = (
        TYPE_QUALITY.values.index(vehicle.vehicle_type or UNKNOWN_VALUE),
        _band(vehicle.occlusion, BREAKDOWN_BANDS.occlusions, OCCLUSION_QUALITY),
        _band(height, BREAKDOWN_BANDS.heights_px, HEIGHT_QUALITY),
    )
    number = 0
    for value_index, quality in zip(places, ALL_QUALITIES, strict=True):
        number = number * len(quality.values) + value_index
    return number


def _band(value: float | None, edges: Sequence[float], quality: Quality) -> int:
    return len(quality.values) - 1 if value is None else int(np.searchsorted(edges, value, side="right"))


def described() -> list[dict[str, Any]]:
    """Return `ALL_QUALITIES` for the page."""
    return [{"name": quality.name, "values": list(quality.values)} for quality in ALL_QUALITIES]


@dataclass(frozen=True)
class ScoreSteps:
    """Resolution of the score threshold."""

    steps: int = 1000
    """Score thresholds are whole numbers from 0 to this, so that browser and server use the same values."""
    kept: int = 8
    """Maximum number of score thresholds with cached counts."""


SCORE_STEPS_KEPT: Final = ScoreSteps()

SCORE_THRESHOLDS: Final = np.arange(SCORE_STEPS_KEPT.steps + 1) / SCORE_STEPS_KEPT.steps
IMAGE_FACETS: Final[dict[str, Callable[[Image], str | None]]] = {
    "split": lambda image: image.split,
    "site": lambda image: image.site,
    "recording": lambda image: None if image.recording is None else f"{image.site or '-'}/{image.recording}",
    "weather": lambda image: image.weather,
}
"""Properties for filtering images."""


class Documents:
    """JSON documents of a collection. Images are numbered from 0 through all splits."""

    def __init__(self, collection: Collection) -> None:
        self._collection = collection
        self._splits = [_SplitDocuments(split, collection) for split in collection.splits]
        self._ends = list(itertools.accumulate(len(split.file.images) for split in collection.splits))
        self.scores = lru_cache(maxsize=SCORE_STEPS_KEPT.kept)(self._scores)

    @property
    def has_predictions(self) -> bool:
        """Whether there are scores."""
        return self._collection.options is not None

    def __len__(self) -> int:
        """Number of images."""
        return self._ends[-1]

    def index(self) -> dict[str, Any]:
        """Return the title of the page, and columns with a row per image: name, filter values and vehicles.

        Vehicles are numbers, one for each kind of vehicle that a filter distinguishes, each once.
        """
        options, scheme = self._collection.options, self._collection.splits[0].file.scheme
        return {
            "title": self._collection.title,
            "truth": self._collection.truth,
            "score": None if options is None else _step_of(options.score),
            "predicted": list(options.points) if options else [],
            "keypoints": list(scheme.names),
            "skeleton": [list(edge) for edge in scheme.skeleton],
            "names": [image.file_name for split in self._collection.splits for image in split.file.images],
            "facets": [self._facet(name, value) for name, value in IMAGE_FACETS.items()],
            "qualities": described(),
            "kinds": [kinds for split in self._splits for kinds in split.kinds()],
            "others": any(len(split.file.categories) > 1 for split in self._collection.splits),
        }

    def _facet(self, name: str, value: Callable[[Image], str | None]) -> dict[str, Any]:
        """Return the values of a field, and the index of each image's value; -1 for none."""
        values = [
            # Files of other tools specify the split only in their name.
            value(image) or (split.file.name if name == "split" else None) or None
            for split in self._collection.splits
            for image in split.file.images
        ]
        known = sorted({value for value in values if value is not None})
        index_of = {value: i for i, value in enumerate(known)}
        return {"name": name, "values": known, "of": [-1 if value is None else index_of[value] for value in values]}

    def details(self, number: int) -> dict[str, Any]:
        """Return the overlays of an image and their texts."""
        split, index = self._split_of(number)
        return self._splits[split].details(index)

    def picture(self, number: int) -> Picture:
        """Return the file of an image. Raises UserError if it cannot be read."""
        split, index = self._split_of(number)
        return self._collection.picture(self._collection.splits[split].file.images[index])

    def _split_of(self, number: int) -> tuple[int, int]:
        """Return the split of an image, and its index in it."""
        split = bisect.bisect_right(self._ends, number)
        return split, number - (self._ends[split - 1] if split else 0)

    def _scores(self, step: int) -> dict[str, Any]:
        """Return figures of the detections above a score threshold, image by image."""
        parts = [split.scores(step) for split in self._splits]
        return {name: [value for part in parts for value in part[name]] for name in parts[0]}


class _SplitDocuments:
    """JSON documents of one split. Images are numbered from 0."""

    def __init__(self, split: ShownSplit, collection: Collection) -> None:
        self._split, self._options = split, collection.options
        self._truth = collection.truth
        self._boxes = self._options.boxes if self._options else "full"
        groups = split.file.by_image()
        self._vehicles = [groups[image.id] for image in split.file.images]
        road_users_by_image = split.file.road_users_by_image()
        self._road_users = [road_users_by_image[image.id] for image in split.file.images]
        self._kinds = {a.id: kind_number(a, self._boxes) for a in split.file.annotations}
        if self._options:
            # Lower scores do not affect which vehicle a detection matches, so one matching is valid at every threshold.
            options = replace(self._options, score=0.0)
            self._matches = match_split(split.file, split.results, options)
            self._outcomes = outcomes_at(self._matches, options.loosest, options)
            self._wrong = wrong_points(self._matches, self._outcomes, options) >= 0
            self._false = false_detections(self._matches, self._outcomes)

    def kinds(self) -> list[list[int]]:
        """Return the kinds of vehicles of each image that are not ignored."""
        return [sorted({self._kinds[a.id] for a in vehicles if not a.ignored}) for vehicles in self._vehicles]

    def details(self, index: int) -> dict[str, Any]:
        image, vehicles = self._split.file.images[index], self._vehicles[index]
        found = self._found(index) if self._options else {}
        return {
            "size": [image.width, image.height],
            "facts": _facts(image, self._split.file.name),
            "vehicles": [self._vehicle(a) | found.get(a.id, {}) for a in vehicles],
            "others": [self._drawn(user) | {"category": user.category} for user in self._road_users[index]],
            "detections": self._detections(index) if self._options else [],
        }

    def _vehicle(self, vehicle: Annotation) -> dict[str, Any]:
        return self._drawn(vehicle) | {"points": _rounded(vehicle.keypoints), "kind": self._kinds[vehicle.id]}

    def _drawn(self, label: Annotation | RoadUser) -> dict[str, Any]:
        """Return drawing and description of a road user of any category."""
        return {
            "box": _rounded(box_of(label, self._boxes)),
            "words": draw.words_of(label),
            "color": "#{:02x}{:02x}{:02x}".format(*draw.color_of(label)),
            "ignored": label.ignored,
        }

    def _found(self, index: int) -> dict[int, dict[str, Any]]:
        """Return the ground truth of an image by id: score step of its detection, and wrong keypoints."""
        out = {}
        for g in _of_image(self._matches.gt_image, index):
            d = int(self._outcomes.detection[g])
            found = d >= 0
            out[self._matches.vehicles[g].id] = {
                "found": _step_of(float(self._matches.det_score[d])) if found else 0,
                # Detections are listed in the order of their numbers.
                "by": d - _of_image(self._matches.det_image, index).start if found else None,
                "wrong": np.flatnonzero(self._wrong[g]).tolist(),
            }
        return out

    def _detections(self, index: int) -> list[dict[str, Any]]:
        return [
            self._detection(
                self._split.results[self._matches.det_result[d]], false=self._truth and bool(self._false[d])
            )
            for d in _of_image(self._matches.det_image, index)
        ]

    def _detection(self, result: Result, *, false: bool) -> dict[str, Any]:
        points = result.keypoints
        return {
            "box": _rounded(result.bbox),
            "points": np.column_stack([np.round(points[:, :2], 1), np.round(points[:, 2], 3)]).ravel().tolist(),
            "score": round(result.score, 4),
            "step": _step_of(result.score),
            "false": false,
            "words": "followed from other frames" if result.interpolated else "",
        }

    def scores(self, step: int) -> dict[str, list[Any]]:
        """Return per image: detections above a threshold, false positives, missed vehicles by kind, and quality.

        Quality is None if nothing is labelled. Without ground truth there are only detections.
        """
        assert self._options
        options = replace(self._options, score=step / SCORE_STEPS_KEPT.steps)
        matches = match_split(self._split.file, self._split.results, options)
        outcomes = outcomes_at(matches, options.loosest, options)
        tally = outcome_counts.tally(matches, options.loosest, options)
        if not self._truth:
            return {"detections": tally.detections.tolist()}
        missed: list[list[int]] = [[] for _ in self._split.file.images]
        for g in np.flatnonzero(~outcomes.found):
            missed[matches.gt_image[g]].append(self._kinds[matches.vehicles[g].id])
        false = np.bincount(matches.det_image[false_detections(matches, outcomes)], minlength=matches.images)
        quality = [None if np.isnan(value) else round(value, 4) for value in outcome_counts.quality(tally).tolist()]
        return {
            "detections": tally.detections.tolist(),
            "false": false.tolist(),
            "missed": missed,
            "quality": quality,
        }


def _of_image(numbers: Integers, index: int) -> range:
    """Return the rows of an image's entries in a sorted column of image numbers."""
    first, last = np.searchsorted(numbers, [index, index + 1])
    return range(int(first), int(last))


def _step_of(score: float) -> int:
    """Return the lowest threshold step that a score does not exceed: it counts at every step below this."""
    return int(np.searchsorted(SCORE_THRESHOLDS, score, side="left"))


def _rounded(values: Array) -> list[float]:
    return [round(value, 1) for value in values.ravel().tolist()]


def _facts(image: Image, split: str) -> list[list[str]]:
    """Return facts about an image as texts: name and value."""
    facts: Sequence[tuple[str, object]] = (
        ("size", f"{image.width}x{image.height}"),
        ("split", image.split or split),
        ("site", image.site),
        ("recording", image.recording),
        ("frame", image.frame_index),
        ("time", None if image.time_s is None else f"{image.time_s:.2f} s"),
        ("weather", image.weather),
        ("sun's elevation", None if image.sun_elevation_deg is None else f"{image.sun_elevation_deg:.0f}°"),
    )
    return [[name, str(value)] for name, value in facts if value not in (None, "")]
