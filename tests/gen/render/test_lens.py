"""Distorted cameras: picture, depth, ids, silhouettes and labels share one warp."""

import cv2
import numpy as np
import pytest

from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import RenderedFrame, Silhouette
from skope.gen.render.lens import Lens, pinhole_of
from tests.gen.rays import cast, vehicle_triangles
from tests.gen.scenes import standing

SIZE = (640, 360)
BROWN = Distortion("brown", (-0.18, 0.03, 0.001, -0.002))
FISHEYE = Distortion("fisheye", (-0.02, 0.005, 0.0, 0.0))
VEHICLES = [("sedan", 2.0, 3.0, 0.4), ("van", -5.0, 9.0, 2.0), ("suv", 9.5, 1.0, 1.2)]


def camera_of(distortion: Distortion) -> Camera:
    return Camera.looking(
        [0, -9, 6.5], yaw=np.pi / 2, pitch_down=0.42, size=SIZE, fov=np.radians(75), distortion=distortion
    )


@pytest.mark.parametrize("name", ["gl", pytest.param("pybullet", marks=pytest.mark.slow)])
@pytest.mark.parametrize("distortion", [BROWN, FISHEYE], ids=["brown", "fisheye"])
def test_depth_and_ids_are_those_of_each_pixels_own_ray(name: str, distortion: Distortion) -> None:
    camera = camera_of(distortion)
    recording = standing(camera, VEHICLES)
    view = make_renderer(name, recording).render(0)
    columns, rows = np.meshgrid(np.arange(2, SIZE[0], 5) + 0.5, np.arange(2, SIZE[1], 5) + 0.5)
    rays, valid = camera.rays(np.stack([columns, rows], axis=-1))
    assert valid.all()
    depth, ids = view.depth[2::5, 2::5], view.ids[2::5, 2::5]
    # The road: the plane z = 0 between the kerbs.
    level = (rays @ camera.T_camera_world[:3, :3])[..., 2]
    truth = np.where(level < 0, -6.5 / np.where(level < 0, level, -1), np.inf)
    ground = (ids == 0) & (level < 0)
    away = np.abs(depth[ground] - truth[ground])
    # Kerbs, walks and lawns are 12 cm higher, which is far more than this.
    assert (away < (1e-3 if name == "gl" else 1e-2)).sum() > 4000
    # The vehicles: what rays through the pixel meet, but at edges, where the nearest pixel may show the other side.
    moment = recording.moment(0)
    wrong = checked = 0
    around = [(0.0, 0.0), (-0.6, -0.6), (0.6, -0.6), (-0.6, 0.6), (0.6, 0.6)]
    for i in range(len(VEHICLES)):
        triangles = vehicle_triangles(moment, i)
        picked = ids == i + 1
        pixels = np.stack([columns[picked], rows[picked]], axis=-1)
        own = [camera.rays(pixels + offset)[0] @ camera.T_camera_world[:3, :3] for offset in around]
        met = np.stack([cast(camera.position, directions, triangles)[0] for directions in own])
        smooth = np.isfinite(met).all(axis=0) & (np.ptp(met, axis=0) < 0.1)
        off = np.maximum(met.min(axis=0) - depth[picked], depth[picked] - met.max(axis=0))
        wrong += int((off[smooth] > 0.01).sum())
        checked += int(smooth.sum())
    assert checked > 0.6 * (ids > 0).sum()
    assert wrong <= 0.01 * checked


@pytest.mark.parametrize("distortion", [BROWN, FISHEYE], ids=["brown", "fisheye"])
def test_labels_follow_the_distortion(distortion: Distortion) -> None:
    camera = camera_of(distortion)
    recording = standing(camera, VEHICLES)
    moment = recording.moment(0)
    view = make_renderer("gl", recording).render(0)
    annotations, _ = annotate(moment, view, camera, Rules(), image_id=1)
    assert len(annotations) == 3
    for i, annotation in enumerate(annotations):
        # An outline from the meshes' own vertices.
        pixels, _, valid = camera.project(vehicle_triangles(moment, i).reshape(-1, 3))
        assert valid.all()
        low, high = pixels.min(axis=0), pixels.max(axis=0)
        inside = np.clip(np.concatenate([low, high]), 0, [*SIZE, *SIZE])
        x, y, w, h = annotation.bbox
        # What of the last one is lowest lies beyond the image's edge.
        sides = [0, 1, 2] if i == 2 else [0, 1, 2, 3]
        np.testing.assert_allclose(np.array([x, y, x + w, y + h])[sides], inside[sides], atol=1.5)
        visible = annotation.keypoints[annotation.keypoints[:, 2] == 2]
        assert len(visible) > 8
        assert (visible[:, 0] >= x - 1.5).all()
        assert (visible[:, 0] <= x + w + 1.5).all()
    cut = annotations[2]
    assert 0.05 < cut.truncation < 0.95
    assert all(annotation.truncation == 0 for annotation in annotations[:2])


