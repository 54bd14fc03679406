"""Write the remarks of a traffic report: missing or doubtful values, and times of poor visibility."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.camera.ground_plane import Ground
from skope.camera.model import Camera, same_aspect
from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate, gate_at_size
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
    """Thresholds for the warnings of a report."""

    dark: float = 0.1
    """Mean brightness (0 to 1) below which an image counts as dark. In 386 generated images of all hours and weathers
    the lowest values are 0.089 (a road without lamps) and 0.097. Nights with lamps have at least 0.105."""
    flat: float = 0.015
    """Contrast below which an image counts as without contrast. In the generated images, thick fog has 0.010 and 0.012,
    other fog at least 0.031, and photographs of a car park from above have 0.022."""
    lost_s: float = 0.5
    """Unobserved time within the footage from which the report warns, seconds."""
    beside_m: float = 2.0
    """Distance from a gate within which the start or end of a track may hide a crossing, metres."""
    many_share: float = 0.1
    """Minimum number of tracks that begin or end near a gate, as a share of its crossings, for a warning."""
    few_tracks: int = 3
    """Minimum number of tracks that begin or end near a gate for a warning."""
    least_visible: float = 0.9
    """Minimum share of the visible part of a gate that remains visible after a turn of the camera. Below it the report
    warns."""
    apart_share: float = 0.02
    """Distance in the image between `pixels` and `line` of a gate, as a share of the image width, above which the
    report warns. The site page writes both with one camera, so that they are equal."""
    gate_points: int = 100
    """Number of points on a gate that are projected."""


REMARK_LIMITS: Final = RemarkLimits()


@dataclass(frozen=True, kw_only=True)
class IntervalVisibility:
    """Visibility in the camera's images in a counting interval; None for values that were not measured."""

    low_brightness_s: float | None
    """Time with dark images, seconds."""
    low_contrast_s: float | None
    """Time with images of hardly any contrast (fog, a covered lens), seconds."""
    camera_moved_s: float
    """Time for which the camera was moved away from its calibrated view and observed nothing, seconds."""
    poor_s: float | None
    """Time with dark images, without contrast, or with a moved camera, seconds."""
    brightness: float | None
    """Mean brightness, from 0 to 1."""
    contrast: float | None
    """Mean contrast."""


def interval_visibility(observation: Observation, begin_s: float, end_s: float) -> IntervalVisibility:
    """Return the visibility in a counting interval.

    Args:
        observation: The footage with its samples of brightness and contrast.
        begin_s: Start of the interval, seconds.
        end_s: End of the interval, seconds.
    """
    every = np.union1d(observation.times_s, observation.camera_moved_s)
    camera_moved_s = float(
        frame_durations_s(every, begin_s, end_s, observation.recording_starts_s)[
            np.isin(every, observation.camera_moved_s)
        ].sum()
    )
    times, brightness, contrast = observation.visibility_samples.T
    held = frame_durations_s(times, begin_s, end_s, observation.recording_starts_s)
    if not held.sum() > 0:
        return IntervalVisibility(
            low_brightness_s=None,
            low_contrast_s=None,
            camera_moved_s=camera_moved_s,
            poor_s=camera_moved_s or None,
            brightness=None,
            contrast=None,
        )
    dark, flat = brightness < REMARK_LIMITS.dark, contrast < REMARK_LIMITS.flat
    frames = np.concatenate([[-np.inf], every])
    of_moved = np.isin(frames[np.searchsorted(every, times, side="right")], observation.camera_moved_s)
    return IntervalVisibility(
        low_brightness_s=float(held[dark].sum()),
        low_contrast_s=float(held[flat].sum()),
        camera_moved_s=camera_moved_s,
        poor_s=camera_moved_s + float(held[(dark | flat) & ~of_moved].sum()),
        brightness=float(np.average(brightness, weights=held)),
        contrast=float(np.average(contrast, weights=held)),
    )


