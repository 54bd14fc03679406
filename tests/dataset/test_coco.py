import json
from collections.abc import Callable
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope import keypoints, schema
from skope.camera.model import Camera, Distortion
from skope.dataset import coco
from skope.errors import UserError
from skope.schema import Annotation, AnnotationFile, Box3D, Image, Result, RoadUser, RoadUserResult
from tests.samples import make_annotation, make_image, make_road_user

Document = dict[str, Any]


def full_image() -> Image:
    """Every field is set."""
    return Image(
        id=3,
        file_name="images/t01/00_000001.jpg",
        width=640,
        height=360,
        depth_file_name="depth/t01/00_000001.png",
        town="t01",
        site="t01_a",
        recording="00",
        frame_index=1,
        time_s=0.5,
        split="hard",
        weather="after_rain",
        sun_elevation_deg=-3.25,
        camera=Camera.looking(
            [1, 2, 7],
            yaw=0.7,
            pitch_down=0.3,
            roll=0.02,
            size=(640, 360),
            distortion=Distortion("brown", (-0.1, 0.01, 0.0, 0.0)),
        ),
    )


def full_annotation() -> Annotation:
    """Every field is set, at the digits that are written."""
    rng = np.random.default_rng(5)
    points = np.concatenate([np.round(rng.uniform(0, 300, (33, 2)), 2), rng.integers(1, 3, (33, 1))], axis=1)
    points[7] = 0
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    return Annotation(
        id=11,
        image_id=3,
        bbox=np.array([1.25, 2.5, 300.75, 200.0]),
        keypoints=points,
        area=1234,
        iscrowd=1,
        segmentation={"size": [360, 640], "counts": "abc"},
        track_id=4,
        model="sedan_a",
        vehicle_type="sedan",
        color="red",
        parked=False,
        bbox_visible=np.array([2.0, 3.0, 100.0, 50.5]),
        area_full=2000,
        keypoints_3d=np.round(rng.normal(0, 20, (33, 3)), 4),
        box_3d=Box3D(center=np.array([1.0, 2.0, 0.75]), size_lwh=np.array([4.5, 1.8, 1.5]), yaw=angle, R=turn),
        box_3d_pixels=np.round(rng.uniform(-50, 700, (8, 2)), 2),
        velocity=np.array([3.5, -1.25, 0.0]),
        distance=21.5,
        occlusion=0.25,
        truncation=0.0,
        contrast=7.5,
        articulation=-0.1234,
        ignore_reason="occluded",
    )


def same(a: Any, b: Any) -> bool:
    """Deep equality of records that hold arrays."""
    if hasattr(a, "__dataclass_fields__"):
        return type(a) is type(b) and all(same(getattr(a, f.name), getattr(b, f.name)) for f in fields(a))
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.shape == b.shape and bool(np.array_equal(a, b))
    return bool(a == b)


def test_every_field_comes_back(tmp_path: Path) -> None:
    image, vehicle = full_image(), full_annotation()
    assert all(getattr(image, f.name) is not None for f in fields(image))
    assert all(getattr(vehicle, f.name) is not None for f in fields(vehicle))
    path = tmp_path / "hard.json"
    coco.write(path, AnnotationFile(images=(image,), annotations=(vehicle,), info={"seed": 7}))
    back = coco.read(path)
    assert back.name == "hard"
    assert back.info["seed"] == 7
    assert back.info["keypoint_scheme"] == "skope33"
    for record, other in ((image, back.images[0]), (vehicle, back.annotations[0])):
        for field in fields(record):
            assert same(getattr(record, field.name), getattr(other, field.name)), field.name
    coco.write(tmp_path / "again.json", back)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_fields_that_are_not_known_stay_away(tmp_path: Path) -> None:
    bare = Annotation(id=1, image_id=1, bbox=np.array([0, 0, 4, 2]), keypoints=np.zeros((33, 3)), area=8)
    image = Image(id=1, file_name="a.jpg", width=4, height=3)
    coco.write(tmp_path / "a.json", AnnotationFile(images=(image,), annotations=(bare,)))
    document = json.loads((tmp_path / "a.json").read_text())
    assert set(document["images"][0]) == {"id", "file_name", "width", "height"}
    assert set(document["annotations"][0]) == {
        *("id", "image_id", "category_id", "iscrowd", "bbox", "area", "keypoints", "num_keypoints"),
    }
    assert coco.read(tmp_path / "a.json").annotations[0].keypoints_3d is None


