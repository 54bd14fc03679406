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


def _who(one: Track) -> TableRow:
    return one.number, one.class_name, one.class_confidence


def _events(report: TrafficReport) -> ReportTable:
    def rows() -> Iterator[tuple[float, TableRow]]:
        for one in report.crossings:
            place = one.place.tolist() if report.metres else [one.place[0], -one.place[1]]
            speed_sigma = report.observation.total_sigma(one.speed_sigma, one.speed)
            ends = (one.speed * KMH_PER_MPS, speed_sigma * KMH_PER_MPS, one.front_s, one.rear_s)
            tail = (*place, *(ends if report.metres else (None,) * 4), None, one.probability, one.uncertainty_flags)
            tail = (*tail, *_length(report, one.trajectory))
            who = ("gate", one.sigma_s, *_who(one.trajectory), one.gate, one.direction_name, one.lane)
            yield one.time_s, (*who, *tail)
        for visit in report.visits:
            borders = ("enter", visit.enter_s, None), ("leave", visit.leave_s, visit.dwell_s)
            for (event, time_s, dwell), sigma in zip(borders, visit.sigmas_s, strict=True):
                if not math.isnan(time_s):
                    place = visit.trajectory.at(visit.trajectory.xy, time_s).tolist()
                    where = (visit.zone, None, None, *place, None, None, None, None, dwell, None, None, *_NO_LENGTH)
                    yield time_s, (event, sigma, *_who(visit.trajectory), *where)
        for change in report.lane_changes:
            place = change.place.tolist()
            lanes = (change.from_lane, change.to_lane, change.to_lane)
            where = (*lanes, *place, *(None,) * 5, change.probability, None, *_NO_LENGTH)
            yield change.time_s, ("lane change", None, *_who(change.trajectory), *where)
        for brake in report.brakings:
            sigma = report.observation.total_sigma(brake.sigma, brake.deceleration)
            told = f"{brake.deceleration:.1f} m/s2 (sigma {sigma:.1f})"
            where = (None, None, None, *brake.place.tolist(), *(None,) * 5, brake.probability, told, *_NO_LENGTH)
            yield brake.time_s, ("hard braking", None, *_who(brake.trajectory), *where)

    ordered = sorted(rows(), key=lambda pair: pair[0])
    return _table(
        "event time_s time sigma_s track class class_confidence place direction lane x y speed_kmh speed_sigma_kmh "
        f"front_s rear_s dwell_s probability remark otc_class length_m length_sigma_m length_bin "
        f"length_bin_probability{RECORDING_COLUMN if report.recordings else ''}",
        ((row[0], time_s, clock(report, time_s), *row[1:], *_recording(report, time_s)) for time_s, row in ordered),
    )


_NO_LENGTH: Final = (None,) * 5


def _length(report: TrafficReport, one: Track) -> TableRow:
    """Return cells of a road user: OpenTrafficCam class, length and its standard deviation, bin and its probability."""
    otc = OTC_CLASSES[one.class_name]
    if not report.metres or not has_length(one):
        return otc, *_NO_LENGTH[1:]
    common = report.observation.common_scale_sigma
    return otc, one.length, length_sigma_m(one, common), *length_bin(one, report.site.traffic.length_bins_m, common)


def _trajectories(report: TrafficReport) -> ReportTable:
    step = report.site.traffic.trajectory_interval_s

    def rows() -> Iterator[TableRow]:
        for one in report.trajectories:
            shown = report.observation.with_camera_error(one.during(np.array(thinned(one, step))))
            for i, time_s in enumerate(shown.times_s.tolist()):
                yield (
                    *(one.number, one.class_name, time_s, clock(report, time_s)),
                    *(*shown.xy[i].tolist(), math.degrees(shown.heading[i]), float(shown.speed[i]) * KMH_PER_MPS),
                    *(float(shown.position_sigma[i]), float(shown.speed_sigma[i]) * KMH_PER_MPS),
                    *(one.length, one.width, int(shown.located[i])),
                    *(" ".join(map(str, one.joined)), one.stitch_probability, " ".join(one.flags)),
                    *_recording(report, time_s),
                )

    return _table(
        "track class time_s time x y heading_deg speed_kmh position_sigma_m speed_sigma_kmh length width located "
        f"joined stitch_probability flags{RECORDING_COLUMN if report.recordings else ''}",
        rows(),
    )


def thinned(one: Track, step_s: float) -> list[int]:
    """Return indices of rows of a track that are at least `step_s` apart, including the first and the last row."""
    rows, at = [0], float(one.times_s[0])
    for i, time_s in enumerate(one.times_s[1:-1].tolist(), start=1):
        if time_s - at >= step_s - 1e-6:
            rows.append(i)
            at = time_s
    return [*rows, len(one.times_s) - 1] if len(one.times_s) > 1 else rows


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
    poor_s = {one: interval_visibility(seen, one.begin_s, one.end_s).poor_s for one in report.intervals}
    return _table(
        "begin end begin_s end_s observed observed_s low_visibility_s gate direction lane class count "
        "count_low_90 count_high_90 otc_class pce",
        (
            (
                *_of_interval(one.interval),
                *(
                    one.observed,
                    one.observed_s,
                    poor_s[one.interval],
                    one.gate,
                    one.direction,
                    one.lane,
                    one.class_name,
                    one.count,
                ),
                *in_cells(one.confidence_interval),
                OTC_CLASSES.get(one.class_name),
                one.pce,
            )
            for one in report.counts
        ),
    )


