"""Fronts of houses as solids: x along the wall, y up, z outwards; windows, doors, shop fronts, balconies."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from skope.gen.scenery.quads import Solid
from skope.types import Array


@dataclass(frozen=True)
class FacadeSizes:
    """Sizes of windows and doors."""

    reveal_m: float = 0.12
    """Depth of windows in the wall, metres."""
    door_m: tuple[float, float] = (1.0, 2.15)
    """Width and height of a door, metres."""
    frame_m: float = 0.06
    """Width of a frame, metres."""
    layer_m: float = 0.03
    """Distance of decoration from the wall, metres."""


FACADE_SIZES: Final = FacadeSizes()


@dataclass(frozen=True, kw_only=True)
class FacadeStyle:
    """Walls and windows of a house: materials by name, lengths in metres."""

    walls: str
    dressing: str
    """Material of sills, lintels, string courses and quoins."""
    frame: str
    door: str
    storeys: tuple[float, ...]
    """Height of each storey from the ground up."""
    bay: float
    """Width of wall per window."""
    window: tuple[float, float]
    sill: float
    """Height of window sills above the floor of their storey."""
    panes: tuple[int, int]
    """Columns and rows of panes in a window."""
    lintels: bool = False
    surrounds: bool = False
    shutters: str | None = None
    quoins: bool = False
    cornice: bool = False
    balconies: bool = False

    @property
    def height(self) -> float:
        return sum(self.storeys)

    def floor(self, storey: int) -> float:
        return sum(self.storeys[:storey])


@dataclass(frozen=True, kw_only=True)
class Shop:
    fascia: str
    lettering: str
    awning: str | None


def facade(
    width: float,
    style: FacadeStyle,
    rng: np.random.Generator,
    *,
    near: bool,
    plain: bool = False,
    bays: int | None = None,
    door: bool = False,
    shop: Shop | None = None,
    wrap: bool = False,
) -> Solid:
    """Return a wall from x = 0 to `width`.

    A near wall has recessed windows and details as geometry. A far wall has its windows and doors on its surface, which
    takes a tenth of the triangles.

    Args:
        width: Width of the wall, metres.
        style: Style of the house.
        rng: Random generator.
        near: Whether the wall is near a camera.
        plain: Whether windows are panes of glass only.
        bays: Number of bays; None: as many as fit.
        door: Whether the wall has a door.
        shop: The shop on the ground floor, if any.
        wrap: Whether the bands of this wall continue around the corner to the next wall.
    """
    out = Solid()
    count = max(1, round((width - 0.6) / style.bay)) if bays is None else bays
    middles = (np.arange(count) + 0.5) * width / max(count, 1)
    door_bay = int(rng.integers(count)) if door and count else -1
    holes: list[tuple[float, float, float, float]] = []
    windows: list[tuple[float, float]] = []
    for storey in range(len(style.storeys)):
        if storey == 0 and shop:
            continue
        low = style.floor(storey) + style.sill
        for bay, x in enumerate(middles):
            if storey == 0 and bay == door_bay:
                continue
            windows.append((x - style.window[0] / 2, low))
            holes.append((x - style.window[0] / 2, x + style.window[0] / 2, low, low + style.window[1]))
    if door_bay >= 0 and not shop:
        x = middles[door_bay]
        holes.append(
            (x - FACADE_SIZES.door_m[0] / 2, x + FACADE_SIZES.door_m[0] / 2, 0.15, 0.15 + FACADE_SIZES.door_m[1])
        )
        out.add(_door(style, near), (x - FACADE_SIZES.door_m[0] / 2, 0.15, 0.0 if near else FACADE_SIZES.layer_m))
    if shop:
        front = _ShopFront(width, style, shop, rng, near)
        holes += front.holes
        out.add(front.solid, (0.0, 0.0, 0.0 if near else FACADE_SIZES.layer_m))
    out.faces(style.walls, _wall(width, style.height, holes if near else []))
    if plain:
        for x, y in windows:
            out.pane("window", (x, x + style.window[0]), (y, y + style.window[1]), FACADE_SIZES.layer_m)
        return out
    _put_windows(out, style, windows, rng, near)
    if near:
        _put_trim(out, width, style, plinth=shop is None, wrap=wrap)
    if style.balconies and not shop:
        _put_balconies(out, style, middles[1::3] if count > 2 else middles[:1], near)
    return out


def _wall(width: float, height: float, holes: Sequence[tuple[float, float, float, float]]) -> Array:
    """Return the quadrilaterals (N, 4, 3) of a wall with rectangular holes (x0, x1, y0, y1), corner to corner."""
    edges = np.array(holes, dtype=np.float64).reshape(-1, 4)
    xs = np.unique(np.round([0.0, width, *edges[:, :2].ravel()], 6))
    ys = np.unique(np.round([0.0, height, *edges[:, 2:].ravel()], 6))
    x, y = np.meshgrid((xs[:-1] + xs[1:]) / 2, (ys[:-1] + ys[1:]) / 2)
    solid = np.ones(x.shape, dtype=bool)
    for x0, x1, y0, y1 in edges:
        solid &= ~((x > x0) & (x < x1) & (y > y0) & (y < y1))
    row, column = np.nonzero(solid)
    left, right, low, high = xs[column], xs[column + 1], ys[row], ys[row + 1]
    flat = np.stack([[left, low], [right, low], [right, high], [left, high]]).transpose(2, 0, 1)
    return np.concatenate([flat, np.zeros((*flat.shape[:2], 1))], axis=2)


# ------------------------------------------------------------------------------------------------------------- windows


def _put_windows(
    out: Solid, style: FacadeStyle, places: list[tuple[float, float]], rng: np.random.Generator, near: bool
) -> None:
    look = rng.choice(5, len(places), p=[0.34, 0.26, 0.16, 0.10, 0.14])
    for kind in range(5):
        at = [(*corner, 0.0) for corner, chosen in zip(places, look, strict=True) if chosen == kind]
        if at:
            out.add(_window(style, kind, near), at)


def _window(style: FacadeStyle, look: int, near: bool) -> Solid:
    """Return a window with its lower left corner at the origin; `look`: plain, curtains, half a blind, a blind, net."""
    w, h = style.window
    if not near:
        return _far_window(style, look)
    out = Solid()
    x0, x1, y0, y1 = 0.0, w, 0.0, h
    if look == 1:
        x0, x1 = 0.24 * w, 0.76 * w
        out.pane("curtain", (0.0, x0), (0.0, h), -FACADE_SIZES.reveal_m)
        out.pane("curtain", (x1, w), (0.0, h), -FACADE_SIZES.reveal_m)
    elif look in (2, 3):
        y1 = h * (0.55 if look == 2 else 0.12)
        out.pane("blind", (0.0, w), (y1, h), -FACADE_SIZES.reveal_m)
    elif look == 4:
        y0 = 0.5 * h
        out.pane("curtain", (0.0, w), (0.0, y0), -FACADE_SIZES.reveal_m)
    out.pane("window", (x0, x1), (y0, y1), -FACADE_SIZES.reveal_m)
    _put_window_frame(out, style.frame, (w, h), style.panes, 0.035 - FACADE_SIZES.reveal_m)
    out.box(style.dressing, (-0.07, -0.08, 0.0), (w + 0.07, 0.0, 0.07), without="-z")
    out.recess(style.walls, (0.0, w), (0.0, h), (-FACADE_SIZES.reveal_m, 0.0))
    if style.lintels:
        out.box(style.dressing, (-0.12, h, 0.0), (w + 0.12, h + 0.2, 0.025), without="-z")
    if style.surrounds:
        for a, b in ((-0.13, 0.0), (w, w + 0.13)):
            out.box(style.dressing, (a, 0.0, 0.0), (b, h, 0.03), without="-z -y +y")
        out.box(style.dressing, (-0.13, h, 0.0), (w + 0.13, h + 0.16, 0.03), without="-z")
    if style.shutters:
        half = 0.48 * w
        for a in (-half - 0.04, w + 0.04):
            out.box(style.shutters, (a, 0.0, 0.0), (a + half, h, 0.05), without="-z")
    return out


def _far_window(style: FacadeStyle, look: int) -> Solid:
    """Return a window of few triangles: a board of the frame's colour with its panes in front."""
    w, h = style.window
    out = Solid()
    out.pane(style.frame, (0.0, w), (0.0, h), FACADE_SIZES.layer_m)
    columns = min(style.panes[0], 2)
    glass = "blind" if look == 3 else "curtain" if look == 4 else "window"
    for i in range(columns):
        out.pane(
            glass,
            (w * i / columns + FACADE_SIZES.frame_m, w * (i + 1) / columns - FACADE_SIZES.frame_m),
            (FACADE_SIZES.frame_m, h - FACADE_SIZES.frame_m),
            2 * FACADE_SIZES.layer_m,
        )
    return out


