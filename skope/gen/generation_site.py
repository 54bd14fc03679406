"""Read and check site files (`skope gen --site FILE.toml`), before any output is written."""

import hashlib
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from datetime import datetime
from pathlib import Path
from typing import Final, Self
from xml.etree import ElementTree

import cv2
import numpy as np

from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.atomic import read_bytes, read_text
from skope.gen.render.lens import pinhole_of
from skope.gen.scene.conditions import CONDITION_LIMITS, check_settings, ranges, sun_direction, time_of_day
from skope.gen.towns.netconvert import from_map
from skope.gen.towns.road_graph import ROAD_LIMITS, RoadGraph
from skope.gen.towns.sites import Site, site_of, sites
from skope.gen.towns.town import Occluder, OwnRoad, PixelOutline, Town
from skope.gen.towns.town_style import style
from skope.gen.traffic import route_files
from skope.gen.traffic.demand import ways
from skope.records import TomlTable
from skope.site.gates_zones_lanes import read_occluder, read_outline
from skope.site.site_camera import read_site_camera
from skope.site.site_file import read_parts
from skope.types import Range

NAME_PATTERN: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9_]{0,39}")


@dataclass(frozen=True)
class SiteLimits:
    """Limits of a user's own site."""

    seen_within_m: float = 150.0
    """Distance within which the image of the camera must show at least one lane, metres."""
    highest_road_m: float = 5.0
    """Maximum distance of the road's height from 0, metres. Heights in a site file are relative to the road."""


SITE_LIMITS: Final = SiteLimits()

PHOTOGRAPH_CONDITIONS: Final[Mapping[str, Range]] = {
    "exposure_ev": (0.0, 0.0),
    "vignetting": (0.0, 0.0),
    "noise": (0.5, 1.5),
}
"""Ranges of the conditions of a site with a photograph, which already contains exposure, vignetting and noise."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OwnSite:
    """A user's own site, as described by its file."""

    path: Path
    site: Site
    splits: tuple[str, ...]
    """Split of each recording, in their order; empty if the file does not set them."""
    digests: Mapping[str, str]
    """Digests of the site file ("site") and of the files that it names, by their keys."""
    messages: tuple[str, ...]
    """Messages for the user about the site file."""

    @property
    def road(self) -> OwnRoad:
        assert self.site.road is not None
        return self.site.road

    def with_recordings(self, count: int) -> Self:
        """Return the site with `count` recordings; the last is in the split `test`, unless the file sets the splits."""
        return replace(self, splits=self.splits or ("train",) * max(1, count - 1) + ("test",))


def own_site(field: str, text: str) -> OwnSite | None:
    """Return the user's own site if `text` is a site file; None if it is the name of a site of the package.

    Raises:
        UserError: `text` names neither a site nor a file, or both; the message begins with `field`. Also as for
            `read_generation_site`.
    """
    path = Path(text)
    if text not in sites():
        if path.suffix != ".toml" and not path.is_file():
            raise UserError(f"{field}: expected a site file (.toml) or one of {', '.join(sites())}; got {text!r}")
        return read_generation_site(path)
    if path.is_file():
        raise UserError(f"{field}: {text} is both a site of the package and a file here; write ./{text} for the file")
    return None


def read_generation_site(path: Path) -> OwnSite:
    """Read and check a site file.

    Args:
        path: A TOML file (README, "Your own road"); files that it names are relative to its folder.

    Raises:
        UserError: A file cannot be read, or a key is missing, unknown or wrong; the message names file and key.
    """
    table = TomlTable.read(path)
    name = table.text("name", path.stem)
    if not NAME_PATTERN.fullmatch(name):
        raise table.wrong("name", f"expected up to 40 letters, digits and _, got {name!r}")
    background = table.file("background")
    picture = _picture_size(table, background)
    site_camera = read_site_camera(table.table("camera"), picture)
    camera = site_camera.camera
    if picture and abs(picture[0] * camera.height / (picture[1] * camera.width) - 1) > 0.01:
        raise table.wrong(
            "background",
            f"expected the aspect ratio of the camera ({camera.width}x{camera.height}), got {picture[0]}x{picture[1]}",
        )
    styled = table.file("style")
    road = OwnRoad(
        title=name,
        network=_network(table),
        style=read_text(styled) if styled else "",
        camera=camera,
        photograph=read_bytes(background) if background else b"",
    )
    graph = _checked_graph(table, road)
    level = graph.road_level(camera.position[:2])
    occluders = tuple(_occluder(row, camera, level) for row in table.tables("occluders"))
    shades = tuple(_shade(row, camera) for row in table.tables("shades"))
    if occluders or shades:
        if not background:
            raise table.wrong("occluders" if occluders else "shades", "need a photograph, but background is missing")
        road = replace(road, occluders=occluders, shades=shades)
    light = table.table("light")
    weather, hour, sun = _light(light)
    conditions = {**(PHOTOGRAPH_CONDITIONS if background else {}), **sun, **_conditions(table.table("conditions"))}
    vehicles, text = _traffic(table, road, graph)
    splits = _splits(table)
    parts = read_parts(table)
    table.done()
    site = site_of(
        road,
        split=splits[0] if splits else "train",
        vehicles_per_hour=vehicles,
        weather=weather,
        time_of_day=hour,
        conditions=conditions,
        flows=text,
    )
    files = {"site": path, **table.files}
    digests = {key: hashlib.sha256(read_bytes(file)).hexdigest()[:24] for key, file in files.items()}
    messages = (
        *([f"{path.name}: camera: {site_camera.said}"] if site_camera.said else []),
        *(f"{path.name}: {key}: unknown; not used" for key in parts.unknown),
    )
    return OwnSite(path=path, site=site, splits=splits, digests=digests, messages=messages)


