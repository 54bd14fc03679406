"""A recording: everything that happened before one camera, so that rendering is a function of (recording, frame).

One small .npz file: a JSON header (camera, light, vehicles, versions) and float64 arrays of poses. Equal recordings
have equal bytes.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import names
from skope.camera import Camera
from skope.errors import UserError, one_of
from skope.files import read_bytes, write_bytes
from skope.gen.scene.conditions import Conditions, Range
from skope.gen.scene.streams import Stream, rng
from skope.gen.towns.own_road import OwnRoad
from skope.gen.towns.sites import Site
from skope.gen.towns.town import Town, towns

Array = NDArray[np.float64]

VERSION: Final = 3


@dataclass(frozen=True)
class Take:
    """What a dataset knows of a recording without opening it."""

    site: str
    name: str
    split: str
    frames: int

    def frame_name(self, frame: int) -> str:
        """<site>/<recording>_<frame>: what image, depth and label files of a frame are called, without suffix."""
        return f"{self.site}/{self.name}_{frame:06d}"


@dataclass(frozen=True, kw_only=True)
class RecordingPlan:
    """What fixes a recording, seed included."""

    site: Site
    index: int
    frames: int
    interval: float
    """Seconds between frames, a multiple of 0.005."""
    size: tuple[int, int]
    fov_deg: float
    seed: int
    settings: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of conditions that are set; the others follow the site's weather and hour."""
    cameras: Mapping[str, Range] = field(default_factory=dict)
    """Ranges of `skope.gen.scene.camera_sampling.LIMITS` that the camera is drawn from; none for the site's own."""
    vehicles: tuple[str, ...] = ()
    """Models that were added and drive by too."""
    shape_jitter: bool = False
    """Each vehicle has a shape of its own near its model's."""

    @property
    def take(self) -> Take:
        """The recording that this plan leads to."""
        return Take(self.site.name, f"{self.index:02d}", self.site.split, self.frames)

    def rng(self, stream: Stream, *which: int) -> np.random.Generator:
        """The generator of one of this recording's streams; `which` is what the stream takes."""
        return rng(self.seed, self.site.name, self.index, stream, *which)

    def rng_of(self, name: str) -> np.random.Generator:
        """The generator of the vehicle or rider of that name."""
        return self.rng(Stream.ROAD_USER, zlib.crc32(name.encode()))


@dataclass(frozen=True)
class RecordedVehicle:
    """What stays the same about a vehicle, or about somebody else on the road."""

    track_id: int
    model: str
    shape: Mapping[str, float]
    color: str
    parked: bool = False
    labelled: bool = True
    """False for people on foot and on two wheels; these come after the vehicles."""

    def __post_init__(self) -> None:
        names.name("model", self.model)


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame: the state of the N vehicles that are near the camera, and of others on the road after them."""

    time_s: float
    vehicles: tuple[RecordedVehicle, ...]
    T_world_chassis: Array
    """(N, 4, 4) pose of each vehicle frame."""
    T_world_wheels: Array
    """(N, 4, 4, 4) front right, front left, rear right, rear left; y is the axle, pointing left."""
    velocity: Array
    """(N, 3) world, m/s."""
    lamps: NDArray[np.uint8]
    """(N,) bits of `skope.gen.traffic.sumo.LAMPS`."""
    signals: Mapping[str, str]
    """State string of each signal program."""

    def labelled(self) -> "Moment":
        """The vehicles alone."""
        n = sum(vehicle.labelled for vehicle in self.vehicles)
        poses = (self.T_world_chassis[:n], self.T_world_wheels[:n], self.velocity[:n], self.lamps[:n])
        return Moment(self.time_s, self.vehicles[:n], *poses, self.signals)


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    town: Town
    site: str
    name: str
    split: str
    camera: Camera
    weather: str
    time_of_day: str
    conditions: Conditions
    seed: int
    versions: Mapping[str, str]
    vehicles: tuple[RecordedVehicle, ...]
    times_s: Array
    """(F,) seconds since the recording began."""
    signals: tuple[Mapping[str, str], ...]
    """State strings of the signal programs in each frame."""
    frame: NDArray[np.int32]
    """(R,) frame of each row below, rising."""
    vehicle: NDArray[np.int32]
    """(R,) index into `vehicles`."""
    T_world_chassis: Array
    """(R, 4, 4)"""
    T_world_wheels: Array
    """(R, 4, 4, 4)"""
    velocity: Array
    """(R, 3)"""
    lamps: NDArray[np.uint8]
    """(R,)"""
    photograph: NDArray[np.uint8] | None = None
    """(H, W, 3) RGB of the empty road as the camera sees it, in place of scenery: the own road's, unless given."""

    def __post_init__(self) -> None:
        names.name("town", self.town.name)
        for field_name in ("site", "name", "split"):
            names.name(field_name, getattr(self, field_name))
        road = self.town.road
        if self.photograph is None and road and road.photograph:
            picture = road.picture((self.camera.width, self.camera.height))
            object.__setattr__(self, "photograph", picture)

    def __len__(self) -> int:
        return len(self.times_s)

    def rng(self, stream: Stream, *which: int) -> np.random.Generator:
        """The generator of one of this recording's streams; `which` is what the stream takes."""
        return rng(self.seed, self.site, int(self.name), stream, *which)

    def moment(self, frame: int) -> Moment:
        """The state at a frame."""
        rows = slice(*np.searchsorted(self.frame, [frame, frame + 1]))
        return Moment(
            float(self.times_s[frame]),
            tuple(self.vehicles[i] for i in self.vehicle[rows]),
            self.T_world_chassis[rows],
            self.T_world_wheels[rows],
            self.velocity[rows],
            self.lamps[rows],
            self.signals[frame],
        )

    @property
    def take(self) -> Take:
        return Take(self.site, self.name, self.split, len(self))

    def starts_like(self, other: "Recording") -> bool:
        """Whether its first frames are all that `other` has."""
        same = ("town", *_HEADER, "conditions", "photograph")
        rows = len(other.frame)
        return (
            len(self) >= len(other)
            and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in same)
            and self.camera.to_dict() == other.camera.to_dict()
            and self.vehicles[: len(other.vehicles)] == other.vehicles
            and self.signals[: len(other)] == other.signals
            and np.array_equal(self.times_s[: len(other)], other.times_s)
            and not (self.frame[rows:] < len(other)).any()
            and all(np.array_equal(getattr(self, name)[:rows], getattr(other, name)) for name in _ROWS)
        )


