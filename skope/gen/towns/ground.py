"""The ground as polygons in the plane, each part cut out of those below it, then raised to the ground's heights.

No two surfaces share a place, and neighbours share their corners.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Point, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, from_triangles, quads
from skope.gen.towns.layout import FAR, KERB_WIDTH, Layout, beside, driven, half_width, polygons, rectangle, right_of
from skope.gen.towns.markings import crossings, markings
from skope.gen.towns.parking import bay_lines
from skope.gen.towns.terrain import COARSEST

Array = NDArray[np.float64]

MARGIN: Final = 320.0
"""How far the ground goes beyond the network, metres."""
GUTTER: Final = 0.32
WALL: Final = 0.4
"""Steps higher than that between carriageway and ground are retaining walls, metres."""
_GRID: Final = 1e-4
"""Polygons' corners are rounded to that, so that parts cut out of each other keep common corners, metres."""
_STEP: Final = 2.0
"""Kerbs on slopes are made of pieces as long as that, metres."""


@dataclass(frozen=True)
class Part:
    """One material's share of the ground."""

    material: str
    region: Any
    carriageway: bool


@dataclass(frozen=True)
class Beside:
    """What is laid out beside the carriageway by those who build there."""

    forecourts: Any
    walks: Any
    drives: Any
    parking: Any
    footings: Any
    """Bare soil at walls' feet."""
    pits: Any
    """Bare soil around trees in the sidewalk."""


def ground_parts(layout: Layout, beside_road: Beside, rng: np.random.Generator) -> list[Part]:
    """All of the ground; what is beside the carriageway lies a kerb's height above it."""
    road = shapely.set_precision(layout.ground_road, _GRID)
    kerbed = layout.style.kerb > 0
    x0, y0, x1, y1 = road.bounds
    everywhere = shapely.box(x0 - MARGIN, y0 - MARGIN, x1 + MARGIN, y1 + MARGIN)
    patches, old, seals = _repairs(layout, rng)
    street = _cut(
        road,
        [
            ("cover", unary_union(list(_covers(layout, rng)))),
            ("marking", unary_union([*markings(layout), *crossings(layout)])),
            ("bitumen", seals),
            ("asphalt_patch", patches),
            ("asphalt_old", old),
            ("gutter", road.difference(road.buffer(-GUTTER)) if kerbed else Polygon()),
            ("asphalt_polished", _tracks(layout, 0.3)),
            ("asphalt_worn", _tracks(layout, 0.62)),
            ("asphalt", road),
        ],
        carriageway=True,
    )
    kerb = road.difference(layout.walled_road).buffer(KERB_WIDTH, join_style="mitre") if kerbed else Polygon()
    sidewalk, islands = layout.sidewalk, layout.islands
    flush = _flush_decks(layout)
    beyond = _cut(
        everywhere.difference(road).difference(flush),
        [
            ("kerb", kerb),
            ("cover", unary_union(list(_sidewalk_covers(layout, rng))).intersection(sidewalk)),
            ("tactile", _tactile(layout, road).intersection(sidewalk)),
            ("soil", beside_road.pits.intersection(sidewalk)),
            (layout.style.median, islands.buffer(0.01)),
            ("asphalt_old", layout.beside_lanes("shoulder")),
            ("sidewalk", sidewalk.union(beside_road.forecourts)),
            ("paving", unary_union([beside_road.walks, layout.walled_road.buffer(4.5), *under_decks(layout)])),
            ("marking", bay_lines(beside_road.parking)),
            ("asphalt_old", beside_road.parking),
            ("gravel", beside_road.drives),
            ("soil", beside_road.footings),
            *_fields(layout, everywhere.difference(beside_road.footings.buffer(9.0)), rng),
            ("grass", everywhere),
        ],
        carriageway=False,
    )
    return [*street, *beyond]


