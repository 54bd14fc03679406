"""A recording: everything that happened before one camera, so that a rendered frame depends on nothing else.

One small .npz file: a JSON header (camera, light, vehicles, versions) and float64 arrays of poses. Equal recordings
have equal bytes.
"""

import io
import json
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.errors import UserError, one_of
from skope.files import safe_names
from skope.files.atomic import read_bytes, write_bytes
from skope.gen.bystanders import bystander
from skope.gen.scene.conditions import Conditions
from skope.gen.scene.random_streams import Stream, rng
from skope.gen.scene.variation import Variation
from skope.gen.towns.sites import Site
from skope.gen.towns.town import Mast, OwnRoad, Town, Variant, towns
from skope.gen.vehicles.fleet import build_vehicle
from skope.gen.vehicles.model import Body, Vehicle
from skope.types import Array

SHAPES_PER_MODEL: Final = 24
"""Shapes that a dataset with views has of each model: building them must not take longer than drawing them."""
LAMP_BITS: Final = {"low_beam": 1, "brake": 2, "indicator_left": 4, "indicator_right": 8, "reverse": 16}
"""The bit of each lamp in the number that says which of a vehicle's lamps are lit."""
RECORDING_VERSION: Final = 3
"""Version of the file format of recordings."""


@dataclass(frozen=True)
class RecordingInfo:
    """Site, name, split and number of frames of a recording, as the dataset's card lists them under "takes"."""

    site: str
    name: str
    split: str
    frames: int

    def frame_name(self, frame: int) -> str:
        """<site>/<recording>_<frame>: name of a frame's image, depth and label files, without suffix."""
        return f"{self.site}/{self.name}_{frame:06d}"


@dataclass(frozen=True, kw_only=True)
class RecordingPlan:
    """Everything that decides a recording's content, its seed included."""

    site: Site
    index: int
    """Its number among the site's recordings, from 0."""
    frames: int
    interval: float
    """Seconds between frames, a multiple of 0.005."""
    size: tuple[int, int]
    """Width and height of the images, pixels."""
    fov_deg: float
    """Horizontal field of view of the site's camera; a user's own camera has its own."""
    seed: int
    variation: Variation = field(default_factory=Variation)
    """Things that are drawn for it, and their ranges."""
    vehicles: tuple[str, ...] = ()
    """Models that were asked for, of the user (`skope gen vehicles add`) or of the fleet."""
    vehicle_share: float | None = None
    """Share of the traffic that `vehicles` make together; None for a tenth of the fleet's number each."""

    @property
    def leader(self) -> int:
        """Number of the first of the recordings that share this one's traffic."""
        return self.index - self.index % views if (views := self.variation.views) else self.index

    @property
    def info(self) -> RecordingInfo:
        """Site, name, split and number of frames of the recording that this plan describes."""
        return RecordingInfo(self.site.name, f"{self.index:02d}", self.site.split, self.frames)

    def rng(self, stream: Stream, *which: int) -> np.random.Generator:
        """The generator of one of this recording's streams; `which` is what the stream takes."""
        return rng(self.seed, self.site.name, self.index, stream, *which)

    def shared_rng(self, stream: Stream, *which: int) -> np.random.Generator:
        """The generator of a stream that recordings with one traffic have in common."""
        return rng(self.seed, self.site.name, self.leader, stream, *which)

    def shape_rng(self, name: str, model: str) -> np.random.Generator:
        """The generator of a vehicle's shape: its own, or, with views, that of one of the model's
        `SHAPES_PER_MODEL`."""
        if not self.variation.views:
            return self.rng_of(name)
        return rng(self.seed, model, zlib.crc32(name.encode()) % SHAPES_PER_MODEL, Stream.SHAPE)

    def rng_of(self, name: str) -> np.random.Generator:
        """The random generator of the vehicle or rider of that name."""
        return self.shared_rng(Stream.ROAD_USER, zlib.crc32(name.encode()))


@dataclass(frozen=True)
class RecordedVehicle:
    """Constant properties of a road user through a recording: a vehicle, or a bystander."""

    track_id: int
    model: str
    """Model of a vehicle; kind of a bystander ("pedestrian", "cyclist", "motorcyclist")."""
    shape: Mapping[str, float]
    """Dimensions of a vehicle, or numbers of a bystander's `Look`."""
    color: str
    """Name of a vehicle's paint."""
    parked: bool = False
    labelled: bool = True
    """Whether it is a vehicle; False for bystanders, people on foot and on two wheels, who come after the vehicles and
    have labels of their own where `Recording.road_users` says so."""
    recurs: bool = False
    """Whether other recordings of the dataset have vehicles of exactly this shape, drawn at random (see
    `SHAPES_PER_MODEL`)."""

    def __post_init__(self) -> None:
        safe_names.name("model", self.model)