_ROWS: Final = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
_ARRAYS: Final = ("times_s", *_ROWS)
_FILES: Final = ("network", "photograph")
"""Of an own road."""
_HEADER: Final = ("site", "name", "split", "weather", "time_of_day", "seed", "versions")


def save(path: Path, recording: Recording) -> None:
    """Write a recording atomically."""
    write_bytes(path, packed(recording))


def packed(recording: Recording) -> bytes:
    """What a recording's file holds."""
    header = {
        "version": VERSION,
        "town": recording.town.name,
        **{name: getattr(recording, name) for name in _HEADER},
        "size": [recording.camera.width, recording.camera.height],
        "camera": recording.camera.to_dict(),
        "conditions": recording.conditions.to_dict(),
        "vehicles": [asdict(vehicle) for vehicle in recording.vehicles],
        "signals": [dict(states) for states in recording.signals],
    }
    arrays = {name: getattr(recording, name) for name in _ARRAYS}
    if road := recording.town.road:
        header["place"] = road.header()
        arrays |= {name: np.frombuffer(getattr(road, name), dtype=np.uint8) for name in _FILES}
    file = io.BytesIO()
    np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)
    return file.getvalue()


def length(path: Path) -> int:
    """Frames of a recording's file; 0 for a broken one."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return len(file["times_s"])
    except Exception:  # zip, header and array errors of a damaged file come in a dozen types
        return 0


def sound(path: Path) -> bool:
    """Whether all members of a recording's file have their checksums."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None
    except Exception:  # of a damaged file they come in a dozen types
        return False


def load(path: Path) -> Recording:
    """Read a recording; a broken file or one of another version is a UserError."""
    return unpacked(read_bytes(path), path)


def unpacked(data: bytes, path: Path) -> Recording:
    """The recording that a file holds; `path` is what errors call it."""
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            header: dict[str, Any] = json.loads(str(file["header"]))
            if header.get("version") != VERSION:
                raise UserError(
                    f"version: this skope reads recordings of version {VERSION}, got {header.get('version')}"
                )
            recording = _recording_of(header, file)
        if recording.town.road is None:
            one_of("town", recording.town.name, tuple(town.name for town in towns()))
        elif recording.town != Town.of(recording.town.road):
            raise UserError(f"town: expected {recording.town.road.name}, as the road in it, got {recording.town.name}")
        return recording
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    except Exception as error:  # zip, header and array errors of a damaged file come in a dozen types
        raise UserError(f"{path}: not a readable recording: {error}") from None


def _recording_of(header: Mapping[str, Any], file: Mapping[str, Any]) -> Recording:
    """The recording of a file's header and arrays."""
    own = header.get("place")
    road = OwnRoad.of(own, *(file[name].tobytes() for name in _FILES)) if own else None
    return Recording(
        town=Town(header["town"], road),
        **{name: header[name] for name in _HEADER},
        camera=Camera.from_dict(header["camera"], *header["size"]),
        conditions=Conditions(**header["conditions"]),
        vehicles=tuple(RecordedVehicle(**vehicle) for vehicle in header["vehicles"]),
        signals=tuple(header["signals"]),
        **{name: file[name] for name in _ARRAYS},
    )
