"""Everything that is measured of the traffic in a footage, in the order in which it follows from trajectories."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from typing import TYPE_CHECKING, Final

import numpy as np

from skope.site.marks import Gate
from skope.site.traffic_settings import TrafficSettings
from skope.traffic.braking import HardBraking, hard_brakings
from skope.traffic.clock import ClockInterval, clock_intervals, local_start
from skope.traffic.conflicts import ConflictSearch, conflicts
from skope.traffic.counts import Count, counts
from skope.traffic.gates import GateCrossing, crossings, signed_distances
from skope.traffic.hand_checks import HandCheck, adjusted, hand_checks, hand_lines
from skope.traffic.hand_count_file import HandCount
from skope.traffic.headways import Headway, Occupancy, headways, occupancies
from skope.traffic.joining import joined
from skope.traffic.lanes import LaneChange, LaneMap, lane_changes
from skope.traffic.observation import Observation
from skope.traffic.queues import Delay, QueueRecord, delays, queues
from skope.traffic.sight import sight_lines
from skope.traffic.speeds import SectionPass, SpeedGroup, section_passes, speed_groups
from skope.traffic.trajectories import Trajectory, wandering
from skope.traffic.turning import Movement, TurningCount, movements, turning_counts
from skope.traffic.vanished import Unseen, counted, unseen
from skope.traffic.zones import ZoneVisit, visits

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts

_SEED: Final = 0
"""The draws that tell how uncertain conflicts are begin here: the same tracks give the same report."""
_BESIDE_M: Final = 2.0
"""Tracks that begin or end so near to a gate are perhaps missed by it."""
_MANY: Final = 0.1
"""So many of them, as a share of its crossings, are worth a warning; and `_FEW` at least."""
_FEW: Final = 3


@dataclass(frozen=True, kw_only=True, eq=False)
class TrafficReport:
    """What was measured."""

    site: "SiteParts"
    start: datetime | None
    """When the footage begins, in the site's time; None: not known."""
    observation: Observation
    intervals: tuple[ClockInterval, ...]
    trajectories: tuple[Trajectory, ...]
    """Those of confirmed tracks, broken ones joined."""
    crossings: tuple[GateCrossing, ...]
    visits: tuple[ZoneVisit, ...]
    lane_changes: tuple[LaneChange, ...]
    counts: tuple[Count, ...]
    counts_total: tuple[Count, ...]
    """Those of the whole footage, whole gates, all classes together."""
    unseen: Unseen
    """Who may have crossed gates and is not counted."""
    hand_checks: tuple[HandCheck, ...]
    """What was counted by hand, beside what was counted here."""
    movements: tuple[Movement, ...]
    turning: tuple[TurningCount, ...]
    turning_total: tuple[TurningCount, ...]
    """The matrix of the whole footage."""
    sections: tuple[SectionPass, ...]
    speeds: tuple[SpeedGroup, ...]
    headways: tuple[Headway, ...]
    occupancies: tuple[Occupancy, ...]
    queues: tuple[QueueRecord, ...]
    delays: tuple[Delay, ...]
    conflicts: ConflictSearch
    brakings: tuple[HardBraking, ...]
    refused: tuple[str, ...]
    """What could not be measured, or should be distrusted, and why: a sentence each."""
    metres: bool = True
    """Whether places are metres on the road; else pixels, and nothing is measured but counts and movements."""


def measure(
    tracks: Sequence[Trajectory],
    observation: Observation,
    site: "SiteParts",
    start: datetime | None = None,
    hand_counts: Sequence[HandCount] = (),
) -> TrafficReport:
    """Count and measure the traffic of a footage.

    Args:
        tracks: The trajectories of one camera's footage.
        observation: When it observed the road.
        site: Gates, zones, lanes and settings.
        start: When the footage begins; None: as the site says.
        hand_counts: What was counted by hand meanwhile.
    """
    settings = site.traffic
    begin = local_start(site) if start is None else start
    trajectories = joined([one for one in tracks if one.confirmed])
    lanes = LaneMap(site.lanes)
    whole = whole_footage(observation)
    intervals = clock_intervals(begin, max(0.0, whole.begin_s), whole.end_s, settings.interval_minutes)
    every = crossings(trajectories, site.gates, lanes, settings)
    missed = unseen(trajectories, site.gates, every, observation, settings)
    crossed = counted(every)
    checks = hand_checks(hand_counts, crossed, missed, settings)
    missed = adjusted(checks, crossed, missed, site.gates, settings)
    moved = movements(crossed, settings)
    sections = section_passes(moved)
    speeds = speed_groups(crossed, sections, intervals, observation, settings)
    search = conflicts(trajectories, settings, np.random.default_rng(_SEED), site.zones)
    late = delays(sections, speeds, settings)
    names = [lane.name for lane in site.lanes]
    return TrafficReport(
        site=site,
        start=begin,
        observation=observation,
        intervals=tuple(intervals),
        trajectories=tuple(trajectories),
        crossings=tuple(crossed),
        visits=tuple(visits(trajectories, site.zones, settings)),
        lane_changes=tuple(lane_changes(trajectories, lanes, settings.hysteresis_m)),
        counts=tuple(counts(crossed, site.gates, names, intervals, observation, settings, missed)),
        counts_total=total_counts(crossed, site.gates, observation, settings, missed),
        unseen=missed,
        hand_checks=tuple(checks),
        movements=tuple(moved),
        turning=tuple(turning_counts(moved, site.gates, intervals, observation, settings, missed.kinds)),
        turning_total=tuple(turning_counts(moved, site.gates, [whole], observation, settings, missed.kinds)),
        sections=tuple(sections),
        speeds=tuple(speeds),
        headways=tuple(headways(crossed, observation)),
        occupancies=tuple(occupancies(crossed, intervals, observation)),
        queues=tuple(queues(trajectories, lanes, intervals, observation, settings)),
        delays=tuple(late),
        conflicts=search,
        brakings=tuple(hard_brakings(trajectories, settings)),
        refused=(
            *_refused(site, begin, observation, trajectories, crossed, search, late, missed),
            *hand_lines(checks),
            *sight_lines(observation),
        ),
    )


