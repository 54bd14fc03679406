"""Build the scenery of a SUMO network: roads, houses, trees, street furniture, signals.

The same network always gives the same scenery.
"""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Final, Self

import numpy as np
import shapely
from numpy.typing import NDArray
from shapely import Polygon
from shapely.ops import unary_union

from skope.gen.cache import cached, digest_of
from skope.gen.mesh import Mesh, flat, lathe, merged, tube
from skope.gen.scenery.backdrop import backdrop, horizon
from skope.gen.scenery.bridges_and_barriers import structures
from skope.gen.scenery.distractors import distractors, hatched_areas, light_pools, lit_objects
from skope.gen.scenery.gardens import gardens
from skope.gen.scenery.ground import Beside, ground_meshes, ground_parts
from skope.gen.scenery.houses import (
    House,
    car_parks,
    covered,
    drive_bays,
    forecourts,
    garden_paths,
    house_meshes,
    house_plots,
)
from skope.gen.scenery.markings import zebra_stripes
from skope.gen.scenery.quads import Solid
from skope.gen.scenery.street_furniture import furniture, lamp_positions
from skope.gen.scenery.trees import plant, tree_meshes
from skope.gen.towns.land_use import Bay, Layout, ground_of, kerb_bays, lot_bays
from skope.gen.towns.road_graph import driven, right_of
from skope.gen.towns.town import Town
from skope.types import Array

STUDIO_TOWN: Final = Town("studio")
"""Empty place for views of single vehicles."""


@dataclass(frozen=True)
class StudioSizes:
    """Size of the studio (an empty place for views of single vehicles), and clearances on roads."""

    radius_m: float = 200.0
    """Radius of the studio, metres."""
    before_crossings_m: float = 5.0
    """Distance from crossings without parked vehicles, metres."""
    arm_clearance_m: float = 16.0
    """Minimum distance of a camera from signals that hang over the road, metres."""


STUDIO_SIZES: Final = StudioSizes()


@dataclass(frozen=True, eq=False)
class Signal:
    """Head of a traffic light, which shows the state of one link of a junction's program."""

    program: str
    link: int
    lamps: Array
    """(3, 3) world positions of the red, yellow and green lamp."""
    facing: Array
    """(3,) direction of their light."""


@dataclass(frozen=True, eq=False)
class Scenery:
    mesh: Mesh
    signals: tuple[Signal, ...]
    buildings: tuple[Polygon, ...] = ()
    """Footprints of the buildings."""
    trees: tuple[tuple[float, float, float], ...] = ()
    """x, y and radius of their crowns."""
    bays: tuple[Bay, ...] = ()
    """Bays for parked vehicles."""
    lamps: Array = field(default_factory=lambda: np.zeros((0, 5)))
    """(N, 5) street lights: the position of the luminaire, and the horizontal unit vector from its pole to it."""
    light_pools: Array = field(default_factory=lambda: np.zeros((0, 10)))
    """(N, 10) patches of light on the road in the dark, from lamps outside the image. Columns: x, y and z of the
    middle, the unit vector in which the patch fades, half of length and width, irradiance red, green and blue."""

    def to_arrays(self) -> dict[str, NDArray[Any]]:
        """Return arrays to be stored in a file."""
        signals = self.signals
        return {
            **self.mesh.to_arrays("mesh"),
            "signal_programs": np.array([signal.program for signal in signals], dtype=str),
            "signal_links": np.array([signal.link for signal in signals], dtype=np.int64),
            "signal_lamps": np.array([signal.lamps for signal in signals]).reshape(-1, 3, 3),
            "signal_facing": np.array([signal.facing for signal in signals]).reshape(-1, 3),
            "buildings": np.frombuffer(shapely.to_wkb(shapely.MultiPolygon(self.buildings)), dtype=np.uint8),
            "trees": np.array(self.trees).reshape(-1, 3),
            "bays": np.array([(*bay.position, bay.heading) for bay in self.bays]).reshape(-1, 3),
            "lamps": self.lamps,
            "light_pools": self.light_pools,
        }

    @classmethod
    def from_arrays(cls, arrays: Mapping[str, NDArray[Any]]) -> Self:
        """Return the scenery that `to_arrays` wrote."""
        programs, links = arrays["signal_programs"].tolist(), arrays["signal_links"].tolist()
        signals = zip(programs, links, arrays["signal_lamps"], arrays["signal_facing"], strict=True)
        return cls(
            Mesh.from_arrays(arrays, "mesh"),
            tuple(Signal(*values) for values in signals),
            tuple(shapely.from_wkb(arrays["buildings"].tobytes()).geoms),
            tuple((x, y, reach) for x, y, reach in arrays["trees"].tolist()),
            tuple(Bay((x, y), heading) for x, y, heading in arrays["bays"].tolist()),
            arrays["lamps"],
            arrays["light_pools"],
        )


