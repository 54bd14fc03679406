import itertools
import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope import keypoints
from skope.dataset import coco
from skope.eval.report import gallery, page
from skope.keypoints import INDEX
from skope.metrics.breakdown import FleetInfo
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.outcome_counts import quality
from skope.metrics.split_scores import SplitScores, split_metrics
from skope.page import image_viewer
from skope.page.charts import Axes, Line, chart, histogram
from skope.page.vehicle_outline import plan
from skope.schema import AnnotationFile, Result
from tests.html_page import Page
from tests.samples import make_annotation, make_dataset, make_image


def detector_of(file: AnnotationFile, *, seed: int = 0) -> list[Result]:
    """Finds three of four vehicles some pixels off; swaps the sides of one, and sees one that is not there."""
    rng = np.random.default_rng(seed)
    out = []
    for i, vehicle in enumerate(file.annotations):
        if i % 4 == 3:
            continue
        points = vehicle.keypoints + np.pad(rng.normal(0, 1.5, (33, 2)), ((0, 0), (0, 1)))
        points[:, 2] = rng.random(33)
        if i == 0:
            points = points[list(keypoints.FLIP)]
        out.append(Result(image_id=vehicle.image_id, score=0.9 + 0.02 * (i % 4), bbox=vehicle.bbox, keypoints=points))
    image = file.images[-1].id
    out.append(Result(image_id=image, score=0.99, bbox=np.array([0.0, 0, 9, 9]), keypoints=np.zeros((33, 3))))
    return out


@pytest.fixture
def report(skope: Any, tmp_path: Path) -> Page:
    root = make_dataset(tmp_path / "data", images=6)
    path = root / "annotations" / "easy.json"
    coco.write_results(tmp_path / "found.json", detector_of(coco.read(path)))
    common = ("--data", root, "--split", "easy", "--predictions", "found.json", "--score", "0.5")
    code, _, err = skope("eval", *common, "--compare", "paper")
    assert (code, err) == (0, "")
    return Page(Path("eval/report.html").read_text(encoding="utf-8"))


def test_the_page_needs_nothing_from_outside(report: Page) -> None:
    for _, attributes in report.elements:
        for name in ("src", "href"):
            assert (attributes.get(name) or "data:").startswith(("data:", "#"))
        assert "url(" not in (attributes.get("style") or "")
    assert len(report.all("script")) == len(report.all("style")) == 1
    policy = [a["content"] for a in report.all("meta") if a.get("http-equiv") == "Content-Security-Policy"]
    assert policy[0] is not None
    assert policy[0].startswith("default-src 'none'")


def test_what_can_be_seen_can_also_be_read(report: Page) -> None:
    images = report.all("img")
    assert len(images) == 6
    assert all(image["alt"] for image in images)
    assert any("left/right swapped" in (image["alt"] or "") for image in images)
    assert any("missed" in (image["alt"] or "") for image in images)
    assert any("false detection" in (image["alt"] or "") for image in images)
    drawings = [a for a in report.all("svg") if a.get("class") and "chart" in (a["class"] or "")]
    assert len(drawings) == 5
    assert all(a["role"] == "img" and a["aria-label"] and a["tabindex"] == "0" for a in drawings)
    assert len(report.all("details")) == len(drawings)
    assert len(report.all("caption")) == len(report.all("table"))
    for kind in ("best", "median", "worst"):
        assert f"{kind} of easy" in report.text


def test_the_tables_figures_are_those_of_metrics_json(report: Page) -> None:
    metrics = json.loads(Path("eval/metrics.json").read_text())["splits"]["easy"]
    for figures in metrics["iou"].values():
        assert f"{100 * figures['pck']:.2f}" in report.text
        for name in ("box_precision", "keypoint_recall"):
            for value in figures[name].values():
                assert f"{value:.3f}" in report.text
    assert "98.65" in report.text  # the published row
    row = "".join(str(count) for count in metrics["failures"]["0.6"].values())
    assert f"0.6{row}" in report.text


