"""Stochastic gradient descent on a model's weights, and their moving average, which is validated and saved."""

from typing import Any

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn
from torchvision.models.detection import KeypointRCNN

from skope.train.recipe import Recipe


def placed(model: KeypointRCNN, recipe: Recipe, device: torch.device) -> KeypointRCNN:
    """The model on a device, in the recipe's memory layout."""
    layout = torch.channels_last if recipe.channels_last else torch.contiguous_format
    return model.to(device=device, memory_format=layout)


def make_weight_ema(model: KeypointRCNN, recipe: Recipe) -> AveragedModel | None:
    """An exponential moving average (EMA) of the model's weights and statistics over the steps to come.

    In the first steps it forgets faster, or the first weights would weigh for long.
    """
    decay = recipe.ema_decay
    if decay is None:
        return None

    def average(mean: Any, now: Any, steps: int | Tensor) -> None:
        share = min(decay, (1 + int(steps)) / (10 + int(steps)))
        get_ema_multi_avg_fn(share)(mean, now, steps)  # type: ignore[no-untyped-call]

    return AveragedModel(model, multi_avg_fn=average, use_buffers=True)


def make_sgd(model: KeypointRCNN, recipe: Recipe) -> torch.optim.SGD:
    """Stochastic gradient descent on the parameters that learn, in one pass over memory a step."""
    return torch.optim.SGD(
        [parameter for parameter in model.parameters() if parameter.requires_grad],
        lr=recipe.learning_rate,
        momentum=recipe.momentum,
        weight_decay=recipe.weight_decay,
        fused=True,
    )
