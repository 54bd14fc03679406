"""Fold frozen normalisation into the preceding convolution, which saves passes over memory.

The function that the model computes, its weights, buffers and their names are unchanged: only methods are replaced.
"""

from torch import Tensor, nn
from torch.nn import functional
from torchvision.models.detection import KeypointRCNN
from torchvision.ops import FrozenBatchNorm2d

from skope.detector.backbones import convolutions_with_norms


class _FoldedConv2d(nn.Conv2d):
    _norm: tuple[FrozenBatchNorm2d]
    """Norm that is folded into the weights; in a tuple, so that it is not a submodule of the convolution."""

    def forward(self, x: Tensor) -> Tensor:
        (norm,) = self._norm
        scale = norm.weight * (norm.running_var + norm.eps).rsqrt()
        weight = self.weight * scale[:, None, None, None]
        bias = norm.bias - norm.running_mean * scale
        return functional.conv2d(x, weight, bias, self.stride, self.padding, self.dilation, self.groups)


class _Folded(FrozenBatchNorm2d):  # type: ignore[misc]
    def forward(self, x: Tensor) -> Tensor:
        return x


def fold_norms(model: KeypointRCNN) -> int:
    """Fold every frozen norm of the backbone into its convolution; return the number of norms."""
    pairs = [
        (owner.get_submodule(convolution), owner.get_submodule(norm))
        for owner, convolution, norm in convolutions_with_norms(model)
    ]
    frozen = [(conv, norm) for conv, norm in pairs if type(norm) is FrozenBatchNorm2d]
    for conv, norm in frozen:
        assert type(conv) is nn.Conv2d
        assert conv.bias is None
        conv.__class__, norm.__class__ = _FoldedConv2d, _Folded
        conv._norm = (norm,)  # type: ignore[assignment]
    return len(frozen)
