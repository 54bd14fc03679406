import contextlib
import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from skope.dataset import coco
from skope.metrics.coco_ap import average_precision
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.schema import AnnotationFile, Result
from tests.samples import make_annotation, make_image

NAMES = ("box_ap", "box_ap50", "keypoint_ap", "keypoint_ap50")


def crowd(count: int = 60, **more: Any) -> AnnotationFile:
    """One image with `count` vehicles side by side."""
    boxes = [(10.0 + 95 * (i % 10), 10.0 + 70 * (i // 10), 90.0, 60.0) for i in range(count)]
    annotations = tuple(make_annotation(i, 1, box, **more) for i, box in enumerate(boxes, start=1))
    return AnnotationFile(images=(make_image(1, 1000, 500),), annotations=annotations)


def perfect(file: AnnotationFile, score: float = 0.5) -> list[Result]:
    return [Result(image_id=a.image_id, score=score, bbox=a.bbox, keypoints=a.keypoints) for a in file.annotations]


def exactly(value: float | None) -> dict[str, Any]:
    return dict.fromkeys(NAMES, value if value is None else pytest.approx(value, abs=1e-12))


def test_perfect_predictions_of_60_vehicles_in_an_image_score_1() -> None:
    file = crowd(60)
    assert average_precision(file, perfect(file), MetricOptions()) == exactly(1.0)


def test_without_ground_truth_there_is_no_precision() -> None:
    empty = AnnotationFile(images=(make_image(1),), annotations=())
    found = perfect(crowd(1))
    assert average_precision(empty, found, MetricOptions()) == exactly(None)
    assert average_precision(empty, [], MetricOptions()) == exactly(None)
    assert average_precision(replace(empty, images=()), [], MetricOptions()) == exactly(None)
    assert average_precision(crowd(2, iscrowd=1), found, MetricOptions()) == exactly(None)


def test_without_detections_precision_is_0() -> None:
    assert average_precision(crowd(2), [], MetricOptions()) == exactly(0.0)


def test_half_of_the_vehicles_found() -> None:
    # Precision is 1 up to recall 0.5: 51 of the 101 recalls 0, 0.01, ... 1.
    file = crowd(2)
    assert average_precision(file, perfect(file)[:1], MetricOptions()) == exactly(51 / 101)


def test_a_better_scored_false_vehicle_halves_precision() -> None:
    file = crowd(1)
    false = Result(image_id=1, score=0.9, bbox=np.array([900.0, 400, 50, 50]), keypoints=np.full((33, 3), 900.0))
    assert average_precision(file, [*perfect(file, 0.6), false], MetricOptions()) == exactly(0.5)
    assert average_precision(file, [*perfect(file, 0.95), false], MetricOptions()) == exactly(1.0)


def test_box_ap_over_iou_thresholds() -> None:
    # IoU 0.8 passes 0.50, 0.55, ... 0.80: seven of ten thresholds.
    file = crowd(1)
    (result,) = perfect(file)
    narrow = replace(result, bbox=result.bbox * [1, 1, 0.8, 1])
    figures = average_precision(file, [narrow], MetricOptions())
    assert (figures["box_ap"], figures["box_ap50"]) == (pytest.approx(0.7), pytest.approx(1.0))


def test_keypoint_ap_by_the_formula_of_object_keypoint_similarity() -> None:
    # exp(-d^2 / (2 area (2 sigma)^2)) is 0.72 for each of the 33: five of ten thresholds. The area is area_full.
    file = crowd(1)
    (vehicle,) = file.annotations
    assert vehicle.area_full is not None
    distance = np.sqrt(-np.log(0.72) * 2 * vehicle.area_full * 0.1**2)
    (result,) = perfect(file)
    shifted = replace(result, keypoints=result.keypoints + np.array([distance, 0, 0]))
    file = replace(file, annotations=(replace(vehicle, area=vehicle.area / 4),))
    assert average_precision(file, [shifted], MetricOptions())["keypoint_ap"] == pytest.approx(0.5)
    narrow = replace(file, annotations=(replace(file.annotations[0], area_full=None),))
    assert average_precision(narrow, [shifted], MetricOptions())["keypoint_ap"] == 0.0


def test_hidden_points_count_when_asked_for() -> None:
    file = crowd(1, hidden=20)
    (result,) = perfect(file)
    points = result.keypoints.copy()
    points[-20:, :2] += 500
    lost = replace(result, keypoints=points)
    assert average_precision(file, [lost], MetricOptions())["keypoint_ap"] == pytest.approx(1.0)
    assert average_precision(file, [lost], MetricOptions(labelled="all"))["keypoint_ap"] == 0.0


def test_a_detection_on_an_ignored_vehicle_is_neither_right_nor_wrong() -> None:
    file = crowd(2)
    ignored = replace(file, annotations=(file.annotations[0], replace(file.annotations[1], iscrowd=1)))
    found = [perfect(file, 0.5)[0], perfect(file, 0.9)[1]]
    assert average_precision(ignored, found, MetricOptions()) == exactly(1.0)


def test_more_than_pycocotools_own_twenty_detections_count_and_it_stays_silent(
    capsys: pytest.CaptureFixture[str],
) -> None:
    file = crowd(25)
    assert average_precision(file, perfect(file), MetricOptions())["keypoint_ap"] == pytest.approx(1.0)
    assert capsys.readouterr().out == ""


def test_inverted_boxes_and_ids_of_zero_are_handled() -> None:
    file = AnnotationFile(images=(make_image(0),), annotations=(make_annotation(0, 0, (0, 0, 60, 40)),))
    (good,) = perfect(file)
    inverted = replace(good, bbox=np.array([50.0, 50, -20, -20]), score=0.1)
    assert average_precision(file, [good, inverted], MetricOptions()) == exactly(1.0)


def test_pycocotools_loads_what_we_write(tmp_path: Path) -> None:
    file = crowd(3)
    coco.write(tmp_path / "truth.json", file)
    coco.write_results(tmp_path / "results.json", perfect(file))
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(str(tmp_path / "truth.json"))
        loaded = truth.loadRes(str(tmp_path / "results.json"))
    assert len(truth.anns) == len(loaded.anns) == 3
    assert len(truth.loadCats(1)[0]["keypoints"]) == 33


@pytest.mark.parametrize("seed", range(3))
def test_average_precision_is_that_of_pycocotools_own_files_and_loader(tmp_path: Path, seed: int) -> None:
    """Through files, `loadRes` and a plain COCOeval whose settings are made by hand; the mean over `precision`."""
    rng = np.random.default_rng(seed)
    file = crowd(40, hidden=9)
    results = []
    for vehicle in file.annotations:
        if rng.random() < 0.8:
            points = vehicle.keypoints + np.pad(rng.normal(0, 4, (33, 2)), ((0, 0), (0, 1)))
            box = vehicle.bbox + rng.normal(0, 4, 4)
            results.append(Result(image_id=1, score=float(rng.random()), bbox=box, keypoints=points))
    visible = tuple(replace(v, keypoints=np.where(v.keypoints[:, 2:] == 2, v.keypoints, 0.0)) for v in file.annotations)
    coco.write(tmp_path / "truth.json", replace(file, annotations=visible))
    coco.write_results(tmp_path / "results.json", results)
    ours = average_precision(file, coco.read_results(tmp_path / "results.json"), MetricOptions())
    with contextlib.redirect_stdout(io.StringIO()):
        truth = COCO(str(tmp_path / "truth.json"))
        # Loaded with their boxes: for keypoints `loadRes` would take the area from the points' extent.
        found = truth.loadRes(str(tmp_path / "results.json"))
        for kind, names in (("bbox", NAMES[:2]), ("keypoints", NAMES[2:])):
            evaluation = COCOeval(truth, found, kind)
            evaluation.params.maxDets = [300]
            evaluation.params.kpt_oks_sigmas = np.full(33, 0.05)
            evaluation.params.areaRng, evaluation.params.areaRngLbl = [[0, 1e10]], ["all"]
            evaluation.evaluate()
            evaluation.accumulate()
            precision = evaluation.eval["precision"][:, :, 0, 0, 0]
            assert 0.05 < precision.mean() < 0.95
            assert ours[names[0]] == pytest.approx(precision.mean(), abs=1e-12)
            assert ours[names[1]] == pytest.approx(precision[0].mean(), abs=1e-12)
