"""Two threads share a model, and each gets what it would get alone."""

import contextlib
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch

from skope.detector.checkpoint import load_weights
from skope.detector.detect import detect

MEETING_S = 0.3
"""A thread that is let in while another one detects has come to the network by then."""


def test_two_threads_share_a_model(random_run: Path) -> None:
    model, _, _ = load_weights(next(random_run.glob("*.safetensors")), "cpu")
    image = np.random.default_rng(0).integers(0, 255, (64, 96, 3), dtype=np.uint8)
    scores = (0.0, 0.9)
    (every,), (few,) = (detect(model, [image], "cpu", min_score=score, max_detections=5) for score in scores)
    assert len(every) > len(few)

    inside = threading.Barrier(2)

    def meet(*_: object) -> None:
        """Both threads are past setting their thresholds before either reads them, unless one has to wait."""
        with contextlib.suppress(threading.BrokenBarrierError):
            inside.wait(MEETING_S)

    hook = model.backbone.register_forward_pre_hook(meet)
    with ThreadPoolExecutor(2) as pool:
        found = list(
            pool.map(lambda score: detect(model, [image], "cpu", min_score=score, max_detections=5)[0], scores)
        )
    hook.remove()
    assert [len(one) for one in found] == [len(every), len(few)]
    np.testing.assert_array_equal(found[0].scores, every.scores)
    assert not model.training
    assert not torch.is_inference_mode_enabled()
