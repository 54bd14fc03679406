"""Boards, posts and machines beside roads that resemble lamps and fronts of vehicles.

x along the road, y towards it, z up, metres. They extend below the ground, which may slope down under them.
"""

import itertools
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, lathe, merged
from skope.gen.scenery.printed_pictures import LAYER_GAP_M, drawn_color, filled, filled_disc, letters
from skope.gen.scenery.quads import BELOW_GROUND_M, TOWARDS_ROAD, Solid

ARROW_PARTS: Final = (
    ((-0.5, -0.08), (0.05, -0.08), (0.05, 0.08), (-0.5, 0.08)),
    ((0.05, -0.35), (0.5, 0.0), (0.05, 0.35)),
)
"""Convex parts of an arrow of length 1 to the right, with its middle at the origin."""
_SIGN_COLORS: Final = (
    ("sign_blue", "sign_white"),
    ("sign_green", "sign_white"),
    ("sign_white", "fascia_black"),
    ("sign_yellow", "fascia_black"),
)
"""Background and text colours of direction signs."""
_CHEVRON_COLORS: Final = (
    ("sign_red", "sign_white"),
    ("sign_white", "sign_red"),
    ("sign_white", "fascia_black"),
    ("sign_yellow", "fascia_black"),
)
"""Background and arrowhead colours of boards in curves."""
PARKING_PARTS: Final = (
    ((-0.1, 0.1), (-0.04, 0.1), (-0.04, 0.42), (-0.1, 0.42)),
    ((-0.04, 0.24), (0.1, 0.24), (0.1, 0.3), (-0.04, 0.3)),
    ((-0.04, 0.36), (0.1, 0.36), (0.1, 0.42), (-0.04, 0.42)),
    ((0.06, 0.3), (0.12, 0.3), (0.12, 0.36), (0.06, 0.36)),
)
"""Convex parts of a P on a plate 0.5 m high, metres."""


def arrow_trailer(rng: np.random.Generator) -> Mesh:
    """Return a trailer of road works with an upright panel.

    The panel has an arrow of lamps, or a white arrow on a blue disc over stripes.
    """
    x, top = rng.uniform(0.85, 1.2), rng.uniform(2.6, 3.6)
    out = Solid()
    out.box("zinc", (-0.75, -1.2, 0.42), (0.75, 0.7, 0.56))
    out.box("iron", (-0.8, -0.25, 0.23), (0.8, -0.15, 0.33))
    for side in (-0.55, 0.5):
        out.box("iron", (side, -0.35, 0.3), (side + 0.05, -0.05, 0.42), without="+z")
    out.box("zinc", (-0.05, -2.5, 0.42), (0.05, -1.2, 0.52), without="+y")
    out.box("iron", (-0.04, -2.4, BELOW_GROUND_M), (0.04, -2.32, 0.42), without="-z +z")
    out.box(drawn_color(rng), (-0.5, -0.9, 0.56), (0.5, -0.3, 1.05), without="-z")
    for post in (-0.6, 0.52):
        out.box("zinc", (post, 0.55, 0.56), (post + 0.08, 0.63, top - 0.1), without="-z")
    out.box("frame_dark", (-x, 0.63, 0.6), (x, 0.7, top))
    front = Solid()
    _stripes(front, (-x + 0.03, x - 0.03), (0.63, 1.0))
    if rng.random() < 0.5:
        side = min(2 * x, top - 1.0) - 0.12
        lamp = str(rng.choice(["luminaire", "sign_yellow", "#ff9911"]))
        _lamp_arrow(front, lamp, (0.0, (top + 1.0) / 2), side, rng.choice([-1, 1]))
    else:
        _stripes(front, (-x + 0.03, x - 0.03), (1.0, top - 0.03))
        _blue_arrow(front, (0.0, (top + 1.0) / 2), 0.46 * min(2 * x, top - 1.0), rng.choice([-1, 1]))
        for side in (-1, 1):
            filled(front, "#ff9911", filled_disc(side * (x - 0.16), top - 0.18, 0.1), 4 * LAYER_GAP_M)
    out.add(front.placed((0.0, 0.7, 0.0), TOWARDS_ROAD))
    wheel = lathe([(-0.1, 0.0), (-0.1, 0.28), (0.1, 0.28), (0.1, 0.0)], ["rim", "tyre", "rim"], 14, "y")
    turned = wheel.moved((0.0, 0.0, 0.0), np.pi / 2)
    return merged([out.mesh(), *(turned.moved((side * 0.87, -0.2, 0.28)) for side in (-1, 1))])


