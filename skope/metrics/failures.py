"""Failures by kind: vehicles missed and false, and keypoints on the wrong side, at the wrong end or just off.

The kinds follow Ronchi and Perona ("Benchmarking and Error Diagnosis in Multi-Instance Pose Estimation", 2017), with a
vehicle's two symmetries in the place of a person's one.
"""

from typing import Any, Final

import numpy as np

from skope import keypoints
from skope.keypoints import FLIP, OTHER_END
from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes, lengths
from skope.metrics.match import Matches
from skope.types import Array, Integers

ERROR_KINDS: Final = ("left_right", "front_rear", "jitter")
"""Kinds of wrong keypoints: where the other side's counterpart is, where the other end's is (of either side), and
anywhere else."""
NOT_WRONG: Final = -1
"""Stands in place of a kind for a keypoint that is not wrong."""
LEFT_RIGHT, FRONT_REAR, JITTER = range(len(ERROR_KINDS))


def wrong_points(matches: Matches, outcomes: Outcomes, options: MetricOptions) -> Integers:
    """Tell the kinds of wrong keypoints.

    A keypoint is wrong when it is labelled and farther than alpha L from its place. It is swapped when it lies within
    alpha L of a counterpart whose place is known (v > 0); of several, the nearest names the kind.

    Args:
        matches: Vehicles and detections, matched.
        outcomes: Who was taken by which detection, at one IoU.
        options: What counts, and alpha.

    Returns:
        (G, 33) index in `ERROR_KINDS` of each wrong keypoint; -1: right, unlabelled, not predicted or not found.
    """
    kinds = np.full(outcomes.labelled.shape, NOT_WRONG, dtype=np.int64)
    wrong = outcomes.labelled & outcomes.predicted & ~outcomes.correct(options.alpha)
    kinds[wrong] = JITTER
    if options.scheme.name != keypoints.SCHEME:  # which keypoints are counterparts is known of skope33 alone
        return kinds
    side = _apart(matches, outcomes, FLIP)
    ends = np.minimum(_apart(matches, outcomes, OTHER_END), _apart(matches, outcomes, [FLIP[k] for k in OTHER_END]))
    reach = options.alpha * outcomes.length[:, None]
    kinds[wrong & (side <= reach)] = LEFT_RIGHT
    kinds[wrong & (ends <= reach) & (ends < side)] = FRONT_REAR
    return kinds


def _apart(matches: Matches, outcomes: Outcomes, counterpart: Any) -> Array:
    """(G, 33) pixels from each prediction to its counterpart's place, infinite where there is none."""
    counterpart = np.asarray(counterpart)
    truth = matches.gt_keypoints[:, counterpart]
    out = np.full(outcomes.labelled.shape, np.inf)
    found = outcomes.found
    out[found] = lengths(matches.det_keypoints[outcomes.detection[found], :, :2] - truth[found, :, :2])
    labelled = (truth[..., 2] > 0) & (counterpart != np.arange(keypoints.K))
    return np.where(labelled, out, np.inf)


def failure_counts(matches: Matches, outcomes: Outcomes, options: MetricOptions) -> dict[str, int]:
    """Count what went wrong at one IoU threshold.

    Args:
        matches: A split's ground truth and detections.
        outcomes: What became of each vehicle at the threshold.
        options: What counts, and how near a keypoint must be.

    Returns:
        The entry of `failures` in `metrics.json`: vehicles "missed", detections "false", and wrong keypoints by kind.
    """
    kinds = wrong_points(matches, outcomes, options)
    return {
        "missed": int((~outcomes.found).sum()),
        "false": int(false_detections(matches, outcomes).sum()),
        **{name: int((kinds == i).sum()) for i, name in enumerate(ERROR_KINDS)},
    }


def false_detections(matches: Matches, outcomes: Outcomes) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """(D,) detections that took no vehicle and lie on no ignored one."""
    false = ~matches.det_on_ignored
    false[outcomes.detection[outcomes.found]] = False
    return false