def test_every_keypoint_stands_on_the_outline_with_its_figures(report: Page) -> None:
    tips = [a["data-tip"] or "" for a in report.all("g") if (a.get("class") or "").startswith("dot")]
    assert [tip.split(":")[0] for tip in tips] == list(keypoints.NAMES)
    metrics = json.loads(Path("eval/metrics.json").read_text())["splits"]["easy"]["by"]["keypoint"]
    wheel = metrics["wheel_front_left"]["0.6"]
    assert f"{wheel['correct']} of {wheel['labelled']}" in tips[INDEX["wheel_front_left"]]


def test_the_outline_is_symmetric_and_no_two_points_touch() -> None:
    places = np.array([plan(name) for name in keypoints.NAMES])
    assert np.allclose(places[list(keypoints.FLIP)], places * [1, -1])
    apart = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9 * np.eye(33)
    assert apart.min() > 2 * 0.34 * 0.9


def measured_split(count: int, results: list[Result] | None = None) -> SplitScores:
    images = tuple(make_image(i) for i in range(1, count + 1))
    vehicles = tuple(make_annotation(i, i, (20, 20, 80, 60)) for i in range(1, count + 1))
    file = AnnotationFile(images=images, annotations=vehicles, name="a<b")
    return split_metrics(file, results or detector_of(file), MetricOptions(score=0.5), FleetInfo())


def test_curves_agree_with_the_figures_at_their_place() -> None:
    measured = measured_split(40)
    for line, figures in zip(
        page.pck_over_alpha(measured, MetricOptions()), measured.entry["iou"].values(), strict=True
    ):
        assert line.y[20] == pytest.approx(figures["pck"])  # alpha 0.1
        assert line.x[20] == pytest.approx(0.1)
    (boxes, *_) = page.precision_recall(measured, MetricOptions())
    assert boxes.x[-1] == pytest.approx(0.75)
    assert boxes.y[-1] == pytest.approx(30 / 31)
    assert np.mean([*boxes.y, *[0.0] * (101 - len(boxes.y))]) == pytest.approx(measured.entry["coco"]["box_ap50"])


def test_the_best_the_median_and_the_worst_are_chosen() -> None:
    values = np.array([0.5, np.nan, 0.9, 0.1, 0.4, 0.6, 0.8, 0.2, 0.45])

    def chosen(values: np.ndarray, blocks: list[int]) -> list[tuple[int, str]]:
        return [(c.index, c.kind) for c in gallery.chosen_images(values, np.array(blocks))]

    alone = list(range(9))
    assert sorted(chosen(values, alone)) == sorted(
        [(2, "best"), (6, "best"), (0, "median"), (8, "median"), (3, "worst"), (7, "worst")]
    )
    assert [kind for _, kind in chosen(values, alone)] == ["best"] * 2 + ["median"] * 2 + ["worst"] * 2
    assert chosen(values[:3], alone) == [(2, "best"), (0, "best")]
    assert chosen(np.array([np.nan]), [0]) == []
    # 6 is of the same block as 2, and 7 as 3: the next best and next worst of another block come instead.
    assert [i for i, kind in chosen(values, [0, 1, 2, 3, 4, 5, 2, 3, 8]) if kind != "median"] == [2, 5, 3, 4]
    assert len(chosen(values, [0] * 9)) == 6


def test_quality_is_what_the_page_says() -> None:
    measured = measured_split(4)
    (right, labelled) = (getattr(measured.tallies[0.6], name) for name in ("correct", "labelled_all"))
    expected = right / labelled * np.array([1, 1, 1, 0.5])  # the false vehicle is in the last image
    assert quality(measured.tallies[0.6]) == pytest.approx(expected)


def test_names_of_the_user_are_escaped_and_missing_images_left_out(tmp_path: Path) -> None:
    from skope.eval.report import render_page
    from skope.metrics.pck_precision_recall import scores_document

    measured = measured_split(4)
    text = render_page(
        scores_document(MetricOptions(), {"a<b": measured.entry}),
        [measured],
        tmp_path,
        MetricOptions(),
        "pooled",
        None,
        "a&b",
    )
    page = Page(text)
    assert "Split a<b" in page.text
    assert page.all("img") == []
    assert "a<b: no image files found." in page.text
    assert "a&b" in page.text


