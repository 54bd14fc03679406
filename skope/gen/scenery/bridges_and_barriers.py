"""Bridges over roads, guard rails, noise barriers, sign gantries, and utility poles with their wires."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Point, Polygon
from shapely.ops import substring, unary_union

from skope.gen.mesh import Mesh, box, lathe, merged, quads, tube
from skope.gen.scenery.ground import Part, left_of, parapet, rings, runs_of_true, surfaces
from skope.gen.scenery.markings import markings
from skope.gen.scenery.quads import Solid
from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.regions import polygons
from skope.gen.towns.road_graph import ROAD_LIMITS, RoadGraph, beside, driven, half_width, right_of
from skope.types import Array


@dataclass(frozen=True)
class BridgeSizes:
    """Sizes of bridges and gantries."""

    deck_thickness_m: float = 1.1
    """Thickness of bridge decks, metres."""
    gantry_clearance_m: float = 5.7
    """Clearance under signs above the road, metres."""
    deck_cell_m: float = 3.0
    """Length of the parts of a deck, metres."""


BRIDGE_SIZES: Final = BridgeSizes()


def structures(layout: Layout) -> Iterator[Mesh]:
    graph = layout.graph
    drawn = unary_union(list(markings(graph))) if graph.decks else Polygon()
    for deck in graph.decks:
        yield from _bridge(layout, deck, drawn)
    yield from _guard_rails(layout)
    yield from _noise_barriers(layout)
    for gantry in layout.style.gantries:
        yield _gantry(layout, graph.net.getEdge(gantry.edge), gantry.at, gantry.signs)
    yield from _wires(layout)
    yield from _median_barriers(layout)


# -------------------------------------------------------------------------------------------------------------- bridges


def _bridge(layout: Layout, deck: Polygon, drawn: Any) -> Iterator[Mesh]:
    """Yield a deck with its carriageway, sidewalks and parapets, its sides and underside, and piers."""
    walk, kerb = layout.deck_edge, layout.style.kerb
    lanes = layout.graph.deck_lanes

    def height(places: Array) -> Array:
        return lanes.near(places, 40.0)[0]

    x0, y0, x1, y1 = deck.buffer(walk).bounds
    xs, ys = (
        np.arange(low, high + BRIDGE_SIZES.deck_cell_m, BRIDGE_SIZES.deck_cell_m) for low, high in ((x0, x1), (y0, y1))
    )
    cells = np.array(
        [shapely.box(x, y, x + BRIDGE_SIZES.deck_cell_m, y + BRIDGE_SIZES.deck_cell_m) for x in xs for y in ys],
        dtype=object,
    )
    marked = drawn.intersection(deck)
    yield from surfaces([Part("marking", marked, True), Part("asphalt", deck.difference(marked), True)], height, cells)
    whole = _widened_deck(layout.graph, deck, walk)
    beside_lanes = whole.difference(deck)
    stone = beside_lanes.intersection(deck.buffer(LAND_USE.kerb_m))
    yield from surfaces(
        [Part("kerb", stone, False), Part("sidewalk", beside_lanes.difference(stone), False)],
        lambda places: height(places) + kerb,
        cells,
    )
    for polygon in polygons(beside_lanes):
        for ring in rings(polygon):
            line = np.array(shapely.segmentize(LineString(ring), BRIDGE_SIZES.deck_cell_m).coords)
            z = height(line) + kerb
            inner = shapely.distance(deck, shapely.points(line)) < 0.05
            is_kerb = inner[:-1] & inner[1:]
            yield _vertical_faces(line, z - kerb, z, is_kerb, "kerb")
            yield _vertical_faces(line, z - BRIDGE_SIZES.deck_thickness_m, z, ~is_kerb, "concrete")
            outer = shapely.distance(deck, shapely.points(line)) > walk - 0.05
            yield from _edge_parapets(line, z, outer[:-1] & outer[1:])
    soffit = [Part("concrete", whole, False)]
    for part in surfaces(soffit, lambda places: height(places) - BRIDGE_SIZES.deck_thickness_m, cells):
        yield Mesh(part.vertices, -part.normals, part.triangles[:, ::-1], part.materials, part.material)
    yield from _end_faces(deck, height)
    yield from _piers(layout, deck, whole, height)


def _widened_deck(graph: RoadGraph, deck: Polygon, walk: float) -> Polygon:
    """Return a deck that is widened only to both sides of its lanes."""
    parts = [deck]
    for edge in graph.edges_of("bridge"):
        lane = driven(edge)[0]
        line = LineString(lane.getShape())
        if line.intersects(deck):
            strip = line.offset_curve(-(lane.getWidth() + walk) / 2)
            parts.append(strip.buffer(walk / 2 + 0.005, cap_style="flat"))
    return max(
        polygons(unary_union(parts).buffer(0.02, join_style="mitre").buffer(-0.02, join_style="mitre")),
        key=lambda p: p.area,
    )


def _vertical_faces(line: Array, low: Array, high: Array, chosen: NDArray[np.bool_], material: str) -> Mesh:
    """Return vertical faces along a ring (N, 2) with its inside on the right, visible from outside."""
    a, b = line[1:][chosen], line[:-1][chosen]
    za, zb, ta, tb = low[1:][chosen], low[:-1][chosen], high[1:][chosen], high[:-1][chosen]
    corners = np.stack(
        [np.column_stack([a, za]), np.column_stack([b, zb]), np.column_stack([b, tb]), np.column_stack([a, ta])], axis=1
    )
    return quads(corners.reshape(-1, 4, 3), material)


def _edge_parapets(line: Array, z: Array, chosen: NDArray[np.bool_]) -> Iterator[Mesh]:
    for first, last in runs_of_true(chosen):
        piece = slice(first, last + 1)
        if LineString(line[piece]).length > 2.0:
            # The ring has its inside on its right; a parapet is to the left of its line.
            yield from parapet(line[piece][::-1], z[piece][::-1], 0.3)


def _end_faces(deck: Polygon, height: Any) -> Iterator[Mesh]:
    """Yield the deck's ends under the carriageway."""
    for ring in rings(deck):
        z = height(ring)
        yield _vertical_faces(
            ring, z - BRIDGE_SIZES.deck_thickness_m, z - 0.03, np.ones(len(ring) - 1, dtype=bool), "concrete"
        )