def _cut(whole: Any, layers: Sequence[tuple[str, Any]], *, carriageway: bool) -> list[Part]:
    """Share a region out: each layer gets what the ones before it left."""
    out, left = [], shapely.set_precision(whole, _GRID)
    for material, region in layers:
        if region.is_empty:
            continue
        region = _areas(shapely.set_precision(region, _GRID))
        out.append(Part(material, _areas(shapely.intersection(left, region, grid_size=_GRID)), carriageway))
        left = _areas(shapely.difference(left, region, grid_size=_GRID))
    return out


def _areas(shape: Any) -> Any:
    """A shape without the points and lines that overlays leave."""
    return shapely.MultiPolygon(polygons(shape))


def under_decks(layout: Layout) -> list[Any]:
    """Bridges' shadows on the ground, which are paved."""
    return [deck.buffer(2.0, cap_style="square") for deck in layout.decks]


def _flush_decks(layout: Layout) -> Any:
    """Decks, sidewalks included, that continue the ground beside the carriageway that they lead over."""
    out = []
    for deck in layout.decks:
        own = deck.buffer(deck_edge(layout), join_style="mitre").difference(layout.ground_road.buffer(0.01))
        corners = np.array(deck.exterior.coords)
        above, _ = layout.deck_lanes.near(corners, 10.0)
        if np.abs(above - layout.ground.beside(corners)).max() < 0.3:
            out.append(own)
    return unary_union(out)


def deck_edge(layout: Layout) -> float:
    """Width of decks beside their lanes, metres."""
    return max([layout.kind(edge).sidewalk for edge in layout.edges_of("bridge")], default=0.0) + 0.45


