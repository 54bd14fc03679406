"""Houses along the streets: shops wall to wall in the centre, houses with gardens and blocks of flats beyond."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh
from skope.gen.towns import roof
from skope.gen.towns.facade import Shop, Style, facade
from skope.gen.towns.layout import KERB_HEIGHT, SIDEWALK, Layout, beside, polygons, rectangle
from skope.gen.towns.solid import Solid

Array = NDArray[np.float64]

CENTRE_RADIUS: Final = 95.0
"""Around a signalled junction main streets are lined by shops, metres."""
FORECOURT: Final = 0.9
"""From sidewalk to shop front, metres."""
FRONT_GARDEN: Final = (3.2, 6.5)
SIGHT: Final = 38.0
"""Houses keep out of the view of road that is nearer than that to a camera, metres."""

_BRICKS: Final = ("brick", "brick_brown", "brick_buff", "brick_painted")
_PLASTERS: Final = ("plaster", "plaster_white", "plaster_ochre", "plaster_rose", "plaster_sage", "plaster_grey")
_STONES: Final = ("stone", "sandstone")
_AXES: Final = {
    "front": ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    "back": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "right": ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0)),
    "left": ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)),
}
"""Axes of the four facades in the house's frame: x along the street, y towards it, z up."""

Kind = Literal["shop", "house", "flats"]


@dataclass(frozen=True, eq=False)
class House:
    """A building and its plot."""

    kind: Kind
    center: Array
    """(2,) of the footprint."""
    heading: float
    """Of the street, radians; the front looks to its left."""
    size: tuple[float, float]
    """Along the street and across it, metres."""
    setback: float
    """From the sidewalk to the front, metres."""
    terraced: bool
    near: bool

    @property
    def footprint(self) -> Polygon:
        return rectangle(self.center, self.heading, *self.size)

    def to_world(self, local: Array) -> Array:
        """Points (..., 2) of the house's frame in the world."""
        c, s = np.cos(self.heading), np.sin(self.heading)
        return np.asarray(local @ np.array([[c, s], [-s, c]]) + self.center)


def plots(layout: Layout, rng: np.random.Generator) -> list[House]:
    """The houses of a town, in rows along the right-hand sides of its edges, and some behind them."""
    out: list[House] = []
    taken = Taken(layout)
    for edge in layout.edges:
        s, length = 0.0, edge.getLanes()[0].getLength()
        while s < length:
            house = _next_house(layout, edge, s, rng)
            if taken.has_room_for(house):
                out.append(house)
                s += house.size[0] + (0.03 if house.terraced else rng.uniform(3.0, 8.0))
            else:
                s += 2.5
    for edge in layout.edges:
        for s in np.arange(10.0, edge.getLanes()[0].getLength(), 23.0):
            place, heading = beside(edge, float(s), rng.uniform(34.0, 60.0))
            size = (rng.uniform(8.0, 14.0), rng.uniform(8.0, 11.0))
            turned = heading + rng.choice([0.0, np.pi / 2, np.pi])
            behind = House("house", place, turned, size, 0.0, False, False)
            if taken.has_room_for(behind):
                out.append(behind)
    return out


class Taken:
    """Where no further house may stand."""

    def __init__(self, layout: Layout) -> None:
        streets = layout.road.buffer(SIDEWALK + 0.6)
        self._kept_clear = unary_union([streets, layout.around_cameras.buffer(5.0), layout.sightlines(SIGHT)])
        shapely.prepare(self._kept_clear)
        self._houses: list[tuple[Polygon, bool]] = []

    def has_room_for(self, house: House) -> bool:
        """Whether a house fits; if so its place is taken."""
        footprint = house.footprint
        if self._kept_clear.intersects(footprint):
            return False
        for other, terraced in self._houses:
            if footprint.distance(other) < (0.02 if house.terraced and terraced else 2.5):
                return False
        self._houses.append((footprint, house.terraced))
        return True


