"""All of an evaluation at once, over splits of every poor kind: it must hold together wherever a part has nothing."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from skope.eval.report import render_page, table
from skope.metrics import pck_precision_recall
from skope.metrics.breakdown import FleetInfo
from skope.metrics.keypoint_outcomes import MetricOptions
from skope.metrics.outcome_counts import quotients, ratio
from skope.metrics.split_scores import from_tallies, split_metrics, to_tallies
from skope.schema import AnnotationFile, Result
from tests.html_page import Page
from tests.metrics.cases import as_records, random_case

OPTIONS = MetricOptions(score=0.5, keypoint_score=0.2)


def poor_splits() -> list[tuple[AnnotationFile, list[Result]]]:
    out: list[tuple[AnnotationFile, list[Result]]] = [(AnnotationFile(images=(), annotations=()), [])]
    for i in range(6):
        file, results = as_records(*random_case(np.random.default_rng((7, i))))
        none = replace(file, annotations=())
        ignored = replace(file, annotations=tuple(replace(a, iscrowd=1) for a in file.annotations))
        points = tuple(replace(a, keypoints=a.keypoints * [1, 1, 0]) for a in file.annotations)
        bare = replace(file, annotations=points)
        out += [(file, results), (file, []), (none, results), (ignored, results), (bare, results)]
    return out


@pytest.mark.filterwarnings("error")
def test_every_poor_split_is_measured_printed_and_shown(tmp_path: Path) -> None:
    for file, results in poor_splits():
        measured = split_metrics(file, results, OPTIONS, FleetInfo(held_out=()))
        document = pck_precision_recall.scores_document(OPTIONS, {"poor": measured.entry})
        json.dumps(document, allow_nan=False)
        for protocol in ("pooled", "paper"):
            assert table.render_table(document, protocol, 100, beside=table.published())
        Page(render_page(document, [measured], tmp_path, OPTIONS, "pooled", table.published(), "a detector"))


def test_tallies_give_the_figures_again() -> None:
    for file, results in poor_splits():
        measured = split_metrics(file, results, OPTIONS, FleetInfo())
        blocks, tallies = from_tallies(json.loads(json.dumps(to_tallies(measured))))
        assert blocks.to_dict() == measured.blocks.to_dict()
        for t, counts in tallies.items():
            top, bottom = quotients(counts)["box_recall", "paper"]
            assert ratio(top.sum(), bottom.sum()) == measured.entry["iou"][t]["box_recall"]["paper"]
