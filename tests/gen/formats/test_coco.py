"""COCO and CVAT: what goes out comes back, files of others are read by name, and what is wrong with one is told."""

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pycocotools.coco import COCO

from skope import keypoints
from skope.dataset import coco
from skope.dataset.folder import open_dataset
from skope.files.json_files import read_json, write_json
from skope.gen.inspect.check import check
from skope.keypoints import PUBLISHED
from skope.schema import AnnotationFile, Result
from tests.samples import make_annotation, make_dataset, make_image


def rows(root: Path, split: str) -> list[dict[str, Any]]:
    return [coco.annotation_to_dict(a) for a in open_dataset(root).read(split).annotations]


@pytest.fixture
def ours(skope: Any) -> Path:
    """A dataset of two splits with an ignored vehicle, hidden points and an image without a vehicle."""
    root = make_dataset(Path("ours"), images=2)
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    vehicles = (
        make_annotation(1, 1, (10, 12, 60, 40), hidden=4),
        make_annotation(2, 1, (84, 56, 60, 40), iscrowd=1),
    )
    coco.write(path, AnnotationFile(images=file.images, annotations=vehicles, name="train"))
    write_json(root / "dataset.json", {**read_json(root / "dataset.json"), "licence": "CC BY 4.0"})
    return root


def test_coco_returns_whole(skope: Any, ours: Path) -> None:
    assert skope("gen", "convert", "ours", "there", "--to", "coco", "-q")[0] == 0
    assert {p.name for p in Path("there").iterdir()} == {"annotations", "images", "LICENCE.txt"}
    assert skope("gen", "convert", "there", "back", "--from", "coco", "-q")[0] == 0
    back = open_dataset(Path("back"))
    assert (back.splits, back.licence) == (("easy", "train"), "CC BY 4.0")
    for split in back.splits:
        then = [{**row, "id": 0, "image_id": 0} for row in rows(ours, split)]
        assert [{**row, "id": 0, "image_id": 0} for row in rows(Path("back"), split)] == then
        for a, b in zip(open_dataset(ours).read(split).images, back.read(split).images, strict=True):
            first, second = coco.image_to_dict(a), coco.image_to_dict(b)
            assert {**first, "id": 0} == {**second, "id": 0, "split": "train" if split == "train" else "easy"}
            assert (ours / a.file_name).read_bytes() == (Path("back") / b.file_name).read_bytes()
    # The sample's one site is in both of its splits.
    assert {finding.text for finding in check(back)} == {"site: site is also in split easy"}


def test_pycocotools_reads_the_cvat_files(skope: Any, ours: Path) -> None:
    assert skope("gen", "convert", "ours", "there", "--to", "cvat", "-q")[0] == 0
    theirs = COCO("there/annotations/person_keypoints_train.json")
    images = theirs.loadImgs(theirs.getImgIds())
    assert all((Path("there/images/train") / image["file_name"]).is_file() for image in images)
    (first, ignored) = theirs.loadAnns(theirs.getAnnIds(imgIds=images[0]["id"]))
    assert first["attributes"]["track_id"] == 1
    assert (ignored["iscrowd"], ignored["attributes"]["ignore_reason"]) == (0, "small")
    assert theirs.loadCats(1)[0]["keypoints"] == list(keypoints.NAMES)
    # What its editor of labels takes names every point and draws every edge.
    (label,) = read_json(Path("there/labels.json"))
    assert [part["name"] for part in label["sublabels"]] == list(keypoints.NAMES)
    assert label["svg"].count('data-type="edge"') == len(keypoints.SKELETON)


