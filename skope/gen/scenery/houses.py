"""Buildings in rows along the roads and behind them, in the town's style."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
import shapely
from shapely import Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, box
from skope.gen.scenery import large_buildings, roof
from skope.gen.scenery.facade import FacadeStyle, Shop, facade
from skope.gen.scenery.quads import Solid
from skope.gen.towns.land_use import LAND_USE, Bay, Layout, drive_bay, drive_ring
from skope.gen.towns.regions import polygons, rectangle_polygon
from skope.gen.towns.road_graph import beside, driven
from skope.gen.towns.town_style import BuildingKind, ObjectRow, drawn_name
from skope.types import Array


@dataclass(frozen=True)
class HouseLimits:
    """Limits for the positions of houses."""

    open_view_m: float = 38.0
    """Radius around a camera in which its view of the road is free of houses, metres."""
    largest_fall_m: float = 2.2
    """Maximum fall of the ground under a house, metres; steeper ground has no buildings."""


HOUSE_LIMITS: Final = HouseLimits()


BRICK_MATERIALS: Final = ("brick", "brick_brown", "brick_buff", "brick_painted")
_FACADE_AXES: Final = {
    "front": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "back": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "right": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    "left": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
}
"""Axes of the four facades in the house's frame: x along the street, y towards it, z up."""


