"""`skope eval` and `skope eval predict` with a detector that finds people on foot and on two wheels too."""

import json
import re
from collections import Counter
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from skope import boxes as box_math
from skope.boxes import xywh_to_xyxy
from skope.dataset import coco
from skope.detections import apart
from skope.detector import fit_score_calibration
from skope.detector.checkpoint import read_checkpoint
from skope.footage.overlays import blurred
from skope.metrics.road_users import box_outcomes
from skope.schema import CATEGORY_NAMES, Annotation, AnnotationFile, Image, Result, RoadUser, RoadUserResult
from tests import road_users, samples

QUIET = ("--device", "cpu", "-q")


def read(path: Path) -> Any:
    return json.loads(path.read_text())


def as_truth(found: Iterable[Result]) -> list[Annotation]:
    """Annotations that say what was found."""
    return [
        replace(
            samples.make_annotation(i, one.image_id, tuple(one.bbox)),
            keypoints=one.keypoints.round() * [1, 1, 0] + [0, 0, 2],
        )
        for i, one in enumerate(found, start=1)
    ]


def test_figures_of_other_road_users_stand_beside_those_of_vehicles(
    skope: Any, categories_run: Path, tmp_path: Path
) -> None:
    data = road_users.make_dataset(tmp_path / "data", images=3, splits=("easy",))
    common = ("--data", data, "--split", "easy", "--score", "0.2", *QUIET)
    code, said, error = skope("eval", *common, "--checkpoint", categories_run, "--out", "eval")
    assert code == 0, error
    entry = read(Path("eval/metrics.json"))["splits"]["easy"]
    assert list(entry["categories"]) == list(CATEGORY_NAMES[1:])
    assert entry["categories"]["pedestrian"]["all"]["ground_truth"] == 3
    assert entry["categories"]["motorcycle"]["all"]["recall"] is None
    assert entry["ground_truth"] == 6, "vehicles alone"
    first = next(line for line in said.splitlines() if " pedestrian " in line)
    assert first.split()[:3] == ["easy", "pedestrian", "all"]
    motorcycle = entry["categories"]["motorcycle"]
    sizes = [size for size, figures in motorcycle.items() if size == "all" or figures["detections"]]
    assert sum(" motorcycle " in line for line in said.splitlines()) == len(sizes)
    page = Path("eval/report.html").read_text()
    assert "Pedestrians and two-wheelers" in page
    assert re.search(r'data-tip="pedestrian \d+"', page), "labelled ones in the pictures"
    assert re.search(r'data-tip="(bicycle|motorcycle|pedestrian), score 0\.\d\d"', page), "and those that are found"
    vehicles, others = apart(coco.iter_all_results(Path("eval/predictions_easy.json")))
    assert len(vehicles) > 3
    assert {other.category for other in others} == set(CATEGORY_NAMES[1:])
    assert entry["detections"] == sum(vehicle.score > 0.2 for vehicle in vehicles)
    rows = [row for row in read(Path("eval/predictions_easy.json")) if row["category_id"] > 1]
    assert not any("keypoints" in row for row in rows)
    # The results file by itself gives the same figures; vehicles' do not depend on the others.
    alone = ("--predictions", Path("eval/predictions_easy.json"), *common)
    assert skope("eval", *alone, "--out", "again")[0] == 0
    assert read(Path("again/metrics.json"))["splits"]["easy"] == entry
    coco.write_results(Path("vehicles.json"), vehicles)
    assert skope("eval", "--predictions", "vehicles.json", *common, "--out", "vehicles")[0] == 0
    without = read(Path("vehicles/metrics.json"))["splits"]["easy"]
    assert without == {key: value for key, value in entry.items() if key != "categories"}