# -------------------------------------------------------------------------------------------------------------- pieces


def _picture_size(table: TomlTable, path: Path | None) -> tuple[int, int] | None:
    if path is None:
        return None
    image = cv2.imdecode(np.frombuffer(read_bytes(path), dtype=np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise table.wrong("background", f"{path}: not a readable image")
    height, width = image.shape[:2]
    if min(width, height) < 16 or max(width, height) > 8192:
        raise table.wrong("background", f"{path}: is {width}x{height}, expected 16 to 8192 pixels")
    return width, height


def _network(table: TomlTable) -> bytes:
    path = table.file("network")
    if path is None:
        raise table.wrong("network", "missing")
    lefthand, height = table.flag("lefthand"), table.number("ground_height", 0.0)
    if path.name.endswith(".net.xml"):
        data = read_bytes(path)
        if lefthand or height:
            raise table.wrong("lefthand" if lefthand else "ground_height", "applies to maps (.osm, .xodr) only")
        return data
    suffixes = "".join(path.suffixes).lower()
    kind = "osm" if ".osm" in suffixes else "opendrive" if suffixes.endswith(".xodr") else ""
    if not kind:
        raise table.wrong("network", f"{path}: expected .net.xml (SUMO), .osm or .osm.xml (OpenStreetMap), .xodr")
    origin = _origin(table, path) if kind == "osm" else None
    try:
        return from_map(path, kind, origin, lefthand=lefthand, height=height).encode()
    except UserError as error:
        raise table.wrong("network", f"{path}: {error}") from None


def _origin(table: TomlTable, path: Path) -> tuple[float, float]:
    """Return latitude and longitude of the world's origin. Default: the middle of the map's nodes."""
    if "origin" in table:
        latitude, longitude = table.numbers("origin", 2)
        return latitude, longitude
    try:
        nodes = [(float(n.attrib["lat"]), float(n.attrib["lon"])) for n in ElementTree.parse(path).iter("node")]
    except (ElementTree.ParseError, KeyError, ValueError):
        nodes = []
    if not nodes:
        raise table.wrong("network", f"{path}: not an OpenStreetMap file with nodes")
    low, high = np.min(nodes, axis=0), np.max(nodes, axis=0)
    latitude, longitude = ((low + high) / 2).round(7).tolist()
    return latitude, longitude


def _occluder(row: TomlTable, camera: Camera, level: float) -> Occluder:
    mark = read_occluder(row)
    row.done()
    if mark.foot is None:
        assert mark.distance is not None
        return Occluder(mark.polygon, round(mark.distance, 3))
    rays, valid = camera.rays(mark.foot)
    down = float(rays @ camera.T_camera_world[:3, 2])
    distance = (level - camera.position[2]) / down if valid and down < 0 else math.inf
    if not distance < 2000:
        raise row.wrong("foot", "expected a pixel of the ground, within 2000 m")
    return Occluder(mark.polygon, round(distance, 3))


def _shade(table: TomlTable, camera: Camera) -> PixelOutline:
    """Return the outline of a shadow. Raises UserError if it is not completely on the ground."""
    outline = read_outline(table)
    table.done()
    rays, valid = camera.rays(outline)
    if not (valid & (rays @ camera.T_camera_world[:3, 2] < -1e-3)).all():
        raise table.wrong("polygon", "expected pixels of the ground, got some above the horizon")
    return outline


def _light(table: TomlTable) -> tuple[str, str, dict[str, Range]]:
    """Return weather, hour, and conditions that set the position of the sun; empty if its position is not known."""
    weather, sun = table.text("weather", "clear"), {}
    if "when" in table:
        when = table.value("when")
        if not isinstance(when, datetime) or when.tzinfo is None:
            raise table.wrong("when", "expected a time with its zone, like 2026-06-21T14:30:00+02:00")
        latitude, longitude = table.number("latitude", low=-90, high=90), table.number("longitude", low=-180, high=180)
        elevation, azimuth = sun_direction(when, latitude, longitude)
        low, high = CONDITION_LIMITS["sun_elevation_deg"]
        if not low <= elevation <= high:
            raise table.wrong("when", f"expected a sun elevation of {low:g} to {high:g} degrees, got {elevation:.1f}")
        if "time_of_day" in table:
            raise table.wrong("time_of_day", "follows from when; leave it out")
        hour = time_of_day(elevation, azimuth)
        sun = {"sun_elevation_deg": (elevation, elevation), "sun_azimuth_deg": (azimuth, azimuth)}
    else:
        hour = table.text("time_of_day", "noon")
    table.done()
    try:
        ranges(weather, hour)
    except UserError as error:
        raise table.wrong("", str(error)) from None
    return weather, hour, sun


def _conditions(table: TomlTable) -> dict[str, Range]:
    out = {}
    for name in CONDITION_LIMITS:
        if name in table:
            pair = isinstance(table.value(name), list)
            low, high = table.numbers(name, 2) if pair else (table.number(name),) * 2
            out[name] = low, high
    table.done()
    try:
        return check_settings(out)
    except UserError as error:
        raise table.wrong("", str(error).removeprefix("--set ")) from None


def _traffic(table: TomlTable, road: OwnRoad, graph: RoadGraph) -> tuple[float, str]:
    """Return the vehicles per hour, and the text of the route file; 0 or empty for the value that is not given."""
    path = table.file("flows")
    if path is None:
        seen = graph.seen_by(road.camera, SITE_LIMITS.seen_within_m)
        if all(seen.isdisjoint(edges) for edges, _ in ways(Town.of(road).network)):
            raise table.wrong("network", "no route across the network passes the camera; set flows")
        return table.number("vehicles_per_hour", low=1, high=1e5), ""
    if "vehicles_per_hour" in table:
        raise table.wrong("vehicles_per_hour", "flows already sets the traffic; leave vehicles_per_hour out")
    text = read_bytes(path).decode("utf-8-sig", errors="replace")
    try:
        route_files.streams(text, Town.of(road).network)
    except UserError as error:
        raise table.wrong("flows", f"{path}: {error}") from None
    return 0.0, text


def _splits(table: TomlTable) -> tuple[str, ...]:
    if "splits" not in table:
        return ()
    names = table.value("splits")
    if (
        not isinstance(names, list)
        or not names
        or not all(isinstance(n, str) and NAME_PATTERN.fullmatch(n) for n in names)
    ):
        raise table.wrong("splits", 'expected a list of names like ["train", "train", "test"]')
    return tuple(names)


# -------------------------------------------------------------------------------------------------------------- checks


def _checked_graph(table: TomlTable, road: OwnRoad) -> RoadGraph:
    """Return the graph of the road. Raises UserError if style, camera and road do not fit together."""
    camera = road.camera
    if camera.distortion.model != "none":
        try:
            pinhole_of(camera)
        except UserError as error:
            raise table.wrong("", str(error)) from None
    try:
        style(Town.of(road))
    except (TypeError, KeyError, ValueError) as error:
        raise table.wrong("style", str(error)) from None
    try:
        graph = RoadGraph.of(Town.of(road))
    except Exception as error:  # parsers raise various exceptions for files that are not networks
        raise table.wrong("network", f"not a SUMO network: {error}") from None
    if not graph.edges:
        x, y, _ = camera.position
        raise table.wrong(
            "network",
            f"no lane for cars within {ROAD_LIMITS.own_roads_within_m:g} m of the camera at x {x:.0f}, y {y:.0f}"
            f"{_span(graph)}",
        )
    level = graph.road_level(camera.position[:2])
    if abs(level) > SITE_LIMITS.highest_road_m:
        raise table.wrong(
            "network",
            f"expected a road at a height of about 0 m, got {level:.0f} m: set ground_height (maps), or run netconvert "
            f"with --offset.z {-level:.0f}; then give the camera's height over the road",
        )
    if camera.position[2] < level + 0.5:
        raise table.wrong(
            "camera",
            f"expected a height of at least {level + 0.5:.2f} m (0.5 m over the road), got {camera.position[2]:.2f} m",
        )
    if not graph.seen_by(camera, SITE_LIMITS.seen_within_m):
        raise table.wrong("camera", f"its image shows no lane of the network within {SITE_LIMITS.seen_within_m:g} m")
    return graph


def _span(graph: RoadGraph) -> str:
    x0, y0, x1, y1 = graph.net.getBoundary()
    if graph.mirrored:
        y0, y1 = -y1, -y0
    return f"; the network spans x {x0:.0f} to {x1:.0f}, y {y0:.0f} to {y1:.0f}"
