"""The station file: the cameras of a station, its database, and where it publishes."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, TypeVar

from skope.detector import weights
from skope.errors import UserError, one_of
from skope.files import safe_names
from skope.files.atomic import sha256_of
from skope.records import TomlTable, dataclass_of
from skope.site.site_file import SiteFile, read_site

T = TypeVar("T")

AUTO: Final = "auto"
"""Detector of a camera: the first of those that come with skope that runs in real time."""
PICTURES: Final = ("none", "blurred", "plain")
"""Kinds of the latest picture of a camera. Blurred: without glass, plates and heads."""
LOCAL_HOSTS: Final = ("127.0.0.1", "localhost", "::1")
"""Addresses of this machine only."""


@dataclass(frozen=True, kw_only=True)
class _CameraEntry:
    """A camera as the file gives it."""

    name: str
    site: str
    stream: str = ""
    tracks: str = ""
    videos: str = ""
    detector: str = AUTO
    picture: str = PICTURES[0]


@dataclass(frozen=True, kw_only=True)
class HttpAddress:
    """Address of the read-only HTTP API and of the page."""

    host: str = "127.0.0.1"
    port: int = 8500
    token: str = ""
    """Token that requests must carry; empty: none is needed, which is allowed on this machine only."""

    def __post_init__(self) -> None:
        _check_port(self.port)
        if self.host not in LOCAL_HOSTS and not self.token:
            raise UserError(f"token: missing; it is required because {self.host} is not only this machine")


@dataclass(frozen=True, kw_only=True)
class MqttBroker:
    """MQTT broker to which a station publishes."""

    host: str
    port: int = 1883
    topic: str = "skope"
    """First part of all topics."""
    username: str = ""
    password: str = ""

    def __post_init__(self) -> None:
        _check_port(self.port)
        if not self.topic or set(self.topic) & set("#+\0") or self.topic.startswith("$"):
            raise UserError(f"topic: expected an MQTT topic without # and +, got {self.topic!r}")


def _check_port(port: int) -> None:
    if not 1 <= port <= 65535:
        raise UserError(f"port: expected a number from 1 to 65535, got {port}")


@dataclass(frozen=True, kw_only=True, eq=False)
class StationCamera:
    """A camera of a station."""

    name: str
    site: SiteFile
    """Gates, zones, lanes and settings."""
    site_sha256: str
    """Checksum of the site file as it was read. The file may change later."""
    stream: str | None
    """Address of the live stream; None: recordings come from elsewhere."""
    videos: Path | None
    """Folder of an archive of video files; None: there is none."""
    detector: str | None
    """Detector; None: the first of those that come with skope that runs in real time."""
    picture: str
    """One of `PICTURES`."""
    folder: Path
    """Folder of the station's files on this camera."""
    tracks: Path
    """Folder of its recordings: each subfolder is an output folder of `skope eval track`. It may be missing still."""

    @property
    def seen(self) -> Path:
        """Folder of the detections of windows that are not tracked yet."""
        return self.folder / "seen"

    @property
    def tracking(self) -> Path:
        """Folder of the window that is being tracked."""
        return self.folder / "tracking"

    @property
    def latest_picture(self) -> Path:
        """The latest picture, unless `picture` is "none"."""
        return self.folder / "latest.jpg"

    @property
    def view(self) -> Path:
        """File with a small image of the view for which the site file is valid."""
        return self.folder / "view.json"

    @property
    def state(self) -> Path:
        """File with the state of the process that reads the stream."""
        return self.folder / "state.json"


@dataclass(frozen=True, kw_only=True, eq=False)
class Station:
    """The cameras of a station, its database, and where it publishes."""

    path: Path
    """The station file."""
    folder: Path
    """Folder of the station's files."""
    database: str
    """Address of the database, as SQLAlchemy takes it."""
    cameras: tuple[StationCamera, ...]
    window_s: float
    """Length of the windows in which streams are recorded, seconds."""
    keep_days: int | None
    """Number of days for which tracks, events and speeds are kept; None: for ever. Counts are always kept."""
    http: HttpAddress | None
    """None: no HTTP API and no page."""
    mqtt: MqttBroker | None

    def camera(self, name: str) -> StationCamera:
        """Return the camera of a name that the station has."""
        return next(camera for camera in self.cameras if camera.name == name)


