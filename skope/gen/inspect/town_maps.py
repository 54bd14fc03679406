"""Maps of towns, and a network's lanes drawn over the image of a site's camera.

A map shows the plan with roads, buildings, trees and its cameras. The lanes show whether network and camera match.
"""

from dataclasses import dataclass
from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from skope.gen.scenery.build import scenery
from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.regions import polygons
from skope.gen.towns.road_graph import RoadGraph, driven
from skope.gen.towns.town import OwnRoad, Town
from skope.pictures.draw import DRAWING_STYLE
from skope.types import Array, Pixels

PlotColor = tuple[int, int, int]


@dataclass(frozen=True)
class TownMapStyle:
    """Appearance of a town's map."""

    longer_px: int = 1600
    """Longer side of the map, pixels."""
    view_m: float = 60.0
    """Length of view cones, metres."""
    frame_m: float = 30.0
    """Width of the ground around the network, metres."""
    drawn_within_m: float = 200.0
    """Maximum distance of lanes that are drawn, metres."""
    sample_m: float = 1.0
    """Spacing of the points of a lane, metres."""
    arrow_spacing_m: float = 15.0
    """Distance between arrows, metres."""
    background: int = 90
    """Grey level of the background, 0 to 255."""


TOWN_MAP: Final = TownMapStyle()

_GROUND, _WALK, _ROAD_COLORS, _DECK, _ISLAND = (
    (228, 230, 218),
    (205, 203, 197),
    (120, 122, 126),
    (88, 90, 98),
    (188, 202, 168),
)
_HOUSE, _TREE, _TEXT = (196, 168, 148), (150, 180, 130), (30, 30, 34)
SPLIT_RGB: Final[dict[str, PlotColor]] = {
    "train": (40, 110, 200),
    "easy": (50, 150, 70),
    "medium": (220, 140, 30),
    "hard": (205, 50, 45),
    "extra": (130, 70, 170),
}


