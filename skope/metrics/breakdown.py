"""Recall and PCK of groups of vehicles: by distance, size, type, weather and so on, and by keypoint.

A false detection has no distance or type, so the groups have recall and PCK but no precision.
"""

import itertools
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from skope import keypoints
from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes, outcomes_at
from skope.metrics.match import Matches
from skope.metrics.outcome_counts import ratio
from skope.schema import Annotation, Image
from skope.types import Mask


@dataclass(frozen=True)
class BreakdownBands:
    """Edges of the bands of a breakdown."""

    distances_m: tuple[float, float, float] = (20.0, 40.0, 60.0)
    """Distances from the camera, metres."""
    heights_px: tuple[float, float, float, float] = (25.0, 50.0, 100.0, 200.0)
    """Heights of boxes, pixels."""
    occlusions: tuple[float, float] = (0.1, 0.4)
    """Hidden fractions of a vehicle, 0 to 1."""
    truncations: tuple[float, float] = (0.1, 0.4)
    """Truncated fractions of a vehicle, 0 to 1."""
    # Limits of a group that the paper reports separately: unoccluded vehicles within 40 m.
    unoccluded: float = 0.01
    """Hidden fraction below which a vehicle is unoccluded."""
    near_m: float = 40.0
    """Distance of near vehicles, metres."""


BREAKDOWN_BANDS: Final = BreakdownBands()


@dataclass(frozen=True, kw_only=True)
class FleetInfo:
    """Vehicle models of a dataset, from its card; empty if there is no card."""

    held_out: Collection[str] | None = None
    """Models that no training image shows; None if the card does not list them."""
    substituted: Mapping[str, Sequence[str]] = field(default_factory=dict)
    """Model -> names of the keypoints that replace a part that its body lacks."""


def breakdown(images: Sequence[Image], matches: Matches, options: MetricOptions, fleet: FleetInfo) -> dict[str, Any]:
    """Return the figures of groups of vehicles, and of each keypoint.

    Args:
        images: The images of the split, in the order of the file.
        matches: The split's ground truth and detections.
        options: The counting rules and IoU thresholds.
        fleet: Vehicle models from the dataset's card.

    Returns:
        The entry `by` of a split in `metrics.json`: quantity -> group -> IoU threshold -> counts and ratios.
    """
    outcomes = {t: outcomes_at(matches, t, options) for t in options.iou}
    parts = _parts(images, matches, fleet)
    out: dict[str, Any] = {
        quantity: {
            name: {f"{t:g}": _vehicle_figures(outcomes[t], mask, options.alpha) for t in outcomes}
            for name, mask in masks.items()
        }
        for quantity, masks in parts.items()
    }
    out["keypoint"] = {
        options.scheme.names[k]: {
            f"{t:g}": _point_figures(outcomes[t], _column(matches, k), options.alpha) for t in outcomes
        }
        for k in options.points
    }
    stand_ins = _substituted(matches.vehicles, fleet)
    if stand_ins.any():
        out["keypoint_kind"] = {
            name: {f"{t:g}": _point_figures(outcomes[t], mask, options.alpha) for t in outcomes}
            for name, mask in (("own", ~stand_ins), ("substituted", stand_ins))
        }
    return out


def _parts(images: Sequence[Image], matches: Matches, fleet: FleetInfo) -> dict[str, dict[str, Mask]]:
    vehicles = matches.vehicles
    weather = [images[i].weather for i in matches.gt_image]
    parts = {
        "distance": _by_band([v.distance for v in vehicles], BREAKDOWN_BANDS.distances_m),
        "height": _by_band(
            (matches.gt_boxes_xyxy[:, 3] - matches.gt_boxes_xyxy[:, 1]).tolist(), BREAKDOWN_BANDS.heights_px
        ),
        "occlusion": _by_band([v.occlusion for v in vehicles], BREAKDOWN_BANDS.occlusions, last="1"),
        "truncation": _by_band([v.truncation for v in vehicles], BREAKDOWN_BANDS.truncations, last="1"),
        "unoccluded_within_40_m": _by_yes_or_no(vehicles, _paper_cell, {True: "yes", False: "no"}),
        "vehicle_type": _by_name([v.vehicle_type for v in vehicles]),
        "weather": _by_name(weather),
        "parked": _by_yes_or_no(vehicles, lambda v: v.parked, {True: "parked", False: "driving"}),
        "model": _by_yes_or_no(vehicles, lambda v: _unseen(v, fleet), {True: "unseen", False: "seen"}),
    }
    return {quantity: masks for quantity, masks in parts.items() if masks}