def _stripes(out: Solid, x: tuple[float, float], y: tuple[float, float]) -> None:
    """Add red and white upright stripes to a panel."""
    count = max(4, round((x[1] - x[0]) / 0.25))
    edges = np.linspace(*x, count + 1)
    for k in range(count):
        out.pane("sign_white" if k % 2 else "sign_red", (edges[k], edges[k + 1]), y, LAYER_GAP_M)


def _lamp_arrow(out: Solid, lamp: str, middle: tuple[float, float], side: float, way: int) -> None:
    """Add an arrow of round lamps to a panel; it points right if `way` is 1, left if it is -1."""
    along = np.linspace(-0.5, 0.5, 6)
    places = [(a, 0.0) for a in along] + [(0.5 - b, sign * b) for b in (0.17, 0.34) for sign in (-1, 1)]
    for u, v in places:
        at = (middle[0] + 0.85 * side * way * u, middle[1] + 0.85 * side * v)
        filled(out, "#222222", filled_disc(*at, 0.065 * side), LAYER_GAP_M)
        filled(out, lamp, filled_disc(*at, 0.05 * side), 2 * LAYER_GAP_M)


def _blue_arrow(out: Solid, middle: tuple[float, float], radius: float, way: int) -> None:
    """Add a blue disc with a white rim and a white arrow that points down to one side."""
    filled(out, "sign_white", filled_disc(*middle, radius), 2 * LAYER_GAP_M)
    filled(out, "sign_blue", filled_disc(*middle, 0.93 * radius), 3 * LAYER_GAP_M)
    _arrow(out, "sign_white", middle, 1.5 * radius, -np.pi / 4 if way > 0 else -3 * np.pi / 4, 4 * LAYER_GAP_M)


def _arrow(out: Solid, color: str, middle: tuple[float, float], length: float, angle: float, z: float) -> None:
    """Add an arrow to a panel; `angle` is its direction, counter-clockwise from the right."""
    c, s = np.cos(angle), np.sin(angle)
    for part in ARROW_PARTS:
        filled(out, color, middle + length * np.array(part) @ np.array([[c, s], [-s, c]]), z)


def chevron_boards(rng: np.random.Generator) -> Mesh:
    """Return boards at the outside of a curve: arrowheads on one long board or on several square boards."""
    side, count, low = rng.uniform(0.5, 0.95), int(rng.integers(1, 6)), rng.uniform(0.5, 1.1)
    ground, mark = _CHEVRON_COLORS[int(rng.integers(len(_CHEVRON_COLORS)))]
    way, gap = int(rng.choice([-1, 1])), 0.0 if rng.random() < 0.4 else rng.uniform(0.3, 0.8)
    out, front = Solid(), Solid()
    front.pane(ground, (-side / 2, side / 2), (0.0, side), LAYER_GAP_M)
    for sign in (-1, 1):
        reach = ((0.38, 0.5), (-0.04, 0.5 + 0.46 * sign), (-0.4, 0.5 + 0.46 * sign), (0.02, 0.5))
        corners = side * np.array([(way * u, v) for u, v in reach])
        filled(front, mark, corners if way * sign > 0 else corners[::-1], 2 * LAYER_GAP_M)
    for k in range(count):
        x = (side + gap) * (k - (count - 1) / 2)
        out.box("zinc", (x - 0.04, -0.08, BELOW_GROUND_M), (x + 0.04, 0.0, low + side - 0.05), without="-z")
        out.box("frame_dark", (x - side / 2, 0.0, low), (x + side / 2, 0.03, low + side))
        out.add(front.placed((x, 0.03, low), TOWARDS_ROAD))
    return out.mesh()


