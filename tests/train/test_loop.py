"""Runs: what they leave, that they stop where it must, and it resumes to the same bits."""

import json
import os
import shutil
import signal
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from skope.dataset import coco
from skope.dataset.folder import read_image
from skope.detector.checkpoint import BEST_WEIGHTS, checkpoints, load_weights
from skope.errors import UserError
from skope.terminal.console import Console
from skope.train import loop, run_folder, step, training_state
from skope.train.augment import AUGMENT_STEPS, Augment
from skope.train.loop import CheckpointPolicy
from skope.train.recipe import SHIPPED_RECIPES, Recipe
from skope.train.run_config import RunConfig
from tests import samples

pytestmark = pytest.mark.usefixtures("small_network")

CPU = torch.device("cpu")
TINY = replace(
    SHIPPED_RECIPES["scratch"], min_size=64, max_size=96, regions=8, keypoint_regions=1, epochs=2, step_size=1
)
TINY = replace(TINY, val_fraction=0.0)


def train(data: Path, out: Path, recipe: Recipe, **options: Any) -> Path:
    config = RunConfig(recipe=recipe, seed=0, data=(str(data),), mix=None, max_images=None)
    defaults = {
        "device": CPU,
        "workers": 0,
        "resume": False,
        "console": Console(quiet=True),
        "saving": CheckpointPolicy(),
    }
    return loop.train(config, out, **{**defaults, **options})


@pytest.fixture
def one_thread() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


class _Signal:
    """A step after which this process is sent a signal, when it is taken for the n-th time."""

    def __init__(self, n: int, number: signal.Signals, monkeypatch: pytest.MonkeyPatch) -> None:
        self.left, self.number, self.take = n, number, step.train_on_batch
        monkeypatch.setattr(step, "train_on_batch", self)

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        self.left -= 1
        done = self.take(*args, **{**kwargs, "votes": (float(not self.left), 0.0)})
        if not self.left:
            os.kill(os.getpid(), self.number)
        return done


def same_files(one: Path, other: Path) -> bool:
    expected, got = load_file(one), load_file(other)
    return expected.keys() == got.keys() and all(torch.equal(expected[name], got[name]) for name in expected)


@pytest.mark.parametrize("resume", [False, True])
def test_a_folder_is_trained_in_by_one_process(tmp_path: Path, *, resume: bool) -> None:
    data, out = samples.make_dataset(tmp_path / "data", images=1, splits=("train",)), tmp_path / "run"
    with run_folder.exclusive(out):
        assert out.is_dir()
        with pytest.raises(UserError, match="run: another `skope train` is writing to this folder"):
            train(data, out, TINY, resume=resume)
        assert [path.name for path in out.iterdir()] == [".lock"]
    assert not out.exists()


@pytest.mark.usefixtures("one_thread")
def test_a_resumed_run_equals_an_uninterrupted_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Whatever the step it is stopped at, in whatever way, and with every augmentation."""
    before = signal.getsignal(signal.SIGINT)
    data = samples.make_dataset(tmp_path / "data", images=5, splits=("train",))
    often = Augment(**dict.fromkeys(AUGMENT_STEPS, 0.5))
    recipe = replace(TINY, batch_size=2, augment=often, ema_decay=0.6, cosine_to=0.1)
    state = torch.get_rng_state()
    whole = tmp_path / "whole"
    last = train(data, whole, recipe)
    threads = set(threading.enumerate())
    assert torch.equal(state, torch.get_rng_state())

    steps = sorted(np.random.default_rng().choice(np.arange(1, 4), 2, replace=False).tolist())
    parts = tmp_path / "parts"
    for n, number in zip(np.diff([0, *steps]), (signal.SIGINT, signal.SIGTERM), strict=True):
        with monkeypatch.context() as patch:
            _Signal(n, number, patch)
            with pytest.raises(KeyboardInterrupt):
                train(data, parts, recipe, resume=training_state.resumable(parts))
        assert set(threading.enumerate()) <= threads, "TensorBoard's is closed"
        torch.manual_seed(123)  # where the state that torch starts with must not matter
    assert capfd.readouterr().err.count("skope: stopping after this step, to save it; once more stops at once") == 2
    resumed = train(data, parts, recipe, resume=True)

    assert same_files(last, resumed), steps
    assert (whole / "metrics.jsonl").read_text() == (parts / "metrics.jsonl").read_text(), steps
    assert signal.getsignal(signal.SIGINT) is before
    _, _, metadata = load_weights(resumed, CPU)
    assert metadata["epoch"] == 2
    assert Recipe.from_dict(metadata["run"]["recipe"]) == recipe
    assert metadata["origin"] == "random weights"


@pytest.mark.usefixtures("one_thread")
def test_a_run_killed_without_notice_goes_on_from_what_was_saved_last(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = samples.make_dataset(tmp_path / "data", images=3, splits=("train",))
    last = train(data, tmp_path / "whole", TINY)

    class Killed(BaseException):
        pass

    class Killer(_Signal):
        def __call__(self, *args: Any, **kwargs: Any) -> Any:
            self.left -= 1
            if not self.left:
                raise Killed
            return self.take(*args, **kwargs)

    often = CheckpointPolicy(state_interval_s=0, checkpoint_interval_s=0)
    with monkeypatch.context() as patch:
        Killer(5, signal.SIGINT, patch)
        with pytest.raises(Killed):
            train(data, tmp_path / "parts", TINY, saving=often)
    assert torch.load(tmp_path / "parts" / "resume.pt", weights_only=True)["steps_done"] == 1
    assert same_files(last, train(data, tmp_path / "parts", TINY, resume=True))


def test_the_mean_of_the_weights_is_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Against the mean taken here of the weights after each step."""
    data = samples.make_dataset(tmp_path / "data", images=3, splits=("train",))
    after, take = [], step.train_on_batch

    def learn(training: training_state.TrainingState, *args: Any, **kwargs: Any) -> Any:
        done = take(training, *args, **kwargs)
        after.append({name: value.clone() for name, value in training.model.state_dict().items()})
        return done

    monkeypatch.setattr(step, "train_on_batch", learn)
    last = train(data, tmp_path / "run", replace(TINY, ema_decay=0.2))
    assert len(after) == 6
    mean = after[0]
    for n, weights in enumerate(after[1:], start=1):
        keep = min(0.2, (1 + n) / (10 + n))
        mean = {name: keep * value + (1 - keep) * weights[name] for name, value in mean.items()}
    saved = load_file(last)
    for name in ("backbone.body.conv1.weight", "backbone.body.bn1.running_mean", "rpn.head.bbox_pred.bias"):
        torch.testing.assert_close(saved[name], mean[name])
        assert not torch.allclose(saved[name], after[-1][name], rtol=1e-5, atol=1e-8)


