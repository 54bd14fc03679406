"""Labelled photographs made up here, whose figures can be worked out by hand."""

import json
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from pycocotools.coco import COCO
from pycocotools.cocoeval import COCOeval

from skope import keypoints
from skope.dataset import coco
from skope.detector.checkpoint import checkpoint_name
from skope.files.json_files import read_json, write_json
from skope.keypoints import INDEX
from skope.schema import Annotation, AnnotationFile, Result, category
from tests.samples import load_script, make_annotation, make_image

SCRIPT = Path(__file__).parents[1] / "scripts" / "score_photographs.py"
SIZE = (160, 120)
Box = tuple[float, float, float, float]


@pytest.fixture(scope="module")
def script() -> ModuleType:
    return load_script("score_photographs")


@pytest.fixture
def checkpoint(random_run: Path) -> Path:
    """The weights of a small-input detector that has learned nothing and finds a handful of vehicles."""
    return random_run / checkpoint_name(1)


def vehicle(number: int, image: int, box: Box, *, names: Sequence[str] = keypoints.NAMES, crowd: int = 0) -> Annotation:
    """A vehicle of whose keypoints `names` are labelled (v = 2) and the others not (x = y = v = 0)."""
    whole = make_annotation(number, image, box, iscrowd=crowd)
    labelled = np.isin(keypoints.NAMES, () if crowd else names)
    return replace(whole, keypoints=whole.keypoints * labelled[:, None])


def found(annotation: Annotation, score: float, *, points: NDArray[np.float64] | None = None) -> Result:
    """A detection exactly on a vehicle, with its keypoints or `points`."""
    chosen = annotation.keypoints if points is None else points
    return Result(image_id=annotation.image_id, score=score, bbox=annotation.bbox, keypoints=chosen)


def anywhere(image: int, box: Box, score: float) -> Result:
    return Result(image_id=image, score=score, bbox=np.array(box), keypoints=np.zeros((keypoints.K, 3)))


def photographs(
    script: ModuleType, annotations: Sequence[Annotation], scenes: Sequence[str] = ("a",), partial: Sequence[int] = ()
) -> Any:
    """One image, numbered from 1, for each entry of `scenes`; not all boxes are there on those of `partial`."""
    images = tuple(replace(make_image(i, *SIZE), site=scene) for i, scene in enumerate(scenes, start=1))
    return script.Photographs(
        source=Path("photographs/labels.json"),
        file=AnnotationFile(images=images, annotations=tuple(annotations)),
        complete=frozenset(image.id for image in images) - set(partial),
    )


def test_matched_unmatched_ignored_and_low(script: ModuleType) -> None:
    one, two = vehicle(1, 1, (10, 10, 40, 30)), vehicle(2, 1, (60, 10, 40, 30), names=keypoints.NAMES[:10])
    low, region = vehicle(3, 1, (60, 60, 20, 12), names=()), vehicle(4, 1, (100, 60, 50, 50), crowd=1)
    results = [
        found(one, 0.5),  # at the score
        found(two, 0.4),  # below it
        found(low, 0.8),  # low, but it takes a vehicle
        anywhere(1, (90, 70, 20, 30), 0.7),  # half inside the ignored region
        anywhere(1, (89, 70, 20, 30), 0.5),  # less than half inside: a phantom, at the score
        anywhere(1, (10, 80, 30, 13.9), 0.6),  # low
        anywhere(1, (10, 80, 30, 14), 0.6),  # not low: a phantom
    ]
    figures = script.score_photographs(photographs(script, [one, two, low, region]), results, None, 0.5)
    boxes, points = figures["all"]["boxes"], figures["all"]["keypoints"]
    assert {name: boxes[name] for name in ("vehicles", "hits", "phantoms", "left_out")} == {
        "vehicles": 3,
        "hits": 2,
        "phantoms": 2,
        "left_out": 2,
    }
    assert (boxes["precision"], boxes["recall"], boxes["phantoms_a_frame"]) == (2 / 4, 2 / 3, 2.0)
    assert (points["vehicles"], points["matched"], points["labelled"], points["found"]) == (2, 1, 43, 33)
    assert (points["share_of_all"], points["share_of_matched"]) == (33 / 43, 1.0)
    assert (points["share_in_given_boxes"], points["found_in_given_boxes"]) == (None, None)
    assert figures["scenes"] == {"a": figures["all"]}