def test_opencv_takes_the_distortion_out_again() -> None:
    camera = camera_of(BROWN)
    straight = camera_of(Distortion())
    bent = make_renderer("gl", standing(camera, VEHICLES)).render(0).rgb
    plain = make_renderer("gl", standing(straight, VEHICLES)).render(0).rgb
    # OpenCV counts pixel centres from 0.
    K = camera.K - [[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]
    undone = cv2.undistort(bent, K, np.array(BROWN.coefficients))
    part = slice(60, 300), slice(100, 540)
    blurred = [cv2.GaussianBlur(image[part], (7, 7), 1.5).astype(float) for image in (undone, plain)]
    assert np.abs(blurred[0] - blurred[1]).mean() < 2.5
    # A pixel off would be seen.
    moved = np.roll(blurred[0], 2, axis=1)
    assert np.abs(moved - blurred[1]).mean() > 1.5 * np.abs(blurred[0] - blurred[1]).mean()


def test_distortions_that_cannot_be_drawn_are_refused() -> None:
    with pytest.raises(UserError, match="folds back inside the image"):
        pinhole_of(camera_of(Distortion("brown", (-0.5, 0.0, 0.0, 0.0))))
    wide = Camera.looking(
        [0, 0, 6], yaw=0, pitch_down=0.3, size=(1920, 1080), fov=2.6, distortion=Distortion("fisheye", (0.0,) * 4)
    )
    Lens(camera_of(BROWN))
    with pytest.raises(UserError, match=r"shows more than a view of|folds back"):
        pinhole_of(Camera(1920, 1080, wide.K * [[2, 1, 1], [1, 2, 1], [1, 1, 1]], wide.T_camera_world, wide.distortion))


@pytest.mark.parametrize("distortion", [BROWN, FISHEYE], ids=["brown", "fisheye"])
def test_the_inside_of_a_silhouette_is_not_warped_pixel_by_pixel(
    distortion: Distortion, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens, rng = Lens(camera_of(distortion)), np.random.default_rng(3)
    silhouettes = []
    for x, y, width, height in rng.integers([-200, -150, 3, 3], [600, 300, 260, 200], (60, 4)).tolist():
        mask = np.zeros((height, width), dtype=np.uint8)
        corners = rng.integers(0, [width, height], (5, 2)).astype(np.int32)
        cv2.fillConvexPoly(mask, cv2.convexHull(corners), 1)
        silhouettes.append(Silhouette(x, y, mask > 0))
    view = RenderedFrame(
        np.zeros((lens.pinhole.height, lens.pinhole.width, 3), np.uint8),
        np.ones((lens.pinhole.height, lens.pinhole.width), np.float32),
        np.zeros((lens.pinhole.height, lens.pinhole.width, 2), np.float32),
        np.zeros((lens.pinhole.height, lens.pinhole.width), np.int32),
        tuple(silhouettes),
        np.zeros(len(silhouettes)),
    )
    bent = lens.bend(view).silhouettes
    monkeypatch.setattr(Lens, "_surely_sampled", lambda _, silhouette: np.zeros_like(silhouette.mask))
    for one, other in zip(bent, lens.bend(view).silhouettes, strict=True):
        assert (one.x, one.y) == (other.x, other.y)
        np.testing.assert_array_equal(one.mask, other.mask)


def test_a_lens_leaves_the_noise_of_the_sensor_as_it_is() -> None:
    lens, noise = Lens(camera_of(BROWN)), np.linspace(0, 3, 256, dtype=np.float32)
    shape = (lens.pinhole.height, lens.pinhole.width)
    flat = (np.ones(shape, np.float32), np.zeros((*shape, 2), np.float32), np.zeros(shape, np.int32))
    view = RenderedFrame(np.zeros((*shape, 3), np.uint8), *flat, (), np.zeros(0), noise)
    assert lens.bend(view).noise is noise
