"""Objects that resemble vehicles or their parts; x along the road, y towards it, z up, metres.

They extend below the ground, which may slope down under them.
"""

from collections.abc import Callable, Mapping
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, grid, lathe, merged
from skope.gen.scenery.printed_pictures import LAYER_GAP_M, drawn_color, letters, logo, poster
from skope.gen.scenery.quads import BELOW_GROUND_M, TOWARDS_ROAD, Solid
from skope.gen.scenery.roadside_boards import (
    arrow_trailer,
    chevron_boards,
    direction_sign,
    phone_boxes,
    posts,
    site_fence,
    ticket_machines,
)
from skope.gen.scenery.roadside_objects import (
    bales,
    concrete_barriers,
    covered_boat,
    covered_caravan,
    garages,
    generator,
    gravestones,
    kerb_stones,
    market_stall,
    portable_toilets,
    recessed_wall,
)
from skope.gen.scenery.street_furniture import bus_shelter, cabinet

_DARK_COLOR: Final = "#222222"


def shipping_container(rng: np.random.Generator) -> Mesh:
    """Return a container with ribbed sides and a door with bars, 10 or 20 feet long."""
    x, y, top = rng.choice([1.5, 3.03]), 1.22, 2.59
    color = drawn_color(rng)
    out = Solid()
    out.box(color, (-x, -y, 0.15), (x, y, top), without="-z")
    for at in np.arange(-x + 0.25, x - 0.3, 0.28):
        for side in (-y - 0.04, y):
            out.box(color, (at, side, 0.3), (at + 0.14, side + 0.04, top - 0.15), without="+z -z")
    for at in (-0.8, -0.3, 0.3, 0.8):
        out.box("#888888", (x, at - 0.03, 0.25), (x + 0.06, at + 0.03, top - 0.1), without="-x")
    for corner in ((-x, -y), (-x, y - 0.15), (x - 0.15, -y), (x - 0.15, y - 0.15)):
        out.box(_DARK_COLOR, (*corner, BELOW_GROUND_M), (corner[0] + 0.15, corner[1] + 0.15, 0.16), without="-z")
    if rng.random() < 0.6:
        word = letters(rng.uniform(0.7, 1.6) * x, rng.uniform(0.25, 0.5), rng)
        out.add(word.placed((0.8 * x, y + 0.05, 1.6), TOWARDS_ROAD))
    return out.mesh()


def skip(rng: np.random.Generator) -> Mesh:
    """Return an open skip with sloping ends, full of rubble."""
    color, (x, y, top) = drawn_color(rng), (1.8, 0.85, rng.uniform(1.1, 1.6))
    low = 0.55 * x
    out = Solid()
    for side in (-1, 1):
        long = [(-low, side * y, 0.1), (low, side * y, 0.1), (x, side * y, top), (-x, side * y, top)]
        out.face(color, *(long if side < 0 else long[::-1]))
        end = [(side * low, -y, 0.1), (side * low, y, 0.1), (side * x, y, top), (side * x, -y, top)]
        out.face(color, *(end if side > 0 else end[::-1]))
        out.box(
            _DARK_COLOR, (side * 0.9 * low - 0.1, -y, BELOW_GROUND_M), (side * 0.9 * low + 0.1, y, 0.11), without="-z"
        )
        out.box(color, (-0.95 * x, side * y - 0.05, top - 0.12), (0.95 * x, side * y + 0.05, top), without="-z")
    heap = [[(a, b, top - 0.2 + rng.uniform(0, 0.35)) for a in np.linspace(-x, x, 6)] for b in np.linspace(-y, y, 4)]
    return merged([out.mesh(), grid(heap, [["gravel"] * 5] * 3)])