@lru_cache(maxsize=10)
def scenery(town: Town) -> Scenery:
    """Build all stationary parts of a town, or load them from the cache.

    Args:
        town: A town of the package or a user's road (with a photograph, only ground and occluders); `STUDIO_TOWN` for
            an empty floor.

    Returns:
        The scenery; equal towns always have equal scenery.
    """
    if town == STUDIO_TOWN:
        r = STUDIO_SIZES.radius_m
        return Scenery(flat([[(-r, -r, 0), (r, -r, 0), (r, r, 0), (-r, r, 0)]], "concrete"), ())
    if town.road and town.road.photograph:
        return Scenery(backdrop(Layout.of(town), town.road), ())
    parts = (town.name, *([repr(town.variant)] if town.variant else []))
    return Scenery.from_arrays(cached("town", digest_of(*parts), lambda: _grow_scenery(town).to_arrays()))


def bays_of(town: Town) -> tuple[Bay, ...]:
    """Return the parking bays of a town's scenery, without building the rest of a variant."""
    if not town.variant:
        return scenery(town).bays
    layout = Layout.of(town)
    houses = house_plots(layout, _generators(town)["plots"])
    bays = (*lot_bays(car_parks(houses)[0]), *drive_bays(houses), *_bays_along_kerbs(town, layout, houses))
    return tuple(map(_bay_out_of_mirror, bays)) if layout.graph.mirrored else bays


def _grow_scenery(town: Town) -> Scenery:
    layout = Layout.of(town)
    rng = _generators(town)
    houses = house_plots(layout, rng["plots"])
    built = covered(houses)
    walks, drives = garden_paths(houses)
    lots, ways = car_parks(houses)
    along_kerbs = _bays_along_kerbs(town, layout, houses)
    lay_bys = ground_of(along_kerbs)
    paved = unary_union([drives, lots, ways, lay_bys])
    trees = plant(layout, unary_union([built, paved]), rng["trees"])
    signals, poles = _signals(layout)
    pits = unary_union([tree.pit for tree in trees if tree.street])
    footings = built.buffer(0.35, join_style="mitre")
    beside_road = Beside(unary_union([forecourts(houses), ways]), walks, drives, lots, lay_bys, footings, pits)
    lit_roads = bool(town.variant and town.variant.lit_objects)
    furnished = list(furniture(layout, unary_union([built, paved, pits]), rng["furniture"], lit_roads=lit_roads))
    hatched: list[Polygon] = []
    if town.variant and town.variant.lit_objects:
        hatched = hatched_areas(town, layout, rng["hatching"])
    surfaces = list(ground_meshes(layout, ground_parts(layout, beside_road, rng["ground"], hatched)))
    meshes = [
        *surfaces,
        *house_meshes(houses, rng["houses"]),
        *gardens(layout, houses, pits, rng["gardens"]),
        *tree_meshes(layout, trees, rng["crowns"]),
        *furnished,
        *structures(layout),
        *horizon(layout, rng["horizon"]),
        *poles,
    ]
    if town.variant and town.variant.distractors:
        blocked = unary_union([built, paved, walks, pits])
        meshes += distractors(town, layout, houses, blocked, merged(meshes[len(surfaces) :]), rng["distractors"])
    lit: list[Mesh] = []
    pools = np.zeros((0, 10))
    if town.variant and town.variant.lit_objects:
        blocked = unary_union([built, paved, walks, pits])
        lit = list(lit_objects(town, layout, houses, blocked, merged(meshes[len(surfaces) :]), rng["lit_objects"]))
        meshes += lit
        pools = light_pools(town, layout, rng["light_pools"])
    crowns = tuple((*tree.position.tolist(), tree.reach) for tree in trees)
    bays = (*lot_bays(lots), *drive_bays(houses), *along_kerbs)
    footprints = tuple(house.footprint for house in houses)
    lamps = lamp_positions([*furnished, *lit])
    grown = Scenery(merged(meshes), signals, footprints, crowns, bays, lamps, pools)
    return _out_of_mirror(grown) if layout.graph.mirrored else grown


def _bays_along_kerbs(town: Town, layout: Layout, houses: list[House]) -> list[Bay]:
    """Return bays along kerbs, which variants of the towns have, clear of drives and crossings."""
    if not (town.variant and town.variant.seed):
        return []
    stripes = unary_union(list(zebra_stripes(layout.graph)))
    keep_clear = unary_union(
        [garden_paths(houses)[1], car_parks(houses)[1], stripes.buffer(STUDIO_SIZES.before_crossings_m)]
    )
    return kerb_bays(layout, keep_clear, _generators(town)["kerbside"])


