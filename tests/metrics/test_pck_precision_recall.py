from typing import Any

import numpy as np
import pytest

from skope import keypoints
from skope.errors import UserError
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.match import match
from skope.metrics.pck_precision_recall import recall_at_precision, recalls, score_split
from skope.metrics.thresholds import PAPER_THRESHOLDS
from skope.schema import Annotation, AnnotationFile, Image, Result
from tests.metrics import brute
from tests.metrics.cases import as_records, random_case


def image(image_id: int) -> Image:
    return Image(id=image_id, file_name=f"{image_id}.png", width=400, height=300)


def points(labelled: int, x: float = 0.0, v: int = 2) -> np.ndarray:
    out = np.zeros((keypoints.K, 3))
    out[:labelled] = (x, 0.0, v)
    return out


def vehicle(annotation_id: int, box: tuple[float, ...], labelled: int = 20, **more: Any) -> Annotation:
    more.setdefault("image_id", 1)
    more.setdefault("keypoints", points(labelled))
    return Annotation(id=annotation_id, bbox=np.array(box), area=box[2] * box[3], **more)


def result(box: tuple[float, ...], score: float = 0.95, image_id: int = 1, at: np.ndarray | None = None) -> Result:
    return Result(image_id=image_id, score=score, bbox=np.array(box), keypoints=points(0) if at is None else at)


def split(*annotations: Annotation, images: int = 1) -> AnnotationFile:
    return AnnotationFile(images=tuple(image(i + 1) for i in range(images)), annotations=annotations)


def both(value: float | None) -> dict[str, float | None]:
    return {"paper": value, "pooled": value}


# ------------------------------------------------------------------------------------------------- the worked case


@pytest.fixture
def worked() -> dict[str, Any]:
    at = points(33)
    at[:15, 0] = 10.0  # within a tenth of 100 px, to the pixel
    at[15:, 0] = 10.5
    detection = result((0, 0, 85, 50), at=at)
    return score_split(
        split(vehicle(1, (0, 0, 100, 50), 20), vehicle(2, (200, 0, 100, 50), 10)), [detection], MetricOptions()
    )


def test_worked_case_at_08(worked: dict[str, Any]) -> None:
    assert worked["iou"]["0.8"] == {
        "matched": 1,
        "labelled": 20,
        "labelled_all": 30,
        "correct": 15,
        "predicted": 33,
        "detections_ignored": 0,
        "pck": 0.75,
        "box_precision": both(1.0),
        "box_recall": both(0.5),
        "keypoint_precision": both(15 / 33),
        "keypoint_recall": {"paper": 1.0, "pooled": 0.5},
    }


def test_worked_case_at_09(worked: dict[str, Any]) -> None:
    counts = {"matched": 0, "labelled": 0, "labelled_all": 30, "correct": 0, "predicted": 33, "detections_ignored": 0}
    ratios = dict.fromkeys(("box_precision", "box_recall", "keypoint_precision", "keypoint_recall"), both(0.0))
    assert worked["iou"]["0.9"] == {**counts, "pck": None, **ratios}


def test_layout_of_a_split(worked: dict[str, Any]) -> None:
    assert list(worked["iou"]) == ["0.9", "0.8", "0.7", "0.6"]
    assert {name: worked[name] for name in worked if name != "iou"} == {
        "images": 1,
        "ground_truth": 2,
        "ignored": 0,
        "detections": 1,
    }


# ------------------------------------------------------------------------------------------------- edges, one by one


def at_06(*annotations: Annotation, found: list[Result], images: int = 1, **options: Any) -> dict[str, Any]:
    entry: dict[str, Any] = score_split(split(*annotations, images=images), found, MetricOptions(**options))["iou"][
        "0.6"
    ]
    return entry


def test_nothing_at_all_has_no_ratio() -> None:
    entry = at_06(found=[])
    assert entry["pck"] is None
    for name in ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall"):
        assert entry[name] == both(None)


def test_no_detections_recall_nothing_and_have_no_pooled_precision() -> None:
    entry = at_06(vehicle(1, (0, 0, 100, 50)), found=[])
    assert entry["box_precision"] == {"paper": 0.0, "pooled": None}
    assert entry["box_recall"] == both(0.0)
    assert entry["keypoint_precision"] == {"paper": 0.0, "pooled": None}


