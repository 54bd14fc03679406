"""Drawings of a user on a road in a site file: gates, zones, lanes, occluders."""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from shapely import Polygon

from skope.camera.ground_plane import Ground, intersect_ground
from skope.camera.model import Camera, same_aspect
from skope.errors import UserError
from skope.records import TomlTable
from skope.site.mark_parser import MARK_LIMITS, NO_NAME, is_name
from skope.types import Array

Outline = tuple[tuple[float, float], ...]

DEFAULT_LANE_M: Final = 3.5
"""Width of a lane that states none, metres."""


@dataclass(frozen=True, kw_only=True)
class Gate:
    """Line across the road at which traffic is counted: drawn in the image, surveyed on the road, or both."""

    name: str
    line: Outline = ()
    """Both ends on the road, world x and y, metres; empty for a gate that is drawn in the image only."""
    pixels: Outline = ()
    """Both ends in the image, column and row; empty for a gate from a map or a survey."""
    size: tuple[int, int] | None = None
    """Width and height of the image in which `pixels` were drawn; None: not recorded."""
    directions: tuple[str, str] | None = None
    """Names of crossings from left to right, and from right to left, of the line as drawn; None: not named."""
    edges: tuple[str, str] | None = None
    """Edges of a SUMO network on which the gate is crossed from left to right and back, "" for none; None: not
    given."""


@dataclass(frozen=True, kw_only=True)
class Zone:
    """Area of the road."""

    name: str
    polygon: Outline
    """Corners, world x and y, metres."""


@dataclass(frozen=True, kw_only=True)
class Lane:
    """Middle line of a lane, in its driving direction."""

    name: str
    line: Outline
    """Points of the line, world x and y, metres."""
    width: float | None = None
    """Width, metres; None: not known."""


@dataclass(frozen=True, kw_only=True)
class OccluderMark:
    """Object in the image that hides traffic; either `distance` or `foot` gives its distance."""

    polygon: Outline
    """Corners, pixels."""
    distance: float | None = None
    """Planar depth, metres."""
    foot: tuple[float, float] | None = None
    """Pixel at which it stands on the ground."""


def gate_at_size(gate: Gate, size: tuple[int, int]) -> Gate:
    """Return the gate with its pixels in an image of another size.

    Args:
        gate: The gate. Without `pixels` it is returned unchanged; without `size` its pixels are assumed to fit `size`.
        size: Width and height of the image, pixels.

    Raises:
        UserError: The aspect ratios of the two images differ by more than 1%.
    """
    if not gate.pixels:
        return gate
    drawn = gate.size or size
    if not same_aspect(drawn, size):
        raise UserError(
            f"gate {gate.name!r}: drawn in an image of {drawn[0]}x{drawn[1]}, but this footage is {size[0]}x{size[1]}, "
            "another aspect ratio"
        )
    x, y = size[0] / drawn[0], size[1] / drawn[1]
    return replace(gate, pixels=tuple((u * x, v * y) for u, v in gate.pixels), size=size)


def line_on_road(camera: Camera, pixels: Array, ground: Ground | None = None) -> Outline:
    """Return the ends on the road of a gate that is drawn in the image.

    Args:
        camera: The camera.
        pixels: (2, 2) ends of the gate in an image of the camera's size.
        ground: The road; None: z = 0.

    Returns:
        World x and y of both ends, metres, rounded to a millimetre; empty if one lies on or above the horizon.
    """
    road = ground or Ground()
    ends = np.round(intersect_ground(camera, pixels, road.height, slope=road.slope, about=road.about)[:, :2], 3)
    if not np.isfinite(ends).all() or (ends[0] == ends[1]).all():
        return ()
    return tuple((float(x), float(y)) for x, y in ends)


def gate_on_road(gate: Gate, camera: Camera) -> Gate:
    """Return the gate with a line on the road: if it has only `pixels`, their projection onto the road.

    The gate is unchanged if its image has another aspect ratio, or one of its ends lies on or above the horizon.
    """
    size = (camera.width, camera.height)
    if gate.line or not gate.pixels or not same_aspect(gate.size or size, size):
        return gate
    return replace(gate, line=line_on_road(camera, np.array(gate_at_size(gate, size).pixels)))


def read_gate(row: TomlTable) -> Gate:
    """Read a gate. Raises UserError with the file and the invalid key."""
    if "line" not in row and "pixels" not in row:
        raise row.wrong("line", "missing: draw the gate (`pixels`) or survey it (`line`)")
    return Gate(
        name=read_name(row),
        line=_ends(row, "line", "[x, y]") if "line" in row else (),
        pixels=_ends(row, "pixels", "[column, row]") if "pixels" in row else (),
        size=_image_size(row),
        directions=_directions(row),
        edges=_edges(row),
    )


