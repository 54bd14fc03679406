import json
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import pytest

from skope import keypoints
from skope.dataset import coco
from skope.schema import AnnotationFile, Result
from tests.conftest import files_of
from tests.samples import make_annotation, make_dataset, make_image


def write_pair(folder: Path, score: float = 0.95) -> tuple[Path, Path]:
    """Ground truth of two images, one of them empty, and results that find one of two vehicles and a false one."""
    vehicles = (make_annotation(1, 1, (10, 10, 60, 40)), make_annotation(2, 1, (80, 50, 60, 40)))
    truth, results = folder / "crossing.json", folder / "results.json"
    coco.write(truth, AnnotationFile(images=(make_image(1), make_image(2)), annotations=vehicles))
    (found, _) = (Result(image_id=1, score=score, bbox=a.bbox, keypoints=a.keypoints) for a in vehicles)
    coco.write_results(results, [found, replace(found, image_id=2)])
    return truth, results


# ------------------------------------------------------------------------------------------------ from two files


def test_results_without_boxes_are_scored_by_their_points_and_told(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    rows = json.loads(results.read_text())
    for row in rows:
        del row["bbox"]
        row["keypoints"][:9] = [0] * 9
    results.write_text(json.dumps(rows))
    code, _, err = skope("eval", "--annotations", truth, "--predictions", results, "--iou", "0.5", "--out", "scores")
    assert code == 0, err
    assert "warning: " in err
    assert "results.json: 2 results without bbox, first for image 1: the extent of the keypoints" in err
    (split,) = json.loads(Path("scores/metrics.json").read_text())["splits"].values()
    assert split["iou"]["0.5"]["matched"] == 1


def test_annotations_that_cannot_be_right_are_told(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    file = coco.read(truth)
    first, second = file.annotations
    points = first.keypoints.copy()
    points[3] = [150, 110, 2]
    spoilt = (replace(first, keypoints=points), replace(second, bbox=second.bbox * [1, 1, 1, 0]))
    coco.write(truth, replace(file, annotations=spoilt))
    err = skope("eval", "--annotations", truth, "--predictions", results, "--out", "scores")[2]
    assert "1 vehicle with a box without area, which no detector can find; first: annotation 2" in err
    assert "1 vehicle with keypoints called visible far outside of the box" in err


def test_two_files_alone(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    code, out, err = skope("eval", "--annotations", truth, "--predictions", results, "--out", "scores")
    assert (code, err) == (0, "")
    assert out.splitlines()[-1] == "Wrote metrics.json, tallies.json to scores; open scores/report.html"
    assert "crossing" in out
    metrics = json.loads(Path("scores/metrics.json").read_text())
    assert {name: metrics[name] for name in metrics if name not in ("splits", "of")} == {
        "version": 1,
        "score_threshold": 0.9,
        "alpha": 0.1,
        "labelled": "visible",
        "boxes": "full",
        "keypoint_score_threshold": 0.0,
        "scheme": "skope33",
        "points": list(range(33)),
        "calibrated": None,
    }
    (split,) = metrics["splits"].values()
    assert list(metrics["splits"]) == ["crossing"]
    names = ["images", "ground_truth", "ignored", "detections", "iou", "coco", "recall_at_precision", "by"]
    assert list(split)[:8] == names
    assert list(split)[8:] == ["localisation", "failures", "confidence", "intervals"]
    assert (split["images"], split["ground_truth"], split["detections"]) == (2, 2, 2)
    assert split["iou"]["0.9"]["box_precision"] == {"paper": 1.0, "pooled": 0.5}
    assert split["coco"]["keypoint_ap50"] == pytest.approx(51 / 101)
    assert set(split["by"]) == {
        *("distance", "height", "occlusion", "truncation", "unoccluded_within_40_m", "vehicle_type", "weather"),
        "keypoint",
    }


def test_twice_gives_the_same_bytes(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data")
    truth = root / "annotations" / "easy.json"
    found = [
        Result(image_id=a.image_id, score=0.97, bbox=a.bbox, keypoints=a.keypoints)
        for a in coco.read(truth).annotations
    ]
    coco.write_results(tmp_path / "results.json", found)
    for out in ("one", "two"):
        assert skope("eval", "--annotations", truth, "--predictions", "results.json", "--out", out)[0] == 0
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")
    assert sorted(files_of(tmp_path / "one")) == [
        *("metrics.json", "overlays/easy_1.jpg", "overlays/easy_2.jpg", "report.html", "tallies.json", "work.json"),
    ]
    sheet = cv2.imread(str(tmp_path / "one" / "overlays" / "easy_1.jpg"))
    assert sheet is not None
    assert sheet.shape[1] > 2 * 2 * 160  # two panels, enlarged twice


def test_a_results_file_against_a_split_of_a_dataset(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=3)
    (tmp_path / "none.json").write_text("[]")
    common = ("eval", "--data", root, "--predictions", "none.json", "--split", "train")
    code, out, _ = skope(*common)
    assert code == 0
    assert "No detection scores above 0.9 in train: there are no detections." in out
    assert out.splitlines()[-1] == "Wrote metrics.json, tallies.json, overlays/ to eval; open eval/report.html"
    before = files_of(tmp_path / "eval")
    code, _, err = skope(*common, "--max-images", 2)
    assert (code, "max_images = None, now 2" in err) == (2, True)
    assert files_of(tmp_path / "eval") == before
    assert skope(*common)[0] == 0  # the same work is done again
    assert files_of(tmp_path / "eval") == before
    assert skope(*common, "--max-images", 2, "--out", "two")[0] == 0
    assert json.loads(Path("two/metrics.json").read_text())["splits"]["train"]["images"] == 2


def test_nothing_above_the_threshold_is_said_with_the_best_score(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path, score=0.41)
    _, out, _ = skope("eval", "--annotations", truth, "--predictions", results)
    assert out.splitlines()[-3:] == [
        "No detection scores above 0.9 in crossing: the highest score is 0.410.",
        "To count weaker detections: `skope eval --score 0.3 --out eval_0.3`. AP includes all detections.",
        "Wrote metrics.json, tallies.json to eval; open eval/report.html",
    ]
    _, out, _ = skope("eval", "--annotations", truth, "--predictions", results, "--score", "0.3", "--out", "eval_0.3")
    assert "No detection" not in out


def test_flags_change_what_is_measured(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    common = ("eval", "--annotations", truth, "--predictions", results)
    _, pooled, _ = skope(*common)
    _, paper, _ = skope(*common, "--protocol", "paper", "--quiet")
    assert pooled != paper
    skope(*common, "--labelled", "all", "--alpha", "0.05", "--out", "strict")
    metrics = json.loads(Path("strict/metrics.json").read_text())
    assert (metrics["labelled"], metrics["alpha"]) == ("all", 0.05)


def test_the_installed_command_ends_with_code_2_and_one_line(tmp_path: Path) -> None:
    call = [sys.executable, "-m", "skope", "eval"]
    done = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == ("skope: data/skope: no such dataset folder; `skope gen --out data/skope` makes one\n")
    assert list(tmp_path.iterdir()) == []


# ------------------------------------------------------------------------------------------------ users' mistakes


def broken(results: Path, **changes: Any) -> None:
    """Change fields of the second result."""
    rows = json.loads(results.read_text())
    rows[1] |= changes
    results.write_text(json.dumps(rows))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"image_id": 77}, "results[1]: image_id 77 is not among the images of crossing"),
        ({"category_id": 3}, "results[1]: category_id 3 is not the vehicles' 1"),
        ({"score": float("nan")}, "results[1]: score: expected a number from 0 to 1, got nan"),
        ({"score": 7}, "results[1]: score: expected a number from 0 to 1, got 7"),
        ({"keypoints": [1.0] * 51}, "results[1]: keypoints: expected 33 x 3 numbers, got 51"),
        ({"keypoints": [float("nan")] * 99}, "results[1]: keypoints: not all numbers are finite"),
        ({"bbox": [1, 2, 3]}, "results[1]: bbox: expected 4 numbers, got 3"),
        ({"bbox": "wide"}, "results[1]: bbox: expected numbers, got 'wide'"),
    ],
)
def test_a_bad_result_gets_one_line(skope: Any, tmp_path: Path, changes: dict[str, Any], said: str) -> None:
    truth, results = write_pair(tmp_path)
    broken(results, **changes)
    code, out, err = skope("eval", "--annotations", truth, "--predictions", results)
    assert (code, out, err) == (2, "", f"skope: {results}: {said}\n")
    assert not Path("eval").exists()


@pytest.mark.parametrize("missing", ["image_id", "keypoints", "score"])
def test_a_missing_field_of_a_result_is_named(skope: Any, tmp_path: Path, missing: str) -> None:
    remedy = " (for results that are boxes alone: --scheme boxes or coco)" if missing == "keypoints" else ""
    truth, results = write_pair(tmp_path)
    rows = json.loads(results.read_text())
    del rows[0][missing]
    results.write_text(json.dumps(rows))
    code, _, err = skope("eval", "--annotations", truth, "--predictions", results)
    assert (code, err) == (2, f"skope: {results}: results[0]: field {missing} is missing{remedy}\n")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("not json", "not valid JSON"),
        ("{}", "expected a list of results, got a dict"),
        ("[3]", "results[0]: expected an object, got '3'"),
        ("", "not valid JSON"),
    ],
)
def test_a_results_file_that_is_none(skope: Any, tmp_path: Path, text: str, said: str) -> None:
    truth, results = write_pair(tmp_path)
    results.write_text(text)
    code, _, err = skope("eval", "--annotations", truth, "--predictions", results)
    assert code == 2
    assert err.startswith(f"skope: {results}: {said}")
    assert err.count("\n") == 1