def _fields(layout: Layout, everywhere: Any, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """Open ground in strips and squares of several kinds, away from the roads."""
    kinds = layout.style.open_ground
    if len(kinds) < 2:
        return
    away = everywhere.difference(layout.road.buffer(layout.style.fields_from))
    x0, y0, x1, y1 = everywhere.bounds
    shares: dict[str, list[Any]] = {kind: [] for kind in kinds}
    turn = rng.uniform(-0.3, 0.3)
    for x in np.arange(x0 - 200.0, x1 + 200.0, 118.0):
        for y in np.arange(y0 - 200.0, y1 + 200.0, 86.0):
            size = (rng.uniform(90.0, 112.0), rng.uniform(62.0, 80.0))
            kind = kinds[rng.integers(len(kinds))]
            shares[kind].append(rectangle(np.array([x, y]), 0.0, *size))
    for kind, shapes in shares.items():
        if shapes:
            yield kind, shapely.affinity.rotate(unary_union(shapes), turn, (0, 0), True).intersection(away)


# ------------------------------------------------------------------------------------------------------------- surfaces


def ground_meshes(layout: Layout, parts: Sequence[Part]) -> Iterator[Mesh]:
    """The parts as meshes at the ground's heights, and the kerbs between them."""
    kerb, ground = layout.style.kerb, layout.ground
    x0, y0, x1, y1 = layout.ground_road.bounds
    bounds = (x0 - MARGIN, y0 - MARGIN, x1 + MARGIN, y1 + MARGIN)
    cells = None if ground.flat else ground.cells(bounds, layout.ground_road)
    heights: dict[bool, Callable[[Array], Array]] = {
        True: ground.road,
        False: lambda places: ground.beside(places) + kerb,
    }
    for carriageway, height in heights.items():
        yield from surfaces([part for part in parts if part.carriageway is carriageway], height, cells)
    yield from _kerbs(layout)


def surfaces(
    parts: Sequence[Part], height: Callable[[Array], Array], cells: NDArray[np.object_] | None
) -> Iterator[Mesh]:
    """Parts of the plane, raised to a height at each corner: cut into cells where they are not level."""
    corners, materials = [], []
    for part in parts:
        shapes = polygons(part.region) if cells is None else _in_cells(polygons(part.region), cells)
        for shape in shapes:
            triangles = shapely.constrained_delaunay_triangles(shape)
            rings = [np.array(t.exterior.coords)[:3] for t in triangles.geoms]
            corners += [ring if shapely.is_ccw(t.exterior) else ring[::-1] for t, ring in zip(triangles.geoms, rings)]
            materials += [part.material] * len(rings)
    points, index = np.unique(np.concatenate(corners).round(4), axis=0, return_inverse=True)
    whole = from_triangles(np.column_stack([points, height(points)]), index.reshape(-1, 3), "")
    names = tuple(dict.fromkeys(materials))
    number = {name: i for i, name in enumerate(names)}
    yield Mesh(
        whole.vertices, whole.normals, whole.triangles, names, np.array([number[name] for name in materials], np.int64)
    )


def _in_cells(shapes: Sequence[Polygon], cells: NDArray[np.object_]) -> list[Polygon]:
    """Pieces of polygons, one cell each; first cut by large squares, so that no large polygon is cut often."""
    low, high = np.floor(shapely.total_bounds(cells)[:2] / COARSEST), shapely.total_bounds(cells)[2:] / COARSEST
    x, y = np.meshgrid(*(COARSEST * np.arange(a, b) for a, b in zip(low, high, strict=True)))
    squares = shapely.box(x, y, x + COARSEST, y + COARSEST).ravel()
    return _cut_by(_cut_by(shapes, squares, _GRID), cells, None)


def _cut_by(shapes: Sequence[Polygon], cells: NDArray[np.object_], precision: float | None) -> list[Polygon]:
    whole = np.array(shapes, dtype=object)
    shapely.prepare(whole)
    number, cell = shapely.STRtree(cells).query(whole, predicate="intersects")
    inside = shapely.covers(whole[number], cells[cell])
    cut = shapely.intersection(whole[number[~inside]], cells[cell[~inside]], grid_size=precision)
    return [*cells[cell[inside]], *(polygon for piece in cut for polygon in polygons(piece))]


def _kerbs(layout: Layout) -> Iterator[Mesh]:
    """Kerbs and retaining walls between the carriageway and the ground beside it, with parapets on high ones."""
    ground = layout.ground
    decks = unary_union([deck.buffer(deck_edge(layout), join_style="mitre") for deck in layout.decks])
    for ring in rings(shapely.set_precision(layout.ground_road, _GRID)):
        line = ring if ground.flat else np.array(shapely.segmentize(LineString(ring), _STEP).coords)
        low, high = ground.road(line), ground.beside(line) + layout.style.kerb
        under = shapely.intersects(decks, shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1)))
        for chosen, material in ((high - low <= WALL, "kerb"), (high - low > WALL, "concrete")):
            strip = chosen[:-1] if material == "kerb" else ~(high - low <= WALL)[:-1]
            if not strip.any() or (material == "kerb" and (high - low)[chosen].max() < 1e-6):
                continue
            top = high.copy()
            if material == "concrete":
                covered = np.zeros(len(line), dtype=bool)
                covered[:-1] |= under
                covered[1:] |= under
                top[covered] -= 0.5
            yield _strip(line, low, top, strip, material)
            if material == "concrete":
                yield from _parapet(line, high, strip & ~under)


def _strip(line: Array, low: Array, high: Array, chosen: NDArray[np.bool_], material: str) -> Mesh:
    """Vertical quadrilaterals along a line (N, 2), between two heights at each point, facing its right-hand side."""
    start, end = np.column_stack([line[:-1], low[:-1]]), np.column_stack([line[1:], low[1:]])
    over_end, over_start = np.column_stack([line[1:], high[1:]]), np.column_stack([line[:-1], high[:-1]])
    corners = np.stack([start, end, over_end, over_start], axis=1)
    proper = chosen & (np.hypot(*(line[1:] - line[:-1]).T) > 1e-6)
    return quads(corners[proper], material)


