"""Ground as polygons in the plane, raised to the ground's heights.

Kerbs, retaining walls and parapets along its edges. Each part is cut out of the parts below it. Surfaces do not
overlap, and neighbours share their corners.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Polygon
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, from_triangles, quads
from skope.gen.scenery.markings import covers, markings, repairs, sidewalk_covers, tracks, zebra_stripes
from skope.gen.towns.land_use import LAND_USE, Layout, bay_lines
from skope.gen.towns.regions import GRID_M, polygons, rectangle_polygon
from skope.gen.towns.road_graph import RoadGraph
from skope.gen.towns.terrain import TERRAIN_CELLS
from skope.types import Array


@dataclass(frozen=True)
class GroundSizes:
    """Sizes of kerbs, walls and the ground."""

    wall_m: float = 0.4
    """Minimum height of a step between carriageway and ground that is a retaining wall, metres."""
    kerb_piece_m: float = 2.0
    """Length of the segments of kerbs on slopes, metres."""
    margin_m: float = 320.0
    """Margin of the ground beyond the network, metres."""
    gutter_m: float = 0.32
    """Width of a gutter, metres."""


GROUND_SIZES: Final = GroundSizes()


def kerbs(layout: Layout) -> Iterator[Mesh]:
    """Yield kerbs and retaining walls between the carriageway and the ground beside it, with parapets on high walls."""
    ground = layout.ground
    decks = unary_union([deck.buffer(layout.deck_edge, join_style="mitre") for deck in layout.graph.decks])
    for ring in rings(shapely.set_precision(layout.graph.ground_road, GRID_M)):
        line = ring if ground.flat else np.array(shapely.segmentize(LineString(ring), GROUND_SIZES.kerb_piece_m).coords)
        low, high = ground.road(line), ground.beside(line) + layout.style.kerb
        under = shapely.intersects(decks, shapely.linestrings(np.stack([line[:-1], line[1:]], axis=1)))
        for chosen, material in (
            (high - low <= GROUND_SIZES.wall_m, "kerb"),
            (high - low > GROUND_SIZES.wall_m, "concrete"),
        ):
            strip = chosen[:-1] if material == "kerb" else ~(high - low <= GROUND_SIZES.wall_m)[:-1]
            if not strip.any() or (material == "kerb" and (high - low)[chosen].max() < 1e-6):
                continue
            top = high.copy()
            if material == "concrete":
                covered = np.zeros(len(line), dtype=bool)
                covered[:-1] |= under
                covered[1:] |= under
                top[covered] -= 0.5
            yield _wall_strip(line, low, top, strip, material)
            if material == "concrete":
                yield from _parapets_along(line, high, strip & ~under)


def _wall_strip(line: Array, low: Array, high: Array, chosen: NDArray[np.bool_], material: str) -> Mesh:
    """Return vertical quadrilaterals along a line (N, 2), between two heights per point, facing its right-hand side."""
    start, end = np.column_stack([line[:-1], low[:-1]]), np.column_stack([line[1:], low[1:]])
    over_end, over_start = np.column_stack([line[1:], high[1:]]), np.column_stack([line[:-1], high[:-1]])
    corners = np.stack([start, end, over_end, over_start], axis=1)
    proper = chosen & (np.hypot(*(line[1:] - line[:-1]).T) > 1e-6)
    return quads(corners[proper], material)


def _parapets_along(line: Array, base: Array, chosen: NDArray[np.bool_]) -> Iterator[Mesh]:
    """Yield a low wall on a line's left-hand side, with a rail on it."""
    for first, last in runs_of_true(chosen):
        path, z = LineString(line[first : last + 1]), base[first : last + 1]
        if path.length < 1.0:
            continue
        yield from parapet(np.array(path.coords), z, 0.3)


