"""The lines of the charts: what is measured at every score or every alpha instead of at one."""

import numpy as np

from skope.metrics.keypoint_outcomes import Options
from skope.metrics.match import match
from skope.metrics.score_reliability import curve
from skope.metrics.split_scores import SplitScores
from skope.page.charts import Line

ALPHAS = np.linspace(0, 0.2, 41)


def precision_recall(measured: SplitScores, options: Options) -> list[Line]:
    """Box precision over recall by falling score, a line per IoU threshold, of all results whatever they score.

    Detections on ignored vehicles are left out, as in the pooled protocol.
    """
    matches = match(measured.file, measured.results, score=-1.0, boxes=options.boxes, thresholds=options.iou)
    lines = []
    for t in options.iou:
        taken = matches.taken[t] >= 0
        counted = taken | ~matches.det_on_ignored
        recall, precision = curve(matches.det_score[counted], taken[counted], len(matches.gt_image))
        # Beyond what is ever recalled precision is 0 by definition, which is no news in a picture.
        reached = np.flatnonzero(precision > 0)
        end = int(reached[-1]) + 1 if reached.size else 0
        lines.append(Line(name=f"IoU {t:g}", x=recall[:end].tolist(), y=precision[:end].tolist()))
    return lines


def pck_over_alpha(measured: SplitScores, options: Options) -> list[Line]:
    """PCK of matched vehicles over alpha, a line per IoU threshold."""
    lines = []
    for t in options.iou:
        outcomes = measured.outcomes[t]
        labelled = int((outcomes.labelled & outcomes.found[:, None]).sum())
        shares = [outcomes.correct(alpha).sum() / labelled if labelled else None for alpha in ALPHAS.tolist()]
        lines.append(Line(name=f"IoU {t:g}", x=ALPHAS.tolist(), y=shares))
    return lines


def reliability_curve(measured: SplitScores) -> list[Line]:
    """The share of keypoints that are right over the score that they claim, per tenth of scores."""
    rows = measured.entry["confidence"]["reliability"]
    notes = [f"{row['count']} keypoints" for row in rows]
    return [Line(name="keypoints", x=[row["score"] for row in rows], y=[row["right"] for row in rows], notes=notes)]


def keypoint_precision_recall(measured: SplitScores) -> list[Line]:
    """Keypoint precision over recall by falling keypoint score."""
    precision = measured.entry["confidence"]["precision_at_recall"]
    end = max((i + 1 for i, p in enumerate(precision) if p > 0), default=0)
    return [Line(name="keypoints", x=[i / 100 for i in range(end)], y=precision[:end])]
