import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pycocotools import mask as coco_mask

from skope import keypoints
from skope.camera.model import Camera
from skope.errors import UserError
from skope.gen.labels.annotate import annotate
from skope.gen.labels.ignore_rules import Rules, occluded_by_others
from skope.gen.labels.image_extent import _segmentation, bbox_of
from skope.gen.labels.visibility import behind
from skope.gen.labels.world_keypoints import world_keypoints
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import SKY_ID, STATIC_ID, RenderedFrame, Silhouette
from skope.gen.scene.recording import Recording, RecordingPlan
from skope.gen.simulation.simulate import simulate
from skope.gen.towns.sites import site
from skope.schema import Annotation
from tests.gen.rays import cast, vehicle_triangles
from tests.gen.scenes import driven, standing

K = keypoints.K
CAMERA = Camera.looking([0, -9, 6.5], yaw=np.pi / 2, pitch_down=0.35, size=(640, 360), fov=np.radians(80))


def wall(camera: Camera, distance: float, number: int = STATIC_ID) -> RenderedFrame:
    """A view of a wall across the optical axis."""
    shape = (camera.height, camera.width)
    return RenderedFrame(
        np.zeros((*shape, 3), np.uint8),
        np.full(shape, distance, np.float32),
        np.zeros((*shape, 2), np.float32),
        np.full(shape, number, np.int32),
        (),
        np.zeros(0),
    )


def test_points_behind_and_before_a_wall() -> None:
    camera = Camera.looking([0, 0, 0], yaw=0, pitch_down=0, size=(640, 360))
    # Camera looks along x; pixel centres nearest to the axis are 0.7 px off, which changes distances by micrometres.
    gap, ids = behind(wall(camera, 20.0), camera, np.array([[20.03, 0, 0], [20.3, 0, 0], [19.0, 0, 0], [-5, 0, 0]]))
    np.testing.assert_allclose(gap[:, :3], np.tile([0.03, 0.3, -1.0], (4, 1)), atol=1e-3)
    assert np.isnan(gap[:, 3]).all()
    assert ids.tolist() == [[0, 0, 0, -2]] * 4


def test_distances_are_compared_not_depths() -> None:
    """At the corner of 110 degrees a point 0.3 m behind the wall along its ray is 0.16 m deeper than it."""
    camera = Camera.looking([0, 0, 0], yaw=0, pitch_down=0, size=(1920, 1080))
    ray = camera.unproject([[1900.5, 20.5]], [1.0])[0][0]
    length = np.linalg.norm(ray)
    assert length > 1.85
    gap, _ = behind(wall(camera, 20.0), camera, (ray * (20.0 * length + 0.3) / length)[None])
    assert gap[0, 0] == pytest.approx(0.3, abs=1e-3)


def test_sky_hides_nothing() -> None:
    camera = Camera.looking([0, 0, 0], yaw=0, pitch_down=0, size=(640, 360))
    gap, _ = behind(wall(camera, math.inf, SKY_ID), camera, np.array([[1e4, 0, 0]]))
    assert gap[0, 0] == -math.inf


def test_slope_allows_for_the_offset_between_pixel_centre_and_point() -> None:
    """A road seen at a grazing angle: its depth changes by a metre a pixel, its points are still on it."""
    camera = Camera.looking([0, 0, 6.0], yaw=0, pitch_down=0, size=(640, 360))
    rows = np.arange(360) + 0.5
    down = (rows - 180) / camera.K[1, 1]
    depth = np.where(down > 0, 6.0 / np.where(down > 0, down, 1), np.inf)
    inverse_slope = np.where(down > 0, 1 / camera.K[1, 1] / 6.0, 0)
    view = wall(camera, 1.0)
    slope_down = np.where(down > 0, -inverse_slope * np.where(down > 0, depth, 0) ** 2, 0)
    tilted = RenderedFrame(
        view.rgb,
        np.tile(depth[:, None], (1, 640)).astype(np.float32),
        np.stack([np.zeros((360, 640)), np.tile(slope_down[:, None], (1, 640))], -1).astype(np.float32),
        view.ids,
        (),
        view.contrast,
    )
    rng = np.random.default_rng(0)
    points = np.stack([rng.uniform(20, 90, 500), rng.uniform(-15, 15, 500), np.zeros(500)], axis=1)
    gap, _ = behind(tilted, camera, points)
    assert np.nanmax(gap[0]) < 0.05
    below = points - np.array([0, 0, 0.5])
    assert (behind(tilted, camera, below)[0][0] > 0.05).mean() > 0.9
    bare = RenderedFrame(view.rgb, tilted.depth, np.zeros_like(tilted.slope), view.ids, (), view.contrast)
    assert (behind(bare, camera, points)[0][0] > 0.05).mean() > 0.3