def test_coordinates_are_rounded_and_no_zero_is_negative(tmp_path: Path) -> None:
    vehicle = make_annotation(1, 1, (-0.001, 1.23456, 50, 20))
    coco.write(tmp_path / "a.json", AnnotationFile(images=(make_image(1),), annotations=(vehicle,)))
    text = (tmp_path / "a.json").read_text()
    assert '"bbox":[0.0,1.23,50.0,20.0]' in text
    assert "-0.0," not in text.split('"annotations"')[1]


def test_an_empty_file_is_a_file(tmp_path: Path) -> None:
    coco.write(tmp_path / "a.json", AnnotationFile(images=(), annotations=()))
    back = coco.read(tmp_path / "a.json")
    assert back.images == back.annotations == ()


def test_plain_coco_without_info_or_area_is_read(tmp_path: Path) -> None:
    document = sample(tmp_path / "a.json")
    del document["info"]
    del document["annotations"][0]["area"]
    document["annotations"][0]["attributes"] = {"unknown": 1}
    (tmp_path / "a.json").write_text(json.dumps(document))
    assert coco.read(tmp_path / "a.json").annotations[0].area == 60 * 40


# ------------------------------------------------------------------------------------------------- bad fields


def sample(path: Path) -> Document:
    vehicles = (make_annotation(1, 1, (10, 10, 60, 40)), make_annotation(2, 1, (80, 50, 60, 40)))
    coco.write(path, AnnotationFile(images=(make_image(1), make_image(2)), annotations=vehicles))
    document: Document = json.loads(path.read_text())
    return document


def put(value: Any, *keys: str | int) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        place: Any = document
        for key in keys[:-1]:
            place = place[key]
        place[keys[-1]] = value

    return change


def drop(*keys: str | int) -> Callable[[Document], None]:
    def change(document: Document) -> None:
        place: Any = document
        for key in keys[:-1]:
            place = place[key]
        del place[keys[-1]]

    return change


