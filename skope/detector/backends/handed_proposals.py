"""A pyramid that also computes the scores and offsets of its anchors, and what hands those to torchvision."""

from torch import Tensor, nn


class PyramidWithProposals(nn.Module):
    """In place of the detector's backbone: notes what the proposals' head would answer to its maps.

    `forward` of those that compute it gives the feature maps of (N, 3, H, W) images, by name.
    """

    def __init__(self, out_channels: int) -> None:
        super().__init__()
        self.out_channels = out_channels
        self.proposals: tuple[list[Tensor], list[Tensor]] = ([], [])
        """Scores and offsets of the anchors for the images that were seen last."""


class HandedProposals(nn.Module):
    """In place of the proposals' head: answers what the pyramid has computed."""

    def __init__(self, pyramid: PyramidWithProposals) -> None:
        super().__init__()
        self._pyramid = (pyramid,)  # in a tuple, or it would be a part of this module

    def forward(self, features: list[Tensor]) -> tuple[list[Tensor], list[Tensor]]:
        return self._pyramid[0].proposals