def read_station(path: Path) -> Station:
    """Read a station file. Paths in it are relative to its folder.

    Raises:
        UserError: A file is missing, a key is missing, unknown or invalid, or two cameras have the same name.
    """
    table = TomlTable.read(path)
    entries: Any = table.value("cameras")
    if not isinstance(entries, list) or not entries:
        raise table.wrong("cameras", "expected at least one [[cameras]] table")
    folder = path.parent / table.text("folder", "station")
    cameras = tuple(_camera(path, entry, folder, f"{path}: cameras[{i}]") for i, entry in enumerate(entries))
    for i, camera in enumerate(cameras):
        if camera.name in {other.name for other in cameras[:i]}:
            raise table.wrong(f"cameras[{i}].name", f"{camera.name!r} is the name of another camera")
    keep_days = table.number("keep_days", low=2, high=36500) if "keep_days" in table else None
    station = Station(
        path=path,
        folder=folder,
        database=_in_folder(table.text("database", "sqlite:///traffic.db"), path.parent),
        cameras=cameras,
        window_s=60 * table.number("window_minutes", 5.0, low=0.1, high=60),
        keep_days=None if keep_days is None else round(keep_days),
        http=_part(HttpAddress, table, "http"),
        mqtt=_part(MqttBroker, table, "mqtt"),
    )
    table.done()
    return station


def _camera(path: Path, entry: Any, folder: Path, where: str) -> StationCamera:
    read = dataclass_of(_CameraEntry, entry, where, _defaults(_CameraEntry))
    name = safe_names.name(f"{where}.name", read.name)
    if sum(map(bool, (read.stream, read.tracks, read.videos))) != 1:
        raise UserError(f"{where}: expected one of stream, videos and tracks")
    try:
        site = read_site(path.parent / read.site)
    except UserError as error:
        raise UserError(f"{where}.site: {error}") from None
    if not (site.gates or site.zones or site.lanes):
        raise UserError(f"{where}.site: {site.path} has no gates, zones or lanes: nothing can be counted")
    if read.stream and "://" not in read.stream:
        raise UserError(f"{where}.stream: expected an address like rtsp://camera/stream, got {read.stream!r}")
    if site.camera is None and not read.tracks:
        raise UserError(f"{where}.site: {site.path} has no camera; a station needs a calibrated camera")
    return StationCamera(
        name=name,
        site=site,
        site_sha256=sha256_of(site.path),
        stream=read.stream or None,
        videos=path.parent / read.videos if read.videos else None,
        detector=_detector(read.detector, path, where),
        picture=one_of(f"{where}.picture", read.picture, PICTURES),
        folder=folder / name,
        tracks=path.parent / read.tracks if read.tracks else folder / name / "tracks",
    )


def _detector(given: str, path: Path, where: str) -> str | None:
    """Return the name or the file of a detector; None for `auto`."""
    if given == AUTO:
        return None
    if given in weights.BY_ACCURACY:
        return given
    file = path.parent / given
    if not file.exists():
        names = ", ".join((AUTO, *weights.BY_ACCURACY))
        raise UserError(f"{where}.detector: expected {names} or a file, got {given!r}")
    return str(file)


def _part(cls: type[T], table: TomlTable, key: str) -> T | None:
    """Return a table of the file as a dataclass; None if it is missing."""
    return dataclass_of(cls, table.value(key), f"{table.path}: {key}", _defaults(cls)) if key in table else None


def _defaults(cls: Any) -> dict[str, Any]:
    return {field.name: getattr(cls, field.name) for field in fields(cls) if hasattr(cls, field.name)}


def _in_folder(address: str, folder: Path) -> str:
    """Return the address of a database; a relative path to an SQLite file becomes relative to `folder`."""
    start = "sqlite:///"
    if not address.startswith(start) or address == start:
        return address
    return start + str(folder.resolve() / address.removeprefix(start))
