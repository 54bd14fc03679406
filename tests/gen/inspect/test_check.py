import json
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from skope.cli import app
from skope.dataset.folder import open_dataset
from skope.gen.inspect.check import check
from tests.gen.small import content

Document = dict[str, Any]


@pytest.fixture
def copy(whole: Path, tmp_path: Path) -> Path:
    root = tmp_path / "damaged"
    shutil.copytree(whole, root)
    return root


def largest(document: Document) -> Any:
    """The vehicle with the most visible pixels."""
    return max(document["annotations"], key=lambda a: a["area"])


def move_keypoint(document: Document) -> None:
    row = largest(document)
    k = row["keypoints"][2::3].index(2)
    row["keypoints"][3 * k] = (row["keypoints"][3 * k] + 40) % 190


def show_hidden(document: Document) -> None:
    row = largest(document)
    for k in range(33):
        if row["keypoints"][3 * k + 2] == 1:
            row["keypoints"][3 * k + 2] = 2


def hide_in_image(document: Document) -> None:
    row = largest(document)
    k = row["keypoints"][2::3].index(2)
    row["keypoints"][3 * k : 3 * k + 3] = [0, 0, 0]
    row["num_keypoints"] -= 1


def hide_visible(document: Document) -> None:
    row = largest(document)
    row["keypoints"][2::3] = [1 if v == 2 else v for v in row["keypoints"][2::3]]


def point_outside(document: Document) -> None:
    row = largest(document)
    k = row["keypoints"][2::3].index(2)
    row["keypoints"][3 * k] = 1000


def leave_coordinates(document: Document) -> None:
    row = next(a for a in document["annotations"] if 0 in a["keypoints"][2::3])
    k = row["keypoints"][2::3].index(0)
    row["keypoints"][3 * k] = 7


def set_in(row: Callable[[Document], Any], **values: Any) -> Callable[[Document], None]:
    return lambda document: row(document).update(values)


def first_image(document: Document) -> Any:
    return document["images"][0]


def repeat_annotation(document: Document) -> None:
    document["annotations"][1]["id"] = document["annotations"][0]["id"]


def repeat_image(document: Document) -> None:
    document["images"][1]["id"] = document["images"][0]["id"]


def repeat_track(document: Document) -> None:
    own = [a for a in document["annotations"] if a["image_id"] == document["annotations"][0]["image_id"]]
    own[1]["track_id"] = own[0]["track_id"]


def repeat_file(document: Document) -> None:
    for key in ("file_name", "depth_file_name"):
        document["images"][1][key] = document["images"][0][key]


def move_camera(document: Document) -> None:
    document["images"][0]["camera"]["T_camera_world"][0][3] += 0.5


def turn_box(document: Document) -> None:
    largest(document)["box_3d"]["yaw"] += 0.1


def move_box(document: Document) -> None:
    largest(document)["box_3d"]["center"][0] += 5


def spoil_mask(document: Document) -> None:
    row = largest(document)
    other = next(a for a in document["annotations"] if a["area"] != row["area"])
    row["segmentation"] = other["segmentation"]


def shift_mask_box(document: Document) -> None:
    largest(document)["bbox_visible"][0] += 5


def hurry(document: Document) -> None:
    """A velocity that its vehicle's way to the next image does not bear out."""
    tracks = [a["track_id"] for a in document["annotations"]]
    row = next(a for a in document["annotations"] if tracks.count(a["track_id"]) > 1)
    row["velocity"][0] += 8


def lose_image(document: Document) -> None:
    gone = document["images"].pop()
    document["annotations"] = [a for a in document["annotations"] if a["image_id"] != gone["id"]]


def forget_reason(document: Document) -> None:
    next(a for a in document["annotations"] if a["iscrowd"])["ignore_reason"] = None