@pytest.mark.parametrize("target", ["there", "there.zip"])
def test_cvat_returns_what_it_holds(skope: Any, ours: Path, target: str) -> None:
    assert skope("gen", "convert", "ours", target, "--to", "cvat", "-q")[0] == 0
    assert skope("gen", "convert", target, "back", "--from", "cvat", "-q")[0] == 0
    kept = ("bbox", "keypoints", "num_keypoints", "iscrowd", "ignore_reason", "track_id", "vehicle_type")
    for split in ("easy", "train"):
        one, other = (
            [{name: row.get(name) for name in kept} for row in rows(root, split)] for root in (ours, Path("back"))
        )
        assert one == other
    back = open_dataset(Path("back"))
    assert back.licence == "CC BY 4.0"
    assert np.array_equal(
        back.image(back.read("easy").images[0]), open_dataset(ours).image(open_dataset(ours).read("easy").images[0])
    )
    assert skope("gen", "convert", "ours", target, "--to", "cvat", "-q")[0] == 0  # and finds it the same
    make_dataset(Path("others"), seed=1)
    code, _, err = skope("gen", "convert", "others", target, "--to", "cvat", "-q")
    assert code == 2
    assert target in err


def foreign(folder: Path) -> dict[str, Any]:
    """A file with three labelled points, one of them not of skope's, and with boxes of people beside."""
    (folder / "frames").mkdir(parents=True)
    cv2.imwrite(str(folder / "frames" / "a 1.png"), np.full((60, 80, 3), 90, np.uint8))
    return {
        "images": [{"id": 5, "file_name": "a 1.png", "width": 80, "height": 60, "camera": "nikon", "site": 5}],
        "categories": [
            {"id": 3, "name": "person"},
            {"id": 4, "name": "car", "keypoints": ["Wheel Front-Left", "exhaust", "mirror_left"], "skeleton": []},
        ],
        "annotations": [
            {"id": 9, "image_id": 5, "category_id": 4, "bbox": [10, 10, 40, 30], "color": [1, 2, 3],
             "keypoints": [20, 30, 1, 5, 5, 2, 79.5, 12, 2], "attributes": {"track_id": "4", "color": "red"}},
            {"id": 10, "image_id": 5, "category_id": 4, "keypoints": [20, 30, 2, 5, 5, 2, 90, 12, 2]},
            {"id": 11, "image_id": 5, "category_id": 4, "bbox": [1, 2, 3, 4]},
            {"id": 12, "image_id": 5, "category_id": 3, "bbox": [1, 2, 3, 4]},
        ],
    }  # fmt: skip


FOREIGN = ("gen", "convert", "in/labels.json", "out", "--from", "coco", "--images", "in/frames", "--split", "train")


def test_files_of_others_are_read_by_name(skope: Any) -> None:
    document = foreign(Path("in"))
    document["annotations"][1]["bbox"] = [0, 0, 0, 0]
    document["annotations"][1]["keypoints"] = [20, 30, 2, 0, 0, 0, 30, 12, 2]
    write_json(Path("in/labels.json"), document)
    code, out, err = skope(*FOREIGN)
    assert code == 0, err
    assert "left out keypoints that are not in skope33: exhaust" in out
    assert "2 of the 33 keypoints of skope33" in out
    assert "warning: 1 annotation of person left out, without a keypoint of skope; first: " in err
    assert "warning: 1 vehicle with keypoints marked visible far outside the box" in err
    assert "annotations[0]" in err
    file = open_dataset(Path("out")).read("train")
    assert [(i.file_name, i.site, i.camera) for i in file.images] == [("images/a 1.png", None, None)]
    one, two, three = file.annotations
    wheel, mirror = keypoints.INDEX["wheel_front_left"], keypoints.INDEX["mirror_left"]
    assert one.keypoints[wheel].tolist() == [20, 30, 1]
    assert one.keypoints[mirror].tolist() == [79.5, 12, 2]
    assert np.flatnonzero(one.keypoints[:, 2]).tolist() == sorted((wheel, mirror))
    assert (one.track_id, one.color, one.area) == (4, "red", 1200)
    assert two.bbox.tolist() == [20, 12, 10, 18]
    assert (three.num_keypoints, three.bbox.tolist()) == (0, [1, 2, 3, 4])


def test_boxes_end_at_the_image(skope: Any) -> None:
    """As people drag them in an editor; what is outside, or a single point, is no vehicle to learn or to find."""
    document = foreign(Path("in"))
    first, second, third, _ = document["annotations"]
    first["bbox"] = [-5, 40, 40, 30]
    second["keypoints"] = [20, 30, 2, 0, 0, 0, 0, 0, 0]  # its box would be that point
    third["bbox"] = [80, 10, 20, 20]
    write_json(Path("in/labels.json"), document)
    code, _, err = skope(*FOREIGN)
    assert code == 0, err
    assert "warning: 2 vehicles left out, without area inside the image; first: " in err
    (vehicle,) = open_dataset(Path("out")).read("train").annotations
    assert (vehicle.bbox.tolist(), vehicle.area) == ([0, 40, 35, 20], 700)


