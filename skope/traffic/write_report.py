"""The files of a traffic report: events and trajectories apart, a table for each measure, and a summary.

Cells are empty where there is nothing to say: a count of nothing observed, a time that was not seen. Speeds are km/h,
lengths metres, times seconds of the footage; columns with times of the day have the site's time with its offset.
"""

import csv
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.files.atomic import replacing
from skope.files.json_files import write_json
from skope.traffic.clock import ClockInterval
from skope.traffic.count_interval import CountInterval, count_interval
from skope.traffic.counts import observed_word
from skope.traffic.gates import GateCrossing
from skope.traffic.measure import TrafficReport
from skope.traffic.speed_percentiles import PERCENTILES
from skope.traffic.trajectories import Trajectory
from skope.version import __version__

Row = Sequence[Any]
_KMH: Final = 3.6
_DIGITS: Final = 3
SUMMARY: Final = "summary.json"
"""Written last: where it is, the report is whole."""


@dataclass(frozen=True)
class _Table:
    columns: str
    rows: Iterable[Row]


def write_report(out: Path, report: TrafficReport, *, tracks: str, revision: str | None) -> list[Path]:
    """Write the files of a report.

    Args:
        out: The folder.
        report: What was measured.
        tracks: What the tracks were read from, for the summary.
        revision: Digest of the site file; None: there is none.

    Returns:
        The files, the summary last.
    """
    tables = {
        "events.csv": _events(report),
        "trajectories.csv": _trajectories(report),
        "counts.csv": _counts(report),
        "turning.csv": _turning(report),
        "speeds.csv": _speeds(report),
        "headways.csv": _headways(report),
        "occupancy.csv": _occupancy(report),
        "queues.csv": _queues(report),
        "delays.csv": _delays(report),
        "conflicts.csv": _conflicts(report),
    }
    for name, table in tables.items():
        _write(out / name, table)
    write_json(out / SUMMARY, summary(report, tracks=tracks, revision=revision))
    return [out / name for name in (*tables, SUMMARY)]


def _write(path: Path, table: _Table) -> None:
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.columns.split())
        for row in table.rows:
            writer.writerow([_cell(value) for value in row])


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    if isinstance(value, float):
        return f"{value:.{_DIGITS}f}"
    return value.isoformat() if isinstance(value, datetime) else str(value)


