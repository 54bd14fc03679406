"""Everything that is measured of the traffic in a footage, in the order in which it follows from trajectories."""

from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.tracks.track import Track
from skope.traffic.braking import hard_brakings
from skope.traffic.conflicts import conflicts
from skope.traffic.counting_intervals import ClockInterval, clock_intervals, local_start
from skope.traffic.event_probability import usual_step
from skope.traffic.gate_counts import Count, interval_counts
from skope.traffic.gates import GateCrossing, gate_crossings, gates_on_road
from skope.traffic.hand_checks import counts_adjusted_by_hand, hand_checks
from skope.traffic.hand_count_file import HandCount
from skope.traffic.headways import headways, occupancies
from skope.traffic.join_broken_tracks import join_trajectories
from skope.traffic.lanes import LaneMap, lane_changes
from skope.traffic.length_bins import length_counts
from skope.traffic.missed_crossings import Unseen, unseen
from skope.traffic.observation import Observation
from skope.traffic.queues import delays, queues
from skope.traffic.recordings import SiteRecording
from skope.traffic.report_remarks import remarks
from skope.traffic.speeds import section_passes, speed_groups
from skope.traffic.traffic_report import TrafficReport
from skope.traffic.turning_movements import movements, turning_counts
from skope.traffic.zones import visits

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts

_SEED: Final = 0
"""The draws that tell how uncertain conflicts are begin here: the same tracks give the same report."""


def measure(
    tracks: Sequence[Track],
    observation: Observation,
    site: "SiteParts",
    start: datetime | None = None,
    hand_counts: Sequence[HandCount] = (),
    *,
    broken: bool = True,
    recordings: Sequence[SiteRecording] = (),
) -> TrafficReport:
    """Count and measure the traffic of a footage.

    Args:
        tracks: The trajectories of one camera's footage.
        observation: When it observed the road.
        site: Gates, zones, lanes and settings.
        start: When the footage begins; None: as the site says.
        hand_counts: What was counted by hand meanwhile.
        broken: Whether a road user's track may have broken into several, which are joined. Those of a simulation are
            whole.
        recordings: The recordings, where tracks and observation are of several.
    """
    settings = site.traffic
    begin = local_start(site) if start is None else start
    confirmed = [one for one in tracks if one.confirmed]
    trajectories = join_trajectories(confirmed) if broken else confirmed
    lanes, gates = LaneMap(site.lanes), gates_on_road(site.gates)
    whole = whole_footage(observation)
    intervals = clock_intervals(begin, max(0.0, whole.begin_s), whole.end_s, settings.interval_minutes)
    every = gate_crossings(trajectories, gates, lanes, settings)
    missed = unseen(trajectories, gates, every, observation, settings)
    crossed = [one for one in every if one.counts]
    checks = hand_checks(hand_counts, crossed, missed, settings)
    missed = counts_adjusted_by_hand(checks, crossed, missed, gates, settings)
    moved = movements(crossed, settings, usual_step(trajectories) if broken else None)
    sections = section_passes(moved)
    speeds = speed_groups(crossed, sections, intervals, observation)
    search = conflicts(trajectories, settings, np.random.default_rng(_SEED), site.zones)
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
        hand_checks=tuple(checks),
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
    return replace(report, refused=tuple(remarks(report)))


def total_counts(
    crossed: Sequence[GateCrossing],
    gates: Sequence[Gate],
    observation: Observation,
    settings: TrafficSettings,
    missed: Unseen,
) -> tuple[Count, ...]:
    """The counts of the whole footage, of each gate and direction, of all and of vehicles.

    Args:
        crossed: The crossings that are counted.
        gates: All gates.
        observation: When was observed.
        settings: The classes that are counted.
        missed: Who may have crossed and is not counted.
    """
    whole = [whole_footage(observation)]
    return tuple(interval_counts(crossed, gates, (), whole, observation, settings, missed, by_class=False))


def whole_footage(observation: Observation) -> ClockInterval:
    """From the first to the last frame."""
    spans = observation.spans
    begin_s, end_s = (float(spans[0, 0]), float(spans[-1, 1])) if len(spans) else (0.0, 0.0)
    return ClockInterval(begin_s=begin_s, end_s=end_s, begin=None, end=None)
