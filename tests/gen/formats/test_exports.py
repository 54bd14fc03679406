"""YOLO, KITTI and MOTChallenge files, read back by readers of this test."""

import configparser
import itertools
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope import keypoints
from skope.camera.calibration_files import over_plane, read_calibration, read_plane
from skope.camera.model import Camera
from skope.dataset import coco, shards
from skope.dataset.folder import open_dataset
from skope.files.json_files import read_json, write_json
from skope.gen.inspect.check import check
from skope.schema import Annotation, AnnotationFile, Box3D
from tests import hostile
from tests.samples import make_annotation, make_dataset

# ----------------------------------------------------------------------------------------------------------------- YOLO


def yolo_yaml(root: Path) -> dict[str, Any]:
    """The file's one-line values, lists of numbers and words alike."""
    out: dict[str, Any] = {}
    for line in (root / "data.yaml").read_text().splitlines():
        key, _, value = line.partition(": ")
        if value and not line.startswith(("#", " ")):
            inner = value.removeprefix("[").removesuffix("]").split(", ")
            out[key] = inner if value.startswith("[") else value
    out["names"] = [
        line.strip().removeprefix("- ") for line in (root / "data.yaml").read_text().splitlines() if "- " in line
    ]
    return out


def yolo_rows(root: Path, image: Path) -> np.ndarray[Any, Any]:
    path = Path(str(image).replace("/images/", "/labels/")).with_suffix(".txt")
    return np.array([[float(cell) for cell in line.split()] for line in path.read_text().splitlines()])


@pytest.fixture
def ours(skope: Any) -> Path:
    root = make_dataset(Path("ours"), images=12)
    path = root / "annotations" / "easy.json"
    file = coco.read(path)
    first = file.images[0].id
    ignored = make_annotation(500, first, (84, 56, 60, 40), iscrowd=1)
    vehicles = [make_annotation(499, first, (10, 12, 60, 40), hidden=4), ignored]
    coco.write(path, replace(file, annotations=tuple(vehicles)))
    return root


def test_yolo_rows_say_what_the_labels_say(skope: Any, ours: Path) -> None:
    code, out, err = skope("gen", "convert", "ours", "there", "--to", "yolo")
    assert (code, err.count("Error")) == (0, 0)
    ignored = [vehicle for split in ("train", "easy") for vehicle in open_dataset(ours).read(split).annotations]
    ignored = [vehicle.ignore_reason for vehicle in ignored if vehicle.ignored]
    assert f"1 ignored vehicle in addition to 23 others: background here (1 {ignored[0]})" in out
    assert "val, the end of train's recordings: 1 image; left out, too similar to both: 1" in out
    told = yolo_yaml(Path("there"))
    assert (told["train"], told["val"], told["test"]) == ("images/train", "images/val", ["images/easy"])
    assert told["kpt_shape"] == ["33", "3"]
    assert [int(i) for i in told["flip_idx"]] == list(keypoints.FLIP)
    assert [float(s) for s in told["kpt_oks_sigmas"]] == list(keypoints.SIGMAS)
    assert told["names"] == list(keypoints.NAMES)
    # The recording's last tenth is val; the frame before it is neither.
    counts = {part: len(list(Path("there/images", part).rglob("*.png"))) for part in ("train", "val", "easy")}
    assert counts == {"train": 10, "val": 1, "easy": 12}
    file = open_dataset(ours).read("easy")
    own = file.by_image()
    for image in file.images:
        found = Path("there/images/easy") / image.file_name.removeprefix("images/")
        assert found.read_bytes() == (ours / image.file_name).read_bytes()
        rows = yolo_rows(Path("there"), found)
        kept = [vehicle for vehicle in own[image.id] if not vehicle.ignored]
        assert len(rows) == len(kept)
        for row, vehicle in zip(rows, kept, strict=True):
            assert row.size == 5 + 99
            center, size = row[1:3] * [image.width, image.height], row[3:5] * [image.width, image.height]
            assert np.abs(np.concatenate([center - size / 2, size]) - vehicle.bbox).max() < 1e-3
            points = row[5:].reshape(-1, 3) * [image.width, image.height, 1]
            assert np.abs(points - vehicle.keypoints).max() < 1e-3


