"""Scenery grown from a SUMO network, the same for the same network: roads, houses, trees, street furniture, signals."""

import zlib
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from shapely.ops import unary_union

from skope.gen.mesh import Mesh, box, lathe, merged
from skope.gen.towns.furniture import furniture
from skope.gen.towns.gardens import gardens
from skope.gen.towns.ground import Beside, ground_meshes, ground_parts
from skope.gen.towns.houses import covered, forecourts, house_meshes, paths, plots
from skope.gen.towns.layout import KERB_HEIGHT, Layout, right_of
from skope.gen.towns.trees import hills, plant, tree_meshes

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Signal:
    """A traffic light's head; it shows the state of one link of a junction's program."""

    program: str
    link: int
    lamps: Array
    """(3, 3) world positions of red, yellow and green lamp."""
    facing: Array
    """(3,) the direction into which they shine."""


@dataclass(frozen=True, eq=False)
class Scenery:
    mesh: Mesh
    signals: tuple[Signal, ...]


@cache
def scenery(town: str) -> Scenery:
    """Everything of a town that does not move."""
    layout = Layout.of(town)
    # A generator of its own for each part, so that a change of one leaves the others as they are.
    rng = dict(zip(_PARTS, np.random.default_rng(zlib.crc32(town.encode())).spawn(len(_PARTS)), strict=True))
    houses = plots(layout, rng["plots"])
    built = covered(houses)
    walks, drives = paths(houses)
    trees = plant(layout, unary_union([built, drives]), rng["trees"])
    signals, poles = _signals(layout.net)
    pits = unary_union([tree.pit for tree in trees if tree.street])
    beside_road = Beside(forecourts(layout, houses), walks, drives, built.buffer(0.35, join_style="mitre"), pits)
    meshes = [
        *ground_meshes(layout, ground_parts(layout, beside_road, rng["ground"])),
        *house_meshes(houses, rng["houses"]),
        *gardens(layout, houses, rng["gardens"]),
        *tree_meshes(trees, rng["crowns"]),
        *furniture(layout, unary_union([built, drives, pits]), rng["furniture"]),
        hills(layout, rng["hills"]),
        *poles,
    ]
    return Scenery(merged(meshes), signals)


_PARTS = ("plots", "houses", "trees", "crowns", "ground", "gardens", "furniture", "hills")


def _signals(net: Any) -> tuple[tuple[Signal, ...], list[Mesh]]:
    """One pole with a head for every edge that leads to a signalled junction, at its stop line."""
    signals, poles = [], []
    for program in net.getTrafficLights():
        links = {lane.getEdge().getID(): (lane.getEdge(), link) for lane, _, link in reversed(program.getConnections())}
        for edge, link in links.values():
            shape = np.array(edge.getLanes()[0].getShape())
            heading = float(np.arctan2(*(shape[-1] - shape[-2])[::-1]))
            foot = shape[-1] + right_of(heading) * (edge.getLanes()[0].getWidth() / 2 + 0.7)
            head = box([-0.12, -0.17, 2.6], [0.1, 0.17, 3.6], "trim")
            pole = lathe([(0.0, 0.07), (3.2, 0.06)], ["pole"], 8, "z").moved([0.17, 0, 0])
            poles.append(merged([head, pole]).moved([*foot, KERB_HEIGHT], heading))
            facing = np.array([-np.cos(heading), -np.sin(heading), 0.0])
            lamps = [*foot, KERB_HEIGHT] + 0.13 * facing + np.array([[0, 0, 3.42], [0, 0, 3.1], [0, 0, 2.78]])
            signals.append(Signal(program.getID(), link, lamps, facing))
    return tuple(signals), poles
