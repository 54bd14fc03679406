"""Lights, signs, cabinets, bins, benches, bollards, bus shelters; x along the street, y towards the carriageway."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
import shapely
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, box, lathe, merged, tube
from skope.gen.scenery.quads import Solid
from skope.gen.scenery.trees import bush
from skope.gen.towns.land_use import LAND_USE, Layout
from skope.gen.towns.road_graph import beside, driven, is_minor, is_signalled, joins
from skope.gen.towns.town_style import drawn_name
from skope.types import Array


@dataclass(frozen=True)
class FurnitureLimits:
    """Clearances of street furniture."""

    clearance_m: float = 0.4
    """Minimum distance of street furniture from the carriageway, metres."""
    overhead_m: float = 6.0
    """Minimum height of parts over the road, metres."""
    light_spacing_m: float = 32.0
    """Distance between street lights on each side of continuously lit roads, metres."""
    foot_m: float = 0.5
    """Height of the part of a street light that counts as its foot, metres."""
    shortest_arm_m: float = 0.3
    """Minimum horizontal distance from the foot of a pole to a lamp on an arm, metres."""
    open_view_m: float = 26.0
    """Radius around a camera in which its view of the road is free of furniture, metres."""


FURNITURE_LIMITS: Final = FurnitureLimits()


def furniture(layout: Layout, keep_clear: Any, rng: np.random.Generator, *, lit_roads: bool = False) -> Iterator[Mesh]:
    """Yield all objects beside the roads of a town except trees and signals.

    With `lit_roads`, all roads have street lights, at most `FURNITURE_LIMITS.light_spacing_m` apart.
    """
    blocked = unary_union([keep_clear, layout.sightlines(FURNITURE_LIMITS.open_view_m)])
    spots = _Spots(layout, blocked)
    for edge in layout.graph.edges_of("ground"):
        for offset, s, make in _furniture_along(layout, edge, rng, lit_roads):
            position, heading = beside(edge, s, offset)
            if layout.camera_distance(position) > LAND_USE.plain_from_m:
                continue
            made = make()
            if spots.take(position, heading, made):
                yield made.moved(layout.on_ground(position), heading)


class _Spots:
    """Free positions for street furniture beside the road."""

    def __init__(self, layout: Layout, blocked: Any) -> None:
        self._blocked, self._road = blocked, layout.graph.road
        shapely.prepare(self._blocked)
        shapely.prepare(self._road)
        self._taken: list[tuple[Array, Any]] = []

    def take(self, position: Array, heading: float, made: Mesh) -> bool:
        """Return whether an object fits there; if it does, reserve the position."""
        c, s = np.cos(heading), np.sin(heading)
        low = made.vertices[made.vertices[:, 2] < FURNITURE_LIMITS.overhead_m, :2]
        plan = low @ np.array([[c, s], [-s, c]]) + position
        shape = shapely.MultiPoint(plan).convex_hull.buffer(0.02)
        if shape.intersects(self._blocked) or shape.distance(self._road) < FURNITURE_LIMITS.clearance_m:
            return False
        if any(abs(position - at).max() < 9.0 and shape.distance(neighbour) < 0.6 for at, neighbour in self._taken):
            return False
        self._taken.append((position, shape))
        return True


def _furniture_along(
    layout: Layout, edge: Any, rng: np.random.Generator, lit_road: bool
) -> Iterator[tuple[float, float, Callable[[], Mesh]]]:
    """Yield furniture along an edge: distance from the kerb and along the edge, metres, and its builder."""
    length, kind, style = driven(edge)[0].getLength(), layout.graph.kind(edge), layout.style
    first, back = (kind.shoulder + 1.1, kind.shoulder + 2.6) if not kind.sidewalk else (0.75, 0.92 * kind.sidewalk)
    spacing = (
        min(kind.lights or FURNITURE_LIMITS.light_spacing_m, FURNITURE_LIMITS.light_spacing_m)
        if lit_road
        else kind.lights
    )
    if spacing:
        start = 0.25 * spacing if _number_of(edge.getID()) % 2 else 0.7 * spacing
        reach = 2.0 if style.light == "curved" else 2.6
        for s in np.arange(start, length, spacing):
            yield back if style.light == "curved" else first, float(s), partial(street_light, style.light, reach)
    yield first, 10.0, lambda: sign("limit")
    if kind.sidewalk:
        yield first, 60.0, lambda: sign("no_parking")
    if is_signalled(edge):
        yield first, length - 42.0, lambda: sign("warning")
        yield first, length - 16.0, lambda: sign("street")
    elif is_minor(edge):
        yield first, length - 3.0, lambda: sign("give_way")
        yield first, length - 70.0, lambda: sign("warning")
    elif joins(edge) > 2:
        yield first, length - 24.0, lambda: sign("priority")
    if not kind.sidewalk:
        for s in np.arange(25.0, length, 50.0):
            yield first, float(s), delineator
        return
    if kind.main and length > 60.0:
        yield 1.55, 44.0, bus_shelter
        yield first, 50.5, lambda: sign("bus")
    for s in np.arange(rng.uniform(3.0, 9.0), length, 11.0 if kind.main else 26.0):
        at = float(s + rng.uniform(-3.0, 3.0))
        offset, make = _draw_small_item(style.furniture, back, rng)
        yield offset, at, make
    for near_end in (True, False):
        if kind.main and is_signalled(edge) is near_end:
            for k in range(6):
                yield 0.62, (length - 2.0 - 1.6 * k) if near_end else 2.0 + 1.6 * k, bollard


def _number_of(name: str) -> int:
    """Return a number for a name, the same in every process."""
    return sum(name.encode())


def _draw_small_item(
    shares: Mapping[str, float], back: float, rng: np.random.Generator
) -> tuple[float, Callable[[], Mesh]]:
    """Return a random object for a sidewalk: its distance from the kerb, metres, and its builder."""
    name = drawn_name(shares, rng)
    make, at_kerb = _SIDEWALK_OBJECTS[name]
    return 0.8 if at_kerb else back, make


def street_light(form: str, reach: float) -> Mesh:
    """Return a street light.

    Args:
        form: `curved` (curved arm), `double` (two arms), `timber` (timber pole, straight arm); others: a straight arm.
        reach: Length of a straight arm, metres.
    """
    if form == "curved":
        bend = np.linspace(0, np.pi / 2, 5)
        arm = [(0.0, 0.9 * (1 - np.cos(a)), 7.1 + 0.9 * np.sin(a)) for a in bend]
        pole = lathe([(0.0, 0.11), (1.1, 0.11), (1.1, 0.075), (7.1, 0.05)], ["zinc"] * 3, 6, "z")
        return merged([pole, tube(arm, [0.05] * 5, "zinc", 5), _luminaire(0.75, 7.94)])
    high = 7.6 if form == "timber" else 9.4
    material, foot = ("timber", 0.15) if form == "timber" else ("zinc", 0.13)
    parts = [lathe([(-0.2, foot), (high, 0.6 * foot), (high + 0.02, 0.0)], [material] * 2, 7, "z")]
    for side in (1.0, -1.0) if form == "double" else (1.0,):
        path = [(0.0, 0.0, high - 0.25), (0.0, side * 0.5 * reach, high + 0.1), (0.0, side * reach, high + 0.2)]
        parts.append(tube(path, [0.05] * 3, "zinc", 5))
        head = _luminaire(reach - 0.3, high + 0.14)
        parts.append(head if side > 0 else head.moved([0, 0, 0], np.pi))
    return merged(parts)


def _luminaire(y: float, z: float) -> Mesh:
    head = box([-0.13, y, z], [0.13, y + 0.7, z + 0.14], "pole")
    return merged([head, box([-0.1, y + 0.1, z - 0.02], [0.1, y + 0.65, z], "luminaire")])


def lamp_positions(meshes: Iterable[Mesh]) -> Array:
    """Return the luminaires of street lights (N, 5).

    The columns are the middle of the pane, and the horizontal unit vector from the foot of the pole to it. The vector
    is 0 for a lamp above its foot. Each pane is a box of 24 vertices.
    """
    rows = [np.zeros((0, 5))]
    for mesh in meshes:
        if "luminaire" not in mesh.materials:
            continue
        panes = mesh.by_material()["luminaire"].vertices.reshape(-1, 24, 3).mean(axis=1)
        low = mesh.vertices[:, 2] < mesh.vertices[:, 2].min() + FURNITURE_LIMITS.foot_m
        arms = panes[:, :2] - mesh.vertices[low, :2].mean(axis=0)
        lengths = np.linalg.norm(arms, axis=1, keepdims=True)
        rows.append(
            np.hstack(
                [panes, np.where(lengths > FURNITURE_LIMITS.shortest_arm_m, arms / np.maximum(lengths, 1e-9), 0.0)]
            )
        )
    return np.concatenate(rows)


def delineator() -> Mesh:
    """Return a marker post at the edge of the road."""
    out = Solid()
    out.box("frame", (-0.06, -0.05, -0.1), (0.06, 0.05, 0.95), without="-z")
    out.box("iron", (-0.065, -0.055, 0.68), (0.065, 0.055, 0.86), without="-z +z")
    out.box("lettering", (-0.07, -0.03, 0.72), (0.07, 0.03, 0.82), without="-z +z")
    return out.mesh()


def hydrant() -> Mesh:
    profile = [
        (0.0, 0.16),
        (0.06, 0.16),
        (0.07, 0.11),
        (0.52, 0.11),
        (0.54, 0.14),
        (0.6, 0.12),
        (0.7, 0.05),
        (0.72, 0.0),
    ]
    body = lathe(profile, ["enamel_red"] * 7, 8, "z")
    return merged([body, box([-0.2, -0.06, 0.36], [0.2, 0.06, 0.48], "enamel_red")])


def planter() -> Mesh:
    profile = [(0.0, 0.4), (0.5, 0.52), (0.55, 0.52), (0.55, 0.45), (0.45, 0.44), (0.46, 0.0)]
    rng = np.random.default_rng(5)
    return merged([lathe(profile, ["concrete"] * 4 + ["soil"], 10, "z"), bush(0.5, rng).moved([0, 0, 0.5])])


def news_rack() -> Mesh:
    out = Solid()
    for k, color in enumerate(("sign_red", "sign_blue", "sign_yellow")):
        x = 0.5 * k - 0.75
        out.box(color, (x, -0.2, 0.1), (x + 0.45, 0.2, 1.05), without="-z")
        out.pane("window", (x + 0.05, x + 0.4), (-0.15, 0.15), 1.055)
    return out.mesh()


def sign(kind: str) -> Mesh:
    """Return a post with a plate that faces the traffic, which comes from -x."""
    top = 2.35 if kind != "street" else 2.5
    post = lathe([(0.0, 0.032), (top + 0.3, 0.032), (top + 0.31, 0.0)], ["zinc", "zinc"], 7, "z")
    parts = {
        "limit": [(_disc(0.3), "sign_red", 0.05), (_disc(0.22), "sign_white", 0.056), (_digits(), "iron", 0.06)],
        "no_parking": [(_disc(0.27), "sign_red", 0.05), (_disc(0.21), "sign_blue", 0.056)],
        "warning": [(_triangle(0.36), "sign_red", 0.05), (_triangle(0.23), "sign_white", 0.056)],
        "give_way": [(-_triangle(0.38), "sign_red", 0.05), (-_triangle(0.25), "sign_white", 0.056)],
        "priority": [(_diamond(0.33), "sign_white", 0.05), (_diamond(0.24), "sign_yellow", 0.056)],
        "bus": [(_rectangle(0.25, 0.25), "sign_yellow", 0.05), (_disc(0.19), "door_green", 0.056)],
        "street": [(_rectangle(0.45, 0.13), "sign_blue", 0.05), (_rectangle(0.36, 0.03), "sign_white", 0.056)],
    }[kind]
    plate = Solid()
    for outline, material, z in parts:
        flat = outline.reshape(-1, *outline.shape[-2:])
        for shape in flat:
            for i in range(1, len(shape) - 1):
                a, b, c = ((*p, z) for p in shape[[0, i, i + 1]])
                plate.face(material, a, b, c)
    back = parts[0][0]
    for i in range(1, len(back) - 1):
        a, b, c = ((*p, 0.045) for p in back[[0, i + 1, i]])
        plate.face("zinc", a, b, c)
    faced = plate.placed((0.0, 0.0, top), ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0), (-1.0, 0.0, 0.0)))
    return merged([post, faced.mesh()])


def _disc(radius: float) -> Array:
    angle = np.arange(16) * np.pi / 8
    return radius * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def _triangle(radius: float) -> Array:
    angle = np.pi / 2 + np.arange(3) * 2 * np.pi / 3
    return np.asarray(radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _diamond(radius: float) -> Array:
    return radius * np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


def _rectangle(half: float, height: float) -> Array:
    return np.array([[-half, -height], [half, -height], [half, height], [-half, height]])


def _digits() -> Array:
    """Return bars that look like two digits in a distant view."""
    bars = [(-0.11, 0.03, 0.11), (0.11, 0.03, 0.11), (0.03, 0.03, 0.11)]
    return np.stack([_rectangle(w, h) + np.array([x, 0.0]) for x, w, h in bars])


def bollard() -> Mesh:
    profile = [(0.0, 0.08), (0.8, 0.06), (0.84, 0.075), (0.9, 0.06), (0.94, 0.0)]
    return lathe(profile, ["iron", "lettering", "iron", "iron"], 8, "z")


def litter_bin() -> Mesh:
    profile = [(0.0, 0.22), (0.7, 0.26), (0.78, 0.26), (0.88, 0.2), (0.9, 0.0)]
    return lathe(profile, ["door_green", "iron", "door_green", "iron"], 8, "z")


def pillar_box() -> Mesh:
    profile = [(0.0, 0.26), (0.12, 0.26), (0.13, 0.23), (1.25, 0.23), (1.28, 0.28), (1.36, 0.27), (1.45, 0.0)]
    body = lathe(profile, ["iron", *["enamel_red"] * 5], 12, "z")
    return merged([body, box([-0.12, 0.2, 1.08], [0.12, 0.25, 1.12], "iron")])


def bench() -> Mesh:
    out = Solid()
    for x in (-0.75, 0.0, 0.75):
        out.box("iron", (x - 0.03, -0.22, 0.0), (x + 0.03, 0.22, 0.42))
        out.box("iron", (x - 0.03, -0.27, 0.42), (x + 0.03, -0.21, 0.85))
    for y in (-0.16, 0.0, 0.16):
        out.box("timber", (-0.9, y - 0.06, 0.425), (0.9, y + 0.06, 0.465))
    for z in (0.58, 0.73):
        out.box("timber", (-0.9, -0.205, z), (0.9, -0.17, z + 0.11))
    return out.mesh()


def cabinet() -> Mesh:
    out = Solid()
    out.box("concrete", (-0.65, -0.2, 0.0), (0.65, 0.2, 0.12), without="-z")
    out.box("cabinet", (-0.6, -0.17, 0.12), (0.6, 0.17, 1.2), without="-z")
    out.box("cabinet", (-0.63, -0.2, 1.2), (0.63, 0.2, 1.25))
    for x in (-0.55, 0.03):
        out.box("cabinet", (x, 0.17, 0.2), (x + 0.52, 0.185, 1.12), without="-y")
        out.box("iron", (x + 0.42, 0.185, 0.62), (x + 0.47, 0.2, 0.76), without="-y")
    return out.mesh()


def cabinet_small() -> Mesh:
    out = Solid()
    out.box("zinc", (-0.3, -0.13, 0.0), (0.3, 0.13, 0.85), without="-z")
    out.box("zinc", (-0.33, -0.16, 0.85), (0.33, 0.16, 0.9))
    out.box("iron", (0.12, 0.13, 0.4), (0.16, 0.15, 0.52), without="-y")
    return out.mesh()


def bus_shelter() -> Mesh:
    """Return posts, a roof, a bench, a back wall of frosted panes and a poster."""
    out = Solid()
    for x in (-1.9, 0.0, 1.9):
        for y in (-0.62, 0.42):
            out.box("frame_dark", (x - 0.035, y - 0.035, 0.0), (x + 0.035, y + 0.035, 2.3), without="-z")
    out.box("frame_dark", (-2.1, -0.75, 2.3), (2.1, 0.65, 2.42))
    out.box("balustrade", (-1.86, -0.64, 0.25), (-0.04, -0.61, 2.1))
    out.box("balustrade", (0.04, -0.64, 0.25), (1.86, -0.61, 2.1))
    out.box("frame_dark", (1.87, -0.58, 0.3), (1.99, 0.38, 2.1))
    out.box("sign_yellow", (1.84, -0.5, 0.5), (1.87, 0.3, 1.9), without="+x")
    out.box("sign_blue", (1.83, -0.42, 1.0), (1.84, 0.22, 1.6), without="+x")
    out.box("timber", (-1.6, -0.5, 0.42), (0.6, -0.15, 0.47))
    out.box("sign_red", (-1.95, 0.65, 2.32), (1.95, 0.67, 2.4), without="-y")
    return out.mesh()


_SIDEWALK_OBJECTS: Final[Mapping[str, tuple[Callable[[], Mesh], bool]]] = {
    "litter_bin": (litter_bin, True),
    "bench": (bench, False),
    "cabinet": (cabinet, False),
    "pillar_box": (pillar_box, True),
    "cabinet_small": (cabinet_small, False),
    "bollard": (bollard, True),
    "hydrant": (hydrant, True),
    "planter": (planter, True),
    "news_rack": (news_rack, False),
}
"""Builders of the objects for sidewalks in a town's style, and whether the objects are at the kerb."""