def _paper_cell(vehicle: Annotation) -> bool | None:
    if vehicle.occlusion is None or vehicle.distance is None:
        return None
    return vehicle.occlusion < BREAKDOWN_BANDS.unoccluded and vehicle.distance < BREAKDOWN_BANDS.near_m


def _unseen(vehicle: Annotation, fleet: FleetInfo) -> bool | None:
    return None if fleet.held_out is None or vehicle.model is None else vehicle.model in fleet.held_out


def band_names(edges: Sequence[float], last: str | None = None) -> list[str]:
    """Return the names of the bands from 0 over `edges`, like "0-20"; the last band ends with `last`."""
    inner = [f"{low:g}-{high:g}" for low, high in itertools.pairwise((0.0, *edges))]
    return [*inner, f"{edges[-1]:g}-{last}" if last else f"{edges[-1]:g}+"]


def _by_band(values: Sequence[float | None], edges: Sequence[float], last: str | None = None) -> dict[str, Mask]:
    """Return masks of [0, e0), [e0, e1), ... and from the last edge on, without empty bands."""
    numbers = np.array([np.nan if value is None else value for value in values], dtype=np.float64)
    bounds = itertools.pairwise((0.0, *edges, np.inf))
    names = band_names(edges, last)
    out = {name: (numbers >= low) & (numbers < high) for name, (low, high) in zip(names, bounds, strict=True)}
    return {name: mask for name, mask in out.items() if mask.any()}


def _by_name(values: Sequence[str | None]) -> dict[str, Mask]:
    names = np.array([value or "" for value in values], dtype=object)
    return {str(name): names == name for name in sorted(set(names.tolist()) - {""})}


def _by_yes_or_no(
    vehicles: Sequence[Annotation], which: Callable[[Annotation], bool | None], names: Mapping[bool, str]
) -> dict[str, Mask]:
    values = [which(vehicle) for vehicle in vehicles]
    return _by_name([None if value is None else names[value] for value in values])


def _vehicle_figures(outcomes: Outcomes, part: Mask, alpha: float) -> dict[str, Any]:
    points = _point_figures(outcomes, part[:, None], alpha)
    truth, matched = int(part.sum()), int((part & outcomes.found).sum())
    return {"ground_truth": truth, "matched": matched, "box_recall": ratio(matched, truth), **points}


def _point_figures(outcomes: Outcomes, part: Mask, alpha: float) -> dict[str, Any]:
    """Return counts and ratios of the keypoints in `part`, a mask that broadcasts to (G, 33)."""
    labelled_all = int((outcomes.labelled & part).sum())
    labelled = int((outcomes.labelled & part)[outcomes.found].sum())
    correct = int((outcomes.correct(alpha) & part).sum())
    return {
        "labelled": labelled,
        "labelled_all": labelled_all,
        "correct": correct,
        "pck": ratio(correct, labelled),
        "keypoint_recall": ratio(correct, labelled_all),
    }


def _column(matches: Matches, k: int) -> Mask:
    mask = np.zeros((len(matches.gt_image), keypoints.K), dtype=bool)
    mask[:, k] = True
    return mask


def _substituted(vehicles: Sequence[Annotation], fleet: FleetInfo) -> Mask:
    """Return the (G, 33) mask of keypoints that replace a part that the vehicle's body lacks."""
    mask = np.zeros((len(vehicles), keypoints.K), dtype=bool)
    for i, vehicle in enumerate(vehicles):
        mask[i, [keypoints.INDEX[name] for name in fleet.substituted.get(vehicle.model or "", ())]] = True
    return mask