def test_yolo_takes_some_keypoints(skope: Any, ours: Path) -> None:
    chosen = "wheel_front_left,front_logo,wheel_front_right"
    assert skope("gen", "convert", "ours", "there", "--to", "yolo", "--keypoints", chosen, "-q")[0] == 0
    told = yolo_yaml(Path("there"))
    assert (told["kpt_shape"], told["flip_idx"], told["names"]) == (["3", "3"], ["2", "1", "0"], chosen.split(","))
    image = open_dataset(ours).read("easy").images[0]
    (row,) = yolo_rows(Path("there"), Path("there/images/easy") / image.file_name.removeprefix("images/"))
    vehicle = open_dataset(ours).read("easy").annotations[0]
    wanted = vehicle.keypoints[[keypoints.INDEX[name] for name in chosen.split(",")]]
    assert np.abs(row[5:].reshape(3, 3) * [image.width, image.height, 1] - wanted).max() < 1e-3
    code, out, _ = skope("gen", "convert", "ours", "half", "--to", "yolo", "--keypoints", "wheel_front_left")
    assert (code, "no flip_idx" in out, "flip_idx" in yolo_yaml(Path("half"))) == (0, True, False)
    for names, said in (
        ("wheel", "--keypoints: 'wheel' is not a keypoint"),
        ("front_logo,front_logo", "is listed twice"),
    ):
        code, _, err = skope("gen", "convert", "ours", "new", "--to", "yolo", "--keypoints", names, "-q")
        assert (code, said in err, Path("new").exists()) == (2, True, False)


def test_yolo_labels_of_two_images_are_not_written_to_one_file(skope: Any) -> None:
    root = make_dataset(Path("ours"), splits=("train", "val"))
    path = root / "annotations" / "train.json"
    file = coco.read(path)
    first, second = (root / image.file_name for image in file.images)
    second.rename(first.with_suffix(".PNG"))
    second_now = replace(file.images[1], file_name=first.with_suffix(".PNG").relative_to(root).as_posix())
    coco.write(path, replace(file, images=(file.images[0], second_now)))
    code, _, err = skope("gen", "convert", "ours", "new", "--to", "yolo", "-q")
    assert (code, "another image has this name with another suffix" in err, Path("new").exists()) == (2, True, False)


def test_yolo_needs_something_to_learn_and_validate(skope: Any) -> None:
    make_dataset(Path("tests"), splits=("easy",))
    make_dataset(Path("short"), splits=("train",), images=2)
    for root, said in (("tests", "has no split train"), ("short", "too short to keep the last 10% for val")):
        code, _, err = skope("gen", "convert", root, "new", "--to", "yolo", "-q")
        assert (code, said in err, Path("new").exists()) == (2, True, False)


# ---------------------------------------------------------------------------------------------------------------- KITTI


def turned(roll: float, pitch: float, yaw: float) -> np.ndarray[Any, Any]:
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(a), np.sin(a)) for a in (roll, pitch, yaw))
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


CAMERA = Camera.looking([3, -2, 6.5], yaw=0.7, pitch_down=0.35, size=(160, 120))


@pytest.fixture
def boxed(skope: Any) -> list[Annotation]:
    """A dataset with three vehicles on the road, one of them nose down, and an ignored one."""
    root = make_dataset(Path("ours"), images=1, splits=("hard",))
    path = root / "annotations" / "hard.json"
    file = coco.read(path)
    image = replace(file.images[0], camera=CAMERA)
    vehicles = []
    for i, (x, y, yaw, pitch) in enumerate(((14.0, 6.0, 0.3, 0.0), (20.0, 9.0, 2.9, 0.0), (17.0, 13.0, -1.8, 0.06))):
        R = turned(0.0, pitch, yaw)
        box = Box3D(center=[x, y, 0.8], size_lwh=[4.4, 1.8, 1.6], yaw=float(np.arctan2(R[1, 0], R[0, 0])), R=R)
        vehicle = make_annotation(i + 1, image.id, (10 + 20 * i, 12, 60, 40))
        vehicles.append(replace(vehicle, box_3d=box, occlusion=0.25 * i, truncation=0.1, vehicle_type="van"))
    ignored = replace(vehicles[0], id=9, iscrowd=1, ignore_reason="small")
    coco.write(path, AnnotationFile(images=(image,), annotations=(*vehicles, ignored), name="hard"))
    assert skope("gen", "convert", "ours", "there", "--to", "kitti", "-q")[0] == 0
    return vehicles


def kitti_corners(h: float, w: float, length: float, at: Any, R: Any) -> np.ndarray[Any, Any]:
    """The devkit's corners (x forward, y down from the bottom's middle), turned by R: (8, 3) in the camera frame."""
    x, y, z = np.array(list(itertools.product((-length / 2, length / 2), (-h, 0), (-w / 2, w / 2)))).T
    return np.array(at) + np.stack([x, y, z], axis=1) @ np.asarray(R).T


