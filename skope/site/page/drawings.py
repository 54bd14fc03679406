"""Gates, zones, lanes and occluders of the page's document: their position in the image, and checks of them.

A gate counts badly without room for tracks on both sides, along a lane, or at uncertain positions.
"""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from shapely import Polygon

from skope.camera.ground_plane import intersect_ground
from skope.camera.model import Camera
from skope.site.gates_zones_lanes import DEFAULT_LANE_M, line_on_road
from skope.site.mark_parser import MARK_LIMITS, NO_NAME, Problem, is_name, number_or_none, positions
from skope.site.page.marks import entries_of
from skope.site.page.overlays import Polyline, polylines_of
from skope.types import Array


@dataclass(frozen=True)
class DrawingRules:
    """Limits for warnings on a gate, and settings for projecting drawings."""

    room_m: float = 3.0
    """Distance from a gate over which a track must be visible on both sides, metres."""
    samples: int = 21
    """Number of examined points along a gate."""
    blind_share: float = 0.25
    """Share of a gate without room on one side at which a warning is given."""
    along_deg: float = 30.0
    """Angle between a gate and a lane below which the gate runs along the lane, degrees."""
    known_m: float = 1.0
    """Maximum 90% error of positions on a gate, metres."""
    shortest_m: float = 0.5
    """Minimum length of a gate, metres."""
    step_m: float = 0.5
    """Length of the segments for projecting lines on the road, metres. A lens bends the lines."""
    arrow_m: float = 3.0
    """Length of the arrows across a gate on the road, metres."""
    arrow_px: float = 40.0
    """Length of the arrows across a gate in the image, pixels."""


DRAWING_RULES: Final = DrawingRules()


def gate_warnings(
    line: Array, camera: Camera, lanes: Sequence[tuple[Array, float]], position_error: Callable[[Array], Array] | None
) -> list[str]:
    """Return warnings on a gate.

    Args:
        line: (2, 2) both ends on the road, metres.
        camera: The camera over a road at z = 0.
        lanes: Lines (N, 2) along the lanes and their widths, metres.
        position_error: Function from pixels (..., 2) to position errors in metres (...,); None: errors are unknown.
    """
    along = line[1] - line[0]
    length = float(np.linalg.norm(along))
    if length < DRAWING_RULES.shortest_m:
        return [f"is {length:.1f} m long: nothing can cross it"]
    spots = line[0] + np.linspace(0, 1, DRAWING_RULES.samples)[:, None] * along
    out = []
    seen = _seen(camera, spots)
    if not seen.any():
        return ["lies outside the image: nothing can be seen to cross it"]
    left = np.array([-along[1], along[0]]) / length
    for side, sign in (("left", 1.0), ("right", -1.0)):
        blind = float(np.mean(~(seen & _seen(camera, spots + sign * DRAWING_RULES.room_m * left))))
        if blind >= DRAWING_RULES.blind_share:
            much = "all" if blind == 1 else f"{blind:.0%}"
            out.append(
                f"{much} of it has no {DRAWING_RULES.room_m:g} m of road in the image on its {side}: "
                "tracks there are never on both sides"
            )
    out += _lanes_along(line, lanes)
    if position_error is not None:
        errors = position_error(camera.project(_on_road(spots[seen]))[0])
        worst = float(np.nanmax(errors)) if np.isfinite(errors).any() else math.nan
        if worst > DRAWING_RULES.known_m:
            out.append(
                f"positions on it have errors of up to {worst:.1f} m (90%); recommended: {DRAWING_RULES.known_m:g} m"
            )
    return out


def _lanes_along(line: Array, lanes: Sequence[tuple[Array, float]]) -> list[str]:
    """Return a warning if a gate runs along a lane that it touches."""
    along = line[1] - line[0]
    for lane, width in lanes:
        for a, b in itertools.pairwise(lane):
            if np.allclose(a, b) or _distance(line, np.stack([a, b])) > width / 2:
                continue
            cosine = abs(float(along @ (b - a))) / (float(np.linalg.norm(along)) * float(np.linalg.norm(b - a)))
            angle = math.degrees(math.acos(min(1.0, cosine)))
            if angle < DRAWING_RULES.along_deg:
                return [f"runs along a lane ({angle:.0f} degrees to it): draw it across"]
    return []