def bins(rng: np.random.Generator) -> Mesh:
    """Return one to four large bins on castors beside each other."""
    out = Solid()
    count = int(rng.integers(1, 5))
    for k in range(count):
        x, color = 1.5 * (k - count / 2), drawn_color(rng)
        out.box(color, (x, -0.45, 0.25), (x + 1.35, 0.45, 1.15), without="-z")
        out.box(color, (x - 0.04, -0.5, 1.15), (x + 1.39, 0.5, 1.22))
        lid = drawn_color(rng) if rng.random() < 0.5 else color
        out.face(lid, (x + 1.35, 0.48, 1.22), (x, 0.48, 1.22), (x, -0.1, 1.5), (x + 1.35, -0.1, 1.5))
        out.face(lid, (x, -0.48, 1.22), (x + 1.35, -0.48, 1.22), (x + 1.35, -0.1, 1.5), (x, -0.1, 1.5))
        for end in (x, x + 1.35):
            corners = [(end, -0.48, 1.22), (end, 0.48, 1.22), (end, -0.1, 1.5)]
            out.face(lid, *(corners if end > x else corners[::-1]))
        for a, b in ((0.1, -0.4), (1.1, -0.4), (0.1, 0.25), (1.1, 0.25)):
            out.box(_DARK_COLOR, (x + a, b, BELOW_GROUND_M), (x + a + 0.15, b + 0.15, 0.26), without="-z +z")
    return out.mesh()


def kiosk(rng: np.random.Generator) -> Mesh:
    """Return a booth with a hatch, an awning and a sign on its roof."""
    x, y, top = rng.uniform(1.0, 1.8), rng.uniform(0.9, 1.3), rng.uniform(2.3, 2.8)
    color, band = drawn_color(rng, 0.7), drawn_color(rng)
    out = Solid()
    out.box(color, (-x, -y, BELOW_GROUND_M), (x, y, top), without="-z")
    out.box(band, (-x - 0.15, -y - 0.15, top), (x + 0.15, y + 0.25, top + 0.5))
    front = Solid()
    front.pane("shop_window", (-0.8 * x, 0.8 * x), (1.0, 2.0), LAYER_GAP_M)
    front.add(letters(1.6 * x, 0.28, rng), (-0.8 * x, top + 0.1, 0.25 + LAYER_GAP_M))
    out.add(front.placed((0.0, y, 0.0), TOWARDS_ROAD))
    out.box(band, (-0.85 * x, y, 2.05), (0.85 * x, y + 0.6, 2.1))
    return out.mesh()


def shelter(rng: np.random.Generator) -> Mesh:
    """Return a bus shelter away from the kerb, with a poster at its end."""
    return bus_shelter() if rng.random() < 0.5 else merged([bus_shelter(), poster_stand(rng).moved((2.9, 0.0, 0.0))])


def crates(rng: np.random.Generator) -> Mesh:
    """Return stacked crates on pallets."""
    out = Solid()
    for k in range(int(rng.integers(1, 4))):
        x = 1.3 * k - 1.3
        out.box("timber", (x, -0.5, BELOW_GROUND_M), (x + 1.2, 0.5, 0.15), without="-z")
        z, color = 0.15, drawn_color(rng, 0.7)
        for _ in range(int(rng.integers(1, 5))):
            high, shift = rng.uniform(0.25, 0.5), rng.uniform(-0.05, 0.05)
            out.box(color, (x + 0.05 + shift, -0.45, z), (x + 1.15 + shift, 0.45, z + high - 0.03))
            z += high
            color = drawn_color(rng, 0.7) if rng.random() < 0.3 else color
    return out.mesh()


def covered_heap(rng: np.random.Generator) -> Mesh:
    """Return a tarpaulin over a heap: lumps under cloth that touches the ground all around."""
    x, y, top = rng.uniform(0.9, 2.0), rng.uniform(0.6, 1.1), rng.uniform(0.6, 1.4)
    rows, columns = 9, 13
    u, v = np.meshgrid(np.linspace(-1, 1, columns), np.linspace(-1, 1, rows))
    height = top * (1 - np.maximum(np.abs(u), np.abs(v)) ** 4) * (0.75 + 0.25 * rng.random((rows, columns)))
    height[[0, -1]] = height[:, [0, -1]] = BELOW_GROUND_M
    shape = np.stack([x * u, y * v, height], axis=-1)
    shape[1:-1, 1:-1, :2] += rng.normal(0, 0.03, (rows - 2, columns - 2, 2))
    return grid(shape, [[drawn_color(rng)] * (columns - 1)] * (rows - 1))


