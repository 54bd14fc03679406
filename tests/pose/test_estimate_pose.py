"""Poses from keypoints: exact where the shape is known, near the Cramer-Rao bound where it is not, refused or flagged
where the keypoints are nonsense."""

import itertools
import math
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
import pytest

from skope import keypoints
from skope.camera.ground_plane import Ground
from skope.camera.model import Camera, Distortion
from skope.errors import UserError
from skope.gen.vehicles.fleet import fleet
from skope.pose import closed_form_starts, estimate_pose
from skope.pose.keypoint_views import Scene
from skope.pose.observations import observe
from skope.pose.pose_records import locate_view
from skope.pose.shape_model import Shapes, facing, fleet_shapes, read_shapes
from skope.schema import AnnotationFile, Image, Result
from tests.sightings import CAMERA, scene

SPACE = fleet_shapes()


def drawn(count: int, seed: int) -> list[Any]:
    """Keypoints of vehicles as often of each type as on the road, from the shape space."""
    rng = np.random.default_rng(seed)
    kinds = rng.choice(len(SPACE.types), size=count, p=SPACE.share)
    return [
        SPACE.mean[k, :-1]
        + np.tensordot(rng.standard_normal(SPACE.directions.shape[1]), SPACE.directions[k, :, :-1], 1)
        for k in kinds
    ]


def test_the_shape_space_is_the_fleets() -> None:
    assert set(SPACE.types) == {entry.vehicle.vehicle_type for entry in fleet().values()}
    mirrored = SPACE.mean[:, :-1][:, list(keypoints.FLIP)] * [1, -1, 1]
    assert np.abs(mirrored - SPACE.mean[:, :-1]).max() < 2e-4
    # A held-out model, which the file has not seen, lies within the space: its shape's numbers are of unit size.
    sedan = fleet()["sedan_compact"].vehicle
    k = SPACE.types.index("sedan")
    D = SPACE.directions[k, :, :-1].reshape(SPACE.directions.shape[1], -1)
    away = (sedan.points - SPACE.mean[k, :-1]).ravel()
    a, *_ = np.linalg.lstsq(D.T, away, rcond=None)
    assert np.abs(away - a @ D).max() < 0.12
    assert np.abs(a).max() < 3


def test_a_file_of_another_scheme_is_refused(tmp_path: Any) -> None:
    path = tmp_path / "shapes.json"
    path.write_text('{"scheme": "apollo24"}')
    with pytest.raises(UserError, match=r"shapes\.json: scheme"):
        read_shapes(path)


@pytest.mark.parametrize("kind", SPACE.types)
def test_known_shapes_are_placed_exactly(kind: str) -> None:
    vehicle = next(entry.vehicle for entry in fleet().values() if entry.vehicle.vehicle_type == kind)
    truth = scene([vehicle.points] * 16, np.random.default_rng(3), noise=0, far=60)
    poses = estimate_pose.estimate_poses(CAMERA, truth.found, shapes=Shapes.known(vehicle.points, vehicle.size_lwh))
    metres, degrees = truth.errors(poses)
    assert metres.max() < 0.01
    assert degrees.max() < 0.1
    assert set(poses.refusal) == {None}


