"""Write and read tracks.csv. The values read equal the values written, to the last digit.

The file has one row per moment of a track; the rows of a track are adjacent. Units: metres, seconds, m/s, m/s^2, square
metres, and degrees counter-clockwise from world x. An empty cell has no value.
"""

import csv
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.schema import CATEGORY_NAMES, VEHICLE_CATEGORY
from skope.site.traffic_settings import TRAFFIC_CLASSES
from skope.tracks.track import Track
from skope.types import Array

TRACKS_CSV: Final = "tracks.csv"
TRACK_COLUMNS: Final = (
    *("track", "category", "class", "class_confidence", "body_type", "frame", "time_s", "detected", "located"),
    *("x", "y", "z", "heading_deg", "speed", "vx", "vy", "ax", "ay", "sigma_speed"),
    *("sigma_xx", "sigma_xy", "sigma_yy", "body_error_x", "body_error_y", "length", "width", "height", "flags"),
)
DERIVED_COLUMNS: Final = frozenset({"speed"})
"""Columns for readers of the file. `read_tracks` computes them from others."""


@dataclass(frozen=True)
class TrackDigits:
    """Digits after the decimal point in tracks.csv."""

    time: int = 4
    length: int = 3
    variance: int = 6
    degrees: int = 2
    size: int = 2
    share: int = 2


TRACK_DIGITS: Final = TrackDigits()

CsvRow = dict[str, str]


def as_written(track: Track) -> Track:
    """Return the track with every value rounded as in tracks.csv.

    A track in memory and the same track read from its file are then equal to the last digit.
    """
    metres = ("position", "velocity", "acceleration", "speed_sigma", "body_error")
    columns: dict[str, Any] = {name: _rounded(getattr(track, name), TRACK_DIGITS.length) for name in metres}
    sizes: dict[str, Any] = {
        name: None if value is None else round(float(value), TRACK_DIGITS.size)
        for name, value in zip(("length", "width", "height"), track.size_lwh.tolist(), strict=True)
        if math.isfinite(value)
    }
    return replace(
        track,
        class_confidence=round(float(track.class_confidence), TRACK_DIGITS.share),
        times_s=np.round(track.times_s, TRACK_DIGITS.time),
        heading=np.radians(_rounded(np.degrees(track.heading), TRACK_DIGITS.degrees)),
        covariance=_rounded(track.covariance, TRACK_DIGITS.variance),
        **columns,
        **sizes,
    )


def _rounded(values: Array, digits: int) -> Array:
    """Return rounded values, with 0.0 in place of -0.0, which would change directions."""
    return np.asarray(np.round(values, digits) + 0.0)


