"""Prints on posters and signs: flat images of vehicles, logos and rows of letters.

They lie in the plane of a panel, x to the right, y up and z outwards, metres. Each layer is `LAYER_GAP_M` in front of
the previous one.
"""

import colorsys
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from skope.gen.scenery.quads import Solid
from skope.types import Array

LAYER_GAP_M: Final = 0.012
"""Distance between layers, metres: large enough for the depth buffer to separate them."""

_Outline = Sequence[tuple[float, float]]
_SIDE_VIEWS: Final[Mapping[str, tuple[Sequence[_Outline], Sequence[_Outline], Sequence[float]]]] = {
    "saloon": (
        (
            ((0.0, 0.09), (1.0, 0.09), (0.99, 0.20), (0.01, 0.22)),
            ((0.20, 0.21), (0.82, 0.20), (0.66, 0.34), (0.36, 0.34)),
        ),
        (
            ((0.28, 0.22), (0.49, 0.22), (0.49, 0.32), (0.37, 0.32)),
            ((0.51, 0.22), (0.74, 0.22), (0.65, 0.32), (0.51, 0.32)),
        ),
        (0.19, 0.80),
    ),
    "hatchback": (
        (
            ((0.0, 0.10), (1.0, 0.10), (0.99, 0.25), (0.01, 0.24)),
            ((0.18, 0.24), (0.97, 0.24), (0.90, 0.41), (0.36, 0.41)),
        ),
        (
            ((0.27, 0.26), (0.52, 0.26), (0.52, 0.38), (0.38, 0.38)),
            ((0.55, 0.26), (0.92, 0.26), (0.86, 0.38), (0.55, 0.38)),
        ),
        (0.20, 0.80),
    ),
    "van": (
        (
            ((0.0, 0.09), (0.14, 0.09), (0.14, 0.25), (0.0, 0.23)),
            ((0.14, 0.09), (1.0, 0.09), (1.0, 0.46), (0.26, 0.46)),
        ),
        (((0.20, 0.27), (0.38, 0.27), (0.38, 0.41), (0.27, 0.41)),),
        (0.17, 0.82),
    ),
    "bus": (
        (((0.0, 0.06), (1.0, 0.06), (1.0, 0.30), (0.01, 0.30)),),
        tuple(((x, 0.15), (x + 0.10, 0.15), (x + 0.10, 0.26), (x, 0.26)) for x in (0.03, 0.15, 0.27, 0.39, 0.51, 0.63)),
        (0.17, 0.74),
    ),
    "lorry": (
        (
            ((0.0, 0.08), (0.22, 0.08), (0.22, 0.33), (0.03, 0.33)),
            ((0.24, 0.12), (1.0, 0.12), (1.0, 0.42), (0.24, 0.42)),
        ),
        (((0.05, 0.21), (0.17, 0.21), (0.17, 0.30), (0.07, 0.30)),),
        (0.12, 0.68, 0.82),
    ),
}
"""Side views of vehicles of length 1: body, windows, and positions of the wheels."""
_BODY_FRONT: Final = (
    ((0.05, 0.10), (0.95, 0.10), (1.0, 0.28), (0.0, 0.28)),
    ((0.0, 0.28), (1.0, 0.28), (0.94, 0.46), (0.06, 0.46)),
    ((0.09, 0.46), (0.91, 0.46), (0.78, 0.76), (0.22, 0.76)),
)
"""Body of a front view of width 1, convex parts."""


def drawn_color(rng: np.random.Generator, saturation: float = 0.75) -> str:
    """Return a random colour such as "#a03020" up to a saturation (0..1); two in five are grey."""
    grey = rng.random() < 0.4
    hue, saturated, value = rng.random(), 0.0 if grey else saturation * rng.uniform(0.3, 1.0), rng.uniform(0.08, 0.95)
    return "#" + "".join(f"{17 * round(15 * channel):02x}" for channel in colorsys.hsv_to_rgb(hue, saturated, value))


def poster(width: float, height: float, rng: np.random.Generator) -> Solid:
    """Return a printed panel from the origin: a vehicle or a logo on a plain or divided background, with text."""
    out = Solid()
    out.pane(drawn_color(rng), (0.0, width), (0.0, height), 0.0)
    if rng.random() < 0.6:  # a road, a band or a sky
        edge = height * rng.uniform(0.15, 0.6)
        low, high = (0.0, edge) if rng.random() < 0.7 else (edge, height)
        out.pane(drawn_color(rng, 0.6), (0.0, width), (low, high), LAYER_GAP_M)
    choice = rng.random()
    if choice < 0.55:
        _put(out, vehicle_from_side(rng), (width, height), 0.44, rng)
    elif choice < 0.8:
        _put(out, vehicle_from_front(rng), (width, height), 0.78, rng)
    else:
        _put(out, logo(rng), (width, height), 1.0, rng)
    line = min(0.12 * height, 0.12 * width)
    for y in (0.06 * height, height - 1.6 * line)[: int(rng.integers(0, 3))]:
        out.add(letters(0.8 * width * rng.uniform(0.5, 1.0), line, rng), (0.08 * width, y, 6 * LAYER_GAP_M))
    return out