def _piers(layout: Layout, deck: Polygon, whole: Polygon, height: Any) -> Iterator[Mesh]:
    """Yield columns under a crossbeam wherever the deck crosses a gap between carriageways."""
    axis = _deck_axis(layout.graph, deck)
    kept_clear = layout.graph.ground_road.buffer(0.55)
    shapely.prepare(kept_clear)
    spots = np.arange(0.15, 0.85, 0.5 / axis.length) * axis.length
    places = np.array([axis.interpolate(s).coords[0] for s in spots])
    drop = height(places) - layout.ground.beside(places)
    fits = (drop > 4.5) & ~shapely.intersects(kept_clear, shapely.points(places))
    for first, last in runs_of_true(fits):
        k = (first + last - 1) // 2
        if spots[last - 1] - spots[first] > 6.0:
            continue  # a bank near the end of the deck
        ahead = np.array(axis.interpolate(spots[k] + 0.5).coords[0])
        heading = float(np.arctan2(*(ahead - places[k])[::-1]))
        half = whole.area / axis.length / 2 - 0.6
        top, foot = (
            float(height(places[k : k + 1])[0]) - BRIDGE_SIZES.deck_thickness_m,
            float(layout.ground.beside(places[k : k + 1])[0]),
        )
        beam = box([-0.5, -half, top - foot - 0.8], [0.5, half, top - foot + 0.05], "concrete")
        columns = [
            lathe([(-0.3, 0.42), (top - foot - 0.7, 0.42)], ["concrete"], 14, "z").moved([0, y, 0])
            for y in np.linspace(-half + 1.2, half - 1.2, 3)
        ]
        yield merged([beam, *columns]).moved([*places[k], foot], heading)


def _deck_axis(graph: RoadGraph, deck: Polygon) -> LineString:
    """Return the line along a deck's middle."""
    lines = [LineString(driven(edge)[-1].getShape()) for edge in graph.edges_of("bridge")]
    edge_line = max((line for line in lines if line.intersects(deck)), key=lambda line: line.length)
    middle = deck.centroid
    foot = edge_line.interpolate(edge_line.project(middle))
    return shapely.affinity.translate(edge_line, middle.x - foot.x, middle.y - foot.y)


# ---------------------------------------------------------------------------------------------------------- guard rails


def _guard_rails(layout: Layout) -> Iterator[Mesh]:
    """Yield guard rails on the right of roads that have them and in medians, except where carriageways join."""
    graph = layout.graph
    for edge in graph.edges:
        lanes, kind = driven(edge), graph.kind(edge)
        if not kind.guard_rails or kind.form != "ground":
            continue
        lines = [LineString(lanes[0].getShape()).offset_curve(-(lanes[0].getWidth() / 2 + kind.shoulder + 0.35))]
        if layout.style.median_rails:
            lines.append(LineString(lanes[-1].getShape()).offset_curve(lanes[-1].getWidth() / 2 + 0.75).reverse())
        kept_clear = graph.road.buffer(0.3)
        for line in lines:
            left = line.difference(kept_clear)
            for piece in getattr(left, "geoms", [left]):
                if isinstance(piece, LineString) and piece.length > 8.0:
                    near = layout.camera_distance(np.array(piece.interpolate(0.5, normalized=True).coords[0])) < 120.0
                    yield layout.draped(_rail(shapely.segmentize(piece.simplify(0.02), 4.0), near))


