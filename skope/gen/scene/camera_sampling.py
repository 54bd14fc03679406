"""Sample the cameras of recordings, near a site's own camera or elsewhere in its town.

Near a site, height, pose and field of view vary around those of the site's camera. Elsewhere ("views"), the camera is
on a mast beside a road or above the road, and looks at a point on the road. Its zoom is set so that vehicles there have
a size that was sampled before. One of many candidate cameras is chosen; its probability depends on the vehicles that it
will see. Views of road that a test site's camera sees are always rejected: test roads are never used for training.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.scenery.houses import HOUSE_LIMITS
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import RoadGraph, driven, right_of
from skope.gen.towns.sites import Site, site_at, sites_of
from skope.gen.towns.town import Mast, Town
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
"""Limits of the ranges from which a camera is sampled.

Values with "by" in their name change those of the site (`zoom_by` is a factor on the focal length). The others replace
them (the height is above the road)."""


@dataclass(frozen=True)
class CameraSampling:
    """Settings for sampling cameras, and the minimum length of road that a camera must see."""

    tries: int = 500
    """Maximum number of cameras that are sampled until one sees enough road."""
    car_height_m: float = 1.5
    """Assumed height of a car, metres."""
    large_px: float = 24.0
    """Minimum height of a car on a lane for the lane to count as seen, pixels in an image of 1080 rows."""
    bridge_m: float = 12.0
    """Distance from a bridge's lanes within which a camera is taken to be on the bridge, metres."""
    least_road_m: float = 40.0
    """Minimum length of lanes that a camera must see, metres; or half of what the site's camera sees, if less."""
    candidates: int = 100
    """Number of candidate cameras that are sampled for each view."""
    empty_share: float = 0.06
    """Fraction of the views that are meant to show a road without vehicles."""
    enough_vehicles: float = 20.0
    """Mean number of vehicles in view above which more vehicles do not make a view more probable."""
    least_view_road_m: float = 8.0
    """Minimum length of lanes that a view must show, metres; a camera above one vehicle sees little more."""
    largest_vehicle: tuple[float, float] = (0.1, 0.7)
    """Default range of the height of the largest vehicle in a frame, as a fraction of the image height.

    It is sampled log-uniformly. A preset can set another range (`Variation.largest_vehicle`)."""
    largest_sigma: float = 0.3
    """Standard deviation of the logarithm of that height around the sampled value."""
    at_target: tuple[float, float] = (0.5, 1.0)
    """Range of the height of a car at the camera's target, relative to the sampled height of the largest vehicle."""
    at_vehicles_share: float = 0.8
    """Fraction of the candidate cameras that look at a vehicle. The others look at a random point on the road."""
    mast_aside_m: tuple[float, float] = (0.8, 9.0)
    """Range of the distance from the carriageway to a mast, metres."""
    seen_px: float = 16.0
    """Minimum height of a visible car, pixels in an image of 1080 rows."""
    car_extent_m: float = 3.0
    """Typical apparent length of a car seen from above, between its width and its length, metres."""
    steep_deg: float = 55.0
    """Downward pitch above which a camera hangs over the road (on a gantry, bridge or arm), degrees."""
    over_road_m: float = 6.0
    """Minimum height above the road of a camera that hangs over it, metres."""
    frame_step: int = 3
    """Frame stride when counting the vehicles in view."""
    house_distance_m: float = 3.0
    """Minimum distance from houses to the carriageway, metres."""
    above_ground_m: float = 2.5
    """Minimum height of a camera above the ground at its mast, metres."""


CAMERA_SAMPLING: Final = CameraSampling()


@dataclass(frozen=True)
class CameraRanges:
    """Image settings of a camera, and the ranges from which its parameters are sampled."""

    size: tuple[int, int]
    """Width and height of the image, pixels."""
    fov_deg: float
    """Horizontal field of view, degrees; used if `spans` has none."""
    distortion: Distortion | None
    """Distortion of the lens; None for no distortion, or for that of a user's own camera."""
    spans: Mapping[str, Range]
    """Ranges from which values are sampled, with the keys of `CAMERA_LIMITS`. Empty for a site's own camera."""


def check_ranges(spans: Mapping[str, Range]) -> None:
    """Raise a UserError if a range is not in `CAMERA_LIMITS`, or exceeds it."""
    for name, (low, high) in spans.items():
        least, most = CAMERA_LIMITS[name]
        if not least <= low <= high <= most:
            raise UserError(f"camera.{name}: expected a range within {least:g}..{most:g}, got {low:g}..{high:g}")