def _parapet(line: Array, base: Array, chosen: NDArray[np.bool_]) -> Iterator[Mesh]:
    """A low wall behind a line's left-hand side, with a rail on it."""
    for first, last in _runs(chosen):
        path, z = LineString(line[first : last + 1]), base[first : last + 1]
        if path.length < 1.0:
            continue
        yield from parapet(np.array(path.coords), z, 0.3)


def parapet(line: Array, base: Array, thickness: float) -> Iterator[Mesh]:
    """A wall of 0.8 m from a line (N, 2) to its left, at heights (N,), with a steel rail on top."""
    back = np.array(LineString(line).offset_curve(thickness, join_style="mitre").coords)
    if len(back) != len(line):  # a bend so sharp that its inner side lost a corner
        back = line + thickness * _left_of(line)
    for a, b, material, top, bottom in ((line, back, "concrete", 0.8, -0.05),):
        high, low = base + top, base + bottom
        yield _strip(a, low, high, np.ones(len(a) - 1, bool), material)
        yield _strip(b[::-1], low[::-1], high[::-1], np.ones(len(a) - 1, bool), material)
        lid = np.stack(
            [
                np.column_stack([a[:-1], high[:-1]]),
                np.column_stack([a[1:], high[1:]]),
                np.column_stack([b[1:], high[1:]]),
                np.column_stack([b[:-1], high[:-1]]),
            ],
            axis=1,
        )
        yield quads(lid, "dressing")
        for end, step in ((0, 1), (-1, -1)):
            pair = np.array([b[end], a[end]])[::step]
            yield _strip(pair, np.full(2, low[end]), np.full(2, high[end]), np.ones(1, bool), material)
    middle = (line + back) / 2
    for side in (1.0, -1.0):
        rail = middle + 0.03 * side * _left_of(middle)
        path = rail if side < 0 else rail[::-1]
        z = (base if side < 0 else base[::-1]) + 1.0
        yield _strip(path, z, z + 0.07, np.ones(len(path) - 1, bool), "zinc")


def _left_of(line: Array) -> Array:
    """(N, 2) unit vectors to the left of a line at its points."""
    forward = np.gradient(line, axis=0)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    return np.stack([-forward[:, 1], forward[:, 0]], axis=1)


def _runs(chosen: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """First and one past the last index of each run of True."""
    edges = np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))
    yield from zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)


def rings(shape: Any) -> Iterator[Array]:
    """Rings (N, 2) of a region, with the region's inside on their right."""
    for polygon in polygons(shape):
        turned = shapely.geometry.polygon.orient(polygon, sign=-1.0)
        for ring in (turned.exterior, *turned.interiors):
            yield np.array(ring.coords)


# --------------------------------------------------------------------------------------------------- wear and repairs


def _tracks(layout: Layout, width: float) -> Any:
    """Where wheels run: two strips along each lane."""
    strips = []
    for edge in layout.edges:
        for lane in driven(edge):
            line = LineString(lane.getShape())
            strips += [line.offset_curve(side).buffer(width / 2, cap_style="flat") for side in (-0.82, 0.82)]
    return unary_union(strips).intersection(layout.detailed)


