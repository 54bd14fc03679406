"""Place objects that resemble vehicles around the cameras: beside the roads and on walls."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final, Self

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh
from skope.gen.scenery.distractor_shapes import STANDING_OBJECTS, wall_panel
from skope.gen.scenery.houses import House, covered
from skope.gen.scenery.lit_objects import FACING_ROAD, LIT_OBJECTS, lit_panel
from skope.gen.scenery.markings import hatching
from skope.gen.towns.land_use import Layout
from skope.gen.towns.regions import rectangle_polygon
from skope.gen.towns.road_graph import beside, driven, right_of
from skope.gen.towns.sites import Site, sites_of
from skope.gen.towns.town import Mast, Town
from skope.types import Array


@dataclass(frozen=True)
class DistractorLimits:
    """Positions and sizes of objects that resemble vehicles."""

    placed_within_m: float = 70.0
    """Maximum distance of these objects from a camera, metres."""
    out_of_view_share: float = 0.15
    """Share of the objects in any direction from a camera; the others are in its view."""
    clearance_m: float = 0.6
    """Minimum distance from the carriageway, metres."""
    largest_share: float = 0.45
    """Maximum size as a share of the distance from the nearest camera, so that no object fills an image."""
    open_view_m: float = 24.0
    """Radius around a camera in which its view of the road is free of objects, metres."""
    on_walls_share: float = 0.4
    """Share of the objects that are on walls."""
    lit_on_walls_share: float = 0.15
    """Share of lit objects that are signs on walls."""
    largest_fall_m: float = 0.3
    """Maximum fall of the ground under an object, metres."""
    overhead_m: float = 4.5
    """Minimum height of parts of lit objects over the road, metres."""
    pool_colors: tuple[tuple[float, float, float], ...] = (
        (1.1, 0.98, 0.8),
        (1.0, 1.0, 1.0),
        (0.85, 1.0, 1.2),
        (0.45, 0.2, 0.18),
    )
    """Colours of patches of light from warm, white and cool headlamps, and from tail lamps."""
    pool_irradiance: tuple[float, float] = (0.04, 0.3)
    """Minimum and maximum irradiance of the patches, in units of the renderer; a street light gives about 0.1 on the
    road below it."""
    tries: int = 40
    """Number of positions to try per object."""
    spacing_m: float = 2.5
    """Distance between candidate positions along roads, metres."""
    aspect: float = 9 / 16
    """Height of images as a share of their width."""


DISTRACTOR_LIMITS: Final = DistractorLimits()


def distractors(
    town: Town, layout: Layout, houses: Sequence[House], blocked: Any, standing: Mesh, rng: np.random.Generator
) -> Iterator[Mesh]:
    """Make and place the objects of a town's variant that resemble vehicles; fewer if there is no room.

    Args:
        town: The town; its variant sets the number of objects.
        layout: Its regions and cameras.
        houses: Its buildings; their walls carry some of the objects.
        blocked: Further area without objects.
        standing: All existing objects of the town, which new objects must not touch.
        rng: Random generator.
    """
    if not town.variant or not layout.sites:
        return
    room, views, along_roads, walls = _surroundings(town, layout, houses, blocked, standing)
    kinds, shares = list(STANDING_OBJECTS), np.array(list(STANDING_OBJECTS.values()))
    for _ in range(town.variant.distractors):
        view = int(rng.integers(len(views)))
        if rng.random() < DISTRACTOR_LIMITS.on_walls_share and (panel := walls.draw(view, room, rng)):
            yield panel
            continue
        made = kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))](rng)
        for _ in range(DISTRACTOR_LIMITS.tries):
            placed = along_roads.draw(view, made.vertices, rng)
            if placed and room.take(*placed, made.vertices):
                position, heading = placed
                yield made.moved([*position, _foot(layout, position, heading, made.vertices)], heading)
                break


def _surroundings(
    town: Town, layout: Layout, houses: Sequence[House], blocked: Any, standing: Mesh
) -> "tuple[_Room, list[_View], _Roadside, _Walls]":
    """Return free room, the cameras' views, roadsides and walls for the placement; see `distractors`."""
    masts = town.variant.masts if town.variant else ()
    near = [
        house
        for house in houses
        if layout.camera_distance(house.center) < DISTRACTOR_LIMITS.placed_within_m + max(house.size)
    ]
    room = _Room(layout, unary_union([blocked, covered(near).buffer(0.4)]), standing)
    views = [_View.of(mast, layout) for mast in masts or map(_mast_at, sites_of(town))]
    return room, views, _Roadside(layout, views), _Walls(views, near)


