"""Labels of people on foot and on two wheels, against what is worked out from rendered ids by brute force."""

import itertools
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from pycocotools import mask as coco_mask

from skope.camera.model import Camera
from skope.gen.bystanders import bystander
from skope.gen.bystanders.luggage import LUGGAGE_KINDS
from skope.gen.bystanders.people import Look
from skope.gen.labels.annotate import annotate, annotate_road_users
from skope.gen.labels.ignore_rules import Rules
from skope.gen.render.choose_renderer import make_renderer
from skope.gen.render.frame import RenderedFrame
from skope.gen.scene.recording import RecordedVehicle, Recording
from skope.schema import RoadUser
from tests.gen.scenes import pose, standing

CAMERA = Camera.looking((0.0, 0.0, 4.0), yaw=0.0, pitch_down=0.2, size=(640, 360), fov=0.9)
FIGURES = (
    ("pedestrian", {"load": float(LUGGAGE_KINDS.index("umbrella"))}, (10.0, 2.4, 0.4)),
    ("cyclist", {"load": float(LUGGAGE_KINDS.index("trailer")), "helmet": 1.0}, (12.0, 0.2, 1.9)),
    ("motorcyclist", {"passenger": 1.0, "machine": 1.0}, (9.0, -1.6, -0.7)),
    ("pedestrian", {}, (15.8, -3.0, math.pi)),  # behind the car
    ("pedestrian", {}, (8.0, -3.9, 2.0)),  # half outside the image
    ("cyclist", {}, (150.0, 0.0, 0.0)),  # far away
)
CARS = [("sedan", 14.0, -3.0, math.pi / 2)]


def scene(
    figures: tuple[tuple[str, dict[str, float], tuple[float, float, float]], ...],
    cars: list[tuple[str, float, float, float]],
) -> Recording:
    """One frame of cars and of jointed people, who are numbered against the order in which they stand."""
    recording = standing(CAMERA, cars)
    bodies = [bystander.build_bystander(kind, Look(jointed=1.0, **numbers).to_dict()) for kind, numbers, _ in figures]
    chassis = np.array([pose(*place) for _, _, place in figures]).reshape(-1, 4, 4)
    parts = [T @ body.pose(0.35) for T, body in zip(chassis, bodies, strict=True)]
    rest = [np.concatenate([p[4:], np.tile(np.eye(4), (7 - len(p), 1, 1))]) for p in parts]
    count = len(cars) + len(figures)
    return replace(
        recording,
        vehicles=(
            *recording.vehicles,
            *(
                RecordedVehicle(100 - i, body.kind, body.look.to_dict(), "black", labelled=False)
                for i, body in enumerate(bodies)
            ),
        ),
        frame=np.zeros(count, dtype=np.int32),
        vehicle=np.arange(count, dtype=np.int32),
        T_world_chassis=np.concatenate([recording.T_world_chassis, chassis]),
        T_world_wheels=np.concatenate(
            [recording.T_world_wheels, np.array([p[:4] for p in parts]).reshape(-1, 4, 4, 4)]
        ),
        T_world_trailer=np.concatenate([recording.T_world_trailer, np.array(rest).reshape(-1, 3, 4, 4)]),
        velocity=np.tile([1.0, 2.0, 0.0], (count, 1)),
        lamps=np.zeros(count, dtype=np.uint8),
        road_users=True,
    )


@cache
def rendered(renderer: str) -> tuple[Recording, RenderedFrame]:
    recording = scene(FIGURES, CARS)
    return recording, make_renderer(renderer, recording).render(0)


def alone(renderer: str, i: int) -> np.ndarray:
    """(H, W) the pixels of one of `FIGURES` with nobody else there; scenery stands before none of them."""
    return np.asarray(make_renderer(renderer, scene((FIGURES[i],), [])).render(0).ids == 1)


def labels(renderer: str, rules: Rules | None = None) -> dict[int, RoadUser]:
    """By place in `FIGURES`."""
    recording, view = rendered(renderer)
    found = annotate_road_users(recording.moment(0), view, CAMERA, rules or Rules(), 7, first_id=3)
    assert [user.id for user in found] == list(range(3, 3 + len(found)))
    assert [user.track_id for user in found] == sorted(user.track_id or 0 for user in found)
    assert {user.image_id for user in found} == {7}
    return {100 - (user.track_id or 0): user for user in found}


