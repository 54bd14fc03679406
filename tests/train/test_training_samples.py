"""Training samples: their order, what is supervised, what is ignored, and what is refused."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch

from skope import keypoints
from skope.dataset import coco
from skope.errors import UserError
from skope.schema import Annotation, AnnotationFile, Image
from skope.terminal.console import Console
from skope.train import splits, training_samples
from skope.train.augment import Augment
from skope.train.sample_loader import Loader
from skope.train.splits import TrainingSource
from skope.train.targets import Vehicles
from skope.train.training_samples import Draw, TrainingSample, TrainingSet
from tests import samples
from tests.waiting import HANG_S


def write(root: Path, images: list[Image], annotations: list[Annotation]) -> Path:
    samples.make_dataset(root, images=1, splits=("train",))
    file = AnnotationFile(images=tuple(images), annotations=tuple(annotations), name="train")
    coco.write(root / "annotations" / "train.json", file)
    for image in images:
        cv2.imwrite(str(root / image.file_name), np.zeros((image.height, image.width, 3), np.uint8))
    return root


def source(root: Path, **options: Any) -> TrainingSource:
    return splits.read(root, **{"exclude_types": (), "val_fraction": 0.0, "max_images": None, **options})


def training_set(*roots: Path, seed: int = 0, flip: float = 0.0, supervise: str = "visible") -> TrainingSet:
    return TrainingSet([source(root) for root in roots], seed=seed, augment=Augment(flip=flip), supervise=supervise)


def loaded(images: TrainingSet, groups: list[list[Draw]], workers: int) -> list[list[TrainingSample]]:
    return list(Loader(images, workers=workers, console=Console(quiet=True)).batches(groups, max(map(len, groups))))


def test_targets(tmp_path: Path) -> None:
    boxes = [(10, 20, 60, 40), (80, 20, 60, 40), (100, 70, 30, 30)]
    vehicles = [
        samples.make_annotation(1, 1, boxes[0], hidden=3),
        samples.make_annotation(2, 1, boxes[1], iscrowd=1),
        samples.make_annotation(3, 1, (20, 20, 0, 10)),
        samples.make_annotation(4, 1, boxes[2]),
    ]
    root = write(tmp_path, [samples.make_image(1), samples.make_image(2)], vehicles)
    sample = training_set(root)[0, 0, 0]
    assert isinstance(sample, TrainingSample)
    assert sample.target["boxes"].tolist() == [[10, 20, 70, 60], [100, 70, 130, 100]]
    assert sample.target["ignored_boxes"].tolist() == [[80, 20, 140, 60]]
    assert sample.target["labels"].tolist() == [1, 1]
    assert sample.target["keypoints"].shape == (2, keypoints.K, 3)
    assert sample.pixels.shape == (3, 120, 160)
    assert not sample.target["keypoints"][0, -3:].any(), "hidden points are not learnt"
    everything = training_set(root, supervise="all")[0, 0, 0]
    assert isinstance(everything, TrainingSample)
    assert (everything.target["keypoints"][0, -3:, 2] == 1).all()
    empty = training_set(root)[0, 1, 0]
    assert isinstance(empty, TrainingSample)
    assert empty.target["boxes"].shape == (0, 4)
    assert empty.target["keypoints"].shape == (0, keypoints.K, 3)


def test_changes_depend_on_seed_epoch_and_image_alone(tmp_path: Path) -> None:
    root = samples.make_dataset(tmp_path, images=8, splits=("train",))

    def seen(seed: int, epoch: int, workers: int = 0) -> list[tuple[str, torch.Tensor]]:
        images = training_set(root, seed=seed, flip=0.5)
        draws = training_samples.order(images.sizes, None, seed=seed, epoch=epoch)
        batches = loaded(images, [draws[:3], draws[3:]], workers)
        return [(sample.name, sample.target["boxes"]) for batch in batches for sample in batch]

    def equal(a: list[tuple[str, torch.Tensor]], b: list[tuple[str, torch.Tensor]]) -> bool:
        return all(x[0] == y[0] and torch.equal(x[1], y[1]) for x, y in zip(a, b, strict=True))

    assert equal(seen(0, 0), seen(0, 0, workers=2))
    assert not equal(seen(0, 0), seen(0, 1))
    assert not equal(seen(0, 0), seen(1, 0))
    assert len({name for name, _ in seen(0, 0)}) == 8


@pytest.mark.parametrize(("sizes", "mix", "counts"), [((4, 12), 0.5, (8, 8)), ((10, 30, 60), 0.4, (40, 20, 40))])
def test_a_mix_gives_each_dataset_its_share(sizes: tuple[int, ...], mix: float, counts: tuple[int, ...]) -> None:
    draws = training_samples.order(sizes, mix, seed=0, epoch=3)
    assert len(set(draws)) == len(draws) == sum(sizes), "no image is drawn twice alike"
    ends = np.cumsum([0, *sizes])
    for low, high, count in zip(ends[:-1], ends[1:], counts, strict=True):
        own = np.bincount([position - low for _, position, _ in draws if low <= position < high])
        assert own.sum() == count
        assert own.max() == -(-count // (high - low)), "all come before one comes again"
    assert {epoch for epoch, _, _ in draws} == {3}
    assert draws != training_samples.order(sizes, mix, seed=0, epoch=4)
    assert sorted(training_samples.order(sizes, None, seed=0, epoch=0)) == [(0, i, 0) for i in range(sum(sizes))]


def test_repeated_images_are_changed_anew(tmp_path: Path) -> None:
    root = samples.make_dataset(tmp_path, images=1, splits=("train",))
    images = training_set(root, flip=0.5)
    boxes = [images[0, 0, repeat].target["boxes"] for repeat in range(16)]  # type: ignore[union-attr]
    assert 0 < sum(torch.equal(boxes[0], other) for other in boxes) < 16


def test_datasets_may_share_image_ids(tmp_path: Path) -> None:
    roots = [samples.make_dataset(tmp_path / name, images=2, splits=("train",), seed=i) for i, name in enumerate("ab")]
    images = training_set(*roots)
    assert images.sizes == (2, 2)
    assert not torch.equal(images[0, 0, 0].pixels, images[0, 2, 0].pixels)  # type: ignore[union-attr]


def test_another_scheme_is_refused(tmp_path: Path) -> None:
    root = samples.make_dataset(tmp_path, splits=("train",))
    card = root / "dataset.json"
    card.write_text(card.read_text().replace(keypoints.SCHEME, "coco17"))
    with pytest.raises(UserError, match=r"dataset.json: keypoint_scheme: 'coco17' is not one of skope33, skope3d"):
        source(root)


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
    # With hidden points among those to learn, the last is something to train on.
    assert len(training_set(root, supervise="all")) == 1
    samples.make_dataset(tmp_path / "e", splits=("easy",))
    with pytest.raises(UserError, match="no split 'train'; there are: easy"):
        training_set(tmp_path / "e")


@pytest.mark.parametrize("workers", [0, 2])
def test_a_broken_image_is_one_line_from_any_worker(tmp_path: Path, workers: int) -> None:
    root = samples.make_dataset(tmp_path, images=3, splits=("train",))
    images = training_set(root)
    broken = root / source(root).learnt.images[1].file_name
    broken.write_bytes(broken.read_bytes()[:40])
    with pytest.raises(UserError, match=rf"{broken.name}: not an image") as caught:
        loaded(images, [[(0, i, 0)] for i in range(3)], workers)
    assert "\n" not in str(caught.value)


def test_loading_begins_after_this_process_has_used_opencvs_threads(tmp_path: Path) -> None:
    """Which a loading process, a fork, does not have: whoever waits for them there waits for ever."""
    samples.make_dataset(tmp_path / "data", images=2, splits=("train",))
    code = (
        "import cv2, numpy as np; from pathlib import Path\n"
        "from tests.train.test_training_samples import loaded, training_set\n"
        "cv2.setNumThreads(4); cv2.GaussianBlur(np.zeros((3000, 3000, 3), np.uint8), (0, 0), 5)\n"
        "images = training_set(Path('data'))\n"
        "print(sum(map(len, loaded(images, [[(0, 0, 0)], [(0, 1, 0)]], 2))))"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[2])}
    done = subprocess.run(
        [sys.executable, "-c", code],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HANG_S,
        check=False,
    )
    assert done.stdout == "2\n", done.stderr


def test_share_of_keypoints_inside_their_box() -> None:
    points = np.zeros((1, keypoints.K, 3))
    points[0, :4] = [[5, 5, 2], [10, 10, 2], [30, 5, 2], [5, 30, 2]]
    vehicles = Vehicles(np.array([[0, 0, 10.0, 10]]), points, np.zeros((0, 4)))
    sample = training_samples.to_sample("a", np.zeros((40, 40, 3), np.uint8), vehicles, "visible")
    assert training_samples.mean_share_inside([sample]) == 0.5
    assert training_samples.mean_share_inside([]) is None
