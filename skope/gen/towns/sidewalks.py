"""Paths of pedestrians: the middles of the sidewalks."""

from typing import Final

import numpy as np
import shapely
from shapely import LineString, Point
from shapely.ops import unary_union

from skope.gen.towns.land_use import KERB_WIDTH, Layout
from skope.gen.towns.road_graph import driven
from skope.gen.towns.town import Town
from skope.types import Array

_SHORTEST: Final = 20.0
"""Metres that are worth walking."""
_SPACING: Final = 5.0
"""Metres between the heights of a path."""


def sidewalks(town: Town, center: tuple[float, float], reach: float) -> list[Array]:
    """Middles (N, 3) of the sidewalks within `reach` metres of a place."""
    layout = Layout.of(town)
    graph = layout.graph
    around = Point(graph.world(center)).buffer(reach)
    out = []
    widths = sorted({graph.kind(edge).sidewalk for edge in graph.edges} - {0.0})
    for width in widths:
        edges = [edge for edge in graph.edges if graph.kind(edge).sidewalk == width]
        beyond = KERB_WIDTH + width / 2
        strips = [
            LineString(lane.getShape()).buffer(lane.getWidth() / 2 + KERB_WIDTH + width, cap_style="flat")
            for edge in edges
            if graph.kind(edge).form == "ground"
            for lane in driven(edge)
        ]
        own = unary_union(strips).buffer(width).intersection(layout.sidewalk).intersection(around)
        middle = shapely.line_merge(graph.road.buffer(beyond).boundary.intersection(own))
        out += [graph.world(_path(layout, line)) for line in _lines(middle) if line.length > _SHORTEST]
    return out


def _lines(shape: shapely.Geometry) -> list[LineString]:
    parts = getattr(shape, "geoms", [shape])
    return [part for part in parts if isinstance(part, LineString)]


def _path(layout: Layout, line: LineString) -> Array:
    marks = np.linspace(0, line.length, max(2, round(line.length / _SPACING)))
    xs = np.union1d(marks, [line.project(Point(point)) for point in line.coords])
    places = np.array([line.interpolate(x).coords[0] for x in xs])
    return np.array([layout.on_ground(place) for place in places])
