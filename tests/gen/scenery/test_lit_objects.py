"""Things that burn at night are solid, stand beside the roads, list their lamps, and have no labels."""

from dataclasses import replace

import numpy as np
import pytest
import shapely
from shapely.ops import unary_union

from skope.camera.model import Camera
from skope.gen.mesh import flat
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import RenderedFrame
from skope.gen.render.gl import background, renderer
from skope.gen.render.gl.light import PATTERN_GROUPS
from skope.gen.render.materials import GROUND_MATERIALS, materials_between, named_color
from skope.gen.scenery.build import Scenery, scenery
from skope.gen.scenery.distractor_shapes import wall_panel
from skope.gen.scenery.distractors import DISTRACTOR_LIMITS
from skope.gen.scenery.lit_objects import LIT_OBJECTS, MakeLit, lit_panel
from skope.gen.scenery.markings import hatching
from skope.gen.scenery.street_furniture import FURNITURE_LIMITS
from skope.gen.towns.land_use import Layout
from skope.gen.towns.road_graph import driven
from skope.gen.towns.sites import site
from skope.gen.towns.town import Mast, Town, Variant
from tests.gen.scenery.test_distractor_shapes import floating, sights
from tests.gen.scenes import conditions, standing

SITE = site("t01_main_west")
MAST = Mast(SITE.position, SITE.yaw_deg, SITE.pitch_deg, 80.0)
every_kind = pytest.mark.parametrize("make", LIT_OBJECTS, ids=lambda make: make.__name__)


def variant(count: int, name: str = "town01") -> Town:
    """A variant of a town with a number of lit objects before one camera."""
    return Town(name, variant=Variant(4, (MAST,) if name == "town01" else (), lit_objects=count))


@pytest.fixture(scope="module")
def plain() -> Scenery:
    return scenery(variant(0))


@pytest.fixture(scope="module")
def more() -> Scenery:
    return scenery(variant(25))


@every_kind
def test_shapes_are_whole_and_look_outward(make: MakeLit) -> None:
    drawn = {name for ends in PATTERN_GROUPS.values() for name in materials_between(*ends)}
    met = []
    for seed in range(12):
        mesh = make(np.random.default_rng(seed))
        assert np.isfinite(mesh.vertices).all()
        assert all(name in drawn or named_color(name) for name in mesh.materials)
        assert np.ptp(mesh.vertices, axis=0).max() < 11.0
        assert mesh.vertices[:, 2].min() <= 0.0
        assert floating(mesh) == 0, seed
        met.append(sights(mesh, 80, np.random.default_rng(seed)))
    cosines = np.concatenate(met)
    assert (cosines != 0).sum() > 60
    assert (cosines < -0.3).sum() <= 0.02 * (cosines != 0).sum()


@every_kind
def test_a_seed_gives_the_same_thing(make: MakeLit) -> None:
    first, again = (make(np.random.default_rng(1)) for _ in range(2))
    assert first.vertices.tobytes() == again.vertices.tobytes()
    assert first.materials == again.materials


def test_globes_come_in_clusters() -> None:
    make = next(make for make in LIT_OBJECTS if make.__name__ == "globe_lamps")
    for seed in range(20):
        globes = [part for name, part in make(np.random.default_rng(seed)).by_material().items() if "lamp_" in name]
        # Each of them has a middle of its own, in pairs and more.
        middles = np.concatenate([part.vertices[part.triangles].mean(axis=1) for part in globes])
        assert np.ptp(middles[:, :2], axis=0).max() > 0.25


NIGHT = {"sun_elevation_deg": -30.0, "noise": 0.0, "shutter_s": 0.04, "gain_db": 30.0}


def above_ground(seen: Scenery) -> np.ndarray:
    """(T, 3, 3) corners of the triangles of what stands."""
    is_ground = np.array([name in GROUND_MATERIALS for name in seen.mesh.materials])[seen.mesh.material]
    return np.asarray(seen.mesh.vertices[seen.mesh.triangles[~is_ground]])


def test_hatched_areas_are_painted_on_the_road() -> None:
    def areas(count: int) -> dict[str, float]:
        mesh = scenery(Town("town01", variant=Variant(2, (MAST,), lit_objects=count))).mesh
        parts = {
            name: part.vertices[part.triangles] for name, part in mesh.by_material().items() if name in GROUND_MATERIALS
        }
        return {name: float(shapely.area(shapely.polygons(at[..., :2])).sum()) for name, at in parts.items()}

    bare, hatched = areas(0), areas(1)
    assert sum(hatched.values()) == pytest.approx(sum(bare.values()), rel=1e-6)
    assert hatched["marking"] > bare["marking"] + 5.0
    rng = np.random.default_rng(3)
    for parts in (hatching(np.array([5.0, 2.0]), 0.7, rng) for _ in range(10)):
        assert all(part.is_valid and part.area > 0.05 for part in parts)
        assert 3.0 < unary_union(parts).area < 30.0


def corner_set(triangles: np.ndarray) -> set[bytes]:
    return {triangle.tobytes() for triangle in triangles}


