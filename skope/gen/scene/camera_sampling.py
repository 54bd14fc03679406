"""Draw a recording's camera at random: height, pose and field of view, near those of its site."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.sites import Site
from skope.types import Array, Range

CAMERA_LIMITS: Final[Mapping[str, Range]] = {
    "fov_deg": (5.0, 150.0),
    "height_m": (2.0, 60.0),
    "pitch_deg": (-5.0, 90.0),
    "zoom_by": (0.2, 5.0),
    "height_by_m": (-10.0, 10.0),
    "pitch_by_deg": (-45.0, 45.0),
    "yaw_by_deg": (-180.0, 180.0),
    "roll_by_deg": (-45.0, 45.0),
}
"""Ranges that a camera can be drawn by: in place of the site's (height over the road), or added to it (`zoom_by` is a
factor on the focal length)."""
_TRIES: Final = 500
"""Cameras that are drawn until one sees enough road."""
CAR: Final = 1.5
"""Height of a car, metres."""
_LARGE: Final = 24.0
"""A lane is seen where a car is so high in an image of 1080 rows, pixels."""
_BRIDGE: Final = 12.0
"""A camera nearer to a bridge's lanes than this hangs on the bridge, metres."""
LEAST_ROAD_M: Final = 40.0
"""Least length of lanes that a camera must see, metres; or half of what the site's own sees, if that is less."""


@dataclass(frozen=True)
class CameraRanges:
    """Ranges that cameras are drawn from."""

    size: tuple[int, int]
    """Width and height of the image, pixels."""
    fov_deg: float
    """Horizontal field of view where `spans` has none."""
    distortion: Distortion | None
    """That of the lens; None for none, or that of a user's own camera."""
    spans: Mapping[str, Range]
    """Ranges of `CAMERA_LIMITS`, from which values are drawn; empty for a site's own camera."""


def check_ranges(spans: Mapping[str, Range]) -> None:
    """UserError when a range is not one of `CAMERA_LIMITS`, or beyond it."""
    for name, (low, high) in spans.items():
        least, most = CAMERA_LIMITS[name]
        if not least <= low <= high <= most:
            raise UserError(f"camera.{name}: expected a range within {least:g}..{most:g}, got {low:g}..{high:g}")


def sample_camera(site: Site, ranges: CameraRanges, rng: np.random.Generator) -> Camera:
    """Draw a camera on the site's mast that sees enough road.

    Args:
        site: The camera site.
        ranges: What is drawn evenly.
        rng: Draws.

    Raises:
        UserError: None of `_TRIES` cameras sees enough road.
    """
    spans = ranges.spans
    own = site.camera(ranges.size, ranges.fov_deg, ranges.distortion)
    if not spans:
        return own
    layout = Layout.of(site.town)
    lanes, level = np.concatenate(list(layout.graph.lane_points.values())), _level(layout, site)
    lowest = _lowest(layout.graph, site)
    enough = min(LEAST_ROAD_M, road_seen(own, lanes) / 2)
    for _ in range(_TRIES):
        values = {name: float(rng.uniform(*spans[name])) for name in CAMERA_LIMITS if name in spans}
        lens = site.camera(ranges.size, values.get("fov_deg", ranges.fov_deg), ranges.distortion)
        camera = moved(lens, values, level)
        if camera.position[2] >= lowest and road_seen(camera, lanes) >= enough:
            return camera
    raise UserError(f"{site.name}: of {_TRIES} cameras drawn none sees {enough:.0f} m of lanes")


def moved(camera: Camera, values: Mapping[str, float], level: float) -> Camera:
    """A camera that hangs, turns or zooms otherwise.

    Args:
        camera: The camera.
        values: Some of the values of `CAMERA_LIMITS`, in their units.
        level: Height of the road before the camera, metres.
    """
    x, y, z = camera.position.tolist()
    yaw, pitch_down, roll = camera.angles
    pitch = values.get("pitch_deg", math.degrees(pitch_down)) + values.get("pitch_by_deg", 0.0)
    pose = Camera.looking(
        (x, y, (level + values["height_m"] if "height_m" in values else z) + values.get("height_by_m", 0.0)),
        yaw=yaw + math.radians(values.get("yaw_by_deg", 0.0)),
        pitch_down=math.radians(pitch),
        roll=roll + math.radians(values.get("roll_by_deg", 0.0)),
    )
    zoom = values.get("zoom_by", 1.0)
    return replace(camera, K=camera.K * [[zoom, zoom, 1], [1, zoom, 1], [1, 1, 1]], T_camera_world=pose.T_camera_world)


def _level(layout: Layout, site: Site) -> float:
    """Height of the road that the site looks at, metres."""
    return layout.graph.road_level(site.position[:2]) if site.road else layout.road_below(site)


def _lowest(graph: RoadGraph, site: Site) -> float:
    """Height that a camera on a bridge keeps to: that of its parapet; elsewhere it may hang at any, metres."""
    decks = [graph.lane_points[str(edge.getID())] for edge in graph.edges_of("bridge")]
    x, y, z = site.position
    under = [points for points in decks if (np.hypot(points[:, 0] - x, points[:, 1] - y) < _BRIDGE).any()]
    return z if under else -math.inf


def road_seen(camera: Camera, lanes: Array) -> float:
    """Metres of lanes, given as points (N, 3) at every metre, in which cars are large enough in the image."""
    pixels, depth, valid = camera.project(lanes)
    high = camera.K[1, 1] * CAR >= _LARGE * camera.height / 1080 * depth
    return float((valid & camera.inside(pixels) & high).sum())
