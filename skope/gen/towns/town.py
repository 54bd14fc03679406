"""Towns: SUMO networks of the package or a user's own road; they determine layout, scenery and traffic."""

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
    """Object in the photograph that is in front of the traffic."""

    polygon: PixelOutline
    """Outline of the object, pixels of the camera's image."""
    distance: float
    """Planar depth of the object, metres."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnRoad:
    """A user's road in front of one camera; its name contains a digest, so equal names are equal roads."""

    title: str
    network: bytes = field(repr=False)
    """Content of a SUMO network file (.net.xml)."""
    style: str
    """Content of a `town.toml`; empty for the generic style."""
    camera: Camera
    photograph: bytes = field(default=b"", repr=False)
    """Photograph of the empty road: bytes of an image file with the camera's size or a multiple of it.

    If empty, scenery is generated instead."""
    occluders: tuple[Occluder, ...] = ()
    shades: tuple[PixelOutline, ...] = ()
    """Outlines of shaded ground in the photograph, pixels of the camera's image."""

    def __post_init__(self) -> None:
        safe_names.name("title", self.title)

    @property
    def name(self) -> str:
        """Name of the town in recordings and annotations."""
        return _name_of_road(self)

    def picture(self, size: tuple[int, int]) -> Pixels:
        """Return the RGB photograph (H, W, 3) at an image size (width, height)."""
        bgr = cv2.imdecode(np.frombuffer(self.photograph, dtype=np.uint8), cv2.IMREAD_COLOR)
        assert bgr is not None
        smaller = size[0] < bgr.shape[1]
        sized = cv2.resize(bgr, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_CUBIC)
        return np.asarray(cv2.cvtColor(sized, cv2.COLOR_BGR2RGB), dtype=np.uint8)

    def header(self) -> dict[str, Any]:
        """Return the fields that JSON can store."""
        return {
            "title": self.title,
            "style": self.style,
            "size": [self.camera.width, self.camera.height],
            "camera": self.camera.to_dict(),
            "occluders": [[occluder.polygon, occluder.distance] for occluder in self.occluders],
            "shades": self.shades,
        }

    @classmethod
    def of(cls, header: Mapping[str, Any], network: bytes, photograph: bytes) -> Self:
        """Return the road with a `header` and its two files."""
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
    """Position and view of a camera in a town."""

    position: tuple[float, float, float]
    """World x, y and z, metres."""
    yaw_deg: float
    """Viewing direction: degrees counter-clockwise from east."""
    pitch_deg: float
    """Viewing direction: degrees down from the horizon."""
    fov_deg: float = 90.0
    """Horizontal field of view, degrees."""


@dataclass(frozen=True)
class Variant:
    """Redrawn scenery along the roads of a town of the package: another place with the same network."""

    seed: int
    """Seed for houses, trees, furniture and colours; 0 for the town's own style."""
    masts: tuple[Mast, ...] = ()
    """Cameras with clear views, which replace those of the town's sites."""
    distractors: int = 0
    """Number of distractors around the masts: objects that resemble vehicles or parts of them."""
    lit_objects: int = 0
    """Number of burning or luminous objects around the masts at night, other than vehicles."""
    season: int = 0
    """Seed for the colours of plants and the choice of bare trees; 0 for the default summer."""
    randomised: int = 0
    """Seed for the colours and patterns of ground and walls; 0 for those of the materials."""


@dataclass(frozen=True)
class Town:
    """A town of the package, or a user's own road. Towns with the same name and variant are equal."""

    name: str
    road: OwnRoad | None = field(default=None, compare=False, repr=False)
    """User's own road; None for the towns of the package."""
    variant: Variant | None = None
    """Differences between its scenery and that of the package; None if there are none."""

    @classmethod
    def of(cls, road: OwnRoad) -> "Town":
        """Return the town that consists of a user's own road."""
        return cls(road.name, road)

    @property
    def network(self) -> Path:
        """Path of the compiled SUMO network (.net.xml)."""
        return _network_file(self) if self.road else town_folder(self.name) / "town.net.xml"


def town_folder(name: str) -> Path:
    """Return the folder with the files of a town of the package."""
    return Path(str(resources.files("skope.gen.towns"))) / name


@cache
def towns() -> tuple[Town, ...]:
    """Return all towns of the package."""
    return tuple(Town(name) for name in sorted(path.parent.name for path in town_folder("").glob("*/town.toml")))


def source_digest(name: str) -> str:
    """Return the digest of the plain XML files from which the network of a town of the package is compiled."""
    digest = hashlib.sha256()
    for path in sorted((town_folder(name) / "source").glob("*.xml")):
        digest.update(path.name.encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()[:24]


@cache
def _network_file(town: Town) -> Path:
    """Write an own road's network to a file, since SUMO reads only files; it exists until the process ends."""
    assert town.road is not None
    path = Path(_scratch().name) / f"{town.name}.net.xml"
    path.write_bytes(town.road.network)
    return path


@cache
def _scratch() -> tempfile.TemporaryDirectory[str]:
    return tempfile.TemporaryDirectory(prefix="skope-")