def test_what_a_run_leaves(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=4, splits=("train",))
    out = tmp_path / "run"
    saving = CheckpointPolicy(keep=2, checkpoint_interval_s=0)
    train(data, out, replace(TINY, epochs=3, val_fraction=0.25), saving=saving)
    assert list(checkpoints(out)) == [2, 3]
    files = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    board = {name for name in files if name.startswith("tensorboard/")}
    assert files - board == {
        *("epoch_002.safetensors", "epoch_003.safetensors", "best.safetensors", "resume.pt", "recipe.json"),
        *("metrics.jsonl", "README.md", "curves.png"),
        *(f"progress/epoch_00{epoch}.jpg" for epoch in (1, 2, 3)),
    }
    rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
    assert [row["epoch"] for row in rows] == [1, 2, 3]
    assert {*step.LOSS_NAMES, "loss", "epoch", "validation"} == set(rows[0])
    assert rows[0]["loss"] == pytest.approx(sum(rows[0][name] for name in step.LOSS_NAMES), rel=1e-5)
    assert rows[0]["validation"]["images"] == 1
    card = (out / "README.md").read_text()
    for words in (
        "nothing but the seed",
        "| 2 | 4 | visible |",
        "weight_decay = 0.0001",
        "On 1 image with 2 vehicles",
    ):
        assert words in card
    sheet = read_image(out / "progress" / "epoch_003.jpg")
    assert sheet.shape[1] >= 2 * 160
    assert sheet.std() > 10
    curves = read_image(out / "curves.png")
    assert curves.shape[1] == 1000
    assert len(np.unique(curves.reshape(-1, 3), axis=0)) > 50


def test_images_without_vehicles_validate_nothing(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=4, splits=("train",))
    path = data / "annotations" / "train.json"
    file = coco.read(path)
    last = file.images[-1].id
    coco.write(path, replace(file, annotations=tuple(a for a in file.annotations if a.image_id != last)))
    train(data, tmp_path / "run", replace(TINY, epochs=1, val_fraction=0.25))
    assert "validation" not in json.loads((tmp_path / "run" / "metrics.jsonl").read_text())
    assert not (tmp_path / "run" / "best.safetensors").exists()


def test_a_folder_with_a_run_is_not_overwritten(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "epoch_001.safetensors").touch()
    with pytest.raises(UserError, match=r"holds checkpoints but no state to resume from .* --out"):
        train(data, tmp_path / "run", TINY)
    with pytest.raises(UserError, match="nothing saved yet to resume from"):
        train(data, tmp_path / "run", TINY, resume=True)
    (tmp_path / "run" / "resume.pt").write_bytes(b"junk")
    with pytest.raises(UserError, match=r"resume.pt: cannot be read"):
        train(data, tmp_path / "run", TINY, resume=True)


