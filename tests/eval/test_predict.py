"""A detector with random weights, from the checkpoint to the metrics."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope import coco
from skope.console import Console
from skope.eval.predict import Predictor
from skope.eval.settings import Settings
from skope.schema import AnnotationFile
from tests.eval.conftest import files_of
from tests.samples import make_annotation, make_dataset, make_image


def test_a_checkpoint_is_evaluated_on_all_test_splits(skope: Any, random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("train", "hard", "easy"))
    code, out, err = skope("eval", "--data", root, "--checkpoint", random_run, "--score", "0.999", "--device", "cpu")
    assert code == 0, err
    lines = out.splitlines()
    assert any(line.endswith("for 1 images") and line.startswith("easy: about") for line in lines)
    assert lines[-1].startswith("Wrote metrics.json, tallies.json, predictions_{easy,hard}.json, overlays/ to ")
    assert lines[-1].endswith(f"open {random_run}/eval/report.html")
    assert any("No detection scores above 0.999 in easy, hard" in line for line in lines)
    assert any("--recipe scratch" in line and "--init coco" in line for line in lines)
    assert list(json.loads((random_run / "eval" / "metrics.json").read_text())["splits"]) == ["easy", "hard"]
    once = files_of(random_run / "eval")
    assert 0 < len(json.loads(once["predictions_easy.json"])) < 60
    assert set(once) >= {"predictions_easy.json", "predictions_hard.json", "overlays/easy_1.jpg", "overlays/hard_1.jpg"}

    skope("eval", "--data", root, "--checkpoint", random_run, "--score", "0.999", "--device", "cpu", "--out", "again")
    assert files_of(Path("again")) == once

    predictions = ("--predictions", random_run / "eval" / "predictions_easy.json", "--score", "0.999", "--out", "read")
    skope("eval", "--data", root, "--split", "easy", *predictions)
    read = json.loads(Path("read/metrics.json").read_text())["splits"]["easy"]
    assert read == json.loads(once["metrics.json"])["splits"]["easy"]


def test_given_boxes_put_keypoints_on_every_ground_truth_vehicle(random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("easy",))
    file = coco.read(root / "annotations" / "easy.json")
    first, second = file.annotations
    ignored = make_annotation(9, first.image_id, (5, 5, 20, 20), iscrowd=1)
    file = AnnotationFile(images=file.images, annotations=(second, ignored, first), name="easy")
    found = Predictor(random_run, Settings(device="cpu", given=True), Console(quiet=True)).split(file, root)
    assert [result.score for result in found] == [1.0, 1.0]
    for result, vehicle in zip(found, (first, second), strict=True):
        assert np.array_equal(result.bbox, vehicle.bbox)
        low, size = vehicle.bbox[:2], vehicle.bbox[2:]
        inside = (result.keypoints[:, :2] >= low - 1) & (result.keypoints[:, :2] <= low + size + 1)
        assert inside.all()


def test_given_boxes_match_all_vehicles(skope: Any, random_run: Path, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=1, splits=("easy",))
    skope("eval", "--data", root, "--checkpoint", random_run, "--boxes", "given", "--out", "out", "--quiet")
    entry = json.loads(Path("out/metrics.json").read_text())["splits"]["easy"]["iou"]["0.9"]
    assert entry["matched"] == 2
    assert entry["box_precision"] == entry["box_recall"] == {"paper": 1.0, "pooled": 1.0}


def test_a_split_without_images_has_no_results(random_run: Path, tmp_path: Path) -> None:
    predictor = Predictor(random_run, Settings(device="cpu"), Console(quiet=True))
    assert predictor.split(AnnotationFile(images=(), annotations=()), tmp_path) == ()
    file = AnnotationFile(images=(make_image(1),), annotations=())
    with pytest.raises(ValueError, match="no such file"):
        predictor.split(file, tmp_path)
