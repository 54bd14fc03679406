"""Report of an evaluation: the content of `report.html`, and the curves of its charts."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from markupsafe import Markup

from skope.eval.report.gallery import gallery
from skope.eval.report.table import AREA_WORDS, FIGURE_COLUMNS, evidence, published_row, road_user_rows, row_of
from skope.metrics.keypoint_outcomes import PROTOCOL_NAMES, MetricOptions
from skope.metrics.match import match
from skope.metrics.pck_precision_recall import METRIC_RULES
from skope.metrics.road_users import AP50_IOU
from skope.metrics.score_reliability import curve
from skope.metrics.split_scores import SplitScores
from skope.page.charts import Axes, Line, chart
from skope.page.templates import Cell, ShareCell, Table, number_text, percent_text, render
from skope.page.vehicle_outline import Point, outline
from skope.version import __version__

CURVE_ALPHAS = np.linspace(0, 0.2, 41)


def precision_recall(measured: SplitScores, options: MetricOptions) -> list[Line]:
    """Return box precision over recall by decreasing score, a line per IoU threshold, for results of any score.

    Detections on ignored vehicles are excluded, as in the pooled protocol.
    """
    matches = match(measured.file, measured.results, score=-1.0, boxes=options.boxes, thresholds=options.iou)
    lines = []
    for t in options.iou:
        taken = matches.taken[t] >= 0
        counted = taken | ~matches.det_on_ignored
        recall, precision = curve(matches.det_score[counted], taken[counted], len(matches.gt_image))
        # Beyond the highest recall the precision is 0 by definition, so the curve ends there.
        reached = np.flatnonzero(precision > 0)
        end = int(reached[-1]) + 1 if reached.size else 0
        lines.append(Line(name=f"IoU {t:g}", x=recall[:end].tolist(), y=precision[:end].tolist()))
    return lines


def pck_over_alpha(measured: SplitScores, options: MetricOptions) -> list[Line]:
    """Return PCK of matched vehicles over alpha, a line per IoU threshold."""
    lines = []
    for t in options.iou:
        outcomes = measured.outcomes[t]
        labelled = int((outcomes.labelled & outcomes.found[:, None]).sum())
        shares = [outcomes.correct(alpha).sum() / labelled if labelled else None for alpha in CURVE_ALPHAS.tolist()]
        lines.append(Line(name=f"IoU {t:g}", x=CURVE_ALPHAS.tolist(), y=shares))
    return lines


def reliability_curve(measured: SplitScores) -> list[Line]:
    """Return the share of right keypoints over their mean score, by bin of scores."""
    rows = measured.entry["confidence"]["reliability"]
    notes = [f"{row['count']} keypoints" for row in rows]
    return [Line(name="keypoints", x=[row["score"] for row in rows], y=[row["right"] for row in rows], notes=notes)]


def keypoint_precision_recall(measured: SplitScores) -> list[Line]:
    """Return keypoint precision over recall by decreasing keypoint score."""
    precision = measured.entry["confidence"]["precision_at_recall"]
    end = max((i + 1 for i, p in enumerate(precision) if p > 0), default=0)
    return [Line(name="keypoints", x=[i / 100 for i in range(end)], y=precision[:end])]


FIGURE_TITLES: Final = ("PCK %", "box precision", "box recall", "keypoint precision", "keypoint recall")
COUNT_TITLES: Final = {
    "images": "images",
    "ground_truth": "vehicles",
    "ignored": "ignored vehicles",
    "detections": "detections",
}
PRECISION_TITLES: Final = {
    "box_ap": "box AP",
    "box_ap50": "box AP50",
    "keypoint_ap": "keypoint AP",
    "keypoint_ap50": "keypoint AP50",
}
_BREAKDOWN_TITLES: Final = {
    "distance": "Distance, m",
    "height": "Height of the box, px",
    "occlusion": "Occlusion",
    "truncation": "Truncation",
    "weather": "Weather",
    "vehicle_type": "Vehicle type",
    "unoccluded_within_40_m": "Unoccluded and within 40 m",
    "parked": "Parked or driving",
    "model": "Model seen in training",
    "keypoint_kind": "Keypoints of the body's own, or substituted",
}
DRAWN_LAYERS: Final = {
    "truth": "ground truth (solid; rings: hidden)",
    "found": "predictions (dashed; rings: score under 0.5)",
    "wrong": "failures (L/R sides swapped, F/R ends swapped)",
    "ignored": "ignored vehicles (dotted)",
}


def render_page(
    document: Mapping[str, Any],
    measured: Sequence[SplitScores],
    root: Path,
    options: MetricOptions,
    protocol: str,
    beside: Mapping[str, Any] | None,
    subject: str,
) -> str:
    """Return the report as one HTML page.

    Args:
        document: The content of `metrics.json`.
        measured: Scores of the splits.
        root: Folder that paths of images are relative to. Images without a file are not shown.
        options: The counting rules.
        protocol: Protocol of the table that is shown first, one of `PROTOCOL_NAMES`.
        beside: A published table (see `table.published`); None: none.
        subject: Detector and data, for the title.

    Returns:
        The page as HTML.
    """
    splits = document["splits"]
    return render(
        "eval/report/report.html",
        title=f"{subject} ({', '.join(split.file.name for split in measured)})",
        subject=subject,
        layers=DRAWN_LAYERS,
        protocol=protocol,
        about=[_about(document), _source(document["of"])],
        tables={name: _table(document, name, beside) for name in PROTOCOL_NAMES},
        evidence={name: evidence(split["intervals"]) for name, split in splits.items()},
        counts=_counts(splits),
        categories=_categories(splits),
        partial=any(_lacks_low_scores(split) for split in splits.values()),
        splits=[_split(split, root, options) for split in measured],
    )


def _about(document: Mapping[str, Any]) -> str:
    scores = {
        None: "as given by the detector's own program",
        True: "calibrated probabilities of being visible and within that distance",
        False: "not calibrated (skope eval calibrate-scores)",
    }[document["calibrated"]]
    least = document["keypoint_score_threshold"]
    return (
        f"A detection counts if its score is above {document['score_threshold']:g}; a keypoint is correct within "
        f"{document['alpha']:g} of the longer edge L of the ground-truth box ({document['boxes']} boxes); keypoints "
        f"that count: {document['labelled']}; keypoint scores: {scores}; "
        f"{'all keypoints count as predicted' if not least else f'keypoints above {least:g} count as predicted'}. "
        f"{len(document['points'])} keypoints of scheme {document['scheme']}."
    )


def _source(of: Mapping[str, Any] | None) -> str:
    """Return a sentence on the evaluated files, the version of skope and the date."""
    if of is None:
        return f"skope {__version__}."
    files = "; ".join(f"{path} (SHA-256 {digest[:12]})" for path, digest in of["inputs"].items())
    return f"Evaluated files: {files}. skope {of['skope']}, {of['date']}."


def _counts(splits: Mapping[str, Any]) -> Table:
    """Return the table of counts and average precision, with a column per split."""
    every = splits.values()
    rows: list[list[object]] = [[words, *(split[key] for split in every)] for key, words in COUNT_TITLES.items()]
    rows += [[words, *(number_text(split["coco"][key]) for split in every)] for key, words in PRECISION_TITLES.items()]
    for precision in (f"{p:g}" for p in METRIC_RULES.at_precision):
        recalls = [number_text(split["recall_at_precision"][precision]) for split in every]
        rows.append([f"box recall at precision {precision}", *recalls])
    return Table(caption="Counts and average precision", head=("", *splits), rows=rows)


def _categories(splits: Mapping[str, Any]) -> Table:
    """Return the table of road users other than vehicles; without rows if none are labelled."""
    counts, shares = ("ground_truth", "ignored", "detections"), ("precision", "recall", "ap", "ap50")
    rows = [
        [
            split,
            name,
            AREA_WORDS[size],
            *(figures[key] for key in counts),
            *(number_text(figures[key]) for key in shares),
        ]
        for split, entry in splits.items()
        for name, size, figures in road_user_rows(entry)
    ]
    head = ("split", "category", "size", "labelled", "ignored", "detections", *shares[:2], "box AP", "box AP50")
    caption = f"Pedestrians and two-wheelers: boxes, precision and recall at IoU {AP50_IOU:g}"
    return Table(caption=caption, head=head, rows=rows, sortable=True)


def _lacks_low_scores(split: Mapping[str, Any]) -> bool:
    return bool(split["ground_truth"]) and split["coco"]["box_ap"] is None


def _table(document: Mapping[str, Any], protocol: str, beside: Mapping[str, Any] | None) -> Table:
    rows = []
    for name, split in document["splits"].items():
        for t, figures in split["iou"].items():
            spans = row_of(split["intervals"]["iou"][t], protocol)
            cells = [_cell(v, s, i == 0) for i, (v, s) in enumerate(zip(row_of(figures, protocol), spans, strict=True))]
            rows.append([f"{name}, IoU {t}", *cells])
            if beside and protocol == "paper":
                theirs = [_cell(v, None, i == 0) for i, v in enumerate(published_row(beside, name, t))]
                rows.append([f"{name}, IoU {t}: published", *theirs])
    assert len(FIGURE_TITLES) == len(FIGURE_COLUMNS) + 1
    caption = f"Protocol {protocol}, with 95% intervals"
    return Table(caption=caption, head=("split, threshold", *FIGURE_TITLES), rows=rows, sortable=True)


def _cell(value: float | None, interval: Sequence[float] | None, percent: bool) -> Cell:
    """Return a metric with its confidence interval below it."""
    scale, digits = (100, 2) if percent else (1, 3)
    text = "–" if value is None else f"{scale * value:.{digits}f}"
    if interval is None:
        return Cell(text, None)
    low, high = interval
    return Cell(text, f"{scale * low:.{digits}f}–{scale * high:.{digits}f}")


def _split(measured: SplitScores, root: Path, options: MetricOptions) -> dict[str, Any]:
    """Return the content of the page for a split."""
    entry = measured.entry
    loosest = f"{options.loosest:g}"
    boxes = Axes(x_label="recall", y_label="precision")
    within = Axes(x_label="alpha", y_label="PCK", x_end=0.2)
    claimed = Axes(x_label="score", y_label="share visible and near enough")
    charts = [
        chart("Boxes: precision over recall", boxes, precision_recall(measured, options), every=5),
        chart("PCK over alpha", within, pck_over_alpha(measured, options), every=4),
        chart("Calibration of keypoint scores", claimed, reliability_curve(measured), diagonal=True),
        chart("Keypoints: precision over recall", boxes, keypoint_precision_recall(measured), every=5),
    ]
    charts.append(_keypoints(entry["by"]["keypoint"], loosest))
    return {
        "name": measured.file.name,
        "loosest": loosest,
        "photos": gallery(measured, root, options),
        "charts": charts,
        "confidence": _confidence(entry["confidence"], loosest),
        # A table of one row would repeat the figures of the split.
        "parts": [
            _part(title, entry["by"][key], loosest)
            for key, title in _BREAKDOWN_TITLES.items()
            if len(entry["by"].get(key, ())) > 1
        ],
        "failures": _failures(entry["failures"]),
    }


def _keypoints(entry: Mapping[str, Any], threshold: str) -> Markup:
    """Return a drawing of the PCK of each keypoint at its position on the vehicle."""
    points = {}
    for name, by_threshold in entry.items():
        figures = by_threshold[threshold]
        pck, correct, labelled = figures["pck"], figures["correct"], figures["labelled"]
        points[name] = Point(
            share=pck,
            tip=f"PCK {percent_text(pck)}, {correct} of {labelled}",
            cells=(percent_text(pck), str(correct), str(labelled), percent_text(figures["keypoint_recall"])),
        )
    return outline(f"PCK of each keypoint, IoU {threshold}", points, ("PCK", "correct", "labelled", "recall"))


def _confidence(entry: Mapping[str, Any], threshold: str) -> str:
    error, auc, average = (number_text(entry[key]) for key in ("calibration_error", "auc_visible", "average_precision"))
    return (
        f"Keypoint scores at IoU {threshold}: {entry['points']} keypoints of matched vehicles, {entry['right']} of "
        f"them visible and near enough; calibration error {error}; a visible keypoint outscores a hidden one with "
        f"probability {auc} (AUC; {entry['visible']} visible, {entry['hidden']} hidden); average precision of "
        f"keypoints {average}."
    )


def _part(title: str, of: Mapping[str, Any], threshold: str) -> Table:
    rows = []
    for name, by_threshold in of.items():
        figures = by_threshold[threshold]
        known = "ground_truth" in figures
        vehicles = (figures["ground_truth"], ShareCell(figures["box_recall"])) if known else ("", "")
        rows.append([name, *vehicles, figures["labelled"], ShareCell(figures["pck"])])
    head = ("part", "vehicles", "recall %", "keypoints", "PCK %")
    return Table(caption=title, head=head, rows=rows, sortable=True)


def _failures(entry: Mapping[str, Mapping[str, int]]) -> Table:
    head = ("IoU", "vehicles missed", "false vehicles", "left/right swapped", "front/rear swapped", "jitter")
    rows = [[t, *counts.values()] for t, counts in entry.items()]
    return Table(caption="Missed vehicles, false positives, and wrong keypoints by kind", head=head, rows=rows)
