"""Failures by kind: missed vehicles, false positives, and keypoints on the wrong side, at the wrong end or displaced.

The kinds follow Ronchi and Perona ("Benchmarking and Error Diagnosis in Multi-Instance Pose Estimation", 2017). A
vehicle has two symmetries, a person has one.
"""

from typing import Any, Final

import numpy as np

from skope import keypoints
from skope.keypoints import FLIP, OTHER_END
from skope.metrics.keypoint_outcomes import MetricOptions, Outcomes, lengths
from skope.metrics.match import Matches
from skope.types import Array, Integers

ERROR_KINDS: Final = ("left_right", "front_rear", "jitter")
"""Kinds of wrong keypoints: at the counterpart on the other side, at a counterpart at the other end (of either side),
or anywhere else."""
NOT_WRONG: Final = -1
"""Value instead of an index in `ERROR_KINDS` for a keypoint that is not wrong."""
LEFT_RIGHT, FRONT_REAR, JITTER = range(len(ERROR_KINDS))


def wrong_points(matches: Matches, outcomes: Outcomes, options: MetricOptions) -> Integers:
    """Classify wrong keypoints.

    A keypoint is wrong if it is labelled and more than alpha L from its true position. It is swapped if it is within
    alpha L of a labelled counterpart (v > 0). If there are several, the nearest counterpart decides.

    Args:
        matches: Matched vehicles and detections.
        outcomes: Outcomes of the vehicles at one IoU threshold.
        options: The counting rules, with alpha.

    Returns:
        (G, 33) index in `ERROR_KINDS` of each wrong keypoint; -1: correct, unlabelled, not predicted or not found.
    """
    kinds = np.full(outcomes.labelled.shape, NOT_WRONG, dtype=np.int64)
    wrong = outcomes.labelled & outcomes.predicted & ~outcomes.correct(options.alpha)
    kinds[wrong] = JITTER
    if options.scheme.name != keypoints.SCHEME:  # counterparts are defined only for skope33
        return kinds
    side = _apart(matches, outcomes, FLIP)
    ends = np.minimum(_apart(matches, outcomes, OTHER_END), _apart(matches, outcomes, [FLIP[k] for k in OTHER_END]))
    reach = options.alpha * outcomes.length[:, None]
    kinds[wrong & (side <= reach)] = LEFT_RIGHT
    kinds[wrong & (ends <= reach) & (ends < side)] = FRONT_REAR
    return kinds


def _apart(matches: Matches, outcomes: Outcomes, counterpart: Any) -> Array:
    """Return (G, 33) distances from each prediction to its counterpart, pixels; infinite if there is none."""
    counterpart = np.asarray(counterpart)
    truth = matches.gt_keypoints[:, counterpart]
    out = np.full(outcomes.labelled.shape, np.inf)
    found = outcomes.found
    out[found] = lengths(matches.det_keypoints[outcomes.detection[found], :, :2] - truth[found, :, :2])
    labelled = (truth[..., 2] > 0) & (counterpart != np.arange(keypoints.K))
    return np.where(labelled, out, np.inf)


def failure_counts(matches: Matches, outcomes: Outcomes, options: MetricOptions) -> dict[str, int]:
    """Count failures at one IoU threshold.

    Args:
        matches: A split's ground truth and detections.
        outcomes: Outcomes of the vehicles at the threshold.
        options: The counting rules.

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
    """Return (D,) whether a detection matched no vehicle and is not on an ignored vehicle."""
    false = ~matches.det_on_ignored
    false[outcomes.detection[outcomes.found]] = False
    return false
