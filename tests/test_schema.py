from typing import Any

import numpy as np
import pytest

from skope import keypoints, schema
from skope.errors import UserError
from skope.schema import Annotation, AnnotationFile, Box3D, Image, Result, RoadUser, RoadUserResult
from tests.samples import make_annotation, make_image, make_road_user


def annotation(**changes: Any) -> Annotation:
    values = {"id": 1, "image_id": 1, "bbox": [0, 0, 10, 5], "keypoints": np.zeros((33, 3)), "area": 50}
    return Annotation(**(values | changes))


def with_point(*xyv: float) -> np.ndarray:
    points = np.zeros((33, 3))
    points[4] = xyv
    return points


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"id": -1}, "id: expected a whole number from 0, got -1"),
        ({"id": True}, "id: expected a whole number"),
        ({"image_id": 1.5}, "image_id: expected a whole number"),
        ({"category_id": "car"}, "category_id: expected a whole number from 0, got 'car'"),
        ({"track_id": "a"}, "track_id: expected a whole number from 0, got 'a'"),
        ({"iscrowd": 2}, "iscrowd: expected 0 or 1, got 2"),
        ({"bbox": [1, 2, 3]}, "bbox: expected 4 numbers, got 3"),
        ({"bbox": [0, 0, -1, 5]}, "bbox: width and height must not be negative"),
        ({"bbox": [0, 0, float("inf"), 5]}, "bbox: not all numbers are finite"),
        ({"bbox": None}, "bbox"),
        ({"bbox_visible": ["a"] * 4}, "bbox_visible: expected numbers"),
        ({"keypoints": np.zeros((17, 3))}, "keypoints: expected 33 x 3 numbers, got 51"),
        ({"keypoints": with_point(1, 1, 3)}, "keypoints: v is 0, 1 or 2"),
        ({"keypoints": with_point(float("nan"), 1, 2)}, "keypoints: not all numbers are finite"),
        ({"keypoints_3d": np.zeros((33, 2))}, "keypoints_3d: expected 33 x 3 numbers, got 66"),
        ({"velocity": [1.0]}, "velocity: expected 3 numbers, got 1"),
        ({"area": -1}, "area: expected a number from 0"),
        ({"area": None}, "area: expected a number from 0"),
        ({"area_full": float("nan")}, "area_full: expected a number from 0"),
        ({"distance": "far"}, "distance: expected a number from 0"),
        ({"occlusion": 1.01}, "occlusion: expected a number from 0 to 1"),
        ({"truncation": -0.1}, "truncation: expected a number from 0 to 1"),
        ({"vehicle_type": "tank"}, "vehicle_type: 'tank' is not one of city_car, "),
        ({"color": "mauve"}, "color: 'mauve' is not one of white, "),
        ({"ignore_reason": "ugly"}, "ignore_reason: 'ugly' is not one of occluded, sliver, small, unseen"),
    ],
)
def test_an_annotation_out_of_range_names_the_field(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        annotation(**changes)
    assert str(caught.value).startswith(said)


def test_an_annotation_knows_its_labels() -> None:
    vehicle = make_annotation(1, 1, (0, 0, 50, 20), hidden=3)
    assert vehicle.num_keypoints == 33
    assert not vehicle.ignored
    assert annotation(keypoints=with_point(1, 1, 1)).num_keypoints == 1
    assert annotation(iscrowd=1, ignore_reason="small").ignored


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"width": 0}, "width: expected a whole number from 1"),
        ({"file_name": ""}, "file_name: expected a path inside the dataset folder"),
        ({"file_name": "/etc/passwd"}, "file_name: expected a path inside"),
        ({"file_name": "images/../../secret.jpg"}, "file_name: expected a path inside"),
        ({"depth_file_name": "../depth.png"}, "depth_file_name: expected a path inside"),
        ({"weather": "hail"}, "weather: 'hail' is not one of clear, cloudy, overcast, rain, after_rain, fog"),
    ],
)
def test_an_image_out_of_range_names_the_field(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError) as caught:
        Image(**({"id": 1, "file_name": "a.jpg", "width": 4, "height": 3} | changes))
    assert str(caught.value).startswith(said)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"size_lwh": [4, 0, 1]}, "box_3d.size_lwh: expected three positive lengths"),
        ({"center": [1, 2]}, "box_3d.center: expected 3 numbers, got 2"),
        ({"R": [1, 2]}, "box_3d.R: expected 3 x 3 numbers, got 2"),
    ],
)
def test_a_box_out_of_range_names_the_field(changes: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        Box3D(**({"center": [0, 0, 0], "size_lwh": [4, 2, 1], "yaw": 0.0, "R": np.eye(3)} | changes))


@pytest.mark.parametrize("score", [-0.1, 1.1, float("nan"), "high", True, None])
def test_a_score_out_of_range_is_refused(score: Any) -> None:
    with pytest.raises(UserError, match="score: expected a number from 0 to 1"):
        Result(image_id=1, score=score, bbox=np.zeros(4), keypoints=np.zeros((33, 3)))


def test_vehicles_are_grouped_by_image_in_file_order() -> None:
    vehicles = tuple(make_annotation(i, image_id, (0, 0, 9, 9)) for i, image_id in ((5, 2), (3, 1), (4, 2)))
    groups = AnnotationFile(images=tuple(make_image(i) for i in (1, 2, 3)), annotations=vehicles).by_image()
    assert {image: [a.id for a in found] for image, found in groups.items()} == {1: [3], 2: [5, 4], 3: []}


def test_the_category_is_what_coco_readers_expect() -> None:
    category = schema.category()
    assert category["id"] == 1
    assert category["keypoints"] == list(keypoints.NAMES)
    assert min(min(edge) for edge in category["skeleton"]) == 1
    assert max(max(edge) for edge in category["skeleton"]) == 33
    assert len(category["keypoint_sigmas"]) == 33


@pytest.mark.parametrize("category_id", [0, 1, 5, True, 2.5, "pedestrian", None])
def test_a_road_user_is_of_one_of_three_categories(category_id: Any) -> None:
    said = r"category_id: expected 2 \(bicycle\), 3 \(motorcycle\) or 4 \(pedestrian\), got "
    with pytest.raises(UserError, match=said):
        RoadUser(id=1, image_id=1, category_id=category_id, bbox=np.zeros(4), area=0)
    with pytest.raises(UserError, match=said):
        RoadUserResult(image_id=1, category_id=category_id, bbox=np.zeros(4), score=0.5)


def test_road_users_are_checked_as_vehicles_are() -> None:
    values: dict[str, Any] = {"id": 1, "image_id": 1, "category_id": 4, "bbox": [0, 0, 1, 1], "area": 1}
    for change, said in (
        ({"bbox": [0, 0, -1, 5]}, "bbox: width and height must not be negative"),
        ({"occlusion": 1.5}, "occlusion: expected a number from 0 to 1"),
        ({"velocity": [1.0]}, "velocity: expected 3 numbers, got 1"),
        ({"ignore_reason": "ugly"}, "ignore_reason: 'ugly' is not one of"),
    ):
        with pytest.raises(UserError, match=said):
            RoadUser(**(values | change))
    with pytest.raises(UserError, match="score: expected a number from 0 to 1"):
        RoadUserResult(image_id=1, category_id=2, bbox=np.zeros(4), score=1.5)
    assert [RoadUser(**(values | {"category_id": k})).category for k in (2, 3, 4)] == [
        "bicycle",
        "motorcycle",
        "pedestrian",
    ]


def test_a_file_names_the_categories_that_it_has() -> None:
    images, user = (make_image(1),), make_road_user(1, 1, (0, 0, 9, 9), "bicycle")
    file = AnnotationFile(
        images=images, annotations=(), road_users=(user,), categories=("vehicle", "pedestrian", "bicycle")
    )
    assert file.categories == ("vehicle", "bicycle", "pedestrian")  # by their ids
    assert file.road_users_by_image() == {1: [user]}
    assert file.by_image() == {1: []}
    assert AnnotationFile(images=images, annotations=()).categories == ("vehicle",)
    for categories, said in (
        (("vehicle", "pedestrian"), "categories: road user 1 is a bicycle, which is not among them"),
        (("bicycle",), "categories: expected vehicle among bicycle"),
        (("vehicle", "tram"), "categories: 'tram' is not one of vehicle, bicycle, motorcycle, pedestrian"),
    ):
        with pytest.raises(UserError, match=said):
            AnnotationFile(images=images, annotations=(), road_users=(user,), categories=categories)


def test_categories_without_keypoints_have_what_coco_readers_ask_for() -> None:
    rows = schema.category_rows(("vehicle", "motorcycle", "pedestrian"))
    assert rows[0] == schema.category()
    assert rows[1:] == [
        {"id": 3, "name": "motorcycle", "supercategory": "vehicle", "keypoints": [], "skeleton": []},
        {"id": 4, "name": "pedestrian", "supercategory": "person", "keypoints": [], "skeleton": []},
    ]
