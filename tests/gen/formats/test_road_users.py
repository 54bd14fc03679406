"""People on foot and on two wheels in each format: written, read by its own reader where there is one, and back."""

import json
import math
from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from torchvision.datasets import CocoDetection

from skope import schema
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.files.json_files import read_json, write_json
from skope.gen.inspect.check import check
from skope.schema import Annotation, AnnotationFile, Box3D, Result, RoadUser, RoadUserResult
from tests.samples import make_dataset

KINDS = ("pedestrian", "bicycle", "motorcycle")


@pytest.fixture
def ours(skope: Any) -> Path:
    """Three images of each split, each with two vehicles, a pedestrian, a bicycle and an ignored motorcycle."""
    return make_dataset(Path("ours"), images=12, road_users=True)


def placed(label: Any) -> Any:
    """The label with a 3D box on the road."""
    yaw = 0.3
    turn = np.array([[math.cos(yaw), -math.sin(yaw), 0], [math.sin(yaw), math.cos(yaw), 0], [0, 0, 1.0]])
    return replace(
        label, box_3d=Box3D(center=np.array([15.0, 1, 0.9]), size_lwh=np.array([1.8, 0.6, 1.8]), yaw=yaw, R=turn)
    )


def convert(skope: Any, *words: str) -> str:
    code, out, err = skope("gen", "convert", *words)
    assert (code, err.count("Error")) == (0, 0), err
    return str(out)


def same_users(a: AnnotationFile, b: AnnotationFile, *, tracks: bool = True) -> None:
    assert a.categories == b.categories
    assert len(a.road_users) == len(b.road_users)
    for one, other in zip(a.road_users, b.road_users, strict=True):
        assert np.abs(one.bbox - other.bbox).max() < 0.011
        assert (one.category, one.iscrowd, one.ignore_reason) == (other.category, other.iscrowd, other.ignore_reason)
        assert one.track_id == other.track_id or not tracks
    assert len(a.annotations) == len(b.annotations)


def test_coco_goes_out_and_comes_back(skope: Any, ours: Path, capsys: pytest.CaptureFixture[str]) -> None:
    convert(skope, "ours", "there", "--to", "coco", "-q")
    truth = COCO("there/annotations/train.json")
    assert [row["name"] for row in truth.loadCats(truth.getCatIds())] == list(schema.CATEGORY_NAMES)
    assert len(truth.getAnnIds(catIds=[2])) == len(truth.getAnnIds(catIds=[4])) == 12
    assert all(row["num_keypoints"] == 0 for row in truth.loadAnns(truth.getAnnIds(catIds=[2, 3, 4])))
    read = CocoDetection("there", "there/annotations/train.json")
    assert Counter(row["category_id"] for _, rows in (read[i] for i in range(len(read))) for row in rows) == {
        **{1: 24, 2: 12, 3: 12, 4: 12}
    }
    out = convert(skope, "there", "back", "--from", "coco")
    assert "read as categories of skope" not in out  # it is
    for split in ("train", "easy"):
        same_users(open_dataset(ours).read(split), open_dataset(Path("back")).read(split))
    assert open_dataset(Path("back")).categories == schema.CATEGORY_NAMES
    found = [str(finding) for finding in check(open_dataset(Path("back")))]
    assert [text for text in found if "site: site is also in split" not in text] == []
    capsys.readouterr()


def test_somebody_elses_categories_of_our_names_are_read_and_it_is_said(skope: Any, ours: Path) -> None:
    convert(skope, "ours", "there", "--to", "coco", "-q")
    for split in ("train", "easy"):
        path = Path("there/annotations") / f"{split}.json"
        document = read_json(path)
        del document["info"]
        ids = {1: 7, 2: 20, 3: 30, 4: 40}
        for row in document["categories"]:
            row |= {"id": ids[row["id"]], "name": row["name"].title()}
        for row in document["annotations"]:
            row["category_id"] = ids[row["category_id"]]
        document["categories"].append({"id": 50, "name": "tram"})
        document["annotations"].append({**document["annotations"][0], "id": 9999, "category_id": 50})
        write_json(path, document)
    code, out, err = skope("gen", "convert", "there", "back", "--from", "coco")
    assert code == 0
    assert "read as categories of skope, without keypoints: bicycle, motorcycle, pedestrian" in out
    assert "of tram left out, without a keypoint of skope" in out + err
    back = open_dataset(Path("back")).read("train")
    assert Counter(user.category for user in back.road_users) == dict.fromkeys(KINDS, 12)
    assert all(user.track_id is None for user in back.road_users)  # what is theirs need not mean what ours does


def test_files_that_label_different_categories_are_not_mixed(skope: Any, ours: Path) -> None:
    convert(skope, "ours", "there", "--to", "coco", "-q")
    path = Path("there/annotations/easy.json")
    document = read_json(path)
    document["categories"] = document["categories"][:1]
    document["annotations"] = [row for row in document["annotations"] if row["category_id"] == 1]
    write_json(path, document)
    code, _, err = skope("gen", "convert", "there", "back", "--from", "coco", "-q")
    assert code == 2
    assert (
        "categories: labels vehicle, bicycle, motorcycle, pedestrian, the others vehicle: import them separately" in err
    )


