import sys
from pathlib import Path

import numpy as np
import pytest

from skope import doctor
from skope.camera.model import Camera
from skope.gen.mesh import flat
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import STATIC_ID, RenderedFrame
from skope.gen.render.materials import MATERIAL_COLORS, Light
from skope.gen.render.tiny_renderer import _Stage
from skope.gen.scene.recording import Recording
from skope.gen.simulation.pybullet_engine import engine
from tests.gen.rays import cast, vehicle_triangles
from tests.gen.scenes import standing

SIZE = (640, 360)
CAMERA = Camera.looking([0, -9, 6.5], yaw=np.pi / 2, pitch_down=0.35, size=SIZE, fov=np.radians(80))


def depth_of_plane(camera: Camera, corners: list[tuple[float, float, float]]) -> np.ndarray:
    """Depth at pixel centres of one large quadrilateral."""
    light = Light((0, 0, 1), 0.5, 0.5, (1, 1, 1), (1, 1, 1), (1, 1, 1))
    stage = _Stage()
    stage.add(flat([corners], "asphalt"), MATERIAL_COLORS)
    layer = stage.draw(camera, camera.T_camera_world, (0, 0, camera.width, camera.height), light)
    return layer.depth[1::3, 1::3].astype(np.float64)


def assert_depth(found: np.ndarray, truth: np.ndarray) -> None:
    """Within 1 cm to 50 m and 0.1% beyond."""
    assert np.abs(found - truth)[truth <= 50].max(initial=0) < 0.01
    beyond = truth > 50
    assert (np.abs(found - truth) / truth)[beyond].max(initial=0) < 1e-3


@pytest.mark.parametrize("distance", [0.7, 12.0, 49.0, 180.0])
def test_depth_of_a_fronto_parallel_plane(distance: float) -> None:
    camera = Camera.looking([0, 0, 0], yaw=0, pitch_down=0, size=SIZE)
    r = 2 * distance
    found = depth_of_plane(camera, [(distance, -r, -r), (distance, -r, r), (distance, r, r), (distance, r, -r)])
    assert_depth(found, np.full_like(found, distance))


@pytest.mark.parametrize(("pitch", "roll"), [(0.15, 0.0), (0.4, 0.5), (1.2, -1.0)])
def test_depth_of_the_ground_seen_obliquely(pitch: float, roll: float) -> None:
    camera = Camera.looking([3, 4, 7.5], yaw=0.6, pitch_down=pitch, roll=roll, size=SIZE)
    found = depth_of_plane(camera, [(-900, -900, 0), (900, -900, 0), (900, 900, 0), (-900, 900, 0)])
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays, _ = camera.rays(np.stack([columns, rows], axis=-1))
    down = (rays @ camera.T_camera_world[:3, :3])[..., 2]
    truth = np.where(down < 0, -7.5 / np.where(down < 0, down, -1), np.inf)
    near = truth < 400
    assert near.sum() > 50_000
    assert_depth(found[near], truth[near])


def test_recordings_share_pybullets_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    # Each takes memory that pybullet never gives back, and there are no more than 1024.
    recording = standing(CAMERA, [("sedan", -3.0, 4.0, 0.3)])
    first = make_renderer("pybullet", recording).render(0)
    monkeypatch.setattr(engine(), "connect", None)
    second = make_renderer("pybullet", recording).render(0)
    np.testing.assert_array_equal(second.rgb, first.rgb)
    np.testing.assert_array_equal(second.depth, first.depth)


