"""Train a detector: one screen of stages, and the steps inside an epoch."""

import math
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Final, Self

import numpy as np
import torch

from skope.console import Console, minutes
from skope.dataset import open_dataset
from skope.detector import checkpoint_name
from skope.errors import UserError
from skope.train import assign, data, run
from skope.train.data import Sample, TrainingSet
from skope.train.recipe import Recipe
from skope.train.run import RunConfig, Training

SAVE_INTERVAL_S: Final = 60.0
"""Half a gigabyte is written for a checkpoint: not after every epoch when epochs take seconds."""

_MEASURED_STEPS = 2
_LEAST_INSIDE = 0.8


def train(
    config: RunConfig,
    out: Path,
    *,
    device: torch.device,
    workers: int,
    resume: bool,
    console: Console,
    save_interval_s: float = SAVE_INTERVAL_S,
) -> Path:
    """Train as `config` says, with checkpoints in the run folder `out`; returns the last checkpoint.

    A checkpoint is written after the last epoch, and after each other one unless the one before is younger than
    `save_interval_s`. Raises UserError for a dataset without anything to learn from, a broken image, a folder that
    holds another run, and a loss that is no longer finite.
    """
    recipe = config.recipe
    training_set = TrainingSet(
        open_dataset(Path(config.data)),
        seed=config.seed,
        flip_probability=recipe.flip_probability,
        supervise=recipe.supervise,
        max_images=config.max_images,
    )
    training = run.resume(out, config, device) if resume else run.start(out, config, device)
    assign.prepare(training.model, regions=recipe.regions, keypoint_regions=recipe.keypoint_regions)
    _announce(config, training, training_set, f"on {device}, {workers} extra processes", console)

    steps = math.ceil(len(training_set) / recipe.batch_size)
    progress = _Progress(steps, training.epochs_done, recipe.epochs, console)
    saved_at = time.monotonic()
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []), progress:
        while training.epochs_done < recipe.epochs:
            batches = data.batches(
                training_set, training.epochs_done, seed=config.seed, batch_size=recipe.batch_size, workers=workers
            )
            _epoch(config, training, batches, steps, device, progress)
            if training.epochs_done == recipe.epochs or time.monotonic() - saved_at >= save_interval_s:
                run.save(out, config, training)
                saved_at = time.monotonic()
    return out / checkpoint_name(training.epochs_done)


def _announce(config: RunConfig, training: Training, training_set: TrainingSet, where: str, console: Console) -> None:
    recipe = config.recipe
    console.say(f"{recipe.describe()}; {training.origin}; seed {config.seed}; {where}")
    console.say(f"{config.data}: {len(training_set)} images with {training_set.vehicles} vehicles to learn from")
    if training.epochs_done:
        console.say(f"resumed after epoch {training.epochs_done}")
    elif training.config.norm == "batch" and recipe.init != "random":
        console.say(f"recipe {recipe.name} fine-tunes trained weights; `--recipe scratch` is made for random ones")


def _epoch(
    config: RunConfig,
    training: Training,
    batches: Iterable[Sequence[Sample]],
    steps: int,
    device: torch.device,
    progress: "_Progress",
) -> None:
    """One pass over the images, which ends with its mean losses in the history."""
    epoch = training.epochs_done
    # torchvision's samplers draw from torch's global state; seeded here, an epoch is the same wherever a run resumes.
    torch.manual_seed(int(np.random.SeedSequence((config.seed, epoch)).generate_state(1)[0]))
    training.model.train()
    sums: dict[str, float] = {}
    for step, batch in enumerate(batches):
        if epoch == step == 0:
            _check_first(batch, progress.console)
        losses = _step(training, batch, config.recipe, step=epoch * steps + step, device=device)
        sums = {name: sums.get(name, 0.0) + value for name, value in losses.items()}
        progress.tick(epoch, {name: value / (step + 1) for name, value in sums.items()})
    training.epochs_done += 1
    training.history.append({"epoch": training.epochs_done, **{name: value / steps for name, value in sums.items()}})


def _step(
    training: Training, batch: Sequence[Sample], recipe: Recipe, *, step: int, device: torch.device
) -> dict[str, float]:
    """One step of the optimiser, counted over the whole run; returns each loss, and their sum as `loss`."""
    for group in training.optimizer.param_groups:
        group["lr"] = recipe.rate(training.epochs_done, step)
    images, targets = zip(*(sample.to(device) for sample in batch), strict=True)
    with torch.autocast(device.type, torch.bfloat16, enabled=recipe.bfloat16):
        losses = training.model(list(images), list(targets))
    total = torch.stack(list(losses.values())).sum()
    values = {"loss": total.item(), **{name: loss.item() for name, loss in losses.items()}}
    if not math.isfinite(values["loss"]):
        names = ", ".join(sample.name for sample in batch)
        raise UserError(
            f"epoch {training.epochs_done + 1}: the loss is no longer a finite number, at {names}; see these "
            "images, or take a recipe with a lower rate (the last checkpoint is as it was)"
        )
    training.optimizer.zero_grad(set_to_none=True)
    total.backward()  # type: ignore[no-untyped-call]
    if recipe.gradient_clip is not None:
        torch.nn.utils.clip_grad_norm_(training.model.parameters(), recipe.gradient_clip)
    training.optimizer.step()
    return values


def _check_first(batch: Sequence[Sample], console: Console) -> None:
    """Keypoint R-CNN can only learn points inside their box: stop when boxes and keypoints do not belong together."""
    share = data.share_inside(batch)
    if share is None or share >= _LEAST_INSIDE:
        return
    names = ", ".join(sample.name for sample in batch)
    if share == 0:
        raise UserError(
            f"{names}: no labelled keypoint lies inside its vehicle's bbox: fields bbox and keypoints differ"
        )
    console.say(f"warning: {names}: only {share:.0%} of the labelled keypoints lie inside their vehicle's bbox")


class _Progress:
    """A bar over all steps of the run with the epoch's mean losses; says once how long the run will take."""

    def __init__(self, steps: int, epochs_done: int, epochs: int, console: Console) -> None:
        self.console = console
        self._epochs, self._total, self._seen = epochs, steps * (epochs - epochs_done), 0
        self._bar = console.bar(total=self._total, unit="step", label="training")
        self._since = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tick(self, epoch: int, losses: Mapping[str, float]) -> None:
        """A step is done."""
        values = {name.removeprefix("loss_"): f"{value:.3f}" for name, value in losses.items()}
        self._bar.set_postfix({"epoch": f"{epoch + 1}/{self._epochs}", **values}, refresh=False)
        self._bar.update()
        self._seen += 1
        if self._seen == 1:  # the first step also sets up what the others find ready
            self._since = time.perf_counter()
        elif self._seen == 1 + _MEASURED_STEPS:
            step_s = (time.perf_counter() - self._since) / _MEASURED_STEPS
            self._bar.clear()
            self.console.say(f"{step_s:.2g} s a step: about {minutes(step_s * self._total)} for {self._total} steps")