def test_unknown_shapes_come_near_the_bound_and_beat_a_mean_vehicle() -> None:
    truth = scene(drawn(300, 0), np.random.default_rng(1), noise=2)
    poses = estimate_pose.estimate_poses(CAMERA, truth.found)
    metres, degrees = truth.errors(poses)
    far = np.linalg.norm(truth.position - CAMERA.position[:2], axis=1) > 30
    assert far.sum() > 30
    assert np.median(metres) < 0.2
    assert np.median(degrees) < 1.2
    assert np.median(metres[far]) < 0.35
    assert np.median(degrees[far]) < 2.5
    # The covariance is what it says: neither a boast nor a shrug.
    squared = degrees**2 / np.degrees(1) ** 2 / poses.covariance[:, 3, 3]
    assert 0.15 < np.median(squared) < 0.8  # 0.455 for a normal distribution

    mean = SPACE.mean_vehicle()[:-1]
    theirs = []
    for row in truth.found:
        seen = row[:, 2] > 0
        _, _, shift = cv2.solvePnP(mean[seen], row[seen, :2], CAMERA.K, None)
        T = np.linalg.inv(CAMERA.T_camera_world)
        theirs.append(T[:2, :3] @ shift[:, 0] + T[:2, 3])
    peer = np.linalg.norm(np.array(theirs) - truth.position, axis=1)
    distance = np.linalg.norm(truth.position - CAMERA.position[:2], axis=1)
    for low in (8, 16, 24, 32):
        band = (distance >= low) & (distance < low + 8)
        assert np.median(metres[band]) < 0.5 * np.median(peer[band])


def test_a_lens_with_distortion_is_honoured() -> None:
    lens = Distortion("brown", (-0.12, 0.01, 0.001, -0.001))
    camera = Camera(CAMERA.width, CAMERA.height, CAMERA.K, CAMERA.T_camera_world, lens)
    vehicle = fleet()["suv"].vehicle
    known = Shapes.known(vehicle.points, vehicle.size_lwh)
    truth = scene([vehicle.points] * 12, np.random.default_rng(3), noise=0, far=60, camera=camera)
    assert truth.errors(estimate_pose.estimate_poses(camera, truth.found, shapes=known))[0].max() < 0.01
    assert truth.errors(estimate_pose.estimate_poses(CAMERA, truth.found, shapes=known))[0].max() > 0.1


def test_without_a_ground_size_alone_tells_the_distance() -> None:
    vehicle = fleet()["sedan"].vehicle
    truth = scene([vehicle.points] * 6, np.random.default_rng(5), noise=0)
    poses = estimate_pose.estimate_poses(
        CAMERA, truth.found, ground=None, shapes=Shapes.known(vehicle.points, vehicle.size_lwh)
    )
    metres, degrees = truth.errors(poses)
    assert metres.max() < 0.01
    assert degrees.max() < 0.1
    free = estimate_pose.estimate_poses(CAMERA, truth.found, ground=None)
    known = estimate_pose.estimate_poses(CAMERA, truth.found)
    assert (free.covariance[:, 0, 0] > known.covariance[:, 0, 0]).all()


def test_wild_keypoints_do_not_move_a_vehicle() -> None:
    rng = np.random.default_rng(2)
    truth = scene(drawn(60, 4), rng, noise=1)
    wild = truth.found.copy()
    for row in wild:
        some = rng.choice(np.flatnonzero(row[:, 2]), size=2, replace=False)
        row[some, :2] += rng.uniform(60, 200, (2, 2)) * rng.choice([-1, 1], (2, 2))
    poses = estimate_pose.estimate_poses(CAMERA, wild, sigma_px=1)
    metres, degrees = truth.errors(poses)
    assert np.median(metres) < 0.15
    assert np.percentile(degrees, 90) < 5


def nonsense() -> dict[str, Any]:
    """Keypoints (N, 33, 3) that are wrong in a way, and where the vehicles stand."""
    truth = scene(drawn(40, 7), np.random.default_rng(8), noise=0.5, far=25)
    found = truth.found
    line = found.copy()
    line[..., 1] = 500 + 0.2 * line[..., 0]
    zero = found * [1, 1, 0]
    scattered = found.copy()
    scattered[..., :2] = np.random.default_rng(0).uniform(0, 1000, scattered[..., :2].shape)
    not_numbers = found.copy()
    not_numbers[:, :, 0] = math.nan
    huge = found * [1e9, 1e9, 1]
    one_place = found.copy()
    one_place[..., :2] = 700
    return {
        "sides": found[:, list(keypoints.FLIP)],
        "ends": found[:, list(keypoints.OTHER_END)],
        "line": line,
        "zero": zero,
        "scattered": scattered,
        "not_numbers": not_numbers,
        "huge": huge,
        "one_place": one_place,
        "truth": truth,
    }