def lit_objects(
    town: Town, layout: Layout, houses: Sequence[House], blocked: Any, standing: Mesh, rng: np.random.Generator
) -> Iterator[Mesh]:
    """Make and place the objects of a town's variant that are lit at night; fewer if there is no room.

    Args:
        town: The town; its variant sets the number of objects.
        layout: Its regions and cameras.
        houses: Its buildings.
        blocked: Further area without objects.
        standing: All existing objects of the town, which new objects must not touch.
        rng: Random generator.
    """
    if not town.variant or not layout.sites:
        return
    room, views, along_roads, walls = _surroundings(town, layout, houses, blocked, standing)
    kinds, shares = list(LIT_OBJECTS), np.array(list(LIT_OBJECTS.values()))
    for _ in range(town.variant.lit_objects):
        view = int(rng.integers(len(views)))
        if rng.random() < DISTRACTOR_LIMITS.lit_on_walls_share and (panel := walls.draw(view, room, rng)):
            yield lit_panel(panel, rng)
            continue
        make = kinds[int(rng.choice(len(kinds), p=shares / shares.sum()))]
        made = make(rng)
        points = made.vertices
        standing_points = points[points[:, 2] < DISTRACTOR_LIMITS.overhead_m]
        for _ in range(DISTRACTOR_LIMITS.tries):
            placed = along_roads.draw(view, standing_points, rng, facing_road=make.__name__ in FACING_ROAD)
            if placed and room.take(*placed, standing_points, points):
                position, heading = placed
                yield made.moved([*position, _foot(layout, position, heading, standing_points)], heading)
                break


def light_pools(town: Town, layout: Layout, rng: np.random.Generator) -> Array:
    """Return up to three patches of light per camera on the lanes in its view, (N, 10) as `Scenery.light_pools`."""
    out = []
    for kerb, heading in _seen_kerbs(town, layout, 3, rng):
        at = kerb - right_of(heading) * rng.uniform(1.2, 4.5)
        turned = heading + rng.choice([0.0, np.pi]) + rng.normal(0.0, 0.15)
        half_length = rng.uniform(1.5, 5.0)
        color = np.array(DISTRACTOR_LIMITS.pool_colors[int(rng.integers(len(DISTRACTOR_LIMITS.pool_colors)))])
        size = (half_length, min(rng.uniform(0.9, 2.2), half_length))
        light = rng.uniform(*DISTRACTOR_LIMITS.pool_irradiance) * color
        out.append([*at, layout.ground.road(at[None])[0], np.cos(turned), np.sin(turned), *size, *light])
    return np.array(out).reshape(-1, 10)


def hatched_areas(town: Town, layout: Layout, rng: np.random.Generator) -> list[Polygon]:
    """Return the stripes of up to two hatched areas per camera, at the right edges of the roads in its view."""
    kerbs = _seen_kerbs(town, layout, 2, rng)
    return [part for kerb, heading in kerbs for part in hatching(kerb - 0.35 * right_of(heading), heading, rng)]


def _seen_kerbs(town: Town, layout: Layout, most: int, rng: np.random.Generator) -> Iterator[tuple[Array, float]]:
    """Yield positions at kerbs in the cameras' views, up to `most` per camera, with the headings of the roads."""
    views = [_View.of(mast, layout) for mast in (town.variant and town.variant.masts) or map(_mast_at, sites_of(town))]
    along_roads = _Roadside(layout, views)
    for view in range(len(views)):
        for _ in range(int(rng.integers(most + 1))):
            if placed := along_roads.draw_kerb(view, rng):
                yield placed


