"""Stochastic gradient descent with a learning rate per step, and a moving average of the weights."""

import math
from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchvision.models.detection import KeypointRCNN

from skope.train.recipe import Recipe


def placed(model: KeypointRCNN, recipe: Recipe, device: torch.device) -> KeypointRCNN:
    """Return the model on a device, in the recipe's memory layout."""
    layout = torch.channels_last if recipe.channels_last else torch.contiguous_format
    return model.to(device=device, memory_format=layout)


def make_weight_ema(model: KeypointRCNN, recipe: Recipe) -> AveragedModel | None:
    """Make the exponential moving average (EMA) of the model's weights and statistics over the steps.

    The average decays faster in the first steps. The initial weights would otherwise influence it for long.
    """
    decay = recipe.ema_decay
    if decay is None:
        return None

    def average(mean: Any, now: Any, steps: int | Tensor) -> None:
        share = min(decay, (1 + int(steps)) / (10 + int(steps)))
        get_ema_multi_avg_fn(share)(mean, now, steps)  # type: ignore[no-untyped-call]

    return AveragedModel(model, multi_avg_fn=average, use_buffers=True)


def learning_rate_at(recipe: Recipe, step: int, steps: int) -> float:
    """Return the learning rate at `step`, counted from 0 over the run, if an epoch has `steps`: warm-up, then decay."""
    warm = min(1.0, (step + 1) / recipe.warmup_steps) if recipe.warmup_steps else 1.0
    if recipe.cosine_to is None:
        return recipe.learning_rate * warm * float(recipe.gamma ** (step // steps // recipe.decay_epochs))
    share = (1 + math.cos(math.pi * step / (steps * recipe.epochs))) / 2
    return recipe.learning_rate * warm * (recipe.cosine_to + (1 - recipe.cosine_to) * share)


def make_sgd(model: KeypointRCNN, recipe: Recipe) -> torch.optim.SGD:
    """Return stochastic gradient descent on the trainable parameters, with one pass over memory per step."""
    return torch.optim.SGD(
        [parameter for parameter in model.parameters() if parameter.requires_grad],
        lr=recipe.learning_rate,
        momentum=recipe.momentum,
        weight_decay=recipe.weight_decay,
        fused=True,
    )
