"""The database of a station: SQLite in a file, or PostgreSQL.

The tables `counts`, `events`, `speeds` and `visibility` have the columns of the CSV files of a traffic report
(docs/traffic-files.md), after `camera`, `day` and `row`. A day is a date in the time zone of the camera's site. All
rows of a camera's day are replaced in one transaction, so none is lost or doubled if a station is killed. Times are in
UTC.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from datetime import UTC, date, datetime
from typing import Any, Final, Self

import sqlalchemy as sql
from sqlalchemy.exc import ArgumentError, NoSuchModuleError, SQLAlchemyError

from skope.errors import UserError
from skope.traffic.report_tables import report_tables
from skope.traffic.traffic_report import TrafficReport

SCHEMA_VERSION: Final = 2
_TIMES: Final = frozenset({"begin", "end", "time"})
_WHOLE: Final = frozenset({"count", "count_high_90", "count_low_90", "includes_camera_error", "recording", "track"})
_TEXTS: Final = frozenset(
    {"class", "direction", "event", "gate", "kind", "lane", "length_bin", "observed", "otc_class", "place", "remark"}
    | {"unavailable_reason", "where"}
)
_COLUMNS: Final = {
    "counts": "begin end begin_s end_s observed observed_s low_visibility_s gate direction lane class count "
    "count_low_90 count_high_90 otc_class pce",
    "events": "event time_s time sigma_s track class class_confidence place direction lane x y speed_kmh "
    "speed_sigma_kmh front_s rear_s dwell_s probability remark deceleration_ms2 deceleration_sigma_ms2 otc_class "
    "length_m length_sigma_m length_bin length_bin_probability recording",
    "speeds": "begin end begin_s end_s kind where class vehicles v15_kmh v15_low_kmh v15_high_kmh v50_kmh v50_low_kmh "
    "v50_high_kmh v85_kmh v85_low_kmh v85_high_kmh includes_camera_error unavailable_reason",
    "visibility": "begin end begin_s end_s observed observed_s low_brightness_s low_contrast_s moved_s brightness "
    "contrast",
}
"""Columns of the measured tables, by table."""


def _type_of(column: str) -> Any:
    if column in _TIMES:
        return sql.DateTime(timezone=True)
    return sql.Integer if column in _WHOLE else sql.Text if column in _TEXTS else sql.Double


def _day_key() -> tuple[Any, Any]:
    """Return the columns that name a day of a camera."""
    return sql.Column("camera", sql.Text, primary_key=True), sql.Column("day", sql.Date, primary_key=True)


_METADATA: Final = sql.MetaData()
_SCHEMA: Final = sql.Table("skope_schema", _METADATA, sql.Column("version", sql.Integer, primary_key=True))
_DAYS: Final = sql.Table(
    "days",
    _METADATA,
    *_day_key(),
    sql.Column("recordings", sql.Integer, nullable=False),
    sql.Column("digest", sql.Text, nullable=False),
    sql.Column("measured", sql.DateTime(timezone=True), nullable=False),
    sql.Column("took_s", sql.Double),
)
_RECORDINGS: Final = sql.Table(
    "recordings",
    _METADATA,
    *_day_key(),
    sql.Column("folder", sql.Text, primary_key=True),
    sql.Column("begin", sql.DateTime(timezone=True), nullable=False),
    sql.Column("end", sql.DateTime(timezone=True), nullable=False),
    sql.Column("frames", sql.Integer, nullable=False),
    sql.Column("observed_s", sql.Double, nullable=False),
    sql.Column("moved", sql.Boolean, nullable=False),
)
_MEASURED: Final = {
    name: sql.Table(
        name,
        _METADATA,
        *_day_key(),
        sql.Column("row", sql.Integer, primary_key=True),
        *(sql.Column(column, _type_of(column)) for column in columns.split()),
    )
    for name, columns in _COLUMNS.items()
}


_DAY_TABLES: Final = {**_MEASURED, "recordings": _RECORDINGS}
TABLES: Final = tuple(_DAY_TABLES)
"""Names of the tables whose rows belong to a day of a camera."""


@dataclass(frozen=True)
class MeasuredDay:
    """Measurement of a camera's day: digest of the recordings, duration and time."""

    digest: str
    """Digest of the recordings, the site and the version of skope."""
    took_s: float
    """Duration of the measurement, seconds."""
    measured: datetime | None = None
    """Time of the measurement; None: not stored yet."""


@dataclass(frozen=True, kw_only=True)
class RecordingRow:
    """A recording of a day."""

    begin: datetime
    """Time of its first frame, UTC."""
    end: datetime
    """Time of its end, UTC."""
    folder: str
    """Name of its folder."""
    frames: int
    """Number of analysed frames."""
    observed_s: float
    """Observed time without gaps, seconds."""
    moved: bool
    """True if the camera was moved in the recording."""