def test_images_of_a_subset_lie_in_its_folder(skope: Any) -> None:
    """Two subsets and the folder above have an image of one name; the archive's folder or one file of it is read."""
    document = foreign(Path("in"))
    for folder, level in (("images", 10), ("images/train", 20), ("images/val", 30)):
        (Path("in") / folder).mkdir()
        cv2.imwrite(f"in/{folder}/a 1.png", np.full((60, 80, 3), level, np.uint8))
    for subset in ("train", "val"):
        write_json(Path(f"in/annotations/person_keypoints_{subset}.json"), document)
    one = "in/annotations/person_keypoints_val.json"
    for source, out, expected in (("in", "both", {"train": 20, "val": 30}), (one, "one", {"val": 30})):
        code, _, err = skope("gen", "convert", source, out, "--from", "cvat", "-q")
        assert code == 0, err
        data = open_dataset(Path(out))
        assert {split: data.image(data.read(split).images[0])[0, 0, 0] for split in data.splits} == expected


def test_published_names_make_their_scheme(skope: Any) -> None:
    make_dataset(Path("theirs"), scheme=PUBLISHED, splits=("train",))
    assert skope("gen", "convert", "theirs", "there", "--to", "cvat", "-q")[0] == 0
    assert skope("gen", "convert", "there", "back", "--from", "cvat", "-q")[0] == 0
    assert open_dataset(Path("back")).scheme is PUBLISHED
    make_dataset(Path("ours"), splits=("easy",))
    assert skope("gen", "convert", "ours", "here", "--to", "cvat", "-q")[0] == 0
    code, _, err = skope("gen", "convert", "there", "here", "both", "--from", "cvat", "-q")
    assert (code, "has keypoints of scheme skope33, the others of skope3d" in err) == (2, True)


def test_predictions_are_corrected_and_learnt(skope: Any) -> None:
    """predict -> CVAT -> correct -> train: a footage's results out, a point moved, and back."""
    vehicle = make_annotation(1, 1, (10, 10, 60, 40))
    image = make_image(1)
    (Path("crossing") / "x").mkdir(parents=True)
    cv2.imwrite("crossing/x/a.png", np.full((image.height, image.width, 3), 90, np.uint8))
    shown = coco.image_to_dict(image) | {"file_name": "x/a.png"}
    coco.write(Path("predicted/frames.json"), AnnotationFile(images=(coco.image_from_dict(shown),), annotations=()))
    points = vehicle.keypoints.copy()
    points[:, 2] = np.where(np.arange(33) < 5, 0.4, 0.9)
    found = Result(image_id=1, score=0.8, bbox=vehicle.bbox, keypoints=points)
    coco.write_results(Path("predicted/predictions.json"), [found])
    out = ("gen", "convert", "predicted", "todo.zip", "--from", "coco", "--images", "crossing", "--to", "cvat", "-q")
    code, _, err = skope(*out)
    assert code == 0, err
    with zipfile.ZipFile("todo.zip") as archive:
        archive.extractall("corrected")
    path = Path("corrected/annotations/person_keypoints_train.json")
    document = json.loads(path.read_text())
    assert document["annotations"][0]["keypoints"][2::3] == [1] * 5 + [2] * 28
    document["annotations"][0]["keypoints"][:3] = [33, 22, 2]
    path.write_text(json.dumps(document))
    assert skope("gen", "convert", "corrected", "mine", "--from", "cvat", "-q")[0] == 0
    (now,) = open_dataset(Path("mine")).read("train").annotations
    assert now.keypoints[0].tolist() == [33, 22, 2]
    assert np.abs(now.keypoints[1:, :2] - vehicle.keypoints[1:, :2]).max() < 0.01


