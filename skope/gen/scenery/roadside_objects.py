"""Objects of a vehicle's size beside roads: covered, behind shutters, stacked, or set up for a day.

x along the road, y towards it, z up, metres. They extend below the ground, which may slope down under them.
"""

import itertools
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, lathe, merged
from skope.gen.scenery.printed_pictures import LAYER_GAP_M, drawn_color, letters
from skope.gen.scenery.quads import BELOW_GROUND_M, TOWARDS_ROAD, Solid
from skope.types import Array

JERSEY_PROFILE: Final = ((0.3, BELOW_GROUND_M), (0.3, 0.08), (0.13, 0.33), (0.08, 0.81))
"""Half widths and heights of a concrete barrier."""
WALL_MATERIALS: Final = ("brick", "brick_buff", "plaster_white", "plaster_grey", "concrete", "stone")
_DARK_COLOR: Final = "#222222"


def garages(rng: np.random.Generator) -> Mesh:
    """Return one or two garages or lock-up shops with ribbed shutters, some with large letters, and a flat roof."""
    count, half, depth, top = int(rng.integers(1, 3)), rng.uniform(1.3, 1.6), 2.4, rng.uniform(2.4, 2.9)
    wall, door = str(rng.choice(WALL_MATERIALS)), drawn_color(rng)
    high, rib = top - rng.uniform(0.25, 0.5), float(rng.choice([0.12, 0.25, 0.5]))
    out = Solid()
    x = count * half
    out.box(wall, (-x, -depth, BELOW_GROUND_M), (x, depth - 0.2, top), without="-z")
    out.box(_DARK_COLOR, (-x - 0.06, -depth - 0.06, top), (x + 0.06, depth + 0.08, top + 0.14))
    lettered = rng.random() < 0.6
    for k in range(count + 1):
        left = -x + 2 * half * k - 0.15
        out.box(
            wall, (max(left, -x), depth - 0.2, BELOW_GROUND_M), (min(left + 0.3, x), depth, top), without="-z +z -y"
        )
    for k in range(count):
        middle = -x + half * (2 * k + 1)
        left, reach = middle - half + 0.15, 2 * half - 0.3
        out.box(wall, (left, depth - 0.2, high), (left + reach, depth, top), without="+z -y -x +x")
        gaps = Solid()
        gaps.pane(_DARK_COLOR, (-reach / 2, reach / 2), (BELOW_GROUND_M, high), LAYER_GAP_M)
        out.add(gaps.placed((middle, depth - 0.2, 0.0), TOWARDS_ROAD))
        for z in np.arange(0.02, high - 0.02, rib):
            end = min(z + rib - min(0.15 * rib, 0.025), high)
            out.box(door, (left, depth - 0.2, z), (left + reach, depth - 0.16, end), without="-y -x +x")
        if lettered:
            word, tall = letters(0.85 * reach, rng.uniform(0.35, 0.7), rng), rng.uniform(0.8, 1.3)
            out.add(word.placed((middle + 0.42 * reach, depth - 0.16 + LAYER_GAP_M, tall), TOWARDS_ROAD))
        else:
            out.box(_DARK_COLOR, (middle - 0.08, depth - 0.16, 0.9), (middle + 0.08, depth - 0.12, 0.95), without="-y")
    return out.mesh()


def concrete_barriers(rng: np.random.Generator) -> Mesh:
    """Return concrete barriers end to end with reflectors or lamps on them, or stored in a stack."""
    length, color = rng.uniform(1.9, 2.8), str(rng.choice(["concrete", "concrete", "sign_white", "sign_red"]))
    out = Solid()
    if rng.random() < 0.65:
        count = int(rng.integers(1, 4))
        lamp = str(rng.choice(["sign_yellow", "sign_red", "luminaire"]))
        for k in range(count):
            x = length * (k - count / 2)
            tint = ("sign_white" if k % 2 else "sign_red") if color == "sign_red" else color
            out.extrude(tint, JERSEY_PROFILE, (x + 0.02, x + length - 0.02))
            for at in (x + 0.25 * length, x + 0.75 * length):
                out.box(lamp, (at - 0.06, -0.04, 0.81), (at + 0.06, 0.04, 0.95), without="-z")
        return out.mesh()
    for level, count in enumerate(range(int(rng.integers(2, 4)), 0, -1)):
        foot = 0.83 * level
        for k in range(count):
            barrier, y = Solid(), 0.64 * (k - (count - 1) / 2)
            low = BELOW_GROUND_M if level == 0 else 0.0
            barrier.extrude(color, [(0.3, low), *JERSEY_PROFILE[1:]], (-length / 2, length / 2))
            if level:
                for at in (-0.3 * length, 0.25 * length):
                    barrier.box("timber", (at, -0.34, -0.02), (at + 0.1, 0.34, 0.01))
                end = length / 2
                barrier.face(color, (-end, 0.3, 0.0), (end, 0.3, 0.0), (end, -0.3, 0.0), (-end, -0.3, 0.0))
            out.add(barrier, (0.0, y, foot))
    return out.mesh()