@pytest.mark.parametrize("ground", [Ground(), None])
def test_nonsense_is_refused_or_flagged(ground: Ground | None) -> None:
    cases = nonsense()
    truth = cases.pop("truth")
    for name, found in cases.items():
        few = slice(None) if ground else slice(8)
        poses = estimate_pose.estimate_poses(CAMERA, found[few], sigma_px=1, ground=ground)
        wrong = np.array([r is None and not f for r, f in zip(poses.refusal, poses.flags, strict=True)])
        if name in ("sides", "ends"):
            # Unflagged answers there may be, where a vehicle hardly shows the difference; they are right then.
            turn = (poses.yaw - truth.yaw[few] + math.pi) % (2 * math.pi) - math.pi
            wrong &= np.abs(turn) > math.radians(10)
            exchanged = np.array(["sides_exchanged" in f or "ends_exchanged" in f for f in poses.flags])
            assert exchanged.mean() > 0.5 or ground is None
        assert not wrong.any(), (name, ground)


def test_half_a_vehicle_outside_the_image_is_placed() -> None:
    vehicle = fleet()["sedan"].vehicle
    truth = scene([vehicle.points] * 40, np.random.default_rng(9), noise=0.5, far=15)
    x = truth.found[..., 0]
    seen = truth.found[..., 2] > 0
    middle = np.array([np.median(row[good]) for row, good in zip(x, seen, strict=True)])
    half = truth.found * (x < middle[:, None])[..., None]
    poses = estimate_pose.estimate_poses(CAMERA, half, sigma_px=1)
    good = np.array([reason is None for reason in poses.refusal])
    assert good.mean() > 0.6
    metres, _ = truth.errors(poses)
    assert np.median(metres[good]) < 0.3
    spread = np.sqrt(poses.covariance[:, 0, 0] + poses.covariance[:, 1, 1])
    assert (metres[good] < 4 * spread[good] + 0.1).all()


def test_no_vehicles_are_no_poses() -> None:
    assert len(estimate_pose.estimate_poses(CAMERA, np.zeros((0, keypoints.K, 3)))) == 0


@pytest.mark.parametrize("kind", ["sedan", "suv", "van", "box_truck", "bus"])
def test_an_eye_sees_the_end_and_the_side_that_face_it(kind: str) -> None:
    index = SPACE.types.index(kind)
    points = SPACE.mean[index, :-1]

    def seen(*eye: float) -> Any:
        return facing(SPACE, np.array([index]), points[None], np.array([eye]))[0]

    ends = [
        [i for i, name in enumerate(keypoints.NAMES) if name.startswith(word)] for word in ("headlight", "taillight")
    ]
    for front, rear, x in ((True, False, 30.0), (False, True, -30.0)):
        shown = seen(x, 0, 6)
        assert (shown[ends[0]] == front).all()
        assert (shown[ends[1]] == rear).all()
    left = seen(2, 25, 6)
    assert left[keypoints.INDEX["wheel_front_left"]]
    assert not left[keypoints.INDEX["wheel_front_right"]]
    mirrored = seen(2, -25, 6)[list(keypoints.FLIP)]
    assert (mirrored != left).sum() <= 2


