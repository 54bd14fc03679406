import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.dataset import coco
from skope.schema import AnnotationFile, Image, Result, RoadUserResult
from tests.samples import make_annotation, make_road_user

IMAGES = 60


@pytest.fixture
def runs(skope: Any, tmp_path: Path) -> tuple[Path, Path]:
    """Two detectors on the same 60 images, 2 s apart; B misses each seventh vehicle of those that A finds."""
    rng = np.random.default_rng(0)
    images = tuple(
        Image(id=i, file_name=f"{i}.png", width=200, height=100, site="a", recording="00", time_s=2.0 * i)
        for i in range(1, IMAGES + 1)
    )
    vehicles = tuple(make_annotation(i, i, (10, 10, 100, 60)) for i in range(1, IMAGES + 1))
    coco.write(tmp_path / "truth.json", AnnotationFile(images=images, annotations=vehicles))
    found = []
    for vehicle in vehicles:
        points = vehicle.keypoints + np.pad(rng.normal(0, 7, (33, 2)), ((0, 0), (0, 1)))
        if rng.random() < 0.8:
            found.append(Result(image_id=vehicle.image_id, score=0.95, bbox=vehicle.bbox, keypoints=points))
    coco.write_results(tmp_path / "a.json", found)
    coco.write_results(tmp_path / "b.json", [r for i, r in enumerate(found) if i % 7])
    for name in "ab":
        common = ("--annotations", "truth.json", "--predictions", f"{name}.json", "--out", name)
        assert skope("eval", *common)[0] == 0
    return tmp_path / "a", tmp_path / "b"


def row(document: dict[str, Any], figure: str, protocol: str | None, t: str = "0.6") -> dict[str, Any]:
    (found,) = (r for r in document["splits"]["truth"]["iou"][t] if (r["figure"], r["protocol"]) == (figure, protocol))
    return found


def test_differences_and_their_intervals(skope: Any, runs: tuple[Path, Path]) -> None:
    code, out, err = skope("eval", "compare", *runs, "--out", "compare.json")
    assert (code, err) == (0, "")
    document = json.loads(Path("compare.json").read_text())
    a, b = (json.loads((run / "metrics.json").read_text())["splits"]["truth"] for run in runs)
    recall = row(document, "box_recall", "pooled")
    assert recall["values"] == [a["iou"]["0.6"]["box_recall"]["pooled"], b["iou"]["0.6"]["box_recall"]["pooled"]]
    (gap,) = recall["differences"]
    assert gap["value"] == pytest.approx(recall["values"][1] - recall["values"][0])
    low, high = gap["interval"]
    assert low <= gap["value"] <= high < 0
    # Paired: far narrower than what the two intervals by themselves would give.
    alone = [of["intervals"]["iou"]["0.6"]["box_recall"]["pooled"] for of in (a, b)]
    assert high - low < 0.7 * np.hypot(*(top - bottom for bottom, top in alone))
    line = next(line for line in out.splitlines() if line.split()[:3] == ["0.6", "box", "recall"])
    assert line.rstrip().endswith("*")
    precision = row(document, "box_precision", "pooled")
    assert precision["values"] == [1.0, 1.0]
    assert precision["differences"] == [{"value": 0.0, "interval": [0.0, 0.0]}]
    assert "keypoint ap" in out
    assert "12 blocks of 10 s of one site" in out or "13 blocks" in out


def test_a_run_does_not_differ_from_itself(skope: Any, runs: tuple[Path, Path]) -> None:
    _, out, _ = skope("eval", "compare", runs[0], runs[0], "--protocol", "paper")
    rows = [line for line in out.splitlines() if line.startswith("  0.")]
    assert len(rows) == 20
    assert all("+0.000 +0.000..+0.000" in line for line in rows)


