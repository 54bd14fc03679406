"""What only the OpenGL renderer promises."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera
from skope.dataset.depth_files import encode_depth
from skope.gen.mesh import flat, merged
from skope.gen.render.choose_renderer import choose_renderer, make_renderer
from skope.gen.render.gl.light import Stage, mean_light
from skope.gen.render.gl.renderer import GLRenderer, device
from skope.gen.render.pixel_windows import WINDOW_LIMITS, tile_runs, tiles
from tests.gen.scenes import conditions, driven, standing

SIZE = (640, 360)


def geometry_of_plane(camera: Camera, corners: np.ndarray) -> np.ndarray:
    """(H, W, 4) depth, slopes and id of one quadrilateral given in world coordinates."""
    gl = device()
    target = gl.target(SIZE, ["4f4"])
    Stage(gl, flat([corners], "asphalt"), camera, conditions()).draw_geometry(target)
    return np.frombuffer(target.read(components=4, dtype="f4"), dtype=np.float32).reshape(SIZE[1], SIZE[0], 4)


def test_light_in_parts_adds_up_to_light_in_one() -> None:
    camera = Camera.looking([0, 0, 7.5], yaw=0.6, pitch_down=0.3, size=SIZE)
    ground = flat([np.array([(-90, -90, 0), (90, -90, 0), (90, 90, 0), (-90, 90, 0)])], "asphalt")
    wall = flat([np.array([(20, -9, 0), (20, 9, 0), (20, 9, 8), (20, -9, 8)])], "brick")
    stage = Stage(device(), merged([ground, wall]), camera, conditions())
    whole, parts = (mean_light([make() for make in stage.light_parts(count)]) for count in (1, 3))
    for name, light in whole.items():
        assert np.unique(light).size > 500
        np.testing.assert_allclose(parts[name].astype(float), light.astype(float), rtol=2e-3, atol=1e-5)


@pytest.mark.parametrize("origin", [(0.0, 0.0), (1000.0, -700.0)])
@pytest.mark.parametrize("roll", [0.0, 0.4])
def test_depth_of_the_road_within_a_millimetre(origin: tuple[float, float], roll: float) -> None:
    x, y = origin
    camera = Camera.looking([x, y, 7.5], yaw=0.6, pitch_down=0.3, roll=roll, size=SIZE)
    r = 400  # the town's own roads end 250 m from its middle
    corners = np.array([(x - r, y - r, 0), (x + r, y - r, 0), (x + r, y + r, 0), (x - r, y + r, 0)])
    layer = geometry_of_plane(camera, corners)
    columns, rows = np.meshgrid(np.arange(SIZE[0]) + 0.5, np.arange(SIZE[1]) + 0.5)
    rays, _ = camera.rays(np.stack([columns, rows], axis=-1))
    down = (rays @ camera.T_camera_world[:3, :3])[..., 2]
    truth = np.where(down < 0, -7.5 / np.where(down < 0, down, -1), np.inf)
    near = truth < 200
    assert near.sum() > 50_000
    assert np.abs(layer[..., 0] - truth)[near].max() < 1e-3
    # What the file holds is rounded to 1/256 m.
    file = encode_depth(layer[..., 0]).astype(float) / 256
    assert np.abs(file - truth)[near].max() < 3e-3
    # The slope carries a pixel's depth to its neighbour's: inverse depth is linear on a plane.
    z, right, below = (np.where(near, layer[..., k].astype(float), 1) for k in range(3))
    for change, axis in ((right, 1), (below, 0)):
        step = np.diff(1 / truth, axis=axis)
        inverse = (-change / z**2)[:-1] if axis == 0 else (-change / z**2)[:, :-1]
        inside = near[:-1] & near[1:] if axis == 0 else near[:, :-1] & near[:, 1:]
        assert np.abs(inverse - step)[inside].max() < 2e-5


def test_three_hundred_metres_and_sky() -> None:
    camera = Camera.looking([0, 0, 50], yaw=0, pitch_down=0, size=SIZE, fov=np.radians(60))
    layer = geometry_of_plane(camera, np.array([(300, 40, 20), (300, -40, 20), (300, -40, 80), (300, 40, 80)]))
    hit = layer[..., 3] > 0
    assert hit[180, 320]
    assert not hit[0, 0]
    np.testing.assert_allclose(layer[hit][:, 0], 300, atol=2e-3)
    assert encode_depth(np.array([[300.0, np.inf]], dtype=np.float32)).tolist() == [[65535, 0]]


def test_wheels_and_body_hide_what_is_behind_them_in_contrast_too() -> None:
    """A dark car before a light one: without it the light one would show."""
    camera = Camera.looking([0, -12, 3.0], yaw=np.pi / 2, pitch_down=0.15, size=SIZE, fov=np.radians(60))
    recording = standing(camera, [("sedan", 0.0, 0.0, 0.0), ("van", 0.0, 5.0, 0.0)])
    view = make_renderer("gl", recording).render(0)
    assert (view.contrast > 3).all()
    assert ((view.ids == 1).sum(), (view.ids == 2).sum()) > (1000, 1000)


def test_a_vehicle_whose_window_only_touches_the_image_is_not_drawn() -> None:
    camera = Camera.looking([0, -9, 6], yaw=np.pi / 2, pitch_down=0.35, size=(640, 360), fov=np.radians(110))
    view = make_renderer("gl", standing(camera, [("bus", 4.6696, -9.695, 3.2985)])).render(0)
    assert not (view.ids > 0).any()


def test_an_interrupted_frame_leaves_nothing_behind(monkeypatch: pytest.MonkeyPatch) -> None:
    camera = Camera.looking([0, -12, 3.0], yaw=np.pi / 2, pitch_down=0.15, size=SIZE, fov=np.radians(60))
    renderer = make_renderer("gl", standing(camera, [("sedan", 0.0, 0.0, 0.0), ("van", 0.0, 5.0, 0.0)]))
    whole = renderer.render(0)

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(GLRenderer, "_draw_color", interrupt)
        with pytest.raises(KeyboardInterrupt):
            renderer.render(0)
    again = renderer.render(0)
    np.testing.assert_array_equal(again.rgb, whole.rgb)
    np.testing.assert_array_equal(again.ids, whole.ids)


def test_the_scenery_is_kept_on_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SKOPE_CACHE", str(tmp_path))
    camera = Camera.looking([0, -9, 6.5], yaw=np.pi / 2, pitch_down=0.35, size=(64, 36))
    recording = standing(camera, [])
    lit: list[str] = []
    first = make_renderer("gl", recording, lambda: lit.append("first")).render(0)
    (file,) = tmp_path.glob("light_*.npz")
    again = make_renderer("gl", recording, lambda: lit.append("again")).render(0)
    np.testing.assert_array_equal(first.rgb, again.rgb)
    assert set(lit) == {"first"}
    file.write_bytes(b"damaged")
    np.testing.assert_array_equal(make_renderer("gl", recording).render(0).rgb, first.rgb)
    assert file.stat().st_size > 1000


def test_dirt_lies_low() -> None:
    """A dirty white car is darker and browner than a clean one at its sills, and hardly at its roof."""
    camera = Camera.looking([0, -9, 3.5], yaw=np.pi / 2, pitch_down=0.25, size=SIZE)
    clean = standing(camera, [("wagon", 0.0, 0.0, 0.0)])
    (car,) = clean.vehicles
    views = []
    for amount in (0.0, 1.0):
        own = replace(car, color="white", shape={**car.shape, "dirt": amount})
        views.append(make_renderer("gl", replace(clean, vehicles=(own,))).render(0))
    (found,) = views[0].silhouettes
    rows, columns = np.nonzero(found.mask)
    before, after = (view.rgb[found.y + rows, found.x + columns].astype(float) for view in views)
    white, height = before.min(axis=1) > 150, (rows - rows.min()) / np.ptp(rows)
    change = before - after
    assert np.abs(change[white & (height < 0.2)].mean(axis=0)).max() < 5
    red, _, blue = change[white & (height > 0.6)].mean(axis=0)
    assert blue > red > 8


def test_tiles_cover_polygons() -> None:
    """Every pixel in a polygon, also in slivers and where most of it lies outside, is in exactly one run."""
    rng = np.random.default_rng(2)
    size = (130, 100)
    columns, rows = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    for _ in range(60):
        corners = rng.uniform([-60, -40], [190, 140], (3, 2)) * rng.choice([1.0, 20.0])
        hull = cv2.convexHull(corners.astype(np.float32))[:, 0].astype(float)
        ahead = np.roll(hull, -1, axis=0) - hull
        turn = [a[0] * (rows - p[1]) - a[1] * (columns - p[0]) for p, a in zip(hull, ahead, strict=True)]
        within = np.all(np.array(turn) >= 0, axis=0) | np.all(np.array(turn) <= 0, axis=0)
        covered = np.zeros(within.shape, int)
        for x0, y0, x1, y1 in tile_runs(tiles([hull], size), size):
            assert x0 % WINDOW_LIMITS.tile_px == y0 % WINDOW_LIMITS.tile_px == 0
            covered[y0:y1, x0:x1] += 1
        assert covered.max() <= 1
        assert covered[within].all()
    assert tile_runs(tiles([np.zeros((0, 2))], size), size) == []


def test_without_egl_the_fallback_is_taken_and_gl_is_refused(tmp_path: Path) -> None:
    """A process that finds no EGL library: `auto` says why it draws with pybullet, `gl` is one line."""
    code = "import ctypes.util; ctypes.util.find_library = lambda name: None; from skope.cli import main; main()"
    blind = {**os.environ, "__EGL_VENDOR_LIBRARY_FILENAMES": str(tmp_path / "none.json")}
    flags = ["gen", "--sites", "t01_mill_corner", "--frames", "1", "--size", "64x36", "--workers", "1"]

    def run(*more: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", code, *flags, "--out", str(tmp_path / "d"), *more]
        return subprocess.run(command, capture_output=True, text=True, check=False, env=blind)

    refused = run("--renderer", "gl")
    assert refused.returncode == 2
    assert "libegl1" in refused.stderr
    assert refused.stderr.count("\n") == 1
    taken = run()
    assert taken.returncode == 0, taken.stderr
    assert "renderer pybullet (simpler images), because" in taken.stdout


def test_auto_is_gl_where_egl_is_to_be_had() -> None:
    assert choose_renderer("auto")[0] == "gl"
    assert choose_renderer("pybullet")[0] == "pybullet"


@pytest.mark.slow
def test_memory_is_flat_over_2000_frames() -> None:
    recording = driven("t01_mill_corner")
    renderer = make_renderer("gl", recording)

    def resident_mb() -> float:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6

    sizes = []
    for k in range(2000):
        renderer.render(k % len(recording))
        if k % 100 == 99:
            sizes.append(resident_mb())
    print(sizes)
    assert max(sizes[2:]) - sizes[1] < 10
    # Recordings come and go.
    for _ in range(6):
        make_renderer("gl", recording).render(0)
        sizes.append(resident_mb())
    assert sizes[-1] - sizes[-4] < 20


def test_llvmpipe_has_no_threads_of_its_own() -> None:
    # With them it damages the heap once in some ten thousand frames of a busy machine.
    draw = "from skope.gen.render.gl.renderer import device; device().target((64, 64), ['4f1']).clear()"
    names = "from pathlib import Path; print(*(p.read_text().strip() for p in Path('/proc/self/task').glob('*/comm')))"
    said = subprocess.run([sys.executable, "-c", f"{draw}; {names}"], capture_output=True, text=True, check=True)
    assert "llvmpipe" not in said.stdout