def test_keypoints_that_the_body_hides_may_lie_anywhere() -> None:
    """As detectors have it that learn from visible keypoints alone: all 33 with high scores."""
    rng = np.random.default_rng(3)
    shapes = [SPACE.mean[i % len(SPACE.types), :-1] for i in range(60)]
    road = scene(shapes, rng, noise=1.5)
    found = road.found.copy()
    seen = found[..., 2] > 0
    for row, own in zip(found, seen, strict=True):
        low, high = row[own, :2].min(axis=0), row[own, :2].max(axis=0)
        row[~own] = np.column_stack([rng.uniform(low, high, ((~own).sum(), 2)), np.ones((~own).sum())])
    poses = estimate_pose.estimate_poses(CAMERA, found, sigma_px=1.5)
    metres, degrees = road.errors(poses)
    refused = np.array([reason is not None for reason in poses.refusal])
    assert refused.sum() <= 6
    for numbers in (poses.T_world_vehicle, poses.points, poses.size_lwh, poses.covariance):
        assert (np.isnan(numbers).reshape(60, -1).all(axis=1) == refused).all()
    assert (metres < 0.25).mean() > 0.5
    assert (degrees < 5).mean() >= 0.8
    kept = poses.used[np.array([reason is None for reason in poses.refusal])]
    assert 0.3 < kept.mean() < 0.7


def test_what_a_detector_pushes_to_the_images_edge_does_not_turn_the_vehicle() -> None:
    """Of a vehicle that the image shows in part, all points lie in what is left of its box, with high scores."""
    rng = np.random.default_rng(5)
    whole = scene([SPACE.mean[i % len(SPACE.types), :-1] for i in range(40)], rng, noise=1.0, far=25)
    images, results = [], []
    for number, row in enumerate(whole.found, start=1):
        xy = row[row[:, 2] > 0, :2]
        low, high = xy.min(axis=0), xy.max(axis=0)
        width = math.ceil(low[0] + 0.6 * (high[0] - low[0]))
        camera = replace(CAMERA, width=width)
        image = Image(
            id=number, file_name=f"{number}.jpg", width=width, height=CAMERA.height, camera=camera, time_s=float(number)
        )
        points = np.column_stack([np.minimum(row[:, 0], width - 0.5), row[:, 1:]])
        box = np.array([*low, width - low[0], high[1] - low[1]])
        images.append(image)
        results.append(Result(image_id=number, score=0.99, bbox=box, keypoints=points))
    file = AnnotationFile(images=tuple(images), annotations=(), info={}, name="cut", scheme=keypoints.SKOPE33)
    road = Scene(file, tuple(results), None, Ground())

    turned: dict[bool, list[float]] = {True: [], False: []}
    for view, result, yaw in zip(road.views(sigma_px=2.0), results, whole.yaw, strict=True):
        assert view.cut.all()
        pushed = replace(view, found=result.keypoints[None].copy(), cut=np.array([False]))
        for known, one in ((True, view), (False, pushed)):
            poses = locate_view(one, road).poses
            assert ("cut" in poses.flags[0]) == known
            if poses.refusal[0] is None:
                axis = (poses.yaw[0] - yaw + math.pi / 2) % math.pi - math.pi / 2
                turned[known].append(abs(math.degrees(axis)))
    assert len(turned[True]) >= 20
    assert np.median(turned[True]) < 2.5
    assert np.median(turned[True]) < 0.5 * np.median(turned[False])


def test_starts_on_the_ground_are_the_least_squares_solution() -> None:
    truth = scene(drawn(12, 5), np.random.default_rng(6), noise=3)
    ground = Ground(height=0.2)
    seen = observe(CAMERA, truth.found, np.full(12, 2.0))
    starts = closed_form_starts.on_ground(seen, SPACE, ground)
    # The solution is damped by 1e-9, towards the camera's foot.
    for i, k in itertools.product(range(12), (0, 5, 13)):
        use, depth = seen.counted[i], np.ones(seen.counted[i].sum())
        x, y, z = SPACE.mean[k, :-1][use].T
        for _ in range(2):
            # Two equations per keypoint in X, Y, c, s: the projections to the image, times the depth.
            lines, right = [math.sqrt(1e-9) * np.eye(4)], [math.sqrt(1e-9) * np.array([*CAMERA.position[:2], 0, 0])]
            for axis in (0, 1):
                m = CAMERA.T_camera_world[axis] - seen.xy[i, use, axis, None] * CAMERA.T_camera_world[2]
                scale = 1 / np.sqrt(seen.variance[i, use]) / depth
                columns = [m[:, 0], m[:, 1], m[:, 0] * x + m[:, 1] * y, m[:, 1] * x - m[:, 0] * y]
                lines.append(np.stack(columns, axis=1) * scale[:, None])
                right.append(-(m[:, 2] * (z + ground.height) + m[:, 3]) * scale)
            X, Y, c, s = np.linalg.lstsq(np.concatenate(lines), np.concatenate(right), rcond=None)[0]
            c, s = np.array([c, s]) / math.hypot(c, s)
            world = np.stack([X + c * x - s * y, Y + s * x + c * y, z + ground.height, np.ones_like(x)], axis=1)
            depth = world @ CAMERA.T_camera_world[2]
        assert starts.p[i, k] == pytest.approx([X, Y, 0.2], abs=1e-7)
        assert starts.R[i, k][:, 0] == pytest.approx([c, s, 0], abs=1e-7)


