"""Where people walk: along the middle of the sidewalks."""

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import LineString, Point

from skope.gen.towns.layout import KERB_HEIGHT, SIDEWALK, Layout

Array = NDArray[np.float64]


def sidewalks(town: str, center: tuple[float, float], reach: float) -> list[Array]:
    """Middles (N, 3) of the sidewalks within `reach` metres of a place."""
    road = Layout.of(town).road.intersection(Point(center).buffer(reach + 50))
    middle = shapely.line_merge(road.buffer(0.6 * SIDEWALK).boundary.intersection(Point(center).buffer(reach)))
    lines = [line for line in getattr(middle, "geoms", [middle]) if isinstance(line, LineString) and line.length > 20]
    return [np.column_stack([np.array(line.coords), np.full(len(line.coords), KERB_HEIGHT)]) for line in lines]