def town_map(town: Town) -> Pixels:
    """Return the map (H, W, 3), RGB, with north at the top."""
    layout = Layout.of(town)
    x0, y0, x1, y1 = layout.graph.road.buffer(TOWN_MAP.frame_m).bounds
    scale = TOWN_MAP.longer_px / max(x1 - x0, y1 - y0)
    image = np.full((round((y1 - y0) * scale) + 60, round((x1 - x0) * scale), 3), _GROUND, dtype=np.uint8)

    def pixels(points: ArrayLike) -> NDArray[np.int32]:
        at = (np.asarray(points)[..., :2] - [x0, y1]) * [scale, -scale] + [0, 60]
        return np.asarray(np.rint(at * 2**DRAWING_STYLE.subpixel_bits), dtype=np.int32)

    def fill(region: Any, color: PlotColor) -> None:
        for polygon in polygons(region):
            outline = [pixels(ring.coords) for ring in (polygon.exterior, *polygon.interiors)]
            cv2.fillPoly(image, outline, color, cv2.LINE_AA, DRAWING_STYLE.subpixel_bits)

    fill(layout.sidewalk, _WALK)
    built = scenery(town)
    for footprint in built.buildings:
        fill(footprint, _HOUSE)
    for x, y, reach in built.trees:
        cv2.circle(
            image,
            pixels([x, y]).tolist(),
            round(reach * scale * 2**DRAWING_STYLE.subpixel_bits),
            _TREE,
            -1,
            cv2.LINE_AA,
            DRAWING_STYLE.subpixel_bits,
        )
    fill(layout.graph.ground_road, _ROAD_COLORS)
    fill(layout.islands, _ISLAND)
    for deck in layout.graph.decks:
        fill(deck, _DECK)
    cones = image.copy()
    for site in layout.sites:
        angle = np.radians(site.yaw_deg + np.linspace(-LAND_USE.half_view_deg, LAND_USE.half_view_deg, 24))
        rim = np.array(site.position[:2]) + TOWN_MAP.view_m * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        cv2.fillPoly(
            cones, [pixels([site.position[:2], *rim])], SPLIT_RGB[site.split], cv2.LINE_AA, DRAWING_STYLE.subpixel_bits
        )
    image = cv2.addWeighted(cones, 0.35, image, 0.65, 0.0)
    for site in layout.sites:
        x, y = (pixels(site.position) // 2**DRAWING_STYLE.subpixel_bits).tolist()
        cv2.circle(image, (x, y), 7, SPLIT_RGB[site.split], -1, cv2.LINE_AA)
        cv2.circle(image, (x, y), 7, (255, 255, 255), 2, cv2.LINE_AA)
        label = f"{site.name} ({site.split})"
        width = cv2.getTextSize(label, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)[0][0]
        left = x + width + 16 > image.shape[1]
        at = (x - width - 12 if left else x + 12, y - 8)
        cv2.rectangle(image, (at[0] - 3, at[1] - 15), (at[0] + width + 3, at[1] + 5), (255, 255, 255), -1)
        cv2.putText(image, label, at, cv2.FONT_HERSHEY_SIMPLEX, 0.55, _TEXT, 1, cv2.LINE_AA)
    cv2.putText(
        image, f"{town.name}: {layout.style.title}", (16, 38), cv2.FONT_HERSHEY_SIMPLEX, 0.9, _TEXT, 2, cv2.LINE_AA
    )
    bar = round(100 * scale)
    cv2.line(image, (16, image.shape[0] - 20), (16 + bar, image.shape[0] - 20), _TEXT, 3)
    cv2.putText(image, "100 m", (22 + bar, image.shape[0] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.6, _TEXT, 1, cv2.LINE_AA)
    return np.asarray(image, dtype=np.uint8)


_LANE_COLORS, _ARROW, _OCCLUDER, _SHADE = (255, 200, 40), (60, 220, 255), (255, 60, 160), (80, 80, 255)


def draw_lanes(road: OwnRoad) -> Pixels:
    """Return the photograph or a grey image (H, W, 3), RGB, with lane edges, arrows, occluders and shades."""
    camera, graph = road.camera, RoadGraph.of(Town.of(road))
    size = (camera.width, camera.height)
    image = (
        road.picture(size) if road.photograph else np.full((size[1], size[0], 3), TOWN_MAP.background, dtype=np.uint8)
    )
    for edge in graph.edges:
        for lane in driven(edge):
            middle, across = _ways_along(np.array(lane.getShape3D()))
            for side in (-0.5, 0.5):
                _draw_lane(image, road, graph, middle + side * lane.getWidth() * across, _LANE_COLORS)
            for k in range(3, len(middle), int(TOWN_MAP.arrow_spacing_m / TOWN_MAP.sample_m)):
                barbs = middle[[k - 3, k, k - 3]] + np.array([[0.5], [0.0], [-0.5]]) * across[k]
                _draw_lane(image, road, graph, barbs, _ARROW)
    outlines = [
        *((occluder.polygon, _OCCLUDER) for occluder in road.occluders),
        *((shade, _SHADE) for shade in road.shades),
    ]
    for outline, color in outlines:
        corners = np.rint((np.array(outline) - 0.5) * 2**DRAWING_STYLE.subpixel_bits).astype(np.int32)
        cv2.polylines(image, [corners], True, color, 1, cv2.LINE_AA, DRAWING_STYLE.subpixel_bits)
    return image


def _ways_along(line: Array) -> tuple[Array, Array]:
    """Return points (N, 3) along a line, and unit vectors to its left."""
    marks = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    at = np.linspace(0.0, marks[-1], max(2, round(marks[-1] / TOWN_MAP.sample_m)))
    middle = np.column_stack([np.interp(at, marks, column) for column in line.T])
    ahead = np.gradient(middle[:, :2], axis=0)
    left = np.column_stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(ahead))])
    return middle, left / np.hypot(*ahead.T)[:, None].clip(1e-9)


def _draw_lane(image: Pixels, road: OwnRoad, graph: RoadGraph, line: Array, color: tuple[int, int, int]) -> None:
    """Draw a line (N, 3) of the graph where it is before the camera."""
    pixels, depth, valid = road.camera.project(graph.world(line))
    near = valid & (depth < TOWN_MAP.drawn_within_m) & (np.abs(np.nan_to_num(pixels)) < 1e4).all(axis=-1)
    at = np.rint((np.where(near[:, None], pixels, 0.0) - 0.5) * 2**DRAWING_STYLE.subpixel_bits).astype(int).tolist()
    for k in np.flatnonzero(near[:-1] & near[1:]):
        cv2.line(image, at[k], at[k + 1], color, 2, cv2.LINE_AA, DRAWING_STYLE.subpixel_bits)