def test_the_pose_of_a_vehicle_does_not_depend_on_the_others() -> None:
    rng = np.random.default_rng(8)
    truth = scene(drawn(40, 7), rng, noise=2)
    found = truth.found.copy()
    found[..., :2] += (rng.random(found.shape[:2]) < 0.6)[..., None] * rng.normal(0, 60, (*found.shape[:2], 2))
    together = estimate_pose.estimate_poses(CAMERA, found)
    alone = [estimate_pose.estimate_poses(CAMERA, found[i : i + 1]) for i in range(40)]
    assert [pose.refusal[0] for pose in alone] == list(together.refusal)
    assert [pose.flags[0] for pose in alone] == list(together.flags)
    assert np.concatenate([pose.position for pose in alone]) == pytest.approx(together.position, abs=1e-6, nan_ok=True)


@pytest.mark.parametrize("ground", [Ground(), Ground(slope=(0.02, -0.01)), None], ids=["level", "slope", "unknown"])
def test_images_of_different_cameras_have_the_same_poses_together_and_alone(ground: Ground | None) -> None:
    rng = np.random.default_rng(9)
    moved = replace(
        CAMERA,
        T_camera_world=CAMERA.T_camera_world @ np.array([[1, 0, 0, 3.0], [0, 1, 0, -2], [0, 0, 1, 1], [0, 0, 0, 1]]),
    )
    longer = replace(CAMERA, K=CAMERA.K * [[1.3], [1.25], [1.0]])
    bent = replace(CAMERA, distortion=Distortion("brown", (-0.12, 0.01, 0.001, -0.001)))
    images = []
    for number, camera in enumerate((CAMERA, longer, bent, moved)):
        found = scene(drawn(6, number), rng, noise=2, camera=camera if number < 3 else CAMERA).found
        found[..., :2] += (rng.random(found.shape[:2]) < 0.4)[..., None] * rng.normal(0, 60, (*found.shape[:2], 2))
        sigma, cut = np.full(len(found), 1.0 + number), rng.random(len(found)) < 0.5
        images.append(estimate_pose.VehicleKeypoints(camera, found, sigma, cut))
    images.insert(
        2, replace(images[0], points=np.zeros((0, keypoints.K, 3)), sigma_px=np.zeros(0), cut=np.zeros(0, bool))
    )
    together = estimate_pose.poses_of_images(images, ground)
    assert [len(poses) for poses in together] == [6, 6, 0, 6, 6]
    for image, poses in zip(images, together, strict=True):
        alone = estimate_pose.estimate_poses(
            image.camera, image.points, sigma_px=image.sigma_px, ground=ground, cut=image.cut
        )
        assert alone.refusal == poses.refusal
        assert alone.flags == poses.flags
        assert poses.T_world_vehicle == pytest.approx(alone.T_world_vehicle, abs=1e-6, nan_ok=True)
        assert poses.covariance == pytest.approx(alone.covariance, rel=1e-4, abs=1e-9, nan_ok=True)