def kerb_stones(rng: np.random.Generator) -> Mesh:
    """Return one to three pallets of kerb stones or bricks bound by straps."""
    out = Solid()
    for k in range(int(rng.integers(1, 4))):
        x, color = 1.35 * k - 1.35, str(rng.choice(["concrete", "kerb", "sandstone", "brick"]))
        out.box("timber", (x, -0.5, BELOW_GROUND_M), (x + 1.1, 0.5, 0.13), without="-z")
        rows, columns = int(rng.integers(2, 6)), int(rng.integers(3, 7))
        wide, high = 1.1 / columns, rng.uniform(0.15, 0.25)
        for level in range(rows):
            for column in range(columns):
                y0, z = rng.normal(0.0, 0.012), 0.13 + high * level
                left = x + wide * column
                out.box(color, (left + 0.008, -0.48 + y0, z), (left + wide - 0.008, 0.48 + y0, z + high - 0.012))
        top = 0.13 + rows * high
        for at in (x + 0.25, x + 0.8):
            out.box(_DARK_COLOR, (at, -0.54, 0.13), (at + 0.04, 0.54, top + 0.01), without="-z")
    return out.mesh()


def portable_toilets(rng: np.random.Generator) -> Mesh:
    """Return one to four portable toilets in a row: ribbed plastic, a door with a white sign, a pale roof."""
    color, roof = drawn_color(rng), str(rng.choice(["sign_white", "#cccccc", "#dddddd"]))
    half, top = 0.55, 2.1
    cabin = Solid()
    cabin.box(_DARK_COLOR, (-half, -half, BELOW_GROUND_M), (half, half, 0.12), without="-z")
    cabin.box(color, (-half + 0.03, -half + 0.03, 0.12), (half - 0.03, half - 0.03, top), without="-z")
    for side in (-half, half - 0.03):
        for y in (-0.4, -0.12, 0.16):
            cabin.box(color, (side, y, 0.3), (side + 0.03, y + 0.16, 1.7))
    cabin.extrude(
        roof, [(half, top), (half, top + 0.06), (0.6 * half, top + 0.2), (0.3 * half, top + 0.24)], (-half, half)
    )
    cabin.box(_DARK_COLOR, (0.38, -0.5, top + 0.1), (0.48, -0.4, top + 0.5), without="-z")
    front = Solid()
    front.pane(drawn_color(rng) if rng.random() < 0.4 else color, (-0.42, 0.42), (0.2, 1.98), 0.02)
    front.pane("sign_white", (-0.16, 0.16), (1.4, 1.7), 0.02 + LAYER_GAP_M)
    front.pane("sign_red", (0.28, 0.36), (1.0, 1.06), 0.02 + LAYER_GAP_M)
    front.pane(_DARK_COLOR, (-0.38, 0.38), (1.84, 1.92), 0.02 + LAYER_GAP_M)
    cabin.add(front.placed((0.0, half - 0.03, 0.0), TOWARDS_ROAD))
    count = int(rng.integers(1, 5))
    mesh = cabin.mesh()
    return merged(mesh.moved((1.2 * (k - (count - 1) / 2), 0.0, 0.0), rng.normal(0, 0.03)) for k in range(count))