def test_a_better_score_chooses_first_and_the_second_is_a_phantom(script: ModuleType) -> None:
    one = vehicle(1, 1, (10, 10, 40, 30))
    far = one.keypoints + [100, 0, 0]
    figures = script.score_photographs(
        photographs(script, [one]), [found(one, 0.6), found(one, 0.7, points=far)], None, 0.5
    )
    assert figures["all"]["keypoints"]["found"] == 0
    assert figures["all"]["boxes"]["phantoms"] == 1


def test_keypoints_count_within_a_tenth_of_the_longer_edge_and_only_where_labelled(script: ModuleType) -> None:
    one = vehicle(1, 1, (10, 10, 40, 30), names=keypoints.NAMES[:5])
    guess = one.keypoints.copy()
    guess[0, 0] += 3.9
    guess[1, 1] += 4.1
    guess[5:] = 55.0  # wherever an unlabelled point is predicted
    hidden = one.keypoints.copy()
    hidden[2, 2] = 1
    for truth, labelled in ((one, 5), (replace(one, keypoints=hidden), 4)):
        points = script.score_photographs(
            photographs(script, [truth]), [found(one, 1.0, points=guess)], [found(one, 1.0)], 0.5
        )["all"]["keypoints"]
        assert (points["labelled"], points["found"], points["found_in_given_boxes"]) == (
            labelled,
            labelled - 1,
            labelled,
        )
        assert points["share_in_given_boxes"] == 1.0


def test_frames_with_some_boxes_count_for_keypoints_only(script: ModuleType) -> None:
    one, two = vehicle(1, 1, (10, 10, 40, 30)), vehicle(2, 2, (10, 10, 70, 64))
    results = [found(one, 0.9), found(two, 0.9), anywhere(2, (100, 20, 40, 40), 0.9)]
    figures = script.score_photographs(photographs(script, [one, two], ("a", "b"), partial=[2]), results, None, 0.5)
    boxes, partial = figures["all"]["boxes"], figures["scenes"]["b"]
    assert (boxes["complete_frames"], boxes["vehicles"], boxes["hits"], boxes["phantoms"]) == (1, 1, 1, 0)
    assert partial["keypoints"]["found"] == 33
    nothing = {"complete_frames": 0, "vehicles": 0, "hits": 0, "phantoms": 0, "left_out": 0}
    ratios = dict.fromkeys(("ap", "ap50", "precision", "recall", "phantoms_a_frame"))
    at = {"recall": None, "score": None}
    assert partial["boxes"] == {**nothing, **ratios, "recall_at_precision": {"0.90": at, "0.95": at}}
    assert {band: own["vehicles"] for band, own in figures["heights_px"].items()} == {
        "0-32": 1,
        "32-64": 0,
        "64-128": 1,
        "128+": 0,
    }


FRONT = ("headlight_outer_right", "headlight_outer_left", "bumper_front_right", "bumper_front_left", "front_logo")
SIDES = ("wheel_front_right", "wheel_rear_right", "roof_front_right", "roof_rear_right")
OTHER = {"headlight_outer": "taillight_outer", "bumper_front": "bumper_rear", "wheel_front": "wheel_rear"}
OTHER |= {"roof_front": "roof_rear"}
OTHER |= {rear: front for front, rear in OTHER.items()}


def exchanged(annotation: Annotation, *, sides: bool, ends: bool) -> NDArray[np.float64]:
    """A prediction that puts each labelled keypoint of a vehicle where another one is, the others far away."""
    points = np.full((keypoints.K, 3), -500.0)
    for name in np.array(keypoints.NAMES)[annotation.keypoints[:, 2] > 0]:
        stem, _, side = name.rpartition("_")
        if side not in ("right", "left"):
            taken_for = name
        else:
            stem = OTHER[stem] if ends else stem
            taken_for = f"{stem}_{'left' if (side == 'right') == sides else 'right'}"
        points[INDEX[taken_for]] = annotation.keypoints[INDEX[name]]
    return points