def _rail(path: LineString, near: bool) -> Mesh:
    """Return a beam of two waves on posts, at height 0.75 m; traffic drives on its left-hand side."""
    line = np.array(path.coords)
    profile = [(0.45, 0.0), (0.50, 0.08), (0.58, 0.02), (0.66, 0.08), (0.75, 0.0)]
    faces = []
    left = left_of(line)
    for (z0, y0), (z1, y1) in itertools.pairwise(profile):
        low = np.column_stack([line + y0 * left, np.full(len(line), z0)])
        high = np.column_stack([line + y1 * left, np.full(len(line), z1)])
        faces.append(np.stack([low[1:], low[:-1], high[:-1], high[1:]], axis=1))
    beam = quads(np.concatenate(faces), "zinc")
    posts = Solid()
    spacing = 2.0 if near else 4.0
    for s in np.arange(0.3, path.length, spacing):
        x, y = path.interpolate(s).coords[0]
        posts.box("zinc", (x - 0.05, y - 0.05, -0.4), (x + 0.05, y + 0.05, 0.72), without="-z")
    return merged([beam, posts.mesh()])


def _median_barriers(layout: Layout) -> Iterator[Mesh]:
    """Yield concrete barriers between the directions of roads between retaining walls."""
    walled = layout.graph.edges_of("walled")
    for edge in walled:
        lane = driven(edge)[-1]
        line = LineString(lane.getShape())
        other_lines = [LineString(driven(other_edge)[-1].getShape()) for other_edge in walled if other_edge is not edge]
        gap = min((line.distance(other_line) for other_line in other_lines), default=99.0) - lane.getWidth()
        if not 0.6 < gap < 2 * ROAD_LIMITS.barrier_m or any(other_edge.getID() < edge.getID() for other_edge in walled):
            continue
        path = np.array(shapely.segmentize(line.offset_curve((lane.getWidth() + gap) / 2), 3.0).coords)
        z = layout.ground.road(path)
        profile = [
            (0.3, 0.0),
            (0.3, 0.08),
            (0.12, 0.33),
            (0.08, 0.85),
            (-0.08, 0.85),
            (-0.12, 0.33),
            (-0.3, 0.08),
            (-0.3, 0.0),
        ]
        left = right_of(np.pi / 2 + np.arctan2(*(path[-1] - path[0])[::-1])) * -1.0
        rows = [np.column_stack([path - y * left, z + h]) for y, h in profile]
        faces = [np.stack([a[:-1], a[1:], b[1:], b[:-1]], axis=1) for a, b in itertools.pairwise(rows)]
        yield quads(np.concatenate(faces), "concrete")


# ----------------------------------------------------------------------------------------------- barriers and gantries


def _noise_barriers(layout: Layout) -> Iterator[Mesh]:
    """Yield noise barriers of panels between steel posts."""
    for name, start, end in layout.style.barriers:
        edge = layout.graph.net.getEdge(name)
        lane, kind = driven(edge)[0], layout.graph.kind(edge)
        offset = lane.getWidth() / 2 + max(kind.shoulder, kind.sidewalk) + 2.2
        line = substring(LineString(lane.getShape()).offset_curve(-offset), start, end)
        for s in np.arange(0.0, line.length - 4.0, 4.0):
            a, b = (np.array(line.interpolate(t).coords[0]) for t in (s, s + 4.0))
            heading = float(np.arctan2(*(b - a)[::-1]))
            part = Solid()
            part.box("concrete", (-2.0, -0.1, -0.3), (2.0, 0.1, 0.5), without="-z")
            part.box(
                "cladding_sand" if int(s / 4) % 5 else "door_green", (-2.0, -0.06, 0.5), (2.0, 0.06, 3.4), without="-z"
            )
            part.box("zinc", (-2.09, -0.12, -0.3), (-1.91, 0.12, 3.55), without="-z")
            yield part.mesh().moved(layout.on_ground((a + b) / 2), heading)