def box_corners(box: Box3D) -> np.ndarray[Any, Any]:
    return np.array(list(itertools.product((-0.5, 0.5), repeat=3))) * box.size_lwh @ box.R.T + box.center


def apart(a: Any, b: Any) -> float:
    """Largest distance from a corner to the nearest of the others."""
    return float(np.linalg.norm(a[:, None] - b[None], axis=-1).min(axis=1).max())


def test_kitti_boxes_stand_where_ours_do(boxed: list[Annotation]) -> None:
    root = Path("there/hard")
    lines = (root / "label_2/000000.txt").read_text().splitlines()
    assert lines[3].split()[0] == "DontCare"
    a, b, c, d = (float(v) for v in (root / "denorm/000000.txt").read_text().split())
    assert d == pytest.approx(6.5)
    # Rope3D's tilt: the rotation about the axis between the camera's y and the road's downward normal.
    down = -np.array([a, b, c])
    axis = np.cross([0, 1, 0], down)
    angle = np.arctan2(np.linalg.norm(axis), down[1])
    n = axis / np.linalg.norm(axis)
    cross = np.array([[0, -n[2], n[1]], [n[2], 0, -n[0]], [-n[1], n[0], 0]])
    tilt = np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    rotations = np.loadtxt(root / "rotation/000000.txt").reshape(-1, 3, 3)
    for i, (line, vehicle) in enumerate(zip(lines, boxed, strict=False)):
        kind, *cells = line.split()
        truncated, occluded, alpha, *rest = map(float, cells)
        (h, w, length), at, ry = rest[4:7], rest[7:10], rest[10]
        assert (kind, truncated, occluded) == ("Van", 0.1, i)
        assert alpha == pytest.approx(ry - np.arctan2(at[0], at[2]), abs=1e-3)
        assert np.abs(np.array(rest[:4]) - [*vehicle.bbox[:2], *(vehicle.bbox[:2] + vehicle.bbox[2:])]).max() < 0.011
        turn = np.array([[np.cos(ry), 0, np.sin(ry)], [0, 1, 0], [-np.sin(ry), 0, np.cos(ry)]])
        truth = CAMERA.to_camera(box_corners(vehicle.box_3d))
        assert apart(kitti_corners(h, w, length, at, rotations[i]), truth) < 0.001
        # The set of corners is the same for a mirrored box: the axes are told by points with names.
        assert np.linalg.det(rotations[i]) == pytest.approx(1, abs=1e-6)
        named = [[length / 2, -h / 2, 0], [0, -h, 0], [0, -h / 2, w / 2]]  # middles of the front, top and left
        box = vehicle.box_3d
        assert box is not None
        ours = CAMERA.to_camera(np.diag(box.size_lwh / 2)[[0, 2, 1]] @ box.R.T + box.center)
        assert np.abs(np.array(at) + np.array(named) @ rotations[i].T - ours).max() < 0.001
        level = apart(kitti_corners(h, w, length, at, tilt @ turn), truth)
        assert level < 0.001 if i < 2 else 0.05 < level < 0.3  # its own pitch is not in the label
        # Without the tilt the box would not stand on the road.
        assert apart(kitti_corners(h, w, length, at, turn), truth) > 0.3


def test_kitti_cameras_are_read_as_rope3d_files(boxed: list[Annotation]) -> None:
    assert np.abs(read_calibration(Path("there/hard/calib/000000.txt")).K - CAMERA.K).max() < 1e-6
    T = over_plane(read_plane(Path("there/hard/denorm/000000.txt")), position=(3, -2), yaw=0.7)
    assert np.abs(T - CAMERA.T_camera_world).max() < 1e-6


def test_kitti_needs_cameras_and_boxes(skope: Any) -> None:
    root = make_dataset(Path("ours"), images=1, splits=("hard",))
    code, _, err = skope("gen", "convert", "ours", "there", "--to", "kitti", "-q")
    assert (code, "ours: hard: image 1, annotation 1: box_3d: missing" in err) == (2, True)
    path = root / "annotations" / "hard.json"
    file = coco.read(path)
    coco.write(path, replace(file, images=(replace(file.images[0], camera=None),)))
    code, _, err = skope("gen", "convert", "ours", "there", "--to", "kitti", "-q")
    assert (code, "ours: hard: image 1: camera: missing" in err, Path("there").exists()) == (2, True, False)


# ------------------------------------------------------------------------------------------------------------------ MOT


