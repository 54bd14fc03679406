"""Folding frozen norms changes neither outputs nor gradients nor the state dict."""

import copy

import pytest
import torch
from torch import nn
from torchvision.ops import FrozenBatchNorm2d

from skope.detector.backbones import multiply_in
from skope.detector.build import DetectorConfig, build
from skope.train.fold_batchnorm import fold_norms
from tests.detector.test_detector import use_uneven_statistics


def test_folded_and_plain_agree() -> None:
    torch.manual_seed(0)
    plain = build(DetectorConfig(norm="frozen", norm_eps=1e-3, min_size=96, max_size=160), trainable_layers=3)
    use_uneven_statistics(plain)
    folded = copy.deepcopy(plain).to(memory_format=torch.channels_last)
    assert fold_norms(folded) == 53
    pixels = torch.rand(2, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    maps = [model.backbone(pixels) for model in (plain, folded)]
    for name in maps[0]:
        torch.testing.assert_close(maps[1][name], maps[0][name], rtol=1e-3, atol=1e-4)
    for each in maps:
        sum(one.square().mean() for one in each.values()).backward()
    gradients = [{n: p.grad for n, p in model.named_parameters() if p.grad is not None} for model in (plain, folded)]
    assert gradients[0].keys() == gradients[1].keys()
    for name, gradient in gradients[0].items():
        torch.testing.assert_close(gradients[1][name], gradient, rtol=1e-2, atol=1e-3 * float(gradient.abs().max()))
    assert list(folded.state_dict()) == list(plain.state_dict())


def test_norms_that_learn_are_left_alone() -> None:
    assert fold_norms(build(DetectorConfig(norm="batch", norm_eps=1e-5, min_size=96, max_size=160))) == 0


@pytest.mark.parametrize("norm", ["frozen", "batch"])
def test_norms_that_are_multiplied_in_for_good_leave_the_maps_as_they_were(norm: str) -> None:
    torch.manual_seed(0)
    model = build(DetectorConfig(norm=norm, norm_eps=1e-3, min_size=96, max_size=160)).eval()
    use_uneven_statistics(model)
    pixels = torch.rand(1, 3, 64, 96, generator=torch.Generator().manual_seed(0))
    with torch.inference_mode():
        before = model.backbone(pixels)
        multiply_in(model)
        after = model.backbone(pixels)
    assert not any(isinstance(module, FrozenBatchNorm2d | nn.BatchNorm2d) for module in model.backbone.modules())
    for name, one in before.items():
        torch.testing.assert_close(after[name], one, rtol=1e-3, atol=1e-4)
