"""Training end to end: it learns, it stops where it must, and it resumes to the same bits."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from skope import boxes, coco, detector
from skope.console import Console
from skope.dataset import open_dataset
from skope.errors import UserError
from skope.schema import Annotation
from skope.train import loop, plan, run
from skope.train.recipe import RECIPES, Recipe
from skope.train.run import RunConfig
from tests import samples

CPU = torch.device("cpu")
SMALL = replace(
    RECIPES["scratch"], min_size=128, max_size=256, regions=64, keypoint_regions=4, bfloat16=plan.multiplies_bfloat16()
)
TINY = replace(RECIPES["scratch"], min_size=64, max_size=96, regions=8, keypoint_regions=1, epochs=2, step_size=1)


def train(data: Path, out: Path, recipe: Recipe, **options: Any) -> Path:
    config = RunConfig(recipe=recipe, init="random", seed=0, data=str(data), max_images=None)
    defaults = {"device": CPU, "workers": 0, "resume": False, "console": Console(quiet=True)}
    return loop.train(config, out, **{**defaults, **options})


def pck(found: detector.Detections, vehicles: list[Annotation], score: float = 0.9, iou: float = 0.6) -> float:
    """Share of all labelled keypoints that the best detection on their vehicle puts within a tenth of its size."""
    correct = labelled = 0
    sure = found.scores > score
    for vehicle in vehicles:
        visible = vehicle.keypoints[:, 2] == 2
        labelled += int(visible.sum())
        overlaps = boxes.iou(boxes.xywh_to_xyxy(vehicle.bbox), found.boxes_xyxy[sure])[0]
        if len(overlaps) and overlaps.max() >= iou:
            points = found.keypoints[sure][overlaps.argmax()]
            distances = np.hypot(*(points[:, :2] - vehicle.keypoints[:, :2]).T)
            correct += int((distances[visible] <= 0.1 * vehicle.bbox[2:].max()).sum())
    return correct / labelled


def scores_on_its_images(data: Path, checkpoint: Path) -> list[float]:
    model, _, _ = detector.load_weights(checkpoint, CPU)
    dataset = open_dataset(data)
    file = dataset.read("train")
    vehicles = file.by_image()
    return [pck(detector.detect(model, [dataset.image(image)], CPU)[0], vehicles[image.id]) for image in file.images]


def test_overfits_one_image_from_random_weights(tmp_path: Path) -> None:
    """Targets, network and decoded coordinates agree from end to end."""
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    recipe = replace(SMALL, epochs=60, flip_probability=0.0, warmup_steps=10)
    checkpoint = train(data, tmp_path / "run", recipe)
    assert scores_on_its_images(data, checkpoint)[0] > 0.9


@pytest.mark.slow
def test_overfits_four_images_with_flips(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=4, splits=("train",))
    checkpoint = train(data, tmp_path / "run", replace(SMALL, epochs=60))
    assert np.mean(scores_on_its_images(data, checkpoint)) > 0.9


@pytest.fixture
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class _Killer:
    """A step that stops the run when it is taken for the n-th time."""

    def __init__(self, n: int, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left, self.step = n, loop._step
        monkeypatch.setattr(loop, "_step", self)

    def __call__(self, *args: Any, **kwargs: Any) -> dict[str, float]:
        self.left -= 1
        if not self.left:
            raise KeyboardInterrupt
        return self.step(*args, **kwargs)


@pytest.mark.usefixtures("one_thread")
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = samples.make_dataset(tmp_path / "data", images=2, splits=("train",))
    whole, halves = tmp_path / "whole", tmp_path / "halves"
    state = torch.get_rng_state()
    last = train(data, whole, TINY)
    assert torch.equal(state, torch.get_rng_state())

    with monkeypatch.context() as patch:
        _Killer(4, patch)  # in the second epoch's second step
        with pytest.raises(KeyboardInterrupt):
            train(data, halves, TINY, save_interval_s=0)
    assert detector.find_checkpoint(halves).name == "epoch_001.safetensors"
    torch.manual_seed(123)  # where the state that torch starts with must not matter
    resumed = train(data, halves, TINY, resume=True)

    expected, got = load_file(last), load_file(resumed)
    assert expected.keys() == got.keys()
    assert all(torch.equal(expected[name], got[name]) for name in expected)
    assert (whole / "metrics.jsonl").read_text() == (halves / "metrics.jsonl").read_text()
    names = ["epoch_002.safetensors", "metrics.jsonl", "recipe.json", "resume.pt"]
    assert sorted(path.name for path in halves.iterdir()) == names
    _, _, metadata = detector.load_weights(resumed, CPU)
    assert metadata["epoch"] == 2
    assert metadata["run"]["recipe"] == TINY.to_dict()
    assert metadata["origin"] == "random weights"


def test_a_folder_with_a_run_is_not_overwritten(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "epoch_001.safetensors").touch()
    with pytest.raises(UserError, match=r"holds a run already; go on with it by --resume, or .* --out"):
        train(data, tmp_path / "run", TINY)
    with pytest.raises(UserError, match="no finished epoch to resume from"):
        train(data, tmp_path / "run", TINY, resume=True)
    (tmp_path / "run" / "resume.pt").write_bytes(b"junk")
    with pytest.raises(UserError, match=r"resume.pt: cannot be read"):
        train(data, tmp_path / "run", TINY, resume=True)


def test_older_checkpoints_go_only_after_the_pair_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Killed between checkpoint and resume.pt, a run still resumes from the epoch before."""
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))

    def kill(*_: Any) -> None:
        raise KeyboardInterrupt

    train(data, tmp_path / "run", replace(TINY, epochs=1))
    with monkeypatch.context() as patch:
        patch.setattr(torch, "save", kill)
        with pytest.raises(KeyboardInterrupt):
            train(data, tmp_path / "run", TINY, resume=True)
    assert list(detector.checkpoints(tmp_path / "run")) == [1, 2]
    last = train(data, tmp_path / "run", TINY, resume=True)
    assert list(detector.checkpoints(tmp_path / "run")) == [2]
    assert last.name == "epoch_002.safetensors"
    with pytest.raises(UserError, match=r"--epochs 1: the run in .* has 2 epochs behind it"):
        train(data, tmp_path / "run", replace(TINY, epochs=1), resume=True)
    assert len((tmp_path / "run" / "metrics.jsonl").read_text().splitlines()) == 2