def total_counts(
    crossed: Sequence[GateCrossing],
    gates: Sequence[Gate],
    observation: Observation,
    settings: TrafficSettings,
    missed: Unseen,
) -> tuple[Count, ...]:
    """The counts of the whole footage, of each gate and direction."""
    together = replace(settings, classes=())
    return tuple(counts(crossed, gates, (), [whole_footage(observation)], observation, together, missed))


def unseen_lines(missed: Unseen) -> Iterator[str]:
    """The gates whose counts are not known, and what is not counted, in sentences."""
    for name in sorted(missed.gates):
        yield f"gate {name!r}: nobody was ever seen near it: nobody crossed it, or nobody can be seen there"
    if missed.doubtful:
        yield f"{len(missed.doubtful)} crossings are more probably none than one: they are in the intervals alone"


def whole_footage(observation: Observation) -> ClockInterval:
    """From the first to the last frame."""
    spans = observation.spans
    begin_s, end_s = (float(spans[0, 0]), float(spans[-1, 1])) if len(spans) else (0.0, 0.0)
    return ClockInterval(begin_s=begin_s, end_s=end_s, begin=None, end=None)


def _refused(
    site: "SiteParts",
    start: datetime | None,
    observation: Observation,
    trajectories: Sequence[Trajectory],
    crossed: Sequence[GateCrossing],
    search: ConflictSearch,
    late: Sequence[Delay],
    missed: Unseen,
) -> Iterator[str]:
    """What the report lacks, in sentences."""
    if not site.gates:
        yield "no counts, speeds and headways: the site has no gates"
    if not site.lanes:
        yield "no queues and lane changes, headways over the whole width of a gate: the site has no lanes"
    if start is None:
        yield "intervals count from the footage's beginning: neither start in the site nor --begins says when that was"
    if observation.common_sigma is None:
        yield "speeds: nothing says how well the camera is known: the error that it gives all is not in their intervals"
    if len(observation.spans) > 1:
        lost = observation.spans[-1, 1] - observation.spans[0, 0] - np.diff(observation.spans).sum()
        yield f"{lost:.0f} s within the footage were not observed: what happened then is counted nowhere"
    if any(np.isnan(one.delay_s) for one in late):
        yield "delays: too few vehicles tell the speed of free flow (traffic.free_flow_kmh of the site says it)"
    if search.overlapping:
        yield (
            f"conflicts: {search.overlapping} pairs whose footprints overlap are left out: two tracks of one vehicle, "
            "or places that are wrong"
        )
    if search.unsteady:
        yield (
            f"conflicts: {search.unsteady} pairs are left out of which one is not followed well enough where they meet "
            "(without a gap of 0.6 s, known to 0.5 m): there may be conflicts among them, most are none"
        )
    yield from unseen_lines(missed)
    for gate in site.gates:
        yield from _cut_at(gate, trajectories, crossed, observation)


def _cut_at(
    gate: Gate, trajectories: Sequence[Trajectory], crossed: Sequence[GateCrossing], observation: Observation
) -> Iterator[str]:
    """A warning where many tracks begin or end at a gate, as at the edge of the image."""
    number = 0
    for one in filter(wandering, trajectories):
        for row in (0, -1):
            signed, along = signed_distances(gate, one.place[[row]])
            length = math.dist(*gate.line)
            number += bool(
                abs(signed[0]) < _BESIDE_M and 0 <= along[0] <= length and not observation.is_cut(one.times_s[row])
            )
    total = sum(one.gate == gate.name for one in crossed)
    if number >= max(_FEW, _MANY * total):
        yield (
            f"gate {gate.name!r}: {number} tracks begin or end within {_BESIDE_M:g} m of it ({total} crossings): many "
            "may be missed; move it to where vehicles are seen on both sides"
        )
