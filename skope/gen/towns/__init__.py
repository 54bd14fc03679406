"""Towns and their camera sites, as shipped with the package: a SUMO network, scenery grown from it, cameras."""

import hashlib
import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path

from skope.camera import Camera, Distortion
from skope.errors import UserError


@dataclass(frozen=True, kw_only=True)
class Site:
    """A camera where a road authority would hang one, with the traffic and the hour that it is recorded at."""

    name: str
    town: str
    split: str
    mounting: str
    """What the camera hangs on; the source is named in the town's file."""
    sees: str
    """What traffic it looks at."""
    position: tuple[float, float, float]
    """World x, y and z of the camera, metres."""
    yaw_deg: float
    """Viewing direction, counter-clockwise from east."""
    pitch_deg: float
    """Downwards from the horizon."""
    vehicles_per_hour: float
    """Over all ways into the town."""
    weather: str
    time_of_day: str

    def camera(self, size: tuple[int, int], fov_deg: float, k1: float = 0.0) -> Camera:
        """The site's camera for an image size (width, height), a field of view and a radial distortion."""
        return Camera.looking(
            self.position,
            yaw=math.radians(self.yaw_deg),
            pitch_down=math.radians(self.pitch_deg),
            size=size,
            fov=math.radians(fov_deg),
            distortion=Distortion("brown", (k1, 0.0, 0.0, 0.0)) if k1 else None,
        )


def folder(town: str) -> Path:
    """Where a town's files are."""
    return Path(str(resources.files("skope.gen.towns"))) / town


@cache
def towns() -> tuple[str, ...]:
    """The names of all towns."""
    return tuple(sorted(path.parent.name for path in folder("").glob("*/town.toml")))


def source_digest(town: str) -> str:
    """Of the plain XML files that a town's network is compiled from."""
    digest = hashlib.sha256()
    for path in sorted((folder(town) / "source").glob("*.xml")):
        digest.update(path.name.encode() + b"\n" + path.read_bytes())
    return digest.hexdigest()[:24]


@cache
def sites() -> Mapping[str, Site]:
    """All camera sites by name, town by town."""
    out = {}
    for path in sorted(folder("").glob("*/sites.toml")):
        for name, row in tomllib.loads(path.read_text(encoding="utf-8")).items():
            out[name] = Site(name=name, town=path.parent.name, **{**row, "position": tuple(row["position"])})
    return out


def site(name: str) -> Site:
    """The site of that name, or a UserError that lists them."""
    if name not in sites():
        raise UserError(f"site: {name!r} is not one of {', '.join(sites())}")
    return sites()[name]


def network(town: str) -> Path:
    """The town's compiled SUMO network."""
    return folder(town) / "town.net.xml"