def test_rule_others_by_hand() -> None:
    hidden, inside = np.zeros((4, K), bool), np.ones((4, K), bool)
    hidden[0, :16] = True  # 16 of 33: not more than half
    hidden[1, :17] = True
    inside[2, 10:] = False
    hidden[2, :5] = True  # 5 of 10
    inside[3, 10:] = False
    hidden[3, :6] = True
    assert occluded_by_others(hidden, inside).tolist() == [False, True, False, True]


@cache
def scene(hide: str) -> tuple[Recording, RenderedFrame]:
    """A sedan whose pixels are replaced by a near wall (`static`) or not at all."""
    recording = standing(CAMERA, [("sedan", 0.0, 6.0, 0.3)])
    view = make_renderer("pybullet", recording).render(0)
    if hide == "static":
        rows, columns = np.nonzero(view.ids == 1)
        cut = np.quantile(columns, 0.8)
        depth, ids = view.depth.copy(), view.ids.copy()
        covered = np.zeros_like(ids, bool)
        covered[rows.min() - 3 : rows.max() + 4, : int(cut)] = True
        depth[covered], ids[covered] = 3.0, STATIC_ID
        view = RenderedFrame(view.rgb, depth, np.zeros_like(view.slope), ids, view.silhouettes, view.contrast)
    return recording, view


def test_a_car_in_full_view_is_ground_truth_by_others_and_may_fall_by_paper() -> None:
    recording, view = scene("nothing")
    (annotation,), tally = annotate(recording.moment(0), view, CAMERA, Rules(), 7)
    assert annotation.image_id == 7
    assert not annotation.ignored
    assert annotation.occlusion == 0
    assert annotation.truncation == 0
    hidden = int((annotation.keypoints[:, 2] == 1).sum())
    assert 10 <= hidden <= 20  # about half of the points are on the far side
    assert tally.occluded_others == 0


def test_a_car_behind_a_wall_is_ignored_by_others_and_removed_by_paper() -> None:
    recording, view = scene("static")
    (annotation,), tally = annotate(recording.moment(0), view, CAMERA, Rules(), 1)
    assert annotation.ignore_reason == "occluded"
    assert annotation.iscrowd == 1
    assert annotation.occlusion > 0.6
    assert tally.ignored == {"occluded": 1}
    removed, tally = annotate(recording.moment(0), view, CAMERA, Rules(occlusion="paper"), 1)
    assert removed == []
    assert (tally.occluded_others, tally.occluded_paper) == (1, 1)


def test_no_visible_pixel_no_annotation() -> None:
    recording, view = scene("nothing")
    ids = np.where(view.ids == 1, STATIC_ID, view.ids)
    hidden = RenderedFrame(view.rgb, view.depth, view.slope, ids, view.silhouettes, view.contrast)
    assert annotate(recording.moment(0), hidden, CAMERA, Rules(), 1)[0] == []


def test_a_point_past_the_edge_of_a_road_user_is_hidden_by_scenery_around_it() -> None:
    recording = standing(CAMERA, [("sedan", 0.0, 6.0, 0.3), ("van", 40.0, 60.0, 0.0)])
    moment, view = recording.moment(0), make_renderer("pybullet", recording).render(0)
    before = annotate(moment, view, CAMERA, Rules(), 1)[0][0].keypoints
    k = int(np.flatnonzero(before[:, 2] == 2)[0])
    column, row = np.floor(before[k, :2]).astype(int)
    for around, v in ((STATIC_ID, 1), (SKY_ID, 2)):
        depth, ids = view.depth.copy(), view.ids.copy()
        # A road user's edge: the point's pixel shows it, and the ray to the point does not meet it.
        depth[row - 1 : row + 2, column - 1 : column + 2] = 3.0 if around == STATIC_ID else np.inf
        ids[row - 1 : row + 2, column - 1 : column + 2] = around
        depth[row, column], ids[row, column] = 3.0, 2
        changed = RenderedFrame(view.rgb, depth, view.slope, ids, view.silhouettes, view.contrast)
        assert annotate(moment, changed, CAMERA, Rules(), 1)[0][0].keypoints[k, 2] == v