@dataclass(frozen=True, eq=False)
class House:
    """Building and its plot."""

    kind: BuildingKind
    center: Array
    """(2,) middle of the footprint, metres."""
    heading: float
    """Direction of the street in front of the house, radians; the front faces the left of it."""
    size: tuple[float, float]
    """Size along the street and across it, metres."""
    setback: float
    """Distance from the sidewalk to the front, metres; 0 behind the rows."""
    detail: int
    """Level of detail: 2 near a camera, 0 at distances where only walls and windows are visible."""
    floor: float
    """Height of the ground at the house's highest corner, metres."""
    footing: float
    """Height of the ground at the house's lowest corner, metres."""

    @property
    def near(self) -> bool:
        return self.detail == 2

    @property
    def terraced(self) -> bool:
        return self.kind.terraced

    @property
    def footprint(self) -> Polygon:
        return rectangle_polygon(self.center, self.heading, *self.size)

    def to_world(self, local: Array) -> Array:
        """Transform points (..., 2) from the house's frame to the world."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.asarray(local @ np.array([[c, s], [-s, c]]) + self.center)


def _house(
    layout: Layout, kind: BuildingKind, center: Array, heading: float, size: tuple[float, float], setback: float
) -> House:
    corners = np.array(rectangle_polygon(center, heading, *size).exterior.coords)
    heights = layout.ground.beside(corners) + layout.style.kerb
    distance = layout.camera_distance(center)
    detail = 2 if distance < LAND_USE.detailed_within_m else 1 if distance < LAND_USE.plain_from_m else 0
    return House(kind, center, heading, size, setback, detail, float(heights.max()), float(heights.min()))


def house_plots(layout: Layout, rng: np.random.Generator) -> list[House]:
    """Return the houses of a town, in rows along the right-hand sides of its edges, and some behind them."""
    out: list[House] = []
    taken = Taken(layout)
    fronts = [edge for edge in layout.graph.edges if layout.graph.kind(edge).form != "bridge"]
    for edge in fronts:
        s, length = 0.0, driven(edge)[0].getLength()
        while s < length:
            row = _row_at(layout, edge, s)
            if row is None:
                s += 5.0
                continue
            house = _next_house(layout, row, edge, s, rng)
            if rng.random() >= row.empty and taken.has_room_for(house):
                out.append(house)
                s += house.size[0] + (0.03 if house.terraced else rng.uniform(*row.gap))
            else:
                s += 2.5 if row.empty == 0 else rng.uniform(*row.gap) + 4.0
    kinds = layout.style.behind
    for edge in fronts if kinds else []:
        for s in np.arange(10.0, driven(edge)[0].getLength(), 23.0):
            kind = layout.style.kinds[drawn_name(kinds, rng)]
            size = (rng.uniform(*kind.length), rng.uniform(*kind.depth))
            position, heading = beside(edge, float(s), rng.uniform(26.0, 52.0) + max(size) / 2)
            turned = heading + rng.choice([0.0, np.pi / 2, np.pi])
            behind = _house(layout, kind, position, turned, size, 0.0)
            if taken.has_room_for(behind):
                out.append(behind)
    return out


class Taken:
    """Areas in which no further house fits."""

    def __init__(self, layout: Layout) -> None:
        walled = layout.graph.walled_road
        walls = walled.buffer(3.0) if not walled.is_empty else walled
        streets = [layout.graph.road.buffer(1.0), layout.sidewalk.buffer(0.4), walls, *layout.under_decks]
        self._kept_clear = unary_union(
            [
                *streets,
                layout.enclosed(max(layout.style.interchange, LAND_USE.island_m)),
                layout.around_cameras.buffer(5.0),
                layout.sightlines(HOUSE_LIMITS.open_view_m),
            ]
        )
        shapely.prepare(self._kept_clear)
        self._houses: list[tuple[Polygon, bool]] = []

    def has_room_for(self, house: House) -> bool:
        """Return whether a house fits, with its car park; if it does, reserve the area."""
        footprint = house.footprint
        if house.floor - house.footing > HOUSE_LIMITS.largest_fall_m:
            return False
        if house.kind.parking:
            x, y = house.size[0] / 2, house.size[1] / 2
            lot = [[-x, y], [x, y], [x, y + house.setback - 1.5], [-x, y + house.setback - 1.5]]
            footprint = unary_union([footprint, Polygon(house.to_world(np.array(lot)))])
        if self._kept_clear.intersects(footprint):
            return False
        for neighbour, terraced in self._houses:
            if footprint.distance(neighbour) < (0.02 if house.terraced and terraced else 2.5):
                return False
        self._houses.append((footprint, house.terraced))
        return True


def _row_at(layout: Layout, edge: Any, s: float) -> ObjectRow | None:
    distance = layout.graph.signal_distance(beside(edge, s, 0.0)[0])
    rows = (
        row for row in layout.style.rows if (not row.roads or edge.getType() in row.roads) and distance < row.within
    )
    return next(rows, None)


def _next_house(layout: Layout, row: ObjectRow, edge: Any, s: float, rng: np.random.Generator) -> House:
    kind = layout.style.kinds[drawn_name(row.kinds, rng)]
    length, depth = rng.uniform(*kind.length), rng.uniform(*kind.depth)
    setback = rng.uniform(*row.setback) + kind.parking
    road = layout.graph.kind(edge)
    street = max(road.sidewalk, road.shoulder) + 0.15
    position, heading = beside(edge, s + length / 2, street + setback + depth / 2)
    return _house(layout, kind, position, heading, (length, depth), setback)


def house_meshes(houses: list[House], rng: np.random.Generator) -> Iterator[Mesh]:
    footprints = [house.footprint for house in houses]
    index = shapely.STRtree(footprints)
    for house in houses:
        sides = [
            rectangle_polygon(house.to_world(np.array([s * house.size[0] / 2, 0.0])), house.heading, 1.0, 4.0)
            for s in (1, -1)
        ]
        joined = [len(index.query(side, predicate="intersects")) > 1 for side in sides]
        yield _house_mesh(house, (joined[0], joined[1]), rng).moved([*house.center, house.floor], house.heading)
        if house.floor - house.footing > 0.05:
            x, y = house.size[0] / 2, house.size[1] / 2
            foundation = box([-x, -y, house.footing - house.floor - 0.3], [x, y, 0.0], "stone")
            yield foundation.moved([*house.center, house.floor], house.heading)


def _house_mesh(house: House, joined: tuple[bool, bool], rng: np.random.Generator) -> Mesh:
    half, kind = (house.size[0] / 2, house.size[1] / 2), house.kind
    if kind.form == "silo":
        return large_buildings.silo(kind, half[0], house.near, rng)
    if kind.form == "tower":
        return large_buildings.tower(kind, half, house.detail, rng).mesh()
    if kind.form == "hall":
        return large_buildings.hall(kind, half, house.near, rng).mesh()
    if kind.form == "barn":
        return large_buildings.barn(kind, half, rng).mesh()
    return _building(house, _draw_style(kind, rng), joined, rng).mesh()


def _draw_style(kind: BuildingKind, rng: np.random.Generator) -> FacadeStyle:
    def pick(names: tuple[str, ...]) -> str:
        return str(rng.choice(names))

    upper = int(rng.integers(kind.storeys[0], kind.storeys[1] + 1)) - 1
    style = FacadeStyle(
        walls=pick(kind.walls),
        dressing="dressing",
        frame=pick(kind.frames),
        door=pick(("door_green", "door_red", "door_blue", "door_oak")),
        storeys=(kind.ground, *[kind.storey] * upper),
        bay=rng.uniform(*kind.bay),
        window=(rng.uniform(*kind.window), rng.uniform(*kind.pane)),
        sill=0.92,
        panes=(2, 1) if kind.balconies else [(2, 1), (2, 2), (2, 3), (1, 2)][rng.integers(4)],
        balconies=kind.balconies,
        cornice=kind.shop and rng.random() < 0.7,
    )
    if kind.balconies:
        return style
    masonry = not style.walls.startswith("cladding")
    brick = style.walls in BRICK_MATERIALS
    return replace(
        style,
        lintels=brick,
        surrounds=not brick and rng.random() < 0.45,
        shutters=pick(("shutter_green", "shutter_blue", "shutter_brown"))
        if kind.shutters and not brick and style.bay > 2.6 and rng.random() < 0.6
        else None,
        quoins=masonry and rng.random() < 0.3,
    )


def _building(house: House, style: FacadeStyle, joined: tuple[bool, bool], rng: np.random.Generator) -> Solid:
    """Return a house around the origin with its front towards +y; a side (+x, -x) that joins another house is blank."""
    x, y = house.size[0] / 2, house.size[1] / 2
    out = Solid()
    shop = None
    if house.kind.shop:
        fascia, lettering = (
            ("fascia_red", "lettering"),
            ("fascia_green", "lettering"),
            ("fascia_blue", "lettering"),
            ("fascia_black", "lettering_gold"),
            ("fascia_cream", "lettering_dark"),
        )[rng.integers(5)]
        awning = str(rng.choice(["awning_red", "awning_blue", "awning_green"])) if rng.random() < 0.45 else None
        shop = Shop(fascia=fascia, lettering=lettering, awning=awning)
    plain = replace(style, shutters=None, balconies=False, surrounds=False)
    near, far = house.near, house.detail == 0
    front = facade(house.size[0], style, rng, near=near, plain=far, door=True, shop=shop, wrap=True)
    back = facade(house.size[0], plain, rng, near=False, plain=far)
    bays = [0 if meets else int(rng.integers(2, 4)) for meets in joined]
    right = facade(house.size[1], plain, rng, near=near, plain=far, bays=bays[0])
    left = facade(house.size[1], plain, rng, near=near, plain=far, bays=bays[1])
    out.add(front.placed((x, y, 0.0), _FACADE_AXES["front"]))
    out.add(back.placed((-x, -y, 0.0), _FACADE_AXES["back"]))
    out.add(right.placed((x, -y, 0.0), _FACADE_AXES["right"]))
    out.add(left.placed((-x, y, 0.0), _FACADE_AXES["left"]))
    _put_roof(out, house, style, rng)
    return out


def _put_roof(out: Solid, house: House, style: FacadeStyle, rng: np.random.Generator) -> None:
    (x, y), eaves = (house.size[0] / 2, house.size[1] / 2), style.height
    pitch, covering = rng.uniform(0.55, 0.85), str(rng.choice(house.kind.roofs))
    chance = rng.random()
    if house.kind.roof == "flat" or (house.kind.roof == "mixed" and house.terraced and chance < 0.3):
        out.add(roof.flat_roof((x, y), eaves, 0.7 if house.kind.balconies else 0.9, style.walls, style.dressing))
        return
    stack = "brick" if style.walls not in BRICK_MATERIALS else style.walls
    ridge = eaves + pitch * y
    mixed = house.kind.roof == "mixed" and not house.terraced
    if mixed and chance < 0.22 and x > y + 0.5:
        out.add(roof.hipped((x, y), eaves, pitch * y, covering))
        out.add(roof.chimney(0.4 * x, -0.5, ridge - 1.2, ridge + 0.9, stack))
    elif mixed and chance < 0.42 and x < 5.2:
        turned = roof.gabled((y, x), eaves, 1.15 * pitch * x, 0.3, covering, style.walls)
        out.add(turned.placed((0.0, 0.0, 0.0), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))))
        out.add(roof.chimney(0.0, -0.5 * y, eaves + pitch * x - 0.4, eaves + 1.15 * pitch * x + 0.9, stack))
    else:
        out.add(roof.gabled((x, y), eaves, pitch * y, 0.0 if house.terraced else 0.3, covering, style.walls))
        for side in (-1.0, 1.0)[: int(rng.integers(1, 3))]:
            out.add(roof.chimney(side * (x - 0.6), 0.0, ridge - 0.7, ridge + 1.0, stack))
        if house.near:
            _put_into_slope(out, x, y, eaves, pitch, covering, rng)
    if house.near:
        out.add(roof.gutters((x, y), eaves))


def _put_into_slope(
    out: Solid, x: float, y: float, eaves: float, pitch: float, covering: str, rng: np.random.Generator
) -> None:
    """Add dormers or roof windows in the slope towards the street."""
    look, places = rng.random(), np.array([-0.45, 0.45]) * x
    thickness = roof.ROOF_SIZES.thickness_m
    for at in places:
        if look < 0.35:
            front = 0.78 * y
            out.add(roof.dormer(float(at), front, eaves + pitch * (y - front) + thickness, pitch, covering, "frame"))
        elif look < 0.65:
            out.add(roof.roof_window(float(at), 0.5 * y, eaves + pitch * 0.5 * y + thickness + 0.01, pitch))


def forecourts(houses: list[House]) -> Any:
    """Return paved ground between the sidewalk and the fronts of shops, and around buildings without gardens."""
    strips = [house.footprint.buffer(2.5, join_style="mitre") for house in houses if house.kind.form == "tower"]
    for house in houses:
        if house.setback and not house.kind.garden and not house.kind.parking:
            x, y, d = house.size[0] / 2, house.size[1] / 2, house.setback + 0.5
            ring = [[-x - 1, y - 0.2], [x + 1, y - 0.2], [x + 1, y + d], [-x - 1, y + d]]
            strips.append(Polygon(house.to_world(np.array(ring))))
    return unary_union(strips)


def car_parks(houses: list[House]) -> tuple[Any, Any]:
    """Return asphalt in front of halls and the drives to it from the road."""
    lots, ways = [], []
    for house in houses:
        if not house.kind.parking:
            continue
        x, y, d = house.size[0] / 2, house.size[1] / 2, house.setback
        lots.append(
            Polygon(house.to_world(np.array([[-x, y + 3.0], [x, y + 3.0], [x, y + d - 4.0], [-x, y + d - 4.0]])))
        )
        for at in (-x + 6.0, x - 6.0):
            ring = [[at - 3.2, y + d - 4.0], [at + 3.2, y + d - 4.0], [at + 3.2, y + d + 0.4], [at - 3.2, y + d + 0.4]]
            ways.append(Polygon(house.to_world(np.array(ring))))
    return unary_union(lots), unary_union(ways)


def garden_paths(houses: list[House]) -> tuple[Any, Any]:
    """Return paved paths and gravel drives from the sidewalk to houses with gardens."""
    walks, drives = [], []
    for i, house in enumerate(houses):
        x, y, d = house.size[0] / 2, house.size[1] / 2, house.setback + 0.3
        if house.kind.form == "barn":
            drives.append(
                Polygon(house.to_world(np.array([[-4, y], [4, y], [3, y + max(d, 6.0)], [-3, y + max(d, 6.0)]])))
            )
        if not house.kind.garden or house.setback == 0.0:
            continue
        # The door can be anywhere in the front: the path leads to the middle of the front and along it.
        ring = [[-0.6, y], [0.6, y], [0.6, y + d], [-0.6, y + d]]
        walks += [Polygon(house.to_world(np.array(ring)))]
        walks += [
            Polygon(house.to_world(np.array([[-x + 0.6, y], [x - 0.6, y], [x - 0.6, y + 1.0], [-x + 0.6, y + 1.0]])))
        ]
        if _has_drive(i, house):
            drives.append(Polygon(house.to_world(drive_ring(x, y, y + d))))
    return unary_union(walks), unary_union(drives)


def _has_drive(i: int, house: House) -> bool:
    return bool(i % 2 and house.kind.drive and house.kind.garden and house.setback)


def drive_bays(houses: list[House]) -> list[Bay]:
    """Return bays on the drives beside houses."""
    out = []
    for i, house in enumerate(houses):
        if _has_drive(i, house):
            x, y = house.to_world(np.array(drive_bay(house.size[0] / 2, house.size[1] / 2)))
            out.append(Bay((float(x), float(y)), house.heading - np.pi / 2))
    return out


def covered(houses: list[House]) -> Any:
    return unary_union([part for house in houses for part in polygons(house.footprint)])
