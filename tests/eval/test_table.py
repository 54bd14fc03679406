from typing import Any

import pytest

from skope.errors import UserError
from skope.eval.metrics import document
from skope.eval.table import render
from skope.eval.tally import Options


def split(pck: float | None) -> dict[str, Any]:
    ratios = {
        name: {"paper": 0.25, "pooled": 0.5}
        for name in ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
    }
    return {
        "images": 7,
        "ground_truth": 20,
        "ignored": 3,
        "detections": 11,
        "iou": {t: {"pck": pck, **ratios} for t in ("0.9", "0.8", "0.7", "0.6")},
        "coco": {"box_ap": 0.125, "box_ap50": 0.5, "keypoint_ap": None, "keypoint_ap50": 0.0},
        "by": {},
    }


METRICS = document(Options(), {"easy": split(0.9865), "medium": split(1.0), "hard": split(None)})


def test_splits_stand_side_by_side_with_a_row_per_threshold() -> None:
    lines = render(METRICS, "pooled", 120).splitlines()
    assert "pooled" in lines[0]
    assert lines[2].split() == ["easy", "|", "medium", "|", "hard"]
    assert [line.split()[0] for line in lines[5:9]] == ["0.9", "0.8", "0.7", "0.6"]
    figures = ["0.500"] * 4
    assert lines[5].split() == ["0.9", "98.65", *figures, "|", "100.00", *figures, "|", "-", *figures]


def test_a_narrow_terminal_gets_them_one_below_the_other() -> None:
    lines = render(METRICS, "pooled", 60).splitlines()
    assert sum(line.startswith("  0.9") for line in lines) == 3
    assert max(len(line) for line in lines if line.startswith("  0.")) <= 60


@pytest.mark.parametrize("width", [1, 40, 75, 76, 80, 110, 200])
def test_no_row_of_the_table_is_wider_than_the_terminal_or_one_split(width: int) -> None:
    table = render(METRICS, "pooled", width).split("\n\nsplit")[0]
    assert max(len(line) for line in table.splitlines()[1:]) <= max(width, 40)


def test_the_protocol_decides_which_figures_are_shown() -> None:
    assert "0.250" in render(METRICS, "paper", 120)
    assert "paper" in render(METRICS, "paper", 120).splitlines()[0]
    with pytest.raises(UserError, match=r"--protocol.*pooled, paper"):
        render(METRICS, "published", 120)


def test_counts_and_average_precision_stand_below() -> None:
    last = render(METRICS, "pooled", 120).splitlines()[-1]
    assert last.split() == ["hard", "7", "20", "3", "11", "0.125", "0.500", "-", "0.000"]