def parapet(line: Array, base: Array, thickness: float) -> Iterator[Mesh]:
    """Yield a wall of 0.8 m height from a line (N, 2) to its left, at heights (N,), with a steel rail on top."""
    back = np.array(LineString(line).offset_curve(thickness, join_style="mitre").coords)
    if len(back) != len(line):  # a bend so sharp that its inner side lost a corner
        back = line + thickness * left_of(line)
    for a, b, material, top, bottom in ((line, back, "concrete", 0.8, -0.05),):
        high, low = base + top, base + bottom
        yield _wall_strip(a, low, high, np.ones(len(a) - 1, bool), material)
        yield _wall_strip(b[::-1], low[::-1], high[::-1], np.ones(len(a) - 1, bool), material)
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
            yield _wall_strip(pair, np.full(2, low[end]), np.full(2, high[end]), np.ones(1, bool), material)
    middle = (line + back) / 2
    for side in (1.0, -1.0):
        rail = middle + 0.03 * side * left_of(middle)
        path = rail if side < 0 else rail[::-1]
        z = (base if side < 0 else base[::-1]) + 1.0
        yield _wall_strip(path, z, z + 0.07, np.ones(len(path) - 1, bool), "zinc")


def left_of(line: Array) -> Array:
    """Return unit vectors (N, 2) to the left of a line at its points."""
    forward = np.gradient(line, axis=0)
    forward /= np.maximum(np.linalg.norm(forward, axis=1, keepdims=True), 1e-9)
    return np.stack([-forward[:, 1], forward[:, 0]], axis=1)


def runs_of_true(chosen: NDArray[np.bool_]) -> Iterator[tuple[int, int]]:
    """Yield the first and one past the last index of each run of True."""
    edges = np.diff(np.concatenate([[0], chosen.astype(np.int8), [0]]))
    yield from zip(np.flatnonzero(edges == 1).tolist(), np.flatnonzero(edges == -1).tolist(), strict=True)


def rings(shape: Any) -> Iterator[Array]:
    """Yield the rings (N, 2) of a region, with the region's inside on their right."""
    for polygon in polygons(shape):
        turned = shapely.geometry.polygon.orient(polygon, sign=-1.0)
        for ring in (turned.exterior, *turned.interiors):
            yield np.array(ring.coords)


@dataclass(frozen=True)
class Part:
    """Share of the ground with one material."""

    material: str
    region: Any
    carriageway: bool


@dataclass(frozen=True)
class Beside:
    """Areas beside the carriageway that other modules define: paths, drives, car parks."""

    forecourts: Any
    walks: Any
    drives: Any
    parking: Any
    lay_bys: Any
    """Bays along kerbs."""
    footings: Any
    """Bare soil at the foot of walls."""
    pits: Any
    """Bare soil around trees in the sidewalk."""


def ground_parts(
    layout: Layout, beside_road: Beside, rng: np.random.Generator, hatched: Sequence[Polygon] = ()
) -> list[Part]:
    """Return all parts of the ground; parts beside the carriageway lie a kerb's height above it.

    `hatched` are stripes that are painted on the carriageway in addition to its usual markings.
    """
    graph = layout.graph
    road = shapely.set_precision(graph.ground_road, GRID_M)
    kerbed = layout.style.kerb > 0
    x0, y0, x1, y1 = road.bounds
    everywhere = shapely.box(
        x0 - GROUND_SIZES.margin_m, y0 - GROUND_SIZES.margin_m, x1 + GROUND_SIZES.margin_m, y1 + GROUND_SIZES.margin_m
    )
    patches, old, seals = repairs(layout, rng)
    street = _share_out(
        road,
        [
            ("cover", unary_union(list(covers(layout, rng)))),
            ("marking", unary_union([*markings(graph), *zebra_stripes(graph), *hatched])),
            ("bitumen", seals),
            ("asphalt_patch", patches),
            ("asphalt_old", old),
            ("gutter", road.difference(road.buffer(-GROUND_SIZES.gutter_m)) if kerbed else Polygon()),
            ("asphalt_polished", tracks(layout, 0.3)),
            ("asphalt_worn", tracks(layout, 0.62)),
            ("asphalt", road),
        ],
        carriageway=True,
    )
    kerb = road.difference(graph.walled_road).buffer(LAND_USE.kerb_m, join_style="mitre") if kerbed else Polygon()
    sidewalk, islands = layout.sidewalk, layout.islands
    flush = _flush_decks(layout)
    beyond = _share_out(
        everywhere.difference(road).difference(flush),
        [
            ("kerb", kerb),
            ("cover", unary_union(list(sidewalk_covers(layout, rng))).intersection(sidewalk)),
            ("tactile", _tactile_paving(graph, road).intersection(sidewalk)),
            ("soil", beside_road.pits.intersection(sidewalk)),
            (layout.style.median, islands.buffer(0.01)),
            ("asphalt_old", layout.beside_lanes("shoulder")),
            ("asphalt_old", beside_road.lay_bys),
            ("sidewalk", sidewalk.union(beside_road.forecourts)),
            ("paving", unary_union([beside_road.walks, graph.walled_road.buffer(4.5), *layout.under_decks])),
            ("marking", bay_lines(beside_road.parking)),
            ("asphalt_old", beside_road.parking),
            ("gravel", beside_road.drives),
            ("soil", beside_road.footings),
            ("paving", sidewalk.buffer(layout.style.plaza) if layout.style.plaza else Polygon()),
            *_fields(layout, everywhere.difference(beside_road.footings.buffer(9.0)), rng),
            ("grass", everywhere),
        ],
        carriageway=False,
    )
    return [*street, *beyond]


