"""Measure the traffic in a footage: all stages from tracks to the report, in order."""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.conflicts import conflicts
from skope.traffic.counting_intervals import ClockInterval, clock_intervals, local_start
from skope.traffic.event_probability import usual_step
from skope.traffic.gate_counts import Count, interval_counts
from skope.traffic.gates import GateCrossing, gate_crossings, gates_of_drawn_cameras, gates_on_road
from skope.traffic.headways import headways, occupancies
from skope.traffic.lanes import LaneMap, lane_changes
from skope.traffic.length_bins import length_counts
from skope.traffic.manual_count_checks import counts_adjusted_by_manual_counts, manual_count_checks
from skope.traffic.manual_count_file import ManualCount
from skope.traffic.missed_crossings import MissedCrossings, unseen
from skope.traffic.observation import Observation
from skope.traffic.queues import delays, queues
from skope.traffic.recordings import SiteRecording
from skope.traffic.report_remarks import remarks
from skope.traffic.speeds import section_passes, speed_groups
from skope.traffic.stitch_broken_tracks import stitch_tracks
from skope.traffic.time_to_collision import hard_brakings
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import movements, turning_counts
from skope.traffic.zones import visits

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts

DRAW_SEED: Final = 0
"""Seed of the random samples for the uncertainty of conflicts; fixed, so that a report is reproducible."""


def measure(
    tracks: Sequence[Track],
    observation: Observation,
    site: "SiteParts",
    start: datetime | None = None,
    manual_counts: Sequence[ManualCount] = (),
    *,
    broken: bool = True,
    search_conflicts: bool = True,
    recordings: Sequence[SiteRecording] = (),
) -> TrafficReport:
    """Count and measure the traffic of a footage.

    Args:
        tracks: The tracks of one camera's footage.
        observation: The observed times and the camera.
        site: Gates, zones, lanes and settings.
        start: Start time of the footage; None: that of the site.
        manual_counts: Manual counts of the same footage.
        broken: Whether the track of a road user may be broken into several, which are then joined. False for simulated
            tracks.
        search_conflicts: Whether to search for conflicts, which takes most of the time. If not, the report has none.
        recordings: The recordings, if tracks and observation are of several.
    """
    settings = site.traffic
    begin = local_start(site) if start is None else start
    confirmed = [track for track in tracks if track.confirmed]
    trajectories = stitch_tracks(confirmed) if broken else confirmed
    lanes, gates = LaneMap(site.lanes), gates_on_road(site.gates, (*observation.parts, observation)[0])
    whole = whole_footage(observation)
    intervals = clock_intervals(begin, max(0.0, whole.begin_s), whole.end_s, settings.interval_minutes)
    step_s = usual_step(trajectories)
    every, drawn_crossings = _crossings(trajectories, site, observation, lanes, step_s)
    missed = unseen(trajectories, gates, every, observation, settings, other_cameras=drawn_crossings)
    crossed = [crossing for crossing in every if crossing.is_counted]
    checks = manual_count_checks(manual_counts, crossed, missed, settings)
    missed = counts_adjusted_by_manual_counts(checks, crossed, missed, gates, settings)
    moved = movements(crossed, settings, step_s if broken else None)
    sections = section_passes(moved)
    speeds = speed_groups(crossed, sections, intervals, observation)
    search = conflicts(
        trajectories if search_conflicts else (),
        settings,
        np.random.default_rng(DRAW_SEED),
        site.zones,
        observation.common_scale_sigma or 0.0,
    )
    late = delays(sections, speeds, settings)
    names = [lane.name for lane in site.lanes]
    report = TrafficReport(
        site=site,
        gates=gates,
        start=begin,
        observation=observation,
        intervals=tuple(intervals),
        trajectories=tuple(trajectories),
        crossings=tuple(crossed),
        visits=tuple(visits(trajectories, site.zones, settings)),
        lane_changes=tuple(lane_changes(trajectories, lanes, settings.hysteresis_m)),
        counts=tuple(interval_counts(crossed, gates, names, intervals, observation, settings, missed)),
        counts_total=total_counts(crossed, gates, observation, settings, missed),
        lengths=tuple(length_counts(crossed, gates, intervals, observation, settings, missed)),
        lengths_total=tuple(length_counts(crossed, gates, [whole], observation, settings, missed)),
        unseen=missed,
        manual_count_checks=tuple(checks),
        movements=tuple(moved),
        turning=tuple(turning_counts(moved, gates, intervals, observation, settings, missed)),
        turning_total=tuple(turning_counts(moved, gates, [whole], observation, settings, missed)),
        sections=tuple(sections),
        speeds=tuple(speeds),
        headways=tuple(headways(crossed, observation)),
        occupancies=tuple(occupancies(crossed, intervals, observation)),
        queues=tuple(queues(trajectories, lanes, intervals, observation, settings)),
        delays=tuple(late),
        conflicts=search,
        brakings=tuple(hard_brakings(trajectories, settings)),
        recordings=tuple(recordings),
    )
    return replace(report, notes=tuple(remarks(report)))


def _crossings(
    tracks: Sequence[Track], site: "SiteParts", observation: Observation, lanes: LaneMap, step_s: float
) -> tuple[list[GateCrossing], dict[str, list[list[GateCrossing]]]]:
    """Return all crossings, and by surveyed gate the crossings under each sampled set of camera parameters."""
    every: list[GateCrossing] = []
    drawn_crossings: dict[str, list[list[GateCrossing]]] = {}
    by_recording = defaultdict[int, list[Track]](list)
    for track in tracks:
        by_recording[observation.recording_at(float(track.times_s[0]))].append(track)
    for number, recording in enumerate(observation.parts or (observation,), start=1):
        recording_tracks = by_recording[number]
        gates = gates_on_road(site.gates, recording)
        every += gate_crossings(recording_tracks, gates, lanes, site.traffic, step_s=step_s)
        for k, moved in enumerate(gates_of_drawn_cameras(gates, recording)):
            found = gate_crossings(recording_tracks, moved, lanes, site.traffic, step_s=step_s)
            for gate in moved:
                draws = drawn_crossings.setdefault(gate.name, [])
                if len(draws) <= k:
                    draws.append([])
                draws[k] += [crossing for crossing in found if crossing.gate == gate.name]
    return sorted(
        every, key=lambda crossing: (crossing.time_s, crossing.trajectory.number, crossing.gate)
    ), drawn_crossings


def total_counts(
    crossed: Sequence[GateCrossing],
    gates: Sequence[Gate],
    observation: Observation,
    settings: TrafficSettings,
    missed: MissedCrossings,
) -> tuple[Count, ...]:
    """Return counts of the whole footage for each gate and direction, of all road users and of vehicles.

    Args:
        crossed: The crossings that are counted.
        gates: All gates.
        observation: The observed times.
        settings: The classes that are counted.
        missed: Road users that may have crossed and are not counted.
    """
    whole = [whole_footage(observation)]
    return tuple(interval_counts(crossed, gates, (), whole, observation, settings, missed, by_class=False))


def whole_footage(observation: Observation) -> ClockInterval:
    """Return the interval from the first to the last frame."""
    spans = observation.spans
    begin_s, end_s = (float(spans[0, 0]), float(spans[-1, 1])) if len(spans) else (0.0, 0.0)
    return ClockInterval(begin_s=begin_s, end_s=end_s, begin=None, end=None)