def direction_sign(rng: np.random.Generator) -> Mesh:
    """Return a large direction sign on two posts: place names and arrows on blue, green, white or yellow."""
    x, low = rng.uniform(0.9, 2.2), rng.uniform(0.9, 2.4)
    rows = int(rng.integers(2, 5))
    high = rows * rng.uniform(0.4, 0.65)
    ground, ink = _SIGN_COLORS[int(rng.integers(len(_SIGN_COLORS)))]
    out = Solid()
    for post in (-0.7 * x, 0.7 * x - 0.1):
        out.box("zinc", (post, -0.12, BELOW_GROUND_M), (post + 0.1, 0.0, low + high - 0.1), without="-z")
    out.box("zinc", (-x, 0.0, low), (x, 0.04, low + high))
    front = Solid()
    front.pane(ink, (-x, x), (low, low + high), LAYER_GAP_M)
    front.pane(ground, (-x + 0.05, x - 0.05), (low + 0.05, low + high - 0.05), 2 * LAYER_GAP_M)
    row = (high - 0.1) / rows
    for k in range(rows):
        y, side = low + 0.05 + (k + 0.5) * row, rng.choice([-1, 1])
        _arrow(
            front, ink, (side * (x - 0.15 - 0.4 * row), y), 0.8 * row, int(rng.integers(3)) * np.pi / 2, 3 * LAYER_GAP_M
        )
        word, left = letters((2 * x - 0.6 - 0.8 * row) * rng.uniform(0.6, 1.0), 0.45 * row, rng, ink), -x + 0.15
        front.add(word, (left if side > 0 else left + 0.15 + 0.8 * row, y - 0.22 * row, 3 * LAYER_GAP_M))
    out.add(front.placed((0.0, 0.04, 0.0), TOWARDS_ROAD))
    return out.mesh()


def site_fence(rng: np.random.Generator) -> Mesh:
    """Return one or two panels of a site's fence on concrete feet, of bars or lettered boards, with lamps on top."""
    count, long, top = int(rng.integers(1, 3)), 3.4, rng.uniform(1.9, 2.2)
    boarded, lamp = rng.random() < 0.5, str(rng.choice(["luminaire", "#ff8800", "sign_red"]))
    board = drawn_color(rng)
    out = Solid()
    for k in range(count):
        x = long * (k - count / 2)
        for at in (x + 0.05, x + long - 0.1):
            out.box("zinc", (at, -0.03, BELOW_GROUND_M), (at + 0.05, 0.03, top), without="-z")
            out.box(lamp, (at - 0.05, -0.06, top), (at + 0.1, 0.06, top + 0.17))
        for at in (x + 0.02, x + long - 0.32):
            out.box("concrete", (at, -0.35, BELOW_GROUND_M), (at + 0.3, 0.35, 0.13), without="-z")
        if boarded:
            out.box(board, (x + 0.1, -0.02, 0.15), (x + long - 0.1, 0.02, top - 0.05))
            word = letters(rng.uniform(1.2, 2.6), rng.uniform(0.25, 0.5), rng)
            out.add(word.placed((x + long - 0.4, 0.02 + LAYER_GAP_M, 1.1), TOWARDS_ROAD))
        else:
            for z in (0.2, 0.5 * top, top - 0.08):
                out.box("zinc", (x + 0.1, -0.02, z), (x + long - 0.1, 0.02, z + 0.04), without="-x +x")
            for at in np.arange(x + 0.2, x + long - 0.15, 0.14):
                out.box("zinc", (at, -0.01, 0.2), (at + 0.015, 0.01, top - 0.08), without="-z +z")
            _tape(out, (x + 0.1, x + long - 0.1), 1.0)
    return out.mesh()


def _tape(out: Solid, x: tuple[float, float], z: float) -> None:
    """Add red and white tape along a fence."""
    edges = np.linspace(*x, 13)
    for k, (left, right) in enumerate(itertools.pairwise(edges)):
        out.box("sign_white" if k % 2 else "sign_red", (left, -0.035, z), (right, 0.035, z + 0.15), without="-x +x")


def posts(rng: np.random.Generator) -> Mesh:
    """Return a row of posts with reflective bands: marker posts of road works, bollards of stone or of steel."""
    count, gap, high = int(rng.integers(3, 9)), rng.uniform(0.8, 1.2), rng.uniform(0.7, 1.15)
    radius = rng.uniform(0.05, 0.14)
    body = str(rng.choice(["#ff6611", "iron", "concrete", "sign_red", drawn_color(rng)]))
    band = str(rng.choice(["sign_white", "sign_yellow", "sign_red", "lettering"]))
    steps = [BELOW_GROUND_M, 0.5 * high, 0.62 * high, 0.74 * high, 0.86 * high, high, high + 0.4 * radius]
    profile = [(z, radius) for z in steps[:-1]] + [(steps[-1], 0.0)]
    post = lathe(profile, [body, band, body, band, body, body], 9, "z")
    parts = [post.moved((gap * (k - (count - 1) / 2), 0.0, 0.0)) for k in range(count)]
    if radius < 0.09 and rng.random() < 0.5:  # on rubber feet
        foot = lathe([(BELOW_GROUND_M, 0.2), (0.05, 0.2), (0.1, radius)], ["tyre"] * 2, 9, "z")
        parts += [foot.moved((gap * (k - (count - 1) / 2), 0.0, 0.0)) for k in range(count)]
    return merged(parts)