def test_cvat_has_rectangles(skope: Any, ours: Path) -> None:
    convert(skope, "ours", "there.zip", "--to", "cvat", "-q")
    convert(skope, "ours", "there", "--to", "cvat", "-q")
    labels = json.loads(Path("there/labels.json").read_text())
    assert [(label["name"], label["type"]) for label in labels] == [
        ("vehicle", "skeleton"),
        *((name, "rectangle") for name in ("bicycle", "motorcycle", "pedestrian")),
    ]
    rows = read_json(Path("there/annotations/person_keypoints_train.json"))["annotations"]
    others = [row for row in rows if row["category_id"] > 1]
    assert len(others) == 36
    assert all((row["keypoints"], row["num_keypoints"], row["iscrowd"]) == ([], 0, 0) for row in others)
    assert {row["attributes"].get("ignore_reason") for row in others if row["category_id"] == 3} == {"small"}
    assert all(row["bbox"][2:] == [8.0, 20.0] for row in others)
    # What CVAT exports has lost our `info`.
    for split in ("train", "easy"):
        path = Path("there/annotations") / f"person_keypoints_{split}.json"
        document = read_json(path)
        del document["info"]
        write_json(path, document)
    out = convert(skope, "there", "back", "--from", "cvat")
    assert "read as categories of skope, without keypoints: bicycle, motorcycle, pedestrian" in out
    same_users(open_dataset(ours).read("train"), open_dataset(Path("back")).read("train"))
    convert(skope, "there.zip", "again", "--from", "cvat", "-q")
    same_users(open_dataset(ours).read("easy"), open_dataset(Path("again")).read("easy"))
    # A dataset of vehicles alone has the labels that it had.
    make_dataset(Path("cars"))
    convert(skope, "cars", "plain", "--to", "cvat", "-q")
    assert len(json.loads(Path("plain/labels.json").read_text())) == 1


def test_yolo_has_classes_whose_points_are_not_labelled(skope: Any, ours: Path) -> None:
    out = convert(skope, "ours", "there", "--to", "yolo")
    # One image is left out between the ends of the recordings for training and what they are validated on.
    assert "23 ignored road users in addition to 92 others: background here (23 small)" in out
    lines = Path("there/data.yaml").read_text().splitlines()
    start = lines.index("names:")
    assert lines[start + 1 : start + 5] == ["  0: vehicle", "  1: bicycle", "  2: motorcycle", "  3: pedestrian"]
    file = open_dataset(ours).read("easy")
    own = file.labels_by_image()
    for image in file.images:
        path = Path("there/labels/easy") / Path(image.file_name).relative_to("images").with_suffix(".txt")
        rows = [list(map(float, line.split())) for line in path.read_text().splitlines()]
        kept = [label for label in own[image.id] if not label.ignored]
        assert len(rows) == len(kept) == 4
        for row, label in zip(rows, kept, strict=True):
            assert len(row) == 5 + 99
            w, h = row[3] * image.width, row[4] * image.height
            box = [row[1] * image.width - w / 2, row[2] * image.height - h / 2, w, h]
            assert np.abs(box - label.bbox).max() < 1e-3
            if isinstance(label, RoadUser):
                assert lines[start + 1 + int(row[0])] == f"  {int(row[0])}: {label.category}"
                assert not any(row[5:])
            else:
                assert row[0] == 0
    path = ours / "annotations" / "easy.json"
    coco.write(path, replace(file, road_users=(), categories=("vehicle",)))
    code, _, err = skope("gen", "convert", "ours", "new", "--to", "yolo", "-q")
    assert (code, "easy: labels vehicle, split train labels vehicle, bicycle" in err) == (2, True)


def test_kitti_calls_them_by_its_names(skope: Any, ours: Path) -> None:
    path = ours / "annotations" / "train.json"
    file = coco.read(path)
    coco.write(
        path,
        replace(file, annotations=tuple(map(placed, file.annotations)), road_users=tuple(map(placed, file.road_users))),
    )
    (ours / "annotations" / "easy.json").unlink()
    convert(skope, "ours", "there", "--to", "kitti", "-q")
    rows = [line.split() for line in Path("there/train/label_2/000000.txt").read_text().splitlines()]
    assert [row[0] for row in rows] == ["Car", "Car", "Pedestrian", "Cyclist", "DontCare"]
    user = file.road_users[0]
    x, y, w, h = user.bbox
    assert [float(v) for v in rows[2][4:8]] == pytest.approx([x, y, x + w, y + h], abs=0.01)
    assert [float(v) for v in rows[2][8:11]] == [1.8, 0.6, 1.8]
    assert len(Path("there/train/rotation/000000.txt").read_text().splitlines()) == 5
    seen = [replace(user, iscrowd=0, ignore_reason=None) for user in map(placed, file.road_users)]
    coco.write(path, replace(file, annotations=(), road_users=tuple(seen)))
    convert(skope, "ours", "all", "--to", "kitti", "-q")
    kinds = [line.split()[0] for line in Path("all/train/label_2/000000.txt").read_text().splitlines()]
    assert kinds == ["Pedestrian", "Cyclist", "Motorcyclist"]