NAMES = list(keypoints.NAMES)
SWAPPED = [NAMES[1], NAMES[0], *NAMES[2:]]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (drop("images"), "field images is missing or not a list"),
        (put({}, "annotations"), "field annotations is missing or not a list"),
        (drop("categories"), "field categories: expected exactly one category"),
        (put([], "categories"), "field categories: expected exactly one category"),
        (put(NAMES[:17], "categories", 0, "keypoints"), "categories[0].keypoints: expected 33 names, got 17"),
        (drop("categories", 0, "keypoints"), "categories[0].keypoints: expected 33 names, got none"),
        (
            put(SWAPPED, "categories", 0, "keypoints"),
            "categories[0].keypoints[0]: 'roof_front_left' is not scheme skope33's 'roof_front_right'",
        ),
        (put("apollo24", "info", "keypoint_scheme"), "info.keypoint_scheme: 'apollo24' is not one of skope33, skope3d"),
        (drop("images", 1, "width"), "images[1]: field width is missing"),
        (put(-3, "images", 1, "height"), "images[1]: camera size: 160x-3 is not positive"),
        (put("../x.jpg", "images", 0, "file_name"), "images[0]: file_name: expected a path inside the dataset folder"),
        (put(1, "images", 1, "id"), "field images: two images share an id"),
        (drop("images", 0, "camera", "K"), "images[0]: camera: field 'K' is missing"),
        (put([[1, 2], [3, 4]], "images", 0, "camera", "K"), "images[0]: camera.K: expected 3x3 finite numbers"),
        (put("wide", "images", 0, "camera"), "images[0]: camera: "),
        (drop("annotations", 1, "bbox"), "annotations[1]: field bbox is missing"),
        (drop("annotations", 1, "keypoints"), "annotations[1]: field keypoints is missing"),
        (put([1, 2, 3], "annotations", 1, "bbox"), "annotations[1]: bbox: expected 4 numbers, got 3"),
        (put([1], "annotations", 1, "category_id"), "annotations[1]: category_id: expected a whole number from 0"),
        (put([0.0] * 51, "annotations", 1, "keypoints"), "annotations[1]: keypoints: expected 33 x 3 numbers, got 51"),
        (put(3, "annotations", 1, "keypoints", 2), "annotations[1]: keypoints: v is 0, 1 or 2"),
        (put(float("nan"), "annotations", 0, "keypoints", 0), "annotations[0]: keypoints: not all numbers are finite"),
        (put("x", "annotations", 0, "keypoints", 0), "annotations[0]: keypoints: expected numbers"),
        (put(1, "annotations", 1, "id"), "annotations[1]: id 1 stands twice"),
        (put(77, "annotations", 1, "image_id"), "annotations[1]: image_id 77 is not among the images"),
        (put("tank", "annotations", 0, "vehicle_type"), "annotations[0]: vehicle_type: 'tank' is not one of"),
        (put({"yaw": 0}, "annotations", 0, "box_3d"), "annotations[0]: field center is missing"),
        (put("car", "annotations", 0), "annotations[0]: expected an object, got 'car'"),
    ],
)
def test_a_bad_field_is_named(tmp_path: Path, change: Callable[[Document], None], said: str) -> None:
    path = tmp_path / "a.json"
    document = sample(path)
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(UserError) as caught:
        coco.read(path)
    assert str(caught.value).startswith(f"{path}: {said}")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{", "not valid JSON: Expecting property name enclosed in double quotes at line 1"),
        ("[]", "expected a COCO object with images and annotations, got a list"),
        ("\x00", "not valid JSON"),
    ],
)
def test_a_file_that_is_no_coco_is_named(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "a.json"
    path.write_text(text)
    with pytest.raises(UserError) as caught:
        coco.read(path)
    assert str(caught.value).startswith(f"{path}: {said}")


def test_other_things_than_files_are_named(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"gone\.json: no such file"):
        coco.read(tmp_path / "gone.json")
    with pytest.raises(UserError, match="is a folder"):
        coco.read(tmp_path)
    (tmp_path / "binary.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(UserError, match="not UTF-8"):
        coco.read(tmp_path / "binary.json")


# ---------------------------------------------------------------------------------------------------- results


def test_results_come_back_rounded(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    results = tuple(
        Result(image_id=i, score=float(rng.random()), bbox=rng.uniform(0, 99, 4), keypoints=rng.uniform(0, 1, (33, 3)))
        for i in (2, 1)
    )
    path = tmp_path / "results.json"
    coco.write_results(path, results)
    back = coco.read_results(path)
    assert [result.image_id for result in back] == [2, 1]
    for before, after in zip(results, back, strict=True):
        assert after.score == pytest.approx(before.score, abs=1e-6)
        assert np.allclose(after.bbox, before.bbox, atol=0.005)
        assert np.allclose(after.keypoints[:, :2], before.keypoints[:, :2], atol=0.005)
        assert np.allclose(after.keypoints[:, 2], before.keypoints[:, 2], atol=0.00005)
    coco.write_results(path, ())
    assert coco.read_results(path) == ()


def test_a_result_without_a_box_gets_the_extent_of_its_points() -> None:
    points = np.full((33, 3), 0.5)
    points[:, :2] = 20
    points[0, :2], points[1, :2] = (10, 15), (40, 30)
    result = coco.result_from_dict({"image_id": 1, "keypoints": points.ravel().tolist(), "score": 0.5})
    assert result.bbox.tolist() == [10, 15, 30, 15]


def test_points_that_were_not_found_are_no_part_of_the_box() -> None:
    """Bottom-up programs write 0, 0, 0 for them: the box would reach to the image's corner."""
    points = np.zeros((33, 3))
    points[4:8] = [[30, 40, 0.9], [50, 45, 0.2], [35, 70, 0.5], [200, 200, 0]]
    found = coco.result_from_dict({"image_id": 1, "keypoints": points.ravel().tolist(), "score": 0.9})
    assert (found.bbox.tolist(), found.boxed) == ([30, 40, 20, 30], False)
    stated = {"image_id": 1, "keypoints": points.ravel().tolist(), "score": 0.9, "bbox": [1, 2, 3, 4]}
    assert coco.result_from_dict(stated).boxed
    points[:, 2] = 0
    with pytest.raises(UserError, match="bbox: missing, and no keypoint has a score"):
        coco.result_from_dict({"image_id": 1, "keypoints": points.ravel().tolist(), "score": 0.9})


def test_what_was_followed_is_rounded_to_pixels_and_keeps_its_name(tmp_path: Path) -> None:
    points = np.column_stack([np.linspace(10.26, 90.74, 33), np.linspace(5.5, 60.25, 33), np.linspace(0, 1, 33)])
    one = Result(image_id=1, score=0.9, bbox=np.array([1.234, 2.345, 30.456, 40.567]), keypoints=points, track_id=7)
    coco.write_results(tmp_path / "r.json", [one, replace(one, interpolated=True)])
    found, followed = coco.read_results(tmp_path / "r.json")
    assert (found.track_id, followed.track_id) == (7, 7)
    assert np.abs(found.keypoints - points).max() < 0.0051
    assert np.abs(followed.keypoints[:, :2] - points[:, :2]).max() <= 0.5
    assert np.abs(followed.keypoints[:, 2] - points[:, 2]).max() < 0.051
    assert (followed.keypoints[:, :2] % 1 == 0).all()
    with pytest.raises(UserError, match="track_id"):
        replace(one, track_id=-1)


# ------------------------------------------------------------------------------------------------- road users

ALL = schema.CATEGORY_NAMES


def full_road_user() -> RoadUser:
    """Every field is set: those that it shares with `full_annotation` as there."""
    vehicle = full_annotation()
    shared = {name: getattr(vehicle, name) for name in RoadUser.__dataclass_fields__ if name != "category_id"}
    return RoadUser(**(shared | {"id": 12, "category_id": 3}))


def mixed() -> AnnotationFile:
    """Two images with a vehicle and two others each, in an order that is not that of the images."""
    vehicles = (make_annotation(2, 2, (10, 10, 60, 40)), make_annotation(1, 1, (80, 50, 60, 40)))
    others = (
        make_road_user(6, 2, (5, 5, 8, 20)),
        make_road_user(3, 1, (1, 2, 8, 20), "bicycle"),
        make_road_user(4, 1, (30, 2, 8, 20), "motorcycle", iscrowd=1),
    )
    images = (make_image(1), make_image(2), make_image(3))
    return AnnotationFile(images=images, annotations=vehicles, road_users=others, categories=ALL)


def test_the_order_of_fields_names_them_all() -> None:
    assert set(coco._ANNOTATION_FIELDS) == set(Annotation.__dataclass_fields__)
    assert set(coco._ROAD_USER_FIELDS) == set(RoadUser.__dataclass_fields__)


def test_every_field_of_a_road_user_comes_back(tmp_path: Path) -> None:
    user, path = full_road_user(), tmp_path / "hard.json"
    assert all(getattr(user, f.name) is not None for f in fields(user))
    file = AnnotationFile(images=(full_image(),), annotations=(full_annotation(),), road_users=(user,), categories=ALL)
    coco.write(path, file)
    back = coco.read(path)
    assert back.categories == ALL
    assert same(back.annotations[0], full_annotation())
    for field in fields(user):
        assert same(getattr(user, field.name), getattr(back.road_users[0], field.name)), field.name
    coco.write(tmp_path / "again.json", back)
    assert (tmp_path / "again.json").read_bytes() == path.read_bytes()


def test_rows_stand_by_image_and_vehicles_come_first(tmp_path: Path) -> None:
    coco.write(tmp_path / "a.json", mixed())
    rows = json.loads((tmp_path / "a.json").read_text())["annotations"]
    assert [(row["image_id"], row["category_id"], row["id"]) for row in rows] == [
        *((1, 1, 1), (1, 2, 3), (1, 3, 4)),
        *((2, 1, 2), (2, 4, 6)),
    ]
    assert all(row["keypoints"] == [0] * 99 and row["num_keypoints"] == 0 for row in rows if row["category_id"] > 1)
    back = coco.read(tmp_path / "a.json")
    assert [user.id for user in back.road_users] == [3, 4, 6]
    assert [vehicle.id for vehicle in back.annotations] == [1, 2]


def test_files_of_vehicles_alone_have_one_category_and_its_bytes(tmp_path: Path) -> None:
    file = mixed()
    coco.write(tmp_path / "a.json", replace(file, road_users=(), categories=("vehicle",)))
    coco.write(tmp_path / "b.json", AnnotationFile(images=file.images, annotations=file.annotations))
    assert (tmp_path / "a.json").read_bytes() == (tmp_path / "b.json").read_bytes()
    document = json.loads((tmp_path / "a.json").read_text())
    assert document["categories"] == [schema.category()]
    assert [row["id"] for row in document["annotations"]] == [2, 1]  # in file order


def test_labelled_categories_are_named_though_nobody_is_there(tmp_path: Path) -> None:
    coco.write(tmp_path / "a.json", replace(mixed(), road_users=()))
    assert coco.read(tmp_path / "a.json").categories == ALL


def test_pycocotools_reads_and_draws_what_is_written(tmp_path: Path) -> None:
    coco_api = pytest.importorskip("pycocotools.coco")
    coco.write(tmp_path / "a.json", mixed())
    truth = coco_api.COCO(str(tmp_path / "a.json"))
    assert {row["id"]: row["name"] for row in truth.loadCats(truth.getCatIds())} == dict(enumerate(ALL, start=1))
    assert truth.getAnnIds(catIds=[4]) == [6]
    results = [RoadUserResult(image_id=2, category_id=4, bbox=np.array([5, 5, 8, 20]), score=0.75)]
    coco.write_results(tmp_path / "r.json", results)
    assert truth.loadRes(str(tmp_path / "r.json")).loadAnns([1])[0]["area"] == 160


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            put("person", "categories", 3, "name"),
            "field categories: expected exactly one category, or the first of 1 v",
        ),
        (put(7, "categories", 3, "id"), "field categories: expected exactly one category, or the first of 1 vehicle"),
        (put(2, "categories", 0, "id"), "field categories: expected exactly one category, or the first of 1 vehicle"),
        (lambda d: d["categories"].append(d["categories"][1]), "field categories: a category stands twice"),
        (put("a", "categories", 1), "field categories: expected exactly one category"),
        (put(9, "annotations", 1, "category_id"), "annotations[1]: category_id: 9 is none of the file's categories"),
        (lambda d: d["categories"].pop(), "annotations[4]: category_id: 4 is none of the file's categories"),
        (put(1, "annotations", 1, "id"), "annotations[1]: id 1 stands twice"),
        (put(77, "annotations", 1, "image_id"), "annotations[1]: image_id 77 is not among the images"),
        (drop("annotations", 1, "bbox"), "annotations[1]: field bbox is missing"),
        (put(-2.0, "annotations", 1, "distance"), "annotations[1]: distance: expected a number from 0"),
    ],
)
def test_a_bad_field_of_a_road_user_is_named(tmp_path: Path, change: Callable[[Document], None], said: str) -> None:
    path = tmp_path / "a.json"
    coco.write(path, mixed())
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))
    with pytest.raises(UserError) as caught:
        coco.read(path)
    assert str(caught.value).startswith(f"{path}: {said}")