def test_a_changed_dataset_is_noticed(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=2, splits=("train",))
    train(data, tmp_path / "run", replace(TINY, epochs=1))
    moved = data.rename(tmp_path / "elsewhere")
    train(moved, tmp_path / "run", TINY, resume=True)
    with pytest.raises(UserError, match=r"--epochs 1: the run in .* has 2 epochs behind it"):
        train(moved, tmp_path / "run", replace(TINY, epochs=1), resume=True)
    image = next((moved / "images").rglob("*.png"))
    image.write_bytes(image.read_bytes() + b"0")
    with pytest.raises(UserError, match=r"elsewhere: is not the dataset that the run in .* began with"):
        train(moved, tmp_path / "run", TINY, resume=True)
    image.write_bytes(image.read_bytes()[:-1])
    train(moved, tmp_path / "run", TINY, resume=True)
    move_boxes(moved, 1)
    with pytest.raises(UserError, match=r"elsewhere: is not the dataset"):
        train(moved, tmp_path / "run", TINY, resume=True)


def test_an_unwritable_run_folder_is_one_line(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=r"file/run: cannot be written: .*/file is a file"):
        train(data, tmp_path / "file" / "run", TINY)


def test_too_little_memory_says_what_to_lower(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    for error in (
        torch.OutOfMemoryError("CUDA out of memory"),
        RuntimeError("DefaultCPUAllocator: can't allocate memory"),
    ):

        def fail(*_: Any, error: Exception = error, **__: Any) -> None:
            raise error

        monkeypatch.setattr(step, "train_on_batch", fail)
        with pytest.raises(
            UserError, match=r"out of memory at 1 images at once, short side 64, 1 keypoint regions: lower"
        ):
            train(data, tmp_path / "run", TINY)


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
    assert "float32; random weights; seed 0; on cpu x 1, 0 extra processes" in said
    move_boxes(data, 2)
    with pytest.raises(UserError, match=r"00_000001.png: no labelled keypoint lies inside its vehicle's bbox"):
        train(data, tmp_path / "none", TINY)


def test_a_loss_that_is_not_finite_names_the_images(tmp_path: Path) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    wild = replace(TINY, learning_rate=1e12, warmup_steps=0, gradient_clip=None, epochs=9)
    with pytest.raises(UserError, match=r"epoch \d: the loss is no longer a finite number, at images/site/00_000001"):
        train(data, tmp_path / "run", wild)
    assert not training_state.resumable(tmp_path / "run")


@pytest.mark.slow
def test_room_is_asked_for_before_the_first_epoch(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    data = samples.make_dataset(tmp_path / "data", images=1, splits=("train",))
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(run_folder.shutil, "disk_usage", lambda _: usage._replace(free=1000))
    with pytest.raises(
        UserError, match=r"run: 0 MB free on its disk, and this run writes up to \d+ MB there; make room"
    ):
        train(data, tmp_path / "run", TINY)
    assert not (tmp_path / "run").exists()
    monkeypatch.undo()
    run = train(data, tmp_path / "run", replace(TINY, epochs=1)).parent
    used = sum(path.stat().st_size for path in run.iterdir() if path.is_file())
    # Of a run that is there, its own files count as room.
    monkeypatch.setattr(run_folder.shutil, "disk_usage", lambda _: usage._replace(free=2 * used))
    train(data, run, TINY, resume=True)


def test_where_the_best_cannot_be_written_the_epoch_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The state comes first; the run that goes on writes the best one that was not."""
    data = samples.make_dataset(tmp_path / "data", images=4, splits=("train",))
    recipe = replace(TINY, val_fraction=0.5, epochs=1)
    out, whole = tmp_path / "run", tmp_path / "whole"
    train(data, whole, recipe)

    def full(*_: object) -> None:
        raise UserError("best.safetensors: cannot be written: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(run_folder, "save_best", full)
        with pytest.raises(UserError, match="No space left"):
            train(data, out, recipe)
    assert not (out / BEST_WEIGHTS).exists()
    train(data, out, recipe, resume=True)
    assert same_files(out / BEST_WEIGHTS, whole / BEST_WEIGHTS)


def test_types_that_are_not_there_are_not_left_out_in_silence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    data = samples.make_dataset(tmp_path / "data", images=2, splits=("train",))
    recipe = replace(TINY, epochs=1, exclude_types=("bus", "truck"))
    train(data, tmp_path / "typed", recipe, console=Console())
    said = capsys.readouterr()
    assert ("0 vehicles left out by type (bus, truck)" in said.out, "warning" in said.err) == (True, False)
    path = data / "annotations" / "train.json"
    path.write_text(path.read_text().replace('"vehicle_type":"sedan",', ""))
    train(data, tmp_path / "untyped", recipe, console=Console())
    said = capsys.readouterr()
    assert "does not say the type of" in said.err
    assert "they are learnt, whether bus, truck or not" in said.err