def ticket_machines(rng: np.random.Generator) -> Mesh:
    """Return a ticket machine with a screen, a slot and a sign above it, or a row of parking meters on poles."""
    color = str(rng.choice(["sign_blue", "frame_dark", "cabinet", drawn_color(rng)]))
    return _parking_meters(color, rng) if rng.random() < 0.4 else _ticket_machine(color, rng)


def _parking_meters(color: str, rng: np.random.Generator) -> Mesh:
    count, gap = int(rng.integers(2, 4)), rng.uniform(1.6, 2.4)
    meter = Solid()
    meter.box(color, (-0.11, -0.08, 1.1), (0.11, 0.08, 1.42))
    meter.extrude(color, [(0.08, 1.42), (0.06, 1.5), (0.0, 1.53)], (-0.09, 0.09))
    front = Solid()
    front.pane("shop_window", (-0.075, 0.075), (1.28, 1.4), LAYER_GAP_M)
    front.pane("sign_red", (-0.04, 0.04), (1.16, 1.22), LAYER_GAP_M)
    meter.add(front.placed((0.0, 0.08, 0.0), TOWARDS_ROAD))
    pole = lathe([(BELOW_GROUND_M, 0.035), (1.12, 0.035)], ["zinc"], 8, "z")
    whole = merged([meter.mesh(), pole])
    return merged(whole.moved((gap * (k - (count - 1) / 2), 0.0, 0.0)) for k in range(count))


def _ticket_machine(color: str, rng: np.random.Generator) -> Mesh:
    x, y, top = rng.uniform(0.2, 0.32), rng.uniform(0.15, 0.24), rng.uniform(1.45, 1.8)
    out = Solid()
    out.box("iron", (-x + 0.04, -y + 0.04, BELOW_GROUND_M), (x - 0.04, y - 0.04, 0.16), without="-z +z")
    out.box(color, (-x, -y, 0.15), (x, y, top))
    front = Solid()
    front.pane("shop_window", (-0.7 * x, 0.7 * x), (top - 0.4, top - 0.15), LAYER_GAP_M)
    front.pane("zinc", (-0.7 * x, 0.1 * x), (top - 0.75, top - 0.5), LAYER_GAP_M)
    front.pane("#222222", (0.25 * x, 0.7 * x), (top - 0.7, top - 0.6), LAYER_GAP_M)
    front.pane("#222222", (-0.5 * x, 0.5 * x), (0.45, 0.6), LAYER_GAP_M)
    out.add(front.placed((0.0, y, 0.0), TOWARDS_ROAD))
    out.box("zinc", (-0.03, -0.03, top), (0.03, 0.03, top + 0.35), without="-z")
    out.box("sign_blue", (-0.25, -0.035, top + 0.35), (0.25, 0.035, top + 0.85))
    plate = Solid()
    for part in PARKING_PARTS:
        filled(plate, "sign_white", part, LAYER_GAP_M)
    out.add(plate.placed((0.0, 0.035, top + 0.35), TOWARDS_ROAD))
    return out.mesh()


