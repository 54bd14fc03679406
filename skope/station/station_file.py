"""The station file: the cameras of a station and its database."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from skope.files import safe_names
from skope.files.atomic import sha256_of
from skope.records import TomlTable, dataclass_of
from skope.site.site_file import SiteFile, read_site


@dataclass(frozen=True, kw_only=True)
class _CameraEntry:
    """A camera as the file gives it."""

    name: str
    site: str
    tracks: str


@dataclass(frozen=True, kw_only=True, eq=False)
class StationCamera:
    """A camera of a station."""

    name: str
    site: SiteFile
    """Gates, zones, lanes and settings."""
    site_sha256: str
    """Checksum of the site file as it was read. The file may change later."""
    tracks: Path
    """Folder of its recordings: each subfolder is an output folder of `skope eval track`. It may be missing still."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Station:
    """The cameras of a station and its database."""

    path: Path
    """The station file."""
    database: str
    """Address of the database, as SQLAlchemy takes it."""
    cameras: tuple[StationCamera, ...]


def read_station(path: Path) -> Station:
    """Read a station file. Paths in it are relative to its folder.

    Raises:
        UserError: A file is missing, a key is missing, unknown or invalid, or two cameras have the same name.
    """
    table = TomlTable.read(path)
    entries: Any = table.value("cameras")
    if not isinstance(entries, list) or not entries:
        raise table.wrong("cameras", "expected at least one [[cameras]] table")
    cameras = tuple(_camera(path, entry, f"{path}: cameras[{i}]") for i, entry in enumerate(entries))
    for i, camera in enumerate(cameras):
        if camera.name in {other.name for other in cameras[:i]}:
            raise table.wrong(f"cameras[{i}].name", f"{camera.name!r} is the name of another camera")
    address = table.text("database", "sqlite:///traffic.db")
    table.done()
    return Station(path=path, database=_in_folder(address, path.parent), cameras=cameras)


def _camera(path: Path, entry: Any, where: str) -> StationCamera:
    read = dataclass_of(_CameraEntry, entry, where)
    name = safe_names.name(f"{where}.name", read.name)
    site = read_site(path.parent / read.site)
    return StationCamera(name=name, site=site, site_sha256=sha256_of(site.path), tracks=path.parent / read.tracks)


def _in_folder(address: str, folder: Path) -> str:
    """Return the address of a database; a relative path to an SQLite file becomes relative to `folder`."""
    start = "sqlite:///"
    if not address.startswith(start) or address == start:
        return address
    return start + str(folder.resolve() / address.removeprefix(start))
