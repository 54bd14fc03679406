"""Cameras from what a detector sees: `seen_by_a_detector.npz` has keypoints that road33 found in generated footage,
without the corners of bumpers, hoods and trunks.

Each camera has views of vehicles (xy in eighths of a pixel, probabilities in 200ths), and what is true of it.
"""

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.camera.fit.bundle_adjustment import VehicleViews
from skope.camera.fit.camera_doubts import rejection_reason, sigma_of_ways
from skope.camera.fit.camera_unknowns import FOCAL, HEIGHT, PITCH, camera_of_unknowns
from skope.camera.fit.fit_camera import CameraEstimate, Rival, fit_camera_to_vehicles
from skope.camera.fit.write_camera import KnownLength, camera_figures, corrected, known_of, scale_error_line
from skope.dataset import coco
from skope.errors import UserError
from skope.pose.shape_model import fleet_shapes
from skope.types import Array
from tests.eval.cli.test_footage import drive

SIZE = (1280, 720)


@cache
def stored(name: str) -> tuple[VehicleViews, Array, Array]:
    """Views of vehicles, the true unknowns of their camera, and the middles of the lower edges of boxes."""
    with np.load(Path(__file__).with_name("seen_by_a_detector.npz")) as file:
        found = np.concatenate([file[f"{name}_xy"] / 8, file[f"{name}_p"][..., None] / 200], axis=-1)
        vehicle = file[f"{name}_vehicle"].astype(np.intp)
        views = VehicleViews(found, file[f"{name}_sigma"].astype(float), vehicle, SIZE, fleet_shapes())
        return views, file[f"{name}_truth"], file[f"{name}_edges"].astype(float)


@cache
def fitted(name: str) -> CameraEstimate:
    return fit_camera_to_vehicles(stored(name)[0])


def ways(unknowns: Array, pixels: Array) -> Array:
    """Distances on the road between pixels (P, 2) that follow one another."""
    camera = camera_of_unknowns(unknowns, SIZE)
    x, y, down = (camera.rays(pixels)[0] @ camera.T_camera_world[:3, :3]).T
    on_road = np.stack([x, y], axis=-1) * (-camera.position[2] / down)[:, None]
    return np.asarray(np.linalg.norm(np.diff(on_road, axis=0), axis=1))


@pytest.mark.parametrize("name", ["day", "steep", pytest.param("rain_dusk", marks=pytest.mark.slow)])
def test_a_camera_is_what_it_says_it_is_within_what_it_says(name: str) -> None:
    _, truth, edges = stored(name)
    estimate = fitted(name)
    assert rejection_reason(estimate, edges) is None
    away = estimate.solved.bundle.camera - truth
    sigma = np.sqrt(np.diag(estimate.covariance))
    assert (np.abs(away) < 3 * sigma)[[FOCAL, PITCH, HEIGHT]].all()
    assert (sigma < [0.12, math.radians(3), math.radians(3), 0.12, 0.1]).all()
    row = np.linspace(0.5, 0.95, 6) * SIZE[1]
    pixels = np.column_stack([np.full(len(row), SIZE[0] / 2), row])
    off = np.abs(np.log(ways(estimate.solved.bundle.camera, pixels) / ways(truth, pixels)))
    assert off.max() < 0.1
    assert off.max() < 3 * sigma_of_ways(estimate)


def test_what_contradicts_itself_is_refused() -> None:
    _, truth, edges = stored("refused")
    estimate = fitted("refused")
    assert abs(estimate.solved.bundle.camera[FOCAL] - truth[FOCAL]) > 0.15
    words = rejection_reason(estimate, edges)
    assert words is not None
    assert "keypoints are impossible" in words


def test_squeezed_pictures_are_refused() -> None:
    views, _, edges = stored("steep")
    found = views.found.copy()
    found[..., 0] = SIZE[0] / 2 + 0.75 * (found[..., 0] - SIZE[0] / 2)
    estimate = fit_camera_to_vehicles(replace(views, found=found))
    undoubted = replace(estimate, unevenness=0.0, covariance=fitted("steep").covariance)
    assert "a pixel is 1.33 times as wide as high" in str(rejection_reason(undoubted, edges))


def test_what_is_known_is_kept_to() -> None:
    views, truth, _ = stored("steep")
    height, fov = math.exp(truth[HEIGHT]), 2 * math.degrees(math.atan(SIZE[0] / 2 / math.exp(truth[FOCAL])))
    estimate = fit_camera_to_vehicles(views, known_of(height, fov, SIZE[0]))
    assert estimate.camera.K[0, 0] == pytest.approx(math.exp(truth[FOCAL]), rel=0.06)
    assert estimate.camera.position[2] == pytest.approx(height, rel=0.06)
    assert sigma_of_ways(estimate) < sigma_of_ways(fitted("steep"))