LABELS: list[tuple[Callable[[Document], None], list[str]]] = [
    (move_keypoint, ["keypoints:", "px from where keypoints_3d projects"]),
    (show_hidden, ["keypoints:", "has v = 2, but the depth file"]),
    (hide_visible, ["keypoints:", "has v = 1, but the depth file"]),
    (hide_in_image, ["keypoints:", "has v = 0"]),
    (point_outside, ["keypoints:", "outside the image"]),
    (leave_coordinates, ["keypoints:", "v = 0 with coordinates"]),
    (set_in(largest, num_keypoints=3), ["num_keypoints: is 3"]),
    (set_in(largest, bbox=[5.0, 5.0, 500.0, 20.0]), ["bbox: extends outside the image"]),
    (shift_mask_box, ["bbox_visible"]),
    (spoil_mask, ["segmentation:", "from area"]),
    (set_in(largest, area_full=1.0), ["area:"]),
    (set_in(largest, distance=1.0), ["distance: 1.00 m"]),
    (turn_box, ["box_3d.yaw"]),
    (move_box, ["keypoints_3d: a point lies far outside box_3d"]),
    (hurry, ["velocity: the mean with annotation", "m/s from the motion between them"]),
    (forget_reason, ["ignore_reason"]),
    (repeat_annotation, ["id", "stands twice"]),
    (repeat_image, ["share an id"]),
    (repeat_track, ["track_id", "is a duplicate in image"]),
    (repeat_file, ["file_name", "is a duplicate"]),
    (set_in(first_image, site="t01_mill_corner"), ["site: t01_mill_corner is also in split"]),
    (set_in(first_image, width=191), ["191"]),
    (move_camera, ["px from where keypoints_3d projects"]),
    (lose_image, ["takes: t01_main_west", "1 frames without an image"]),
]


@pytest.mark.parametrize(("damage", "words"), LABELS)
def test_damaged_labels_are_found(damage: Callable[[Document], None], words: list[str], copy: Path) -> None:
    path = copy / "annotations" / "medium.json"
    document = json.loads(path.read_text())
    damage(document)
    path.write_text(json.dumps(document))
    findings = list(map(str, check(open_dataset(copy))))
    assert any(all(word in finding for word in words) for finding in findings), findings
    # The changed bytes are a finding of their own.
    assert any(finding.startswith("annotations/medium.json: sha256") for finding in findings)


def test_test_splits_may_share_a_site_and_none_shares_one_with_training(copy: Path) -> None:
    annotations = copy / "annotations"
    first = json.loads((annotations / "medium.json").read_text())["images"][0]["site"]
    document = json.loads((annotations / "train.json").read_text())
    for image in document["images"]:
        image["site"] = first
    for split, found in (("easy", False), ("train", True)):
        path = annotations / f"{split}.json"
        kept = path.read_text() if path.exists() else None
        path.write_text(json.dumps(document))
        assert any("is also in split" in str(finding) for finding in check(open_dataset(copy))) == found
        path.unlink() if kept is None else path.write_text(kept)


@pytest.mark.parametrize(("x", "found"), [(-1.5, True), (-0.4, False)])
def test_points_far_outside_are_found_but_in_the_outermost_pixels(x: float, found: bool, copy: Path) -> None:
    """Of a mirror at the image's edge the part that holds the marked tip may lie beyond it."""
    path = copy / "annotations" / "medium.json"
    document = json.loads(path.read_text())
    row = min(document["annotations"], key=lambda a: a["bbox"][0] + a["bbox"][2])
    k = row["keypoints"][2::3].index(2)
    row["keypoints"][3 * k : 3 * k + 2] = [document["images"][0]["width"] + x, 1.5]
    path.write_text(json.dumps(document))
    assert any("far outside its" in str(finding) for finding in check(open_dataset(copy))) == found


def an_image(root: Path) -> Path:
    return sorted((root / "images").rglob("*.jpg"))[0]


