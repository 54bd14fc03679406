"""Objects beside roads that are lit at night and are not vehicles: lamps, works lamps, plants with lamps in them.

x along the road, y towards it, z up, metres. They extend below the ground, which may slope down under them.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Final

import numpy as np

from skope.gen.mesh import Mesh, box, lathe, merged, tube
from skope.gen.scenery.printed_pictures import LAYER_GAP_M, drawn_color, filled, filled_disc, letters
from skope.gen.scenery.quads import BELOW_GROUND_M, TOWARDS_ROAD, Solid
from skope.gen.scenery.roadside_boards import arrow_trailer, gore_boards, message_board, sign_gantry
from skope.gen.scenery.street_furniture import bus_shelter
from skope.gen.scenery.trees import bush


def _in_row(mesh: Mesh, count: int, gap: float) -> Mesh:
    """Return copies of an object along x, with their middle at the origin."""
    return merged(mesh.moved((gap * (k - (count - 1) / 2), 0.0, 0.0)) for k in range(count))


def _recolored(mesh: Mesh, names: Mapping[str, str]) -> Mesh:
    """Return the mesh with some of its materials replaced."""
    return replace(mesh, materials=tuple(names.get(name, name) for name in mesh.materials))


def _ball(center: tuple[float, float, float], radius: float, material: str) -> Mesh:
    turn = np.linspace(-np.pi / 2, np.pi / 2, 7)
    profile = np.column_stack([radius * np.sin(turn), (radius * np.cos(turn)).clip(0.0)])
    return lathe(profile, [material] * 6, 9, "z").moved(center)


def globe_lamps(rng: np.random.Generator) -> Mesh:
    """Return one to three posts, each with a cluster of two to five globes; pairs look like headlights."""
    globes, radius, high = int(rng.integers(2, 6)), float(rng.uniform(0.14, 0.28)), float(rng.uniform(2.6, 5.6))
    lamp = str(rng.choice(["lamp_white", "lamp_white", "lamp_warm"]))
    post = str(rng.choice(["iron", "zinc", "frame", "door_green"]))
    reach, turn = radius + float(rng.uniform(0.1, 0.45)), float(rng.choice([0.0, np.pi / 2, rng.uniform(0.0, np.pi)]))
    around = globes - globes % 2
    angles = turn + 2 * np.pi * np.arange(around) / around
    centers = [(reach * float(np.cos(a)), reach * float(np.sin(a)), high) for a in angles]
    if globes % 2:
        centers.append((0.0, 0.0, high + radius * float(rng.uniform(0.8, 2.4))))
    top = centers[-1][2] - radius if globes % 2 else high - radius
    parts = [
        lathe([(BELOW_GROUND_M, 0.16), (0.5, 0.14), (0.55, 0.07), (top, 0.05), (top + 0.03, 0.0)], [post] * 4, 8, "z")
    ]
    for x, y, z in centers:
        foot = z - radius + 0.02
        if x or y:
            parts.append(
                tube([(0.0, 0.0, foot - 0.2), (0.7 * x, 0.7 * y, foot - 0.12), (x, y, foot)], [0.03] * 3, post, 5)
            )
        parts.append(
            lathe([(-0.06, 0.0), (-0.05, 0.5 * radius), (0.06, 0.45 * radius)], [post] * 2, 8, "z").moved((x, y, foot))
        )
        parts.append(_ball((x, y, z), radius, lamp))
    return _in_row(merged(parts), int(rng.integers(1, 4)), float(rng.uniform(3.5, 4.0)))


def floodlights(rng: np.random.Generator) -> Mesh:
    """Return floodlights on a column, in pairs and rows, that face across the road."""
    columns, rows, high = int(rng.integers(2, 5)), int(rng.integers(1, 3)), float(rng.uniform(4.5, 9.5))
    gap, lamp = float(rng.uniform(0.5, 0.8)), str(rng.choice(["lamp_white", "lamp_white", "lamp_warm"]))
    half = gap * (columns - 1) / 2
    out = Solid()
    for row in range(rows):
        z = high - 0.55 * row
        out.box("zinc", (-half - 0.1, -0.05, z - 0.05), (half + 0.1, 0.05, z + 0.05))
        for k in range(columns):
            x = gap * k - half
            out.box("pole", (x - 0.2, 0.05, z - 0.16), (x + 0.2, 0.22, z + 0.16))
            out.box(lamp, (x - 0.17, 0.22, z - 0.13), (x + 0.17, 0.24, z + 0.13), without="-y")
    column = lathe([(BELOW_GROUND_M, 0.14), (high, 0.07), (high + 0.02, 0.0)], ["zinc"] * 2, 8, "z")
    return merged([column, out.mesh()])


def low_lamp(rng: np.random.Generator) -> Mesh:
    """Return a street light that is low enough to cast a bright patch on the road; it counts as a street light."""
    high = float(rng.uniform(3.4, 5.4))
    reach = float(rng.uniform(2.0, 6.0)) if high > 4.6 else 0.3
    pole = lathe([(BELOW_GROUND_M, 0.09), (high, 0.06), (high + 0.02, 0.0)], ["pole"] * 2, 7, "z")
    arm = tube([(0.0, 0.0, high - 0.05), (0.0, reach, high + 0.1)], [0.04] * 2, "pole", 5)
    head = box((-0.13, reach - 0.1, high + 0.06), (0.13, reach + 0.5, high + 0.18), "pole")
    return merged([pole, arm, head, box((-0.1, reach, high + 0.04), (0.1, reach + 0.45, high + 0.07), "luminaire")])


def works_lamps(rng: np.random.Generator) -> Mesh:
    """Return beacons of road works on boards or posts, amber or red; some flashing beacons are dark in an image."""
    count, gap = int(rng.integers(2, 6)), float(rng.uniform(1.3, 1.8))
    lamp, pale = ("lamp_red", "#992222") if rng.random() < 0.35 else ("lamp_amber", "#cc8822")
    boarded, flashing, high = rng.random() < 0.5, rng.random() < 0.6, float(rng.uniform(0.9, 1.25))
    out = Solid()
    for k in range(count):
        x = gap * (k - (count - 1) / 2)
        out.box("tyre", (x - 0.2, -0.3, BELOW_GROUND_M), (x + 0.2, 0.3, 0.1), without="-z")
        out.box("iron", (x - 0.03, -0.03, 0.1), (x + 0.03, 0.03, high), without="-z")
        if boarded:
            for stripe in range(4):
                color, low = ("sign_red", "sign_white")[stripe % 2], high - 0.15 * (stripe + 1)
                out.box(color, (x - 0.14, 0.03, low), (x + 0.14, 0.05, low + 0.15))
        out.box("sign_yellow", (x - 0.09, -0.06, high), (x + 0.09, 0.06, high + 0.12))
        lit = not flashing or rng.random() < 0.6
        out.box(lamp if lit else pale, (x - 0.1, -0.05, high + 0.12), (x + 0.1, 0.05, high + 0.32))
    return out.mesh()


def lit_arrow_trailer(rng: np.random.Generator) -> Mesh:
    """Return a trailer of road works with a lit arrow or lit beacons."""
    lamp = str(rng.choice(["lamp_amber", "lamp_amber", "lamp_white"]))
    return _recolored(arrow_trailer(rng), {"#ff9911": lamp, "luminaire": lamp})


def lit_plants(rng: np.random.Generator) -> Mesh:
    """Return a row of bushes, or a small tree, lit by lamps at their feet or in their crowns."""
    lamp = str(rng.choice(["lamp_white", "lamp_white", "lamp_warm"]))
    parts = []
    if rng.random() < 0.5:
        count, radius = int(rng.integers(1, 5)), float(rng.uniform(0.5, 1.1))
        for k in range(count):
            x = 1.7 * radius * (k - (count - 1) / 2)
            plant = bush(radius * float(rng.uniform(0.8, 1.2)), rng)
            parts.append(_recolored(plant, {"leaves": "leaves_lit"}).moved((x, 0.0, 0.0)))
            parts.append(box((x - 0.09, 1.2 * radius, BELOW_GROUND_M), (x + 0.09, 1.2 * radius + 0.14, 0.12), "iron"))
            parts.append(box((x - 0.07, 1.2 * radius + 0.02, 0.12), (x + 0.07, 1.2 * radius + 0.12, 0.14), lamp))
        return merged(parts)
    bare, reach = float(rng.uniform(1.6, 2.6)), float(rng.uniform(1.0, 1.8))
    top = bare + 1.2 * reach
    parts.append(lathe([(BELOW_GROUND_M, 0.14), (0.3, 0.1), (top, 0.05)], ["bark"] * 2, 6, "z"))
    inside = int(rng.integers(5))
    for k, turn in enumerate(rng.uniform(0.0, 2 * np.pi) + 2 * np.pi * np.arange(5) / 5):
        position = (0.55 * reach * np.cos(turn), 0.55 * reach * np.sin(turn), bare + rng.uniform(0.1, 0.7) * reach)
        # Light from one lamp reaches only the next clumps.
        lit = rng.random() < 0.85 if k in (inside, (inside + 1) % 5) else rng.random() < 0.4
        leaves = bush(0.75 * reach, rng)
        parts.append((_recolored(leaves, {"leaves": "leaves_lit"}) if lit else leaves).moved(position))
    glow = (0.9 * reach * float(np.cos(inside)), 0.9 * reach * float(np.sin(inside)), bare + 0.2 * reach)
    parts += [_ball(glow, 0.12, lamp), tube([(0.0, 0.0, glow[2] - 0.2), glow], [0.02] * 2, "iron", 4)]
    return merged(parts)


def lit_shelter(_: np.random.Generator) -> Mesh:
    """Return a bus shelter with a lamp under its roof and a backlit poster."""
    lit = _recolored(bus_shelter(), {"sign_yellow": "lit_white", "balustrade": "lit_dim"})
    return merged([lit, box((-1.7, -0.1, 2.24), (1.7, 0.05, 2.3), "lamp_white")])


def shop_sign(rng: np.random.Generator) -> Mesh:
    """Return an internally lit box on posts, with words and prices, as at shops and filling stations."""
    width, rows = float(rng.uniform(0.9, 2.6)), int(rng.integers(1, 5))
    row, low = float(rng.uniform(0.5, 0.9)), float(rng.uniform(0.2, 2.6))
    high = low + rows * row
    ground = str(rng.choice(["lit_white", "lit_warm", "lit_red", "lit_blue", "lit_green"]))
    ink = "lit_white" if ground in ("lit_red", "lit_blue", "lit_green") else drawn_color(rng)
    out, face = Solid(), Solid()
    for x in (-0.35 * width, 0.35 * width):
        out.box("frame_dark", (x - 0.06, -0.06, BELOW_GROUND_M), (x + 0.06, 0.06, low), without="-z")
    out.box("frame_dark", (-width / 2 - 0.04, -0.14, low - 0.04), (width / 2 + 0.04, 0.14, high + 0.04))
    for k in range(rows):
        backing = ground if rng.random() < 0.7 else str(rng.choice(["lit_white", "lit_warm", "fascia_black"]))
        text = ink if backing == ground else "lit_red" if backing == "fascia_black" else "#223344"
        face.pane(backing, (-width / 2, width / 2), (k * row + 0.03, (k + 1) * row - 0.03), LAYER_GAP_M)
        word = letters(width * float(rng.uniform(0.5, 0.85)), 0.5 * row, rng, text)
        face.add(word, (-0.42 * width, (k + 0.25) * row, 2 * LAYER_GAP_M))
    back = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    for y, axes in ((0.14, TOWARDS_ROAD), (-0.14, back)):
        out.add(face.placed((0.0, y, low), axes))
    return out.mesh()


def lit_panel(panel: Mesh, rng: np.random.Generator) -> Mesh:
    """Return a wall panel (see `wall_panel`) as an internally lit sign: its background is lit, its print is not."""
    lit = str(rng.choice(["lit_white", "lit_white", "lit_warm", "lit_red", "lit_green", "lit_blue"]))
    _frame, *printed = panel.materials
    return _recolored(panel, dict.fromkeys(printed[:1], lit))


def cones(rng: np.random.Generator) -> Mesh:
    """Return a row of cones or drums with retroreflective bands."""
    count, body = int(rng.integers(3, 7)), str(rng.choice(["#ff5511", "#ff5511", "#ee4411", "sign_red"]))
    band = str(rng.choice(["lit_dim", "sign_white"]))
    if rng.random() < 0.6:
        high, foot = float(rng.uniform(0.5, 1.05)), float(rng.uniform(0.14, 0.2))
        shares = np.array([0.0, 0.35, 0.52, 0.62, 0.8, 1.0])
        profile = [(0.04 + high * share, foot * (1 - share) + 0.025) for share in shares]
        base = box((-1.2 * foot, -1.2 * foot, BELOW_GROUND_M), (1.2 * foot, 1.2 * foot, 0.05), body)
        materials = [body, band, body, band, body, body]
    else:
        high, foot = float(rng.uniform(0.9, 1.1)), 0.28
        shares = np.array([0.0, 0.2, 0.38, 0.56, 0.74, 1.0])
        profile = [(0.04 + high * share, foot - 0.05 * share) for share in shares]
        base = lathe([(BELOW_GROUND_M, 0.36), (0.05, 0.36), (0.06, 0.2)], ["tyre"] * 2, 10, "z")
        materials = [body, band, body, band, body, body]
    cone = merged([base, lathe([*profile, (profile[-1][0] + 0.01, 0.0)], materials, 10, "z")])
    return _in_row(cone, count, float(rng.uniform(1.0, 1.4)))


def reflector_posts(rng: np.random.Generator) -> Mesh:
    """Return marker posts in pairs with reflectors at the spacing of a car's lamps."""
    reflector = str(rng.choice(["lit_white", "lit_amber", "lit_red", "lamp_white", "lamp_amber"]))
    body, high = str(rng.choice(["frame", "iron", "sign_yellow", "#ff6611"])), float(rng.uniform(0.7, 1.1))
    apart, are_round = float(rng.uniform(0.9, 1.7)), rng.random() < 0.5
    out, front = Solid(), Solid()
    if are_round:
        filled(front, reflector, filled_disc(0.0, high - 0.16, 0.05), LAYER_GAP_M)
    else:
        front.pane(reflector, (-0.04, 0.04), (high - 0.26, high - 0.1), LAYER_GAP_M)
    back = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0))
    for x in (-apart / 2, apart / 2):
        out.box(body, (x - 0.06, -0.05, BELOW_GROUND_M), (x + 0.06, 0.05, high), without="-z")
        for y, axes in ((0.05, TOWARDS_ROAD), (-0.05, back)):
            out.add(front.placed((x, y, 0.0), axes))
    return _in_row(out.mesh(), int(rng.integers(1, 3)), float(rng.uniform(2.5, 4.0)))


MakeLit = Callable[[np.random.Generator], Mesh]
LIT_OBJECTS: Final[Mapping[MakeLit, float]] = {
    globe_lamps: 4.0,
    floodlights: 2.5,
    low_lamp: 2.5,
    works_lamps: 2.0,
    lit_arrow_trailer: 0.7,
    lit_plants: 2.5,
    lit_shelter: 1.0,
    shop_sign: 1.5,
    cones: 1.5,
    reflector_posts: 1.5,
    message_board: 2.0,
    sign_gantry: 2.0,
    gore_boards: 2.0,
}
"""Objects that are lit at night, with their shares."""
FACING_ROAD: Final = (
    "globe_lamps",
    "low_lamp",
    "sign_gantry",
    "cones",
    "reflector_posts",
    "works_lamps",
    "lit_shelter",
)
"""Names of the objects that are placed along the road, with their y axis towards it."""