class Database:
    """An open database of a station."""

    def __init__(self, engine: sql.Engine) -> None:
        self._engine = engine

    @classmethod
    def open(cls, address: str) -> Self:
        """Open a database, and create the tables that are missing.

        Args:
            address: Address as SQLAlchemy takes it, for example sqlite:///traffic.db or postgresql+psycopg://host/name.

        Raises:
            UserError: The address is invalid, its driver is missing, the database cannot be reached, or its tables are
                of another version of skope.
        """
        with _named_errors("database"):
            engine = sql.create_engine(address, pool_pre_ping=True)
        if engine.dialect.name == "sqlite":
            sql.event.listen(engine, "connect", _use_wal)
        database = cls(engine)
        with database._errors(), engine.begin() as connection:
            _METADATA.create_all(connection)
            version = connection.execute(sql.select(_SCHEMA.c.version)).scalar()
            if version is None:
                connection.execute(sql.insert(_SCHEMA).values(version=SCHEMA_VERSION))
            elif version == 1:
                connection.execute(sql.text("ALTER TABLE days ADD COLUMN took_s DOUBLE PRECISION"))
                connection.execute(sql.update(_SCHEMA).values(version=SCHEMA_VERSION))
            elif version != SCHEMA_VERSION:
                raise UserError(f"{database.name}: its tables have version {version}, expected {SCHEMA_VERSION}")
        return database

    @property
    def name(self) -> str:
        """The address without its password."""
        return f"database {self._engine.url.render_as_string(hide_password=True)}"

    def measured_days(self, camera: str) -> dict[date, MeasuredDay]:
        """Return the measured days of a camera. Raises UserError."""
        query = sql.select(_DAYS).where(_DAYS.c.camera == camera)
        with self._errors(), self._engine.connect() as connection:
            return {
                row.day: MeasuredDay(row.digest, row.took_s or 0.0, _in_utc(row.measured))
                for row in connection.execute(query)
            }

    def replace_day(
        self,
        camera: str,
        day: date,
        measured: MeasuredDay,
        recordings: Sequence[RecordingRow],
        report: TrafficReport,
    ) -> int:
        """Replace all rows of a camera's day in one transaction.

        Args:
            camera: Name of the camera.
            day: The day.
            measured: Digest of the recordings, and duration of the measurement.
            recordings: The recordings.
            report: The traffic of the day.

        Returns:
            Number of events.

        Raises:
            UserError: The database cannot be written.
        """
        found = report_tables(report)
        rows = {
            name: [
                {
                    "camera": camera,
                    "day": day,
                    "row": i,
                    **dict(zip(found[name].columns, map(_cell, cells), strict=True)),
                }
                for i, cells in enumerate(found[name].rows)
            ]
            for name in _MEASURED
        }
        day_row = {
            "recordings": len(recordings),
            "digest": measured.digest,
            "measured": datetime.now(UTC),
            "took_s": measured.took_s,
        }
        listed = [{"camera": camera, "day": day, **asdict(recording)} for recording in recordings]
        with self._errors(), self._engine.begin() as connection:
            for table in (_DAYS, _RECORDINGS, *_MEASURED.values()):
                connection.execute(sql.delete(table).where(table.c.camera == camera, table.c.day == day))
            for name, table in _MEASURED.items():
                if rows[name]:
                    connection.execute(sql.insert(table), rows[name])
            if listed:
                connection.execute(sql.insert(_RECORDINGS), listed)
            connection.execute(sql.insert(_DAYS).values(camera=camera, day=day, **day_row))
        return len(rows["events"])

    def days(self, camera: str, limit: int | None = None) -> list[dict[str, Any]]:
        """Return rows of the table `days` of a camera, the newest first: `limit` of them, or all.

        Raises:
            UserError: The database cannot be read.
        """
        return self._rows(sql.select(_DAYS).where(_DAYS.c.camera == camera).order_by(_DAYS.c.day.desc()).limit(limit))

    def rows(
        self, table: str, camera: str, day: date, first: int = 0, limit: int | None = None
    ) -> list[dict[str, Any]]:
        """Return rows of a camera's day from one of `TABLES`, in order: `limit` of them from number `first` on, or all.

        Raises:
            UserError: The database cannot be read.
        """
        found = _DAY_TABLES[table]
        order = found.c.begin if table == "recordings" else found.c.row
        query = sql.select(found).where(found.c.camera == camera, found.c.day == day).order_by(order)
        return self._rows(query.limit(limit).offset(first))

    def forget(self, camera: str, before: date) -> int:
        """Delete the events, speeds and recordings of the days before a day; counts are kept.

        Returns:
            Number of deleted events.

        Raises:
            UserError: The database cannot be written.
        """
        with self._errors(), self._engine.begin() as connection:
            deleted = 0
            for name in ("events", "speeds", "recordings"):
                table = _DAY_TABLES[name]
                found = connection.execute(sql.delete(table).where(table.c.camera == camera, table.c.day < before))
                deleted += found.rowcount if name == "events" else 0
            return deleted

    def _rows(self, query: Any) -> list[dict[str, Any]]:
        with self._errors(), self._engine.connect() as connection:
            return [
                {name: _in_utc(value) if isinstance(value, datetime) else value for name, value in row.items()}
                for row in connection.execute(query).mappings()
            ]

    @contextmanager
    def _errors(self) -> Iterator[None]:
        with _named_errors(self.name):
            yield


def _use_wal(connection: Any, _record: object) -> None:
    """Let others read an SQLite file while it is written."""
    connection.execute("PRAGMA journal_mode=WAL")


@contextmanager
def _named_errors(name: str) -> Iterator[None]:
    """Turn errors of SQLAlchemy and of drivers into UserErrors of one line."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise UserError(f"{name}: its driver {error.name!r} is not installed: pip install 'skope[station]'") from None
    except (ArgumentError, NoSuchModuleError) as error:
        raise UserError(f"{name}: not an address of a database: {str(error).splitlines()[0]}") from None
    except SQLAlchemyError as error:
        reason = str(getattr(error, "orig", None) or error).strip().splitlines()
        raise UserError(f"{name}: {reason[0] if reason else type(error).__name__}") from None


def _in_utc(value: datetime | None) -> datetime | None:
    """Return a time of the database with its zone: SQLite stores times in UTC without it."""
    return value if value is None or value.tzinfo is not None else value.replace(tzinfo=UTC)


def _cell(value: Any) -> Any:
    """Return a cell as the database takes it: missing values are None, times are in UTC, numbers are Python's."""
    if isinstance(value, datetime):
        return value.astimezone(UTC)
    if hasattr(value, "item"):
        value = value.item()
    return None if isinstance(value, float) and math.isnan(value) else value
