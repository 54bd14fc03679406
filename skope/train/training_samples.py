"""Training samples: images and targets in the form of torchvision's detectors, with augmentation, and their order.

The augmentation of an image depends only on seed, epoch, dataset, image id and the number of earlier uses in the epoch.
It is therefore independent of the number of workers or processes and of interruptions.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import Dataset as TorchDataset

from skope import keypoints, schema
from skope.dataset.folder import Dataset
from skope.errors import UserError, one_of
from skope.schema import Image
from skope.train.augment import Augment
from skope.train.recipe import SUPERVISE_CHOICES
from skope.train.splits import TRAINING_SPLIT, TrainingSource
from skope.train.target_batch import IGNORED_KEY
from skope.train.targets import Vehicles, vehicles_of

Draw = tuple[int, int, int]
"""Request for a sample: epoch, index of the image in the training set, and number of its earlier uses in the epoch."""


@dataclass(frozen=True)
class TrainingSample:
    """One image with its vehicles and other road users for training."""

    name: str
    pixels: torch.Tensor
    """(3, H, W) uint8 sRGB."""
    target: dict[str, torch.Tensor]
    """boxes (N, 4) float32 xyxy, labels (N,) int64, keypoints (N, 33, 3) float32, ignored_boxes (M, 4) float32.

    Vehicles come first, with label 1; others follow, with labels from 2 and keypoints that are all v = 0."""

    def pin_memory(self) -> "TrainingSample":
        """Return the sample with its pixels in pinned memory, from which a GPU copies asynchronously.

        Targets are not pinned: those of a batch are combined before they are transferred.
        """
        return TrainingSample(self.name, self.pixels.pin_memory(), self.target)


@dataclass(frozen=True)
class _Frame:
    source: int
    dataset: Dataset
    image: Image
    vehicles: Vehicles


class TrainingSet(TorchDataset[TrainingSample | UserError]):
    """Images of all datasets with their vehicles, one dataset after another; an index is a `Draw`."""

    def __init__(
        self,
        sources: Sequence[TrainingSource],
        *,
        seed: int,
        augment: Augment,
        supervise: str,
        inside: tuple[int, int] | None = None,
    ) -> None:
        """Gather the images.

        Args:
            sources: The datasets.
            seed: Seed of the run.
            augment: Probabilities of changes to images.
            supervise: "visible", or "all" for hidden keypoints too.
            inside: Short and largest long side of images inside the network, pixels, for `augment.reduce`.
        """
        self._seed, self._augment, self._supervise, self._inside = seed, augment, supervise, inside
        self._frames = [
            _Frame(number, source.dataset, image, vehicles)
            for number, source in enumerate(sources)
            for image, vehicles in zip(source.learnt.images, source.vehicles(), strict=True)
        ]
        self.sizes = tuple(len(source.learnt.images) for source in sources)
        """Number of images of each dataset."""
        if not any((frame.vehicles.supervised(supervise)[..., 2] > 0).any() for frame in self._frames):
            path = sources[0].dataset.root / "annotations" / f"{TRAINING_SPLIT}.json"
            least = "visible point (v = 2)" if supervise == "visible" else "labelled point (v > 0)"
            raise UserError(f"{path}: field keypoints: no {least} in any annotation")

    @property
    def vehicles(self) -> int:
        """Number of vehicles for training, without ignored ones."""
        return sum(len(frame.vehicles.boxes_xyxy) for frame in self._frames)

    @property
    def road_users(self) -> int:
        """Number of other road users for training, without ignored ones."""
        return sum(len(frame.vehicles.road_users_xyxy) for frame in self._frames)

    @property
    def largest_image(self) -> int:
        """Size of the pixels of the largest image, bytes."""
        return max(3 * frame.image.width * frame.image.height for frame in self._frames)

    def __len__(self) -> int:
        return len(self._frames)

    def __getitem__(self, index: Draw) -> TrainingSample | UserError:
        """Return the sample, or the error in the user's files, which a worker would raise inside a traceback."""
        epoch, position, repeat = index
        frame = self._frames[position]
        try:
            pixels = frame.dataset.image(frame.image)
        except UserError as error:
            return error
        rng = np.random.default_rng((self._seed, epoch, frame.source, frame.image.id, repeat))
        pixels, vehicles = self._augment.apply(pixels, frame.vehicles, rng, self._scale(frame.image))
        return to_sample(frame.image.file_name, pixels, vehicles, self._supervise)

    def _scale(self, image: Image) -> float:
        """Return the size of an image inside the network relative to its own size; 1 if it is not known."""
        if self._inside is None:
            return 1.0
        short, long = sorted((image.width, image.height))
        return min(self._inside[0] / short, self._inside[1] / long)