def test_results_without_boxes_are_scored_by_the_extent_of_their_points(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    rows = json.loads(results.read_text())
    for row in rows:
        del row["bbox"]
        row["keypoints"][:6] = [10, 10, 0.5, 70, 50, 0.5]
    results.write_text(json.dumps(rows))
    assert skope("eval", "--annotations", truth, "--predictions", results)[0] == 0
    assert json.loads(Path("eval/metrics.json").read_text())["splits"]["crossing"]["iou"]["0.9"]["matched"] == 1


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--split", "night"), "no split 'night'; there are: easy, train"),
        (("--split", "easy,night"), "no split 'night'; there are: easy, train"),
        (("--protocol", "best"), "--protocol: 'best' is not one of pooled, paper"),
        (("--labelled", "some"), "--labelled: 'some' is not one of visible, all"),
        (("--boxes", "round"), "--boxes: 'round' is not one of full, visible, given"),
        (("--score", "2"), "--score: expected a number from 0 to 1, got 2.0"),
        (("--alpha", "-1"), "--alpha: expected a positive number, got -1.0"),
        (("--iou", "0.5,high"), "--iou: expected numbers, got 0.5,high"),
        (("--iou", "0"), "--iou: expected numbers above 0 and up to 1, got 0.0"),
        (("--iou", "0.5,0.5"), "--iou: expected different numbers, got 0.5, 0.5"),
        (("--keypoint-score", "3"), "--keypoint-score: expected a number from 0 to 1, got 3.0"),
        (("--compare", "rumour"), "--compare: 'rumour' is not one of paper"),
        (("--precision", "float8"), "--precision: 'float8' is not one of auto, float32, bfloat16, int8"),
        (("--batch-size", "0"), "--batch-size: expected a whole number from 1, got 0"),
        (("--scheme", "face68"), "--scheme: 'face68' is not one of skope33, apollo24, carfusion14, veri20, skope3d"),
        (("--scheme", "veri20"), "--scheme needs --predictions"),
        (("--max-images", "0"), "--max-images: expected a whole number from 1, got 0"),
        (("--checkpoint", "nowhere"), "nowhere: no such checkpoint"),
        (("--device", "abacus"), "abacus"),
        (("--out", "results.json"), "--out: expected a folder, got the file results.json"),
        (("--predictions", "results.json"), "--predictions with a dataset needs exactly one --split"),
        (("--predictions", "results.json", "--checkpoint", "x"), "--predictions and --checkpoint cannot be combined"),
        (("--predictions", "results.json", "--boxes", "given"), "--predictions and --boxes given cannot be combined"),
        (("--annotations", "crossing.json"), "--annotations and --data cannot be combined"),
        (("--predictions", "gone.json", "--split", "easy"), "gone.json: no such file"),
    ],
)
def test_a_bad_flag_gets_one_line(skope: Any, tmp_path: Path, flags: tuple[str, ...], said: str) -> None:
    write_pair(tmp_path)
    make_dataset(tmp_path / "data")
    before = files_of(tmp_path)
    code, out, err = skope("eval", "--data", "data", *flags)
    assert (code, out) == (2, "")
    assert said in err
    assert err.startswith("skope: ")
    assert err.count("\n") == 1
    assert files_of(tmp_path) == before


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (("--annotations", "crossing.json"), "--annotations needs --predictions"),
        (
            ("--annotations", "crossing.json", "--predictions", "results.json", "--split", "a"),
            "--split cannot be combined",
        ),
        (("--annotations", "gone.json", "--predictions", "results.json"), "gone.json: no such file"),
        (("--annotations", "results.json", "--predictions", "results.json"), "expected a COCO object"),
    ],
)
def test_a_bad_pair_of_files_gets_one_line(skope: Any, tmp_path: Path, flags: tuple[str, ...], said: str) -> None:
    write_pair(tmp_path)
    code, _, err = skope("eval", *flags)
    assert code == 2
    assert said in err
    assert err.count("\n") == 1