def _lengths(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s observed gate direction length_bin from_m to_m "
        "count count_low_90 count_high_90 remark",
        (
            (
                *_of_interval(one.interval),
                *(one.observed, one.gate, one.direction, one.bin_name, *_bounds(one), one.count),
                *in_cells(one.confidence_interval),
                WHY_NOT if one.between_m and one.between_m[0] >= LENGTH_MODEL.longest_measured_m else None,
            )
            for one in report.lengths
        ),
    )


def _bounds(one: LengthCount) -> TableRow:
    """Return shortest and longest length of a bin, metres; the last bin has no upper limit."""
    if one.between_m is None:
        return None, None
    return tuple(end if math.isfinite(end) else None for end in one.between_m)


def _manual_count(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s gate direction class manual_count "
        "count count_low_90 count_high_90 difference geh contradicts",
        (
            (
                *_of_interval(one.hand.interval),
                *(one.hand.gate, one.hand.direction_name, one.hand.class_name, one.hand.number, one.count),
                *(*in_cells(one.confidence_interval), one.count - one.hand.number, one.geh, int(one.contradicts)),
            )
            for one in report.manual_count_checks
        ),
    )


def _turning(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s observed from_gate from_direction to_gate to_direction class "
        "count count_low_90 count_high_90",
        (
            (
                *_of_interval(one.interval),
                observed_word(one.interval, report.observation.seconds_in(one.interval.begin_s, one.interval.end_s)),
                *(*one.origin, *one.destination, one.class_name, one.count, *in_cells(one.confidence_interval)),
            )
            for one in report.turning
        ),
    )


def _speeds(report: TrafficReport) -> ReportTable:
    names = " ".join(f"{name}_kmh {name}_low_kmh {name}_high_kmh" for name in SPEED_PERCENTILES)

    def rows() -> Iterator[TableRow]:
        for group in report.speeds:
            cells: list[Any] = []
            for name in SPEED_PERCENTILES:
                one = group.percentiles[name]
                cells += [None if v is None else v * KMH_PER_MPS for v in (one.value, one.low, one.high)]
            why = "; ".join(
                f"{name}: {one.unavailable_reason}" for name, one in group.percentiles.items() if one.unavailable_reason
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
    def pair(one: GateCrossing) -> TableRow:
        return one.trajectory.number, one.trajectory.class_name

    return _table(
        "time_s time gate direction lane leader leader_class follower follower_class headway_s gap_s sigma_s",
        (
            (
                *(one.follower.time_s, clock(report, one.follower.time_s)),
                *(one.follower.gate, one.follower.direction_name, one.follower.lane),
                *(*pair(one.leader), *pair(one.follower), one.headway_s, one.gap_s, one.sigma_s),
            )
            for one in report.headways
        ),
    )


def _occupancy(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s gate direction lane observed_s occupied_s sigma_s occupancy excluded_vehicles",
        (
            (
                *_of_interval(one.interval),
                *(one.gate, one.direction, one.lane, one.observed_s, one.occupied_s, one.sigma_s),
                *(one.occupied_s / one.observed_s, one.excluded_vehicles),
            )
            for one in report.occupancies
        ),
    )


def _queues(report: TrafficReport) -> ReportTable:
    return _table(
        "begin end begin_s end_s lane longest_m sigma_m longest_at_s vehicles vehicles_low vehicles_high mean_vehicles "
        "mean_low mean_high",
        (
            (
                *_of_interval(one.interval),
                *(
                    one.lane,
                    one.longest_m,
                    one.sigma_m,
                    one.longest_at_s,
                    one.vehicles,
                    *in_cells(one.vehicles_expected),
                ),
                *(one.mean_vehicles, *one.mean_between),
            )
            for one in report.queues
        ),
    )


def _delays(report: TrafficReport) -> ReportTable:
    def rows() -> Iterator[TableRow]:
        for one in report.delays:
            section = one.section
            first = section.movement.origin
            assert first is not None
            yield (
                *(first.time_s, clock(report, first.time_s), first.trajectory.number, first.trajectory.class_name),
                *(section.name, section.length_m, section.seconds, section.seconds_sigma),
                *(
                    section.speed * KMH_PER_MPS,
                    report.observation.total_sigma(section.speed_sigma, section.speed) * KMH_PER_MPS,
                ),
                *(one.stops, *in_cells(one.stops_bounds), one.stopped_s, one.delay_s, one.sigma_s),
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
                *(one.time_s, clock(report, one.time_s), *one.place.tolist(), one.zone, one.kind, one.angle_deg),
                *(one.first.number, one.first.class_name, one.second.number, one.second.class_name),
                *(one.ttc_s, one.ttc_low_s, one.ttc_high_s, one.probability),
                *(one.drac_ms2, one.drac_low_ms2, one.drac_high_ms2),
                *(one.pet_ssam_s, one.pet_area_s, one.pet_sigma_s),
            )
            for one in report.conflicts.conflicts
        ),
    )