def _put(out: Solid, picture: Solid, size: tuple[float, float], shape: float, rng: np.random.Generator) -> None:
    """Put an image of width 1 and height `shape` at a random position on a panel, at a random size that fits."""
    width, height = size
    scale = min(0.94 * width, 0.9 * height / shape) * rng.uniform(0.7, 1.0)
    x, y = rng.uniform(0.03, 0.97, 2) * [width - scale, height - scale * shape]
    out.add(picture.placed((x, y, 2 * LAYER_GAP_M), np.diag([scale, scale, 1.0])))


def vehicle_from_side(rng: np.random.Generator) -> Solid:
    """Return the side view of a vehicle of length 1, made of few flat shapes."""
    body, windows, wheels = _SIDE_VIEWS[str(rng.choice(list(_SIDE_VIEWS)))]
    paint, glass = drawn_color(rng), str(rng.choice(["#112233", "#334455", "#8899aa"]))
    out, mirrored = Solid(), rng.random() < 0.5

    def put(color: str, outline: ArrayLike, z: float) -> None:
        points = np.asarray(outline, dtype=np.float64)
        filled(out, color, (np.array([1.0, 0.0]) + np.array([-1.0, 1.0]) * points)[::-1] if mirrored else points, z)

    for part in body:
        put(paint, part, 0.0)
    for part in windows:
        put(glass, part, LAYER_GAP_M)
    lamp = 0.6 * body[0][2][1]
    put("#ffeecc", _rectangle(0.005, lamp, 0.045, 0.03), LAYER_GAP_M)
    put("#aa1111", _rectangle(0.955, lamp, 0.04, 0.04), LAYER_GAP_M)
    for x in wheels:
        put("#111111", filled_disc(x, 0.085, 0.082), 2 * LAYER_GAP_M)
        put("#999999", filled_disc(x, 0.085, 0.048), 3 * LAYER_GAP_M)
    return out


def vehicle_from_front(rng: np.random.Generator) -> Solid:
    """Return the front or rear view of a car of width 1, made of few flat shapes."""
    paint, rear = drawn_color(rng), rng.random() < 0.35
    out = Solid()
    for x in (0.06, 0.76):
        filled(out, "#111111", _rectangle(x, 0.0, 0.18, 0.16), 0.0)
    for part in _BODY_FRONT:
        filled(out, paint, part, LAYER_GAP_M)
    filled(out, "#223344", ((0.14, 0.48), (0.86, 0.48), (0.75, 0.73), (0.25, 0.73)), 2 * LAYER_GAP_M)
    for x in (0.04, 0.76):
        filled(out, "#bb1111" if rear else "#ffffee", _rectangle(x, 0.31, 0.2, 0.09), 2 * LAYER_GAP_M)
    if not rear:
        filled(out, "#222222", _rectangle(0.28, 0.28, 0.44, 0.12), 2 * LAYER_GAP_M)
    filled(out, "#eeeedd", _rectangle(0.37, 0.17, 0.26, 0.07), 2 * LAYER_GAP_M)
    return out


def logo(rng: np.random.Generator) -> Solid:
    """Return a sign of width and height 1: a disc, a ring, bars or a wedge, inside each other."""
    out = Solid()
    for k in range(int(rng.integers(1, 4))):
        size, color, z = 0.5 * 0.62**k, drawn_color(rng), k * LAYER_GAP_M
        form = int(rng.integers(4))
        if form == 0:
            filled(out, color, filled_disc(0.5, 0.5, size), z)
        elif form == 1:
            filled(out, color, _rectangle(0.5 - size, 0.5 - 0.6 * size, 2 * size, 1.2 * size), z)
        elif form == 2:
            filled(out, color, ((0.5 - size, 0.5 - size), (0.5 + size, 0.5 - size), (0.5, 0.5 + size)), z)
        else:
            for y in (-0.8, -0.2, 0.4):
                filled(out, color, _rectangle(0.5 - size, 0.5 + y * size, 2 * size, 0.35 * size), z)
    return out


def letters(width: float, height: float, rng: np.random.Generator, color: str | None = None) -> Solid:
    """Return a row of strokes that looks like a word in a distant view; without `color`, its colour is random."""
    out, x, color = Solid(), 0.0, color or drawn_color(rng, 0.5)
    while x + 0.7 * height < width:
        wide = height * rng.uniform(0.35, 0.7)
        filled(out, color, _rectangle(x, 0.0, 0.22 * height, height), 0.0)
        for y in rng.choice([0.0, 0.4, 0.8], int(rng.integers(0, 3)), replace=False):
            filled(out, color, _rectangle(x + 0.22 * height, y * height, wide, 0.2 * height), 0.0)
        x += wide + 0.5 * height
    return out


def filled(out: Solid, color: str, outline: ArrayLike, z: float) -> None:
    """Fill a convex outline (N, 2), counter-clockwise."""
    points = np.column_stack([np.asarray(outline, dtype=np.float64), np.full(len(np.asarray(outline)), z)])
    for i in range(1, len(points) - 1, 2):
        out.face(color, *points[[0, i, i + 1, *([i + 2] if i + 2 < len(points) else [])]])


def _rectangle(x: float, y: float, width: float, height: float) -> _Outline:
    return ((x, y), (x + width, y), (x + width, y + height), (x, y + height))


def filled_disc(x: float, y: float, radius: float) -> Array:
    """Return the outline (12, 2) of a disc."""
    angle = np.arange(12) * np.pi / 6
    return np.array([x, y]) + radius * np.column_stack([np.cos(angle), np.sin(angle)])
