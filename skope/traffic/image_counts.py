"""Count crossings and movements at gates in the image, for cameras without calibration."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.schema import VEHICLE_CATEGORY
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import VEHICLE_CLASSES, TrafficSettings
from skope.tracks.track import Track
from skope.traffic.conflicts import ConflictSearch
from skope.traffic.counting_intervals import clock_intervals, local_start
from skope.traffic.event_probability import image_miss_rate_groups, usual_step
from skope.traffic.gate_counts import interval_counts
from skope.traffic.gates import gate_crossings, gates_in_image
from skope.traffic.lanes import LaneMap
from skope.traffic.manual_count_checks import counts_adjusted_by_manual_counts, manual_count_checks
from skope.traffic.manual_count_file import ManualCount
from skope.traffic.measure import total_counts, whole_footage
from skope.traffic.missed_crossings import unseen
from skope.traffic.observation import Observation
from skope.traffic.report_remarks import remarks_on_counts
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import movements, turning_counts

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts


@dataclass(frozen=True)
class ImageGateLimits:
    """Limits of crossings in the image."""

    hysteresis_sigmas: float = 3.0
    """Hysteresis, in standard deviations of a box's foot."""
    row_groups: int = 12
    """Number of groups of boxes, by image row of their foot. Their median heights give the size of vehicles by row."""
    fewest_boxes: int = 5 * row_groups
    """Minimum number of boxes for estimating the size of vehicles."""
    near_px: float = 50.0
    """Distance from a gate within which a road user shows that the gate is in view, pixels."""


IMAGE_GATES: Final = ImageGateLimits()

NO_METRES: Final = (
    "no metres: positions are in pixels. Counts are of the feet of boxes at gates in the image; speeds, headways, "
    "queues, delays and conflicts are not available (`skope eval site` calibrates a camera)"
)


_NO_CLASSES: Final = (
    "classes of vehicles: not available at gates in the image; `counts.csv` has vehicles together, and no rows of car, "
    "van, lorry and bus (with a camera each vehicle has a class)"
)


def count_in_image(
    tracks: Sequence[Track],
    observation: Observation,
    site: "SiteParts",
    start: datetime | None = None,
    manual_counts: Sequence[ManualCount] = (),
) -> TrafficReport:
    """Return counts and movements of tracks with positions in pixels (columns and negative rows of the image).

    Args:
        tracks: The tracks.
        observation: The times at which the camera had the view in which the gates are drawn.
        site: The site; its gates with `pixels` and its settings are used.
        start: Start time of the footage; None: that of the site.
        manual_counts: Manual counts of the same footage.
    """
    settings = site.traffic
    gates = gates_in_image(site.gates)
    begin = local_start(site) if start is None else start
    whole = whole_footage(observation)
    intervals = clock_intervals(begin, max(0.0, whole.begin_s), whole.end_s, settings.interval_minutes)
    step_s = usual_step(tracks)
    every = sorted(
        (
            crossing
            for track in tracks
            for crossing in gate_crossings(
                [track], gates, LaneMap(()), _in_pixels(track, settings), metres=False, step_s=step_s
            )
        ),
        key=lambda crossing: crossing.time_s,
    )
    kinds = {gate.name: image_miss_rate_groups(_vehicle_px(tracks, gate)) for gate in gates}
    missed = unseen(tracks, gates, every, observation, settings, IMAGE_GATES.near_px, kinds)
    crossed = [crossing for crossing in every if crossing.is_counted]
    checks = manual_count_checks(manual_counts, crossed, missed, settings)
    missed = counts_adjusted_by_manual_counts(checks, crossed, missed, gates, settings)
    moved = movements(crossed, settings)
    counts = interval_counts(crossed, gates, [], intervals, observation, settings, missed)
    # Vehicles of unknown class, shared evenly among the classes, would give intervals such as 3 to 14 lorries.
    has_classes = any(track.class_name in VEHICLE_CLASSES for track in tracks)
    known = [row for row in counts if has_classes or row.class_name not in VEHICLE_CLASSES]
    report = TrafficReport(
        site=site,
        gates=gates,
        start=begin,
        observation=observation,
        intervals=tuple(intervals),
        trajectories=tuple(tracks),
        crossings=tuple(crossed),
        visits=(),
        lane_changes=(),
        counts=tuple(known),
        counts_total=total_counts(crossed, gates, observation, settings, missed),
        lengths=(),
        lengths_total=(),
        unseen=missed,
        manual_count_checks=tuple(checks),
        movements=tuple(moved),
        turning=tuple(turning_counts(moved, gates, intervals, observation, settings, missed)),
        turning_total=tuple(turning_counts(moved, gates, [whole], observation, settings, missed)),
        sections=(),
        speeds=(),
        headways=(),
        occupancies=(),
        queues=(),
        delays=(),
        conflicts=ConflictSearch(conflicts=(), overlapping=0, poorly_tracked_pairs=0),
        brakings=(),
        metres=False,
    )
    why = (NO_METRES,) if len(known) == len(counts) else (NO_METRES, _NO_CLASSES)
    return replace(report, notes=(*why, *remarks_on_counts(report)))


def _vehicle_px(tracks: Sequence[Track], gate: Gate) -> float | None:
    """Return the usual height of vehicle boxes at a gate, pixels; None for too few boxes.

    On a road the height of boxes is a linear function of the row of their foot. The fitted line also gives the height
    in rows where vehicles are too small to be detected.
    """
    vehicles = [track for track in tracks if track.category == VEHICLE_CATEGORY]
    rows = np.concatenate([np.zeros(0), *(-vehicle.xy[:, 1] for vehicle in vehicles)])
    heights = np.concatenate([np.zeros(0), *(vehicle.boxes[:, 3] for vehicle in vehicles)])
    rows, heights = rows[np.isfinite(heights)], heights[np.isfinite(heights)]
    if len(rows) < IMAGE_GATES.fewest_boxes or np.ptp(rows) == 0:
        return None
    groups = np.array_split(np.argsort(rows, kind="stable"), IMAGE_GATES.row_groups)
    medians = np.array([(np.median(rows[group]), np.median(heights[group])) for group in groups])
    slope, constant = np.polyfit(medians[:, 0], medians[:, 1], 1)
    return float(constant + slope * -np.mean(gate.line, axis=0)[1])


def _in_pixels(track: Track, settings: TrafficSettings) -> TrafficSettings:
    """Return settings for crossings in pixels, with a hysteresis from the position error of the track's boxes."""
    sigma = float(np.median(np.sqrt(track.covariance[:, 0, 0])))
    return replace(
        settings,
        hysteresis_m=IMAGE_GATES.hysteresis_sigmas * sigma,
        least_travel_m=2 * IMAGE_GATES.hysteresis_sigmas * sigma,
    )
