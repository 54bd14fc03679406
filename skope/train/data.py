"""Training samples: images and targets as torchvision's detectors want them, flips included.

What happens to an image depends on (seed, epoch, image id) alone, so neither the number of workers nor an interruption
changes anything.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch.utils.data import DataLoader
from torch.utils.data import Dataset as TorchDataset

from skope import boxes as boxes_module
from skope import keypoints
from skope.dataset import Dataset
from skope.errors import UserError
from skope.schema import Annotation, AnnotationFile, Image
from skope.train import assign

SPLIT = "train"

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Vehicles:
    """What is annotated in one image."""

    boxes_xyxy: Array
    """(N, 4) ground truth."""
    keypoints: Array
    """(N, 33, 3) x, y, v of the ground truth; v = 0 (then x = y = 0) is not learnt."""
    ignored_xyxy: Array
    """(M, 4) ignored vehicles."""

    def flipped(self, width: float) -> "Vehicles":
        """As in the mirrored image: x becomes width - x, and right and left change names."""
        points = self.keypoints[:, keypoints.FLIP].copy()
        points[..., 0] = np.where(points[..., 2] > 0, width - points[..., 0], 0.0)
        return Vehicles(_mirror(self.boxes_xyxy, width), points, _mirror(self.ignored_xyxy, width))


@dataclass(frozen=True)
class Sample:
    """One image on its way into the network."""

    name: str
    pixels: torch.Tensor
    """(3, H, W) uint8 sRGB."""
    target: dict[str, torch.Tensor]
    """boxes (N, 4) float32 xyxy, labels (N,) int64, keypoints (N, 33, 3) float32, ignored_boxes (M, 4) float32."""

    def to(self, device: torch.device) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
        """Pixels as (3, H, W) float32 0..1 and target, on `device`."""
        return self.pixels.to(device).float() / 255, {key: value.to(device) for key, value in self.target.items()}


def _mirror(boxes_xyxy: Array, width: float) -> Array:
    return np.stack(
        [width - boxes_xyxy[:, 2], boxes_xyxy[:, 1], width - boxes_xyxy[:, 0], boxes_xyxy[:, 3]], axis=1
    ).reshape(-1, 4)


def vehicles_of(image: Image, annotations: Sequence[Annotation], supervise: str) -> Vehicles:
    """Ground truth and ignored vehicles; boxes without area inside the image are left out."""
    corners = boxes_module.xywh_to_xyxy(np.array([a.bbox for a in annotations]).reshape(-1, 4))
    corners = boxes_module.clip(corners, image.width, image.height)
    solid = (corners[:, 2:] > corners[:, :2]).all(axis=1)
    ignored = np.array([a.ignored for a in annotations], dtype=bool)
    points = np.array([a.keypoints for a in annotations]).reshape(-1, keypoints.K, 3)
    points = np.where(points[..., 2:] >= (2 if supervise == "visible" else 1), points, 0.0)
    return Vehicles(corners[solid & ~ignored], points[solid & ~ignored], corners[solid & ignored])


class TrainingSet(TorchDataset[Sample | UserError]):
    """Images of split `train` with their vehicles; an index is a pair (epoch, position)."""

    def __init__(
        self,
        dataset: Dataset,
        *,
        seed: int,
        flip_probability: float,
        supervise: str = "visible",
        max_images: int | None = None,
    ) -> None:
        file = dataset.read(SPLIT)
        self._dataset, self._seed, self._flip_probability = dataset, seed, flip_probability
        by_image = file.by_image()
        self._vehicles = {image.id: vehicles_of(image, by_image[image.id], supervise) for image in file.images}
        self.images = self._spread(file, max_images)
        self._check(dataset)

    def _spread(self, file: AnnotationFile, max_images: int | None) -> tuple[Image, ...]:
        if max_images is None:
            return file.images
        useful = [image for image in file.images if len(self._vehicles[image.id].boxes_xyxy)]
        count = min(max_images, len(useful))
        return tuple(useful[i * len(useful) // count] for i in range(count))

    def _check(self, dataset: Dataset) -> None:
        path = dataset.root / "annotations" / f"{SPLIT}.json"
        if not self._vehicles:
            raise UserError(f"{path}: field images is empty: nothing to train on")
        if not self.vehicles:
            raise UserError(f"{path}: field annotations holds no vehicle that is not ignored: nothing to train on")
        if not any((self._vehicles[image.id].keypoints[..., 2] > 0).any() for image in self.images):
            raise UserError(f"{path}: field keypoints: no visible point (v = 2) in any annotation")

    @property
    def vehicles(self) -> int:
        """Number of vehicles to learn from, ignored ones not counted."""
        return sum(len(self._vehicles[image.id].boxes_xyxy) for image in self.images)

    def __len__(self) -> int:
        return len(self.images)

    def __getitem__(self, index: tuple[int, int]) -> Sample | UserError:
        """The sample, or the mistake in the user's files: raised in a worker, it would arrive inside a traceback."""
        epoch, position = index
        image = self.images[position]
        try:
            pixels = self._dataset.image(image)
        except UserError as error:
            return error
        vehicles = self._vehicles[image.id]
        if np.random.default_rng((self._seed, epoch, image.id)).random() < self._flip_probability:
            pixels, vehicles = pixels[:, ::-1], vehicles.flipped(image.width)
        return to_sample(image.file_name, pixels, vehicles)


def to_sample(name: str, pixels: NDArray[np.uint8], vehicles: Vehicles) -> Sample:
    """(H, W, 3) pixels and vehicles as tensors."""
    target = {
        "boxes": torch.as_tensor(vehicles.boxes_xyxy, dtype=torch.float32),
        "labels": torch.ones(len(vehicles.boxes_xyxy), dtype=torch.int64),
        "keypoints": torch.as_tensor(vehicles.keypoints, dtype=torch.float32),
        assign.KEY: torch.as_tensor(vehicles.ignored_xyxy, dtype=torch.float32),
    }
    return Sample(name, torch.as_tensor(np.ascontiguousarray(pixels.transpose(2, 0, 1))), target)


def batches(
    training_set: TrainingSet, epoch: int, *, seed: int, batch_size: int, workers: int
) -> Iterator[list[Sample]]:
    """All images once, in an order drawn from (seed, epoch)."""
    order = np.random.default_rng((seed, epoch)).permutation(len(training_set)).tolist()
    indices = [[(epoch, i) for i in order[start : start + batch_size]] for start in range(0, len(order), batch_size)]
    loader = DataLoader(training_set, batch_sampler=indices, num_workers=workers, collate_fn=list)
    for batch in loader:
        for item in batch:
            if isinstance(item, UserError):
                raise item
        yield batch


def share_inside(samples: Sequence[Sample]) -> float | None:
    """Share of the labelled keypoints that lie inside their vehicle's box; None without a labelled keypoint."""
    inside = labelled = 0
    for sample in samples:
        points, corners = sample.target["keypoints"], sample.target["boxes"][:, None]
        known = points[..., 2] > 0
        within = ((points[..., :2] >= corners[..., :2]) & (points[..., :2] <= corners[..., 2:])).all(dim=-1)
        inside += int((known & within).sum())
        labelled += int(known.sum())
    return inside / labelled if labelled else None