@pytest.mark.parametrize(
    ("kind", "names", "sides", "ends"),
    [
        ("left_right", FRONT, True, False),
        ("front_rear", SIDES, False, True),
        ("turned", FRONT, True, True),
        (None, FRONT, False, False),
        (None, FRONT[:3], True, False),  # three points are too few
    ],
)
def test_flips(script: ModuleType, kind: str | None, names: Sequence[str], sides: bool, ends: bool) -> None:
    one = vehicle(7, 1, (10, 10, 100, 80), names=names)
    points = exchanged(one, sides=sides, ends=ends)
    figures = script.score_photographs(photographs(script, [one]), [found(one, 0.9, points=points)], None, 0.5)
    own = figures["all"]["keypoints"]
    assert own["flips"] == int(kind is not None)
    assert own["flips_by_kind"] == {k: int(k == kind) for k in ("left_right", "front_rear", "turned")}
    assert own["flipped_annotations"] == ({"7": kind} if kind else {})


def test_a_flip_must_fit_clearly_better(script: ModuleType) -> None:
    """Of eight points two on the wrong side are a quarter, of nine they are less."""
    pairs = ("wheel_front", "wheel_rear", "roof_front", "roof_rear")
    one = vehicle(1, 1, (0, 0, 100, 100), names=[f"{stem}_{side}" for stem in pairs for side in ("right", "left")])
    truth = one.keypoints.copy()
    labelled = truth[:, 2] > 0
    truth[labelled, :2] = 50.0  # all in one place, so that exchanging those that are right changes nothing
    two = [INDEX["wheel_front_right"], INDEX["wheel_front_left"]]
    truth[two[0], :2], truth[two[1], :2] = (10, 50), (90, 50)
    one = replace(one, keypoints=truth)
    guess = truth.copy()
    guess[two] = truth[two[::-1]]
    assert script.flip_of(one, guess) == "left_right"
    more = truth.copy()
    more[INDEX["front_logo"]] = guess[INDEX["front_logo"]] = (50, 50, 2)
    assert script.flip_of(replace(one, keypoints=more), guess) is None
    hidden = truth.copy()
    hidden[two, 2] = 1  # such points do not count
    assert script.flip_of(replace(one, keypoints=hidden), guess) is None
    # A third of the distance must go too: 700 px of two points that are off either way outweigh the others' 160.
    far = truth.copy()
    far[two] = truth[two[::-1]]
    far[[INDEX["wheel_rear_right"], INDEX["wheel_rear_left"]], 1] = 400
    assert script.flip_of(one, far) is None


def test_recall_at_precision_of_photographs_is_blind_to_what_is_left_out(script: ModuleType) -> None:
    boxes = [(10.0, 10.0, 40.0, 30.0), (60.0, 10.0, 40.0, 30.0), (110.0, 10.0, 40.0, 30.0)]
    truth = [vehicle(i, 1, box) for i, box in enumerate(boxes, start=1)]
    results = [found(truth[0], 0.9), anywhere(1, (10, 80, 30, 10), 0.85), found(truth[1], 0.3)]
    results += [anywhere(1, (10, 80, 30, 30), 0.2), found(truth[2], 0.1)]
    at = script.score_photographs(photographs(script, truth), results, None, 0.5)["all"]["boxes"]["recall_at_precision"]
    assert at == {"0.90": {"recall": 2 / 3, "score": 0.3}, "0.95": {"recall": 2 / 3, "score": 0.3}}


def test_no_detections(script: ModuleType) -> None:
    one = vehicle(1, 1, (10, 10, 40, 30))
    figures = script.score_photographs(photographs(script, [one]), [], [], 0.5)
    boxes, points = figures["all"]["boxes"], figures["all"]["keypoints"]
    assert (boxes["ap"], boxes["precision"], boxes["recall"], boxes["phantoms_a_frame"]) == (0.0, None, 0.0, 0.0)
    assert boxes["recall_at_precision"]["0.90"] == {"recall": 0.0, "score": None}
    assert (points["share_of_all"], points["share_of_matched"], points["share_in_given_boxes"]) == (0.0, None, 0.0)
    assert figures["keypoints_of_all_interval_90"] == [0.0, 0.0]


