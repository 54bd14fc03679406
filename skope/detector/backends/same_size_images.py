"""Images of one size after another: their anchors are worked out once, and they are normalised when they are small."""

from typing import Any

from torch import Tensor, nn
from torchvision.models.detection import KeypointRCNN
from torchvision.models.detection.anchor_utils import AnchorGenerator
from torchvision.models.detection.image_list import ImageList
from torchvision.models.detection.transform import GeneralizedRCNNTransform


def resize_first(model: KeypointRCNN) -> None:
    """Let a model resize images before it normalises them from now on."""
    model.transform = ResizeFirst(model.transform)


def keep_anchors(model: KeypointRCNN) -> None:
    """Let a model keep the anchors of the last size of images from now on."""
    model.rpn.anchor_generator = KeptAnchors(model.rpn.anchor_generator)


class ResizeFirst(GeneralizedRCNNTransform):  # type: ignore[misc]  # torchvision has no types
    """torchvision's transform in the other order, with the same answer up to rounding: fewer pixels are normalised."""

    def __init__(self, transform: GeneralizedRCNNTransform) -> None:
        super().__init__(
            transform.min_size, transform.max_size, transform.image_mean, transform.image_std, transform.size_divisible
        )

    def normalize(self, image: Tensor) -> Tensor:
        """The image as it is: `resize` normalises."""
        return image

    def resize(self, image: Tensor, target: Any = None) -> tuple[Tensor, Any]:
        """The image (3, h, w) as the network takes it, of (3, H, W) from 0 to 1, and the target."""
        resized, moved = super().resize(image, target)
        return super().normalize(resized), moved


class KeptAnchors(nn.Module):
    """`AnchorGenerator`'s anchors, worked out again only where the images have another size."""

    def __init__(self, generator: AnchorGenerator) -> None:
        super().__init__()
        self._generator = generator
        self._kept: tuple[Any, list[Tensor]] = (None, [])

    def forward(self, images: ImageList, maps: list[Tensor]) -> list[Tensor]:
        """The (A, 4) anchors of each image on its feature maps."""
        first = maps[0]
        key = (
            images.tensors.shape,
            len(images.image_sizes),
            first.dtype,
            first.device,
            *(one.shape[2:] for one in maps),
        )
        if key != self._kept[0]:
            self._kept = (key, self._generator(images, maps))
        return self._kept[1]
