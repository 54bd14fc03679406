"""Second moments of layers' inputs against torch's own unfolding, and of a detector's layers."""

import numpy as np
import pytest
import torch
from torch import nn

from skope.detector.build import DetectorConfig, build
from skope.train import export
from tests.train.conftest import shrink


@pytest.mark.parametrize(("kernel", "stride", "pad"), [(3, 1, 1), (3, 2, 1), (1, 2, 0), (7, 2, 3)])
def test_inputs_of_a_convolution_are_its_patches(kernel: int, stride: int, pad: int) -> None:
    layer = nn.Conv2d(5, 4, kernel, stride=stride, padding=pad, bias=False)
    x = torch.randn(2, 5, 9, 11, generator=torch.Generator().manual_seed(0))
    patches = export._sample(layer, x, torch.Generator())
    outputs = patches @ layer.weight.flatten(1).T
    torch.testing.assert_close(outputs, layer(x).permute(0, 2, 3, 1).flatten(0, 2), atol=1e-5, rtol=1e-5)


def test_all_layers_of_a_detector_are_seen(monkeypatch: pytest.MonkeyPatch) -> None:
    shrink(monkeypatch)
    torch.manual_seed(0)
    model = build(DetectorConfig(norm="frozen", norm_eps=1e-5, min_size=64, max_size=96)).eval()
    model.roi_heads.score_thresh = 0.0
    image = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    moments = export.gather(model, [image])
    layers = {name: m for name, m in model.named_modules() if isinstance(m, nn.Conv2d | nn.Linear)}
    assert moments.keys() == {f"{name}.weight" for name in layers}
    for name, layer in layers.items():
        size = layer.weight.flatten(1).shape[1]
        own = moments[f"{name}.weight"]
        assert own.shape == (size, size)
        assert (own.diagonal() >= 0).all()
    assert not any(module._forward_pre_hooks for module in model.modules())