def generator(rng: np.random.Generator) -> Mesh:
    """Return a generator or compressor in a case on skids, with louvres, a panel, an exhaust and a lamp."""
    x, y, top = rng.uniform(0.9, 1.9), rng.uniform(0.45, 0.75), rng.uniform(1.1, 1.8)
    color = drawn_color(rng)
    out = Solid()
    for side in (-1, 1):
        out.box(
            "iron",
            (-x - 0.1, side * 0.8 * y - 0.08, BELOW_GROUND_M),
            (x + 0.1, side * 0.8 * y + 0.08, 0.16),
            without="-z",
        )
    out.box(_DARK_COLOR, (-x, -y, 0.16), (x, y, 0.3))
    out.extrude(color, [(y, 0.3), (y, top - 0.2), (0.75 * y, top)], (-x, x))
    front = Solid()
    for z in np.arange(0.45, top - 0.4, 0.08):
        front.pane(_DARK_COLOR, (-0.9 * x, -0.45 * x), (z, z + 0.05), LAYER_GAP_M)
        front.pane(_DARK_COLOR, (0.45 * x, 0.9 * x), (z, z + 0.05), LAYER_GAP_M)
    front.pane(
        "sign_yellow" if rng.random() < 0.5 else "zinc", (-0.3 * x, 0.3 * x), (0.65 * top, 0.8 * top), LAYER_GAP_M
    )
    front.add(letters(0.7 * x, 0.16, rng), (-0.35 * x, 0.4, LAYER_GAP_M))
    out.add(front.placed((0.0, y, 0.0), TOWARDS_ROAD))
    back = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    out.add(front.placed((0.0, -y, 0.0), back))
    grille = Solid()
    grille.pane("grille", (-0.7 * y, 0.7 * y), (0.45, top - 0.35), LAYER_GAP_M)
    out.add(grille.placed((x, 0.0, 0.0), ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0), (1.0, 0.0, 0.0))))
    exhaust = lathe([(top - 0.05, 0.05), (top + 0.3, 0.05), (top + 0.31, 0.0)], ["iron"] * 2, 8, "z")
    return merged([out.mesh(), exhaust.moved((-0.7 * x, 0.0, 0.0))])


def covered_boat(rng: np.random.Generator) -> Mesh:
    """Return a boat on blocks and props under a cover with a ridge; its hull is visible below."""
    x, y, top = rng.uniform(1.8, 3.0), rng.uniform(0.75, 1.1), rng.uniform(1.5, 2.1)
    keel, gunwale = 0.45, 0.55 * top
    along = np.concatenate([np.linspace(-1, 0.4, 10), [0.55, 0.68, 0.79, 0.88, 0.95, 1.0]])
    beam = y * np.minimum(1.0, 1.25 * np.sqrt(1.0005 - along))
    sheer = gunwale + 0.18 * np.clip(along, 0, None) ** 2
    rocker = keel + 0.7 * (sheer - keel) * np.clip(along, 0, None) ** 4
    ridge = sheer + (top - gunwale) * (1 - 0.6 * np.abs(along) ** 2.5) + rng.normal(0, 0.012, len(along))
    ring = [(1.0, sheer), (0.75, rocker + 0.3 * (sheer - rocker)), (0.0, rocker)]
    cloth = [(1.04, sheer - 0.15), (1.04, sheer), (0.5, sheer + 0.6 * (ridge - sheer)), (0.0, ridge)]
    hull = [*ring, *((-share, z) for share, z in ring[-2::-1])]
    cover = [*((-share, z) for share, z in cloth), *cloth[-2::-1]]
    out = Solid()
    for color, section, long in ((drawn_color(rng), hull, x), (drawn_color(rng), cover, x + 0.04)):
        _tube(out, color, np.array([np.column_stack([long * along, share * beam, z]) for share, z in section]))
    for at in (-0.6 * x, 0.3 * x):
        out.box("timber", (at, -0.2, BELOW_GROUND_M), (at + 0.25, 0.2, keel + 0.04), without="-z")
        for side in (-0.6 * y, 0.6 * y):
            out.box(
                "iron", (at, side - 0.04, BELOW_GROUND_M), (at + 0.08, side + 0.04, keel + 0.3 * (gunwale - keel)), "-z"
            )
    return out.mesh()


def _tube(out: Solid, color: str, points: Array) -> None:
    """Add a closed faceted tube around rings, which are the columns of a grid of points (R, C, 3)."""
    around = np.concatenate([points, points[:1]])
    a, b, c, d = around[:-1, :-1], around[:-1, 1:], around[1:, 1:], around[1:, :-1]
    out.faces(color, np.stack([a, b, c, d], axis=2).reshape(-1, 4, 3))
    for first, *ring in (points[:, 0], points[::-1, -1]):
        for second, third in itertools.pairwise(ring):
            out.face(color, first, second, third)