def sample_camera(site: Site, ranges: CameraRanges, rng: np.random.Generator) -> Camera:
    """Sample a camera on the site's mast that sees enough road.

    Args:
        site: The camera site.
        ranges: Ranges of the values, which are sampled uniformly.
        rng: Random generator.

    Raises:
        UserError: None of `CAMERA_SAMPLING.tries` cameras sees enough road.
    """
    spans = ranges.spans
    site_camera = site.camera(ranges.size, ranges.fov_deg, ranges.distortion)
    if not spans:
        return site_camera
    layout = Layout.of(site.town)
    lanes, level = np.concatenate(list(layout.graph.lane_points.values())), _level(layout, site)
    lowest = _lowest(layout.graph, site)
    enough = min(CAMERA_SAMPLING.least_road_m, road_seen(site_camera, lanes) / 2)
    for _ in range(CAMERA_SAMPLING.tries):
        values = {name: float(rng.uniform(*spans[name])) for name in CAMERA_LIMITS if name in spans}
        lens = site.camera(ranges.size, values.get("fov_deg", ranges.fov_deg), ranges.distortion)
        camera = moved(lens, values, level)
        if camera.position[2] >= lowest and road_seen(camera, lanes) >= enough:
            return camera
    raise UserError(f"{site.name}: none of {CAMERA_SAMPLING.tries} drawn cameras sees {enough:.0f} m of lanes")


def moved(camera: Camera, values: Mapping[str, float], level: float) -> Camera:
    """Return the camera with its height, pose or zoom changed.

    Args:
        camera: The camera.
        values: Some of the values in `CAMERA_LIMITS`, in their units.
        level: Height of the road in front of the camera, metres.
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
    """Return the height of the road that the site's camera looks at, metres."""
    return layout.graph.road_level(site.position[:2]) if site.road else layout.road_below(site)


def _lowest(graph: RoadGraph, site: Site) -> float:
    """Return the minimum height of the site's camera, metres: its own height on a bridge, minus infinity elsewhere."""
    decks = [graph.lane_points[str(edge.getID())] for edge in graph.edges_of("bridge")]
    x, y, z = site.position
    under = [
        points for points in decks if (np.hypot(points[:, 0] - x, points[:, 1] - y) < CAMERA_SAMPLING.bridge_m).any()
    ]
    return z if under else -math.inf


def road_seen(camera: Camera, lanes: Array) -> float:
    """Return the length of lanes, metres, on which cars would be large enough in the image.

    The lanes are points (N, 3), one per metre, world.
    """
    pixels, depth, valid = camera.project(lanes)
    high = camera.K[1, 1] * CAMERA_SAMPLING.car_height_m >= CAMERA_SAMPLING.large_px * camera.height / 1080 * depth
    return float((valid & camera.inside(pixels) & high).sum())


_TESTED_M, _TESTED_DEG = 80.0, 75.0
"""Maximum distance (metres), and angle to either side of its axis (degrees), of road that a test camera sees."""