def test_a_false_vehicle_on_an_empty_image_costs_pooled_precision_only() -> None:
    entry = at_06(
        vehicle(1, (0, 0, 100, 50)), images=2, found=[result((0, 0, 100, 50)), result((0, 0, 9, 9), image_id=2)]
    )
    assert entry["box_precision"] == {"paper": 1.0, "pooled": 0.5}


def test_a_score_equal_to_the_threshold_does_not_count() -> None:
    assert at_06(vehicle(1, (0, 0, 100, 50)), found=[result((0, 0, 100, 50), score=0.9)])["matched"] == 0


def test_an_iou_equal_to_the_threshold_matches() -> None:
    entries = score_split(split(vehicle(1, (0, 0, 100, 50))), [result((0, 0, 80, 50))], MetricOptions())["iou"]
    assert [entries[t]["matched"] for t in ("0.9", "0.8", "0.7")] == [0, 1, 1]


def test_a_matched_vehicle_without_labels_counts_as_recalled_in_the_paper_protocol() -> None:
    entry = at_06(vehicle(1, (0, 0, 100, 50), 0), found=[result((0, 0, 100, 50))])
    assert entry["pck"] is None
    assert entry["keypoint_recall"] == {"paper": 1.0, "pooled": None}


def test_the_best_score_chooses_first_and_a_duplicate_gets_nothing() -> None:
    near, exact = result((2, 0, 100, 50), score=0.99), result((0, 0, 100, 50), score=0.95)
    matches = match(split(vehicle(1, (0, 0, 100, 50))), [exact, near])
    assert matches.taken[0.6].tolist() == [0, -1]
    assert matches.det_keypoints.shape == (2, 33, 3)


def test_ties_go_to_the_first_in_the_file_and_to_the_lowest_id() -> None:
    truth = split(vehicle(7, (0, 0, 100, 50), 1), vehicle(3, (0, 0, 100, 50), 2))
    first, second = result((0, 0, 100, 50), at=points(33, x=1)), result((0, 0, 100, 50), at=points(33, x=2))
    matches = match(truth, [first, second])
    assert matches.taken[0.9].tolist() == [0, 1]
    assert matches.gt_keypoints[:, :, 2].sum(axis=1).tolist() == [4, 2]  # id 3 stands first
    assert matches.det_keypoints[:, 0, 0].tolist() == [1, 2]


def test_an_unmatched_detection_on_an_ignored_vehicle_is_left_out_of_the_pooled_figures_only() -> None:
    ignored = vehicle(2, (200, 0, 100, 50), iscrowd=1, ignore_reason="small")
    inside, outside = result((250, 0, 100, 50)), result((251, 0, 100, 50))
    for stray, judged in ((inside, 1.0), (outside, 0.5)):
        entry = at_06(vehicle(1, (0, 0, 100, 50)), ignored, found=[result((0, 0, 100, 50)), stray])
        assert entry["box_precision"] == {"paper": 0.5, "pooled": judged}
        assert entry["detections_ignored"] == (1 if judged == 1.0 else 0)


def test_visible_boxes_set_both_the_match_and_the_reach() -> None:
    half = vehicle(1, (0, 0, 100, 50), 33, bbox_visible=np.array([0.0, 0, 60, 50]))
    found = [result((0, 0, 60, 50), at=points(33, x=8))]
    assert at_06(half, found=found, boxes="visible")["correct"] == 0
    assert at_06(half, found=found, boxes="full")["correct"] == 33
    assert score_split(split(half), found, MetricOptions(boxes="visible"))["iou"]["0.9"]["matched"] == 1
    with pytest.raises(UserError, match="annotation 1: field bbox_visible"):
        match(split(vehicle(1, (0, 0, 10, 10))), [], boxes="visible")


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"score": 1.5}, "--score"),
        ({"score": float("nan")}, "--score"),
        ({"alpha": 0.0}, "--alpha"),
        ({"alpha": float("inf")}, "--alpha"),
        ({"labelled": "some"}, "--labelled.*visible, all"),
        ({"boxes": "square"}, "--boxes.*full, visible"),
    ],
)
def test_options_out_of_range(values: dict[str, Any], said: str) -> None:
    with pytest.raises(UserError, match=said):
        MetricOptions(**values)


# --------------------------------------------------------------------------------- against the loops, on random cases