@pytest.fixture(scope="module", params=["pybullet", "gl"])
def renderer(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def scene(renderer: str) -> tuple[Recording, RenderedFrame]:
    recording = standing(CAMERA, [("sedan", -3.0, 4.0, 0.3), ("suv", 4.0, 7.0, 2.0), ("van", 1.0, 13.0, -1.2)])
    return recording, make_renderer(renderer, recording).render(0)


def test_depth_and_ids_agree_with_ray_casting(scene: tuple[Recording, RenderedFrame]) -> None:
    recording, view = scene
    camera, moment = recording.camera, recording.moment(0)
    rng = np.random.default_rng(0)
    checked = 0
    for i in range(3):
        triangles = vehicle_triangles(moment, i)
        rows, columns = np.nonzero(view.ids == i + 1)
        chosen = rng.choice(len(rows), 120, replace=False)
        pixels = np.stack([columns[chosen], rows[chosen]], axis=-1) + 0.5
        rays, _ = camera.rays(pixels)
        hits, _ = cast(camera.position, rays @ camera.T_camera_world[:3, :3], triangles)
        found = view.depth[rows[chosen], columns[chosen]]
        same = np.abs(hits - found) < 0.01
        assert same.mean() > 0.98  # rays that graze an edge may pass it on either side
        checked += same.sum()
    assert checked > 300


def test_silhouettes_are_those_of_ray_casting(scene: tuple[Recording, RenderedFrame]) -> None:
    recording, view = scene
    camera, moment = recording.camera, recording.moment(0)
    for i, silhouette in enumerate(view.silhouettes):
        rows, columns = np.mgrid[: silhouette.mask.shape[0] : 3, : silhouette.mask.shape[1] : 3]
        pixels = np.stack([columns + silhouette.x, rows + silhouette.y], axis=-1) + 0.5
        rays, _ = camera.rays(pixels.reshape(-1, 2))
        hits, _ = cast(camera.position, rays @ camera.T_camera_world[:3, :3], vehicle_triangles(moment, i))
        assert (np.isfinite(hits) == silhouette.mask[rows, columns].ravel()).mean() > 0.997


def test_visible_pixels_lie_inside_the_silhouette(scene: tuple[Recording, RenderedFrame]) -> None:
    _, view = scene
    for i, silhouette in enumerate(view.silhouettes):
        rows, columns = np.nonzero(view.ids == i + 1)
        assert len(rows) > 500
        # An edge may round to either side of a pixel's centre in the silhouette's own window.
        assert silhouette.mask[rows - silhouette.y, columns - silhouette.x].mean() > 0.999


def test_slope_predicts_the_neighbouring_pixel_on_the_road(scene: tuple[Recording, RenderedFrame]) -> None:
    _, view = scene
    depth, slope = view.depth[250:340, 20:120].astype(float), view.slope[250:340, 20:120]
    flat_road = (view.ids[250:340, 20:120] == STATIC_ID).all()
    assert flat_road
    predicted = depth[:-1] / (1 - slope[:-1, :, 1] / depth[:-1])
    error = np.abs(predicted - depth[1:])
    assert np.median(error) < 0.002


def test_a_vehicle_across_the_edge_keeps_its_whole_silhouette(renderer: str) -> None:
    recording = standing(CAMERA, [("sedan", -9.0, 2.0, 0.1)])
    view = make_renderer(renderer, recording).render(0)
    (silhouette,) = view.silhouettes
    assert silhouette.x < 0
    inside = silhouette.mask[:, -silhouette.x :].sum()
    assert 0 < inside < silhouette.mask.sum()
    assert (view.ids == 1).sum() == inside


def test_the_same_frame_gives_the_same_pixels(scene: tuple[Recording, RenderedFrame], renderer: str) -> None:
    recording, view = scene
    again = make_renderer(renderer, recording).render(0)
    np.testing.assert_array_equal(again.rgb, view.rgb)
    np.testing.assert_array_equal(again.depth, view.depth)


def test_contrast_is_high_for_a_blue_car_on_the_road_and_zero_unseen(
    scene: tuple[Recording, RenderedFrame], renderer: str
) -> None:
    _, view = scene
    assert (view.contrast > 5).all()
    behind = standing(CAMERA, [("sedan", 0.0, -30.0, 0.0)])
    assert make_renderer(renderer, behind).render(0).contrast.tolist() == [0.0]


def test_an_empty_street(renderer: str) -> None:
    view = make_renderer(renderer, standing(CAMERA, [])).render(0)
    assert (view.ids <= STATIC_ID).all()
    assert view.silhouettes == ()
    assert np.isinf(view.depth).any()
    assert np.isfinite(view.depth[-1]).all()


def test_the_doctor_tries_drawing_where_nothing_can_be_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As on a machine that only renders: no SUMO, no pybullet, and OpenGL works."""
    for name in ("libsumo", "pybullet"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.setattr(doctor, "PROCESSES", {})
    status = {finding.part: finding.status for finding in doctor.examine(tmp_path)}
    assert (status["renderer gl"], status["simulation"]) == ("ok", "broken")
    assert (tmp_path / "doctor_gl.png").is_file()
