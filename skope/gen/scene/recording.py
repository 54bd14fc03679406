"""Recordings: the states of all road users near one camera, and everything else that a rendered frame depends on.

A recording is one small .npz file: a JSON header (camera, light, vehicles, versions) and float64 arrays of poses. Equal
recordings have equal bytes.
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
"""Number of shapes per model in a dataset with views; limited so that building shapes takes less time than drawing."""
LAMP_BITS: Final = {"low_beam": 1, "brake": 2, "indicator_left": 4, "indicator_right": 8, "reverse": 16}
"""Bit of each lamp in the number that encodes which lamps of a vehicle are lit."""
RECORDING_VERSION: Final = 3
"""Version of the file format of recordings."""


@dataclass(frozen=True)
class RecordingInfo:
    """Site, name, split and number of frames of a recording; dataset cards list them under "takes"."""

    site: str
    name: str
    split: str
    frames: int

    def frame_name(self, frame: int) -> str:
        """Return <site>/<recording>_<frame>: the name of a frame's image, depth and label files, without suffix."""
        return f"{self.site}/{self.name}_{frame:06d}"


@dataclass(frozen=True, kw_only=True)
class RecordingPlan:
    """Everything that determines a recording's content, including its seed."""

    site: Site
    index: int
    """Index among the site's recordings, from 0."""
    frames: int
    interval: float
    """Seconds between frames, a multiple of 0.005."""
    size: tuple[int, int]
    """Width and height of the images, pixels."""
    fov_deg: float
    """Horizontal field of view of the site's camera, degrees; not used for a user's own camera."""
    seed: int
    variation: Variation = field(default_factory=Variation)
    """Optional variation between the recordings of the dataset."""
    vehicles: tuple[str, ...] = ()
    """Requested models: added by the user (`skope gen vehicles add`) or from the fleet."""
    vehicle_share: float | None = None
    """Combined traffic share of all `vehicles`, 0 to 1; None for one vehicle of each model per ten of the fleet."""

    @property
    def leader(self) -> int:
        """Index of the first recording that shares the traffic of this one."""
        return self.index - self.index % views if (views := self.variation.views) else self.index

    @property
    def info(self) -> RecordingInfo:
        """Site, name, split and number of frames of the recording that this plan describes."""
        return RecordingInfo(self.site.name, f"{self.index:02d}", self.site.split, self.frames)

    def rng(self, stream: Stream, *which: int) -> np.random.Generator:
        """Return the generator of one of this recording's streams; `which` holds the stream's own arguments."""
        return rng(self.seed, self.site.name, self.index, stream, *which)

    def shared_rng(self, stream: Stream, *which: int) -> np.random.Generator:
        """Return the generator of a stream that is the same for all recordings of one simulated traffic."""
        return rng(self.seed, self.site.name, self.leader, stream, *which)

    def shape_rng(self, name: str, model: str) -> np.random.Generator:
        """Return the generator of a vehicle's shape.

        Without views, each vehicle has its own. With views, it has one of the `SHAPES_PER_MODEL` of its model.
        """
        if not self.variation.views:
            return self.rng_of(name)
        return rng(self.seed, model, zlib.crc32(name.encode()) % SHAPES_PER_MODEL, Stream.SHAPE)

    def rng_of(self, name: str) -> np.random.Generator:
        """Return the random generator of the named vehicle or rider."""
        return self.shared_rng(Stream.ROAD_USER, zlib.crc32(name.encode()))


@dataclass(frozen=True)
class RecordedVehicle:
    """Constant properties of a road user (vehicle or bystander) during a recording."""

    track_id: int
    model: str
    """Model of a vehicle; kind of a bystander ("pedestrian", "cyclist", "motorcyclist")."""
    shape: Mapping[str, float]
    """Dimensions of a vehicle, or the numeric fields of a bystander's `Look`."""
    color: str
    """Name of a vehicle's paint."""
    parked: bool = False
    labelled: bool = True
    """True for vehicles, False for bystanders (pedestrians and riders of two-wheelers).

    Bystanders follow the vehicles and have labels of their own if `Recording.road_users` is set."""
    recurs: bool = False
    """Whether other recordings can have vehicles of exactly this random shape (see `SHAPES_PER_MODEL`)."""

    def __post_init__(self) -> None:
        safe_names.name("model", self.model)