def move_boxes(data: Path, moved: int) -> None:
    """Put the boxes of the first `moved` vehicles where none of their keypoints is."""
    path = data / "annotations" / "train.json"
    file = coco.read(path)
    vehicles = tuple(
        replace(vehicle, bbox=np.array([0.0, 0.0, 5.0, 5.0])) if i < moved else vehicle
        for i, vehicle in enumerate(file.annotations)
    )
    coco.write(path, replace(file, annotations=vehicles))


def test_keypoints_outside_their_boxes_stop_or_warn(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    move_boxes(data, 1)
    train(data, tmp_path / "half", replace(TINY, epochs=1), console=Console())
    said = capsys.readouterr().out
    assert "only 50% of the labelled keypoints lie inside" in said
    assert "float32; random weights; seed 0; on cpu, 0 extra processes" in said
    move_boxes(data, 2)
    with pytest.raises(UserError, match=r"00_000001.png: no labelled keypoint lies inside its vehicle's bbox"):
        train(data, tmp_path / "none", TINY)


def test_a_loss_that_is_not_finite_names_the_images(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    wild = replace(TINY, learning_rate=1e12, warmup_steps=0, gradient_clip=None, epochs=9)
    with pytest.raises(UserError, match=r"epoch \d: the loss is no longer a finite number, at images/site/00_000001"):
        train(data, tmp_path / "run", wild)
    assert not run.resumable(tmp_path / "run")
