"""Camera sites of the package's towns, and the site of a user's own road."""

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any

import numpy as np

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.towns.town import Mast, OwnRoad, Town, town_folder


@dataclass(frozen=True, kw_only=True)
class Site:
    """Place in a town with a roadside camera, and the default traffic, weather and hour of its recordings."""

    name: str
    town: Town
    split: str
    mounting: str
    """Object that the camera is mounted on; the town's `sites.toml` names the source."""
    sees: str
    """Description of the traffic in the camera's view."""
    position: tuple[float, float, float]
    """World x, y and z of the camera, metres."""
    yaw_deg: float
    """Viewing direction: degrees counter-clockwise from east."""
    pitch_deg: float
    """Viewing direction: degrees down from the horizon."""
    vehicles_per_hour: float
    """Total traffic on all routes into the town; for a user's own camera, on all routes that pass it."""
    weather: str
    time_of_day: str
    conditions: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    """Ranges of conditions that replace those of weather and hour."""
    flows: str = ""
    """Traffic as the text of a SUMO route file, used instead of `vehicles_per_hour` if not empty."""

    @property
    def road(self) -> OwnRoad | None:
        """Road of a user's own site; None for the sites of the package."""
        return self.town.road

    def camera(self, size: tuple[int, int], fov_deg: float, distortion: Distortion | None = None) -> Camera:
        """Return the site's camera.

        Args:
            size: Width and height of the image, pixels.
            fov_deg: Horizontal field of view, degrees: for a fisheye lens, the field that its image covers; for other
                lenses, the field without distortion. Ignored for a user's own camera.
            distortion: Distortion of the lens. Default: none, or that of a user's own camera.
        """
        if self.road:
            resized = self.road.camera.resized(size)
            return replace(resized, distortion=distortion) if distortion else resized
        camera = Camera.looking(
            self.position,
            yaw=math.radians(self.yaw_deg),
            pitch_down=math.radians(self.pitch_deg),
            size=size,
            fov=math.radians(fov_deg),
            distortion=distortion,
        )
        if camera.distortion.model != "fisheye":
            return camera
        edge = np.array([math.tan(math.radians(fov_deg) / 2), 0.0])
        shorter = edge[0] / camera.distortion.distort(edge)[0][0]
        return replace(camera, K=camera.K * [[shorter, 1, 1], [1, shorter, 1], [1, 1, 1]])


@cache
def sites() -> Mapping[str, Site]:
    """Return all camera sites by name, town by town."""
    out = {}
    for path in sorted(town_folder("").glob("*/sites.toml")):
        for name, row in tomllib.loads(path.read_text(encoding="utf-8")).items():
            out[name] = Site(name=name, town=Town(path.parent.name), **{**row, "position": tuple(row["position"])})
    return out


def site(name: str) -> Site:
    """Return the site with the given name. Raises UserError with a list of all names if there is none."""
    if name not in sites():
        raise UserError(f"site: {name!r} is not one of {', '.join(sites())}")
    return sites()[name]


def sites_of(town: Town) -> tuple[Site, ...]:
    """Return the camera sites of a town; its scenery keeps their views clear."""
    if town.variant and town.variant.masts:
        return tuple(site_at(mast, town, f"view{i}") for i, mast in enumerate(town.variant.masts))
    if town.road is None:
        return tuple(site for site in sites().values() if site.town.name == town.name)
    return (site_of(town.road, split="", vehicles_per_hour=0.0, weather="", time_of_day=""),)


def site_at(mast: Mast, town: Town, name: str) -> Site:
    """Return a site for a camera on a mast in a town, with default traffic and weather."""
    return Site(
        name=name,
        town=town,
        split="",
        mounting="",
        sees="",
        position=mast.position,
        yaw_deg=mast.yaw_deg,
        pitch_deg=mast.pitch_deg,
        vehicles_per_hour=0.0,
        weather="",
        time_of_day="",
    )


def site_of(road: OwnRoad, **values: Any) -> Site:
    """Return the site of a user's own camera; `values` are the fields of `Site` that the road does not determine."""
    x, y, z = road.camera.position.tolist()
    yaw, pitch_down, _ = road.camera.angles
    return Site(
        name=road.title,
        town=Town.of(road),
        mounting="",
        sees="",
        position=(x, y, z),
        yaw_deg=math.degrees(yaw),
        pitch_deg=math.degrees(pitch_down),
        **values,
    )