def _generators(town: Town) -> dict[str, np.random.Generator]:
    """Return a separate random generator per part of the scenery, so that parts do not affect each other."""
    town_seed = zlib.crc32(town.name.encode())
    seed = [town_seed, town.variant.seed] if town.variant and town.variant.seed else town_seed
    return dict(zip(_BUILD_PARTS, np.random.default_rng(seed).spawn(len(_BUILD_PARTS)), strict=True))


def _bay_out_of_mirror(bay: Bay) -> Bay:
    return Bay((bay.position[0], -bay.position[1]), -bay.heading)


def _out_of_mirror(seen: Scenery) -> Scenery:
    """Return the mirror image of scenery that was built for the mirror image of a town with left-hand traffic."""
    flip = np.array([1.0, -1.0, 1.0])
    return Scenery(
        seen.mesh.mirrored(),
        tuple(replace(signal, lamps=signal.lamps * flip, facing=signal.facing * flip) for signal in seen.signals),
        tuple(shapely.affinity.scale(footprint, 1.0, -1.0, origin=(0, 0)) for footprint in seen.buildings),
        tuple((x, -y, reach) for x, y, reach in seen.trees),
        tuple(map(_bay_out_of_mirror, seen.bays)),
        seen.lamps * [1, -1, 1, 1, -1],
        seen.light_pools * [1, -1, 1, 1, -1, 1, 1, 1, 1, 1],
    )


_BUILD_PARTS = (
    "plots",
    "houses",
    "trees",
    "crowns",
    "ground",
    "gardens",
    "furniture",
    "horizon",
    "kerbside",
    "distractors",
    "lit_objects",
    "light_pools",
    "hatching",
)


def _signal_head() -> Mesh:
    """Return housing, back plate and visors of a signal that faces -x; its lowest point is at 2.55 m."""
    out = Solid()
    out.box("trim", (-0.12, -0.17, 2.6), (0.1, 0.17, 3.6))
    out.box("trim", (0.1, -0.26, 2.55), (0.12, 0.26, 3.65))
    for z in (3.42, 3.1, 2.78):
        for y in (-0.13, 0.12):
            out.box("trim", (-0.3, y, z), (-0.12, y + 0.01, z + 0.12), without="+x")
        out.box("trim", (-0.34, -0.13, z + 0.12), (-0.12, 0.13, z + 0.135), without="+x")
    return out.mesh()


def _signal_arm(reach: float) -> Mesh:
    """Return a taller pole with an arm that carries a head `reach` metres to the left, above 5 m."""
    pole = lathe([(3.0, 0.09), (5.7, 0.08), (6.0, 0.07), (6.01, 0.0)], ["pole"] * 3, 8, "z").moved([0.2, 0, 0])
    arm = tube([(0.2, 0.0, 5.75), (0.2, reach / 2, 5.85), (0.2, reach + 0.3, 5.85)], (0.06, 0.05, 0.04), "pole", 7)
    return merged([pole, arm])


def _signals(layout: Layout) -> tuple[tuple[Signal, ...], list[Mesh]]:
    """Return a pole with a head for every edge that leads to a signalled junction, at its stop line.

    With more than one lane, a second head hangs over the road, unless it would hang before a camera.
    """
    signals, poles = [], []
    for program in layout.graph.net.getTrafficLights():
        links = {lane.getEdge().getID(): (lane.getEdge(), link) for lane, _, link in reversed(program.getConnections())}
        for edge, link in links.values():
            if edge not in layout.graph.edges:
                continue
            lanes = driven(edge)
            shape = np.array(lanes[0].getShape())
            heading = float(np.arctan2(*(shape[-1] - shape[-2])[::-1]))
            foot = shape[-1] + right_of(heading) * (lanes[0].getWidth() / 2 + 0.7)
            facing = np.array([-np.cos(heading), -np.sin(heading), 0.0])
            parts = [
                _signal_head(),
                lathe([(0.0, 0.07), (3.7, 0.06), (3.71, 0.0)], ["pole"] * 2, 8, "z").moved([0.2, 0, 0]),
            ]
            heads = [np.zeros(3)]
            if len(lanes) > 1 and layout.camera_distance(foot) > STUDIO_SIZES.arm_clearance_m:
                reach = 0.7 + lanes[0].getWidth()
                for k in range(1 if len(lanes) < 4 else 2):
                    heads.append(np.array([0.0, reach + 2 * k * lanes[0].getWidth(), 2.65]))
                    parts.append(_signal_head().moved(heads[-1]))
                parts.append(_signal_arm(float(heads[-1][1])))
            base = layout.height(foot)
            poles.append(merged(parts).moved([*foot, base], heading))
            for at in heads:
                position = foot - right_of(heading) * at[1]
                heights = np.array([3.42, 3.1, 2.78]) + at[2] + base
                lamps = np.column_stack([np.tile(position, (3, 1)), heights]) + 0.13 * facing
                signals.append(Signal(program.getID(), link, lamps, facing))
    return tuple(signals), poles