def _distance(first: Array, second: Array) -> float:
    """Return the distance of two line segments (2, 2)."""
    from shapely import LineString

    return float(LineString(first).distance(LineString(second)))


def _on_road(xy: Array) -> Array:
    return np.concatenate([xy, np.zeros((*xy.shape[:-1], 1))], axis=-1)


def _seen(camera: Camera, xy: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    """Return (N,) whether positions (N, 2) on the road are in the image."""
    return camera.inside(camera.project(_on_road(xy))[0])


DRAWN_KINDS: Final = ("gates", "zones", "lanes", "occluders")
POSITION_FIELDS: Final = {"gates": "line", "zones": "polygon", "lanes": "line", "occluders": "polygon"}
"""Field of each kind that holds its positions."""
FEWEST_POSITIONS: Final = {"gates": 2, "zones": 3, "lanes": 2, "occluders": 3}
_ABOVE_HORIZON: Final = "an end lies on or above the horizon: it counts in the image, but not in metres"


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """Gate, zone, lane or occluder without faults."""

    kind: str
    index: int
    positions: Array
    """(N, 2) positions on the road, metres; for occluders, pixels. (0, 2) for a gate with `pixels`."""
    pixels: Array | None = None
    """(2, 2) ends of a gate that is drawn in the image; None for everything else."""
    width: float = DEFAULT_LANE_M
    foot: Array | None = None
    """(2,) pixel at which an occluder stands on the ground."""


def read_drawings(document: Mapping[str, Any], size: tuple[int, int]) -> tuple[list[Drawing], list[Problem]]:
    """Return the valid drawings of a document, and the problems of the others.

    Args:
        document: The page's document.
        size: Width and height of the footage, pixels.
    """
    good: list[Drawing] = []
    problems: list[Problem] = []
    for kind in DRAWN_KINDS:
        names: set[str] = set()
        for index, entry in enumerate(entries_of(document, kind)):
            found = _problems(kind, index, entry, names, size)
            problems += found
            if any(problem.field not in ("name", "directions.0", "directions.1") for problem in found):
                continue
            if drawn_in_image(kind, entry):
                pixels = np.asarray(positions(entry["pixels"], 2))
                good.append(Drawing(kind=kind, index=index, positions=np.zeros((0, 2)), pixels=pixels))
                continue
            rows = positions(entry.get(POSITION_FIELDS[kind]), 2)
            assert rows is not None
            foot = positions([entry.get("foot")], 2) if kind == "occluders" else None
            width = number_or_none(entry.get("width")) or DEFAULT_LANE_M
            at = np.asarray(rows)
            good.append(
                Drawing(kind=kind, index=index, positions=at, width=width, foot=np.array(foot[0]) if foot else None)
            )
    return good, problems


def drawn_in_image(kind: str, entry: Mapping[str, Any]) -> bool:
    """Return whether an entry is a gate with its ends in the image; the camera gives its line on the road."""
    return kind == "gates" and bool(entry.get("pixels"))


def _problems(kind: str, index: int, entry: Mapping[str, Any], names: set[str], size: tuple[int, int]) -> list[Problem]:
    """Return the problems of an entry; its name is added to `names`, those of the entries before it."""
    out: list[Problem] = []

    def wrong(field: str, text: str, *, missing: bool = False) -> None:
        out.append(Problem(kind=kind, index=index, field=field, text=text, missing=missing))

    if kind != "occluders":
        name = entry.get("name")
        if not isinstance(name, str) or not name.strip():
            wrong("name", "type a name: results are listed under it", missing=True)
        elif not is_name(name):
            wrong("name", NO_NAME)
        elif name in names:
            wrong("name", f"another entry is already called {name!r}")
        else:
            names.add(name)
    field = "pixels" if drawn_in_image(kind, entry) else POSITION_FIELDS[kind]
    rows = positions(entry.get(field), 2)
    drawn = positions([entry.get("size") or list(size)], 2)
    if rows is None:
        wrong(field, "expected two numbers for each corner")
    elif field == "pixels" and (drawn is None or drawn[0] != list(size)):
        wrong(field, _other_size(drawn[0] if drawn else None, size))
    elif len(rows) < FEWEST_POSITIONS[kind] or (kind == "gates" and len(rows) != 2):
        wrong(
            field, f"needs {FEWEST_POSITIONS[kind]} positions" + (" or more" if kind != "gates" else ""), missing=True
        )
    elif field == "polygon" and not Polygon(rows).is_valid:
        wrong(field, "its sides cross each other")
    elif field in ("line", "pixels") and not any(a != b for a, b in itertools.pairwise(rows)):
        wrong(field, "its ends are the same")
    if kind == "lanes" and entry.get("width") not in (None, ""):
        width = number_or_none(entry.get("width"))
        low, high = MARK_LIMITS.lane_width_m
        if width is None or not low <= width <= high:
            wrong("width", f"expected a width from {low:g} to {high:g} metres")
    far = number_or_none(entry.get("distance")) is not None
    if kind == "occluders" and positions([entry.get("foot")], 2) is None and not far:
        wrong("foot", "click where it stands on the ground", missing=True)
    if kind == "gates":
        out += _direction_problems(index, entry)
    return out


def _other_size(drawn: list[float] | None, size: tuple[int, int]) -> str:
    """Return a sentence on a gate that was drawn in an image of another aspect ratio than the footage's."""
    where = f"in an image of {drawn[0]:g}x{drawn[1]:g}" if drawn else "in an image of unknown size"
    return f"was drawn {where}; this footage is {size[0]}x{size[1]}: delete it and draw it again"


def _direction_problems(index: int, entry: Mapping[str, Any]) -> list[Problem]:
    """Return the problems of a gate's directions: both must have names, or none."""
    given = entry.get("directions", ["", ""])
    if not isinstance(given, list) or len(given) != 2:
        given = [None, None]
    if given == ["", ""]:
        return []
    out = []
    for side, name in enumerate(given):
        missing = name == ""
        if not is_name(name):
            text = "name this direction too" if missing else NO_NAME
            out.append(Problem(kind="gates", index=index, field=f"directions.{side}", text=text, missing=missing))
    if not out and given[0] == given[1]:
        out.append(Problem(kind="gates", index=index, field="directions.1", text="both directions have this name"))
    return out


def shapes(
    drawings: Sequence[Drawing], camera: Camera | None, position_error: Callable[[Array], Array] | None
) -> list[dict[str, Any]]:
    """Compute what the page shows of each drawing.

    Without a camera only gates that are drawn in the image have a shape. Warnings that need metres are only for
    drawings with positions on the road.

    Args:
        drawings: The drawings without faults.
        camera: The camera, over a road at z = 0; None: it is not known.
        position_error: Function from pixels (..., 2) to position errors in metres (...,); None: errors are unknown.

    Returns:
        For each drawing `kind`, `index` and `warnings`, and these keys:

        - `lines` and `corners`, pixels: all kinds except occluders.
        - `ways`, pairs of positions in metres: both directions across a gate (from its left to its right, and back), or
          the last segment of a lane. `arrows` are the same in pixels.
        - `edges`, pixels: lanes.
        - `places`, metres: the ends on the road of a gate that is drawn in the image, if they are known.
    """
    lanes = [(drawing.positions, drawing.width) for drawing in drawings if drawing.kind == "lanes"]
    out = []
    for drawing in drawings:
        if drawing.pixels is not None:
            out.append(_image_gate(drawing, drawing.pixels, camera, lanes, position_error))
            continue
        if camera is None:
            continue
        shown: dict[str, Any] = {"kind": drawing.kind, "index": drawing.index, "warnings": []}
        if drawing.kind == "occluders":
            shown["warnings"] = _occluder_warnings(drawing, camera)
        else:
            ends = (
                np.concatenate([drawing.positions, drawing.positions[:1]])
                if drawing.kind == "zones"
                else drawing.positions
            )
            shown["lines"] = road_line(camera, ends)
            shown["corners"] = _pixels(camera, drawing.positions)
        if drawing.kind in ("gates", "lanes"):
            ways = _ways_across(drawing.positions) if drawing.kind == "gates" else [drawing.positions[-2:]]
            shown["ways"] = [way.tolist() for way in ways]
            shown["arrows"] = [road_line(camera, way) for way in ways]
        if drawing.kind == "gates":
            shown["warnings"] = gate_warnings(drawing.positions, camera, lanes, position_error)
        if drawing.kind == "lanes":
            shown["edges"] = [line for side in (-1, 1) for line in road_line(camera, _beside(drawing, side))]
        out.append(shown)
    return out


def _image_gate(
    gate: Drawing,
    pixels: Array,
    camera: Camera | None,
    lanes: Sequence[tuple[Array, float]],
    position_error: Callable[[Array], Array] | None,
) -> dict[str, Any]:
    """Return what the page shows of a gate with its ends in the image: an entry of `shapes`."""
    # Negative rows keep left and right of the line as on the screen.
    upwards = np.array([1.0, -1.0])
    arrows = [way * upwards for way in _ways_across(pixels * upwards, DRAWING_RULES.arrow_px)]
    shown: dict[str, Any] = {
        "kind": gate.kind,
        "index": gate.index,
        "warnings": [],
        "lines": [pixels.tolist()],
        "corners": pixels.tolist(),
        "arrows": [[arrow.round(1).tolist()] for arrow in arrows],
        "ways": [],
    }
    if camera is None:
        return shown
    line = line_on_road(camera, pixels)
    if not line:
        return shown | {"warnings": [_ABOVE_HORIZON]}
    ends = np.array(line)
    shown |= {"places": ends.tolist(), "ways": [way.tolist() for way in _ways_across(ends)]}
    return shown | {"warnings": gate_warnings(ends, camera, lanes, position_error)}


def road_line(camera: Camera, corners: Array) -> list[Polyline]:
    """Return a line on the road through corners (N, 2), as polylines in pixels."""
    parts = []
    for a, b in itertools.pairwise(corners):
        steps = int(np.clip(np.linalg.norm(b - a) / DRAWING_RULES.step_m, 1, 400))
        parts.append(a + np.linspace(0, 1, steps + 1)[:, None] * (b - a))
    points = np.concatenate(parts)
    return polylines_of(camera, np.concatenate([points, np.zeros((len(points), 1))], axis=-1))


def _pixels(camera: Camera, corners: Array) -> list[list[float] | None]:
    pixels, _, valid = camera.project(np.concatenate([corners, np.zeros((len(corners), 1))], axis=-1))
    return [[round(float(v), 2) for v in pixel] if good else None for pixel, good in zip(pixels, valid, strict=True)]


def _ways_across(line: Array, longest: float = DRAWING_RULES.arrow_m) -> list[Array]:
    """Return (2, 2) arrows across a gate from left to right, and back; at most `longest` long."""
    along = line[1] - line[0]
    right = np.array([along[1], -along[0]]) / max(float(np.linalg.norm(along)), 1e-9)
    reach = min(longest, float(np.linalg.norm(along)) / 2)
    starts = (line[0] + 0.4 * along, line[0] + 0.6 * along)
    return [np.stack([start, start + reach * way]) for start, way in zip(starts, (right, -right), strict=True)]


def _beside(lane: Drawing, side: int) -> Array:
    """Return (N, 2) the edge of a lane: its line offset by half its width, corner by corner."""
    ways = np.diff(lane.positions, axis=0)
    lengths = np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-9)
    across = np.stack([-ways[:, 1], ways[:, 0]], axis=-1) / lengths
    at_corner = np.concatenate([across[:1], (across[:-1] + across[1:]) / 2, across[-1:]])
    at_corner /= np.maximum(np.linalg.norm(at_corner, axis=1, keepdims=True), 0.5)
    return lane.positions + side * lane.width / 2 * at_corner


def _occluder_warnings(occluder: Drawing, camera: Camera) -> list[str]:
    if occluder.foot is None or np.isfinite(intersect_ground(camera, occluder.foot)).all():
        return []
    return ["its foot is above the horizon, and therefore not on the road"]