def swap_body(rng: np.random.Generator) -> Mesh:
    """Return a lorry's swap body without the lorry, on four supports."""
    x, y, low, top = rng.uniform(2.4, 3.7), 1.24, 1.15, 3.6
    color = drawn_color(rng)
    out = Solid()
    out.box(color, (-x, -y, low), (x, y, top))
    out.box(_DARK_COLOR, (-x, -0.5, low - 0.2), (x, 0.5, low), without="+z")
    for a in (-0.75 * x, 0.75 * x):
        for b in (-y + 0.05, y - 0.15):
            out.box(_DARK_COLOR, (a, b, BELOW_GROUND_M), (a + 0.1, b + 0.1, low), without="-z +z")
    picture = Solid()
    picture.add(logo(rng).placed((0.3, 0.5, 0.0), np.diag([1.2, 1.2, 1.0])))
    picture.add(letters(1.9 * x - 1.8, 0.5, rng), (1.7, 0.9, 0.0))
    out.add(picture.placed((x, y + LAYER_GAP_M, low), TOWARDS_ROAD))
    return out.mesh()


def trailer_frame(rng: np.random.Generator) -> Mesh:
    """Return the bare frame of a trailer on blocks, with its wheels in a pile."""
    x, y = rng.uniform(1.2, 2.2), 0.8
    out = Solid()
    for side in (-y, y - 0.1):
        out.box("zinc", (-x, side, 0.5), (x, side + 0.1, 0.62))
    for at in np.linspace(-x, x - 0.1, 4):
        out.box("zinc", (at, -y, 0.48), (at + 0.1, y, 0.6))
        out.box("timber", (at, -y, BELOW_GROUND_M), (at + 0.25, -y + 0.25, 0.5), without="-z")
        out.box("timber", (at, y - 0.25, BELOW_GROUND_M), (at + 0.25, y, 0.5), without="-z")
    return merged([out.mesh(), tyres(rng).moved((x + 0.9, 0.0, 0.0))])


def tyres(rng: np.random.Generator) -> Mesh:
    """Return one to three stacks of tyres."""
    profile = [(0.0, 0.18), (0.0, 0.30), (0.05, 0.33), (0.17, 0.33), (0.22, 0.30), (0.22, 0.18), (0.0, 0.18)]
    tyre = lathe(profile, ["tyre"] * 6, 14, "z")
    stacks = range(int(rng.integers(1, 4)))
    return merged(
        tyre.moved((0.72 * k + rng.normal(0, 0.02), rng.normal(0, 0.02), 0.22 * level - 0.05))
        for k in stacks
        for level in range(int(rng.integers(2, 7)))
    )


def transformer(rng: np.random.Generator) -> Mesh:
    """Return a metal hut with two doors, louvres and a warning sign."""
    x, y, top = rng.uniform(0.9, 1.7), rng.uniform(0.7, 1.1), rng.uniform(1.5, 2.3)
    color = drawn_color(rng, 0.5)
    out = Solid()
    out.box("concrete", (-x - 0.05, -y - 0.05, BELOW_GROUND_M), (x + 0.05, y + 0.05, 0.15), without="-z")
    out.box(color, (-x, -y, 0.15), (x, y, top), without="-z")
    out.box(color, (-x - 0.08, -y - 0.08, top), (x + 0.08, y + 0.08, top + 0.12))
    for low, high in ((0.35, 0.75), (top - 0.55, top - 0.2)):
        for z in np.arange(low, high, 0.09):
            for left in (-0.85 * x, 0.1 * x):
                out.box(_DARK_COLOR, (left, y, z), (left + 0.75 * x, y + 0.02, z + 0.05), without="-y")
    sign = ((-0.15, y + 0.03, 1.0), (-0.45, y + 0.03, 1.0), (-0.3, y + 0.03, 1.27))
    out.face("sign_yellow", *sign)
    return out.mesh()


def cabinets(rng: np.random.Generator) -> Mesh:
    """Return a row of cable cabinets."""
    return merged(cabinet().moved((1.4 * k, 0.0, 0.0)) for k in range(int(rng.integers(1, 4))))


def barriers(rng: np.random.Generator) -> Mesh:
    """Return road works beside the road: red and white boards on feet with yellow or red lamps."""
    out, count = Solid(), int(rng.integers(1, 5))
    lamp = str(rng.choice(["sign_yellow", "taillight", "#ff8800", "luminaire"]))
    for k in range(count):
        x = 2.0 * (k - count / 2)
        for stripe in range(8):
            color = "sign_red" if stripe % 2 else "sign_white"
            out.box(color, (x + 0.24 * stripe, -0.03, 0.75), (x + 0.24 * (stripe + 1), 0.03, 1.0))
        for at in (x + 0.2, x + 1.6):
            out.box("iron", (at, -0.03, BELOW_GROUND_M), (at + 0.06, 0.03, 0.75), without="-z")
            out.box("iron", (at - 0.1, -0.35, -0.1), (at + 0.16, 0.35, 0.1), without="-z")
        for at in (x + 0.1, x + 1.7):
            out.box(lamp, (at, -0.07, 1.0), (at + 0.16, 0.07, 1.2))
    return out.mesh()