def a_depth_file(root: Path) -> Path:
    return sorted((root / "depth").rglob("*.png"))[0]


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def flip_bit(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(bytes(data))


def redraw(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((10, 10, 3), np.uint8))


def edit(name: str, change: Callable[[Any], None]) -> Callable[[Path], None]:
    def run(root: Path) -> None:
        document = json.loads((root / name).read_text())
        change(document)
        (root / name).write_text(json.dumps(document))

    return run


FILES: list[tuple[Callable[[Path], None], list[str]]] = [
    (lambda root: an_image(root).unlink(), ["images/", "no such file"]),
    (lambda root: cut(an_image(root)), ["truncated"]),
    (lambda root: redraw(an_image(root)), ["10x10"]),
    (lambda root: flip_bit(an_image(root)), ["images/", "sha256"]),
    (lambda root: a_depth_file(root).unlink(), ["depth/", "no such file"]),
    (lambda root: a_depth_file(root).write_bytes(b"no picture"), ["depth/", "not a 16-bit depth image"]),
    (lambda root: redraw(a_depth_file(root)), ["depth/", "not a 16-bit depth image"]),
    (lambda root: flip_bit(a_depth_file(root)), ["depth/", "sha256"]),
    (lambda root: flip_bit(next((root / "recordings").iterdir())), ["recordings/", "sha256"]),
    (lambda root: (root / "images" / "mine.jpg").write_bytes(b""), ["images/mine.jpg", "is not in manifest.json"]),
    (lambda root: cut(root / "annotations" / "train.json"), ["annotations/train.json", "not valid JSON"]),
    (lambda root: (root / "annotations" / "train.json").unlink(), ["annotations/train.json", "no such file"]),
    (lambda root: cut(root / "manifest.json"), ["manifest.json", "cannot be read"]),
    (edit("dataset.json", lambda card: card["counts"].update(images=7)), ["counts.images: 7"]),
]


@pytest.mark.parametrize(("damage", "words"), FILES)
def test_damaged_files_are_found(damage: Callable[[Path], None], words: list[str], copy: Path) -> None:
    damage(copy)
    result = CliRunner().invoke(app, ["gen", "check", str(copy)])
    assert result.exit_code == 1
    assert any(all(word in line for word in words) for line in result.output.splitlines()), result.output
    assert result.output.splitlines()[-1].endswith(("finding", "findings"))


def test_a_sound_dataset_has_no_findings(whole: Path) -> None:
    result = CliRunner().invoke(app, ["gen", "check", str(whole)])
    assert result.exit_code == 0
    assert result.output == f"{whole}: no findings\n"


def test_repair_brings_back_the_same_bytes(whole: Path, copy: Path) -> None:
    an_image(copy).unlink()
    flip_bit(sorted((copy / "depth").rglob("*.png"))[1])
    (copy / "images" / "mine.jpg").write_bytes(b"")
    # Nothing but its bytes tells that this label was changed.
    edit("annotations/train.json", lambda document: largest(document).update(contrast=99.0))(copy)
    subprocess.run(
        [sys.executable, "-m", "skope", "gen", "check", str(copy), "--repair", "--workers", "1"],
        check=True,
        capture_output=True,
    )
    assert content(copy) == content(whole)


def test_a_lost_recording_is_named_with_the_command_that_makes_it(copy: Path) -> None:
    next((copy / "recordings").iterdir()).unlink()
    result = CliRunner().invoke(app, ["gen", "check", str(copy), "--repair", "--workers", "1"])
    assert result.exit_code != 0
    assert "has to be simulated again" in str(result.exception)
    assert "skope gen --preset demo --seed 0 --sites t01_mill_corner,t01_main_west --frames 5" in str(result.exception)


def test_differences_are_named(whole: Path, copy: Path) -> None:
    def run() -> list[str]:
        result = CliRunner().invoke(app, ["gen", "check", str(whole), "--against", str(copy)])
        assert result.exit_code == (0 if "no differences" in result.output else 1)
        return result.output.splitlines()

    assert run() == [f"{whole}: no differences from {copy}"]

    def change(document: Document) -> None:
        row = largest(document)
        row["bbox"][0] += 2.5
        row["keypoints"][2::3] = [1] * 33
        lose_image(document)

    edit("annotations/train.json", change)(copy)
    edit("dataset.json", lambda card: card["parameters"].update(seed=4))(copy)
    name = str(an_image(copy).relative_to(copy))
    edit("manifest.json", lambda manifest: manifest["sha256"].update({name: "0" * 64}))(copy)
    lines = run()
    assert "parameters.seed: 0 and 4" in lines
    assert any("1 frames only in" in line and "t01_mill_corner/00_000004" in line for line in lines)
    assert any("boxes differ by up to 2.50 px" in line for line in lines)
    assert any("v differs for" in line for line in lines)
    assert "images: 1 of 10 files differ" in lines