def test_a_scene_without_ground_truth(script: ModuleType) -> None:
    one = vehicle(1, 1, (10, 10, 40, 30))
    results = [found(one, 0.9), anywhere(2, (10, 10, 40, 30), 0.9)]
    figures = script.score_photographs(photographs(script, [one], ("a", "b")), results, [found(one, 1.0)], 0.5)
    boxes, points = (figures["scenes"]["b"][part] for part in ("boxes", "keypoints"))
    assert (boxes["ap"], boxes["precision"], boxes["recall"], boxes["phantoms_a_frame"]) == (None, 0.0, None, 1.0)
    assert (points["vehicles"], points["share_of_all"], points["share_in_given_boxes"]) == (0, None, None)
    assert figures["all"]["boxes"]["precision"] == 0.5
    empty = script.score_photographs(photographs(script, []), [], None, 0.5)
    assert empty["keypoints_of_all_interval_90"] is None
    assert "-" in script.table(empty)


def test_the_interval_draws_scenes(script: ModuleType) -> None:
    """One scene found whole and one not at all: of the four draws of two, one is 0 and one 1."""
    both = [vehicle(1, 1, (10, 10, 40, 30)), vehicle(2, 2, (10, 10, 40, 30))]
    place = photographs(script, both, ("a", "b"))
    figures = script.score_photographs(place, [found(both[0], 0.9)], None, 0.5)
    assert figures["keypoints_of_all_interval_90"] == [0.0, 1.0]
    assert figures == script.score_photographs(place, [found(both[0], 0.9)], None, 0.5)


def pycocotools_ap(file: AnnotationFile, results: Sequence[Result]) -> tuple[float, float]:
    """Box AP over IoU 0.5 to 0.95, and at 0.5."""
    truth = COCO()
    truth.dataset = {
        "images": [coco.image_to_dict(image) for image in file.images],
        "annotations": [coco.annotation_to_dict(a) for a in file.annotations],
        "categories": [category()],
    }
    truth.createIndex()
    rows = [{key: v for key, v in coco.result_to_dict(r).items() if key != "keypoints"} for r in results]
    evaluation = COCOeval(truth, truth.loadRes(rows), "bbox")
    evaluation.evaluate()
    evaluation.accumulate()
    evaluation.summarize()
    return evaluation.stats[0], evaluation.stats[1]


def test_average_precision_is_that_of_pycocotools(script: ModuleType) -> None:
    rng = np.random.default_rng(4)
    annotations, results, low = [], [], []
    for image in (1, 2, 3):
        region = vehicle(100 + image, image, (120, 60, 40, 60), crowd=1)
        own = [vehicle(10 * image + i, image, (5 + 38.0 * i, 10 + 5.0 * i, 34, 30)) for i in range(4)]
        annotations += [*own, region]
        for one in own:
            moved = one.bbox + rng.normal(0, 2, 4)
            results.append(replace(found(one, round(float(rng.random()), 3)), bbox=moved.round(1)))
        results += [
            anywhere(image, (10, 70, 30, 30), round(float(rng.random()), 3)),
            anywhere(image, (125, 70, 20, 30), 0.9),
        ]
        low.append(anywhere(image, (10, 70, 30, 13), 0.99))
    place = photographs(script, annotations, ("a", "a", "b"))
    boxes = script.score_photographs(place, [*low, *results], None, 0.5)["all"]["boxes"]
    expected = pycocotools_ap(place.file, results)
    assert 0.2 < expected[0] < expected[1] < 1
    assert (boxes["ap"], boxes["ap50"]) == pytest.approx(expected, abs=1e-12)


# ----------------------------------------------------------------------------------------------------------- command


def write_folder(folder: Path) -> Path:
    """Two tiny photographs, one vehicle on each, of a camera that is named in either of two ways.

    They are of little contrast: of colourful noise a detector that has learned nothing finds a hundred vehicles.
    """
    rng = np.random.default_rng(0)
    rows = [
        {"id": 1, "file_name": "one.png", "width": 160, "height": 120, "scene": "bridge"},
        {"id": 2, "file_name": "more/two.png", "width": 160, "height": 120, "site": "gate", "boxes_complete": False},
    ]
    for row in rows:
        path = folder / str(row["file_name"])
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), rng.integers(60, 180, (120, 160, 3), dtype=np.uint8))
    annotations = [coco.annotation_to_dict(vehicle(i, i, (20, 20, 60, 50))) for i in (1, 2)]
    coco.write_rows(folder / "labels.json", {}, rows, annotations)
    return folder