def _gantry(layout: Layout, edge: Any, at: float, signs: tuple[str, ...]) -> Mesh:
    """Return a truss on two posts over an edge's lanes, with signs that face its traffic."""
    lanes, kind = driven(edge), layout.graph.kind(edge)
    s = at if at >= 0 else lanes[0].getLength() + at
    width = 2 * half_width(edge)
    middle, heading = beside(edge, s, -half_width(edge))
    right, left = width / 2 + kind.shoulder + 1.0, width / 2 + 1.1
    road_z = float(layout.ground.road(middle[None])[0])
    low = BRIDGE_SIZES.gantry_clearance_m + 0.4
    out = Solid()
    for y in (-right, left):
        out.box("concrete", (-0.5, y - 0.4, -0.5), (0.5, y + 0.4, 0.7), without="-z")
        out.box("zinc", (-0.2, y - 0.2, 0.7), (0.2, y + 0.2, low + 1.4), without="-z")
    for x in (-0.45, 0.45):
        for z in (low, low + 1.2):
            out.box("zinc", (x - 0.07, -right, z), (x + 0.07, left, z + 0.14))
    for k, y in enumerate(np.arange(-right, left - 1.2, 1.2)):
        z0, z1 = (low + 0.1, low + 1.25) if k % 2 else (low + 1.25, low + 0.1)
        for x in (-0.45, 0.45):
            out.face("zinc", (x, y, z0), (x, y + 1.2, z1), (x, y + 1.2, z1 + 0.09), (x, y, z0 + 0.09))
            out.face("zinc", (x, y, z0 + 0.09), (x, y + 1.2, z1 + 0.09), (x, y + 1.2, z1), (x, y, z0))
    share = (width + kind.shoulder) / len(signs)
    for k, color in enumerate(signs):
        y = width / 2 - (k + 0.5) * share
        half, bottom, top = (
            0.44 * share,
            BRIDGE_SIZES.gantry_clearance_m,
            BRIDGE_SIZES.gantry_clearance_m + min(2.9, 0.7 * share),
        )
        out.box("lettering", (-0.62, y - half, bottom), (-0.56, y + half, top))
        out.box(color, (-0.66, y - half + 0.08, bottom + 0.08), (-0.62, y + half - 0.08, top - 0.08), without="+x")
        for row, (reach, thick) in enumerate(((0.8, 0.26), (0.55, 0.22), (0.7, 0.22))):
            z = top - 0.55 - 0.72 * row
            if z > bottom + 0.2:
                for word in np.arange(-half * reach, half * reach - 0.2, 0.42):
                    out.box("lettering", (-0.68, y + word, z), (-0.665, y + word + 0.3, z + thick), without="+x")
    return out.mesh().moved([*middle, road_z], heading)


# ---------------------------------------------------------------------------------------------------------------- wires


def _wires(layout: Layout) -> Iterator[Mesh]:
    """Yield timber poles every 38 m along the right of roads that have them, with three sagging wires between them."""
    graph = layout.graph
    kept_clear = unary_union([graph.road.buffer(1.2), layout.sightlines(30.0)])
    shapely.prepare(kept_clear)
    for edge in graph.edges:
        kind = graph.kind(edge)
        if not kind.wires:
            continue
        offset = max(kind.sidewalk, kind.shoulder + 2.0) + 1.2
        before: tuple[Array, float] | None = None
        for s in np.arange(14.0, driven(edge)[0].getLength(), 38.0):
            position, heading = beside(edge, float(s), offset)
            if shapely.intersects(kept_clear, Point(position)):
                before = None
                continue
            if before is not None and LineString([before[0][1, :2], position]).intersects(layout.around_cameras):
                before = None
            foot = layout.height(position)
            yield _pole().moved([*position, foot], heading)
            tops = np.array([[0.0, y, 8.6] for y in (-0.9, 0.0, 0.9)])
            c, n = np.cos(heading), np.sin(heading)
            tops = tops @ np.array([[c, n, 0], [-n, c, 0], [0, 0, 1]]) + [*position, foot]
            if before is not None:
                for a, b in zip(before[0], tops, strict=True):
                    share = np.linspace(0, 1, 9)[:, None]
                    sag = -1.1 * 4 * share * (1 - share) * np.array([0.0, 0.0, 1.0])
                    yield tube(a + share * (b - a) + sag, [0.014] * 9, "iron", 3)
            before = tops, foot


def _pole() -> Mesh:
    pole = lathe([(-0.4, 0.16), (9.2, 0.1), (9.22, 0.0)], ["timber"] * 2, 7, "z")
    arm = box([-0.06, -1.1, 8.3], [0.06, 1.1, 8.44], "timber")
    pins = [box([-0.04, y - 0.04, 8.44], [0.04, y + 0.04, 8.6], "iron") for y in (-0.9, 0.0, 0.9)]
    return merged([pole, arm, *pins])