def test_boxes_without_keypoints_have_the_same_figures_of_boxes(skope: Any, tmp_path: Path) -> None:
    data = road_users.make_dataset(tmp_path / "data", images=3, splits=("easy",))
    truth = coco.read(data / "annotations" / "easy.json")
    with_points = [
        {
            "image_id": label.image_id,
            "category_id": label.category_id,
            "bbox": (np.array(label.bbox) + [1, 0, 0, 0]).tolist(),
            "score": 0.5 + label.id / 100,
        }
        | ({"keypoints": np.minimum(label.keypoints, [1e4, 1e4, 1]).ravel().tolist()} if label.category_id == 1 else {})
        for label in (*truth.annotations, *truth.road_users)
    ]
    boxes = [{key: value for key, value in row.items() if key != "keypoints"} for row in with_points]
    numbers = {1: 3, 2: 2, 3: 4, 4: 1}
    in_coco = [row | {"category_id": numbers[row["category_id"]]} for row in boxes]
    stop_sign = boxes[0] | {"category_id": 13, "score": 0.99}
    entries, said = {}, {}
    for name, rows, scheme in (
        ("points", with_points, ()),
        ("boxes", boxes, ("--scheme", "boxes")),
        ("coco", [*in_coco, stop_sign], ("--scheme", "coco")),
        ("twisted", [row for row in in_coco if row["category_id"] > 1], ()),
        ("people", [row for row in in_coco if row["category_id"] == 1], ("--scheme", "coco")),
    ):
        Path(f"{name}.json").write_text(json.dumps(rows))
        common = ("--data", data, "--split", "easy", "--score", "0.3", *QUIET)
        code, said[name], error = skope("eval", *common, "--predictions", f"{name}.json", *scheme, "--out", name)
        assert code == 0, error
        said[name] += error
        entries[name] = read(Path(name, "metrics.json"))["splits"]["easy"]
    assert entries["coco"] == entries["boxes"]
    wanted, found = entries["points"], entries["boxes"]
    assert found["coco"]["box_ap50"] == wanted["coco"]["box_ap50"] == 1
    assert found["categories"] == wanted["categories"]
    assert found["iou"]["0.6"]["box_recall"] == wanted["iou"]["0.6"]["box_recall"]
    assert wanted["coco"]["keypoint_ap50"] == 1
    assert found["coco"]["keypoint_ap50"] is None
    assert found["iou"]["0.6"]["pck"] is None
    # Numbers of COCO that are read as skope's: cars would be motorcycles, and no vehicle would be there.
    assert entries["twisted"]["detections"] == 0
    misread = sum(row["category_id"] > 1 for row in in_coco)
    assert f"twisted.json: {misread} results of bicycles, motorcycles and pedestrians" in said["twisted"]
    assert "--scheme coco" in said["twisted"]
    assert "--scheme coco" not in said["people"]
    code, _, error = skope("eval", "--data", data, "--split", "easy", "--predictions", "boxes.json", "--out", "none")
    assert code == 2
    assert "boxes.json: results[0]: field keypoints is missing" in error
    assert "--scheme boxes or coco" in error


def test_where_the_ground_truth_labels_vehicles_alone_there_are_no_other_figures(
    skope: Any, categories_run: Path, tmp_path: Path
) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("easy",))
    code, said, error = skope("eval", "--data", data, "--checkpoint", categories_run, "--out", "eval", *QUIET)
    assert code == 0, error
    assert "categories" not in read(Path("eval/metrics.json"))["splits"]["easy"]
    assert "pedestrian" not in said
    assert "two wheels" not in Path("eval/report.html").read_text()


def test_on_given_boxes_there_are_vehicles_alone(skope: Any, categories_run: Path, tmp_path: Path) -> None:
    data = road_users.make_dataset(tmp_path / "data", images=1, splits=("easy",))
    given = ("--boxes", "given", "--data", data, "--checkpoint", categories_run, "--out", "eval", *QUIET)
    assert skope("eval", *given)[0] == 0
    assert "categories" not in read(Path("eval/metrics.json"))["splits"]["easy"]


