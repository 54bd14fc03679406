from typing import Any

import pytest

from skope.errors import UserError
from skope.eval.report.table import evidence, published, render_table
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.pck_precision_recall import scores_document


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
        "recall_at_precision": {"0.9": 0.75, "0.95": None},
        "by": {},
    }


METRICS = scores_document(MetricOptions(), {"easy": split(0.9865), "medium": split(1.0), "hard": split(None)})


def test_splits_stand_side_by_side_with_a_row_per_threshold() -> None:
    lines = render_table(METRICS, "pooled", 120).splitlines()
    assert "pooled" in lines[0]
    assert lines[2].split() == ["easy", "|", "medium", "|", "hard"]
    assert [line.split()[0] for line in lines[5:9]] == ["0.9", "0.8", "0.7", "0.6"]
    figures = ["0.500"] * 4
    assert lines[5].split() == ["0.9", "98.65", *figures, "|", "100.00", *figures, "|", "-", *figures]


def test_a_narrow_terminal_gets_them_one_below_the_other() -> None:
    lines = render_table(METRICS, "pooled", 60).splitlines()
    assert sum(line.startswith("  0.9") for line in lines) == 3
    assert max(len(line) for line in lines if line.startswith("  0.")) <= 60


@pytest.mark.parametrize("width", [1, 40, 75, 76, 80, 110, 200])
def test_no_row_of_the_table_is_wider_than_the_terminal_or_one_split(width: int) -> None:
    table = render_table(METRICS, "pooled", width).split("\n\nsplit")[0]
    assert max(len(line) for line in table.splitlines()[1:]) <= max(width, 40)


def test_the_protocol_decides_which_figures_are_shown() -> None:
    assert "0.250" in render_table(METRICS, "paper", 120)
    assert "paper" in render_table(METRICS, "paper", 120).splitlines()[0]
    with pytest.raises(UserError, match=r"--protocol.*pooled, paper"):
        render_table(METRICS, "published", 120)


def test_counts_and_average_precision_stand_below() -> None:
    last = render_table(METRICS, "pooled", 120).splitlines()[-1]
    assert last.split() == ["hard", "7", "20", "3", "11", "0.125", "0.500", "-", "0.000", "0.750", "-"]


def test_the_published_rows_stand_below_ours() -> None:
    lines = render_table(METRICS, "paper", 120, beside=published()).splitlines()
    rows = [line.split() for line in lines if line.startswith("paper")]
    assert rows[0] == [
        *("paper", "98.65", "0.408", "0.345", "0.462", "0.931", "|"),
        *("94.56", "0.635", "0.537", "0.433", "0.894", "|", "45.18", "0.123", "0.190", "0.146", "0.553"),
    ]
    assert len(rows) == 4
    assert any("SKoPe3D" in line for line in lines)


def test_a_split_that_was_not_published_gets_dashes() -> None:
    lines = render_table(
        scores_document(MetricOptions(), {"extra": split(0.5)}), "paper", 120, beside=published()
    ).splitlines()
    assert [line.split() for line in lines if line.startswith("paper")] == [["paper", *"-----"]] * 4


def test_published_figures_follow_the_papers_protocol() -> None:
    """Keypoint precision is recall x PCK x labelled share in the printed table too, but for one misprinted PCK."""
    shares = {
        name: [row[3] / (row[4] * row[0]) for row in table.values()] for name, table in published()["splits"].items()
    }
    for name, low, high in (("easy", 0.50, 0.52), ("medium", 0.50, 0.52), ("hard", 0.58, 0.60)):
        odd = [share for share in shares[name] if not low < share < high]
        assert len(odd) <= (1 if name == "medium" else 0)


@pytest.mark.parametrize(
    ("intervals", "words"),
    [
        ({"unit": "10 s", "blocks": 30, "sites": 1}, "30 blocks of 10 s of one recording: not valid for other w"),
        ({"unit": "recording", "blocks": 10, "sites": 1}, "10 recordings of one site: not valid for other sites"),
        (
            {"unit": "recording", "blocks": 20, "sites": 2},
            "20 recordings of 2 sites: too few to be valid for other sites",
        ),
        ({"unit": "site", "blocks": 15, "sites": 15}, "15 sites"),
        (
            {"unit": "10 s", "blocks": 1, "sites": 1},
            "none, as there are fewer than two blocks of 10 s of one recording",
        ),
        ({"unit": "image", "blocks": 9, "sites": None}, "9 images; the intervals are too narrow"),
    ],
)
def test_what_intervals_speak_for_is_said(intervals: dict[str, Any], words: str) -> None:
    assert evidence(intervals).startswith(words)


def test_intervals_are_printed_at_the_lowest_threshold() -> None:
    both = {"paper": [0.1, 0.2], "pooled": [0.3, 0.4]}
    names = ("box_precision", "box_recall", "keypoint_precision", "keypoint_recall")
    figures = {"pck": [0.91, 0.95], **dict.fromkeys(names, both)}
    entry = {**split(0.5), "intervals": {"unit": "site", "blocks": 9, "sites": 9, "iou": {"0.9": {}, "0.6": figures}}}
    text = render_table(scores_document(MetricOptions(), {"extra": entry}), "pooled", 120)
    assert "IoU 0.6: PCK 91.00-95.00, box Pr 0.300-0.400" in text