def visibility_lines(observation: Observation) -> Iterator[str]:
    """Yield a sentence on the time with poor visibility; nothing if visibility was always good."""
    found = interval_visibility(observation, -np.inf, np.inf)
    parts = {
        "dark": found.low_brightness_s,
        "without contrast": found.low_contrast_s,
        "with the camera moved to another view": found.camera_moved_s,
    }
    periods = [
        f"{seconds:.0f} s {condition}" for condition, seconds in parts.items() if seconds is not None and seconds >= 0.5
    ]
    if periods:
        yield (
            f"poor visibility: {', '.join(periods)}; most road users are missed then, and the 90% intervals do not "
            "include them (see visibility.csv)"
        )


def remarks(report: "TrafficReport") -> Iterator[str]:
    """Yield the remarks on a report in metres."""
    if not report.gates:
        yield "no counts, speeds and headways: the site has no gates"
    if not report.site.lanes:
        yield "no queues and lane changes, and headways across the whole gate: the site has no lanes"
    if report.start is None:
        yield (
            "intervals begin at the start of the footage: its time of day is not known (set start in the site file, "
            "or --start-time)"
        )
    observation = report.observation
    if observation.common_scale_sigma is None:
        yield "speeds: the camera file has no covariance; the intervals exclude the calibration error"
    yield from recording_lines(report.recordings, observation)
    lost = sum(observation.spans[1:, 0] - observation.spans[:-1, 1])
    if lost >= REMARK_LIMITS.lost_s:
        yield f"{lost:.0f} s within the footage were not observed: no count includes them"
    if any(np.isnan(delay.delay_s) for delay in report.delays):
        yield (
            "delays: too few vehicles to estimate the free-flow speed of every section (set traffic.free_flow_kmh in "
            "the site file)"
        )
    yield from _of_conflicts(report)
    yield from remarks_on_counts(report)
    for gate in report.gates:
        yield from _of_gate(gate, report)
        yield from _of_turned_cameras(gate, observation)


def remarks_on_counts(report: "TrafficReport") -> Iterator[str]:
    """Yield remarks on gates without counts or intervals, on uncounted crossings and on manual counts."""
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
        elif report.metres:
            yield from _of_pixels_elsewhere(gate, report.observation)
    for name in sorted(missed.gates):
        yield (
            f"gate {name!r}: no road user was ever detected near it: either none crossed it, or none can be seen there"
        )
    for row in report.counts_total:
        if row.confidence_interval is not None or not row.observed_s or row.gate in missed.gates:
            continue
        kinds = missed.kinds.get(row.gate, ())
        if row.class_name == VEHICLE_CATEGORY and kinds and kinds[0].too_small:
            yield (
                f"gate {row.gate!r} ({row.direction}): no interval: vehicles are too small in the image there, and "
                "few are detected; draw the gate nearer to the camera"
            )
        elif row.class_name == VEHICLE_CATEGORY:
            yield (
                f"gate {row.gate!r} ({row.direction}): no interval: more vehicles are lost before it, or found behind "
                "it, than cross it; move the gate to where vehicles are visible on both sides"
            )
        elif any(kind.too_small for kind in kinds) and not kinds[0].too_small:
            yield (
                f"gate {row.gate!r} ({row.direction}): pedestrians and two-wheelers are too small in the image there, "
                "and few are detected: only counts of vehicles have intervals"
            )
    if missed.doubtful:
        yield (
            f"{len(missed.doubtful)} crossings are not counted (probability below 0.5, or beside the end of a gate); "
            "they only widen the intervals"
        )
    between = any(NO_GATE not in (row.origin, row.destination) for row in report.turning_total)
    if between and any(on_foot(movement) for movement in report.movements):
        yield (
            "movements: tracks of pedestrians often switch to a pedestrian beside them: movements that include "
            "pedestrians have no interval, only those of vehicles have one"
        )
    yield from hand_lines(report.manual_count_checks)
    yield from visibility_lines(report.observation)