def test_somebody_elses_only_category_is_the_vehicle_whatever_its_number(tmp_path: Path) -> None:
    document = sample(tmp_path / "a.json")
    document["categories"][0] |= {"id": 4, "name": "car"}
    for row in document["annotations"]:
        row["category_id"] = 4
    (tmp_path / "a.json").write_text(json.dumps(document))
    back = coco.read(tmp_path / "a.json")
    assert ([a.category_id for a in back.annotations], back.road_users, back.categories) == ([4, 4], (), ("vehicle",))


def test_results_of_both_kinds_come_back_in_their_order(tmp_path: Path) -> None:
    car = Result(image_id=1, score=0.5, bbox=np.array([1.0, 2, 3, 4]), keypoints=np.full((33, 3), 0.5), category_id=3)
    walker = RoadUserResult(image_id=1, score=0.25, bbox=np.array([1.234, 2, 3, 4]), category_id=4, track_id=8)
    followed = replace(walker, interpolated=True)
    path = tmp_path / "results.json"
    coco.write_results(path, [walker, car, followed])
    rows = json.loads(path.read_text())
    assert rows[0] == {"image_id": 1, "category_id": 4, "bbox": [1.23, 2.0, 3.0, 4.0], "score": 0.25, "track_id": 8}
    assert rows[2]["bbox"] == [1.2, 2.0, 3.0, 4.0]
    assert [type(result) for result in coco.iter_all_results(path)] == [RoadUserResult, Result, RoadUserResult]
    assert [result.category_id for result in coco.read_results(path)] == [3]
    assert [result.interpolated for result in coco.read_road_user_results(path)] == [False, True]
    assert coco.read_road_user_results(path)[0].track_id == 8


