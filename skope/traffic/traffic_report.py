"""Report of the traffic in a footage."""

from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

from skope.site.gates_zones_lanes import Gate
from skope.tracks.track import Track
from skope.traffic.braking import HardBraking
from skope.traffic.conflicts import ConflictSearch
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import Count
from skope.traffic.gates import GateCrossing
from skope.traffic.hand_checks import HandCheck
from skope.traffic.headways import Headway, Occupancy
from skope.traffic.lanes import LaneChange
from skope.traffic.length_bins import LengthCount
from skope.traffic.missed_crossings import Unseen
from skope.traffic.observation import Observation
from skope.traffic.queues import Delay, QueueRecord
from skope.traffic.recordings import SiteRecording
from skope.traffic.speeds import SectionPass, SpeedGroup
from skope.traffic.turning_movements import Movement, TurningCount
from skope.traffic.zones import ZoneVisit

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts


@dataclass(frozen=True, kw_only=True, eq=False)
class TrafficReport:
    """All that was measured of the traffic in a footage."""

    site: "SiteParts"
    gates: tuple[Gate, ...]
    """The gates that were counted at; their lines are among positions as the trajectories have them."""
    start: datetime | None
    """Time at which the footage begins, in the site's zone; None: not known."""
    observation: Observation
    intervals: tuple[ClockInterval, ...]
    trajectories: tuple[Track, ...]
    """Those of confirmed tracks, broken ones joined."""
    crossings: tuple[GateCrossing, ...]
    visits: tuple[ZoneVisit, ...]
    lane_changes: tuple[LaneChange, ...]
    counts: tuple[Count, ...]
    counts_total: tuple[Count, ...]
    """Those of the whole footage, whole gates: of all, and of vehicles."""
    lengths: tuple[LengthCount, ...]
    """Counts of vehicles by length; empty without metres."""
    lengths_total: tuple[LengthCount, ...]
    """Those of the whole footage."""
    unseen: Unseen
    """Road users that may have crossed gates and are not counted."""
    hand_checks: tuple[HandCheck, ...]
    """Hand counts, beside what was counted here."""
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
    recordings: tuple[SiteRecording, ...] = ()
    """The recordings, where it is of several, in the order of time."""
    refused: tuple[str, ...] = ()
    """Sentences on what could not be measured, or should be distrusted, and why."""
    metres: bool = True
    """Whether places are metres on the road; else pixels, and nothing is measured but counts and movements."""
