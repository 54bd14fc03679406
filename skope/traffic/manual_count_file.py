"""File of manual counts: CSV with the columns gate, direction, class, begin, end, count."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime, time, timedelta
from pathlib import Path
from typing import Final

from skope.errors import UserError
from skope.files.csv_files import read_csv
from skope.site.gates_zones_lanes import Gate
from skope.site.traffic_settings import TRAFFIC_CLASSES, UNKNOWN_CLASS, TrafficSettings
from skope.traffic.counting_intervals import ClockInterval
from skope.traffic.gate_counts import ALL_CLASSES
from skope.traffic.gates import direction_names
from skope.traffic.observation import Observation
from skope.traffic.speeds import MOTOR_CLASSES, MOTOR_TRAFFIC

COUNT_COLUMNS: Final = ("gate", "direction", "class", "begin", "end", "count")


@dataclass(frozen=True)
class ManualCountLimits:
    """Limits of a file of manual counts."""

    slack_s: float = 1.0
    """Largest time outside the footage or unobserved, seconds. People count by whole seconds or minutes."""
    most_crossings: int = 100_000
    """Maximum count in a row."""
    shown_letters: int = 40
    """Maximum number of characters of a wrong value in a message."""


MANUAL_COUNT_LIMITS: Final = ManualCountLimits()


@dataclass(frozen=True, kw_only=True)
class ManualCount:
    """Manual count of crossings at a gate."""

    gate: str
    direction: int
    """0: from the left of the gate, as it is drawn, to its right. 1: from right to left."""
    direction_name: str
    class_name: str
    """A class, `MOTOR_TRAFFIC` or `ALL_CLASSES`."""
    interval: ClockInterval
    """Period of the count."""
    number: int

    @property
    def classes(self) -> frozenset[str]:
        """Classes that the count includes."""
        return {ALL_CLASSES: frozenset(TRAFFIC_CLASSES), MOTOR_TRAFFIC: MOTOR_CLASSES}.get(
            self.class_name, frozenset({self.class_name})
        )


def read_manual_counts(
    path: Path,
    gates: Sequence[Gate],
    settings: TrafficSettings,
    start: datetime | None,
    observation: Observation,
) -> tuple[ManualCount, ...]:
    """Read a file of manual counts.

    Args:
        path: CSV file. A class is one of the report's classes, `motor`, or empty for all. Times are seconds of the
            footage, times of day, or dates with times.
        gates: The gates that are counted.
        settings: The classes that are counted.
        start: Start of the footage; None: not known, and times must be seconds.
        observation: The observed times.

    Raises:
        UserError: The file cannot be read, or a value is wrong. The message names file, line and column.
    """
    names, rows = read_csv(path)
    if missing := [name for name in COUNT_COLUMNS if name not in names]:
        raise UserError(f"{path}: column {missing[0]}: missing; expected {','.join(COUNT_COLUMNS)}")
    found: list[ManualCount] = []
    for line, row in enumerate(rows, start=2):
        count = _manual_count(_Line(path, line, row), gates, settings, start, observation)
        for before, earlier in enumerate(found, start=2):
            if _overlap(count, earlier):
                same = (
                    "repeats line" if count == earlier else "has a gate, direction, class and time in common with line"
                )
                raise UserError(f"{path}: line {line}: {same} {before}: count each crossing only once")
        found.append(count)
    if not found:
        raise UserError(f"{path}: expected at least one count, found none")
    return tuple(found)


@dataclass(frozen=True)
class _Line:
    path: Path
    number: int
    cells: Mapping[str | None, str | None]

    def text(self, column: str) -> str:
        return (self.cells[column] or "").strip()

    def wrong(self, column: str, message: str) -> UserError:
        return UserError(f"{self.path}: line {self.number}: {column}: {message}")

    def one_of(self, column: str, known: Sequence[str]) -> str:
        # A name may begin or end with a space.
        text = self.cells[column] or ""
        text = text if text in known else text.strip()
        if text not in known:
            raise self.wrong(
                column,
                f"expected one of {', '.join(known) or 'none'}, got {text!r:.{MANUAL_COUNT_LIMITS.shown_letters}}",
            )
        return text


def _manual_count(
    line: _Line, gates: Sequence[Gate], settings: TrafficSettings, start: datetime | None, observation: Observation
) -> ManualCount:
    name = line.one_of("gate", [gate.name for gate in gates])
    directions = direction_names(next(gate for gate in gates if gate.name == name))
    direction = line.one_of("direction", directions)
    counted = [option for option in settings.classes if option != UNKNOWN_CLASS]
    class_name = line.one_of("class", ["", ALL_CLASSES, MOTOR_TRAFFIC, *counted]) or ALL_CLASSES
    begin_s, end_s = (_seconds(line, column, start, observation) for column in ("begin", "end"))
    if end_s <= begin_s:
        raise line.wrong("end", f"expected a time after begin ({line.text('begin')}), got {line.text('end')}")
    if end_s - begin_s - observation.seconds_in(begin_s, end_s) > MANUAL_COUNT_LIMITS.slack_s:
        raise line.wrong("begin", "the footage has a gap from begin to end: missing frames, or a moved camera")
    text = line.text("count")
    if not (
        text.isascii()
        and text.isdecimal()
        and len(text) <= len(str(MANUAL_COUNT_LIMITS.most_crossings))
        and int(text) <= MANUAL_COUNT_LIMITS.most_crossings
    ):
        raise line.wrong(
            "count",
            f"expected a whole number from 0 to {MANUAL_COUNT_LIMITS.most_crossings}, got "
            f"{text!r:.{MANUAL_COUNT_LIMITS.shown_letters}}",
        )
    begin, end = (None if start is None else _after(start, seconds) for seconds in (begin_s, end_s))
    return ManualCount(
        gate=name,
        direction=directions.index(direction),
        direction_name=direction,
        class_name=class_name,
        interval=ClockInterval(begin_s=begin_s, end_s=end_s, begin=begin, end=end),
        number=int(text),
    )


def _overlap(first: ManualCount, second: ManualCount) -> bool:
    if (first.gate, first.direction) != (second.gate, second.direction) or not first.classes & second.classes:
        return False
    return first.interval.begin_s < second.interval.end_s and second.interval.begin_s < first.interval.end_s


def _after(start: datetime, seconds: float) -> datetime:
    """Return the time at a second of the footage."""
    return (start.astimezone(UTC) + timedelta(seconds=seconds)).astimezone(start.tzinfo)


def _seconds(line: _Line, column: str, start: datetime | None, observation: Observation) -> float:
    """Return the second of the footage in a cell, limited to the footage."""
    if not len(observation.spans):
        raise line.wrong(column, "the footage has no frames")
    first, last = float(observation.spans[0, 0]), float(observation.spans[-1, 1])
    text = line.text(column)
    candidates = _possible_seconds(line, column, start, first, last)
    within = sorted(
        {
            min(max(seconds, first), last)
            for seconds in candidates
            if first - MANUAL_COUNT_LIMITS.slack_s <= seconds <= last + MANUAL_COUNT_LIMITS.slack_s
        }
    )
    if not within:
        span = f"{first:.1f} to {last:.1f} s"
        if start is not None:
            clock = (_after(start, seconds).isoformat(timespec="seconds") for seconds in (first, last))
            span += f", {' to '.join(clock)}"
        raise line.wrong(column, f"{text!r:.{MANUAL_COUNT_LIMITS.shown_letters}} is not within the footage ({span})")
    if len(within) > 1:
        raise line.wrong(
            column,
            f"{text!r:.{MANUAL_COUNT_LIMITS.shown_letters}} occurs more than once in the footage: add the date "
            f"and the UTC offset",
        )
    return within[0]


def _possible_seconds(line: _Line, column: str, start: datetime | None, first: float, last: float) -> list[float]:
    """Return all seconds that a cell may mean.

    A time of day has one value for each day, and two if the clocks change so that it occurs twice.
    """
    text = line.text(column)
    try:
        seconds = float(text)
    except ValueError:
        pass
    else:
        if abs(seconds) < 1e9:
            return [seconds]
    moment = _moment(text)
    if moment is None:
        raise line.wrong(
            column,
            f"expected seconds, a time like 10:15:00 or 2026-11-26T10:15:00, got "
            f"{text!r:.{MANUAL_COUNT_LIMITS.shown_letters}}",
        )
    if start is None:
        raise line.wrong(
            column, "expected seconds: the start of the footage is not known (set start in the site, or --start-time)"
        )
    if isinstance(moment, datetime):
        moments = [moment]
    else:
        days = (_after(start, last).date() - _after(start, first).date()).days
        begin: date = _after(start, first).date()
        moments = [datetime.combine(begin + timedelta(days=k), moment) for k in range(-1, days + 2)]
    if moments[0].tzinfo is None:
        moments = [instant.replace(tzinfo=start.tzinfo, fold=fold) for instant in moments for fold in (0, 1)]
    return [(instant.astimezone(UTC) - start.astimezone(UTC)).total_seconds() for instant in moments]


def _moment(text: str) -> datetime | time | None:
    """Return a time of day, or a date with time; None if the text is neither."""
    for parse in (time.fromisoformat, datetime.fromisoformat):
        try:
            moment = parse(text)
        except ValueError:
            continue
        # A bare number, or a date without a time, is no time.
        return moment if ":" in text else None
    return None