def test_mot_has_classes_and_their_names(skope: Any, ours: Path) -> None:
    convert(skope, "ours", "there", "--to", "mot", "-q")
    folder = Path("there/train/site_00/gt")
    assert folder.joinpath("labels.txt").read_text().splitlines() == list(schema.CATEGORY_NAMES)
    rows = [line.split(",") for line in folder.joinpath("gt.txt").read_text().splitlines()]
    assert Counter(row[7] for row in rows) == {"1": 24, "2": 12, "3": 12, "4": 12}
    assert {row[6] for row in rows if row[7] == "3"} == {"0"}  # ignored
    user = open_dataset(ours).read("train").road_users[0]
    row = next(row for row in rows if row[7] == "4")
    assert (int(row[1]), [float(v) for v in row[2:6]]) == ((user.track_id or 0) + 1, user.bbox.tolist())
    make_dataset(Path("cars"))
    convert(skope, "cars", "plain", "--to", "mot", "-q")
    assert not list(Path("plain").rglob("labels.txt"))


def test_the_published_layout_has_vehicles_alone_and_says_so(skope: Any) -> None:
    make_dataset(Path("ours"), images=12, splits=("train",), road_users=True)
    out = convert(skope, "ours", "there", "--to", "skope3d")
    assert "36 people on foot and on two wheels are left out: this format has only vehicles" in out
    convert(skope, "there", "back", "--from", "skope3d", "-q")
    back = open_dataset(Path("back"))
    assert (back.categories, len(back.read("train").annotations)) == (("vehicle",), 24)


def test_predictions_become_labels_of_their_categories(skope: Any, ours: Path) -> None:
    file = open_dataset(ours).read("train")
    folder = Path("found")
    coco.write(folder / "frames.json", replace(file, annotations=(), road_users=(), categories=("vehicle",)))
    found = [
        Result(image_id=1, score=0.9, bbox=np.array([10.0, 10, 60, 40]), keypoints=np.full((33, 3), 20.0)),
        RoadUserResult(image_id=1, score=0.8, bbox=np.array([5.0, 5, 10, 20]), category_id=4),
    ]
    coco.write_results(folder / "predictions.json", found)
    (folder / "images").symlink_to(ours.resolve() / "images")
    convert(skope, "found", "new", "--from", "coco", "-q")
    new = open_dataset(Path("new")).read("train")
    assert new.categories == ("vehicle", "pedestrian")
    assert [user.bbox.tolist() for user in new.road_users] == [[5, 5, 10, 20]]
    assert len(new.annotations) == 1


# ---------------------------------------------------------------------------------------------------------- merging


def pair(*, second: bool) -> None:
    """Folders `ours` and `more` of different sites, of which the second one may have no people."""
    make_dataset(Path("ours"), images=12, splits=("train",), road_users=True)
    make_dataset(Path("more"), images=2, splits=("train",), seed=5, road_users=second)


def test_joined_sets_keep_their_people(skope: Any) -> None:
    pair(second=True)
    code, _, err = skope("gen", "merge", "ours", "more", "joined", "-q")
    assert (code, err) == (0, "")
    joined = open_dataset(Path("joined"))
    assert joined.categories == schema.CATEGORY_NAMES
    file = joined.read("train")
    assert Counter(user.category for user in file.road_users) == dict.fromkeys(KINDS, 14)
    assert len({label.id for label in (*file.annotations, *file.road_users)}) == 28 + 42
    assert joined.card["counts"]["by_category"]["motorcycle"] == {"ground_truth": 0, "ignored": 14}
    assert joined.card["counts"]["ground_truth"] == 28
    assert list(check(joined)) == []


def test_people_whom_one_set_does_not_label_are_no_background(skope: Any) -> None:
    pair(second=False)
    for order in (("ours", "more"), ("more", "ours")):
        code, _, err = skope("gen", "merge", *order, "joined", "-q")
        assert code == 2
        assert "--vehicles-alone leaves those labels out" in err
        assert not Path("joined").exists()
    code, out, _ = skope("gen", "merge", "ours", "more", "joined", "--vehicles-alone")
    assert code == 0
    assert "36 labels of people on foot and on two wheels are left out" in out
    joined = open_dataset(Path("joined"))
    assert (joined.categories, joined.read("train").road_users) == (("vehicle",), ())
    assert "--vehicles-alone" in joined.card["command"]
    assert list(check(joined)) == []


def test_a_card_that_hides_a_difference_does_not_join(skope: Any) -> None:
    """As of a folder that was put together by hand."""
    pair(second=False)
    card = read_json(Path("ours/dataset.json"))
    del card["categories"]
    write_json(Path("ours/dataset.json"), card)
    code, _, err = skope("gen", "merge", "more", "ours", "joined", "-q")
    assert (code, "labels vehicle, bicycle" in err) == (2, True)


def test_vehicles_keep_their_type(ours: Path) -> None:
    assert all(isinstance(vehicle, Annotation) for vehicle in open_dataset(ours).read("train").annotations)
