"""Things that resemble vehicles are solid, stand on the ground, and have the proportions of what they are."""

from collections.abc import Callable

import numpy as np
import pytest

from skope.gen.mesh import Mesh, numbered_rows
from skope.gen.render.gl.light import PATTERN_GROUPS
from skope.gen.render.materials import materials_between, named_color
from skope.gen.scenery.distractor_shapes import STANDING_OBJECTS, skip
from skope.gen.scenery.quads import Solid
from skope.gen.scenery.roadside_boards import posts
from skope.gen.scenery.roadside_objects import bales, concrete_barriers, covered_boat, covered_caravan
from tests.gen.rays import cast

Make = Callable[[np.random.Generator], Mesh]
TOUCHING = 0.12
"""Parts that are nearer to each other than this hold together, metres: as a shelter's bench and its back wall."""
HEIGHTS = {
    "arrow_trailer": (2.5, 3.7),
    "bales": (0.7, 3.1),
    "chevron_boards": (0.9, 2.1),
    "concrete_barriers": (0.8, 2.6),
    "covered_boat": (1.3, 2.4),
    "covered_caravan": (2.2, 2.7),
    "direction_sign": (1.6, 5.1),
    "garages": (2.4, 3.2),
    "generator": (1.1, 2.2),
    "gravestones": (0.5, 1.4),
    "kerb_stones": (0.3, 1.5),
    "market_stall": (2.2, 3.1),
    "phone_boxes": (2.1, 2.6),
    "portable_toilets": (2.1, 2.7),
    "posts": (0.6, 1.3),
    "recessed_wall": (1.3, 2.6),
    "site_fence": (2.0, 2.4),
    "ticket_machines": (1.4, 2.7),
}
"""Lowest and highest top of each kind, metres."""
every_kind = pytest.mark.parametrize("make", STANDING_OBJECTS, ids=lambda make: make.__name__)


def sights(mesh: Mesh, count: int, rng: np.random.Generator) -> np.ndarray:
    """Cosines at which sights from above the ground around a thing meet it, below 0 from behind, 0 for none."""
    corners = mesh.vertices[mesh.triangles]
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    aims = rng.uniform([*low[:2], 0.05], high, (count, 3))
    yaw, up = rng.uniform(0, 2 * np.pi, count), rng.uniform(0.02, 0.9, count)
    back = np.stack([np.cos(yaw) * np.cos(up), np.sin(yaw) * np.cos(up), np.sin(up)], axis=1)
    distances, which = cast(aims + 30.0 * back, -back, corners)
    a, b, c = corners[which].swapaxes(0, 1)
    normals = np.cross(b - a, c - a)
    cosines = (normals * back).sum(axis=1) / np.linalg.norm(normals, axis=1)
    return np.where(np.isfinite(distances), cosines, 0.0)


def parts(mesh: Mesh) -> np.ndarray:
    """(P, 2, 3) lowest and highest corners of what holds together by common corners of its triangles."""
    number, first = numbered_rows(mesh.vertices, 4)
    points, triangles = mesh.vertices[first], number[mesh.triangles]
    label = np.arange(len(points))
    while True:
        lowest = label[triangles].min(axis=1)
        after = label.copy()
        np.minimum.at(after, triangles.ravel(), lowest.repeat(3))
        if np.array_equal(after, label):
            break
        label = after
    used = np.unique(triangles)
    groups = [points[used[label[used] == one]] for one in np.unique(label[used])]
    return np.array([[group.min(axis=0), group.max(axis=0)] for group in groups])


def floating(mesh: Mesh) -> int:
    """How many parts of a thing neither reach the ground nor touch one that does, itself or by others."""
    low, high = parts(mesh).swapaxes(0, 1)
    touch = ((low[:, None] < high[None] + TOUCHING) & (low[None] < high[:, None] + TOUCHING)).all(axis=-1)
    held = low[:, 2] <= 0.0
    while not np.array_equal(held, more := held | touch[:, held].any(axis=1)):
        held = more
    return int((~held).sum())


@pytest.mark.parametrize(
    "make", [make for make in STANDING_OBJECTS if make is not skip], ids=lambda make: make.__name__
)
def test_surfaces_look_outward(make: Make) -> None:
    """A skip is open: one sees its walls from inside. Between a print and its wall one may see, but hardly ever."""
    met = np.concatenate(
        [sights(make(np.random.default_rng(seed)), 80, np.random.default_rng(seed)) for seed in range(6)]
    )
    assert (met != 0).sum() > 100
    assert (met < -0.3).sum() <= 0.01 * (met != 0).sum()


@pytest.mark.parametrize("make", [bales, concrete_barriers, covered_boat, covered_caravan, posts])
def test_they_are_closed_to_all_sides(make: Make) -> None:
    """The area of a closed surface that looks to one side is that which looks to the other; feet are open."""
    for seed in range(10):
        mesh = make(np.random.default_rng(seed))
        a, b, c = mesh.vertices[mesh.triangles].swapaxes(0, 1)
        assert np.cross(b - a, c - a).sum(axis=0)[:2] / 2 == pytest.approx([0.0, 0.0], abs=1e-9)


@every_kind
def test_all_parts_are_held(make: Make) -> None:
    for seed in range(20):
        assert floating(make(np.random.default_rng(seed))) == 0


@every_kind
def test_a_seed_gives_the_same_thing_and_another_one_another(make: Make) -> None:
    first, again = (make(np.random.default_rng(1)) for _ in range(2))
    assert first.vertices.tobytes() == again.vertices.tobytes()
    assert first.materials == again.materials
    assert len({make(np.random.default_rng(seed)).vertices.tobytes() for seed in range(30)}) > 1


@every_kind
def test_scenery_has_their_materials(make: Make) -> None:
    """What is not in the groups of materials that scenery is drawn by would not be seen."""
    drawn = {name for ends in PATTERN_GROUPS.values() for name in materials_between(*ends)}
    for seed in range(30):
        for material in make(np.random.default_rng(seed)).materials:
            assert material in drawn or named_color(material), material


def test_they_have_their_heights() -> None:
    named = {make.__name__: make for make in STANDING_OBJECTS}
    for name, (lowest, highest) in HEIGHTS.items():
        for seed in range(40):
            mesh = named[name](np.random.default_rng(seed))
            assert lowest <= mesh.vertices[:, 2].max() <= highest, name
            assert np.ptp(mesh.vertices[:, :2], axis=0).max() < 9.0, name


def test_an_extruded_profile_encloses_its_volume() -> None:
    """By the divergence theorem, with the open foot closed: a trapezium of 2 m and 1 m, 3 m high, 5 m long."""
    out = Solid()
    out.extrude("concrete", [(1.0, 0.0), (0.5, 3.0)], (0.0, 5.0))
    a, b, c = out.mesh().vertices[out.mesh().triangles].swapaxes(0, 1)
    # The foot lies in the plane z = 0 and adds nothing.
    assert (a * np.cross(b, c)).sum() / 6 == pytest.approx(5.0 * 3.0 * 1.5)
