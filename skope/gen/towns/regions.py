"""Regions of the plane: the polygons of a shape, rectangles, and tests for free positions."""

from typing import Any, Final, TypeAlias

import numpy as np
import shapely
from shapely import MultiPolygon, Point, Polygon

from skope.types import Array

Region: TypeAlias = Polygon | MultiPolygon

GRID_M: Final = 1e-4
"""Grid to which the corners of polygons are rounded, metres; adjacent parts therefore keep common corners."""


def polygons(shape: Any) -> list[Polygon]:
    """Return the polygons of a shape, without slivers."""
    parts = getattr(shape, "geoms", [shape])
    return [part for part in parts if isinstance(part, Polygon) and part.area > 1e-4]


def rectangle_polygon(center: Array, heading: float, length: float, depth: float) -> Polygon:
    """Return a rectangle around a position (2,), `length` m along a heading (radians) and `depth` m across it."""
    c, s = np.cos(heading), np.sin(heading)
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * [length / 2, depth / 2]
    return Polygon(corners @ np.array([[c, s], [-s, c]]) + center)


def is_free(region: Any, position: Array, distance: float = 0.0) -> bool:
    """Return whether a position (2,) is outside a prepared region and at least `distance` metres from it."""
    point = Point(position)
    return not shapely.intersects(region, point) and (distance <= 0 or shapely.distance(region, point) >= distance)