def test_a_calibration_says_whom_it_leaves_out(skope: Any, categories_run: Path, tmp_path: Path) -> None:
    data = road_users.make_dataset(tmp_path / "data", images=2, splits=("easy",))
    common = ("--data", data, "--split", "easy", "--checkpoint", categories_run, "--device", "cpu")
    assert skope("eval", *common, "--out", "eval")[0] == 0
    # The truth is what it finds, so that it finds something.
    path, found = data / "annotations" / "easy.json", coco.read_results(Path("eval/predictions_easy.json"))
    vehicles = as_truth(found)
    coco.write(path, replace(coco.read(path), annotations=tuple(vehicles), road_users=()))
    code, said, error = skope("eval", "calibrate-scores", *common, "--score", "0.05", "--out", "a.safetensors")
    assert code == 0, error
    for name in CATEGORY_NAMES[1:]:
        assert f"{name}: not calibrated, a threshold means another thing for it: of " in said
    assert read_checkpoint(Path("a.safetensors"))[0]["metadata"]["calibrated"]["categories"] == [CATEGORY_NAMES[0]]


def test_a_calibration_of_each_category(
    skope: Any, categories_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where the data tell, each category has its own numbers: a score of it is its share of right ones."""
    monkeypatch.setattr(
        fit_score_calibration, "CALIBRATION_FIT", replace(fit_score_calibration.CALIBRATION_FIT, least_outcomes=2)
    )
    data = road_users.make_dataset(tmp_path / "data", images=2, splits=("easy",))
    common = ("--data", data, "--split", "easy", "--checkpoint", categories_run, "--device", "cpu")
    assert skope("eval", *common, "--out", "eval")[0] == 0
    path = data / "annotations" / "easy.json"
    vehicles, others = apart(coco.iter_all_results(Path("eval/predictions_easy.json")))
    marked = as_truth(vehicles)
    # Of each category every second one that is found is there.
    users = [
        RoadUser(
            id=len(marked) + i, image_id=one.image_id, category_id=one.category_id, bbox=one.bbox.round(1), area=9.0
        )
        for i, one in enumerate(others, start=1)
        if i % 2
    ]
    coco.write(path, replace(coco.read(path), annotations=tuple(marked), road_users=tuple(users)))
    code, said, error = skope("eval", "calibrate-scores", *common, "--score", "0.05", "--out", "a.safetensors")
    assert code == 0, error
    known = read_checkpoint(Path("a.safetensors"))[0]["metadata"]["calibrated"]["categories"]
    assert len(known) > 1
    for name in known[1:]:
        assert f"{name}, after: log loss" in said


def test_outcomes_of_a_category_are_those_of_brute_force(tmp_path: Path) -> None:
    """In order of scores each takes the free road user that it overlaps most, from an IoU of 0.5."""
    rng = np.random.default_rng(5)
    size = Image(id=1, file_name="a.jpg", width=400, height=300)
    boxes = np.concatenate([rng.uniform(0, 250, (12, 2)), rng.uniform(20, 40, (12, 2))], axis=1)
    users = tuple(
        RoadUser(id=i, image_id=1, category_id=2, bbox=box, area=float(box[2:].prod()), iscrowd=int(i == 1))
        for i, box in enumerate(boxes, start=1)
    )
    shaken = np.concatenate([boxes, boxes + rng.normal(0, 4, boxes.shape), boxes + rng.normal(0, 9, boxes.shape)])
    found = [
        RoadUserResult(image_id=1, category_id=2, score=float(score), bbox=box)
        for score, box in zip(rng.permutation(36) / 40, shaken, strict=True)
    ]
    truth = AnnotationFile(images=(size,), annotations=(), road_users=users, categories=CATEGORY_NAMES)
    free, expected = set(range(1, 12)), []
    for one in sorted(found, key=lambda result: -result.score):
        overlaps = box_math.iou(xywh_to_xyxy(one.bbox[None]), xywh_to_xyxy(boxes))[0]
        best = max(free, key=lambda i: overlaps[i], default=None)
        hit = best is not None and overlaps[best] >= 0.5
        if hit:
            free.discard(best)
        elif box_math.share_inside(xywh_to_xyxy(one.bbox[None]), xywh_to_xyxy(boxes[:1]))[0, 0] >= 0.5:
            continue
        expected.append((one.score, hit))
    scores, right = box_outcomes(truth, [*found, replace(found[0], category_id=3)], "bicycle")
    order = np.argsort(-scores, kind="stable")
    assert list(zip(scores[order].tolist(), right[order].tolist(), strict=True)) == expected
    assert 8 < right.sum() < len(right)


def test_predicting_images(skope: Any, categories_run: Path, tmp_path: Path) -> None:
    data = road_users.make_dataset(tmp_path / "data", images=2, splits=("easy",))
    wanted = ("--checkpoint", categories_run, "--score", "0.2", "--overlay", "--blur", "--device", "cpu")
    code, said, error = skope("eval", "predict", data / "images" / "site", *wanted, "--out", "seen")
    assert code == 0, error
    vehicles, others = apart(coco.iter_all_results(Path("seen/predictions.json")))
    assert vehicles
    assert others
    assert coco.read(Path("seen/frames.json")).categories == CATEGORY_NAMES
    counts = Counter(other.category for other in others)
    line = next(line for line in said.splitlines() if line.endswith(" in 2 images"))
    assert line.startswith(f"{len(vehicles)} vehicles, ")
    assert all(f"{count} {name}" in line for name, count in counts.items())
    assert len(list(Path("seen/overlays").rglob("*.jpg"))) == 2


@pytest.mark.parametrize("more", [(), pytest.param(("--every-frame",), marks=pytest.mark.slow), ("--unconfirmed",)])
def test_predicting_a_video(skope: Any, categories_run: Path, stops_after: Any, more: tuple[str, ...]) -> None:
    """Numbers are one category's, and a stopped run ends with the same bytes."""
    writer = cv2.VideoWriter("v.mp4", cv2.VideoWriter.fourcc(*"mp4v"), 10, (96, 64))
    noise = np.random.default_rng(0).integers(0, 256, (64, 106, 3), dtype=np.uint8)
    for i in range(12):
        writer.write(np.ascontiguousarray(noise[:, i // 2 : i // 2 + 96]))
    writer.release()
    wanted = ("v.mp4", "--checkpoint", categories_run, "--score", "0.15", "--overlay", *QUIET, *more)
    assert skope("eval", "predict", *wanted, "--out", "whole")[0] == 0
    _, others = apart(coco.iter_all_results(Path("whole/predictions.json")))
    assert others
    kinds: dict[int, set[str]] = {}
    for row in read(Path("whole/predictions.json")):
        kinds.setdefault(row["track_id"], set()).add(CATEGORY_NAMES[row["category_id"] - 1])
    assert all(len(names) == 1 for names in kinds.values())
    numbers = [max(n for n, names in kinds.items() if "vehicle" in names)]
    assert min(n for n, names in kinds.items() if "vehicle" not in names) == numbers[0] + 1
    with stops_after(2):
        skope("eval", "predict", *wanted, "--out", "parts")
    assert skope("eval", "predict", *wanted, "--out", "parts")[0] == 0
    assert Path("parts/predictions.json").read_bytes() == Path("whole/predictions.json").read_bytes()


def test_heads_are_made_unrecognisable_and_nothing_else_is() -> None:
    image = np.random.default_rng(3).integers(0, 256, (200, 200, 3), dtype=np.uint8)
    user = RoadUserResult(image_id=1, score=0.9, bbox=np.array([80.0, 60, 40, 100]), category_id=4)
    out = blurred(image, [], [user])
    head = (slice(60, 100), slice(80, 120))
    assert out[head].std() < 0.25 * image[head].std()
    changed = (out != image).any(axis=2)
    assert not changed[:50].any()
    assert not changed[110:].any()
    assert not changed[:, :70].any()
    assert not changed[:, 126:].any()
    assert np.array_equal(blurred(image, []), image)


def test_vehicles_and_others_are_told_apart_in_their_order() -> None:
    vehicle = Result(image_id=1, score=0.5, bbox=np.zeros(4), keypoints=np.zeros((33, 3)))
    user = RoadUserResult(image_id=1, score=0.9, bbox=np.zeros(4), category_id=2)
    second = replace(user, category_id=3)
    assert apart([vehicle, user, second]) == ([vehicle], [user, second])