def test_a_known_length_says_how_large_everything_is() -> None:
    estimate, (_, truth, _) = fitted("day"), stored("day")
    ends = np.array([[560.0, 640.0], [700.0, 430.0]])
    length = KnownLength(ends, float(ways(truth, ends)[0]))
    better = corrected(estimate, [length])
    assert sigma_of_ways(better) < sigma_of_ways(estimate)
    assert better.sigma_height < estimate.sigma_height
    assert float(ways(better.solved.bundle.camera, ends)[0]) == pytest.approx(length.metres, rel=0.01)
    assert better.camera.K[0, 0] == pytest.approx(math.exp(better.solved.bundle.camera[FOCAL]))
    # Where the height alone is not known, all distances grow with it.
    only = np.diag([0.0, 0.0, 0.0, 0.2**2, 0.0])
    twice = corrected(replace(estimate, covariance=only), [KnownLength(ends, 1.3 * length.metres)])
    before = float(ways(estimate.solved.bundle.camera, ends)[0])
    assert twice.camera.position[2] / estimate.camera.position[2] == pytest.approx(1.3 * length.metres / before, 0.01)
    assert twice.camera.angles == pytest.approx(estimate.camera.angles)
    with pytest.raises(UserError, match=r"--length 560,640,700,430,.* under the camera from the vehicles"):
        corrected(estimate, [KnownLength(ends, 2 * length.metres)])


def test_each_doubt_has_its_sentence() -> None:
    estimate, edges = fitted("day"), stored("day")[2]
    sky = np.column_stack([np.linspace(0, SIZE[0], 50), np.full(50, -150.0)])
    assert "above the horizon" in str(rejection_reason(estimate, np.concatenate([edges[:50], sky])))
    vague = replace(estimate, covariance=100 * estimate.covariance)
    assert "distances along the road are known within" in str(rejection_reason(vague, edges))
    assert estimate.unevenness < 0.5
    assert "do not stand on one plane" in str(rejection_reason(replace(estimate, unevenness=0.7), edges))
    other = estimate.solved.bundle.camera + np.array([0.0, 0.0, 0.0, 0.3, 0.0])
    assert "two are about as likely" in str(rejection_reason(replace(estimate, rival=Rival(other, 2.0)), edges))
    assert rejection_reason(replace(estimate, rival=Rival(other, 20.0)), edges) is None
    bundle = estimate.solved.bundle
    aside = replace(bundle, pose=bundle.pose + [0.0, 0.0, math.radians(15)])
    turned = replace(estimate, solved=replace(estimate.solved, bundle=aside))
    assert "degrees to their headings" in str(rejection_reason(turned, edges))


@pytest.mark.slow
def test_half_of_the_vehicles_tell_the_same_within_what_both_say() -> None:
    views, _, _ = stored("rain_dusk")
    whole = fitted("rain_dusk")
    rows = views.vehicle % 2 == 0
    vehicle = views.vehicle[rows] // 2
    half = fit_camera_to_vehicles(
        replace(views, found=views.found[rows], sigma_px=views.sigma_px[rows], vehicle=vehicle)
    )
    apart = half.solved.bundle.camera - whole.solved.bundle.camera
    sigma = np.sqrt(np.diag(half.covariance) + np.diag(whole.covariance))
    assert (np.abs(apart) < 3 * sigma).all()


@pytest.mark.slow
def test_too_uncertain_a_camera_is_not_written(skope: Any) -> None:
    coco.write(Path("road.json"), drive(2, 5, speeds=(9.0, 3.0, 6.0, 12.0, -6.0, -9.0)))
    code, _, error = skope("eval", "camera", "--annotations", "road.json", "--noise", 9, "--out", "c.json")
    assert (code, error.count("\n")) == (2, 1)
    assert "frames: no camera can be calibrated from " in error
    assert "--points" in error
    assert not Path("c.json").exists()


def test_a_camera_file_says_how_certain_it_is(skope: Any) -> None:
    coco.write(Path("road.json"), drive(3, 5, speeds=(9.0, 3.0, 6.0, 12.0, -6.0, -9.0)))
    code, out, error = skope("eval", "camera", "--annotations", "road.json", "--noise", 1, "--out", "c.json")
    assert code == 0, error
    document = json.loads(Path("c.json").read_text())
    assert np.array(document["covariance"]["matrix"]).shape == (5, 5)
    assert 0 < document["sigma"]["distance"] < 0.13
    assert "(90%: " in out


def test_intervals_of_a_camera_hold_90_percent() -> None:
    """+-1.645 standard deviations: of logarithms for lengths, of degrees for angles."""
    lines = list(
        camera_figures(
            focal=(1000.0, 50.0), height=(8.0, 0.4), pitch=(math.radians(20), math.radians(1)), roll=(0.0, 0.0)
        )
    )
    low, high = 1000 * math.exp(-1.645 * 0.05), 1000 * math.exp(1.645 * 0.05)
    assert lines[0] == f"focal length 1000 px (90%: {low:.0f} to {high:.0f})"
    assert "tilt down 20.00 deg (90%: 18.36 to 21.64)" in lines[1]
    assert scale_error_line("road", 0.1) == "road: all distances and speeds may be off by 16%, in one direction (90%)"


@pytest.mark.slow
def test_a_road_that_rises_is_no_plane() -> None:
    """Half of the vehicles stand 1.5 m higher than the others, under a camera 4.8 m over the road."""
    views, truth, edges = stored("day")
    camera = camera_of_unknowns(truth, SIZE)
    bundle = fitted("day").solved.bundle
    found = views.found.copy()
    for row in np.flatnonzero(views.vehicle % 2):
        place = np.array([[*(bundle.pose[row, :2] * camera.position[2]), 0.0]])
        here, there = camera.project(place)[0], camera.project(place + [0.0, 0.0, 1.5])[0]
        found[row, :, :2] += there - here
    estimate = fit_camera_to_vehicles(replace(views, found=found))
    assert estimate.unevenness > fitted("day").unevenness
    assert rejection_reason(estimate, edges) is not None
