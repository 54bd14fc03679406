"""Training samples: flips, what is supervised, what is ignored, and what is refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from skope import coco, keypoints
from skope.dataset import open_dataset
from skope.errors import UserError
from skope.schema import Annotation, AnnotationFile, Image
from skope.train import data
from skope.train.data import TrainingSet, Vehicles
from tests import samples


def write(root: Path, images: list[Image], annotations: list[Annotation]) -> Path:
    samples.make_dataset(root, images=1, splits=("train",))
    file = AnnotationFile(images=tuple(images), annotations=tuple(annotations), name="train")
    coco.write(root / "annotations" / "train.json", file)
    for image in images:
        cv2.imwrite(str(root / image.file_name), np.zeros((image.height, image.width, 3), np.uint8))
    return root


def training_set(root: Path, **options: object) -> TrainingSet:
    return TrainingSet(open_dataset(root), **{"seed": 0, "flip_probability": 0.0, **options})


@pytest.mark.parametrize("k", range(keypoints.K))
def test_a_flip_moves_pixel_and_keypoint_together(k: int) -> None:
    width, height = 41, 23
    col, row = 3 + k, 5
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[row, col] = 255
    points = np.zeros((1, keypoints.K, 3))
    points[0, k] = [col + 0.5, row + 0.5, 2]
    vehicles = Vehicles(np.array([[col, row, col + 4.0, row + 6.0]]), points, np.array([[1.0, 2.0, 5.0, 9.0]]))

    flipped = vehicles.flipped(width)
    lit_row, lit_col = np.argwhere(pixels[:, ::-1, 0])[0]
    partner = keypoints.FLIP[k]
    assert flipped.keypoints[0, partner].tolist() == [lit_col + 0.5, lit_row + 0.5, 2]
    assert not np.delete(flipped.keypoints[0], partner, axis=0).any()
    assert flipped.boxes_xyxy.tolist() == [[width - col - 4.0, row, width - col, row + 6.0]]
    assert flipped.ignored_xyxy.tolist() == [[width - 5.0, 2.0, width - 1.0, 9.0]]
    back = flipped.flipped(width)
    assert np.array_equal(back.keypoints, points)
    assert np.array_equal(back.boxes_xyxy, vehicles.boxes_xyxy)


def test_targets(tmp_path: Path) -> None:
    boxes = [(10, 20, 60, 40), (80, 20, 60, 40), (100, 70, 30, 30)]
    vehicles = [
        samples.make_annotation(1, 1, boxes[0], hidden=3),
        samples.make_annotation(2, 1, boxes[1], iscrowd=1),
        samples.make_annotation(3, 1, (20, 20, 0, 10)),
        samples.make_annotation(4, 1, boxes[2]),
    ]
    root = write(tmp_path, [samples.make_image(1), samples.make_image(2)], vehicles)
    sample = training_set(root)[0, 0]
    assert isinstance(sample, data.Sample)
    assert sample.target["boxes"].tolist() == [[10, 20, 70, 60], [100, 70, 130, 100]]
    assert sample.target["ignored_boxes"].tolist() == [[80, 20, 140, 60]]
    assert sample.target["labels"].tolist() == [1, 1]
    assert sample.target["keypoints"].shape == (2, keypoints.K, 3)
    assert sample.pixels.shape == (3, 120, 160)
    assert not sample.target["keypoints"][0, -3:].any(), "hidden points are not learnt"
    everything = training_set(root, supervise="all")[0, 0]
    assert isinstance(everything, data.Sample)
    assert (everything.target["keypoints"][0, -3:, 2] == 1).all()
    empty = training_set(root)[0, 1]
    assert isinstance(empty, data.Sample)
    assert empty.target["boxes"].shape == (0, 4)
    assert empty.target["keypoints"].shape == (0, keypoints.K, 3)


def test_flips_depend_on_seed_epoch_and_image_alone(tmp_path: Path) -> None:
    root = samples.make_dataset(tmp_path, images=8, splits=("train",))

    def seen(seed: int, epoch: int, workers: int = 0) -> list[tuple[str, torch.Tensor]]:
        images = training_set(root, seed=seed, flip_probability=0.5)
        batches = data.batches(images, epoch, seed=seed, batch_size=3, workers=workers)
        return [(sample.name, sample.target["boxes"]) for batch in batches for sample in batch]

    def equal(a: list[tuple[str, torch.Tensor]], b: list[tuple[str, torch.Tensor]]) -> bool:
        return all(x[0] == y[0] and torch.equal(x[1], y[1]) for x, y in zip(a, b, strict=True))

    assert equal(seen(0, 0), seen(0, 0, workers=2))
    assert not equal(seen(0, 0), seen(0, 1))
    assert not equal(seen(0, 0), seen(1, 0))
    assert len({name for name, _ in seen(0, 0)}) == 8


def test_max_images_takes_images_with_vehicles_evenly_spread(tmp_path: Path) -> None:
    images = [samples.make_image(i) for i in range(1, 11)]
    vehicles = [samples.make_annotation(i, i, (10, 20, 60, 40), iscrowd=int(i == 3)) for i in range(2, 11)]
    root = write(tmp_path, images, vehicles)
    assert [image.id for image in training_set(root, max_images=4).images] == [2, 5, 7, 9]
    assert len(training_set(root, max_images=99)) == 8
    assert len(training_set(root)) == 10


def test_nothing_to_train_on_is_one_line(tmp_path: Path) -> None:
    image = samples.make_image(1)
    hidden = samples.make_annotation(1, 1, (10, 20, 60, 40), hidden=keypoints.K)
    ignored = samples.make_annotation(1, 1, (10, 20, 60, 40), iscrowd=1)
    for name, images, vehicles, words in [
        ("a", [], [], "field images is empty"),
        ("b", [image], [], "field annotations"),
        ("c", [image], [ignored], "field annotations"),
        ("d", [image], [hidden], "field keypoints"),
    ]:
        root = write(tmp_path / name, images, vehicles)
        with pytest.raises(UserError, match=f"train.json: {words}"):
            training_set(root)
    samples.make_dataset(tmp_path / "e", splits=("easy",))
    with pytest.raises(UserError, match="no split 'train'; there are: easy"):
        training_set(tmp_path / "e")


@pytest.mark.parametrize("workers", [0, 2])
def test_a_broken_image_is_one_line_from_any_worker(tmp_path: Path, workers: int) -> None:
    root = samples.make_dataset(tmp_path, images=3, splits=("train",))
    images = training_set(root)
    broken = root / images.images[1].file_name
    broken.write_bytes(broken.read_bytes()[:40])
    with pytest.raises(UserError, match=rf"{broken.name}: not an image") as caught:
        list(data.batches(images, 0, seed=0, batch_size=1, workers=workers))
    assert "\n" not in str(caught.value)


def test_share_of_keypoints_inside_their_box() -> None:
    points = np.zeros((1, keypoints.K, 3))
    points[0, :4] = [[5, 5, 2], [10, 10, 2], [30, 5, 2], [5, 30, 2]]
    sample = data.to_sample(
        "a", np.zeros((40, 40, 3), np.uint8), Vehicles(np.array([[0, 0, 10.0, 10]]), points, np.zeros((0, 4)))
    )
    assert data.share_inside([sample]) == 0.5
    assert data.share_inside([]) is None
