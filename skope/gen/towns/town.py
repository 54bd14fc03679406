"""Towns: the SUMO networks of the package, or a user's own road, from which layout, scenery and traffic follow."""

import hashlib
import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import Any, Self

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.files import safe_names
from skope.types import Pixels

PixelOutline = tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Occluder:
    """Something in the photograph that stands before the traffic."""

    polygon: PixelOutline
    """Outline of the object, pixels of the camera's image."""
    distance: float
    """Planar depth, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnRoad:
    """A user's road before one camera. Its name holds a digest of all the rest: equal names, equal roads."""

    title: str
    network: bytes = field(repr=False)
    """A SUMO network (.net.xml)."""
    style: str
    """A `town.toml`; empty for the generic one."""
    camera: Camera
    photograph: bytes = field(default=b"", repr=False)
    """Photograph of the empty road: the bytes of an image file of the camera's size or a multiple. Empty to grow
    scenery instead."""
    occluders: tuple[Occluder, ...] = ()
    shades: tuple[PixelOutline, ...] = ()
    """Ground that lies in shadow in the photograph, pixels of the camera's image."""

    def __post_init__(self) -> None:
        safe_names.name("title", self.title)

    @property
    def name(self) -> str:
        """Name of the town in recordings and annotations."""
        return _name_of_road(self)

    def picture(self, size: tuple[int, int]) -> Pixels:
        """(H, W, 3) RGB photograph at an image size (width, height)."""
        bgr = cv2.imdecode(np.frombuffer(self.photograph, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None
        smaller = size[0] < bgr.shape[1]
        sized = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
        return np.asarray(cv2.cvtColor(sized, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def header(self) -> dict[str, Any]:
        """The fields that JSON can hold."""
        return {
            "title": self.title,
            "style": self.style,
            "size": [self.camera.width, self.camera.height],
            "camera": self.camera.to_dict(),
            "occluders": [[one.polygon, one.distance] for one in self.occluders],
            "shades": self.shades,
        }

    @classmethod
    def of(cls, header: Mapping[str, Any], network: bytes, photograph: bytes) -> Self:
        """The road of a `header` and its two files."""
        return cls(
            title=header["title"],
            network=network,
            style=header["style"],
            camera=Camera.from_dict(header["camera"], *header["size"]),
            photograph=photograph,
            occluders=tuple(Occluder(tuple(map(tuple, polygon)), depth) for polygon, depth in header["occluders"]),
            shades=tuple(tuple(map(tuple, outline)) for outline in header["shades"]),
        )


@cache
def _name_of_road(road: OwnRoad) -> str:
    digest = hashlib.sha256(json.dumps(road.header(), sort_keys=True).encode())
    for data in (road.network, road.photograph):
        digest.update(hashlib.sha256(data).digest())
    return f"{road.title}-{digest.hexdigest()[:10]}"


@dataclass(frozen=True)
class Mast:
    """Place and view of a camera in a town."""

    position: tuple[float, float, float]
    """World x, y and z, metres."""
    yaw_deg: float
    """Viewing direction, degrees counter-clockwise from east."""
    pitch_deg: float
    """Viewing direction, degrees down from the horizon."""
    fov_deg: float = 90.0
    """Horizontal field of view, degrees."""


@dataclass(frozen=True)
class Variant:
    """Scenery grown anew along the roads of a town of the package: another place with the same network."""

    seed: int
    """Seed by which houses, trees, furniture and colours are drawn; 0 for a town's own style."""
    masts: tuple[Mast, ...] = ()
    """Cameras whose views are kept clear, in place of those of the town's sites."""
    distractors: int = 0
    """Number of things around the masts that resemble vehicles or parts of them and are none."""
    lit_objects: int = 0
    """Number of things around the masts that burn or shine at night and are no vehicles."""
    season: int = 0
    """Seed by which the colours of plants and the bare trees are drawn; 0 for the usual summer."""
    randomised: int = 0
    """Seed by which the colours and patterns of ground and walls are drawn; 0 for those of the materials."""


@dataclass(frozen=True)
class Town:
    """A town of the package, or a user's own road. Towns of one name and variant are equal."""

    name: str
    road: OwnRoad | None = field(default=None, compare=False, repr=False)
    """The user's own road; None for the towns of the package."""
    variant: Variant | None = None
    """Differences of its scenery from that of the package; None where there are none."""

    @classmethod
    def of(cls, road: OwnRoad) -> "Town":
        """The town that consists of a user's own road."""
        return cls(road.name, road)

    @property
    def network(self) -> Path:
        """Path of the compiled SUMO network, a .net.xml file."""
        return _network_file(self) if self.road else town_folder(self.name) / "town.net.xml"


def town_folder(name: str) -> Path:
    """Folder with the files of a town of the package."""
    return Path(str(resources.files("skope.gen.towns"))) / name


@cache
def towns() -> tuple[Town, ...]:
    """All towns of the package."""
    return tuple(Town(name) for name in sorted(path.parent.name for path in town_folder("").glob("*/town.toml")))


def source_digest(name: str) -> str:
    """Digest of the plain XML files that the network of a town of the package is compiled from."""
    digest = hashlib.sha256()
    for path in sorted((town_folder(name) / "source").glob("*.xml")):
        digest.update(path.name.encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()[:24]


@cache
def _network_file(town: Town) -> Path:
    """An own road's network as a file, for as long as the process lives: SUMO reads nothing else."""
    assert town.road is not None
    path = Path(_scratch().name) / f"{town.name}.net.xml"
    path.write_bytes(town.road.network)
    return path


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="skope-")
