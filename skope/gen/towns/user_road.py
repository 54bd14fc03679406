"""A road of a user's own: what its traffic and scenery come from, small enough for plans and recordings to carry."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cache
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
        return _name(self)

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
def _name(road: OwnRoad) -> str:
    digest = hashlib.sha256(json.dumps(road.header(), sort_keys=True).encode())
    for data in (road.network, road.photograph):
        digest.update(hashlib.sha256(data).digest())
    return f"{road.title}-{digest.hexdigest()[:10]}"
