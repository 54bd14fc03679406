"""Draw the cameras of recordings at random: height, pose and field of view near those of a site; or at other corners of
its town, by the road and the traffic that they see.

At other corners a mast stands beside a road, or a camera hangs over it; it looks at a place on the road, and its zoom
is set so that vehicles there have a size that is drawn first. Of many cameras, one is taken with a probability that
follows from the vehicles that it will see. Views that show road before a camera of a test site are never taken: what is
tested on is not learnt from.
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
"""Ranges that a camera can be drawn by: in place of the site's (height over the road), or added to it (`zoom_by` is a
factor on the focal length)."""


@dataclass(frozen=True)
class CameraSampling:
    """How cameras are drawn, and what they must see."""

    tries: int = 500
    """Cameras that are drawn until one sees enough road."""
    car_height_m: float = 1.5
    """Height of a car, metres."""
    large_px: float = 24.0
    """A lane is seen where a car is so high in an image of 1080 rows, pixels."""
    bridge_m: float = 12.0
    """A camera nearer to a bridge's lanes than this hangs on the bridge, metres."""
    least_road_m: float = 40.0
    """Least length of lanes that a camera must see, metres; or half of what the site's own sees, if that is less."""
    candidates: int = 100
    """Cameras that are drawn for each view."""
    empty_share: float = 0.06
    """Share of the views that are to show a road without vehicles."""
    enough_vehicles: float = 20.0
    """Vehicles in view on average, from which more of them make a view no more likely."""
    least_view_road_m: float = 8.0
    """Least length of lanes that a view must show, metres: a camera over a single vehicle sees little more."""
    largest_vehicle: tuple[float, float] = (0.1, 0.7)
    """Default range of the height of the largest vehicle in a frame, as a share of the image's; drawn evenly in its
    logarithm. A preset may choose another (`Variation.largest_vehicle`)."""
    largest_sigma: float = 0.3
    """Standard deviation of the logarithm of that height around what is wanted."""
    at_target: tuple[float, float] = (0.5, 1.0)
    """Range of the height of a car where the camera looks, as a share of what is wanted of the largest."""
    at_vehicles_share: float = 0.8
    """Share of the cameras drawn that look at a vehicle; the others look at any place on the road."""
    mast_aside_m: tuple[float, float] = (0.8, 9.0)
    """Range of the distance from the carriageway to a mast, metres."""
    seen_px: float = 16.0
    """Height of a car in an image of 1080 rows from which it counts as seen, pixels."""
    car_extent_m: float = 3.0
    """Typical apparent length of a car, between its width and its length, metres."""
    steep_deg: float = 55.0
    """Cameras that look down more steeply hang over the road, on a gantry, a bridge or an arm."""
    over_road_m: float = 6.0
    """Least height over the road of a camera that hangs above it, metres."""
    frame_step: int = 3
    """One frame of this many is examined to count vehicles."""
    house_distance_m: float = 3.0
    """No house stands nearer to the carriageway than this, metres."""
    above_ground_m: float = 2.5
    """Least height of a camera over the ground that its mast stands on, metres."""