def _foot(layout: Layout, position: Array, heading: float, points: Array) -> float:
    """Return the height of an object of points (N, 3): that of the lowest ground under it."""
    corners = np.array(rectangle_polygon(position, heading, *np.ptp(points[:, :2], axis=0)).exterior.coords)
    return float(layout.ground.beside(corners).min() + layout.style.kerb)


@dataclass(frozen=True, eq=False)
class _View:
    """Part of the plane that a camera sees, derived from its mast."""

    position: Array
    """(2,) position of the camera."""
    height: float
    """Height above the ground below it, metres."""
    yaw: float
    pitch: float
    """Viewing direction, radians from the x axis and down from the horizon."""
    half_fov: float
    """Half of the horizontal field of view, radians."""

    @classmethod
    def of(cls, mast: Mast, layout: Layout) -> Self:
        position = layout.graph.world(mast.position[:2])
        height = mast.position[2] - layout.height(position)
        yaw, pitch, fov = np.radians([mast.yaw_deg, mast.pitch_deg, mast.fov_deg])
        return cls(position, height, -yaw if layout.graph.mirrored else yaw, pitch, fov / 2)

    def sees(self, places: Array) -> NDArray[np.bool_]:
        """Return which places (N, 2) are within reach and may be visible in the image, (N,)."""
        away = places - self.position
        distance = np.maximum(np.hypot(*away.T), 1e-6)
        turned = np.arctan2(away[:, 1], away[:, 0]) - self.yaw
        aside = np.abs((turned + np.pi) % (2 * np.pi) - np.pi)
        down = np.arctan2(self.height - 1.0, distance) - self.pitch
        upright = np.arctan(DISTRACTOR_LIMITS.aspect * np.tan(self.half_fov))
        return np.asarray(
            (aside < 0.95 * self.half_fov)
            & (np.abs(down) < 0.95 * upright)
            & (distance < DISTRACTOR_LIMITS.placed_within_m)
        )


def _mast_at(site: Site) -> Mast:
    return Mast(site.position, site.yaw_deg, site.pitch_deg)


class _Room:
    """Free room for objects on the ground and on walls."""

    def __init__(self, layout: Layout, blocked: Any, standing: Mesh) -> None:
        self._layout = layout
        graph = layout.graph
        self._street = unary_union(
            [
                graph.road.buffer(DISTRACTOR_LIMITS.clearance_m),
                layout.sidewalk.buffer(0.1),
                layout.beside_lanes("shoulder"),
            ]
        )
        walls = graph.walled_road.buffer(4.0) if not graph.walled_road.is_empty else graph.walled_road
        self._blocked = unary_union(
            [self._street, blocked, walls, layout.sightlines(DISTRACTOR_LIMITS.open_view_m), *layout.under_decks]
        )
        for region in (self._street, self._blocked):
            shapely.prepare(region)
        self._obstacles = shapely.STRtree(_plans_of_low_triangles(layout, standing))
        self._taken: list[Polygon] = []

    def take(self, position: Array, heading: float, points: Array, whole: Array | None = None) -> bool:
        """Return whether an object of points (N, 3) has room there on the ground; if it has, reserve the room.

        If parts hang over the road, `whole` (M, 3) also contains their points. These parts only keep clear of other
        objects.
        """
        whole = points if whole is None else whole
        low, high = points.min(axis=0), points.max(axis=0)
        size, distance = high - low, self._layout.camera_distance(position)
        if max(size[0], whole[:, 2].max()) > DISTRACTOR_LIMITS.largest_share * distance:
            return False
        footprint = _plan_of(position, heading, points)
        heights = self._layout.ground.beside(np.array(footprint.exterior.coords))
        if np.ptp(heights) > DISTRACTOR_LIMITS.largest_fall_m or self._blocked.intersects(footprint):
            return False
        if len(self._obstacles.query(footprint.buffer(0.1), predicate="intersects")):
            return False
        return self._keep(_plan_of(position, heading, whole), 0.4)

    def take_on_wall(self, footprint: Polygon) -> bool:
        """Return whether a panel on a wall is clear of streets and of other panels; if it is, reserve its room."""
        return not self._street.intersects(footprint) and self._keep(footprint, 0.2)

    def _keep(self, footprint: Polygon, gap: float) -> bool:
        if any(footprint.distance(neighbour) < gap for neighbour in self._taken):
            return False
        self._taken.append(footprint)
        return True