@dataclass(frozen=True, eq=False)
class Moment:
    """One frame: the state of N road users near the camera, vehicles first, then bystanders."""

    time_s: float
    vehicles: tuple[RecordedVehicle, ...]
    T_world_chassis: Array
    """(N, 4, 4) pose of each vehicle frame in the world."""
    T_world_wheels: Array
    """(N, 4, 4, 4) poses of the wheels: front right, front left, rear right, rear left; y is the axle, pointing left.
    A bystander's four moving parts take their place."""
    velocity: Array
    """(N, 3) world, m/s."""
    lamps: NDArray[np.uint8]
    """(N,) lamps that are lit, as bits of `skope.gen.scene.recording.LAMP_BITS`."""
    signals: Mapping[str, str]
    """SUMO's state string of each signal program."""
    T_world_trailer: Array
    """(N, 3, 4, 4) poses of the trailer of an articulated vehicle and of its wheels rear right, rear left (see
    `skope.gen.vehicles.model.Trailer`), or of three more moving parts of a bystander; the identity for others."""

    def part_poses(self, i: int) -> Array:
        """(8, 4, 4) poses of the parts of the i-th road user (see `skope.gen.vehicles.model.Body`)."""
        return np.concatenate([self.T_world_chassis[i][None], self.T_world_wheels[i], self.T_world_trailer[i]])

    def labelled(self) -> "Moment":
        """The same moment without bystanders."""
        return self.only(range(sum(vehicle.labelled for vehicle in self.vehicles)))

    def only(self, chosen: Sequence[int]) -> "Moment":
        """The same moment with some of its road users, by index."""
        rows = np.array(chosen, dtype=np.intp)
        poses = (self.T_world_chassis[rows], self.T_world_wheels[rows], self.velocity[rows], self.lamps[rows])
        vehicles = tuple(self.vehicles[i] for i in chosen)
        return Moment(self.time_s, vehicles, *poses, self.signals, self.T_world_trailer[rows])


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """The events before one camera: F frames, with R rows of a road user in a frame each."""

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
    """SUMO's state strings of the signal programs in each frame."""
    frame: NDArray[np.int32]
    """(R,) frame of each row, rising."""
    vehicle: NDArray[np.int32]
    """(R,) index into `vehicles` of each row."""
    T_world_chassis: Array
    """(R, 4, 4) pose of the vehicle frame, as in `Moment`."""
    T_world_wheels: Array
    """(R, 4, 4, 4) poses of wheels or moving parts, as in `Moment`."""
    velocity: Array
    """(R, 3) world, m/s."""
    lamps: NDArray[np.uint8]
    """(R,) lamps that are lit, as bits of `skope.gen.scene.recording.LAMP_BITS`."""
    T_world_trailer: Array | None = None
    """(R, 3, 4, 4) poses of a trailer and its wheels, as in `Moment`. Default: no vehicle has one."""
    photograph: NDArray[np.uint8] | None = None
    """(H, W, 3) RGB of the empty road as the camera sees it, in place of scenery. Default: that of the user's road."""
    road_users: bool = False
    """Whether bystanders are labelled too, in categories of their own."""

    def __post_init__(self) -> None:
        safe_names.name("town", self.town.name)
        for field_name in ("site", "name", "split"):
            safe_names.name(field_name, getattr(self, field_name))
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
            self._trailers[rows],
        )

    @property
    def _trailers(self) -> Array:
        """(R, 3, 4, 4) poses of trailers and their wheels."""
        given = self.T_world_trailer
        return np.broadcast_to(np.eye(4), (len(self.frame), 3, 4, 4)) if given is None else given

    @property
    def info(self) -> RecordingInfo:
        """Site, name, split and number of frames."""
        return RecordingInfo(self.site, self.name, self.split, len(self))

    def starts_like(self, other: "Recording") -> bool:
        """Whether the first frames are exactly those of `other`, a recording that is not longer."""
        same = ("town", *HEADER_FIELDS, "conditions", "photograph", "road_users")
        rows = len(other.frame)
        return (
            len(self) >= len(other)
            and all(np.array_equal(getattr(self, name), getattr(other, name)) for name in same)
            and self.camera.to_dict() == other.camera.to_dict()
            and self.vehicles[: len(other.vehicles)] == other.vehicles
            and self.signals[: len(other)] == other.signals
            and np.array_equal(self.times_s[: len(other)], other.times_s)
            and not (self.frame[rows:] < len(other)).any()
            and all(np.array_equal(getattr(self, name)[:rows], getattr(other, name)) for name in _ROW_FIELDS)
            and np.array_equal(self._trailers[:rows], other._trailers)
        )


_ROW_FIELDS: Final = ("frame", "vehicle", "T_world_chassis", "T_world_wheels", "velocity", "lamps")
ARRAY_NAMES: Final = ("times_s", *_ROW_FIELDS)
TRAILER_ARRAY: Final = "T_world_trailer"
"""The array that only files with an articulated vehicle have, or with a bystander of more than four moving parts."""
_FILE_FIELDS: Final = ("network", "photograph")
"""Fields of `OwnRoad` that are stored as bytes."""
HEADER_FIELDS: Final = ("site", "name", "split", "weather", "time_of_day", "seed", "versions")