@dataclass(frozen=True, eq=False)
class Moment:
    """State of the N road users near the camera in one frame; vehicles first, then bystanders."""

    time_s: float
    vehicles: tuple[RecordedVehicle, ...]
    T_world_chassis: Array
    """(N, 4, 4) pose of each vehicle frame in the world."""
    T_world_wheels: Array
    """(N, 4, 4, 4) poses of the wheels: front right, front left, rear right, rear left; y is the axle, pointing left.

    For a bystander, the poses of its first four moving parts."""
    velocity: Array
    """(N, 3) velocity in the world, m/s."""
    lamps: NDArray[np.uint8]
    """(N,) lit lamps, as bits of `skope.gen.scene.recording.LAMP_BITS`."""
    signals: Mapping[str, str]
    """SUMO state string of each signal program."""
    T_world_trailer: Array
    """(N, 3, 4, 4) poses of an articulated vehicle's trailer, its rear right wheel and its rear left wheel.

    See `skope.gen.vehicles.model.Trailer`. For a bystander, the poses of three more moving parts; for all other road
    users, the identity."""

    def part_poses(self, i: int) -> Array:
        """Return the (8, 4, 4) poses of the parts of the i-th road user (see `skope.gen.vehicles.model.Body`)."""
        return np.concatenate([self.T_world_chassis[i][None], self.T_world_wheels[i], self.T_world_trailer[i]])

    def labelled(self) -> "Moment":
        """Return the same moment without bystanders."""
        return self.only(range(sum(vehicle.labelled for vehicle in self.vehicles)))

    def only(self, chosen: Sequence[int]) -> "Moment":
        """Return the same moment with only the road users at the given indices."""
        rows = np.array(chosen, dtype=np.intp)
        poses = (self.T_world_chassis[rows], self.T_world_wheels[rows], self.velocity[rows], self.lamps[rows])
        vehicles = tuple(self.vehicles[i] for i in chosen)
        return Moment(self.time_s, vehicles, *poses, self.signals, self.T_world_trailer[rows])


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """States of the road users near one camera: F frames and R rows, one row per road user and frame."""

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
    """(F,) time since the start of the recording, seconds."""
    signals: tuple[Mapping[str, str], ...]
    """SUMO state strings of the signal programs in each frame."""
    frame: NDArray[np.int32]
    """(R,) frame of each row, in ascending order."""
    vehicle: NDArray[np.int32]
    """(R,) index into `vehicles` for each row."""
    T_world_chassis: Array
    """(R, 4, 4) pose of the vehicle frame in the world."""
    T_world_wheels: Array
    """(R, 4, 4, 4) poses of the wheels, or of a bystander's moving parts, in the order of `Moment`."""
    velocity: Array
    """(R, 3) velocity in the world, m/s."""
    lamps: NDArray[np.uint8]
    """(R,) lit lamps, as bits of `skope.gen.scene.recording.LAMP_BITS`."""
    T_world_trailer: Array | None = None
    """(R, 3, 4, 4) poses of a trailer and its wheels, in the order of `Moment`. None if no vehicle has a trailer."""
    photograph: NDArray[np.uint8] | None = None
    """(H, W, 3) RGB photograph of the empty road from the camera, used instead of scenery.

    Default: the photograph of the user's road, if it has one."""
    road_users: bool = False
    """Whether bystanders are also labelled, in their own categories."""

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
        """Return the generator of one of this recording's streams; `which` holds the stream's own arguments."""
        return rng(self.seed, self.site, int(self.name), stream, *which)

    def moment(self, frame: int) -> Moment:
        """Return the state in a frame."""
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
        """Return whether the first frames are identical to `other`, which must not be longer."""
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
"""Array that only files with an articulated vehicle, or a bystander with more than four moving parts, contain."""
_FILE_FIELDS: Final = ("network", "photograph")
"""Fields of `OwnRoad` that are stored as bytes."""
HEADER_FIELDS: Final = ("site", "name", "split", "weather", "time_of_day", "seed", "versions")


def save(path: Path, recording: Recording) -> None:
    """Write a recording to a .npz file atomically."""
    write_bytes(path, packed_recording(recording))


def packed_recording(recording: Recording) -> bytes:
    """Return the bytes of a recording's .npz file; equal recordings have equal bytes."""
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
    """Return float64 poses as float32 if that loses nothing; other arrays unchanged."""
    short = values.astype(np.float32) if values.dtype == np.float64 and values.ndim > 1 else values
    return short if np.array_equal(short, values) else values


def length(path: Path) -> int:
    """Return the number of frames of the recording at a path; 0 for a damaged file."""
    try:
        with np.load(path, allow_pickle=False) as file:
            return len(file["times_s"])
    except Exception:  # damaged files raise a dozen types of zip, header and array errors
        return 0


def sound(path: Path) -> bool:
    """Return whether the checksums of all members of a recording's file are correct."""
    try:
        with zipfile.ZipFile(path) as file:
            return file.testzip() is None
    except Exception:  # damaged files raise a dozen types of zip errors
        return False


def load(path: Path) -> Recording:
    """Read a recording. Raises UserError if the file is damaged or has another version."""
    return unpacked_recording(read_bytes(path), path)


def unpacked_recording(data: bytes, path: Path) -> Recording:
    """Read a recording from the bytes of its file.

    Args:
        data: The bytes that `packed_recording` returned.
        path: Path of the file, used only in error messages.

    Raises:
        UserError: The bytes are damaged, have another version, or name a town that is not in the package.
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
    except Exception as error:  # damaged files raise a dozen types of zip, header and array errors
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
    """Build a recording from the header and the arrays of its file."""
    road_header = header.get("place")
    road = OwnRoad.of(road_header, *(file[name].tobytes() for name in _FILE_FIELDS)) if road_header else None
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
    """Return the body of a road user; equal bodies are built once."""
    return vehicle_body(recorded) if recorded.labelled else bystander.build_bystander(recorded.model, recorded.shape)


def vehicle_body(recorded: RecordedVehicle) -> Vehicle:
    """Return the body of a labelled road user; equal bodies are built once."""
    return build_vehicle(recorded.model, recorded.shape, recurs=recorded.recurs)