def _repairs(layout: Layout, rng: np.random.Generator) -> tuple[Any, Any, Any]:
    """Dark new patches, pale old ones, and bitumen: their sealed edges and sealed cracks."""
    new, old, cracks = [], [], []
    for edge in layout.edges:
        half = half_width(edge)
        for s in np.arange(rng.uniform(4.0, 14.0), driven(edge)[0].getLength() - 6.0, 15.0):
            s += rng.uniform(-4.0, 4.0)
            kind, across = rng.random(), rng.uniform(-0.8, 0.8) * half
            middle, heading = beside(edge, s, -half)
            if layout.camera_distance(middle) > FAR:
                continue
            at = middle + right_of(heading) * across
            shape = rectangle(at, heading, rng.uniform(1.2, 3.5), rng.uniform(0.8, 1.8))
            if kind < 0.22:
                new.append(shape)
            elif kind < 0.40:
                old.append(shape)
            elif kind < 0.52:  # a trench across the lanes
                new.append(rectangle(middle, heading, rng.uniform(0.6, 0.9), 2 * half))
            elif kind < 0.60:  # a trench along them
                old.append(rectangle(at, heading, rng.uniform(8.0, 16.0), 0.7))
            else:
                cracks.append(_crack(at, heading + rng.choice([0.0, 0.0, np.pi / 2]), rng))
    for node in layout.net.getNodes():
        if layout.camera_distance(np.array(node.getCoord())) > FAR or len(node.getShape()) < 4:
            continue
        if (area := Polygon(node.getShape()).buffer(-3.0)).area > 40:
            for kept in (new, old):
                at, heading = _within(area, rng), rng.uniform(0, np.pi)
                kept.append(rectangle(at, heading, rng.uniform(1.2, 2.6), 1.1))
            cracks += [_crack(_within(area, rng), rng.uniform(0, np.pi), rng) for _ in range(3)]
    seams = [shape.boundary.buffer(0.035, cap_style="flat") for shape in (*new, *old)]
    return unary_union(new), unary_union(old), unary_union([*seams, *cracks])


def _within(region: Any, rng: np.random.Generator) -> Array:
    """A random place (2,) inside a region."""
    x0, y0, x1, y1 = region.bounds
    while True:
        place = rng.uniform((x0, y0), (x1, y1))
        if region.contains(Point(place)):
            return np.asarray(place)


def _crack(at: Array, heading: float, rng: np.random.Generator) -> Polygon:
    """A wandering sealed crack of a few metres."""
    steps = int(rng.integers(6, 16))
    turn = heading + rng.normal(0.0, 0.45, steps)
    line = at + 0.45 * np.cumsum(np.stack([np.cos(turn), np.sin(turn)], axis=1), axis=0)
    return LineString(line).buffer(rng.uniform(0.015, 0.03), quad_segs=1, join_style="mitre")


def _covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    """Manhole covers in the lanes and drain grates in the gutters of roads with sidewalks."""
    for edge in layout.edges:
        if not layout.kind(edge).sidewalk:
            continue
        lanes = driven(edge)
        length = lanes[0].getLength()
        for s in np.arange(rng.uniform(5.0, 20.0), length - 4.0, 27.0):
            at = LineString(lanes[rng.integers(len(lanes))].getShape()).interpolate(s + rng.uniform(-6.0, 6.0))
            if layout.camera_distance(np.array([at.x, at.y])) < FAR:
                yield Point(at.x + rng.uniform(-0.3, 0.3), at.y + rng.uniform(-0.3, 0.3)).buffer(0.33, quad_segs=5)
        for s in np.arange(9.0, length - 4.0, 24.0):
            at, heading = beside(edge, s, -0.19)
            if layout.camera_distance(at) < FAR:
                yield rectangle(at, heading, 0.5, 0.3)


def _sidewalk_covers(layout: Layout, rng: np.random.Generator) -> Iterator[Polygon]:
    for edge in layout.edges:
        for s in np.arange(rng.uniform(3.0, 12.0), driven(edge)[0].getLength(), 13.0):
            at, heading = beside(edge, s + rng.uniform(-3.0, 3.0), rng.uniform(1.0, 1.9))
            if layout.camera_distance(at) > FAR:
                continue
            yield rectangle(at, heading, rng.choice([0.45, 0.6, 0.9]), 0.45)


def _tactile(layout: Layout, road: Any) -> Any:
    """Ribbed paving on the sidewalk at both ends of crossings."""
    stripes = unary_union(list(crossings(layout)))
    spans = polygons(stripes.buffer(0.6, join_style="mitre"))
    ends = unary_union([span.minimum_rotated_rectangle.buffer(0.8, join_style="mitre") for span in spans])
    return ends.intersection(road.buffer(KERB_WIDTH + 0.8))