@pytest.mark.parametrize(
    ("rules", "contrast", "reason"),
    [
        (Rules(min_box=500), 9.0, "small"),
        (Rules(min_visible=1.0), 9.0, None),
        (Rules(), 0.5, "unseen"),
        (Rules(), 9.0, None),
    ],
)
def test_reasons_to_ignore(rules: Rules, contrast: float, reason: str | None) -> None:
    recording, view = scene("nothing")
    view = RenderedFrame(view.rgb, view.depth, view.slope, view.ids, view.silhouettes, np.array([contrast]))
    (annotation,), _ = annotate(recording.moment(0), view, CAMERA, rules, 1)
    assert annotation.ignore_reason == reason


def test_a_sliver_at_the_image_edge() -> None:
    recording, view = scene("nothing")
    mask = view.silhouettes[0].mask
    wide = np.pad(mask, ((0, 0), (20 * mask.shape[1], 0)), constant_values=True)
    whole = Silhouette(view.silhouettes[0].x - 20 * mask.shape[1], view.silhouettes[0].y, wide)
    cut = RenderedFrame(view.rgb, view.depth, view.slope, view.ids, (whole,), view.contrast)
    (annotation,), _ = annotate(recording.moment(0), cut, CAMERA, Rules(), 1)
    assert annotation.ignore_reason == "sliver"
    assert annotation.truncation is not None
    assert annotation.truncation > 0.5


def test_a_visible_pixel_beyond_the_silhouette_belongs_to_it() -> None:
    recording, view = scene("nothing")
    silhouette = view.silhouettes[0]
    smaller = silhouette.mask.copy()
    rows, columns = np.nonzero(smaller)
    smaller[rows[0], columns[0]] = False
    view = RenderedFrame(
        view.rgb, view.depth, view.slope, view.ids, (Silhouette(silhouette.x, silhouette.y, smaller),), view.contrast
    )
    (annotation,), _ = annotate(recording.moment(0), view, CAMERA, Rules(), 1)
    assert annotation.occlusion == 0
    assert annotation.area_full == annotation.area


def test_segmentation_of_a_crop_is_that_of_the_whole_image() -> None:
    rng = np.random.default_rng(0)
    for _ in range(300):
        width, height = rng.integers(3, 30, 2).tolist()
        w, h = int(rng.integers(1, width + 1)), height if rng.random() < 0.3 else int(rng.integers(1, height + 1))
        x, y = int(rng.integers(0, width - w + 1)), int(rng.integers(0, height - h + 1))
        mask = rng.random((h, w)) < rng.choice([0.1, 0.5, 0.9, 1.0])
        image = np.zeros((height, width), dtype=np.uint8)
        image[y : y + h, x : x + w] = mask
        reference = coco_mask.encode(np.asfortranarray(image))
        assert _segmentation(mask, (x, y), (width, height))["counts"] == reference["counts"].decode()


def test_bbox_of_a_mask() -> None:
    mask = np.zeros((20, 30), bool)
    mask[4:7, 10:15] = True
    assert bbox_of(mask).tolist() == [10, 4, 5, 3]


def test_wheels_of_the_near_side_are_seen_and_those_of_the_far_side_hidden() -> None:
    for yaw in np.radians([0, 15, 30, 45, 60, 75]):
        for turn, near in ((0, "right"), (math.pi, "left")):
            recording = standing(CAMERA, [("sedan", 0.0, 3.0, yaw + turn)])
            view = make_renderer("gl", recording).render(0)
            (annotation,), _ = annotate(recording.moment(0), view, CAMERA, Rules(), 1)
            v = {name: annotation.keypoints[i, 2] for name, i in keypoints.INDEX.items()}
            far = "left" if near == "right" else "right"
            assert (v[f"wheel_front_{near}"], v[f"wheel_rear_{near}"]) == (2, 2), (yaw, near)
            assert (v[f"wheel_front_{far}"], v[f"wheel_rear_{far}"]) == (1, 1), (yaw, near)