class DetectionDataset(TorchDataset[tuple[torch.Tensor, dict[str, torch.Tensor]]]):
    """Images of a split in the form of torchvision's detection models, unchanged and in file order."""

    def __init__(self, dataset: Dataset, split: str, supervise: str) -> None:
        """`supervise` is "visible", or "all" for hidden keypoints too."""
        self._supervise = one_of("supervise", supervise, SUPERVISE_CHOICES)
        self._images = list(dataset.images(split))
        self._categories = dataset.read(split).categories

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: int) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Return pixels (3, H, W) float32 from 0 to 1, and the target (see `TrainingSample`)."""
        labelled = self._images[index]
        vehicles = vehicles_of(labelled.record, labelled.annotations, labelled.road_users, self._categories)
        sample = to_sample(labelled.record.file_name, labelled.pixels(), vehicles, self._supervise)
        return sample.pixels.float() / 255, sample.target


def to_sample(name: str, pixels: NDArray[np.uint8], vehicles: Vehicles, supervise: str) -> TrainingSample:
    """Return a training sample as tensors.

    Args:
        name: The image's file, for errors.
        pixels: (H, W, 3) RGB.
        vehicles: Its vehicles and other road users, in pixels.
        supervise: "visible" for visible keypoints, "all" for hidden ones too.
    """
    count = len(vehicles.boxes_xyxy)
    boxes = np.concatenate([vehicles.boxes_xyxy, vehicles.road_users_xyxy])
    labels = np.concatenate([np.full(count, schema.CATEGORY_ID), vehicles.road_user_labels])
    points = np.zeros((len(boxes), keypoints.K, 3))
    points[:count] = vehicles.supervised(supervise)
    target = {
        "boxes": torch.as_tensor(boxes, dtype=torch.float32),
        "labels": torch.as_tensor(labels, dtype=torch.int64),
        "keypoints": torch.as_tensor(points, dtype=torch.float32),
        IGNORED_KEY: torch.as_tensor(vehicles.ignored_xyxy, dtype=torch.float32),
    }
    return TrainingSample(name, torch.as_tensor(np.ascontiguousarray(pixels.transpose(2, 0, 1))), target)


def order(sizes: Sequence[int], mix: float | None, *, seed: int, epoch: int) -> list[Draw]:
    """Sample the order of the images in an epoch.

    Args:
        sizes: Number of images of each dataset.
        mix: Share of the samples from the first dataset; the others share the rest by size. Within a dataset, no image
            is used again before all were used once. None: each image is used once.
        seed: Seed of the run.
        epoch: Number of the epoch, from 0.
    """
    rng = np.random.default_rng((seed, epoch))
    total = sum(sizes)
    counts = list(sizes)
    if mix is not None:
        rest = total - sizes[0]
        ends = [0, *np.rint(np.cumsum([mix] + [(1 - mix) * n / rest for n in sizes[1:]]) * total).astype(int)]
        counts = np.diff(ends).tolist()
    draws: list[Draw] = []
    for start, size, count in zip(np.cumsum([0, *sizes[:-1]]), sizes, counts, strict=True):
        for repeat in range(-(-count // size)):
            left = min(size, count - repeat * size)
            draws += [(epoch, int(start + i), repeat) for i in rng.permutation(size)[:left]]
    return [draws[i] for i in rng.permutation(len(draws))]


def mean_share_inside(samples: Sequence[TrainingSample]) -> float | None:
    """Return the share of labelled keypoints inside their vehicle's box; None without a labelled keypoint."""
    inside = labelled = 0
    for sample in samples:
        points, corners = sample.target["keypoints"], sample.target["boxes"][:, None]
        known = points[..., 2] > 0
        within = ((points[..., :2] >= corners[..., :2]) & (points[..., :2] <= corners[..., 2:])).all(dim=-1)
        inside += int((known & within).sum())
        labelled += int(known.sum())
    return inside / labelled if labelled else None