def _share_out(whole: Any, layers: Sequence[tuple[str, Any]], *, carriageway: bool) -> list[Part]:
    """Divide a region: each layer gets its part of the area that the previous layers left."""
    out, left = [], shapely.set_precision(whole, GRID_M)
    for material, region in layers:
        if region.is_empty:
            continue
        region = _only_polygons(shapely.set_precision(region, GRID_M))
        out.append(Part(material, _only_polygons(shapely.intersection(left, region, grid_size=GRID_M)), carriageway))
        left = _only_polygons(shapely.difference(left, region, grid_size=GRID_M))
    return out


def _only_polygons(shape: Any) -> Any:
    """Return a shape without the points and lines that overlays leave."""
    return shapely.MultiPolygon(polygons(shape))


def _flush_decks(layout: Layout) -> Any:
    """Return decks, with sidewalks, that continue the ground beside the carriageway that they cross."""
    graph = layout.graph
    out = []
    for deck in graph.decks:
        beside_road = deck.buffer(layout.deck_edge, join_style="mitre").difference(graph.ground_road.buffer(0.01))
        corners = np.array(deck.exterior.coords)
        above, _ = graph.deck_lanes.near(corners, 10.0)
        if np.abs(above - layout.ground.beside(corners)).max() < 0.3:
            out.append(beside_road)
    return unary_union(out)


def _fields(layout: Layout, everywhere: Any, rng: np.random.Generator) -> Iterator[tuple[str, Any]]:
    """Yield open ground in strips and squares of several kinds, away from the roads."""
    kinds = layout.style.open_ground
    if len(kinds) < 2:
        return
    away = everywhere.difference(layout.graph.road.buffer(layout.style.fields_from))
    x0, y0, x1, y1 = everywhere.bounds
    shares: dict[str, list[Any]] = {kind: [] for kind in kinds}
    turn = rng.uniform(-0.3, 0.3)
    for x in np.arange(x0 - 200.0, x1 + 200.0, 118.0):
        for y in np.arange(y0 - 200.0, y1 + 200.0, 86.0):
            size = (rng.uniform(90.0, 112.0), rng.uniform(62.0, 80.0))
            kind = kinds[rng.integers(len(kinds))]
            shares[kind].append(rectangle_polygon(np.array([x, y]), 0.0, *size))
    for kind, shapes in shares.items():
        if shapes:
            yield kind, shapely.affinity.rotate(unary_union(shapes), turn, (0, 0), True).intersection(away)


# ------------------------------------------------------------------------------------------------------------- surfaces