def covered_caravan(rng: np.random.Generator) -> Mesh:
    """Return a caravan under a strapped cover: a rounded box of cloth with visible wheels and drawbar."""
    x, y, top = rng.uniform(1.9, 2.9), rng.uniform(1.0, 1.12), rng.uniform(2.3, 2.6)
    low, color = (
        rng.uniform(0.3, 0.6),
        str(rng.choice(["#999999", "#bbbbaa", "#556655", "#445577", drawn_color(rng, 0.4)])),
    )
    profile = [(0.0, low), (0.98 * y, low), (y, 0.5 * top), (0.97 * y, top - 0.25), (0.8 * y, top - 0.06), (0.0, top)]
    out = Solid()
    out.extrude(color, profile, (-x, x))
    for side in (-1, 1):  # slanting ends
        inner, tip = [(0.8 * share, z) for share, z in profile], side * (x + rng.uniform(0.15, 0.4))
        for (y0, z0), (y1, z1), (v0, _), (v1, _) in zip(profile, profile[1:], inner, inner[1:], strict=False):
            for flip in (-1, 1):
                corners = [
                    (side * x, flip * y0, z0),
                    (tip, flip * v0, z0),
                    (tip, flip * v1, z1),
                    (side * x, flip * y1, z1),
                ]
                out.face(color, *(corners if side * flip < 0 else corners[::-1]))
            if z1 > z0:
                corners = [(tip, -v0, z0), (tip, v0, z0), (tip, v1, z1), (tip, -v1, z1)]
                out.face(color, *(corners if side > 0 else [corners[k] for k in (1, 0, 3, 2)]))
    for at in np.linspace(-0.7 * x, 0.7 * x, int(rng.integers(2, 4))):
        out.extrude(
            _DARK_COLOR,
            [(half + 0.012 if half else 0.0, z + 0.012 * (half == 0)) for half, z in profile],
            (at, at + 0.05),
        )
    out.box(_DARK_COLOR, (-0.8 * x, -0.7 * y, 0.3), (0.8 * x, 0.7 * y, low + 0.02), without="+z")
    out.box("zinc", (x, -0.06, 0.38), (x + 1.1, 0.06, 0.48))
    out.box("zinc", (x + 0.9, -0.04, BELOW_GROUND_M), (x + 0.98, 0.04, 0.38), without="-z +z")
    wheel = lathe([(-0.1, 0.0), (-0.1, 0.3), (0.1, 0.3), (0.1, 0.0)], ["rim", "tyre", "rim"], 14, "y")
    return merged([out.mesh(), *(wheel.moved((0.0, side * (y - 0.16), 0.3)) for side in (-1, 1))])


def market_stall(rng: np.random.Generator) -> Mesh:
    """Return a market stall: a striped roof on poles, a valance, a counter with cloth, boxes and goods."""
    x, y, eaves = rng.uniform(1.2, 2.2), rng.uniform(0.9, 1.2), rng.uniform(2.0, 2.3)
    ridge = eaves + rng.uniform(0.35, 0.7)
    colors = (drawn_color(rng), "sign_white" if rng.random() < 0.6 else drawn_color(rng))
    out = Solid()
    for a in (-x + 0.05, x - 0.1):
        for b in (-y + 0.05, y - 0.1):
            out.box("zinc", (a, b, BELOW_GROUND_M), (a + 0.05, b + 0.05, eaves), without="-z +z")
    edges = np.linspace(-x - 0.1, x + 0.1, 2 * int(rng.integers(3, 6)))
    for k, (left, right) in enumerate(itertools.pairwise(edges)):
        profile = [(0.0, eaves - 0.2), (y + 0.12, eaves - 0.2), (y + 0.12, eaves), (0.0, ridge)]
        out.extrude(colors[k % 2], profile, (left, right))
    cloth = drawn_color(rng)
    out.box(cloth, (-x + 0.15, 0.1, BELOW_GROUND_M), (x - 0.15, y - 0.15, 0.85), without="-z")
    for left in np.arange(-x + 0.2, x - 0.6, 0.45):
        if rng.random() < 0.8:
            goods = drawn_color(rng)
            out.box(goods, (left, 0.2, 0.85), (left + 0.38, y - 0.25, 0.85 + rng.uniform(0.08, 0.3)), without="-z")
    if rng.random() < 0.5:  # a cloth wall at the rear, with a name
        out.box(cloth, (-x + 0.05, -y + 0.06, 0.1), (x - 0.05, -y + 0.09, eaves - 0.2))
        word = letters(1.4 * x, 0.3, rng)
        out.add(word.placed((0.7 * x, -y + 0.09 + LAYER_GAP_M, 1.4), TOWARDS_ROAD))
    return out.mesh()