def phone_boxes(rng: np.random.Generator) -> Mesh:
    """Return one to three phone boxes beside each other: panes between bars on all sides, a lit sign under the roof."""
    color = str(rng.choice(["sign_red", "frame_dark", "zinc", "#dd1188", drawn_color(rng)]))
    half, top = 0.45, rng.uniform(2.2, 2.45)
    rows = int(rng.integers(2, 7))
    booth = Solid()
    booth.box(color, (-half, -half, BELOW_GROUND_M), (half, half, top - 0.25), without="-z +z")
    booth.box(color, (-half - 0.03, -half - 0.03, top - 0.25), (half + 0.03, half + 0.03, top))
    booth.extrude(color, [(half - 0.02, top), (0.5 * half, top + 0.08)], (-half + 0.02, half - 0.02))
    wall = Solid()
    edges = np.linspace(0.4, top - 0.3, rows + 1)
    for low, high in itertools.pairwise(edges):
        wall.pane("shop_window", (-half + 0.09, half - 0.09), (low, high - 0.06), LAYER_GAP_M)
    wall.pane("sign_white", (-half + 0.06, half - 0.06), (top - 0.2, top - 0.05), 0.03 + LAYER_GAP_M)
    wall.add(letters(1.4 * half, 0.09, rng), (-0.7 * half, top - 0.17, 0.03 + 2 * LAYER_GAP_M))
    for x, y in ((0.0, 1.0), (0.0, -1.0), (1.0, 0.0), (-1.0, 0.0)):
        booth.add(wall.placed((half * x, half * y, 0.0), ((-y, x, 0.0), (0.0, 0.0, 1.0), (x, y, 0.0))))
    count = int(rng.integers(1, 4))
    return merged(booth.mesh().moved((1.15 * (k - (count - 1) / 2), 0.0, 0.0)) for k in range(count))


def message_board(rng: np.random.Generator) -> Mesh:
    """Return a black board on one or two posts: lines of amber or white dots, and a red ring or an arrow."""
    x, rows, line = rng.uniform(1.0, 2.0), int(rng.integers(1, 4)), rng.uniform(0.3, 0.42)
    low, dots = rng.uniform(1.6, 3.4), str(rng.choice(["lit_amber", "lit_amber", "lit_white"]))
    side, ringed = rows * (line + 0.14) + 0.14, rng.random() < 0.4
    out, front = Solid(), Solid()
    for post in (0.0,) if rng.random() < 0.4 else (-0.6 * x, 0.6 * x):
        out.box("zinc", (post - 0.09, -0.18, BELOW_GROUND_M), (post + 0.09, 0.0, low + side - 0.1), without="-z")
    out.box("fascia_black", (-x, 0.0, low), (x, 0.22, low + side))
    left = -x + 0.15
    if ringed:
        radius, middle = min(0.42 * side, 0.4 * x), low + side / 2
        filled(front, "lit_red", filled_disc(left + radius, middle, radius), LAYER_GAP_M)
        filled(front, "fascia_black", filled_disc(left + radius, middle, 0.75 * radius), 2 * LAYER_GAP_M)
        front.add(
            letters(0.9 * radius, 0.7 * radius, rng, "lit_white"),
            (left + 0.6 * radius, middle - 0.35 * radius, 3 * LAYER_GAP_M),
        )
        left += 2 * radius + 0.15
    for k in range(rows):
        word = letters((x - 0.1 - left) * rng.uniform(0.5, 1.0), line, rng, dots)
        front.add(word, (left, low + 0.14 + k * (line + 0.14), LAYER_GAP_M))
    out.add(front.placed((0.0, 0.22, 0.0), TOWARDS_ROAD))
    return out.mesh()