@pytest.mark.parametrize(("wheel", "v"), [("wheel_front_right", 2), ("wheel_front_left", 1)])
def test_a_wheel_whose_face_is_beyond_the_images_edge_is_hidden_by_the_body_all_the_same(wheel: str, v: int) -> None:
    recording = standing(CAMERA, [("sedan", 0.0, 3.0, math.radians(30))])
    k, world = keypoints.INDEX[wheel], world_keypoints(recording.moment(0), "rigid")
    (center, _), (face, _) = (CAMERA.project(points[0, k])[0] for points in (world.points, world.tested))
    # The image ends half way between the wheel's centre and the middle of its face.
    edge = CAMERA.width if face > center else 0
    K = CAMERA.K.copy()
    K[0, 2] += edge - (center + face) / 2
    cut = replace(recording, camera=replace(CAMERA, K=K))
    view = make_renderer("gl", cut).render(0)
    (annotation,), _ = annotate(cut.moment(0), view, cut.camera, Rules(), 1)
    pixels, _, _ = cut.camera.project(world.tested[0, k])
    assert not cut.camera.inside(pixels)
    assert annotation.keypoints[k, 2] == v


def test_scenery_hides_a_wheel_whose_face_is_beyond_the_images_edge() -> None:
    """A post that covers the wheel's centre: no ray to the road users would notice it."""
    recording = standing(CAMERA, [("sedan", 0.0, 3.0, math.radians(30))])
    k, world = keypoints.INDEX["wheel_front_right"], world_keypoints(recording.moment(0), "rigid")
    (center, _), (face, _) = (CAMERA.project(points[0, k])[0] for points in (world.points, world.tested))
    edge = CAMERA.width if face > center else 0
    K = CAMERA.K.copy()
    K[0, 2] += edge - (center + face) / 2
    cut = replace(recording, camera=replace(CAMERA, K=K))
    view = make_renderer("gl", cut).render(0)
    (before,), _ = annotate(cut.moment(0), view, cut.camera, Rules(), 1)
    column, row = np.floor(cut.camera.project(world.points[0, k])[0]).astype(int)
    depth, ids = view.depth.copy(), view.ids.copy()
    depth[row - 2 : row + 3, max(column - 2, 0) : column + 3] = 2.0
    ids[row - 2 : row + 3, max(column - 2, 0) : column + 3] = STATIC_ID
    (behind_post,), _ = annotate(cut.moment(0), replace(view, depth=depth, ids=ids), cut.camera, Rules(), 1)
    assert (before.keypoints[k, 2], behind_post.keypoints[k, 2]) == (2, 1)


def agreement(name: str, recording: Recording, frames: Sequence[int]) -> Counter[tuple[str, bool]]:
    """Points within 100 m and beyond by whether v is what a ray to each of them says, and the number of vehicles."""
    renderer, count = make_renderer(name, recording), Counter[tuple[str, bool]]()
    for frame in frames:
        moment, view = recording.moment(frame), renderer.render(frame)
        annotations, _ = annotate(moment, view, recording.camera, Rules(), 1)
        world = world_keypoints(moment, "rigid")
        triangles = [vehicle_triangles(moment, i) for i in range(len(moment.vehicles))]
        tracks = {vehicle.track_id: i for i, vehicle in enumerate(moment.vehicles)}
        for annotation in annotations:
            assert annotation.track_id is not None
            i = tracks[annotation.track_id]
            points = world.tested[i]
            direction = points - recording.camera.position
            distance = np.linalg.norm(direction, axis=1)
            shapes = np.concatenate(triangles_towards(recording.camera.position, triangles, i))
            hits, _ = cast(recording.camera.position, direction / distance[:, None], shapes)
            # Static scenery is not among the triangles: leave out the points that only it hides.
            static = view_shows_static(recording.camera, view, points)
            right = np.where(distance - hits > 0.05, 1, 2) == annotation.keypoints[:, 2]
            use = (annotation.keypoints[:, 2] > 0) & ~static
            count.update(
                ("near" if d < 100 else "far", bool(ok)) for d, ok in zip(distance[use], right[use], strict=True)
            )
        count["vehicles", True] += len(annotations)
    return count