CAMERA_SAMPLING: Final = CameraSampling()


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
        UserError: None of `CAMERA_SAMPLING.tries` cameras sees enough road.
    """
    spans = ranges.spans
    own = site.camera(ranges.size, ranges.fov_deg, ranges.distortion)
    if not spans:
        return own
    layout = Layout.of(site.town)
    lanes, level = np.concatenate(list(layout.graph.lane_points.values())), _level(layout, site)
    lowest = _lowest(layout.graph, site)
    enough = min(CAMERA_SAMPLING.least_road_m, road_seen(own, lanes) / 2)
    for _ in range(CAMERA_SAMPLING.tries):
        values = {name: float(rng.uniform(*spans[name])) for name in CAMERA_LIMITS if name in spans}
        lens = site.camera(ranges.size, values.get("fov_deg", ranges.fov_deg), ranges.distortion)
        camera = moved(lens, values, level)
        if camera.position[2] >= lowest and road_seen(camera, lanes) >= enough:
            return camera
    raise UserError(f"{site.name}: of {CAMERA_SAMPLING.tries} cameras drawn none sees {enough:.0f} m of lanes")


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
    under = [
        points for points in decks if (np.hypot(points[:, 0] - x, points[:, 1] - y) < CAMERA_SAMPLING.bridge_m).any()
    ]
    return z if under else -math.inf


def road_seen(camera: Camera, lanes: Array) -> float:
    """Metres of lanes, given as points (N, 3) at every metre, in which cars are large enough in the image."""
    pixels, depth, valid = camera.project(lanes)
    high = camera.K[1, 1] * CAMERA_SAMPLING.car_height_m >= CAMERA_SAMPLING.large_px * camera.height / 1080 * depth
    return float((valid & camera.inside(pixels) & high).sum())


_TESTED_M, _TESTED_DEG = 80.0, 75.0
"""Road belongs to a test site's camera up to this distance, and this angle to either side of where it looks."""


def check_largest_vehicle(span: Range) -> None:
    """UserError where a range is none of shares of an image's height, above 0 and up to 1."""
    low, high = span
    if not 0 < low <= high <= 1:
        raise UserError(f"largest_vehicle: expected a range of shares above 0, up to 1, got {low:g}..{high:g}")


@dataclass(frozen=True, eq=False)
class PlacedCamera:
    """A camera and the mast that it hangs on."""

    mast: Mast
    camera: Camera