def ground_meshes(layout: Layout, parts: Sequence[Part]) -> Iterator[Mesh]:
    """Yield the parts as meshes at the ground's heights, and the kerbs between them."""
    kerb, ground = layout.style.kerb, layout.ground
    x0, y0, x1, y1 = layout.graph.ground_road.bounds
    bounds = (
        x0 - GROUND_SIZES.margin_m,
        y0 - GROUND_SIZES.margin_m,
        x1 + GROUND_SIZES.margin_m,
        y1 + GROUND_SIZES.margin_m,
    )
    cells = None if ground.flat else ground.cells(bounds, layout.graph.ground_road)
    heights: dict[bool, Callable[[Array], Array]] = {
        True: ground.road,
        False: lambda places: ground.beside(places) + kerb,
    }
    for carriageway, height in heights.items():
        yield from surfaces([part for part in parts if part.carriageway is carriageway], height, cells)
    yield from kerbs(layout)


def surfaces(
    parts: Sequence[Part], height: Callable[[Array], Array], cells: NDArray[np.object_] | None
) -> Iterator[Mesh]:
    """Yield parts of the plane, raised to a height at each corner; parts that are not level are cut into cells."""
    shapes, owners = [], []
    for number, part in enumerate(parts):
        pieces = polygons(part.region) if cells is None else _in_cells(polygons(part.region), cells)
        shapes += pieces
        owners += [number] * len(pieces)
    triangles, shape = shapely.get_parts(shapely.constrained_delaunay_triangles(shapes), return_index=True)
    corners = shapely.get_coordinates(triangles).reshape(-1, 4, 2)[:, :3]
    clockwise = ~shapely.is_ccw(shapely.get_exterior_ring(triangles))
    corners[clockwise] = corners[clockwise, ::-1]
    points, index = np.unique(corners.reshape(-1, 2).round(4), axis=0, return_inverse=True)
    whole = from_triangles(np.column_stack([points, height(points)]), index.reshape(-1, 3), "")
    names = tuple(dict.fromkeys(part.material for part in parts))
    material = np.array([names.index(part.material) for part in parts])[np.array(owners)[shape]]
    yield Mesh(whole.vertices, whole.normals, whole.triangles, names, material)


def _in_cells(shapes: Sequence[Polygon], cells: NDArray[np.object_]) -> list[Polygon]:
    """Return pieces of polygons, one cell each.

    The polygons are first cut by large squares, so that no large polygon is cut often.
    """
    low, high = (
        np.floor(shapely.total_bounds(cells)[:2] / TERRAIN_CELLS.coarsest_m),
        shapely.total_bounds(cells)[2:] / TERRAIN_CELLS.coarsest_m,
    )
    x, y = np.meshgrid(*(TERRAIN_CELLS.coarsest_m * np.arange(a, b) for a, b in zip(low, high, strict=True)))
    squares = shapely.box(x, y, x + TERRAIN_CELLS.coarsest_m, y + TERRAIN_CELLS.coarsest_m).ravel()
    return _cut_by(_cut_by(shapes, squares, GRID_M), cells, None)


def _cut_by(shapes: Sequence[Polygon], cells: NDArray[np.object_], precision: float | None) -> list[Polygon]:
    whole = np.array(shapes, dtype=object)
    shapely.prepare(whole)
    number, cell = shapely.STRtree(cells).query(whole, predicate="intersects")
    inside = shapely.covers(whole[number], cells[cell])
    cut = shapely.intersection(whole[number[~inside]], cells[cell[~inside]], grid_size=precision)
    return [*cells[cell[inside]], *(polygon for piece in cut for polygon in polygons(piece))]


def _tactile_paving(graph: RoadGraph, road: Any) -> Any:
    """Return ribbed paving on the sidewalk at both ends of crossings."""
    stripes = unary_union(list(zebra_stripes(graph)))
    spans = polygons(stripes.buffer(0.6, join_style="mitre"))
    ends = unary_union([span.minimum_rotated_rectangle.buffer(0.8, join_style="mitre") for span in spans])
    return ends.intersection(road.buffer(LAND_USE.kerb_m + 0.8))