def _of_conflicts(report: "TrafficReport") -> Iterator[str]:
    search = report.conflicts
    if search.overlapping:
        yield (
            f"conflicts: {search.overlapping} pairs with overlapping footprints are excluded: two tracks of one "
            "vehicle, or wrong positions"
        )
    if search.poorly_tracked_pairs:
        yield (
            f"conflicts: {search.poorly_tracked_pairs} pairs are excluded because one track is poor where they meet "
            "(gap of at least 0.6 s, or position error above 0.5 m): most are no conflicts, but some may be"
        )


def _of_turned_cameras(gate: Gate, observation: Observation) -> Iterator[str]:
    """Yield a warning for each camera that was turned and now shows less of a gate than before."""
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
                        f"gate {gate.name!r}: the camera was turned, and from {from_s:.1f} s on {share:.0%} of the "
                        "part of the gate that it showed before is visible: counts after that time are too low"
                    )


def _of_pixels_elsewhere(gate: Gate, observation: Observation) -> Iterator[str]:
    """Yield a warning if `pixels` and `line` of a gate are apart in a camera: one of them is outdated.

    The line was drawn on the level z = 0 by the site page, or surveyed on the road. The nearer of both counts.
    """
    if not gate.pixels or not gate.line:
        return
    for part in observation.parts or (observation,):
        camera = part.camera
        if camera is None:
            continue
        size = (camera.width, camera.height)
        if not same_aspect(gate.size or size, size):
            continue
        line, pixels = np.array(gate.line), np.array(gate_at_size(gate, size).pixels)
        heights = (np.zeros(2), (part.ground or Ground()).heights(line))
        apart_px = min(_apart_px(camera, np.column_stack([line, height]), pixels) for height in heights)
        if apart_px > REMARK_LIMITS.apart_share * camera.width:
            yield (
                f"gate {gate.name!r}: its pixels are {apart_px:.0f} px from its line: the pixels belong to another "
                "view, or the line to an earlier calibration. It is counted at its pixels; remove its pixels or its "
                "line from the site file, or draw it again"
            )
            return


def _apart_px(camera: Camera, places: Array, pixels: Array) -> float:
    """Return the largest distance between positions (2, 3) and pixels (2, 2); 0 if the camera sees no position."""
    seen, _, valid = camera.project(places)
    return float(np.linalg.norm(seen - pixels, axis=1)[valid].max(initial=0.0))


def _shows(camera: Camera, places: Array) -> Mask:
    """Return (N,) whether positions (N, 3) are inside the camera's image."""
    pixels, _, valid = camera.project(places)
    return np.asarray(valid & camera.inside(pixels), dtype=bool)


def _of_gate(gate: Gate, report: "TrafficReport") -> Iterator[str]:
    """Yield warnings if many tracks begin or end at a gate, or pass close to its ends."""
    number = 0
    for trajectory in filter(is_in_traffic, report.trajectories):
        for row in (0, -1):
            signed, along = signed_distances(gate, trajectory.xy[[row]])
            length = math.dist(*gate.line)
            near = abs(signed[0]) < REMARK_LIMITS.beside_m and 0 <= along[0] <= length
            number += bool(near and not report.observation.is_cut(trajectory.times_s[row]))
    total = sum(crossing.gate == gate.name for crossing in report.crossings)
    if number >= max(REMARK_LIMITS.few_tracks, REMARK_LIMITS.many_share * total):
        yield (
            f"gate {gate.name!r}: {number} tracks begin or end within {REMARK_LIMITS.beside_m:g} m of it "
            f"({total} crossings): many may be missed; move the gate to where vehicles are visible on both sides"
        )
    perhaps = (*report.crossings, *report.unseen.doubtful)
    beside = sum("beside" in crossing.uncertainty_flags and crossing.gate == gate.name for crossing in perhaps)
    if beside >= max(REMARK_LIMITS.few_tracks, REMARK_LIMITS.many_share * total):
        yield (
            f"gate {gate.name!r}: {beside} road users pass so close to an end of the gate that they may be inside or "
            "outside; move the ends to where no road user passes, for example to either edge of a pavement"
        )
