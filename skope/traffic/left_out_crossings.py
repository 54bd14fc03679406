"""Crossings that a gate does not count, each with the reason."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.site.gates_zones_lanes import Gate
from skope.tracks.track import Track
from skope.traffic.gate_counts import ALL_CLASSES
from skope.traffic.gates import GateCrossing, direction_names, may_count, signed_distances
from skope.traffic.traffic_report import TrafficReport


@dataclass(frozen=True)
class LeftOutLimits:
    """Limits for listing a gate and direction."""

    number: int = 3
    """Minimum number of uncounted crossings."""
    share: float = 0.1
    """Uncounted crossings as a share of the count, above which a gate and direction is listed."""


LEFT_OUT_LIMITS: Final = LeftOutLimits()

_TRACK_ENDS: Final = {"begins": "the track begins at the gate", "ends": "the track ends at the gate"}


@dataclass(frozen=True, kw_only=True)
class LeftOutCrossing:
    """Crossing that is not counted, or possible crossing of a lost track."""

    time_s: float
    """Time of the crossing, seconds of the footage. For a lost track: extrapolated at constant velocity."""
    track: int
    class_name: str
    reason: str


def left_out_crossings(report: TrafficReport) -> dict[tuple[str, str], list[LeftOutCrossing]]:
    """Return the crossings that are not counted, by gate and name of the direction, in order of time.

    Only gates and directions with many of them are included: at least three, and more than 10% of the count.
    """
    found: dict[tuple[str, str], list[LeftOutCrossing]] = {}
    begin_s, end_s = report.observation.extent
    for gate in report.gates:
        for direction, left_out in _of_gate(report, gate):
            if begin_s <= left_out.time_s < end_s:
                found.setdefault((gate.name, direction_names(gate)[direction]), []).append(left_out)
    counted = {
        (row.gate, row.direction): row.count or 0 for row in report.counts_total if row.class_name == ALL_CLASSES
    }
    return {
        side: sorted(rows, key=lambda row: row.time_s)
        for side, rows in found.items()
        if len(rows) >= LEFT_OUT_LIMITS.number and len(rows) > LEFT_OUT_LIMITS.share * counted.get(side, 0)
    }


def _of_gate(report: TrafficReport, gate: Gate) -> Iterator[tuple[int, LeftOutCrossing]]:
    """Yield the uncounted crossings of a gate with their directions."""
    explained = {crossing.trajectory.number for crossing in report.crossings if crossing.gate == gate.name}
    for crossing in report.unseen.doubtful:
        if crossing.gate == gate.name:
            explained.add(crossing.trajectory.number)
            yield crossing.direction, _row(crossing.time_s, crossing.trajectory, _why_not_counted(crossing, gate))
    for lost in report.unseen.vanished:
        if lost.gate == gate.name:
            explained.add(lost.trajectory.number)
            reason = "the track begins behind the gate" if lost.begins else "the track ends before the gate"
            yield lost.direction, _row(lost.time_s, lost.trajectory, reason)
    for track in report.trajectories:
        if track.number not in explained and may_count(track, report.site.traffic):
            through = _passes(track, gate)
            if through is not None:
                reason = "not seen far enough beyond the line on both sides (hysteresis)"
                yield through[0], _row(through[1], track, reason)


def _row(time_s: float, track: Track, reason: str) -> LeftOutCrossing:
    return LeftOutCrossing(time_s=time_s, track=track.number, class_name=track.class_name, reason=reason)


def _why_not_counted(crossing: GateCrossing, gate: Gate) -> str:
    """Return the reason why `GateCrossing.is_counted` is false."""
    _, along = signed_distances(gate, crossing.position[None])
    inside = 0 <= along[0] < math.dist(*gate.line)
    reasons = [
        f"probability {crossing.probability:.2f}, below 0.5"
        if inside
        else f"passes beside the end of the gate (probability {crossing.probability:.2f})",
        *(text for word, text in _TRACK_ENDS.items() if word in crossing.uncertainty_flags.split()),
    ]
    return "; ".join(reasons)


def _passes(track: Track, gate: Gate) -> tuple[int, float] | None:
    """Return direction and time of the last passage of a track that ends on the other side of the line; else None."""
    signed, along = signed_distances(gate, track.xy)
    changes = np.flatnonzero(np.diff(np.sign(signed)) != 0)
    if not len(changes) or signed[0] * signed[-1] >= 0:
        return None
    row = int(changes[-1])
    share = float(signed[row] / (signed[row] - signed[row + 1]))
    at = float(along[row] + share * (along[row + 1] - along[row]))
    time_s = float(track.times_s[row] + share * (track.times_s[row + 1] - track.times_s[row]))
    return (0 if signed[0] > 0 else 1, time_s) if 0 <= at < math.dist(*gate.line) else None