def test_images_are_paired_by_id_not_by_place(skope: Any, runs: tuple[Path, Path], tmp_path: Path) -> None:
    file = coco.read(tmp_path / "truth.json")
    coco.write(tmp_path / "truth.json", replace(file, images=file.images[::-1]))
    assert skope("eval", "--annotations", "truth.json", "--predictions", "b.json", "--out", "turned")[0] == 0
    skope("eval", "compare", *runs, "--out", "one.json")
    skope("eval", "compare", runs[0], "turned", "--out", "two.json")
    one, two = (json.loads(Path(name).read_text())["splits"]["truth"]["iou"] for name in ("one.json", "two.json"))
    for t, rows in one.items():
        for ours, theirs in zip(rows, two[t], strict=True):
            (p,), (q,) = ours["differences"], theirs["differences"]
            assert p["value"] == pytest.approx(q["value"])
            assert p["interval"] == pytest.approx(q["interval"])


def test_what_cannot_be_compared_gets_one_line(skope: Any, runs: tuple[Path, Path], tmp_path: Path) -> None:
    def said(*folders: object) -> str:
        code, out, err = skope("eval", "compare", *folders)
        assert (code, out, err.count("\n")) == (2, "", 1)
        return str(err)

    common = ("--annotations", "truth.json", "--predictions", "b.json")
    skope("eval", *common, "--alpha", "0.2", "--out", "wide")
    assert "differ in alpha: 0.1 and 0.2" in said(runs[0], "wide")
    file = coco.read(tmp_path / "truth.json")
    coco.write(tmp_path / "truth.json", replace(file, annotations=file.annotations[:-1]))
    skope("eval", *common, "--out", "other")
    assert "not the ground truth of" in said(runs[0], "other")
    coco.write(tmp_path / "truth.json", replace(file, images=file.images[:-1], annotations=file.annotations[:-1]))
    (tmp_path / "none.json").write_text("[]")
    skope("eval", "--annotations", "truth.json", "--predictions", "none.json", "--out", "fewer")
    assert "split truth: not the images of" in said(runs[0], "fewer")
    assert "metrics.json: no such file" in said(runs[0], "gone")
    assert "expected the folders of two or more" in said(runs[0])
    (tmp_path / "fewer" / "tallies.json").write_text('{"version": 1, "splits": {"truth": {"image_ids": 3}}}')
    assert "tallies.json: damaged" in said("fewer", runs[0])
    (tmp_path / "fewer" / "tallies.json").write_text('{"version": 7}')
    assert "not a file of `skope eval` of version 1" in said("fewer", runs[0])


def test_figures_of_other_road_users_stand_side_by_side(skope: Any, tmp_path: Path) -> None:
    """Also where one of the detectors knows none of them."""
    image = Image(id=1, file_name="1.png", width=300, height=200)
    users = (make_road_user(2, 1, (10, 100, 20, 50)), make_road_user(3, 1, (60, 100, 20, 50)))
    vehicle = make_annotation(1, 1, (100, 10, 100, 60))
    file = AnnotationFile(
        images=(image,), annotations=(vehicle,), road_users=users, categories=("vehicle", "pedestrian")
    )
    coco.write(tmp_path / "truth.json", file)
    car = Result(image_id=1, score=0.95, bbox=vehicle.bbox, keypoints=vehicle.keypoints)
    people = [RoadUserResult(image_id=1, score=0.95, bbox=u.bbox, category_id=4) for u in users]
    for name, found in (("a", [car, *people]), ("b", [car, people[0]]), ("c", [car])):
        coco.write_results(tmp_path / f"{name}.json", found)
        assert skope("eval", "--annotations", "truth.json", "--predictions", f"{name}.json", "--out", name)[0] == 0
    code, out, err = skope("eval", "compare", "a", "b", "c")
    assert (code, err) == (0, "")
    rows = [line.split() for line in out.splitlines() if " pedestrian " in line]
    assert ["pedestrian", "recall", "1.000", "0.500", "-"] in rows
    assert ["pedestrian", "precision", "1.000", "1.000", "-"] in rows
    assert skope("eval", "compare", "c", "c", "--out", "same.json")[0] == 0
    assert "categories" not in json.loads(Path("same.json").read_text())["splits"]["truth"]