def _next_house(layout: Layout, edge: Any, s: float, rng: np.random.Generator) -> House:
    main = edge.getLaneNumber() > 1
    central = layout.centre_distance(beside(edge, s, 0.0)[0]) < (CENTRE_RADIUS if main else 0.45 * CENTRE_RADIUS)
    chance = rng.random()
    kind: Kind
    if central:
        kind = "flats" if chance < 0.16 else "shop"
    else:
        kind = "flats" if chance < (0.14 if main else 0.05) else "house"
    length = {"shop": rng.uniform(6.5, 11.5), "house": rng.uniform(7.5, 12.5), "flats": rng.uniform(15.0, 21.0)}[kind]
    depth = rng.uniform(9.0, 11.0)
    setback = FORECOURT if central else rng.uniform(*FRONT_GARDEN)
    place, heading = beside(edge, s + length / 2, SIDEWALK + 0.15 + setback + depth / 2)
    return House(kind, place, heading, (length, depth), setback, central, layout.is_near(place))


def house_meshes(houses: list[House], rng: np.random.Generator) -> Iterator[Mesh]:
    footprints = [house.footprint for house in houses]
    index = shapely.STRtree(footprints)
    for house in houses:
        sides = [
            rectangle(house.to_world(np.array([s * house.size[0] / 2, 0.0])), house.heading, 1.0, 4.0) for s in (1, -1)
        ]
        joined = [len(index.query(side, predicate="intersects")) > 1 for side in sides]
        style = _style(house.kind, rng)
        solid = _building(house, style, (joined[0], joined[1]), rng)
        yield solid.mesh().moved([*house.center, KERB_HEIGHT], house.heading)


def _style(kind: Kind, rng: np.random.Generator) -> Style:
    def one(*names: str) -> str:
        return str(rng.choice(names))

    upper = int(rng.choice([1, 2], p=[0.55, 0.45]))
    style = Style(
        walls=one(*_BRICKS[:3], *_BRICKS, *_PLASTERS, *_STONES),
        dressing="dressing",
        frame=one("frame", "frame", "frame_dark"),
        door=one("door_green", "door_red", "door_blue", "door_oak"),
        storeys=(2.95, *[2.8] * upper),
        bay=rng.uniform(2.3, 3.1),
        window=(rng.uniform(0.95, 1.35), rng.uniform(1.35, 1.6)),
        sill=0.92,
        panes=[(2, 1), (2, 2), (2, 3), (1, 2)][rng.integers(4)],
    )
    if kind == "flats":
        return replace(
            style,
            walls=one("concrete", "plaster_white", "plaster_grey", "brick_buff", "brick_brown"),
            frame=one("frame_dark", "frame"),
            storeys=(3.2, *[2.8] * int(rng.integers(3, 5))),
            bay=rng.uniform(2.9, 3.4),
            window=(rng.uniform(1.6, 2.1), 1.5),
            panes=(2, 1),
            balconies=True,
        )
    if kind == "shop":
        style = replace(style, storeys=(3.75, *[3.0] * int(rng.integers(1, 4))), cornice=rng.random() < 0.7)
    brick = style.walls in _BRICKS
    return replace(
        style,
        lintels=brick,
        surrounds=not brick and rng.random() < 0.45,
        shutters=one("shutter_green", "shutter_blue", "shutter_brown")
        if kind == "house" and not brick and style.bay > 2.6 and rng.random() < 0.6
        else None,
        quoins=rng.random() < 0.3,
    )