def test_a_chart_places_its_points_and_leaves_gaps_out() -> None:
    axes = Axes(x_label="x", y_label="y", x_end=2.0)
    page = Page(chart("t", axes, [Line(name="a&b", x=[0, 1, 2], y=[0.0, None, 1.0], notes=["p", "q", "r"])]))
    marks = [a for a in page.all("path") if "data-tip" in a]
    assert [a["data-tip"] for a in marks] == ["a&b: x 0, y 0.000; p", "a&b: x 2, y 1.000; r"]
    starts = [tuple(map(float, re.findall(r"[\d.]+", a["d"] or "")[:2])) for a in marks]
    assert starts == [axes.to_drawing(0, 0), axes.to_drawing(2, 1)]
    assert axes.to_drawing(0, 0)[0] < axes.to_drawing(2, 0)[0]
    assert axes.to_drawing(0, 0)[1] > axes.to_drawing(0, 1)[1]
    Page(chart("nothing", axes, [Line(name="a", x=[], y=[])]))


def test_points_of_another_scheme_alone_are_drawn() -> None:
    few = tuple(sorted(keypoints.VERI20.values()))
    options = MetricOptions(score=0.5, points=few)
    file = replace(measured_split(4).file)
    measured = split_metrics(file, detector_of(file), options, FleetInfo())
    assert list(measured.entry["by"]["keypoint"]) == [keypoints.NAMES[k] for k in few]


def test_texts_over_an_image_stand_clear_of_each_other() -> None:
    rng = np.random.default_rng(5)
    boxes = [
        np.array([x, y, 60, 30]) for x, y in zip(rng.integers(0, 600, 12), rng.integers(200, 260, 12), strict=True)
    ]
    drawn = Page(image_viewer.labels_svg([(box, "2 L/R, 3 jitter") for box in boxes], (640, 480)))
    texts = drawn.all("text")
    assert len(texts) == 12
    size = float(texts[0]["font-size"] or 0)
    assert {float(text["font-size"] or 0) for text in texts} == {size}
    long = 0.55 * size * len("2 L/R, 3 jitter")
    places = [(float(text["x"] or 0), float(text["y"] or 0)) for text in texts]
    for x, y in places:
        assert x >= 0
        assert x + long <= 640
        assert size * 0.9 <= y <= 480
    for (xa, ya), (xb, yb) in itertools.combinations(places, 2):
        assert abs(xa - xb) >= long or abs(ya - yb) >= size


def test_a_text_stands_right_above_a_box_alone_and_below_one_at_the_image_s_top() -> None:
    (alone,) = Page(image_viewer.labels_svg([(np.array([100, 200, 50, 50]), "missed")], (640, 480))).all("text")
    assert float(alone["x"] or 0) == 100
    assert 190 < float(alone["y"] or 0) < 200
    (top,) = Page(image_viewer.labels_svg([(np.array([100, 2, 50, 50]), "missed")], (640, 480))).all("text")
    assert 52 < float(top["y"] or 0) < 70


def test_a_histogram_has_a_bar_for_each_band() -> None:
    axes = Axes(x_label="distance, m", y_label="share", x_end=4.0)
    page = Page(histogram("t", axes, [Line(name="easy", x=[0.5, 1.5, 2.5, 3.5], y=[0.5, 0.0, 0.3, 0.2])]))
    (band,) = [a for a in page.all("path") if "band" in (a.get("class") or "")]
    numbers = [float(v) for v in re.findall(r"[\d.]+", band["d"] or "")]
    corners = list(zip(numbers[::2], numbers[1::2], strict=True))
    expected = [(0, 0), (0, 0.5), (1, 0.5), (1, 0), (2, 0), (2, 0.3), (3, 0.3), (3, 0.2), (4, 0.2), (4, 0)]
    assert corners == [axes.to_drawing(*corner) for corner in expected]
    tips = [a["data-tip"] for a in page.all("path") if "data-tip" in a]
    assert tips[0] == "easy: distance, m 0 to 1, share 0.500"
    assert len(tips) == 3
