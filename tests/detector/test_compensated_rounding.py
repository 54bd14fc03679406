"""Compensated rounding against brute force and against rounding to what is nearest."""

import itertools

import pytest
import torch
from torch import Tensor

from skope.detector import compact_weights
from skope.detector.compact_weights import CompensatedRounding


def correlated(count: int, size: int) -> Tensor:
    """(count, size) inputs of which each resembles those beside it, as pixels do."""
    noise = torch.randn(count, size + 8, generator=torch.Generator().manual_seed(1))
    return torch.stack([noise[:, i : i + 9].mean(1) for i in range(size)], dim=1)


def output_error(rounded: Tensor, weights: Tensor, inputs: Tensor) -> float:
    return float((inputs @ (rounded - weights).T).square().mean())


def test_inputs_that_have_nothing_to_do_with_each_other_leave_what_is_nearest() -> None:
    weights = torch.randn(4, 300, generator=torch.Generator().manual_seed(0))
    assert torch.equal(CompensatedRounding(torch.eye(300))(weights, torch.round), weights.round())


def test_outputs_change_several_times_less_than_with_the_nearest() -> None:
    weights = 3 * torch.randn(16, 300, generator=torch.Generator().manual_seed(0))
    inputs = correlated(4000, 300)
    rounded = CompensatedRounding(inputs.T @ inputs / len(inputs))(weights, torch.round)
    assert torch.equal(rounded, rounded.round())
    assert output_error(rounded, weights, inputs) < 0.3 * output_error(weights.round(), weights, inputs)


@pytest.mark.parametrize("seed", range(5))
def test_few_weights_are_rounded_nearly_as_well_as_can_be(seed: int) -> None:
    weights = 3 * torch.randn(1, 6, generator=torch.Generator().manual_seed(seed))
    inputs = correlated(500, 6)
    changes = torch.tensor(list(itertools.product((0, 1), repeat=6)))
    best = min(output_error(weights.floor() + change, weights, inputs) for change in changes)
    rounded = CompensatedRounding(inputs.T @ inputs / len(inputs))(weights, torch.round)
    ours, nearest = output_error(rounded, weights, inputs), output_error(weights.round(), weights, inputs)
    assert ours <= max(nearest, 2 * best)


def test_inputs_that_are_always_zero_do_no_harm() -> None:
    inputs = correlated(100, 20)
    inputs[:, 7] = 0
    weights = torch.randn(3, 20, generator=torch.Generator().manual_seed(0))
    rounded = CompensatedRounding(inputs.T @ inputs / len(inputs))(weights, torch.round)
    assert rounded.isfinite().all()
    assert CompensatedRounding(torch.zeros(20, 20))(weights, torch.round).isfinite().all()


def test_packed_weights_keep_their_outputs_within_the_same_bytes() -> None:
    weights = torch.randn(64, 32, 3, 3, generator=torch.Generator().manual_seed(0))
    inputs = correlated(4000, 288)
    errors = []
    for moments in (None, {"a": inputs.T @ inputs / len(inputs)}):
        stored, kept = compact_weights.pack({"a": weights}, 9_000, moments=moments)
        assert len(stored["a"]) <= 9_000
        back = compact_weights.unpack(stored, kept)["a"]
        errors.append(output_error(back.flatten(1), weights.flatten(1), inputs))
    assert errors[1] < 0.3 * errors[0]
