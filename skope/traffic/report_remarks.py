"""Remarks of a traffic report: what it lacks, which figures are doubtful, and intervals of poor visibility."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.camera.model import Camera
from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.tracks.track import is_in_traffic
from skope.traffic.gates import signed_distances
from skope.traffic.manual_count_checks import hand_lines
from skope.traffic.observation import Observation, frame_durations_s
from skope.traffic.recordings import recording_lines
from skope.traffic.turning_movements import NO_GATE, on_foot
from skope.types import Array, Mask

if TYPE_CHECKING:
    from skope.traffic.traffic_report import TrafficReport


@dataclass(frozen=True)
class RemarkLimits:
    """Limits from which a report warns."""

    dark: float = 0.1
    """Mean brightness below which images show hardly anything. Of 386 generated images of all hours and weathers,
    the darkest two have 0.089 (a road without lamps) and 0.097; nights with lamps have 0.105 and more."""
    flat: float = 0.015
    """Contrast below which images show hardly anything. The thickest fog of these images has 0.010 and 0.012, other
    fog 0.031 and more, photographs of a car park from above 0.022."""
    lost_s: float = 0.5
    """Unobserved time within the footage that is worth a warning, seconds."""
    beside_m: float = 2.0
    """Tracks that begin or end this close to a gate may be missed by it, metres."""
    many_share: float = 0.1
    """Share of such tracks among its crossings that is worth a warning."""
    few_tracks: int = 3
    """Least number of such tracks."""
    least_visible: float = 0.9
    """Smallest share of a gate that a turned camera must show, of what it showed before, without a warning."""
    gate_points: int = 100
    """Number of points on a gate that are projected."""


REMARK_LIMITS: Final = RemarkLimits()


@dataclass(frozen=True, kw_only=True)
class IntervalVisibility:
    """Sight of the camera in an interval; None where nothing was measured in it."""

    low_brightness_s: float | None
    """Seconds in which the picture was dark."""
    low_contrast_s: float | None
    """Seconds in which it had hardly any contrast: fog, a lens that is covered."""
    moved_s: float
    """Seconds of another view than the camera's calibration is of: it had been moved. Nothing is observed then."""
    poor_s: float | None
    """Seconds in which any of these holds."""
    brightness: float | None
    """Mean brightness, from 0 to 1."""
    contrast: float | None
    """Mean contrast."""


def interval_visibility(observation: Observation, begin_s: float, end_s: float) -> IntervalVisibility:
    """Measure how well the camera saw in an interval.

    Args:
        observation: What is known of the footage.
        begin_s: Begin of the interval, seconds.
        end_s: Its end, seconds.
    """
    every = np.union1d(observation.times_s, observation.moved_s)
    moved_s = float(
        frame_durations_s(every, begin_s, end_s, observation.further_s)[np.isin(every, observation.moved_s)].sum()
    )
    times, brightness, contrast = observation.visibility_samples.T
    held = frame_durations_s(times, begin_s, end_s, observation.further_s)
    if not held.sum() > 0:
        return IntervalVisibility(
            low_brightness_s=None,
            low_contrast_s=None,
            moved_s=moved_s,
            poor_s=moved_s or None,
            brightness=None,
            contrast=None,
        )
    dark, flat = brightness < REMARK_LIMITS.dark, contrast < REMARK_LIMITS.flat
    frames = np.concatenate([[-np.inf], every])
    of_moved = np.isin(frames[np.searchsorted(every, times, side="right")], observation.moved_s)
    return IntervalVisibility(
        low_brightness_s=float(held[dark].sum()),
        low_contrast_s=float(held[flat].sum()),
        moved_s=moved_s,
        poor_s=moved_s + float(held[(dark | flat) & ~of_moved].sum()),
        brightness=float(np.average(brightness, weights=held)),
        contrast=float(np.average(contrast, weights=held)),
    )


def sight_lines(observation: Observation) -> Iterator[str]:
    """Sentence on how long the camera saw little; none where it always saw."""
    found = interval_visibility(observation, -np.inf, np.inf)
    parts = {
        "dark": found.low_brightness_s,
        "without contrast": found.low_contrast_s,
        "of another view, as the camera had been moved": found.moved_s,
    }
    told = [f"{seconds:.0f} s {what}" for what, seconds in parts.items() if seconds is not None and seconds >= 0.5]
    if told:
        yield (
            f"the camera saw little: {', '.join(told)}; who crosses then is hardly seen, and intervals do not "
            "tell how many (visibility.csv has the intervals)"
        )


def remarks(report: "TrafficReport") -> Iterator[str]:
    """The sentences, of a report in metres."""
    if not report.gates:
        yield "no counts, speeds and headways: the site has no gates"
    if not report.site.lanes:
        yield "no queues and lane changes, headways over the whole width of a gate: the site has no lanes"
    if report.start is None:
        yield "intervals start with the footage: its time is not known (start in the site file, or --start-time)"
    observation = report.observation
    if observation.common_scale_sigma is None:
        yield "speeds: nothing says how well the camera is known: the error that it gives all is not in their intervals"
    yield from recording_lines(report.recordings, observation)
    lost = sum(observation.spans[1:, 0] - observation.spans[:-1, 1])
    if lost >= REMARK_LIMITS.lost_s:
        yield f"{lost:.0f} s within the footage were not observed: what happened then is counted nowhere"
    if any(np.isnan(one.delay_s) for one in report.delays):
        yield "delays: too few vehicles tell the speed of free flow (traffic.free_flow_kmh of the site says it)"
    yield from _of_conflicts(report)
    yield from remarks_on_counts(report)
    for gate in report.gates:
        yield from _of_gate(gate, report)
        yield from _of_turned_cameras(gate, observation)


