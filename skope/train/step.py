"""One step of the optimiser over the images of all processes; Ctrl-C and SIGTERM wait until it is done."""

import math
import os
import signal
import threading
from collections.abc import Sequence
from types import FrameType, TracebackType
from typing import Any, Final, Self

import numpy as np
import torch
from torch import Tensor

from skope.errors import UserError
from skope.train import teacher
from skope.train.distributed import ProcessGroup
from skope.train.losses import LossSettings, detection_losses
from skope.train.recipe import Recipe
from skope.train.training_samples import TrainingSample
from skope.train.training_state import TrainingState

STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM)
STOP_MESSAGE = b"\nskope: stopping after this step, to save it; once more stops at once\n"


class StopRequest:
    """Context in which the first SIGINT or SIGTERM only sets `asked`; a second one interrupts at once."""

    def __init__(self, *, tell: bool = False) -> None:
        """With `tell`, the first signal is acknowledged on standard error."""
        self.asked: signal.Signals | None = None
        self._tell = tell
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():  # Python allows handlers only in the main thread
            self._before = {number: signal.signal(number, self._heard) for number in STOP_SIGNALS}
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        if self.asked is not None:
            raise KeyboardInterrupt
        self.asked = signal.Signals(number)
        if self._tell:  # print() may be in the middle of a line
            os.write(2, STOP_MESSAGE)


def ignore_signals(_worker: int) -> None:
    """Ignore SIGINT and SIGTERM in a worker process, so that its parent ends it."""
    for number in STOP_SIGNALS:
        signal.signal(number, signal.SIG_IGN)


LOSS_NAMES: Final = ("loss_classifier", "loss_box_reg", "loss_keypoint", "loss_objectness", "loss_rpn_box_reg")
"""Names of the losses, in torchvision's order."""


def loss_names(training: TrainingState) -> tuple[str, ...]:
    """Return the names of the losses of a step."""
    return LOSS_NAMES if training.teacher is None else (*LOSS_NAMES, *teacher.TEACHER_LOSSES)


def seed(seed: int, epoch: int, step: int, processes: ProcessGroup) -> None:
    """Seed torch's global state, with which a step samples its regions. The seed is the same after resuming."""
    rank = () if processes.first else (processes.rank,)
    torch.manual_seed(int(np.random.SeedSequence((seed, epoch, step, *rank)).generate_state(1)[0]))


def train_on_batch(
    training: TrainingState,
    batch: Sequence[TrainingSample],
    recipe: Recipe,
    *,
    rate: float,
    images: int,
    processes: ProcessGroup,
    votes: Sequence[float],
) -> tuple[dict[str, float], list[float]]:
    """Train on one batch: forward, backward, sum over all processes, one step of the optimiser.

    Parts of a batch that are processed one after another or in several processes are weighted by their number of
    images.

    Args:
        training: The model and its optimiser, which are changed.
        batch: This process's share of the batch; may be empty.
        recipe: Number of images at once, precision, and limit of the gradients.
        rate: Learning rate of this step.
        images: Number of images of the whole batch, of all processes.
        processes: Processes that train together.
        votes: Numbers of this process that are summed over all processes in the same message as the losses.

    Returns:
        The losses of the whole batch by name, with their sum as `loss`, and the sums of the votes.

    Raises:
        UserError: The loss is not finite; the message names the images, and the weights are unchanged.
    """
    parameters = [p for group in training.optimizer.param_groups for p in group["params"]]
    device = parameters[0].device
    training.optimizer.zero_grad(set_to_none=True)
    at_once = recipe.images_at_once or max(1, len(batch))
    names = loss_names(training)
    local_losses, last = torch.zeros(len(names), device=device), None
    for start in range(0, len(batch), at_once):
        if last is not None:
            last.backward()  # type: ignore[no-untyped-call]
        weighted = _losses(training, batch[start : start + at_once], recipe, images, device)
        local_losses, last = local_losses + weighted.detach(), weighted.sum()
    # The values are requested before the last backward pass: while the GPU computes it, the next step is prepared.
    together = torch.cat([local_losses, torch.tensor(votes, dtype=torch.float32, device=device)])
    processes.sum_over_all([together])
    numbers = together.tolist()
    values, votes_of_all = numbers[: len(names)], numbers[len(names) :]
    if not math.isfinite(sum(values)):
        _refuse(batch, training.epochs_done + 1, mine=not bool(local_losses.isfinite().all()))
    if last is not None:
        last.backward()  # type: ignore[no-untyped-call]
    for parameter in parameters:
        if parameter.grad is None:  # this process had no image
            parameter.grad = torch.zeros_like(parameter)
    processes.sum_over_all([parameter.grad for parameter in parameters if parameter.grad is not None])
    if recipe.gradient_clip is not None:
        torch.nn.utils.clip_grad_norm_(parameters, recipe.gradient_clip)
    for group in training.optimizer.param_groups:
        group["lr"] = rate
    training.optimizer.step()
    return {"loss": sum(values), **dict(zip(names, values, strict=True))}, votes_of_all


def _losses(
    training: TrainingState, part: Sequence[TrainingSample], recipe: Recipe, images: int, device: torch.device
) -> Tensor:
    """Return the losses of some images in the order of `loss_names`, weighted by their share of the batch."""
    pixels = [sample.pixels.to(device, non_blocking=True) for sample in part]
    rules = LossSettings(recipe.regions, recipe.keypoint_regions, recipe.ignore_below)
    with torch.autocast(device.type, torch.bfloat16, enabled=recipe.bfloat16):
        found = detection_losses(training.model, pixels, [each.target for each in part], rules, training.teacher)
    return torch.stack([found[name].float() for name in loss_names(training)]) * (len(part) / images)


def _refuse(batch: Sequence[TrainingSample], epoch: int, *, mine: bool) -> None:
    names = ", ".join(sample.name for sample in batch) if mine else "images of another process"
    raise UserError(
        f"epoch {epoch}: the loss is no longer a finite number, at {names}; see these images, or take a recipe with a "
        "lower rate (the last checkpoint is as it was)"
    )
