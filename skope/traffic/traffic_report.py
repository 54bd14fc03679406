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
    """All that was measured of the traffic in a footage."""

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
    """Sentences on figures that are not available or doubtful, with reasons."""
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
    likely = [one for one in report.conflicts.conflicts if one.ttc_s <= report.site.traffic.ttc_s]
    others = len(report.conflicts.conflicts) - len(likely)
    told = count_interval([one.probability for one in likely], (0.0, 1.0))
    sure = f" ({told.low} to {told.high} of them real)" if likely else ""
    yield (
        f"{len(report.headways)} headways; {len(likely)} conflicts by time to collision{sure}, {others} more by "
        f"encroachment; {len(report.brakings)} vehicles with hard braking"
    )


def _gates(report: TrafficReport) -> Iterator[list[str]]:
    speeds = {
        one.where: one.percentiles
        for one in report.speeds
        if one.kind == "spot" and one.interval is None and one.class_name == MOTOR_TRAFFIC
    }
    for one in report.counts_total:
        told = in_words(one.confidence_interval)
        found = speeds.get(f"{one.gate} ({one.direction})", {}) if one.class_name == ALL_CLASSES else {}
        yield [
            *(one.gate, one.direction, one.class_name, str(one.count or 0), told),
            *(_speed(found.get(name)) for name in ("v50", "v85")),
        ]


def _by_hand(report: TrafficReport) -> Iterator[list[str]]:
    for one in report.manual_count_checks:
        told = in_words(one.confidence_interval)
        hand = one.hand
        counted = (str(hand.number), str(one.count), told, f"{one.geh:.1f}")
        yield [hand.gate, hand.direction_name, hand.class_name, *counted]


def _speed(one: Percentile | None) -> str:
    if one is None or one.value is None or one.low is None or one.high is None:
        return "-"
    return f"{one.value * KMH_PER_MPS:.1f} ({one.low * KMH_PER_MPS:.1f} to {one.high * KMH_PER_MPS:.1f})"


def _movements(report: TrafficReport) -> Iterator[list[str]]:
    """Yield the pairs of gates with movements between them, over the whole footage."""
    for one in report.turning_total:
        if NO_GATE not in (one.origin, one.destination):
            sides = [f"{gate} ({direction})" for gate, direction in (one.origin, one.destination)]
            told = in_words(one.confidence_interval)
            yield [*sides, one.class_name, str(one.count or 0), told]