def bales(rng: np.random.Generator) -> Mesh:
    """Return round bales of hay, or of silage in film, in one or two rows, or stacked square bales."""
    color = str(rng.choice(["#ccaa66", "#bb9955", "sign_white", "#222222", "#88aa88", "#ddaacc"]))
    if rng.random() < 0.3:
        out, color = Solid(), str(rng.choice(["#ccaa66", "#bb9955", "sign_white", "#222222"]))
        for level in range(int(rng.integers(1, 4))):
            for k in range(int(rng.integers(1, 4))):
                a, z = 2.3 * (k - 1) + rng.normal(0, 0.04), 0.8 * level
                low = BELOW_GROUND_M if level == 0 else z
                out.box(color, (a, -0.55, low), (a + 2.2, 0.55 + rng.normal(0, 0.03), z + 0.78), without="-z")
        return out.mesh()
    radius, half = rng.uniform(0.6, 0.8), 0.6
    end = "#aa8844" if color in ("#ccaa66", "#bb9955") else color
    profile = [
        (-half, 0.0),
        (-half, radius - 0.06),
        (-half + 0.06, radius),
        (half - 0.06, radius),
        (half, radius - 0.06),
        (half, 0.0),
    ]
    bale = lathe(profile, [end, color, color, color, end], 18, "y")
    count, sunk = int(rng.integers(1, 5)), radius - 0.06
    out_parts = [bale.moved((2.0 * radius * (k - (count - 1) / 2), rng.normal(0, 0.05), sunk)) for k in range(count)]
    if count > 1 and rng.random() < 0.5:
        lift = sunk + np.sqrt(3.0) * radius
        out_parts += [bale.moved((2.0 * radius * (k + 0.5 - (count - 1) / 2), 0.0, lift)) for k in range(count - 1)]
    return merged(out_parts)


def recessed_wall(rng: np.random.Generator) -> Mesh:
    """Return a wall of a yard, vault or graveyard, with niches as deep as windows or iron doors, under a coping."""
    count, pitch, top = int(rng.integers(2, 5)), rng.uniform(1.0, 1.7), rng.uniform(1.3, 2.4)
    wall = str(rng.choice(WALL_MATERIALS))
    inside = str(rng.choice([wall, "frame_dark", "door_green", "iron", "window"]))
    x, low, high = count * pitch / 2, rng.uniform(0.3, 0.7), top - rng.uniform(0.2, 0.4)
    out, front = Solid(), Solid()
    out.box(wall, (-x, -0.15, BELOW_GROUND_M), (x, 0.15, top), without="-z +y")
    out.box("dressing", (-x - 0.05, -0.2, top), (x + 0.05, 0.2, top + 0.1))
    front.pane(wall, (-x, x), (BELOW_GROUND_M, low), 0.0)
    front.pane(wall, (-x, x), (high, top), 0.0)
    margin = 0.16 * pitch
    for k in range(count):
        left = -x + k * pitch
        front.pane(wall, (left, left + margin), (low, high), 0.0)
        front.pane(wall, (left + pitch - margin, left + pitch), (low, high), 0.0)
        niche = (left + margin, left + pitch - margin)
        front.recess(wall, niche, (low, high), (-0.12, 0.0))
        front.pane(inside, niche, (low, high), -0.12)
    out.add(front.placed((0.0, 0.15, 0.0), TOWARDS_ROAD))
    return out.mesh()


def gravestones(rng: np.random.Generator) -> Mesh:
    """Return a row of gravestones: polished or rough slabs with round or straight tops, lettering and plinths."""
    out = Solid()
    count = int(rng.integers(2, 6))
    for k in range(count):
        x, half, top = 1.15 * (k - (count - 1) / 2), rng.uniform(0.25, 0.45), rng.uniform(0.6, 1.3)
        stone = str(rng.choice(["#222222", "#444444", "stone", "sandstone", "concrete", "#775555", "dressing"]))
        slab = Solid()
        slab.box("dressing", (-half - 0.08, -0.16, BELOW_GROUND_M), (half + 0.08, 0.16, 0.14), without="-z")
        arch = np.linspace(0, np.pi / 2, 5) if rng.random() < 0.5 else np.zeros(1)
        rise = 0.7 * half * np.sin(arch)
        profile = [(half, 0.14), *zip(half * np.cos(arch), top - 0.7 * half + rise, strict=True)]
        profile[-1] = (max(profile[-1][0], 0.02), profile[-1][1])
        side = Solid()
        side.extrude(stone, profile, (-0.07, 0.07))
        slab.add(side.placed((0.0, 0.0, 0.0), ((0.0, 1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, 1.0))))
        for y in (0.42, 0.56):
            word = letters(1.5 * half, 0.07, rng, str(rng.choice(["lettering_gold", "lettering", "lettering_dark"])))
            slab.add(word.placed((0.75 * half, 0.07 + LAYER_GAP_M, y * top), TOWARDS_ROAD))
        out.add(slab, (x, rng.normal(0, 0.04), 0.0))
    return out.mesh()