COUNTS = ("matched", "labelled", "labelled_all", "correct", "predicted")
RATIOS = ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")


def compare(ours: dict[str, Any], t: float, expected: dict[str, Any]) -> None:
    entry, counts = ours["iou"][f"{t:g}"], expected["counts"]
    assert {name: entry[name] for name in COUNTS} == {name: counts[name] for name in COUNTS}
    assert entry["detections_ignored"] == counts["on_ignored"]
    assert (ours["ground_truth"], ours["ignored"], ours["detections"]) == (
        counts["truth"],
        counts["ignored"],
        counts["detections"],
    )
    assert entry["pck"] == (None if expected["pck"] is None else pytest.approx(expected["pck"], abs=1e-12))
    for name in RATIOS:
        for protocol in ("paper", "pooled"):
            value = expected[name][protocol]
            assert entry[name][protocol] == (None if value is None else pytest.approx(value, abs=1e-12)), name


@pytest.mark.parametrize("block", range(8))
def test_metrics_equal_the_loops(block: int) -> None:
    seen = dict.fromkeys(("matched", "on_ignored", "correct"), 0)
    for case in range(50):
        rng = np.random.default_rng((block, case))
        images, vehicles, detections = random_case(rng)
        file, results = as_records(images, vehicles, detections)
        for labelled, alpha, score, least, points in (
            ("visible", 0.1, 0.9, 0.0, list(range(33))),
            ("all", 0.05, 0.5, 0.5, [0, 3, 17, 32]),
        ):
            options = MetricOptions(
                labelled=labelled, alpha=alpha, score=score, keypoint_score=least, points=tuple(points)
            )
            ours = score_split(file, results, options)
            assert ours["images"] == len(images)
            for t in PAPER_THRESHOLDS.iou:
                expected = brute.evaluate(images, vehicles, detections, t, labelled, score, alpha, least, points)
                compare(ours, t, expected)
                for name in seen:
                    seen[name] += expected["counts"][name]
    assert min(seen.values()) > 50  # the cases do exercise what they are for


@pytest.mark.parametrize("block", range(4))
def test_recalls_at_precisions_equal_the_best_of_all_score_thresholds(block: int) -> None:
    reached = 0
    for case in range(50):
        images, vehicles, detections = random_case(np.random.default_rng((block, case)))
        ours = recalls(*as_records(images, vehicles, detections), MetricOptions(score=0.9, iou=(0.8, 0.6)))
        # Detections score 0.5, 0.9, 0.92, 0.95 or 1.
        rows = [
            brute.evaluate(images, vehicles, detections, 0.6, "visible", score, 0.1, 0.0, list(range(33)))
            for score in (0.0, 0.5, 0.9, 0.92, 0.95)
        ]
        shares = [(row["box_precision"]["pooled"], row["box_recall"]["pooled"]) for row in rows]
        for name, precision in (("0.9", 0.9), ("0.95", 0.95)):
            best = max((recall for share, recall in shares if share is not None and share >= precision), default=0.0)
            truth = any(not vehicle["ignored"] for vehicle in vehicles)
            assert ours[name] == (pytest.approx(best) if truth else None)
            reached += best > 0 if truth else 0
    assert reached > 5


def test_recall_at_precision_from_a_curve() -> None:
    """Hits and false ones by falling score; the last two of one score come in together."""
    scores = np.array([0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.4])
    hit = np.array([True, False, True, True, True, True, False])
    # Precision 1, 1/2, 2/3, 3/4, 4/5, then 5/7; recall is hits of 10.
    order = np.array([3, 0, 5, 2, 6, 1, 4])
    for wanted, recall, least in ((1.0, 0.1, 0.9), (0.8, 0.4, 0.5), (0.81, 0.1, 0.9), (0.71, 0.5, 0.4)):
        at = recall_at_precision(scores[order], hit[order], 10, wanted)
        assert at == {"recall": recall, "score": least}
    assert recall_at_precision(scores[1:2], hit[1:2], 10, 0.9) == {"recall": 0.0, "score": None}
    assert recall_at_precision(scores[:0], hit[:0], 10, 0.9) == {"recall": 0.0, "score": None}
    assert recall_at_precision(scores[1:2], hit[1:2], 0, 0.9) == {"recall": None, "score": None}