def write_tracks(path: Path, tracks: Sequence[Track], frame_index: Sequence[int] | None = None) -> None:
    """Write tracks in the order given.

    Args:
        path: The .csv file; it is replaced when everything is written.
        tracks: The tracks.
        frame_index: Number of each frame of the footage in the file. Default: its index.

    Raises:
        UserError: The file cannot be written.
    """
    with replacing(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(TRACK_COLUMNS)
        for track in tracks:
            writer.writerows(_rows(as_written(track), frame_index))


def _rows(track: Track, frame_index: Sequence[int] | None) -> Iterator[list[Any]]:
    head = [track.number, track.category, track.class_name, f"{track.class_confidence:.{TRACK_DIGITS.share}f}"]
    tail = [*(_cell(v, TRACK_DIGITS.size) for v in track.size_lwh.tolist()), " ".join(track.flags)]
    degrees = np.degrees(track.heading)
    motion = np.column_stack([track.speed, track.velocity, track.acceleration, track.speed_sigma]).tolist()
    spreads = track.covariance.reshape(-1, 4)[:, [0, 1, 3]].tolist()
    for i, frame in enumerate(track.frames.tolist()):
        yield [
            *head,
            track.body_type,
            frame if frame_index is None else frame_index[frame],
            f"{track.times_s[i]:.{TRACK_DIGITS.time}f}",
            int(track.detected[i]),
            int(track.located[i]),
            *(_cell(v, TRACK_DIGITS.length) for v in track.position[i]),
            _cell(degrees[i], TRACK_DIGITS.degrees),
            *(_cell(v, TRACK_DIGITS.length) for v in motion[i]),
            *(_cell(v, TRACK_DIGITS.variance) for v in spreads[i]),
            *(_cell(v, TRACK_DIGITS.length) for v in track.body_error[i]),
            *tail,
        ]


def _cell(value: float, digits: int) -> str:
    return "" if math.isnan(value) else f"{value:.{digits}f}"


def read_tracks(path: Path) -> list[Track]:
    """Read the tracks that `write_tracks` wrote, in their order; all of them are confirmed.

    Args:
        path: The file.

    Raises:
        UserError: The file is missing or invalid; the message names file, line and column.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; `skope eval track FOLDER --out {path.parent}` writes it")
    return [_track(_TrackRows(path, rows)) for rows in _groups(path)]


def _groups(path: Path) -> Iterator[list[CsvRow]]:
    """Yield the rows of each track; each row has its line number under "line"."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.DictReader(file)
            missing = [
                name for name in TRACK_COLUMNS if name not in (reader.fieldnames or ()) and name not in DERIVED_COLUMNS
            ]
            if missing:
                raise UserError(f"{path}: expected a column {missing[0]}")
            rows: list[CsvRow] = []
            seen = set[str]()
            for row in reader:
                row["line"] = str(reader.line_num)
                if rows and row["track"] != rows[0]["track"]:
                    yield rows
                    rows = []
                if not rows:
                    if row["track"] in seen:
                        raise UserError(f"{path}: line {row['line']}: track {row['track']!r:.40}: rows lie apart")
                    seen.add(row["track"])
                rows.append(row)
            if rows:
                yield rows
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise UserError(f"{path}: cannot be read: {error}") from None


class _TrackRows:
    """Rows of one track, read column by column."""

    def __init__(self, path: Path, rows: Sequence[CsvRow]) -> None:
        self.path, self.rows = path, rows

    def wrong(self, row: Mapping[str, str], name: str, expected: str) -> UserError:
        """Return an error that names file, line and column."""
        return UserError(f"{self.path}: line {row['line']}: {name}: expected {expected}, got {row[name]!r:.40}")

    def text(self, name: str, known: Sequence[str] | None = None) -> str:
        """Return the text of a column that is constant over the track."""
        value = self.rows[0][name] or ""
        if known is not None and value not in known:
            raise self.wrong(self.rows[0], name, f"one of {', '.join(known)}")
        return value

    def number(self) -> int:
        """Return the track's number."""
        if not (self.rows[0]["track"] or "").isdecimal():
            raise self.wrong(self.rows[0], "track", "a whole number")
        return int(self.rows[0]["track"])

    def constant(
        self, name: str, holds: Callable[[float], bool], expected: str, *, empty: bool = False
    ) -> float | None:
        """Return the number of a column that is constant over the track; None for an empty cell."""
        value = float(_numbers(self.path, self.rows[:1], name, empty=empty)[0])
        if math.isnan(value):
            return None
        if not holds(value):
            raise self.wrong(self.rows[0], name, expected)
        return value

    def columns(self, *names: str, empty: bool = False) -> Array:
        """Return (M,) numbers of one column, or (M, K) of several; with `empty`, an empty cell is NaN."""
        values = [_numbers(self.path, self.rows, name, empty=empty) for name in names]
        return values[0] if len(values) == 1 else np.stack(values, axis=1)


def _numbers(path: Path, rows: Sequence[CsvRow], name: str, *, empty: bool = False) -> Array:
    out = np.empty(len(rows))
    for i, row in enumerate(rows):
        text = row[name]
        try:
            out[i] = math.nan if empty and text == "" else float(text)
        except (TypeError, ValueError):
            raise UserError(f"{path}: line {row['line']}: {name}: expected a number, got {text!r:.40}") from None
        if not (math.isfinite(out[i]) or (empty and text == "")):
            raise UserError(f"{path}: line {row['line']}: {name}: expected a finite number, got {text!r:.40}")
    return out


def _track(rows: _TrackRows) -> Track:
    category = rows.text("category", CATEGORY_NAMES)
    times = rows.columns("time_s")
    if (np.diff(times) <= 0).any():
        late = rows.rows[1 + int(np.flatnonzero(np.diff(times) <= 0)[0])]
        raise rows.wrong(late, "time_s", "times that rise along the track")
    classes = (
        [name for name in TRAFFIC_CLASSES if name not in CATEGORY_NAMES] if category == VEHICLE_CATEGORY else [category]
    )
    spread = rows.columns("sigma_xx", "sigma_xy", "sigma_yy")
    speed_sigma = rows.columns("sigma_speed")
    if (spread[:, [0, 2]] < 0).any() or (speed_sigma < 0).any():
        bad = rows.rows[int(np.flatnonzero((spread[:, [0, 2]] < 0).any(axis=1) | (speed_sigma < 0))[0])]
        raise rows.wrong(bad, "sigma_xx", "variances and standard deviations that are not negative")
    confidence = rows.constant("class_confidence", lambda value: 0 <= value <= 1, "a probability from 0 to 1")
    sizes: dict[str, Any] = {
        name: rows.constant(name, lambda value: value > 0, "a length above 0", empty=True)
        for name in ("length", "width", "height")
    }
    located = rows.columns("located") > 0
    if not located.any():
        raise rows.wrong(rows.rows[0], "located", "1 in at least one row of the track")
    return Track(
        number=rows.number(),
        category=category,
        class_name=rows.text("class", classes),
        class_confidence=1.0 if confidence is None else confidence,
        times_s=times,
        position=rows.columns("x", "y", "z"),
        velocity=rows.columns("vx", "vy"),
        acceleration=rows.columns("ax", "ay", empty=True),
        heading=np.radians(rows.columns("heading_deg", empty=True)),
        covariance=spread[:, [[0, 1], [1, 2]]],
        speed_sigma=speed_sigma,
        body_error=rows.columns("body_error_x", "body_error_y"),
        located=located,
        detected=rows.columns("detected") > 0,
        frames=rows.columns("frame").astype(np.intp),
        body_type=rows.text("body_type"),
        flags=tuple(rows.text("flags").split()),
        **sizes,
    )