def _plan_of(position: Array, heading: float, points: Array) -> Polygon:
    """Return the rectangle around an object of points (N, 3) at a position with a heading."""
    low, high = points.min(axis=0), points.max(axis=0)
    c, s = np.cos(heading), np.sin(heading)
    middle = (low + high)[:2] / 2 @ np.array([[c, s], [-s, c]]) + position
    return rectangle_polygon(middle, heading, *(high - low)[:2])


class _Roadside:
    """Positions along the roads around the cameras."""

    def __init__(self, layout: Layout, views: Sequence[_View]) -> None:
        places, headings, widths = [], [], []
        for edge in layout.graph.edges_of("ground"):
            lane = driven(edge)[0]
            line, kind = LineString(lane.getShape()), layout.graph.kind(edge)
            if min(line.distance(shapely.Point(view.position)) for view in views) > DISTRACTOR_LIMITS.placed_within_m:
                continue
            for s in np.arange(1.0, line.length, DISTRACTOR_LIMITS.spacing_m):
                position, heading = beside(edge, float(s), 0.0)
                places.append(position)
                headings.append(heading)
                widths.append(max(kind.sidewalk, kind.shoulder))
        self._places, self._headings, self._widths = np.array(places).reshape(-1, 2), np.array(headings), widths
        outwards = np.column_stack([np.sin(self._headings), -np.cos(self._headings)])
        beyond = self._places + outwards * (np.array(widths) + 3.0)[:, None]
        self._seen = [np.flatnonzero(view.sees(beyond)) for view in views]
        self._near = [
            np.flatnonzero(np.hypot(*(beyond - view.position).T) < DISTRACTOR_LIMITS.placed_within_m) for view in views
        ]

    def draw_kerb(self, view: int, rng: np.random.Generator) -> tuple[Array, float] | None:
        """Return a random position at a kerb that a camera may see, and the road's heading; None if it sees none."""
        if not len(self._seen[view]):
            return None
        i = int(rng.choice(self._seen[view]))
        return self._places[i], float(self._headings[i])

    def draw(
        self, view: int, points: Array, rng: np.random.Generator, *, facing_road: bool = False
    ) -> tuple[Array, float] | None:
        """Return a random position beside the road and a heading for an object before a camera; None far from roads.

        Args:
            view: Index of the camera.
            points: (N, 3) points of the object, metres.
            rng: Random generator.
            facing_road: Whether the object is close to the road, with its y axis towards it.
        """
        among = self._near[view] if rng.random() < DISTRACTOR_LIMITS.out_of_view_share else self._seen[view]
        if not len(among):
            return None
        i = int(rng.choice(among))
        if facing_road:
            offset = (
                self._widths[i] + DISTRACTOR_LIMITS.clearance_m + 0.05 + points[:, 1].max() + 2.0 * rng.random() ** 2
            )
            position = self._places[i] + right_of(self._headings[i]) * offset
            return position, float(self._headings[i])
        along_road = rng.random() < 0.7
        depth = np.ptp(points[:, 1 if along_road else 0])
        offset = self._widths[i] + 0.3 + depth / 2 + DISTRACTOR_LIMITS.clearance_m + 14.0 * rng.random() ** 2
        # Fronts face the left of a heading, where the road is.
        turned = rng.choice([0.0, 0.0, 0.0, np.pi]) if along_road else rng.choice([-np.pi / 2, np.pi / 2])
        position = self._places[i] + right_of(self._headings[i]) * offset
        return position, float(self._headings[i] + turned + rng.normal(0.0, 0.08))