def sign_gantry(rng: np.random.Generator) -> Mesh:
    """Return a post with an arm high over the road that carries one or two signs with lamps under them.

    The signs face along the road, in either direction; one of them may be a dot-matrix sign (variable message sign).
    """
    reach, low, count = rng.uniform(3.8, 6.5), rng.uniform(5.5, 5.9), int(rng.integers(1, 3))
    way, high = int(rng.choice([-1, 1])), rng.uniform(1.0, 1.6)
    # Axes of the panel: across the road, up, and along the road in the direction that it faces.
    axes = ((0.0, float(way), 0.0), (0.0, 0.0, 1.0), (float(way), 0.0, 0.0))
    out = Solid()
    out.box("zinc", (-0.2, -0.2, BELOW_GROUND_M), (0.2, 0.2, low + high), without="-z")
    for z in (low + 0.2, low + high - 0.3):
        out.box("zinc", (-0.1, 0.2, z), (0.1, reach, z + 0.16))
    wide = (reach - 0.5) / count - 0.2
    for k in range(count):
        middle = 0.6 + (k + 0.5) * (wide + 0.2)
        x = (0.1, 0.16) if way > 0 else (-0.16, -0.1)
        out.box("frame_dark", (x[0], middle - wide / 2, low), (x[1], middle + wide / 2, low + high))
        face = Solid()
        if rng.random() < 0.3:
            for row in range(2):
                word = letters(wide * rng.uniform(0.5, 0.85), 0.3 * high, rng, "lit_amber")
                face.add(word, (-0.42 * wide, (0.14 + 0.42 * row) * high, LAYER_GAP_M))
        else:
            ground, ink = _SIGN_COLORS[int(rng.integers(3))]
            face.pane(ink, (-wide / 2 + 0.02, wide / 2 - 0.02), (0.02, high - 0.02), LAYER_GAP_M)
            face.pane(ground, (-wide / 2 + 0.07, wide / 2 - 0.07), (0.07, high - 0.07), 2 * LAYER_GAP_M)
            for row in range(2):
                word = letters(wide * rng.uniform(0.35, 0.6), 0.22 * high, rng, ink)
                face.add(word, (-0.44 * wide, (0.16 + 0.36 * row) * high, 3 * LAYER_GAP_M))
            _arrow(
                face,
                ink,
                (0.3 * wide, high / 2),
                0.5 * min(wide, high),
                rng.choice([-1, 1, 3]) * np.pi / 4,
                3 * LAYER_GAP_M,
            )
            lamp = (x[1], x[1] + 0.5) if way > 0 else (x[0] - 0.5, x[0])
            out.box("pole", (lamp[0], middle - 0.35 * wide, low - 0.12), (lamp[1], middle + 0.35 * wide, low - 0.02))
            glow = (lamp[1] - 0.2, lamp[1]) if way > 0 else (lamp[0], lamp[0] + 0.2)
            out.box("lit_white", (glow[0], middle - 0.33 * wide, low - 0.02), (glow[1], middle + 0.33 * wide, low))
        out.add(face.placed((x[1] if way > 0 else x[0], middle, low), axes))
    return out.mesh()


def gore_boards(rng: np.random.Generator) -> Mesh:
    """Return boards where roads split: chevrons under a blue disc, or a low wall with a long band of them."""
    ground, mark = ("lit_yellow", "fascia_black") if rng.random() < 0.7 else ("lit_red", "lit_white")
    out, front = Solid(), Solid()
    if rng.random() < 0.5:
        half, side = rng.uniform(0.3, 0.5), rng.uniform(0.5, 0.9)
        out.box("zinc", (-0.05, -0.1, BELOW_GROUND_M), (0.05, 0.0, 0.4 + side), without="-z")
        out.box("frame_dark", (-half, 0.0, 0.4), (half, 0.03, 0.4 + side + 2.2 * half))
        front.pane(ground, (-half, half), (0.4, 0.4 + side), LAYER_GAP_M)
        for k in range(3):
            foot, thick = 0.42 + side * (k + 0.1) / 3.4, side / 7
            for sign in (-1, 1):
                part = [
                    (0.0, foot + 0.2 * half),
                    (0.0, foot + 0.2 * half + thick),
                    (sign * half, foot + thick),
                    (sign * half, foot),
                ]
                filled(front, mark, part if sign < 0 else part[::-1], 2 * LAYER_GAP_M)
        _blue_arrow(front, (0.0, 0.4 + side + 1.1 * half), half, rng.choice([-1, 1]))
        out.add(front.placed((0.0, 0.03, 0.0), TOWARDS_ROAD))
        return out.mesh()
    long, low = rng.uniform(2.5, 7.5), rng.uniform(0.35, 0.7)
    band, way = rng.uniform(0.2, 0.4), int(rng.choice([-1, 1]))
    out.box("concrete", (-long / 2, -0.12, BELOW_GROUND_M), (long / 2, 0.12, low + band + 0.1), without="-z")
    front.pane(ground, (-long / 2, long / 2), (low, low + band), LAYER_GAP_M)
    for at in np.arange(-long / 2 + band, long / 2 - band, rng.uniform(1.4, 2.6) * band).tolist():
        for up in (0.0, 0.5):
            lean = band * (0.5 if up == 0.0 else -0.5) * way
            start = at if up == 0.0 else at + 0.5 * band * way
            low_edge, high_edge = low + up * band, low + (up + 0.5) * band
            corners = [
                (start, low_edge),
                (start + 0.3 * band, low_edge),
                (start + 0.3 * band + lean, high_edge),
                (start + lean, high_edge),
            ]
            filled(front, mark, corners, 2 * LAYER_GAP_M)
    out.add(front.placed((0.0, 0.12, 0.0), TOWARDS_ROAD))
    return out.mesh()