def test_they_stand_beside_the_road_and_leave_houses_and_trees_as_they_are(plain: Scenery, more: Scenery) -> None:
    layout, before, after = Layout.of(variant(25)), above_ground(plain), above_ground(more)
    # Street lights take the places of a few signs and benches.
    kept = corner_set(before) & corner_set(after)
    assert 0.95 < len(kept) / len(corner_set(before)) < 1
    assert (more.bays, more.buildings, more.trees) == (plain.bays, plain.buildings, plain.trees)
    corners = np.array([triangle for triangle in after if triangle.tobytes() not in kept])
    assert len(corners) > 1000
    height = corners[..., 2] - layout.ground.beside(corners.reshape(-1, 3)[:, :2]).reshape(corners.shape[:2])
    standing_ones = corners[(height < DISTRACTOR_LIMITS.overhead_m).all(axis=1)]
    road = layout.graph.road.buffer(DISTRACTOR_LIMITS.clearance_m - 0.02)
    shapely.prepare(road)
    assert not shapely.intersects(road, shapely.linearrings(standing_ones[..., :2])).any()
    assert len(more.lamps) > len(plain.lamps)


def test_all_roads_around_the_camera_have_street_lights() -> None:
    motorway = site("t04_ridge_deck")
    mast = Mast(motorway.position, motorway.yaw_deg, motorway.pitch_deg, 80.0)
    towns = [Town("town04", variant=Variant(2, (mast,), lit_objects=count)) for count in (0, 1)]
    dark, lit = (scenery(town).lamps for town in towns)
    graph, camera = Layout.of(towns[1]).graph, np.array(motorway.position[:2])
    gaps = []
    for edge in graph.edges_of("ground"):
        if graph.kind(edge).lights:
            continue
        shape = shapely.LineString([place[:2] for place in driven(edge)[0].getShape()])
        line = shapely.get_coordinates(shapely.segmentize(shape, 10.0))
        near = line[np.linalg.norm(line - camera, axis=1) < 150]
        gaps += [[np.linalg.norm(lamps[:, :2] - at, axis=1).min() for lamps in (dark, lit)] for at in near]
    without, within = np.array(gaps).T
    assert len(gaps) > 10
    assert np.percentile(without, 90) > 3 * FURNITURE_LIMITS.light_spacing_m
    assert np.percentile(within, 90) < FURNITURE_LIMITS.light_spacing_m


def seen(count: int, **light: float) -> RenderedFrame:
    """What the camera shows of the variant, without vehicles."""
    camera = Camera.looking(
        list(SITE.position),
        yaw=np.radians(SITE.yaw_deg),
        pitch_down=np.radians(SITE.pitch_deg),
        size=(320, 180),
        fov=np.radians(80),
    )
    town = variant(count)
    states = {signal.program: "r" * 40 for signal in scenery(town).signals}
    recording = replace(standing(camera, []), town=town, conditions=conditions(**light), signals=(states,))
    return make_renderer("gl", recording).render(0)


def test_they_burn_at_night_and_have_no_labels() -> None:
    """In place of what they hide they are bright at night; ids and silhouettes know nothing of them."""
    without, with_them = (seen(count, lit_windows=0.0, **NIGHT) for count in (0, 25))
    assert with_them.ids.max() <= 0
    assert len(with_them.silhouettes) == 0
    gained = with_them.rgb.astype(int).max(axis=-1) - without.rgb.max(axis=-1)
    assert (gained > 120).sum() > 60


def test_patches_of_light_lie_on_the_road(plain: Scenery, more: Scenery) -> None:
    assert len(plain.light_pools) == 0
    road = Layout.of(variant(25)).graph.road.buffer(0.5)
    seeds = [scenery(Town("town01", variant=Variant(seed, (MAST,), lit_objects=1))).light_pools for seed in (1, 2, 3)]
    pools = np.concatenate([more.light_pools, *seeds])
    assert len(pools) >= 2
    assert shapely.contains_xy(road, pools[:, :2]).mean() > 0.7
    np.testing.assert_allclose(np.hypot(*pools[:, 3:5].T), 1.0)
    assert (pools[:, 5:] > 0).all()
    np.testing.assert_array_equal(Scenery.from_arrays(more.to_arrays()).light_pools, more.light_pools)


@pytest.mark.parametrize(("height", "brighter"), [(-30.0, True), (55.0, False)])
def test_a_patch_of_light_shows_in_the_dark_only(
    height: float, brighter: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pool = np.array([[0.0, 0.0, 0.0, 1.0, 0.0, 4.0, 2.0, 0.3, 0.3, 0.3]])
    ground = flat([[(-60, -60, 0), (60, -60, 0), (60, 60, 0), (-60, 60, 0)]], "asphalt")
    camera = Camera.looking([0, -14, 6.5], yaw=np.pi / 2, pitch_down=0.42, size=(160, 90), fov=np.radians(60))
    recording = replace(
        standing(camera, []), conditions=conditions(**{**NIGHT, "sun_elevation_deg": height}), signals=({},)
    )
    shown = []
    for pools in (np.zeros((0, 10)), pool):
        made = Scenery(ground, (), lamps=np.array([[0.0, 30.0, 9.0, 0.0, 0.0]]), light_pools=pools)
        for module in (background, renderer):
            monkeypatch.setattr(module, "scenery", lambda _, made=made: made)
        shown.append(make_renderer("gl", recording).render(0))
    gained = (shown[1].rgb.astype(int) - shown[0].rgb).max(axis=-1)
    assert (gained[40:50, 70:90] > 25).any() == brighter
    assert (np.abs(gained[80:]) < 4).all()
    np.testing.assert_array_equal(shown[0].ids, shown[1].ids)


def test_a_lit_panel_is_a_panel_whose_ground_burns() -> None:
    for seed in range(8):
        panel = wall_panel(3.0, 1.0, np.random.default_rng(seed))
        lit = lit_panel(panel, np.random.default_rng(seed))
        np.testing.assert_array_equal(lit.material, panel.material)
        changed = [new for new, old in zip(lit.materials, panel.materials, strict=True) if new != old]
        assert len(changed) == 1
        assert changed[0].startswith("lit_")