def billboard(rng: np.random.Generator) -> Mesh:
    """Return a large poster on posts, printed on one side or both."""
    width, height, low = rng.uniform(2.2, 4.6), rng.uniform(1.6, 3.0), rng.uniform(0.5, 2.2)
    out = Solid()
    for x in (-0.38 * width, 0.38 * width):
        out.box("iron", (x - 0.07, -0.07, BELOW_GROUND_M), (x + 0.07, 0.07, low), without="-z")
    return _framed(out, width, height, low, rng)


def poster_stand(rng: np.random.Generator) -> Mesh:
    """Return a poster of a person's height between two posts."""
    out = Solid()
    for x in (-0.62, 0.55):
        out.box("frame_dark", (x, -0.06, BELOW_GROUND_M), (x + 0.07, 0.06, 2.35), without="-z")
    return _framed(out, 1.1, 1.7, 0.6, rng)


def _framed(out: Solid, width: float, height: float, low: float, rng: np.random.Generator) -> Mesh:
    """Add a frame with posters on its front and, in most cases, on its back."""
    out.box("frame_dark", (-width / 2 - 0.05, -0.09, low), (width / 2 + 0.05, 0.09, low + height + 0.1))
    out.add(poster(width, height, rng).placed((width / 2, 0.09 + LAYER_GAP_M, low + 0.05), TOWARDS_ROAD))
    if rng.random() < 0.6:
        back = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
        out.add(poster(width, height, rng).placed((-width / 2, -0.09 - LAYER_GAP_M, low + 0.05), back))
    return out.mesh()


def wall_panel(width: float, height: float, rng: np.random.Generator) -> Mesh:
    """Return a printed panel or a shop's sign on a wall that faces +y; the origin is the middle of its lower edge."""
    thick, out = rng.uniform(0.16, 0.24), Solid()
    out.box(drawn_color(rng), (-width / 2 - 0.04, 0.0, -0.04), (width / 2 + 0.04, thick, height + 0.04))
    if width < 2.2 * height:
        printed = poster(width, height, rng)
    else:
        printed = Solid()
        printed.pane(drawn_color(rng), (0.0, width), (0.0, height), 0.0)
        printed.add(logo(rng).placed((0.1, 0.1 * height, LAYER_GAP_M), np.diag([0.8 * height, 0.8 * height, 1.0])))
        printed.add(letters(width - 1.3 * height - 0.1, 0.55 * height, rng), (1.15 * height, 0.2 * height, LAYER_GAP_M))
    out.add(printed.placed((width / 2, thick + LAYER_GAP_M, 0.0), TOWARDS_ROAD))
    return out.mesh()


STANDING_OBJECTS: Final[Mapping[Callable[[np.random.Generator], Mesh], float]] = {
    billboard: 4.0,
    poster_stand: 2.5,
    shipping_container: 2.0,
    skip: 2.0,
    bins: 2.5,
    kiosk: 1.5,
    shelter: 1.0,
    crates: 1.5,
    covered_heap: 1.5,
    swap_body: 1.0,
    trailer_frame: 1.0,
    tyres: 1.0,
    transformer: 1.5,
    cabinets: 1.0,
    barriers: 2.5,
    arrow_trailer: 1.5,
    chevron_boards: 1.5,
    direction_sign: 1.5,
    site_fence: 1.0,
    posts: 1.0,
    ticket_machines: 1.0,
    phone_boxes: 1.0,
    garages: 1.5,
    concrete_barriers: 1.5,
    kerb_stones: 1.0,
    portable_toilets: 1.0,
    generator: 1.0,
    covered_boat: 1.0,
    covered_caravan: 0.7,
    market_stall: 1.0,
    bales: 1.0,
    recessed_wall: 1.0,
    gravestones: 0.7,
}
"""Objects on the ground, with their shares."""