def save(path: Path, recording: Recording) -> None:
    """Write a recording to a .npz file, whole or not at all."""
    write_bytes(path, packed_recording(recording))


def packed_recording(recording: Recording) -> bytes:
    """The bytes of a recording's .npz file; equal recordings have equal bytes."""
    header = {
        "version": RECORDING_VERSION,
        "town": recording.town.name,
        **({"variant": asdict(variant)} if (variant := recording.town.variant) else {}),
        **{name: getattr(recording, name) for name in HEADER_FIELDS},
        **({"road_users": True} if recording.road_users else {}),
        "size": [recording.camera.width, recording.camera.height],
        "camera": recording.camera.to_dict(),
        "conditions": recording.conditions.to_dict(),
        "vehicles": [asdict(vehicle) for vehicle in recording.vehicles],
        "signals": [dict(states) for states in recording.signals],
    }
    arrays = {name: _smallest(getattr(recording, name)) for name in ARRAY_NAMES}
    if recording.T_world_trailer is not None and (recording.T_world_trailer != np.eye(4)).any():
        arrays[TRAILER_ARRAY] = _smallest(recording.T_world_trailer)
    if road := recording.town.road:
        header["place"] = road.header()
        arrays |= {name: np.frombuffer(getattr(road, name), dtype=np.uint8) for name in _FILE_FIELDS}
    file = io.BytesIO()
    np.savez_compressed(file, header=np.array(json.dumps(header)), **arrays)
    return file.getvalue()


def _smallest(values: Any) -> Any:
    """Poses of 24 bits in half of the bytes; others as they are."""
    short = values.astype(np.float32) if values.dtype == np.float64 and values.ndim > 1 else values
    return short if np.array_equal(short, values) else values


def length(path: Path) -> int:
    """Number of frames of the recording at a path; 0 for a broken file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return len(file["times_s"])
    except Exception:  # zip, header and array errors of a damaged file come in a dozen types
        return 0


def sound(path: Path) -> bool:
    """Whether the recording's file at a path is whole, by the checksums of its members."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None
    except Exception:  # zip errors of a damaged file come in a dozen types
        return False


def load(path: Path) -> Recording:
    """Read a recording; a UserError for a broken file or one of another version."""
    return unpacked_recording(read_bytes(path), path)


def unpacked_recording(data: bytes, path: Path) -> Recording:
    """Read a recording from the bytes of its file.

    Args:
        data: What `packed` returned.
        path: What error messages call it.

    Raises:
        UserError: The bytes are damaged, or of another version, or name a town that is not in the package.
    """
    try:
        with np.load(io.BytesIO(data), allow_pickle=False) as file:
            header: dict[str, Any] = json.loads(str(file["header"]))
            if header.get("version") != RECORDING_VERSION:
                raise UserError(
                    f"version: this skope reads recordings of version {RECORDING_VERSION}, got {header.get('version')}"
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


def _full(values: Any) -> Any:
    return values.astype(np.float64) if values.dtype == np.float32 else values


def _variant_of(row: Mapping[str, Any] | None) -> Variant | None:
    if row is None:
        return None
    masts = []
    for mast in row["masts"]:
        x, y, z = map(float, mast["position"])
        angles = {name: float(value) for name, value in mast.items() if name != "position"}
        masts.append(Mast((x, y, z), **angles))
    drawn = {name: int(row[name]) for name in ("distractors", "lit_objects", "season", "randomised")}
    return Variant(int(row["seed"]), tuple(masts), **drawn)


def _recording_of(header: Mapping[str, Any], file: Mapping[str, Any]) -> Recording:
    """Put a recording together from the header and the arrays of its file."""
    own = header.get("place")
    road = OwnRoad.of(own, *(file[name].tobytes() for name in _FILE_FIELDS)) if own else None
    return Recording(
        town=Town(header["town"], road, _variant_of(header.get("variant"))),
        **{name: header[name] for name in HEADER_FIELDS},
        camera=Camera.from_dict(header["camera"], *header["size"]),
        conditions=Conditions(**header["conditions"]),
        vehicles=tuple(RecordedVehicle(**vehicle) for vehicle in header["vehicles"]),
        signals=tuple(header["signals"]),
        **{name: _full(file[name]) for name in ARRAY_NAMES},
        T_world_trailer=_full(file[TRAILER_ARRAY]) if TRAILER_ARRAY in file else None,
        road_users=header.get("road_users") is True,
    )


def body_of(recorded: RecordedVehicle) -> Body:
    """The body of a road user; equal ones are built once."""
    return vehicle_body(recorded) if recorded.labelled else bystander.build_bystander(recorded.model, recorded.shape)


def vehicle_body(recorded: RecordedVehicle) -> Vehicle:
    """The body of a labelled road user; equal ones are built once."""
    return build_vehicle(recorded.model, recorded.shape, recurs=recorded.recurs)