def _put_window_frame(out: Solid, frame: str, size: tuple[float, float], panes: tuple[int, int], z: float) -> None:
    """Add a frame around a window and bars that divide it."""
    w, h = size
    f = FACADE_SIZES.frame_m
    out.pane(frame, (0.0, f), (0.0, h), z)
    out.pane(frame, (w - f, w), (0.0, h), z)
    out.pane(frame, (f, w - f), (0.0, f), z)
    out.pane(frame, (f, w - f), (h - f, h), z)
    columns, rows = panes
    for i in range(1, columns):
        x = w * i / columns
        out.pane(frame, (x - 0.025, x + 0.025), (f, h - f), z)
    for i in range(1, rows):
        # Slightly behind the upright bars that it crosses.
        y = h * (0.68 if rows == 2 else i / rows)
        out.pane(frame, (f, w - f), (y - 0.025, y + 0.025), z - 0.01)


# --------------------------------------------------------------------------------------------------------------- doors


def _door(style: FacadeStyle, near: bool) -> Solid:
    """Return a door with its lower left corner at the origin, a step before it and a hood above."""
    w, h = FACADE_SIZES.door_m
    depth = 0.16 if near else 0.0
    out = Solid()
    out.pane(style.door, (0.0, w), (0.0, h - 0.4), -depth)
    out.pane("window", (0.0, w), (h - 0.4, h), -depth)
    out.box(style.dressing, (-0.25, -0.15, 0.0), (w + 0.25, 0.0, 0.45), without="-z -y")
    if near:
        out.recess(style.walls, (0.0, w), (0.0, h), (-depth, 0.0))
        _put_window_frame(out, style.frame, (w, h), (1, 1), 0.03 - depth)
        out.pane(style.frame, (FACADE_SIZES.frame_m, w - FACADE_SIZES.frame_m), (h - 0.45, h - 0.39), 0.03 - depth)
        for low, high in ((0.15, 0.75), (0.9, 1.6)):
            for a in (0.14, 0.54):
                out.box(style.door, (a, low, -depth), (a + 0.32, high, 0.02 - depth), without="-z")
        out.box(style.frame, (-0.25, h + 0.15, 0.0), (w + 0.25, h + 0.24, 0.6), without="-z")
    return out