def check_largest_vehicle(span: Range) -> None:
    """Raise a UserError unless a range contains only fractions of the image height, above 0 and up to 1."""
    low, high = span
    if not 0 < low <= high <= 1:
        raise UserError(f"largest_vehicle: expected a range above 0 and up to 1, got {low:g}..{high:g}")


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera and its mast."""

    mast: Mast
    camera: Camera


class ViewSampler:
    """Sampler of cameras at random places in a town."""

    def __init__(self, town: Town) -> None:
        self._layout = Layout.of(town)
        graph = self._layout.graph
        self._lanes = np.concatenate(list(graph.lane_points.values()))
        """(N, 3) points of all lanes, one per metre, world."""
        self._tested = tested_road(town, self._lanes)
        self._starts, self._headings = self._roadside()
        self._open = graph.road.buffer(CAMERA_SAMPLING.house_distance_m)
        """Area that is free of houses."""
        for region in (graph.road, self._open):
            shapely.prepare(region)

    def _roadside(self) -> tuple[Array, Array]:
        """Return points (M, 3) of ground-level lanes that a mast can stand beside, world, and their headings (M,)."""
        graph, points, headings = self._layout.graph, [], []
        for edge in graph.edges_of("ground"):
            for lane in driven(edge):
                line = graph.world(np.array(lane.getShape3D()))
                for a, b in itertools.pairwise(line):
                    count = max(1, round(float(np.linalg.norm(b - a)) / 4))
                    points += [a + (b - a) * (k + 0.5) / count for k in range(count)]
                    headings += [math.atan2(b[1] - a[1], b[0] - a[0])] * count
        return np.array(points), np.array(headings)

    def draw(
        self,
        traffic: Array,
        ranges: CameraRanges,
        rng: np.random.Generator,
        largest_vehicle: Range = CAMERA_SAMPLING.largest_vehicle,
    ) -> PlacedCamera:
        """Sample a camera at a random place in the town, which sees road and mostly vehicles.

        Args:
            traffic: (F, V, 3) positions of vehicles on the road in each frame, world; NaN if absent.
            ranges: Ranges from which the camera's parameters are sampled.
            rng: Random generator.
            largest_vehicle: Range from which the height of the largest vehicle is sampled, as a fraction of the image
                height.

        Raises:
            UserError: No candidate camera sees enough road without seeing road of a test site.
        """
        empty = rng.random() < CAMERA_SAMPLING.empty_share
        wanted = math.exp(rng.uniform(*np.log(largest_vehicle)))
        vehicles = traffic[np.isfinite(traffic[..., 0])]
        found: list[tuple[PlacedCamera, float]] = []
        for _ in range(CAMERA_SAMPLING.candidates):
            view = self._candidate(vehicles, wanted, ranges, rng)
            if (
                view is None
                or road_seen(view.camera, self._lanes) < CAMERA_SAMPLING.least_view_road_m
                or self.shows_tested_road(view.camera)
            ):
                continue
            seen, largest = self.vehicles_seen(view.camera, traffic)
            if empty or seen < 0.1:
                weight = float(
                    empty and seen < 0.1 and self.road_in_the_open(view.camera) >= CAMERA_SAMPLING.least_view_road_m
                )
            else:
                weight = min(seen, CAMERA_SAMPLING.enough_vehicles) * math.exp(
                    -0.5 * (math.log(largest / wanted) / CAMERA_SAMPLING.largest_sigma) ** 2
                )
            found.append((view, weight))
        if not found:
            raise UserError(
                f"none of {CAMERA_SAMPLING.candidates} drawn cameras sees "
                f"{CAMERA_SAMPLING.least_view_road_m:.0f} m of road outside the view of test sites"
            )
        weights = np.array([weight for _, weight in found])
        if not weights.any():
            weights = np.ones(len(found))
        return found[int(rng.choice(len(found), p=weights / weights.sum()))][0]

    def vehicles_seen(self, camera: Camera, traffic: Array) -> tuple[float, float]:
        """Compute the mean number of vehicles that a camera sees per frame, and the mean height of the largest one.

        Args:
            camera: The camera.
            traffic: (F, V, 3) positions of vehicles in each frame, world, metres; NaN if absent.

        Returns:
            Mean number, and mean height as a fraction of the image height. Frames without visible vehicles are left out
            of the mean height.
        """
        frames = traffic[:: CAMERA_SAMPLING.frame_step]
        frame, column = np.nonzero(np.isfinite(frames[..., 0]))
        places = frames[frame, column] + [0.0, 0.0, CAMERA_SAMPLING.car_height_m / 2]
        if not len(places):
            return 0.0, 0.0
        pixels, _, valid = camera.project(places)
        share = _apparent_height(camera.position, places) * camera.K[1, 1] / camera.height
        seen = valid & camera.inside(pixels) & (share > CAMERA_SAMPLING.seen_px / 1080)
        seen[seen] = self._in_the_open(camera.position, places[seen])
        largest = np.zeros(len(frames))
        np.maximum.at(largest, frame[seen], share[seen])
        return float(seen.sum() / len(frames)), float(largest[largest > 0].mean()) if seen.any() else 0.0

    def road_in_the_open(self, camera: Camera) -> float:
        """Return the length of lanes, metres, in a camera's image that no house can hide."""
        pixels, _, valid = camera.project(self._lanes)
        shown = self._lanes[valid & camera.inside(pixels)]
        return float(self._in_the_open(camera.position, shown).sum()) if len(shown) else 0.0

    def _in_the_open(self, eye: Array, places: Array) -> NDArray[np.bool_]:
        """Return for each of the places (N, 3) whether it is certain that no house hides it.

        Houses keep clear of roads and of the camera.
        """
        along = np.linspace(0.1, 0.9, 9)[:, None, None]
        points = eye[:2] + along * (places[:, :2] - eye[:2])
        near = np.hypot(*np.moveaxis(points - eye[:2], -1, 0)) < HOUSE_LIMITS.open_view_m
        x, y = np.moveaxis(self._layout.graph.world(points), -1, 0)
        return np.asarray((near | shapely.contains_xy(self._open, x, y)).all(axis=0))

    def shows_tested_road(self, camera: Camera) -> bool:
        """Return whether a camera's image contains road that a test site's camera sees."""
        pixels, _, valid = camera.project(self._lanes[self._tested])
        return bool((valid & camera.inside(pixels)).any())

    def _candidate(
        self, traffic: Array, wanted: float, ranges: CameraRanges, rng: np.random.Generator
    ) -> PlacedCamera | None:
        """Return a camera that looks at a vehicle or a point on the road; None if there is no room for it.

        If the field of view can be chosen, it is set so that a car at the target fills about `wanted` of the image
        height.
        """
        spans = ranges.spans

        def value(name: str, default: float) -> float:
            return float(rng.uniform(*spans[name])) if name in spans else default

        height = value("height_m", 6.0)
        low, high = spans.get("pitch_deg", (10.0, 40.0))
        # Most cameras look ahead; few look down.
        pitch = low + (high - low) * float(rng.beta(1.2, 2.4))
        among = traffic if len(traffic) and rng.random() < CAMERA_SAMPLING.at_vehicles_share else self._lanes
        target = among[rng.integers(len(among))]
        if pitch > CAMERA_SAMPLING.steep_deg:
            height = max(height, CAMERA_SAMPLING.over_road_m)
        distance = height / math.tan(math.radians(max(pitch, 3.0)))
        position = (
            self._over(target, distance, rng)
            if pitch > CAMERA_SAMPLING.steep_deg
            else self._away(target, distance, rng)
        )
        if position is None:
            return None
        x, y, level = position.tolist()
        z = max(
            level + height, self._layout.height(self._layout.graph.world(position[:2])) + CAMERA_SAMPLING.above_ground_m
        )
        fov = ranges.fov_deg
        if "fov_deg" in spans:
            high_m = float(_apparent_height(np.array([x, y, z]), target[None])[0])
            width = high_m / (wanted * rng.uniform(*CAMERA_SAMPLING.at_target)) * ranges.size[0] / ranges.size[1]
            fov = float(np.clip(math.degrees(2 * math.atan(width / 2)), *spans["fov_deg"]))
        yaw = math.degrees(math.atan2(target[1] - y, target[0] - x)) + value("yaw_by_deg", 0.0)
        mast = Mast((round(x, 3), round(y, 3), round(z, 3)), round(yaw, 3), round(pitch, 3))
        camera = site_at(mast, Town("view"), "view").camera(ranges.size, fov, ranges.distortion)
        return PlacedCamera(mast, moved(camera, {"roll_by_deg": value("roll_by_deg", 0.0)}, level))

    def _away(self, target: Array, distance: float, rng: np.random.Generator) -> Array | None:
        """Return a position (3,) beside a carriageway, about `distance` metres from the target (3,), or None."""
        away = np.hypot(*(self._starts[:, :2] - target[:2]).T)
        near = np.flatnonzero(np.abs(away - distance) < max(4.0, 0.3 * distance))
        return self._beside(int(rng.choice(near)), rng) if len(near) else None

    def _over(self, target: Array, distance: float, rng: np.random.Generator) -> Array | None:
        """Return a position (3,) at `distance` metres from the target (3,), or None if a house could be there."""
        angle = rng.uniform(0, 2 * math.pi)
        at = target[:2] - distance * np.array([math.cos(angle), math.sin(angle)])
        free = shapely.contains_xy(self._open, *self._layout.graph.world(at))
        return np.array([*at, target[2]]) if free else None

    def _beside(self, start: int, rng: np.random.Generator) -> Array | None:
        """Return a position (3,) beside the carriageway next to a point of `_starts`, at road height, or None."""
        across = right_of(float(self._headings[start])) * (1 if rng.random() < 0.7 else -1)
        aside = float(rng.uniform(*CAMERA_SAMPLING.mast_aside_m))
        graph = self._layout.graph
        for beyond in np.arange(2.0, 26.0, 1.0):
            at = self._starts[start, :2] + across * beyond
            if not shapely.contains_xy(graph.road, *graph.world(at)):
                at = at + across * aside
                inside = shapely.contains_xy(graph.road, *graph.world(at))
                return None if inside else np.array([*at, self._starts[start, 2]])
        return None


def _apparent_height(eye: Array, places: Array) -> Array:
    """Return the apparent heights (N,) of cars at places (N, 3) seen from `eye` (3,), as fractions of the distance."""
    away = eye - places
    distance = np.maximum(np.linalg.norm(away, axis=1), 0.1)
    steep = np.clip(away[:, 2] / distance, -1.0, 1.0)
    return np.asarray(
        (CAMERA_SAMPLING.car_height_m * np.sqrt(1 - steep**2) + CAMERA_SAMPLING.car_extent_m * np.abs(steep)) / distance
    )


def tested_road(town: Town, lanes: Array) -> NDArray[np.bool_]:
    """Return a mask (N,) of the lane points (N, 3) of a town that the cameras of its test sites look at."""
    out = np.zeros(len(lanes), dtype=bool)
    for site in sites_of(Town(town.name, town.road)):
        if site.split != "train":
            east, north = (lanes[:, :2] - site.position[:2]).T
            aside = np.degrees(np.arctan2(north, east)) - site.yaw_deg
            aside = np.abs((aside + 180) % 360 - 180)
            away = np.hypot(east, north)
            out |= (away < _TESTED_M) & ((aside < _TESTED_DEG) | (away < 5.0))
    return out
