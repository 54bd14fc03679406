"""Backgrounds of OTAnalytics for tracks and gates: the camera's image, or the georeferenced road from above."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from skope.camera.model import Camera
from skope.site.gates_zones_lanes import Gate, Outline
from skope.tracks.track import Track
from skope.types import Array

if TYPE_CHECKING:
    from skope.site.site_file import SiteParts


@dataclass(frozen=True)
class GateImage:
    """Resolution of gates and of the image from above."""

    segments: int = 64
    """Number of parts of a gate that are projected. Distortion bends it."""
    straight_px: float = 0.05
    """Points of a gate's line this close to a straight part are omitted, pixels."""
    px_per_m: int = 10
    """Pixels per metre of the image from above."""
    margin_m: int = 5
    """Margin of that image, metres."""


GATE_IMAGE: Final = GateImage()

LOCAL_SYSTEM: Final = 'LOCAL_CS["metres of the site",UNIT["metre",1]]'
"""Coordinate system of a site that is not in a map's grid."""


@dataclass(frozen=True, kw_only=True, eq=False)
class OtView:
    """Image for OTAnalytics, with a mapping from road positions to its pixels."""

    name: str
    """Stem of the file names."""
    size: tuple[int, int] | None
    """Width and height, pixels; None: not known."""
    pixels: Callable[[Array], Array]
    """Maps positions (M, 2) of a track to columns and rows (M, 2); NaN for positions outside the image plane."""
    gates: tuple[tuple[Gate, Outline], ...]
    """The counted gates, with their lines in pixels."""
    georeference: dict[str, Any] | None = None
    """Entry of the `.ottrk` that makes OTAnalytics count in metres; None for the image of a camera."""
    geo: Callable[[Array], Array] | None = None
    """Maps positions (M, 2) to metres (M, 2) in the coordinate system of `georeference`; None without one."""

    def inside(self, pixels: Array) -> NDArray[np.bool_]:
        """Return (M,) whether pixels (M, 2) are inside the image. OTAnalytics rejects files with pixels outside."""
        return np.asarray(((pixels >= 0) & (pixels <= (self.size or np.inf))).all(axis=1))


def image_view(gates: Sequence[Gate], camera: Camera) -> OtView:
    """Return the view of a camera on positions in metres on a road at z = 0.

    A gate that was drawn in the image keeps its pixels. For a gate with only a line on the road, the longest part
    inside the image is kept.
    """

    def pixels(places: Array) -> Array:
        return camera.project(np.column_stack([places, np.zeros(len(places))]))[0]

    size = (camera.width, camera.height)
    lines = [(gate, _drawn(gate, size) or _bent(gate, pixels, size)) for gate in gates]
    return OtView(
        name="image",
        size=size,
        pixels=pixels,
        gates=tuple((gate, line) for gate, line in lines if len(line) > 1),
    )


def pixel_view(gates: Sequence[Gate]) -> OtView:
    """Return the view of a report without metres, with positions as columns and negative rows of the image."""
    return OtView(
        name="image",
        size=None,
        pixels=lambda places: places * [1.0, -1.0],
        gates=tuple((gate, gate.pixels) for gate in gates),
    )


def plan_view(site: "SiteParts", gates: Sequence[Gate], trajectories: Sequence[Track]) -> OtView:
    """Return the view from above: a virtual image of all gates and tracks, with ten pixels per metre."""
    places = [np.array(gate.line) for gate in gates] + [track.xy for track in trajectories]
    shift, crs = _map_of(site)
    everywhere = np.concatenate([*places, np.zeros((0, 2))]) + shift
    low, high = (everywhere.min(axis=0), everywhere.max(axis=0)) if len(everywhere) else (shift, shift)
    west, south = (math.floor(v) - GATE_IMAGE.margin_m for v in low)
    east, north = (math.ceil(v) + GATE_IMAGE.margin_m for v in high)
    width, height = (east - west) * GATE_IMAGE.px_per_m, (north - south) * GATE_IMAGE.px_per_m

    def geo(places: Array) -> Array:
        return np.asarray(places + shift)

    def pixels(places: Array) -> Array:
        return np.asarray((geo(places) - [west, north]) * [GATE_IMAGE.px_per_m, -GATE_IMAGE.px_per_m])

    return OtView(
        name="plan",
        size=(width, height),
        pixels=pixels,
        gates=tuple((gate, _outline(pixels(np.array(gate.line)))) for gate in gates),
        georeference={
            "geo_bounds": {"min_x": west, "min_y": south, "max_x": east, "max_y": north},
            "birds_eye_view_size": {"width": width, "height": height},
            "padding": 0,
            "crs": crs,
        },
        geo=geo,
    )


def _map_of(site: "SiteParts") -> tuple[Array, str]:
    """Return the (2,) offset to add to positions, metres, and the coordinate system of the result.

    The system is UTM if the site gives the UTM position of its origin, otherwise the site's own.
    """
    world = site.world or {}
    origin = world.get("origin", {})
    if "easting" not in origin or world.get("axes", "east, north") != "east, north":
        return np.zeros(2), LOCAL_SYSTEM
    zone = str(world["utm_zone"])
    code = world.get("epsg", (32600 if zone.endswith("N") else 32700) + int(zone[:-1]))
    return np.array([origin["easting"], origin["northing"]]), f"EPSG:{code}"


def _drawn(gate: Gate, size: tuple[int, int]) -> Outline:
    """Return a gate's own pixels if they refer to images of this size; else empty."""
    return gate.pixels if gate.size in (None, size) else ()


def _bent(gate: Gate, pixels: Callable[[Array], Array], size: tuple[int, int]) -> Outline:
    """Return the longest part of a gate's projection inside an image of a given size; empty for none."""
    from shapely import LineString, box, get_parts

    ends = np.array(gate.line)
    line = pixels(ends[0] + np.linspace(0, 1, GATE_IMAGE.segments + 1)[:, None] * (ends[1] - ends[0]))
    valid = np.isfinite(line[:, 0])
    runs = np.split(np.arange(len(line)), np.flatnonzero(np.diff(valid)) + 1)
    drawn = [LineString(line[run]) for run in runs if valid[run[0]] and len(run) > 1]
    parts = [
        part
        for line_string in drawn
        for part in get_parts(line_string.intersection(box(0, 0, *size)))
        if part.length > 0
    ]
    return _outline(max(parts, key=lambda part: part.length).simplify(GATE_IMAGE.straight_px).coords) if parts else ()


def _outline(points: Iterable[Sequence[float]]) -> Outline:
    return tuple((float(x), float(y)) for x, y in points)