class _ShopFront:
    """Ground floor of a shop: panes between pillars, a fascia board with lettering, and an optional awning."""

    def __init__(self, width: float, style: FacadeStyle, shop: Shop, rng: np.random.Generator, near: bool) -> None:
        self.holes: list[tuple[float, float, float, float]] = []
        self.solid = Solid()
        top = style.storeys[0] - 0.95
        count = max(2, round(width / 3.2))
        edges = np.linspace(0.35, width - 0.35, count + 1)
        door_bay = int(rng.integers(count))
        for bay, (x0, x1) in enumerate(zip(edges[:-1] + 0.14, edges[1:] - 0.14, strict=True)):
            low = 0.04 if bay == door_bay else 0.55
            self.holes.append((x0, x1, low, top))
            self._add_pane(style, shop, (x0, x1 - x0), (low, top - low), bay == door_bay, near)
        self._add_fascia(width, top, shop, rng, near)

    def _add_pane(
        self, style: FacadeStyle, shop: Shop, x: tuple[float, float], y: tuple[float, float], door: bool, near: bool
    ) -> None:
        depth = (0.7 if door else 0.1) if near else 0.0
        part = Solid()
        (w, h), frame = (x[1], y[1]), style.frame if style.frame != "frame" else shop.fascia
        part.pane("shop_window", (0.0, w), (0.0, h), -depth)
        _put_window_frame(part, frame, (w, h), (2 if door or w < 3 else 3, 2 if door else 1), 0.03 - depth)
        if near:
            part.recess(style.walls if door else frame, (0.0, w), (0.0, h), (-depth, 0.0))
        if not door:
            part.box(shop.fascia, (0.0, -0.5, 0.0), (w, -0.04, 0.03), without="-z")
            part.box(style.dressing, (-0.05, -0.04, 0.0), (w + 0.05, 0.0, 0.08), without="-z")
        self.solid.add(part, (x[0], y[0], 0.0))

    def _add_fascia(self, width: float, top: float, shop: Shop, rng: np.random.Generator, near: bool) -> None:
        low, high, front = top + 0.1, top + 0.75, 0.14
        x0, x1 = 0.2, width - 0.2
        self.solid.box(shop.fascia, (x0, low, 0.0), (x1, high, front), without="-z")
        self.solid.box("dressing", (x0 - 0.08, high, 0.0), (x1 + 0.08, high + 0.08, front + 0.08), without="-z")
        if near:
            _put_lettering(self.solid, shop.lettering, (x0, x1), (low + 0.16, high - 0.16), front + 0.006, rng)
        if shop.awning:
            reach, drop = 1.25, 0.55
            inner, outer = (low - 0.02, front - 0.04), (low - drop, reach)
            cloth = [(x, *end) for x, end in ((x0, outer), (x1, outer), (x1, inner), (x0, inner))]
            self.solid.face(shop.awning, *cloth)
            self.solid.face(shop.awning, *((x, y - 0.02, z - 0.01) for x, y, z in cloth[::-1]))
            self.solid.box(shop.awning, (x0, outer[0] - 0.2, reach - 0.02), (x1, outer[0], reach))


