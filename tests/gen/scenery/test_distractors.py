"""Things that resemble vehicles stand beside the roads and on walls, and nothing else of the scenery changes."""

from collections.abc import Callable
from functools import partial

import numpy as np
import pytest
import shapely
from shapely.ops import unary_union

from skope.gen.mesh import Mesh
from skope.gen.render.materials import MATERIAL_COLORS, named_color
from skope.gen.scenery import build
from skope.gen.scenery.build import Scenery, scenery
from skope.gen.scenery.distractor_shapes import STANDING_OBJECTS, wall_panel
from skope.gen.scenery.distractors import DISTRACTOR_LIMITS
from skope.gen.towns.land_use import Layout
from skope.gen.towns.sites import sites_of
from skope.gen.towns.town import Mast, Town, Variant

COUNT = 25


def variant(name: str, seed: int, distractors: int = 0) -> Town:
    """A variant of a town with cameras at its sites."""
    masts = tuple(Mast(site.position, site.yaw_deg, site.pitch_deg) for site in sites_of(Town(name)))
    return Town(name, variant=Variant(seed, masts, distractors))


def added(plain: Scenery, more: Scenery) -> Mesh:
    """What one scenery has more than the other, after making sure that all else is the same."""
    count = len(plain.mesh.triangles)
    assert np.array_equal(more.mesh.triangles[:count], plain.mesh.triangles)
    assert np.array_equal(more.mesh.vertices[: len(plain.mesh.vertices)], plain.mesh.vertices)
    assert (more.bays, more.buildings, more.trees) == (plain.bays, plain.buildings, plain.trees)
    return more.mesh.taken(np.arange(count, len(more.mesh.triangles)))


@pytest.mark.parametrize(("name", "seed"), [("town01", 3), pytest.param("town05", 6, marks=pytest.mark.slow)])
def test_they_stand_beside_roads_sidewalks_and_buildings(name: str, seed: int) -> None:
    town = variant(name, seed, COUNT)
    layout, plain = Layout.of(town), scenery(variant(name, seed))
    mesh = added(plain, scenery(town))
    corners = mesh.vertices[mesh.triangles]
    plans = shapely.linearrings(corners[..., :2])
    assert len(plans) > 500
    for region, gap in (
        (layout.graph.road, DISTRACTOR_LIMITS.clearance_m),
        (layout.sidewalk, 0.05),
        (unary_union(plain.buildings), 0.0),
    ):
        shrunk = region.buffer(gap - 0.02) if gap else region.buffer(-0.02)
        shapely.prepare(shrunk)
        assert not shapely.intersects(shrunk, plans).any()
    middles = corners.mean(axis=1)
    away = np.array([layout.camera_distance(place) for place in middles[:, :2]])
    assert away.max() < DISTRACTOR_LIMITS.placed_within_m + 30.0
    assert (middles[:, 2] > layout.ground.beside(middles[:, :2]) - 1.0).all()


def test_the_same_seed_gives_the_same_things() -> None:
    town = variant("town01", 3, COUNT)
    again = build._grow_scenery(town)
    assert again.mesh.vertices.tobytes() == scenery(town).mesh.vertices.tobytes()
    other = scenery(variant("town01", 3, COUNT - 10))
    assert len(other.mesh.vertices) < len(again.mesh.vertices)


def test_their_shapes_are_sound() -> None:
    makes: list[Callable[[np.random.Generator], Mesh]] = [*STANDING_OBJECTS, partial(wall_panel, 3.0, 1.0)]
    for make in makes:
        for seed in range(5):
            mesh = make(np.random.default_rng(seed))
            assert np.isfinite(mesh.vertices).all()
            assert np.isfinite(mesh.normals).all()
            assert all(name in MATERIAL_COLORS or named_color(name) for name in mesh.materials)
            assert np.ptp(mesh.vertices, axis=0).max() < 9.0