def _building(house: House, style: Style, joined: tuple[bool, bool], rng: np.random.Generator) -> Solid:
    """A house around the origin with its front towards +y; a side (+x, -x) that joins another house is blank."""
    x, y = house.size[0] / 2, house.size[1] / 2
    out = Solid()
    shop = None
    if house.kind == "shop":
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
    near = house.near
    front = facade(house.size[0], style, rng, near=near, door=True, shop=shop, wrap=True)
    back = facade(house.size[0], plain, rng, near=False)
    bays = [0 if meets else int(rng.integers(2, 4)) for meets in joined]
    right = facade(house.size[1], plain, rng, near=near, bays=bays[0])
    left = facade(house.size[1], plain, rng, near=near, bays=bays[1])
    out.add(front.placed((x, y, 0.0), _AXES["front"]))
    out.add(back.placed((-x, -y, 0.0), _AXES["back"]))
    out.add(right.placed((x, -y, 0.0), _AXES["right"]))
    out.add(left.placed((-x, y, 0.0), _AXES["left"]))
    _put_roof(out, house, style, rng)
    return out


def _put_roof(out: Solid, house: House, style: Style, rng: np.random.Generator) -> None:
    (x, y), eaves = (house.size[0] / 2, house.size[1] / 2), style.height
    pitch, covering = rng.uniform(0.55, 0.85), str(rng.choice(["tiles", "tiles", "tiles_brown", "slate", "slate"]))
    chance = rng.random()
    if house.kind == "flats" or (house.terraced and chance < 0.3):
        out.add(roof.flat((x, y), eaves, 0.7 if house.kind == "flats" else 0.9, style.walls, style.dressing))
        return
    stack = "brick" if style.walls not in _BRICKS else style.walls
    ridge = eaves + pitch * y
    if not house.terraced and chance < 0.22 and x > y + 0.5:
        out.add(roof.hipped((x, y), eaves, pitch * y, covering))
        out.add(roof.chimney(0.4 * x, -0.5, ridge - 1.2, ridge + 0.9, stack))
    elif not house.terraced and chance < 0.42 and x < 5.2:
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
    """Dormers or roof windows in the slope towards the street."""
    look, places = rng.random(), np.array([-0.45, 0.45]) * x
    thickness = roof.THICKNESS
    for at in places:
        if look < 0.35:
            front = 0.78 * y
            out.add(roof.dormer(float(at), front, eaves + pitch * (y - front) + thickness, pitch, covering, "frame"))
        elif look < 0.65:
            out.add(roof.roof_window(float(at), 0.5 * y, eaves + pitch * 0.5 * y + thickness + 0.01, pitch))


def forecourts(houses: list[House]) -> Any:
    """Paved ground between the sidewalk and the fronts of shops."""
    shops = [house for house in houses if house.terraced]
    strips = [
        Polygon(house.to_world(np.array([[-x - 1, y - 0.2], [x + 1, y - 0.2], [x + 1, y + d], [-x - 1, y + d]])))
        for house in shops
        for x, y, d in [(house.size[0] / 2, house.size[1] / 2, house.setback + 0.5)]
    ]
    return unary_union(strips)


def paths(houses: list[House]) -> tuple[Any, Any]:
    """Paved paths and gravel drives from the sidewalk to houses with gardens."""
    walks, drives = [], []
    for i, house in enumerate(houses):
        if house.terraced or house.setback == 0.0:
            continue
        x, y, d = house.size[0] / 2, house.size[1] / 2, house.setback + 0.3
        # Doors are somewhere in the front: the path leads to its middle and along it.
        ring = [[-0.6, y], [0.6, y], [0.6, y + d], [-0.6, y + d]]
        walks += [Polygon(house.to_world(np.array(ring)))]
        walks += [
            Polygon(house.to_world(np.array([[-x + 0.6, y], [x - 0.6, y], [x - 0.6, y + 1.0], [-x + 0.6, y + 1.0]])))
        ]
        if i % 2 and house.kind == "house":
            side = [[x + 0.3, y - 5.0], [x + 2.7, y - 5.0], [x + 2.7, y + d], [x + 0.3, y + d]]
            drives.append(Polygon(house.to_world(np.array(side))))
    return unary_union(walks), unary_union(drives)


def covered(houses: list[House]) -> Any:
    return unary_union([part for house in houses for part in polygons(house.footprint)])
