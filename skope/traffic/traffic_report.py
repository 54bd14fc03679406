"""Traffic report of a footage, and its summary for the terminal."""

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

from skope.site.gates_zones_lanes import Gate
from skope.terminal.console import text_table
from skope.tracks.track import KMH_PER_MPS, Track
from skope.traffic.conflicts import ConflictSearch
from skope.traffic.count_uncertainty import count_interval, in_words
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import ALL_CLASSES, Count
from skope.traffic.gates import GateCrossing
from skope.traffic.headways import Headway, Occupancy
from skope.traffic.lanes import LaneChange
from skope.traffic.length_bins import LengthCount
from skope.traffic.manual_count_checks import ManualCountComparison
from skope.traffic.missed_crossings import MissedCrossings
from skope.traffic.observation import Observation
from skope.traffic.queues import Delay, QueueRecord
from skope.traffic.recordings import SiteRecording
from skope.traffic.speeds import MOTOR_TRAFFIC, Percentile, SegmentTraversal, SpeedGroup
from skope.traffic.time_to_collision import HardBraking
from skope.traffic.turning_movements import NO_GATE, Movement, TurningMovementCount
from skope.traffic.zones import ZoneVisit

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts


@dataclass(frozen=True, kw_only=True, eq=False)
class TrafficReport:
    """All measures of the traffic in a footage."""

    site: "SiteParts"
    gates: tuple[Gate, ...]
    """The counted gates, with lines in the coordinates of the trajectories."""
    start: datetime | None
    """Start time of the footage, in the site's zone; None: not known."""
    observation: Observation
    intervals: tuple[ClockInterval, ...]
    trajectories: tuple[Track, ...]
    """Confirmed tracks, with broken tracks joined."""
    crossings: tuple[GateCrossing, ...]
    visits: tuple[ZoneVisit, ...]
    lane_changes: tuple[LaneChange, ...]
    counts: tuple[Count, ...]
    counts_total: tuple[Count, ...]
    """Counts of the whole footage and whole gates: of all road users, and of vehicles."""
    lengths: tuple[LengthCount, ...]
    """Counts of vehicles by length; empty without metres."""
    lengths_total: tuple[LengthCount, ...]
    """Counts by length of the whole footage."""
    unseen: MissedCrossings
    """Road users that may have crossed gates and are not counted."""
    manual_count_checks: tuple[ManualCountComparison, ...]
    """Manual counts, compared with the automatic counts."""
    movements: tuple[Movement, ...]
    turning: tuple[TurningMovementCount, ...]
    turning_total: tuple[TurningMovementCount, ...]
    """Turning movements of the whole footage."""
    sections: tuple[SegmentTraversal, ...]
    speeds: tuple[SpeedGroup, ...]
    headways: tuple[Headway, ...]
    occupancies: tuple[Occupancy, ...]
    queues: tuple[QueueRecord, ...]
    delays: tuple[Delay, ...]
    conflicts: ConflictSearch
    brakings: tuple[HardBraking, ...]
    recordings: tuple[SiteRecording, ...] = ()
    """The recordings in order of time; empty for a single recording."""
    notes: tuple[str, ...] = ()
    """Sentences on values that are not available or doubtful, with reasons."""
    metres: bool = True
    """Whether positions are in metres on the road. Otherwise they are pixels, and the report has only counts and
    movements."""


def report_lines(report: TrafficReport) -> Iterator[str]:
    """Yield the summary: counts and speeds by gate and direction, turning movements, and numbers of other events."""
    seconds = report.observation.observed_s
    yield f"{len(report.trajectories)} road users in {seconds:.1f} s of observation; all intervals are 90% intervals"
    if report.counts:
        yield from text_table(
            ["gate", "direction", "class", "count", "90% interval", "v50 km/h", "v85 km/h"], _gates(report), "lll"
        )
    if report.manual_count_checks:
        head = ["gate", "direction", "class", "manual count", "count", "90% interval without manual count", "GEH"]
        yield from text_table(head, _by_hand(report), "lll")
    if movements := list(_movements(report)):
        yield from text_table(["from", "to", "class", "count", "90% interval"], movements, "lll")
    if not report.metres:
        return
    likely = [conflict for conflict in report.conflicts.conflicts if conflict.ttc_s <= report.site.traffic.ttc_s]
    by_encroachment = len(report.conflicts.conflicts) - len(likely)
    real = count_interval([conflict.probability for conflict in likely], (0.0, 1.0))
    sure = f" ({real.low} to {real.high} of them real)" if likely else ""
    yield (
        f"{len(report.headways)} headways; {len(likely)} conflicts by time to collision{sure}, {by_encroachment} more "
        f"by encroachment; {len(report.brakings)} vehicles with hard braking"
    )


def _gates(report: TrafficReport) -> Iterator[list[str]]:
    speeds = {
        group.where: group.percentiles
        for group in report.speeds
        if group.kind == "spot" and group.interval is None and group.class_name == MOTOR_TRAFFIC
    }
    for row in report.counts_total:
        interval = in_words(row.confidence_interval)
        found = speeds.get(f"{row.gate} ({row.direction})", {}) if row.class_name == ALL_CLASSES else {}
        yield [
            *(row.gate, row.direction, row.class_name, str(row.count or 0), interval),
            *(_speed(found.get(name)) for name in ("v50", "v85")),
        ]


def _by_hand(report: TrafficReport) -> Iterator[list[str]]:
    for check in report.manual_count_checks:
        interval = in_words(check.confidence_interval)
        hand = check.hand
        counted = (str(hand.number), str(check.count), interval, f"{check.geh:.1f}")
        yield [hand.gate, hand.direction_name, hand.class_name, *counted]


def _speed(percentile: Percentile | None) -> str:
    if percentile is None or percentile.value is None or percentile.low is None or percentile.high is None:
        return "-"
    return (
        f"{percentile.value * KMH_PER_MPS:.1f} "
        f"({percentile.low * KMH_PER_MPS:.1f} to {percentile.high * KMH_PER_MPS:.1f})"
    )


def _movements(report: TrafficReport) -> Iterator[list[str]]:
    """Yield the pairs of gates with movements between them, over the whole footage."""
    for row in report.turning_total:
        if NO_GATE not in (row.origin, row.destination):
            sides = [f"{gate} ({direction})" for gate, direction in (row.origin, row.destination)]
            interval = in_words(row.confidence_interval)
            yield [*sides, row.class_name, str(row.count or 0), interval]