@dataclass(frozen=True, eq=False)
class _Wall:
    """Wall of a building."""

    house: House
    middle: Array
    """(2,) middle of the lower edge."""
    heading: float
    """Direction along the wall, radians; the wall faces the left of it."""
    width: float
    out: float
    """Distance by which parts of the building project from the wall, metres."""


class _Walls:
    """Walls of buildings in the cameras' views."""

    def __init__(self, views: Sequence[_View], houses: Sequence[House]) -> None:
        self._footprints = shapely.STRtree([house.footprint for house in houses])
        self._walls: list[list[_Wall]] = [[] for _ in views]
        for house, (side, axis) in itertools.product(houses, enumerate(((0, 1), (0, -1), (1, 0), (-1, 0)))):
            kind = house.kind
            if kind.form in ("barn", "silo") or (side < 2 and (kind.balconies or kind.form == "hall")):
                continue
            middle = house.to_world(np.array(axis) * np.array(house.size) / 2)
            outward = house.to_world(np.array(axis, dtype=np.float64)) - house.center
            heading = float(np.arctan2(outward[1], outward[0]) - np.pi / 2)
            # Piers and floors project from the walls of towers.
            wall = _Wall(house, middle, heading, house.size[side // 2], 0.35 if kind.form == "tower" else 0.02)
            for view, seen in zip(views, self._walls, strict=True):
                if view.sees(middle[None])[0] and self._looks_at(wall, outward, view):
                    seen.append(wall)

    def _looks_at(self, wall: _Wall, outward: Array, view: _View) -> bool:
        """Return whether a camera sees the front of a wall without a building between them."""
        away = view.position - wall.middle
        if away @ outward < 0.25 * np.linalg.norm(away):
            return False
        ray = LineString([wall.middle + 0.6 * outward, view.position])
        return not len(self._footprints.query(ray, predicate="intersects"))

    def draw(self, view: int, room: _Room, rng: np.random.Generator) -> Mesh | None:
        """Return a panel on one of the walls that a camera sees; None if it does not fit."""
        if not self._walls[view]:
            return None
        wall = self._walls[view][int(rng.integers(len(self._walls[view])))]
        kind = wall.house.kind
        low = kind.ground + 0.35 if kind.shop and kind.form == "house" else rng.uniform(0.8, 2.4)
        top = kind.ground + kind.storey * (kind.storeys[0] - 1) - 0.3
        if top - low < 0.6:
            return None
        high = rng.uniform(0.6, min(3.2, top - low))
        long = high * rng.uniform(0.7, 4.0)
        if long > 0.9 * wall.width:
            return None
        along = np.array([np.cos(wall.heading), np.sin(wall.heading)])
        position = wall.middle + along * rng.uniform(-0.5, 0.5) * (0.95 * wall.width - long)
        position = position - wall.out * right_of(wall.heading)
        footprint = rectangle_polygon(position - 0.2 * right_of(wall.heading), wall.heading, long + 0.1, 0.3)
        if len(self._footprints.query(footprint, predicate="intersects")) or not room.take_on_wall(footprint):
            return None
        foot = wall.house.floor + low + rng.uniform(0.0, top - low - high)
        return wall_panel(long, high, rng).moved([*position, foot], wall.heading)


def _plans_of_low_triangles(layout: Layout, standing: Mesh) -> NDArray[np.object_]:
    """Return the outlines in plan of the triangles around the cameras that are near the ground."""
    corners = standing.vertices[standing.triangles]
    middle = corners.mean(axis=1)
    near = np.zeros(len(corners), dtype=bool)
    for site in layout.sites:
        near |= np.abs(middle[:, :2] - site.position[:2]).max(axis=1) < DISTRACTOR_LIMITS.placed_within_m + 10.0
    low = corners[near][..., 2].min(axis=1) < layout.ground.beside(middle[near, :2]) + layout.style.kerb + 2.5
    return np.asarray(shapely.linearrings(corners[near][low][..., :2]))