@pytest.fixture
def command(script: ModuleType, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Any:
    """Run the script; returns exit code, standard output and standard error."""

    def call(*args: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", [str(SCRIPT), *map(str, args)])
        code = 0
        try:
            script.main()
        except SystemExit as stop:
            code = int(stop.code or 0)
        return code, *capsys.readouterr()

    return call


def test_a_checkpoint_is_scored_and_the_look_recorded(command: Any, checkpoint: Path, tmp_path: Path) -> None:
    folder, out = write_folder(tmp_path / "photographs"), tmp_path / "out"
    before = sorted(folder.rglob("*"))
    common = ("--out", out, "--score", "0.06")
    code, said, err = command(folder, "--checkpoint", checkpoint, "--device", "cpu", *common)
    assert code == 0, err
    made = ["looks.jsonl", "metrics.json", "predictions.json", "sheet_01.jpg", "work.json"]
    assert sorted(p.name for p in out.iterdir()) == made
    assert sorted(folder.rglob("*")) == before
    assert [line.split()[0] for line in said.splitlines() if line.startswith(("bridge", "gate", "all"))] == [
        "bridge",
        "gate",
        "all",
    ]
    metrics = read_json(out / "metrics.json")
    assert list(metrics["scenes"]) == ["bridge", "gate"]
    assert (metrics["all"]["images"], metrics["all"]["boxes"]["complete_frames"]) == (2, 1)
    assert metrics["checkpoint"] == str(checkpoint)
    assert len(metrics["sha256"]) == 64
    assert metrics["all"]["keypoints"]["share_in_given_boxes"] is not None
    assert metrics["detections"] == len(coco.read_results(out / "predictions.json")) > 0
    sheet = cv2.imread(str(out / "sheet_01.jpg"))
    assert sheet is not None
    assert sheet.shape[:2] > (2 * 960, 2 * 1280)

    # The same work is done again, and looked at again.
    kept = {path.name: path.read_bytes() for path in out.iterdir()}
    code, _, err = command(folder, "--checkpoint", checkpoint, "--device", "cpu", *common)
    assert code == 0, err
    now = {path.name: path.read_bytes() for path in out.iterdir()}
    assert now.pop("looks.jsonl").startswith(kept.pop("looks.jsonl"))
    assert now == kept
    looks = [json.loads(line) for line in (out / "looks.jsonl").read_text().splitlines()]
    assert [look["checkpoint"] for look in looks] == [str(checkpoint)] * 2
    assert looks[0]["sha256"] == metrics["sha256"]
    assert looks[0]["share_of_all"] == metrics["all"]["keypoints"]["share_of_all"]

    # Predictions that were written are scored alike; they know nothing of given boxes.
    scored = (folder / "labels.json", "--predictions", out / "predictions.json")
    code, _, err = command(*scored, "--out", tmp_path / "other", "--score", "0.06")
    assert code == 0, err
    again = read_json(tmp_path / "other" / "metrics.json")
    assert again["all"]["boxes"] == metrics["all"]["boxes"]
    assert again["all"]["keypoints"]["share_in_given_boxes"] is None

    # Other work leaves all as it was, its own input first of all.
    before = {path: path.read_bytes() for path in out.iterdir()}
    code, _, err = command(*scored, *common)
    assert (code, err.count("\n")) == (2, 1)
    assert f"--out: {out} holds the output of another run (not of {out / 'predictions.json'}" in err
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def test_files_of_others_are_left_alone(command: Any, tmp_path: Path) -> None:
    folder, out = write_folder(tmp_path / "photographs"), tmp_path / "out"
    out.mkdir()
    write_json(out / "predictions.json", [])
    (out / "sheet_01.jpg").write_bytes(b"mine")
    before = {path: path.read_bytes() for path in out.iterdir()}
    code, _, err = command(folder, "--predictions", out / "predictions.json", "--out", out)
    assert (code, err.count("\n")) == (2, 1)
    assert f"--out: {out} holds other files" in err
    assert {path: path.read_bytes() for path in out.iterdir()} == before


def mistake(folder: Path, kind: str) -> str | list[Any]:
    """Break a folder in one way; returns what the error must name."""
    labels = folder / "labels.json"
    document = read_json(labels)
    if kind == "none":
        labels.unlink()
        return "expected one annotation file (*.json) in this folder, found none"
    if kind == "two":
        write_json(folder / "more.json", {})
        return "found labels.json, more.json"
    if kind == "broken":
        labels.write_text('{"images": [')
        return "labels.json: not valid JSON"
    if kind == "image":
        (folder / "one.png").unlink()
        return "one.png: no such file"
    if kind == "complete":
        document["images"][1]["boxes_complete"] = "no"
        write_json(labels, document)
        return "labels.json: images[1]: boxes_complete: expected true or false, got 'no'"
    spoilt = {
        "size": ("images", "width", 161, "labels.json: images[1]: ", "two.png: is 160x120, its annotation says 161"),
        "scene": ("images", "scene", ["a"], "labels.json: images[1]: scene: expected a name", "got ['a']"),
        "line": ("images", "scene", "a\nb", "labels.json: images[1]: scene: expected a name", "got 'a\\nb'"),
        "site": ("images", "site", "a\tb", "labels.json: images[1]: site: expected a name", "got 'a\\tb'"),
        "box": ("annotations", "bbox", [0, 0, 1e308, 2], "labels.json: annotations[1]: bbox: expected at most 1e+06"),
        "point": ("annotations", "keypoints", [1e308, 0, 2] * 33, "labels.json: annotations[1]: keypoints: expected"),
    }
    if kind in spoilt:
        records, field, value, *expected = spoilt[kind]
        document[records][1][field] = value
        write_json(labels, document)
        return expected
    assert kind == "scheme"
    document["info"] = keypoints.PUBLISHED.fields()
    document["categories"][0]["keypoints"] = list(keypoints.PUBLISHED.names)
    write_json(labels, document)
    return "labels.json: has keypoint scheme skope3d, expected skope33"


@pytest.mark.parametrize(
    "kind",
    [
        *("none", "two", "broken", "image", "complete", "scheme"),
        *("size", "scene", "line", "site", "box", "point"),
    ],
)
def test_mistakes_in_the_folder_are_one_line(command: Any, tmp_path: Path, kind: str) -> None:
    folder = write_folder(tmp_path / "photographs")
    expected = mistake(folder, kind)
    write_json(tmp_path / "results.json", [])
    code, said, err = command(folder, "--predictions", tmp_path / "results.json", "--out", tmp_path / "out")
    assert (code, said) == (2, "")
    assert err.startswith("score_photographs: ")
    assert all(text in err for text in ([expected] if isinstance(expected, str) else expected))
    assert err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("field", ["bbox", "keypoints"])
def test_predictions_that_are_nowhere_are_refused(command: Any, tmp_path: Path, field: str) -> None:
    folder = write_folder(tmp_path / "photographs")
    row = coco.result_to_dict(found(vehicle(1, 1, (10, 10, 40, 30)), 0.9))
    row[field] = [1e308, *row[field][1:]]
    write_json(tmp_path / "results.json", [row])
    code, said, err = command(folder, "--predictions", tmp_path / "results.json", "--out", tmp_path / "out")
    assert (code, said, err.count("\n")) == (2, "", 1)
    assert f"results.json: results[0]: {field}: expected at most 1e+06 px, got 1e+308" in err
    assert not (tmp_path / "out").exists()


def test_mistakes_in_flags_are_one_line(command: Any, tmp_path: Path) -> None:
    folder = write_folder(tmp_path / "photographs")
    write_json(tmp_path / "results.json", [])
    known = ("--predictions", tmp_path / "results.json")
    for flags, expected in (
        ((*known, "--out", folder / "out"), "is inside the photographs' folder"),
        ((*known, "--score", "2"), "--score: expected a number from 0 to 1"),
        (("--checkpoint", tmp_path / "nowhere"), "nowhere: no such checkpoint"),
        (("--predictions", tmp_path / "nowhere.json"), "nowhere.json: no such file"),
    ):
        code, said, err = command(folder, *flags)
        assert (code, said, err.count("\n")) == (2, "", 1)
        assert err.startswith("score_photographs: ")
        assert expected in err
    assert command(tmp_path / "absent", *known)[2] == f"score_photographs: {tmp_path / 'absent'}: no such file\n"