def clock(report: TrafficReport, time_s: float) -> datetime | None:
    """The time of the day of a second of the footage, to the millisecond; None where it is not known."""
    if report.start is None or math.isnan(time_s):
        return None
    # Through UTC: on the day of a change the clock does not go on by itself.
    zone = report.start.tzinfo
    moment = report.start.astimezone(UTC) + timedelta(seconds=time_s)
    return moment.replace(microsecond=moment.microsecond // 1000 * 1000).astimezone(zone)


def _of_interval(interval: ClockInterval | None) -> Row:
    if interval is None:
        return (None,) * 4
    return interval.begin, interval.end, interval.begin_s, interval.end_s


def _between(expected: CountInterval | None) -> Row:
    return (None, None) if expected is None else (expected.low, expected.high)


def _who(one: Trajectory) -> Row:
    return one.number, one.class_name, one.class_confidence


def _events(report: TrafficReport) -> _Table:
    def rows() -> Iterator[tuple[float, Row]]:
        for one in report.crossings:
            speed = one.speed * _KMH, one.speed_sigma * _KMH
            times = one.front_s, one.rear_s, None
            tail = (*one.place.tolist(), *speed, *times, one.probability, one.doubt)
            where = one.gate, one.direction_name, one.lane
            yield one.time_s, ("gate", one.sigma_s, *_who(one.trajectory), *where, *tail)
        for visit in report.visits:
            borders = ("enter", visit.enter_s, None), ("leave", visit.leave_s, visit.dwell_s)
            for (event, time_s, dwell), sigma in zip(borders, visit.sigmas_s, strict=True):
                if not math.isnan(time_s):
                    place = visit.trajectory.at(visit.trajectory.place, time_s).tolist()
                    where = (visit.zone, None, None, *place, None, None, None, None, dwell, None, None)
                    yield time_s, (event, sigma, *_who(visit.trajectory), *where)
        for change in report.lane_changes:
            place = change.place.tolist()
            where = (change.from_lane, change.to_lane, change.to_lane, *place, *(None,) * 5, change.probability, None)
            yield change.time_s, ("lane change", None, *_who(change.trajectory), *where)
        for brake in report.brakings:
            told = f"{brake.deceleration:.1f} m/s2 (sigma {brake.sigma:.1f})"
            where = (None, None, None, *brake.place.tolist(), *(None,) * 5, brake.probability, told)
            yield brake.time_s, ("hard braking", None, *_who(brake.trajectory), *where)

    ordered = sorted(rows(), key=lambda pair: pair[0])
    return _Table(
        "event time_s time sigma_s track class class_confidence place direction lane x y speed_kmh speed_sigma_kmh "
        "front_s rear_s dwell_s probability remark",
        ((row[0], time_s, clock(report, time_s), *row[1:]) for time_s, row in ordered),
    )


def _trajectories(report: TrafficReport) -> _Table:
    step = report.site.traffic.trajectory_interval_s

    def rows() -> Iterator[Row]:
        for one in report.trajectories:
            for i in thinned(one, step):
                heading = math.degrees(one.heading[i])
                yield (
                    *(one.number, one.class_name, float(one.times_s[i]), clock(report, float(one.times_s[i]))),
                    *(*one.place[i].tolist(), heading, float(one.speed[i]) * _KMH),
                    *(math.sqrt(float(np.linalg.eigvalsh(one.covariance[i])[-1])), float(one.speed_sigma[i]) * _KMH),
                    *(one.length, one.width, int(one.measured[i])),
                    *(" ".join(map(str, one.joined)), one.joined_probability, " ".join(one.flags)),
                )

    return _Table(
        "track class time_s time x y heading_deg speed_kmh sigma_position sigma_speed_kmh length width measured "
        "joined joined_probability flags",
        rows(),
    )


def thinned(one: Trajectory, step_s: float) -> list[int]:
    """Rows of a trajectory that are `step_s` apart at least, with its first and its last one."""
    rows, at = [0], float(one.times_s[0])
    for i, time_s in enumerate(one.times_s[1:-1].tolist(), start=1):
        if time_s - at >= step_s - 1e-6:
            rows.append(i)
            at = time_s
    return [*rows, len(one.times_s) - 1] if len(one.times_s) > 1 else rows


def _counts(report: TrafficReport) -> _Table:
    return _Table(
        "begin end begin_s end_s observed observed_s gate direction lane class count low high",
        (
            (
                *_of_interval(one.interval),
                *(one.observed, one.observed_s, one.gate, one.direction, one.lane, one.class_name, one.count),
                *_between(one.expected),
            )
            for one in report.counts
        ),
    )


def _turning(report: TrafficReport) -> _Table:
    return _Table(
        "begin end begin_s end_s observed from_gate from_direction to_gate to_direction count low high",
        (
            (
                *_of_interval(one.interval),
                observed_word(one.interval, report.observation.seconds_in(one.interval.begin_s, one.interval.end_s)),
                *(*one.origin, *one.destination, one.count, *_between(one.expected)),
            )
            for one in report.turning
        ),
    )


def _speeds(report: TrafficReport) -> _Table:
    names = " ".join(f"{name}_kmh {name}_low_kmh {name}_high_kmh" for name in PERCENTILES)

    def rows() -> Iterator[Row]:
        for group in report.speeds:
            cells: list[Any] = []
            for name in PERCENTILES:
                one = group.percentiles[name]
                cells += [None if v is None else v * _KMH for v in (one.value, one.low, one.high)]
            why = "; ".join(f"{name}: {one.refused}" for name, one in group.percentiles.items() if one.refused)
            yield (
                *_of_interval(group.interval),
                *(group.kind, group.where, group.class_name, group.number, *cells),
                *(int(group.common_known), why),
            )

    return _Table(f"begin end begin_s end_s kind where class vehicles {names} camera_error_counts refused", rows())


def _headways(report: TrafficReport) -> _Table:
    def pair(one: GateCrossing) -> Row:
        return one.trajectory.number, one.trajectory.class_name

    return _Table(
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


def _occupancy(report: TrafficReport) -> _Table:
    return _Table(
        "begin end begin_s end_s gate direction lane observed_s occupied_s sigma_s occupancy left_out",
        (
            (
                *_of_interval(one.interval),
                *(one.gate, one.direction, one.lane, one.observed_s, one.occupied_s, one.sigma_s),
                *(one.occupied_s / one.observed_s, one.left_out),
            )
            for one in report.occupancies
        ),
    )


def _queues(report: TrafficReport) -> _Table:
    return _Table(
        "begin end begin_s end_s lane longest_m sigma_m at_s vehicles mean_vehicles",
        (
            (
                *_of_interval(one.interval),
                *(one.lane, one.longest_m, one.sigma_m, one.at_s, one.vehicles, one.mean_vehicles),
            )
            for one in report.queues
        ),
    )


def _delays(report: TrafficReport) -> _Table:
    def rows() -> Iterator[Row]:
        for one in report.delays:
            section = one.section
            first = section.movement.origin
            assert first is not None
            yield (
                *(first.time_s, clock(report, first.time_s), first.trajectory.number, first.trajectory.class_name),
                *(section.name, section.length_m, section.seconds, section.seconds_sigma),
                *(section.speed * _KMH, section.speed_sigma * _KMH),
                *(one.stops, one.stopped_s, one.delay_s, one.sigma_s),
            )

    return _Table(
        "time_s time track class section length_m travel_s travel_sigma_s speed_kmh speed_sigma_kmh stops stopped_s "
        "delay_s delay_sigma_s",
        rows(),
    )


def _conflicts(report: TrafficReport) -> _Table:
    return _Table(
        "time_s time x y kind angle_deg first first_class second second_class ttc_s ttc_low_s ttc_high_s "
        "ttc_probability drac_ms2 pet_ssam_s pet_area_s pet_sigma_s",
        (
            (
                *(one.time_s, clock(report, one.time_s), *one.place.tolist(), one.kind, one.angle_deg),
                *(one.first.number, one.first.class_name, one.second.number, one.second.class_name),
                *(one.ttc_s, one.ttc_low_s, one.ttc_high_s, one.probability, one.drac_ms2),
                *(one.pet_places_s, one.pet_area_s, one.pet_sigma_s),
            )
            for one in report.conflicts.conflicts
        ),
    )


def summary(report: TrafficReport, *, tracks: str, revision: str | None) -> dict[str, Any]:
    """What a result was made of and by, so that it can be made again, and its totals."""
    observation = report.observation
    spans = observation.spans
    sides = dict.fromkeys((one.gate, one.direction) for one in report.counts)
    totals = []
    for gate, direction in sides:
        own = [one for one in report.crossings if (one.gate, one.direction_name) == (gate, direction)]
        told = count_interval([one.probability for one in own])
        totals.append({"gate": gate, "direction": direction, "count": len(own), "low": told.low, "high": told.high})
    likely = [one.probability for one in report.conflicts.conflicts if not math.isnan(one.probability)]
    sure = count_interval(likely, (0.0, 1.0))
    return {
        "skope": __version__,
        "tracks": tracks,
        "footage": observation.source,
        "site_revision": revision,
        "settings": report.site.traffic.to_dict(),
        "start": None if report.start is None else report.start.isoformat(),
        "time_zone": report.site.time_zone,
        "observed_s": round(float((spans[:, 1] - spans[:, 0]).sum()), 3),
        "observed_spans_s": np.round(spans, 3).tolist(),
        "camera_common_sigma": observation.common_sigma,
        "interval_level": 0.9,
        "trajectories": len(report.trajectories),
        "joined": [[one.number, *one.joined] for one in report.trajectories if one.joined],
        "counts": totals,
        "turning": [
            {
                "from": list(one.origin),
                "to": list(one.destination),
                "count": one.count,
                **({} if one.expected is None else {"low": one.expected.low, "high": one.expected.high}),
            }
            for one in report.turning_total
        ],
        "conflicts_by_ttc": {"count": len(likely), "low": sure.low, "high": sure.high},
        "hard_brakings": len(report.brakings),
        "refused": list(report.refused),
    }