def test_mot_sequences(skope: Any, ours: Path) -> None:
    assert skope("gen", "convert", "ours", "there", "--to", "mot", "-q")[0] == 0
    folder = Path("there/easy/site_00")
    info = configparser.ConfigParser()
    info.read(folder / "seqinfo.ini")
    assert dict(info["Sequence"]) == {
        **{"name": "site_00", "imdir": "img1", "framerate": "2", "seqlength": "12"},
        **{"imwidth": "160", "imheight": "120", "imext": ".png"},
    }
    file = open_dataset(ours).read("easy")
    for number, image in enumerate(file.images, start=1):
        assert (folder / f"img1/{number:06d}.png").read_bytes() == (ours / image.file_name).read_bytes()
    rows = np.loadtxt(folder / "gt/gt.txt", delimiter=",")
    assert rows.tolist() == [[1, 500, 10, 12, 60, 40, 1, 1, 1], [1, 501, 84, 56, 60, 40, 0, 1, 1]]
    path = ours / "annotations" / "easy.json"
    coco.write(path, replace(file, annotations=(replace(file.annotations[0], track_id=None),)))
    code, _, err = skope("gen", "convert", "ours", "again", "--to", "mot", "-q")
    assert (code, "annotation 499: track_id: missing" in err) == (2, True)


def test_scenes_say_what_they_leave_out(skope: Any, ours: Path) -> None:
    code, out, _ = skope("gen", "convert", "ours", "zips", "--to", "skope3d")
    assert (code, "1 ignored vehicles are left out" in out) == (0, True)


def test_shards_are_exported_like_folders(skope: Any, ours: Path) -> None:
    file = open_dataset(ours).read("easy")
    own = file.by_image()
    shard = Path("tars/shards/easy-000000.tar")
    members = []
    for image in file.images:
        stem = f"site/{image.recording}_{image.frame_index:06d}"
        row = coco.image_to_dict(image) | {"file_name": f"shards/{shard.name}/{stem}.png"}
        labels = {"image": row, "annotations": [coco.annotation_to_dict(a) for a in own[image.id]]}
        members += [(f"{stem}.png", (ours / image.file_name).read_bytes())]
        members += [(f"{stem}.json", json.dumps(labels).encode())]
    shards.write_shard(shard, members)
    write_json(Path("tars/dataset.json"), {"version": 1, **keypoints.SKOPE33.fields(), "format": "shards"})
    (ours / "annotations" / "train.json").unlink()
    for form in ("coco", "mot"):
        for root in ("ours", "tars"):
            assert skope("gen", "convert", root, f"{form}_{root}", "--to", form, "-q")[0] == 0
        assert files_below(Path(f"{form}_ours")) == files_below(Path(f"{form}_tars"))


def files_below(root: Path) -> dict[str, bytes]:
    return {str(path.relative_to(root)): path.read_bytes() for path in root.rglob("*") if path.is_file()}


def test_exports_share_the_images_of_the_dataset(skope: Any, ours: Path) -> None:
    """Linked, not copied, and none the worse for it."""
    for form in ("coco", "yolo", "mot"):
        assert skope("gen", "convert", "ours", form, "--to", form, "-q")[0] == 0
    image = ours / open_dataset(ours).read("easy").images[0].file_name
    assert image.stat().st_nlink == 4
    assert {finding.text for finding in check(open_dataset(ours))} == {"site: site is also in split easy"}


@pytest.mark.parametrize(
    ("card", "manifest", "said"),
    [
        ({}, None, "manifest.json: no such file: only datasets made by `skope gen` can be converted"),
        ({}, {}, "dataset.json: takes, parameters: missing"),
        (
            {"takes": [["site", "00", "train", 13]], "parameters": hostile.parameters()},
            None,
            "train: has fewer images than its card states",
        ),
        (
            {"takes": [["site", "00", "train", 13]], "parameters": {**hostile.parameters(), "rules": {}}},
            None,
            "dataset.json: parameters.rules.",
        ),
    ],
)
def test_shards_are_made_of_whole_datasets(skope: Any, ours: Path, card: Any, manifest: Any, said: str) -> None:
    if card:
        images = [image.file_name for split in ("train", "easy") for image in open_dataset(ours).read(split).images]
        manifest = {"sha256": dict.fromkeys(images, ""), "tallies": {name: {} for name in images}}
    if manifest is not None:
        write_json(ours / "manifest.json", manifest)
    write_json(ours / "dataset.json", {**read_json(ours / "dataset.json"), **card})
    code, out, err = skope("gen", "convert", "ours", "tars", "--to", "shards", "-q")
    assert (code, out, err.count("\n"), Path("tars").exists()) == (2, "", 1, False)
    assert said in err