def change(*path: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def apply(document: Any) -> None:
        for key in path[:-1]:
            document = document[key]
        if to is None:
            del document[path[-1]]
        else:
            document[path[-1]] = to

    return apply


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (change("categories", to=None), "field categories is missing or not a list of objects"),
        (change("categories", 1, "id", to=[4]), "categories[1]: id: expected a whole number, got [4]"),
        (change("categories", 1, "id", to=3), "field categories: duplicate id"),
        (change("images", 0, "id", to="5"), "images[0]: id: expected a whole number, got '5'"),
        (change("annotations", 0, "category_id", to=None), "annotations[0]: category_id: expected a whole number"),
        (change("categories", 1, "keypoints", to=7), "no keypoint has a name of skope33: it has none"),
        (change("annotations", to=[3]), "field annotations is missing or not a list of objects"),
        (change("categories", 1, "keypoints", to=["a", "b", "c"]), "no keypoint has a name of skope33"),
        (change("categories", 1, "keypoints", to=["mirror_left"] * 3), "category 'car' has a duplicate keypoint"),
        (change("annotations", 0, "keypoints", to=[1, 2, 2]), "annotations[0]: keypoints: expected 3 x 3 numbers"),
        (change("annotations", 0, "keypoints", to=["x"] * 9), "annotations[0]: keypoints: expected numbers"),
        (change("annotations", 0, "keypoints", 2, to=5), "annotations[0]: keypoints: v is 0, 1 or 2"),
        (change("annotations", 0, "image_id", to=77), "annotations[0]: image_id 77 is not among the images"),
        (change("annotations", 2, "bbox", to=None), "annotations[2]: bbox: missing, and no keypoint is labelled"),
        (change("annotations", 2, "bbox", to=[1, 2]), "annotations[2]: bbox: expected 4 numbers, got 2"),
        (change("images", 0, "width", to=None), "images[0]: field width is missing"),
        (change("images", 0, "file_name", to="../../etc/passwd"), "images[0]: file_name: no ../../etc/passwd in"),
        (change("images", 0, "file_name", to="b.png"), "images[0]: file_name: no b.png in in/frames"),
        (change("images", 0, "file_name", to="."), "images[0]: file_name: no . in in/frames"),
        (lambda d: d["images"].append({**d["images"][0], "id": 6}), "images[1]: file_name: a 1.png is a duplicate"),
        (lambda d: (d.update(info=keypoints.SKOPE33.fields()), d["images"][0].update(camera=None, site=None),
                    d["annotations"][0].update(color=None, box_3d="x")),
         "annotations[0]: box_3d: expected an object with center"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_told(skope: Any, damage: Callable[[dict[str, Any]], None], said: str) -> None:
    document = foreign(Path("in"))
    damage(document)
    write_json(Path("in/labels.json"), document)
    code, out, err = skope(*FOREIGN, "-q")
    assert (code, out, err.count("\n")) == (2, "", 1), err
    assert "labels.json" in err
    assert said in err
    assert {path.name for path in Path().iterdir()} == {"in"}


def test_images_that_are_nowhere_are_told(skope: Any) -> None:
    write_json(Path("labels.json"), foreign(Path("in")))
    code, out, err = skope("gen", "convert", "labels.json", "out", "--from", "coco", "--images", "gone", "-q")
    assert (code, out, err) == (2, "", "skope: --images: gone: no such folder\n")
    assert not Path("out").exists()


def test_sources_that_are_none_are_told(skope: Any) -> None:
    Path("empty").mkdir()
    Path("bad.json").write_text("{")
    Path("bad.zip").write_text("PK")
    with zipfile.ZipFile("cut.zip", "w") as archive:
        archive.writestr("annotations/person_keypoints_train.json", "{")
    for source, said in (
        ("gone", "gone: no such file"),
        ("gone.json", "gone.json: no such file"),
        ("empty", "empty: has no annotations/person_keypoints_*.json"),
        ("bad.json", "bad.json: not valid JSON"),
        ("bad.zip", "bad.zip: not a zip archive"),
        ("cut.zip", "cut.zip/annotations/person_keypoints_train.json: not valid JSON"),
    ):
        code, out, err = skope("gen", "convert", source, "out", "--from", "cvat", "-q")
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert said in err
        assert not Path("out").exists()