def tight(mask: np.ndarray) -> list[float]:
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    return [columns[0], rows[0], columns[-1] - columns[0] + 1, rows[-1] - rows[0] + 1]


@pytest.mark.parametrize("renderer", ["gl", pytest.param("pybullet", marks=pytest.mark.slow)])
def test_boxes_and_masks_are_those_of_the_ids(renderer: str) -> None:
    _, view = rendered(renderer)
    found = labels(renderer)
    assert set(found) >= {0, 1, 2, 4}
    for i, user in found.items():
        visible = view.ids == i + 2  # the car is the first
        assert user.bbox_visible.tolist() == tight(visible)
        assert user.area == visible.sum()
        rle = {**user.segmentation, "counts": user.segmentation["counts"].encode()}
        assert np.array_equal(coco_mask.decode(rle).astype(bool), visible)
        whole = alone(renderer, i)
        assert user.bbox.tolist() == tight(whole)
        assert user.area_full == whole.sum()
        assert user.occlusion == pytest.approx(1 - visible.sum() / whole.sum())


@pytest.mark.parametrize("renderer", ["gl", pytest.param("pybullet", marks=pytest.mark.slow)])
def test_categories_and_what_is_known_of_the_body(renderer: str) -> None:
    recording, _ = rendered(renderer)
    found = labels(renderer)
    assert [found[i].category for i in (0, 1, 2)] == ["pedestrian", "bicycle", "motorcycle"]
    for i, user in found.items():
        _, _, (x, y, yaw) = FIGURES[i]
        box = user.box_3d
        assert box is not None
        assert box.yaw == pytest.approx(math.remainder(yaw, 2 * math.pi))
        assert np.hypot(*(box.center[:2] - [x, y])) < 1.1  # a trailer is drawn behind
        assert user.distance == pytest.approx(np.linalg.norm(box.center - CAMERA.position))
        assert user.velocity.tolist() == [1.0, 2.0, 0.0]
        assert 0.05 < user.truncation < 0.6 if i == 4 else user.truncation == 0
        if not user.truncation and not user.ignored:  # limbs reach a little out of the box at rest
            corners = np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * box.size_lwh @ box.R.T + box.center
            pixels, _, _ = CAMERA.project(corners)
            low, high = user.bbox[:2], user.bbox[:2] + user.bbox[2:]
            assert (pixels.min(axis=0) - 9 < low).all()
            assert (pixels.max(axis=0) + 9 > high).all()
            assert (pixels.max(axis=0) - pixels.min(axis=0) < 1.7 * user.bbox[2:]).all()
    length, width, height = found[1].box_3d.size_lwh
    assert (2.5 < length < 3.5, 0.5 < width < 1.0, 1.6 < height < 2.0) == (True, True, True)  # with its trailer
    assert 1.6 < found[0].box_3d.size_lwh[2] < 2.2  # with the umbrella
    body = bystander.build_bystander(recording.vehicles[3].model, recording.vehicles[3].shape)
    assert found[2].box_3d.size_lwh == pytest.approx(np.diff(body.box, axis=0)[0])


def test_what_is_ignored_and_why() -> None:
    found = labels("gl")
    reasons = {i: user.ignore_reason for i, user in found.items()}
    assert reasons[0] is reasons[1] is reasons[2] is None
    assert reasons[3] == "occluded"  # more than half of the pixels
    assert found[3].occlusion > 0.5
    assert reasons[5] == "small"
    assert all(user.iscrowd == (user.ignore_reason is not None) for user in found.values())
    assert labels("gl", Rules(min_box=81))[2].ignore_reason == "small"
    assert labels("gl", Rules(min_visible=0.95))[4].ignore_reason == "sliver"
    recording, view = rendered("gl")
    dark = replace(view, contrast=np.full_like(view.contrast, 0.5))
    unseen = annotate_road_users(recording.moment(0), dark, CAMERA, Rules(), 1, 1)
    assert "unseen" in {user.ignore_reason for user in unseen}


def test_vehicles_are_labelled_as_without_them() -> None:
    recording, view = rendered("gl")
    (car,), tally = annotate(recording.moment(0), view, CAMERA, Rules(), 1)
    assert (car.track_id, tally.vehicles) == (1, 1)
    hidden = replace(view, ids=np.where(view.ids > 1, 0, view.ids))
    assert annotate_road_users(recording.moment(0), hidden, CAMERA, Rules(), 1, 1) == []