def triangles_towards(position: np.ndarray, triangles: list[np.ndarray], i: int) -> list[np.ndarray]:
    """Those of the vehicles that may stand before the i-th, itself included."""
    away = [t.reshape(-1, 3) - position for t in triangles]
    middles = [a.mean(axis=0) for a in away]
    radii = [np.linalg.norm(a - m, axis=1).max() for a, m in zip(away, middles, strict=True)]
    toward = middles[i] / np.linalg.norm(middles[i])
    spread = [np.arctan2(radius, np.linalg.norm(m)) for m, radius in zip(middles, radii, strict=True)]
    apart = [np.arccos(np.clip(toward @ m / np.linalg.norm(m), -1, 1)) for m in middles]
    return [t for t, angle, wide in zip(triangles, apart, spread, strict=True) if angle < wide + spread[i]]


@pytest.mark.parametrize("name", ["gl", pytest.param("pybullet", marks=pytest.mark.slow)])
def test_visibility_agrees_with_ray_casting(name: str) -> None:
    """At the angular resolution of the default 1920x1080 camera."""
    count = agreement(name, driven("t01_mill_south", fov_deg=50), (0, 3))
    assert count["near", True] + count["near", False] > 250
    assert count["near", True] >= 0.99 * (count["near", True] + count["near", False])


@pytest.mark.slow
def test_visibility_of_200_vehicles_with_the_default_camera() -> None:
    count = Counter[tuple[str, bool]]()
    for name, seed in (("t01_main_west", 3), ("t01_mill_corner", 4), ("t01_mill_south", 5), ("t01_school_lane", 6)):
        plan = RecordingPlan(
            site=site(name), index=0, frames=8, interval=2.0, size=(1920, 1080), fov_deg=110, seed=seed
        )
        count += agreement("gl", simulate(plan), (0, 1, 3, 5, 7))
    print(dict(count))
    assert count["vehicles", True] >= 200
    assert count["near", True] >= 0.99 * (count["near", True] + count["near", False])
    assert count["far", True] >= 0.98 * (count["far", True] + count["far", False])


def view_shows_static(camera: Camera, view: RenderedFrame, points: np.ndarray) -> np.ndarray:
    gap, ids = behind(view, camera, points)
    return np.asarray(((ids == STATIC_ID) & (gap > 0.05)).any(axis=0))


def test_annotations_carry_what_the_recording_knows() -> None:
    recording, view = scene("nothing")
    (annotation,), _ = annotate(recording.moment(0), view, CAMERA, Rules(), 1)
    assert isinstance(annotation, Annotation)
    assert (annotation.model, annotation.vehicle_type, annotation.color) == ("sedan", "sedan", "blue")
    assert annotation.box_3d is not None
    np.testing.assert_allclose(annotation.box_3d.center, [0, 6, 1.45 / 2], atol=1e-9)
    assert annotation.box_3d.yaw == pytest.approx(0.3)
    assert annotation.distance == pytest.approx(np.linalg.norm(np.array([0, 6, 0.725]) - [0, -9, 6.5]))
    assert annotation.keypoints_3d is not None
    pixels, _, _ = CAMERA.project(annotation.keypoints_3d)
    np.testing.assert_allclose(annotation.keypoints[:, :2], pixels, atol=0.006)
    x, y, w, h = annotation.bbox
    inside = (pixels >= [x - 1, y - 1]).all(1) & (pixels <= [x + w + 1, y + h + 1]).all(1)
    assert inside.all()


def test_localizers_agree_on_a_standing_vehicle() -> None:
    recording, view = scene("nothing")
    free = annotate(recording.moment(0), view, CAMERA, Rules(localizer="trilateration"), 1)[0][0]
    rigid = annotate(recording.moment(0), view, CAMERA, Rules(), 1)[0][0]
    np.testing.assert_allclose(free.keypoints_3d, rigid.keypoints_3d, atol=1e-3)
    assert world_keypoints(recording.moment(0), "rigid").difference.max() < 1e-6


@pytest.mark.parametrize(
    "rules", [{"occlusion": "none"}, {"localizer": "guess"}, {"min_visible": 1.5}, {"min_box": -1.0}]
)
def test_bad_rules_are_refused(rules: dict) -> None:
    with pytest.raises(UserError, match="--"):
        Rules(**rules)