def test_boxes_of_other_programs_are_no_road_users() -> None:
    """COCO's own category 3 is the car; where files are said to be others' a result without keypoints is a mistake."""
    row = {"image_id": 1, "category_id": 3, "bbox": [1, 2, 3, 4], "score": 0.5}
    assert isinstance(coco.any_result_from_dict(row), RoadUserResult)
    for other, foreign, error in ((row, "apollo24", KeyError), (row | {"category_id": 1}, None, UserError)):
        with pytest.raises(error, match="keypoints"):
            coco.any_result_from_dict(other, foreign)


def test_boxes_alone_with_the_category_numbers_of_skope_or_of_coco(tmp_path: Path) -> None:
    path = tmp_path / "boxes.json"
    box = {"bbox": [1, 2, 3, 4], "score": 0.5}
    path.write_text(json.dumps([{"image_id": number, "category_id": number, **box} for number in range(1, 11)]))
    found = dict(coco.numbered_results(path, "coco"))
    assert {number + 1: result.category_id for number, result in found.items()} == {1: 4, 2: 2, 3: 1, 4: 3, 6: 1, 8: 1}
    assert all(result.image_id == number + 1 for number, result in found.items())
    assert [result.image_id for result in coco.read_results(path, "coco")] == [3, 6, 8]
    assert not any(result.keypoints.any() for result in coco.read_results(path, "coco"))
    path.write_text(json.dumps([{"image_id": 1, "category_id": number, **box} for number in (1, 2, 4)]))
    kinds = [(type(result), result.category_id) for result in coco.iter_all_results(path, "boxes")]
    assert kinds == [(Result, 1), (RoadUserResult, 2), (RoadUserResult, 4)]
    path.write_text(json.dumps([{"image_id": 1, "category_id": 1, "score": 0.5}]))
    with pytest.raises(UserError, match=r"boxes\.json: results\[0\]: field bbox is missing"):
        coco.read_results(path, "boxes")
