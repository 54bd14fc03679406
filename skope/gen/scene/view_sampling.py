"""Choose cameras at other corners of a town, by the road and the traffic that they see.

A mast stands beside a road; its camera looks at a place on the road. Of many that are drawn, one is taken with a
probability that follows from the vehicles that it will see. Views that show road before a camera of a test site are
never taken: what is tested on is not learnt from.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import shapely
from numpy.typing import NDArray

from skope.camera import Camera, Distortion
from skope.errors import UserError
from skope.gen.scene.camera_sampling import CAR, ROAD, moved, road_seen
from skope.gen.scene.conditions import Range
from skope.gen.scenery.houses import SIGHT
from skope.gen.towns.layout import Layout
from skope.gen.towns.road_graph import driven, right_of
from skope.gen.towns.sites import site_at, sites_of
from skope.gen.towns.town import Mast, Town
from skope.types import Array

CANDIDATES: Final = 100
"""Cameras that are drawn for each view."""
EMPTY_SHARE: Final = 0.06
"""Share of the views that are to show a road without vehicles."""
ENOUGH: Final = 20.0
"""Vehicles in view on average, from which more of them make a view no more likely."""
NEAR_WEIGHT: Final = 4.0
"""How many distant vehicles a near one counts for."""
AT_VEHICLES: Final = 0.8
"""Share of the cameras drawn that look at a vehicle; the others look at any place on the road."""
_ASIDE: Final = (0.8, 9.0)
"""Range of the distance from the carriageway to a mast, metres."""
_SEEN_PX: Final = 16.0
"""Height of a car in an image of 1080 rows from which it counts as seen, pixels."""
_NEAR_SHARE: Final = 0.15
"""A vehicle is near where a car is higher than this share of the image."""
_EVERY: Final = 3
"""Of as many frames, one is looked at to count vehicles."""
_FRONTS: Final = 3.0
"""No house stands nearer to the carriageway than this, metres."""
_TESTED_M, _TESTED_DEG = 80.0, 75.0
"""Road belongs to a test site's camera up to this distance, and this angle to either side of where it looks."""
_ABOVE_GROUND: Final = 2.5
"""Least height of a camera over the ground that its mast stands on, metres."""


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
        self._open = graph.road.buffer(_FRONTS)
        """Where no house stands."""
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
        size: tuple[int, int],
        fov_deg: float,
        distortion: Distortion | None,
        spans: Mapping[str, Range],
        rng: np.random.Generator,
    ) -> PlacedCamera:
        """Draw a view.

        Args:
            traffic: (F, V, 3) places of vehicles on the road in each frame, world; NaN where there is none.
            size: Width and height of the image, pixels.
            fov_deg: Horizontal field of view where `spans` has none.
            distortion: That of the lens.
            spans: Ranges of `camera_sampling.LIMITS`.
            rng: Draws.

        Raises:
            UserError: No camera was found that sees enough road and none of a test site's.
        """
        empty = rng.random() < EMPTY_SHARE
        vehicles = traffic[np.isfinite(traffic[..., 0])]
        found: list[tuple[PlacedCamera, float]] = []
        for _ in range(CANDIDATES):
            view = self._candidate(vehicles, size, fov_deg, distortion, spans, rng)
            if view is None or road_seen(view.camera, self._lanes) < ROAD or self.shows_tested_road(view.camera):
                continue
            seen, near = self.vehicles_seen(view.camera, traffic)
            weight = float(seen < 0.1) if empty else (min(seen, ENOUGH) + NEAR_WEIGHT * near) ** 1.5 * (seen >= 1)
            found.append((view, weight))
        if not found:
            raise UserError(f"of {CANDIDATES} cameras drawn none sees {ROAD:.0f} m of road that is not tested on")
        weights = np.array([weight for _, weight in found])
        if not weights.any():
            weights = np.ones(len(found))
        return found[int(rng.choice(len(found), p=weights / weights.sum()))][0]

    def vehicles_seen(self, camera: Camera, traffic: Array) -> tuple[float, float]:
        """Mean number of vehicles that a camera sees in a frame, and of near ones among them.

        Args:
            camera: The camera.
            traffic: (F, V, 3) as `draw` takes it.
        """
        frames = traffic[::_EVERY]
        places = frames[np.isfinite(frames[..., 0])] + [0.0, 0.0, CAR / 2]
        if not len(places):
            return 0.0, 0.0
        pixels, depth, valid = camera.project(places)
        rows = camera.K[1, 1] * CAR / np.maximum(depth, 0.1)
        seen = valid & camera.inside(pixels) & (rows > _SEEN_PX * camera.height / 1080)
        seen[seen] = self._in_the_open(camera.position, places[seen])
        near = seen & (rows > _NEAR_SHARE * camera.height)
        return float(seen.sum() / len(frames)), float(near.sum() / len(frames))

    def _in_the_open(self, eye: Array, places: Array) -> NDArray[np.bool_]:
        """To which of the places (N, 3) no house can stand in the way: houses keep off roads, and off what is near."""
        along = np.linspace(0.1, 0.9, 9)[:, None, None]
        points = eye[:2] + along * (places[:, :2] - eye[:2])
        near = np.hypot(*np.moveaxis(points - eye[:2], -1, 0)) < SIGHT
        x, y = np.moveaxis(self._layout.graph.world(points), -1, 0)
        return np.asarray((near | shapely.contains_xy(self._open, x, y)).all(axis=0))

    def shows_tested_road(self, camera: Camera) -> bool:
        """Whether a camera has road in its image that a test site's camera looks at."""
        pixels, _, valid = camera.project(self._lanes[self._tested])
        return bool((valid & camera.inside(pixels)).any())

    def _candidate(
        self,
        traffic: Array,
        size: tuple[int, int],
        fov_deg: float,
        distortion: Distortion | None,
        spans: Mapping[str, Range],
        rng: np.random.Generator,
    ) -> PlacedCamera | None:
        """A camera beside a road that looks at a vehicle or a place on the road; None where nothing is found."""

        def value(name: str, default: float) -> float:
            return float(rng.uniform(*spans[name])) if name in spans else default

        height, fov = value("height_m", 6.0), value("fov_deg", fov_deg)
        low, high = spans.get("pitch_deg", (10.0, 40.0))
        # Most cameras look ahead, few look down.
        pitch = low + (high - low) * float(rng.beta(1.2, 2.4))
        among = traffic if len(traffic) and rng.random() < AT_VEHICLES else self._lanes
        target = among[rng.integers(len(among))]
        distance = height / math.tan(math.radians(max(pitch, 3.0)))
        away = np.hypot(*(self._starts[:, :2] - target[:2]).T)
        there = np.flatnonzero(np.abs(away - distance) < max(4.0, 0.3 * distance))
        place = self._beside(int(rng.choice(there)), rng) if len(there) else None
        if place is None:
            return None
        x, y, level = place.tolist()
        z = max(level + height, self._layout.height(self._layout.graph.world(place[:2])) + _ABOVE_GROUND)
        yaw = math.degrees(math.atan2(target[1] - y, target[0] - x)) + value("yaw_by_deg", 0.0)
        mast = Mast((round(x, 3), round(y, 3), round(z, 3)), round(yaw, 3), round(pitch, 3))
        camera = site_at(mast, Town("view"), "view").camera(size, fov, distortion)
        return PlacedCamera(mast, moved(camera, {"roll_by_deg": value("roll_by_deg", 0.0)}, level))

    def _beside(self, start: int, rng: np.random.Generator) -> Array | None:
        """A place (3,) beside the carriageway next to a point of `_starts`, at the road's height, world."""
        across = right_of(float(self._headings[start])) * (1 if rng.random() < 0.7 else -1)
        aside = float(rng.uniform(*_ASIDE))
        graph = self._layout.graph
        for beyond in np.arange(2.0, 26.0, 1.0):
            at = self._starts[start, :2] + across * beyond
            if not shapely.contains_xy(graph.road, *graph.world(at)):
                at = at + across * aside
                inside = shapely.contains_xy(graph.road, *graph.world(at))
                return None if inside else np.array([*at, self._starts[start, 2]])
        return None


def tested_road(town: Town, lanes: Array) -> NDArray[np.bool_]:
    """Which of the points (N, 3) on a town's lanes the cameras of its test sites look at."""
    out = np.zeros(len(lanes), dtype=bool)
    for site in sites_of(Town(town.name, town.road)):
        if site.split != "train":
            east, north = (lanes[:, :2] - site.position[:2]).T
            aside = np.degrees(np.arctan2(north, east)) - site.yaw_deg
            aside = np.abs((aside + 180) % 360 - 180)
            away = np.hypot(east, north)
            out |= (away < _TESTED_M) & ((aside < _TESTED_DEG) | (away < 5.0))
    return out