def test_visible_boxes_that_are_not_annotated_are_named(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    file = coco.read(truth)
    bare = replace(file.annotations[1], bbox_visible=None)
    coco.write(truth, replace(file, annotations=(file.annotations[0], bare)))
    code, _, err = skope("eval", "--annotations", truth, "--predictions", results, "--boxes", "visible")
    assert code == 2
    assert "crossing: annotation 2: field bbox_visible is missing" in err


def test_an_out_that_cannot_be_made_gets_one_line(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    code, _, err = skope("eval", "--annotations", truth, "--predictions", results, "--out", "results.json/below")
    assert code == 2
    assert err.count("\n") == 1


def test_a_broken_image_costs_its_overlay_only(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=2)
    file = coco.read(root / "annotations" / "easy.json")
    (root / file.images[0].file_name).write_bytes(b"")
    (tmp_path / "none.json").write_text("[]")
    code, out, _ = skope("eval", "--data", root, "--predictions", "none.json", "--split", "easy")
    assert code == 0
    assert "no overlay: " in out
    assert [path.name for path in Path("eval/overlays").iterdir()] == ["easy_2.jpg"]


@pytest.mark.parametrize(
    "changes",
    [
        {"bbox": [-500, -500, 100, 100]},
        {"bbox": [5, 5, -3, -4]},
        {"bbox": [10, 10, 0, 0]},
        {"keypoints": [1e200] * 99},
        {"id": 1},
        {"category_id": None, "keypoints": [10.0, 10.0, 7.5] * 33},
        {"keypoints": [10.0, 10.0, -3.0] * 33},
    ],
)
@pytest.mark.filterwarnings("error")
def test_odd_results_are_scored_for_what_they_are(skope: Any, tmp_path: Path, changes: dict[str, Any]) -> None:
    """Outside the image, inverted, empty, ids that stand twice, and keypoint scores that are logits."""
    truth, results = write_pair(tmp_path)
    rows = json.loads(results.read_text())
    rows = [{"id": 1, **rows[0]}, {**rows[0], "score": 0.94, **changes}]
    rows[1] = {name: value for name, value in rows[1].items() if value is not None}
    results.write_text(json.dumps(rows))
    code, _, err = skope("eval", "--annotations", truth, "--predictions", results)
    assert (code, err) == (0, "")
    split = json.loads(Path("eval/metrics.json").read_text())["splits"]["crossing"]
    assert (split["detections"], split["iou"]["0.6"]["matched"]) == (2, 1)
    assert split["coco"]["keypoint_ap50"] == pytest.approx(51 / 101)


def test_scores_that_are_no_probabilities_are_not_held_to_any(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    rows = json.loads(results.read_text())
    rows[0]["keypoints"][2] = 7.5
    results.write_text(json.dumps(rows))
    assert skope("eval", "--annotations", truth, "--predictions", results)[0] == 0
    confidence = json.loads(Path("eval/metrics.json").read_text())["splits"]["crossing"]["confidence"]
    assert confidence["reliability"] == []
    assert confidence["calibration_error"] is None
    assert confidence["right"] == 33


# ------------------------------------------------------------------------------------------------ other detectors


@pytest.mark.parametrize("scheme", keypoints.FOREIGN_SCHEMES)
def test_another_scheme_is_scored_on_the_points_that_mean_the_same(skope: Any, tmp_path: Path, scheme: str) -> None:
    table, count = keypoints.FOREIGN_SCHEMES[scheme], keypoints.FOREIGN_K[scheme]
    truth, results = write_pair(tmp_path)
    (vehicle, _) = coco.read(truth).annotations
    theirs = [[500.0, 500.0, 0.0]] * count  # what has no counterpart here may lie anywhere
    for foreign, ours in table.items():
        theirs[foreign] = [*vehicle.keypoints[ours, :2], 0.7]
    theirs[min(table)] = [500.0, 500.0, 0.7]  # and one that has is wrong
    row = {"image_id": 1, "bbox": vehicle.bbox.tolist(), "score": 0.97, "keypoints": [x for p in theirs for x in p]}
    results.write_text(json.dumps([row]))
    common = ("eval", "--annotations", truth, "--predictions", results)
    code, _, err = skope(*common, "--scheme", scheme)
    assert (code, err) == (0, "")
    document = json.loads(Path("eval/metrics.json").read_text())
    assert document["scheme"] == scheme
    assert document["points"] == sorted(table.values())
    figures = document["splits"]["crossing"]["iou"]["0.9"]
    n = len(table)
    assert (figures["correct"], figures["labelled"], figures["labelled_all"]) == (n - 1, n, 2 * n)
    assert figures["keypoint_precision"] == {"paper": (n - 1) / n, "pooled": (n - 1) / n}
    other = next(k for k in (14, 20, 24, 33) if k != count)
    row["keypoints"] = [1.0] * 3 * other
    results.write_text(json.dumps([row]))
    code, _, err = skope(*common, "--scheme", scheme)
    assert (code, err) == (
        2,
        f"skope: {results}: results[0]: keypoints: expected {count} x 3 numbers, got {3 * other}\n",
    )


def test_fewer_points_of_a_foreign_vehicle_still_give_its_box(skope: Any, tmp_path: Path) -> None:
    """The extent of all of its points, those without a counterpart too."""
    truth, results = write_pair(tmp_path)
    points = [[40.0, 30.0, 0.9]] * 14
    points[8], points[13] = [10.0, 10.0, 0.9], [70.0, 50.0, 0.9]  # neither has a counterpart
    results.write_text(json.dumps([{"image_id": 1, "score": 0.97, "keypoints": [x for p in points for x in p]}]))
    common = ("--annotations", truth, "--predictions", results, "--scheme", "carfusion14")
    assert skope("eval", *common)[0] == 0
    assert json.loads(Path("eval/metrics.json").read_text())["splits"]["crossing"]["iou"]["0.9"]["matched"] == 1


def test_thresholds_are_chosen_and_reported_from_the_strictest(skope: Any, tmp_path: Path) -> None:
    truth, results = write_pair(tmp_path)
    common = ("eval", "--annotations", truth, "--predictions", results)
    assert skope(*common, "--iou", "0.5,0.75", "--iou", "0.95", "--keypoint-score", "0.5")[0] == 0
    document = json.loads(Path("eval/metrics.json").read_text())
    assert list(document["splits"]["crossing"]["iou"]) == ["0.95", "0.75", "0.5"]
    assert document["keypoint_score_threshold"] == 0.5


def test_what_the_card_says_of_the_models_is_told_apart(skope: Any, tmp_path: Path) -> None:
    root = make_dataset(tmp_path / "data", images=3, splits=("easy",))
    path = root / "annotations" / "easy.json"
    file = coco.read(path)
    models = ("van_b", "sedan_a")
    vehicles = tuple(replace(a, model=models[i % 2], parked=i % 3 == 0) for i, a in enumerate(file.annotations))
    coco.write(path, replace(file, annotations=vehicles))
    card = json.loads((root / "dataset.json").read_text())
    card["fleet"] = {"held_out": ["van_b"], "substituted": {"van_b": ["hood_front_left"]}}
    (root / "dataset.json").write_text(json.dumps(card))
    coco.write_results(
        tmp_path / "found.json",
        [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in vehicles[::2]],
    )
    common = ("eval", "--data", root, "--split", "easy", "--predictions", "found.json")
    code, out, err = skope(*common)
    assert (code, err) == (0, "")
    by = json.loads(Path("eval/metrics.json").read_text())["splits"]["easy"]["by"]
    assert {name: by["model"][name]["0.6"]["box_recall"] for name in by["model"]} == {"seen": 0.0, "unseen": 1.0}
    assert by["keypoint_kind"]["substituted"]["0.6"]["labelled_all"] == 3
    assert by["parked"]["parked"]["0.6"]["ground_truth"] == 2
    for words in ("models unseen in training", "models seen in training", "parked vehicles", "substituted keypoints"):
        assert re.search(rf"^easy +{words} ", out, re.MULTILINE)

    for fleet, said in (
        ({"held_out": []}, "fleet: expected held_out and substituted"),
        ({"held_out": [], "substituted": {"van_b": ["wing"]}}, "fleet.substituted: no keypoint 'wing'"),
    ):
        (root / "dataset.json").write_text(json.dumps({**card, "fleet": fleet}))
        code, _, err = skope(*common)
        assert (code, err) == (2, f"skope: {root / 'dataset.json'}: {said}\n")