def remarks_on_counts(report: "TrafficReport") -> Iterator[str]:
    """The gates whose counts are not known, what is not counted, and what was counted by hand."""
    missed = report.unseen
    counted = {gate.name for gate in report.gates}
    for gate in report.site.gates:
        if gate.name not in counted:
            why = (
                "its pixels do not lie on the road: on or above the camera's horizon, or in an image of another shape"
                if report.metres and gate.pixels
                else f"it has no {'line on the road' if report.metres else 'pixels'}"
            )
            yield f"gate {gate.name!r}: not counted: {why}"
    for name in sorted(missed.gates):
        yield f"gate {name!r}: nobody was ever seen near it: nobody crossed it, or nobody can be seen there"
    for one in report.counts_total:
        if one.expected is not None or not one.observed_s or one.gate in missed.gates:
            continue
        kinds = missed.kinds.get(one.gate, ())
        if one.class_name == VEHICLE_CATEGORY and kinds and kinds[0].too_small:
            yield (
                f"gate {one.gate!r} ({one.direction}): vehicles are so small in the image there that few are "
                "detected: how many crossed it is not known; draw it nearer to the camera"
            )
        elif one.class_name == VEHICLE_CATEGORY:
            yield (
                f"gate {one.gate!r} ({one.direction}): more vehicles are lost before it, or found behind it, than "
                "cross it: how many did is not known; move it to where they are seen on both sides"
            )
        elif any(kind.too_small for kind in kinds) and not kinds[0].too_small:
            yield (
                f"gate {one.gate!r} ({one.direction}): people and two-wheelers are so small in the image there that "
                "few are seen: how many crossed it is known of vehicles alone"
            )
    if missed.doubtful:
        yield f"{len(missed.doubtful)} crossings are more probably none than one: they are in the intervals alone"
    between = any(NO_GATE not in (one.origin, one.destination) for one in report.turning_total)
    if between and any(on_foot(one) for one in report.movements):
        yield (
            "movements: tracks of people go over to others who walk beside: how many of all went from gate to gate is "
            "known of vehicles alone where people walk"
        )
    yield from hand_lines(report.manual_count_checks)
    yield from sight_lines(report.observation)


def _of_conflicts(report: "TrafficReport") -> Iterator[str]:
    search = report.conflicts
    if search.overlapping:
        yield (
            f"conflicts: {search.overlapping} pairs whose footprints overlap are left out: two tracks of one vehicle, "
            "or places that are wrong"
        )
    if search.poorly_tracked_pairs:
        yield (
            f"conflicts: {search.poorly_tracked_pairs} pairs are excluded because one track is poor where they meet "
            "(gap of 0.6 s or more, or positions not known to 0.5 m): most are no conflicts, but some may be"
        )


def _of_turned_cameras(gate: Gate, observation: Observation) -> Iterator[str]:
    """Warnings where a camera was turned so that it shows less of a gate than before."""
    for part in observation.parts or (observation,):
        height = part.ground.height if part.ground else 0.0
        line = np.linspace(gate.line[0], gate.line[1], REMARK_LIMITS.gate_points)
        places = np.column_stack([line, np.full(REMARK_LIMITS.gate_points, height)])
        before = None if part.camera is None else _shows(part.camera, places)
        for from_s, camera in part.turned:
            if before is not None and before.any():
                share = float(_shows(camera, places)[before].mean())
                if share < REMARK_LIMITS.least_visible:
                    yield (
                        f"gate {gate.name!r}: the camera was turned, and from {from_s:.1f} s on it shows {share:.0%} "
                        "of what it showed of the gate: counts from then on are too low"
                    )


def _shows(camera: Camera, places: Array) -> Mask:
    """(N,) whether a camera shows places (N, 3)."""
    pixels, _, valid = camera.project(places)
    return np.asarray(valid & camera.inside(pixels), dtype=bool)


def _of_gate(gate: Gate, report: "TrafficReport") -> Iterator[str]:
    """Warnings where many tracks begin or end at a gate, as at the image's edge, or pass its ends."""
    number = 0
    for one in filter(is_in_traffic, report.trajectories):
        for row in (0, -1):
            signed, along = signed_distances(gate, one.xy[[row]])
            length = math.dist(*gate.line)
            cut = report.observation.is_cut(one.times_s[row])
            number += bool(abs(signed[0]) < REMARK_LIMITS.beside_m and 0 <= along[0] <= length and not cut)
    total = sum(one.gate == gate.name for one in report.crossings)
    if number >= max(REMARK_LIMITS.few_tracks, REMARK_LIMITS.many_share * total):
        yield (
            f"gate {gate.name!r}: {number} tracks begin or end within {REMARK_LIMITS.beside_m:g} m of it "
            f"({total} crossings): many may be missed; move it to where vehicles are seen on both sides"
        )
    perhaps = (*report.crossings, *report.unseen.doubtful)
    beside = sum("beside" in one.doubt and one.gate == gate.name for one in perhaps)
    if beside >= max(REMARK_LIMITS.few_tracks, REMARK_LIMITS.many_share * total):
        yield (
            f"gate {gate.name!r}: {beside} road users pass so near to its ends that they go through it or past it: "
            "let it end where nobody walks, as before a pavement or behind it"
        )