def _put_lettering(
    out: Solid, material: str, x: tuple[float, float], y: tuple[float, float], z: float, rng: np.random.Generator
) -> None:
    """Add strokes that look like a word in a distant view, centred on a board."""
    size = y[1] - y[0]
    letters = int(np.clip(rng.integers(6, 13), 3, (x[1] - x[0] - 0.6) / (0.8 * size)))
    at, stroke = (x[0] + x[1]) / 2 - letters * 0.4 * size, 0.13 * size
    for _ in range(letters):
        width = 0.55 * size
        out.pane(material, (at, at + stroke), y, z)
        shape = rng.integers(4)
        if shape in (0, 1):
            out.pane(material, (at + width - stroke, at + width), y, z)
        for share in ((0.0,), (0.43, 0.87), (0.0, 0.43, 0.87), (0.0, 0.87))[int(shape)]:
            low = y[0] + share * size
            out.pane(material, (at + stroke, at + width - stroke * (shape < 2)), (low, low + stroke), z)
        at += 0.8 * size


# ---------------------------------------------------------------------------------------------------------- decoration


def _put_trim(out: Solid, width: float, style: FacadeStyle, *, plinth: bool, wrap: bool) -> None:
    """Add plinth, string course, cornice and quoins."""
    bands = [(0.0, 0.14, 0.04)] if plinth else []  # the step hides its gap at the door
    if style.cornice:
        first, top = style.floor(1) - 0.05, style.height
        bands += [(first, first + 0.16, 0.06), (top - 0.34, top - 0.14, 0.1), (top - 0.14, top, 0.2)]
    for low, high, reach in bands:
        beyond = reach if wrap else 0.0
        out.box(style.dressing, (-beyond, low, 0.0), (width + beyond, high, reach), without="-z")
    if style.quoins and wrap:
        top = style.height - 0.4
        for i, y in enumerate(np.arange(0.2, top - 0.3, 0.34)):
            reach = 0.42 if i % 2 else 0.26
            out.box(style.dressing, (-0.03, y, -0.3), (reach, y + 0.3, 0.03), without="-z +y -y")
            out.box(style.dressing, (width - reach, y, -0.3), (width + 0.03, y + 0.3, 0.03), without="-z +y -y")


def _put_balconies(out: Solid, style: FacadeStyle, middles: Array, near: bool) -> None:
    reach, half = 1.15, 1.5
    part = Solid()
    part.box("concrete", (-half, -0.16, 0.0), (half, 0.0, reach), without="-z")
    rail = 1.0
    if near:
        for x in np.linspace(-half + 0.03, half - 0.03, 21):
            part.pane("iron", (x - 0.014, x + 0.014), (0.0, rail), reach - 0.03)
        part.box("iron", (-half, rail, reach - 0.07), (half, rail + 0.05, reach - 0.01))
        for x in (-half, half - 0.04):
            part.box("balustrade", (x, 0.05, 0.0), (x + 0.04, rail, reach - 0.06))
    else:
        part.box("balustrade", (-half, 0.05, reach - 0.05), (half, rail, reach))
    for storey in range(1, len(style.storeys)):
        out.add(part, [(x, style.floor(storey) + 0.02, 0.0) for x in middles])