def _ends(row: TomlTable, key: str, form: str) -> Outline:
    """Return the two ends of a gate."""
    ends = read_line(row, key)
    if len(ends) != 2:
        raise row.wrong(key, f"expected two ends {form}, got {len(ends)}")
    if ends[0] == ends[1]:
        raise row.wrong(key, "its ends are the same")
    return ends


def _image_size(row: TomlTable) -> tuple[int, int] | None:
    """Return the size of the image that a gate was drawn in; None if the row does not give it."""
    if "size" not in row:
        return None
    width, height = row.numbers("size", 2)
    if width % 1 or height % 1 or not (1 <= width <= MARK_LIMITS.farthest_m and 1 <= height <= MARK_LIMITS.farthest_m):
        raise row.wrong("size", "expected the width and height of the image, whole numbers of pixels")
    return int(width), int(height)


def _directions(row: TomlTable) -> tuple[str, str] | None:
    """Return the names of a gate's two directions; None if the row does not give them."""
    if "directions" not in row:
        return None
    names = row.value("directions")
    if not isinstance(names, list) or len(names) != 2 or not all(isinstance(name, str) for name in names):
        raise row.wrong("directions", 'expected two names, like ["to the station", "to the bridge"]')
    if names[0] == names[1]:
        raise row.wrong("directions", f"both are called {names[0]!r}")
    return checked_name(row, "directions", names[0]), checked_name(row, "directions", names[1])


def _edges(row: TomlTable) -> tuple[str, str] | None:
    """Return the edges of a SUMO network that a gate crosses, by direction; None if the row does not give them."""
    if "edges" not in row:
        return None
    names = row.value("edges")
    if not isinstance(names, list) or len(names) != 2 or not all(isinstance(name, str) for name in names):
        raise row.wrong("edges", 'expected two edges of a SUMO network, like ["A0B0", "B0A0"]; "" where there is none')
    if names[0] == names[1]:
        raise row.wrong("edges", f"both are {names[0]!r}")
    forwards, backwards = (checked_name(row, "edges", name) if name else "" for name in names)
    return forwards, backwards


def read_zone(row: TomlTable) -> Zone:
    return Zone(name=read_name(row), polygon=read_outline(row, "[x, y]"))


def read_lane(row: TomlTable) -> Lane:
    line = read_line(row, "line")
    width = (
        row.number("width", low=MARK_LIMITS.lane_width_m[0], high=MARK_LIMITS.lane_width_m[1])
        if "width" in row
        else None
    )
    return Lane(name=read_name(row), line=line, width=width)


def read_occluder(row: TomlTable) -> OccluderMark:
    polygon = read_outline(row)
    if "distance" in row:
        return OccluderMark(polygon=polygon, distance=row.number("distance", low=0.5, high=2000))
    column, line = row.numbers("foot", 2)
    return OccluderMark(polygon=polygon, foot=(column, line))


def read_outline(row: TomlTable, corner: str = "[column, row]") -> Outline:
    """Return at least three corners of `polygon`, without crossing sides. `corner` is used only in error messages."""
    points = row.value("polygon")
    if not isinstance(points, list) or len(points) < 3:
        raise row.wrong("polygon", f"expected three or more {corner}")
    outline = tuple((x, y) for x, y in row.matrix("polygon", len(points), 2))
    if not Polygon(outline).is_valid:
        raise row.wrong("polygon", "its sides cross each other")
    return outline


def read_line(row: TomlTable, key: str) -> Outline:
    """Return at least two positions [x, y], metres."""
    points = row.value(key)
    if not isinstance(points, list) or len(points) < 2:
        raise row.wrong(key, "expected two or more places [x, y]" if key in row else "missing")
    line = tuple((x, y) for x, y in row.matrix(key, len(points), 2))
    if any(abs(value) > MARK_LIMITS.farthest_m for position in line for value in position):
        raise row.wrong(key, f"expected numbers within {MARK_LIMITS.farthest_m:g}")
    return line


def read_name(row: TomlTable) -> str:
    if "name" not in row:
        raise row.wrong("name", "missing")
    return checked_name(row, "name", row.text("name"))


def checked_name(row: TomlTable, key: str, name: str) -> str:
    """Check a user-defined name, in any script.

    Args:
        row: The table with the name, for the message.
        key: Its key there, for the message.
        name: The name.

    Returns:
        The name.

    Raises:
        UserError: The name is empty, too long, or cannot be printed in one line.
    """
    if not is_name(name):
        raise row.wrong(key, NO_NAME)
    return name
