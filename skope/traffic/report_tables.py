"""Tables of a traffic report, column by column. docs/traffic-files.md describes the columns.

Cells without a value are None or NaN, for example a count without observation or a time that was not seen. Speeds are
in km/h, lengths in metres, times in seconds of the footage. Columns with times of day have the site's time with its UTC
offset.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final

import numpy as np

from skope.tracks.track import KMH_PER_MPS, Track
from skope.traffic.count_uncertainty import in_cells
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import observed_word
from skope.traffic.gates import GateCrossing
from skope.traffic.length_bins import LENGTH_MODEL, WHY_NOT, LengthCount, has_length, length_bin, length_sigma_m
from skope.traffic.otc_classes import OTC_CLASSES
from skope.traffic.report_remarks import interval_visibility
from skope.traffic.speeds import SPEED_PERCENTILES
from skope.traffic.traffic_report import TrafficReport
from skope.types import Array

TableRow = Sequence[Any]
RECORDING_COLUMN: Final = " recording"
"""An additional column if there are several recordings."""


@dataclass(frozen=True)
class ReportTable:
    """Rows of cells under the names of their columns."""

    columns: tuple[str, ...]
    rows: Iterable[TableRow]


def report_tables(report: TrafficReport) -> dict[str, ReportTable]:
    """Return the tables by name.

    Without metres there are only those of counts, manual counts, movements, events and visibility.
    """
    manual_count = {"manual_count": _manual_count(report)} if report.manual_count_checks else {}
    always = {**manual_count, "visibility": _visibility(report), "events": _events(report)}
    if not report.metres:
        return {**always, "counts": _counts(report), "turning_movements": _turning(report)}
    return {
        **always,
        "trajectories": _trajectories(report),
        "counts": _counts(report),
        "lengths": _lengths(report),
        "turning_movements": _turning(report),
        "speeds": _speeds(report),
        "headways": _headways(report),
        "occupancy": _occupancy(report),
        "queues": _queues(report),
        "delays": _delays(report),
        "conflicts": _conflicts(report),
    }


def _table(columns: str, rows: Iterable[TableRow]) -> ReportTable:
    return ReportTable(tuple(columns.split()), rows)


def clock(report: TrafficReport, time_s: float) -> datetime | None:
    """Return the clock time at a second of the footage, to the millisecond; None if it is not known."""
    if report.start is None or math.isnan(time_s):
        return None
    # Use UTC, because local time is not continuous on the day of a clock change.
    zone = report.start.tzinfo
    moment = report.start.astimezone(UTC) + timedelta(seconds=time_s)
    return moment.replace(microsecond=moment.microsecond // 1000 * 1000).astimezone(zone)


def _of_interval(interval: ClockInterval | None) -> TableRow:
    if interval is None:
        return (None,) * 4
    return interval.begin, interval.end, interval.begin_s, interval.end_s


def _recording(report: TrafficReport, time_s: float) -> TableRow:
    """Return a cell with the number of the recording at a time; empty for a single recording."""
    return (report.observation.recording_at(time_s),) if report.recordings else ()


def _track_cells(track: Track) -> TableRow:
    return track.number, track.class_name, track.class_confidence


_EVENT_COLUMNS: Final = (
    "event time_s time sigma_s track class class_confidence place direction lane x y speed_kmh speed_sigma_kmh "
    "front_s rear_s dwell_s probability remark deceleration_ms2 deceleration_sigma_ms2 otc_class length_m "
    "length_sigma_m length_bin length_bin_probability"
)


def _events(report: TrafficReport) -> ReportTable:
    kinds = (_crossing_events, _visit_events, _lane_change_events, _braking_events)
    names = _EVENT_COLUMNS.split()

    def rows() -> Iterator[TableRow]:
        for event in sorted((event for kind in kinds for event in kind(report)), key=lambda event: event["time_s"]):
            cells = event | {"time": clock(report, event["time_s"])}
            yield *(cells.get(name) for name in names), *_recording(report, event["time_s"])

    return _table(f"{_EVENT_COLUMNS}{RECORDING_COLUMN if report.recordings else ''}", rows())


def _event(event: str, time_s: float, track: Track, position: Array) -> dict[str, Any]:
    """Return the cells that all events have: event, time, road user and position."""
    who = dict(zip(("track", "class", "class_confidence"), _track_cells(track), strict=True))
    return {"event": event, "time_s": time_s, **who, "x": float(position[0]), "y": float(position[1])}


def _crossing_events(report: TrafficReport) -> Iterator[dict[str, Any]]:
    for crossing in report.crossings:
        position = crossing.position if report.metres else crossing.position * (1, -1)
        cells = _event("gate", crossing.time_s, crossing.trajectory, position) | {
            "sigma_s": crossing.sigma_s,
            "place": crossing.gate,
            "direction": crossing.direction_name,
            "lane": crossing.lane,
            "probability": crossing.probability,
            "remark": crossing.uncertainty_flags,
            **_length(report, crossing.trajectory),
        }
        if report.metres:
            speed_sigma = report.observation.total_sigma(crossing.speed_sigma, crossing.speed)
            cells |= {
                "speed_kmh": crossing.speed * KMH_PER_MPS,
                "speed_sigma_kmh": speed_sigma * KMH_PER_MPS,
                "front_s": crossing.front_s,
                "rear_s": crossing.rear_s,
            }
        yield cells


def _visit_events(report: TrafficReport) -> Iterator[dict[str, Any]]:
    for visit in report.visits:
        borders = ("enter", visit.enter_s, None), ("leave", visit.leave_s, visit.dwell_s)
        for (event, time_s, dwell_s), sigma_s in zip(borders, visit.sigmas_s, strict=True):
            if not math.isnan(time_s):
                cells = _event(event, time_s, visit.trajectory, visit.trajectory.at(visit.trajectory.xy, time_s))
                yield cells | {"sigma_s": sigma_s, "place": visit.zone, "dwell_s": dwell_s}


def _lane_change_events(report: TrafficReport) -> Iterator[dict[str, Any]]:
    for change in report.lane_changes:
        lanes = {"place": change.from_lane, "direction": change.to_lane, "lane": change.to_lane}
        cells = _event("lane change", change.time_s, change.trajectory, change.position)
        yield cells | lanes | {"probability": change.probability}


def _braking_events(report: TrafficReport) -> Iterator[dict[str, Any]]:
    for brake in report.brakings:
        yield _event("hard braking", brake.time_s, brake.trajectory, brake.position) | {
            "probability": brake.probability,
            "deceleration_ms2": brake.deceleration,
            "deceleration_sigma_ms2": report.observation.total_sigma(brake.sigma, brake.deceleration),
        }


def _length(report: TrafficReport, track: Track) -> dict[str, Any]:
    """Return cells of a road user: OpenTrafficCam class and, if it has a length, length and bin with their errors."""
    cells: dict[str, Any] = {"otc_class": OTC_CLASSES[track.class_name]}
    if not report.metres or not has_length(track):
        return cells
    common = report.observation.common_scale_sigma
    name, probability = length_bin(track, report.site.traffic.length_bins_m, common)
    return cells | {
        "length_m": track.length,
        "length_sigma_m": length_sigma_m(track, common),
        "length_bin": name,
        "length_bin_probability": probability,
    }


def _trajectories(report: TrafficReport) -> ReportTable:
    step = report.site.traffic.trajectory_interval_s

    def rows() -> Iterator[TableRow]:
        for track in report.trajectories:
            shown = report.observation.with_camera_error(track.during(np.array(thinned(track, step))))
            for i, time_s in enumerate(shown.times_s.tolist()):
                yield (
                    *(track.number, track.class_name, time_s, clock(report, time_s)),
                    *(*shown.xy[i].tolist(), math.degrees(shown.heading[i]), float(shown.speed[i]) * KMH_PER_MPS),
                    *(float(shown.position_sigma[i]), float(shown.speed_sigma[i]) * KMH_PER_MPS),
                    *(track.length, track.width, int(shown.located[i])),
                    *(" ".join(map(str, track.joined)), track.stitch_probability, " ".join(track.flags)),
                    *_recording(report, time_s),
                )

    return _table(
        "track class time_s time x y heading_deg speed_kmh position_sigma_m speed_sigma_kmh length width located "
        f"joined stitch_probability flags{RECORDING_COLUMN if report.recordings else ''}",
        rows(),
    )


def thinned(track: Track, step_s: float) -> list[int]:
    """Return indices of rows of a track that are at least `step_s` apart, including the first and the last row."""
    rows, at = [0], float(track.times_s[0])
    for i, time_s in enumerate(track.times_s[1:-1].tolist(), start=1):
        if time_s - at >= step_s - 1e-6:
            rows.append(i)
            at = time_s
    return [*rows, len(track.times_s) - 1] if len(track.times_s) > 1 else rows


def _visibility(report: TrafficReport) -> ReportTable:
    def row(interval: ClockInterval) -> TableRow:
        found = interval_visibility(report.observation, interval.begin_s, interval.end_s)
        observed_s = report.observation.seconds_in(interval.begin_s, interval.end_s)
        seconds = (
            observed_word(interval, observed_s),
            observed_s,
            found.low_brightness_s,
            found.low_contrast_s,
            found.camera_moved_s,
        )
        return *_of_interval(interval), *seconds, found.brightness, found.contrast

    return _table(
        "begin end begin_s end_s observed observed_s low_brightness_s low_contrast_s moved_s brightness contrast",
        map(row, report.intervals),
    )


def _counts(report: TrafficReport) -> ReportTable:
    seen = report.observation
    poor_s = {
        interval: interval_visibility(seen, interval.begin_s, interval.end_s).poor_s for interval in report.intervals
    }
    return _table(
        "begin end begin_s end_s observed observed_s low_visibility_s gate direction lane class count "
        "count_low_90 count_high_90 otc_class pce",
        (
            (
                *_of_interval(row.interval),
                *(
                    row.observed,
                    row.observed_s,
                    poor_s[row.interval],
                    row.gate,
                    row.direction,
                    row.lane,
                    row.class_name,
                    row.count,
                ),
                *in_cells(row.confidence_interval),
                OTC_CLASSES.get(row.class_name),
                row.pce,
            )
            for row in report.counts
        ),
    )


def _lengths(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s observed gate direction length_bin from_m to_m "
        "count count_low_90 count_high_90 remark",
        (
            (
                *_of_interval(row.interval),
                *(row.observed, row.gate, row.direction, row.bin_name, *_bounds(row), row.count),
                *in_cells(row.confidence_interval),
                WHY_NOT if row.between_m and row.between_m[0] >= LENGTH_MODEL.longest_measured_m else None,
            )
            for row in report.lengths
        ),
    )


def _bounds(row: LengthCount) -> TableRow:
    """Return shortest and longest length of a bin, metres; the last bin has no upper limit."""
    if row.between_m is None:
        return None, None
    return tuple(end if math.isfinite(end) else None for end in row.between_m)


def _manual_count(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s gate direction class manual_count "
        "count count_low_90 count_high_90 difference geh contradicts",
        (
            (
                *_of_interval(check.hand.interval),
                *(check.hand.gate, check.hand.direction_name, check.hand.class_name, check.hand.number, check.count),
                *(
                    *in_cells(check.confidence_interval),
                    check.count - check.hand.number,
                    check.geh,
                    int(check.contradicts),
                ),
            )
            for check in report.manual_count_checks
        ),
    )


def _turning(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s observed from_gate from_direction to_gate to_direction class "
        "count count_low_90 count_high_90",
        (
            (
                *_of_interval(row.interval),
                observed_word(row.interval, report.observation.seconds_in(row.interval.begin_s, row.interval.end_s)),
                *(*row.origin, *row.destination, row.class_name, row.count, *in_cells(row.confidence_interval)),
            )
            for row in report.turning
        ),
    )


def _speeds(report: TrafficReport) -> ReportTable:
    names = " ".join(f"{name}_kmh {name}_low_kmh {name}_high_kmh" for name in SPEED_PERCENTILES)

    def rows() -> Iterator[TableRow]:
        for group in report.speeds:
            cells: list[Any] = []
            for name in SPEED_PERCENTILES:
                percentile = group.percentiles[name]
                cells += [
                    None if v is None else v * KMH_PER_MPS for v in (percentile.value, percentile.low, percentile.high)
                ]
            why = "; ".join(
                f"{name}: {percentile.unavailable_reason}"
                for name, percentile in group.percentiles.items()
                if percentile.unavailable_reason
            )
            yield (
                *_of_interval(group.interval),
                *(group.kind, group.where, group.class_name, group.number, *cells),
                *(int(group.common_known), why),
            )

    return _table(
        f"begin end begin_s end_s kind where class vehicles {names} includes_camera_error unavailable_reason", rows()
    )


def _headways(report: TrafficReport) -> ReportTable:
    def pair(crossing: GateCrossing) -> TableRow:
        return crossing.trajectory.number, crossing.trajectory.class_name

    return _table(
        "time_s time gate direction lane leader leader_class follower follower_class headway_s gap_s sigma_s",
        (
            (
                *(headway.follower.time_s, clock(report, headway.follower.time_s)),
                *(headway.follower.gate, headway.follower.direction_name, headway.follower.lane),
                *(*pair(headway.leader), *pair(headway.follower), headway.headway_s, headway.gap_s, headway.sigma_s),
            )
            for headway in report.headways
        ),
    )


def _occupancy(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s gate direction lane observed_s occupied_s sigma_s occupancy excluded_vehicles",
        (
            (
                *_of_interval(occupancy.interval),
                *(
                    occupancy.gate,
                    occupancy.direction,
                    occupancy.lane,
                    occupancy.observed_s,
                    occupancy.occupied_s,
                    occupancy.sigma_s,
                ),
                *(occupancy.occupied_s / occupancy.observed_s, occupancy.excluded_vehicles),
            )
            for occupancy in report.occupancies
        ),
    )


def _queues(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s lane longest_m sigma_m longest_at_s vehicles vehicles_low vehicles_high mean_vehicles "
        "mean_low mean_high",
        (
            (
                *_of_interval(queue.interval),
                *(
                    queue.lane,
                    queue.longest_m,
                    queue.sigma_m,
                    queue.longest_at_s,
                    queue.vehicles,
                    *in_cells(queue.vehicles_expected),
                ),
                *(queue.mean_vehicles, *queue.mean_between),
            )
            for queue in report.queues
        ),
    )


def _delays(report: TrafficReport) -> ReportTable:
    def rows() -> Iterator[TableRow]:
        for delay in report.delays:
            section = delay.section
            first = section.movement.origin
            assert first is not None
            yield (
                *(first.time_s, clock(report, first.time_s), first.trajectory.number, first.trajectory.class_name),
                *(section.name, section.length_m, section.seconds, section.seconds_sigma),
                *(
                    section.speed * KMH_PER_MPS,
                    report.observation.total_sigma(section.speed_sigma, section.speed) * KMH_PER_MPS,
                ),
                *(delay.stops, *in_cells(delay.stops_bounds), delay.stopped_s, delay.delay_s, delay.sigma_s),
            )

    return _table(
        "time_s time track class section length_m travel_s travel_sigma_s speed_kmh speed_sigma_kmh stops stops_low "
        "stops_high stopped_s delay_s delay_sigma_s",
        rows(),
    )


def _conflicts(report: TrafficReport) -> ReportTable:
    return _table(
        "time_s time x y zone conflict_type conflict_angle_deg first first_class second second_class "
        "ttc_s ttc_low_s ttc_high_s ttc_probability drac_ms2 drac_low_ms2 drac_high_ms2 "
        "pet_ssam_s pet_area_s pet_sigma_s",
        (
            (
                *(
                    conflict.time_s,
                    clock(report, conflict.time_s),
                    *conflict.position.tolist(),
                    conflict.zone,
                    conflict.kind,
                    conflict.angle_deg,
                ),
                *(conflict.first.number, conflict.first.class_name, conflict.second.number, conflict.second.class_name),
                *(conflict.ttc_s, conflict.ttc_low_s, conflict.ttc_high_s, conflict.probability),
                *(conflict.drac_ms2, conflict.drac_low_ms2, conflict.drac_high_ms2),
                *(conflict.pet_ssam_s, conflict.pet_area_s, conflict.pet_sigma_s),
            )
            for conflict in report.conflicts.conflicts
        ),
    )
