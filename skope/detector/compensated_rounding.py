"""Rounding of a layer's weights in which those that are still to be rounded make up for the errors of those before.

GPTQ (Frantar, Ashkboos, Hoefler and Alistarh, 2023): the layer's outputs, not its weights, are to change least. What
decides is the mean of x x^T over the layer's inputs x.
"""

from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor

_MOMENT_DAMPING: Final = 0.01
"""Added to the moments' diagonal, as a share of its mean: they come from a sample."""
_COLUMNS_AT_ONCE: Final = 128
"""Columns whose errors are carried over to all later ones at once."""


class CompensatedRounding:
    """Rounds the weights of a layer, those of the largest inputs first."""

    def __init__(self, moments: Tensor) -> None:
        """Take the (N, N) float32 mean of x x^T over inputs x, on the device that is to compute."""
        self.device = moments.device
        damped = moments.double()
        diagonal = damped.diagonal()
        diagonal += _MOMENT_DAMPING * diagonal.mean() + torch.finfo(torch.float32).tiny
        self._order = torch.argsort(diagonal, descending=True, stable=True)
        damped = damped[self._order][:, self._order]
        inverse = torch.cholesky_inverse(torch.linalg.cholesky(damped))
        self._influence = torch.linalg.cholesky(inverse, upper=True).float()
        """(N, N) upper triangle: in a row what the error of a column does to later ones."""

    def __call__(self, weights: Tensor, nearest: Callable[[Tensor], Tensor]) -> Tensor:
        """Round (C, N) float32 weights; `nearest` rounds a column, (C,), to values that can be kept."""
        influence = self._influence
        left = weights.to(self.device)[:, self._order]
        rounded = torch.empty_like(left)
        for begin in range(0, len(influence), _COLUMNS_AT_ONCE):
            block = left[:, begin : begin + _COLUMNS_AT_ONCE]
            end = begin + block.shape[1]
            errors, near = torch.empty_like(block), influence[begin:end, begin:end]
            for i in range(end - begin):
                rounded[:, begin + i] = nearest(block[:, i])
                errors[:, i] = (block[:, i] - rounded[:, begin + i]) / near[i, i]
                block[:, i + 1 :] -= errors[:, i : i + 1] * near[i : i + 1, i + 1 :]
            left[:, end:] -= errors @ influence[begin:end, end:]
        out = torch.empty_like(rounded)
        out[:, self._order] = rounded
        return out.to(weights.device)
