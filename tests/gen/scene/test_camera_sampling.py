import math

import numpy as np
import pytest

from skope.camera.model import Camera
from skope.errors import UserError
from skope.gen.labels.ignore_rules import Rules
from skope.gen.pipeline.config import DatasetRequest, from_preset
from skope.gen.scene import camera_sampling
from skope.gen.scene.camera_sampling import CameraRanges
from skope.gen.towns.land_use import Layout
from skope.gen.towns.sites import site

SIZE = (1920, 1080)


def request(preset: str = "varied", **values: object) -> DatasetRequest:
    return from_preset(preset, seed=0, renderer="pybullet", driver="", rules=Rules(), **values)  # type: ignore[arg-type]


@pytest.mark.parametrize(("yaw", "pitch", "roll"), [(0.3, 0.4, 0.05), (-2.9, 1.2, -0.4), (3.0, -0.2, 0.0)])
def test_angles_are_those_a_camera_was_hung_with(yaw: float, pitch: float, roll: float) -> None:
    camera = Camera.looking([3, -2, 6], yaw=yaw, pitch_down=pitch, roll=roll)
    assert camera.angles == pytest.approx((yaw, pitch, roll), abs=1e-12)


def test_a_fisheye_shows_the_field_of_view_it_is_asked_for() -> None:
    (plan, *_) = request("demo", settings={"fisheye": (1.0, 1.0), "k1": (-0.03, -0.03)}).plans()
    lens = camera_sampling.sample_camera(
        plan.site,
        CameraRanges(SIZE, 110.0, conditions_of(plan.variation.settings).distortion, plan.variation.cameras),
        np.random.default_rng(0),
    )
    half = math.radians(55)
    edge = lens.position + lens.T_camera_world[:3, :3].T @ [math.sin(half), 0.0, math.cos(half)]
    assert lens.project(edge)[0] == pytest.approx((1920, 540), abs=1e-6)
    # Equidistant but for k1: a quarter of the way out, the angle is what the polynomial says.
    focal = 960 / (half * (1 - 0.03 * half**2))
    aside = lens.position + lens.T_camera_world[:3, :3].T @ [math.sin(0.2), 0.0, math.cos(0.2)]
    assert lens.project(aside)[0][0] - 960 == pytest.approx(focal * 0.2 * (1 - 0.03 * 0.04), abs=1e-6)


def conditions_of(settings: object):  # type: ignore[no-untyped-def]
    from skope.gen.scene.conditions import Conditions, ranges

    return Conditions.drawn(ranges("clear", "noon", settings), np.random.default_rng(0))  # type: ignore[arg-type]


def test_varied_cameras_keep_to_the_ranges_and_see_road() -> None:
    spans = request().parameters.variation.cameras
    seen = {"fov_deg": [], "height_m": [], "pitch_deg": []}  # type: dict[str, list[float]]
    for number, name in enumerate(request().parameters.sites):
        layout = Layout.of(site(name).town)
        for seed in range(3):
            camera = camera_sampling.sample_camera(
                site(name), CameraRanges(SIZE, 110.0, None, spans), np.random.default_rng([number, seed])
            )
            _, pitch, roll = camera.angles
            seen["fov_deg"].append(math.degrees(2 * math.atan(960 / camera.K[0, 0])))
            seen["height_m"].append(camera.position[2] - layout.road_below(site(name)))
            seen["pitch_deg"].append(math.degrees(pitch))
            assert abs(math.degrees(roll)) <= 3 + 1e-9
            assert camera.position[:2] == pytest.approx(site(name).position[:2])
            points = np.concatenate(list(layout.graph.lane_points.values()))
            pixels, _, valid = camera.project(points)
            assert (valid & camera.inside(pixels)).sum() >= 20
    for key, (low, high) in ((key, spans[key]) for key in seen):
        assert low - 1e-6 <= min(seen[key])
        assert max(seen[key]) <= high + 1e-6
        assert max(seen[key]) - min(seen[key]) > 0.5 * (high - low)


def test_jitter_moves_each_recordings_camera_a_little() -> None:
    spans = request("demo", camera_jitter=True).parameters.variation.cameras
    own = site("t01_mill_corner")
    first, second = (
        camera_sampling.sample_camera(own, CameraRanges(SIZE, 80.0, None, spans), np.random.default_rng(seed))
        for seed in (1, 2)
    )
    plain = own.camera(SIZE, 80.0)
    for camera in (first, second):
        angle = camera.T_camera_world[2, :3] @ plain.T_camera_world[2, :3]
        assert 1e-3 < math.degrees(math.acos(angle)) < 6
        assert abs(camera.position[2] - plain.position[2]) <= 0.5
    assert not np.allclose(first.T_camera_world, second.T_camera_world)
    assert request("demo").parameters.variation.cameras == {}


def test_views_that_show_no_road_are_refused() -> None:
    with pytest.raises(UserError, match="t01_mill_corner: none of 500 drawn cameras sees"):
        camera_sampling.sample_camera(
            site("t01_mill_corner"),
            CameraRanges(SIZE, 30.0, None, {"yaw_by_deg": (90.0, 90.0), "pitch_deg": (60.0, 80.0)}),
            np.random.default_rng(0),
        )


@pytest.mark.parametrize(
    ("settings", "message"),
    [({"k1": (-0.6, 0.0)}, "folds back inside the image"), ({"fisheye": (0.0, 1.0), "k1": (-0.9, 0.0)}, "folds back")],
)
def test_lenses_that_fold_are_refused(settings: dict[str, tuple[float, float]], message: str) -> None:
    with pytest.raises(UserError, match=message):
        request(settings=settings)