class ViewSampler:
    """Draws views of a town."""

    def __init__(self, town: Town) -> None:
        self._layout = Layout.of(town)
        graph = self._layout.graph
        self._lanes = np.concatenate(list(graph.lane_points.values()))
        """(N, 3) points of all lanes, one at every metre, world."""
        self._tested = tested_road(town, self._lanes)
        self._starts, self._headings = self._roadside()
        self._open = graph.road.buffer(CAMERA_SAMPLING.house_distance_m)
        """Places where no house stands."""
        for region in (graph.road, self._open):
            shapely.prepare(region)

    def _roadside(self) -> tuple[Array, Array]:
        """Points (M, 3) of lanes on the ground that masts may stand beside, world, and headings (M,) there."""
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
        """Draw a view.

        Args:
            traffic: (F, V, 3) places of vehicles on the road in each frame, world; NaN where there is none.
            ranges: What cameras are drawn from.
            rng: Draws.
            largest_vehicle: Range of the largest vehicle's height, as `CAMERA_SAMPLING.largest_vehicle`.

        Raises:
            UserError: No camera was found that sees enough road and none of a test site's.
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
                f"of {CAMERA_SAMPLING.candidates} cameras drawn none sees "
                f"{CAMERA_SAMPLING.least_view_road_m:.0f} m of road that is not tested on"
            )
        weights = np.array([weight for _, weight in found])
        if not weights.any():
            weights = np.ones(len(found))
        return found[int(rng.choice(len(found), p=weights / weights.sum()))][0]

    def vehicles_seen(self, camera: Camera, traffic: Array) -> tuple[float, float]:
        """Mean number of vehicles that a camera sees in a frame, and the mean height of the largest among them.

        Args:
            camera: The camera.
            traffic: (F, V, 3) as `draw` takes it.

        Returns:
            The number, and the height as a share of the image's; frames in which nothing is seen do not count for it.
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
        """Metres of lanes in a camera's image that no house hides."""
        pixels, _, valid = camera.project(self._lanes)
        shown = self._lanes[valid & camera.inside(pixels)]
        return float(self._in_the_open(camera.position, shown).sum()) if len(shown) else 0.0

    def _in_the_open(self, eye: Array, places: Array) -> NDArray[np.bool_]:
        """To which of the places (N, 3) no house can stand in the way: houses keep off roads, and off what is near."""
        along = np.linspace(0.1, 0.9, 9)[:, None, None]
        points = eye[:2] + along * (places[:, :2] - eye[:2])
        near = np.hypot(*np.moveaxis(points - eye[:2], -1, 0)) < HOUSE_LIMITS.open_view_m
        x, y = np.moveaxis(self._layout.graph.world(points), -1, 0)
        return np.asarray((near | shapely.contains_xy(self._open, x, y)).all(axis=0))

    def shows_tested_road(self, camera: Camera) -> bool:
        """Whether a camera has road in its image that a test site's camera looks at."""
        pixels, _, valid = camera.project(self._lanes[self._tested])
        return bool((valid & camera.inside(pixels)).any())

    def _candidate(
        self, traffic: Array, wanted: float, ranges: CameraRanges, rng: np.random.Generator
    ) -> PlacedCamera | None:
        """A camera that looks at a vehicle or a place on the road; None where there is no room for one.

        Where its field of view can be chosen, it is that in which a car there is about `wanted` of the image high.
        """
        spans = ranges.spans

        def value(name: str, default: float) -> float:
            return float(rng.uniform(*spans[name])) if name in spans else default

        height = value("height_m", 6.0)
        low, high = spans.get("pitch_deg", (10.0, 40.0))
        # Most cameras look ahead, few look down.
        pitch = low + (high - low) * float(rng.beta(1.2, 2.4))
        among = traffic if len(traffic) and rng.random() < CAMERA_SAMPLING.at_vehicles_share else self._lanes
        target = among[rng.integers(len(among))]
        if pitch > CAMERA_SAMPLING.steep_deg:
            height = max(height, CAMERA_SAMPLING.over_road_m)
        distance = height / math.tan(math.radians(max(pitch, 3.0)))
        place = (
            self._over(target, distance, rng)
            if pitch > CAMERA_SAMPLING.steep_deg
            else self._away(target, distance, rng)
        )
        if place is None:
            return None
        x, y, level = place.tolist()
        z = max(
            level + height, self._layout.height(self._layout.graph.world(place[:2])) + CAMERA_SAMPLING.above_ground_m
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
        """A place (3,) beside a carriageway, about as far from a place (3,) as `distance`, in metres."""
        away = np.hypot(*(self._starts[:, :2] - target[:2]).T)
        there = np.flatnonzero(np.abs(away - distance) < max(4.0, 0.3 * distance))
        return self._beside(int(rng.choice(there)), rng) if len(there) else None

    def _over(self, target: Array, distance: float, rng: np.random.Generator) -> Array | None:
        """A place (3,) at that distance from a place (3,), over the road or before the houses, metres."""
        angle = rng.uniform(0, 2 * math.pi)
        at = target[:2] - distance * np.array([math.cos(angle), math.sin(angle)])
        free = shapely.contains_xy(self._open, *self._layout.graph.world(at))
        return np.array([*at, target[2]]) if free else None

    def _beside(self, start: int, rng: np.random.Generator) -> Array | None:
        """A place (3,) beside the carriageway next to a point of `_starts`, at the road's height, world."""
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
    """(N,) height of a car at each of the places (N, 3) as seen from `eye` (3,), as a share of its distance."""
    away = eye - places
    distance = np.maximum(np.linalg.norm(away, axis=1), 0.1)
    steep = np.clip(away[:, 2] / distance, -1.0, 1.0)
    return np.asarray(
        (CAMERA_SAMPLING.car_height_m * np.sqrt(1 - steep**2) + CAMERA_SAMPLING.car_extent_m * np.abs(steep)) / distance
    )


def tested_road(town: Town, lanes: Array) -> NDArray[np.bool_]:
    """Mask of those of the points (N, 3) on a town's lanes that the cameras of its test sites look at."""
    out = np.zeros(len(lanes), dtype=bool)
    for site in sites_of(Town(town.name, town.road)):
        if site.split != "train":
            east, north = (lanes[:, :2] - site.position[:2]).T
            aside = np.degrees(np.arctan2(north, east)) - site.yaw_deg
            aside = np.abs((aside + 180) % 360 - 180)
            away = np.hypot(east, north)
            out |= (away < _TESTED_M) & ((aside < _TESTED_DEG) | (away < 5.0))
    return out
