"""Several processes train one model as torchrun starts them (here two on the CPU, over gloo)."""

import json
import os
import socket
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from skope.detector.checkpoint import checkpoints
from skope.train import distributed, step
from skope.train.distributed import ProcessGroup
from skope.train.recipe import SHIPPED_RECIPES
from skope.train.training_samples import TrainingSample
from tests import samples
from tests.waiting import HANG_S

SMALL = ("min_size=64", "max_size=96", "regions=8", "keypoint_regions=1", "val_fraction=0.25")
RATES = 0.05
BATCHES = (5, 1, 4)
"""Images of each step; of one image a second process gets nothing."""


class Toy(torch.nn.Module):
    """Answers like a detector in training; its losses are means over images."""

    def __init__(self) -> None:
        super().__init__()
        self.weight = torch.nn.Parameter(torch.tensor([0.5, -0.2, 0.1]))
        self.register_buffer("running_mean", torch.zeros(3))

    def losses(
        self, pixels: list[torch.Tensor], targets: list[Any], rules: Any, teacher: None
    ) -> dict[str, torch.Tensor]:
        colors = torch.stack([image.float().mean(dim=(1, 2)) / 255 for image in pixels])
        self.running_mean += colors.detach().mean(dim=0)
        loss = ((colors @ self.weight - 1) ** 2).mean()
        return {name: loss * factor for factor, name in enumerate(step.LOSS_NAMES, start=1)}


def learn(out: str) -> None:
    """A few steps in this process, one of those that the environment names."""
    with distributed.process_group(torch.device("cpu")) as (processes, _), pytest.MonkeyPatch.context() as patch:
        patch.setattr(step, "detection_losses", Toy.losses)
        toy = Toy()
        optimizer = torch.optim.SGD(toy.parameters(), lr=RATES, momentum=0.9)
        training: Any = SimpleNamespace(model=toy, optimizer=optimizer, epochs_done=0, teacher=None)
        rng = np.random.default_rng(0)
        losses = []
        for count in BATCHES:
            images = rng.integers(0, 256, (count, 3, 4, 4), dtype=np.uint8)
            batch = [TrainingSample(str(i), torch.as_tensor(pixels), {}) for i, pixels in enumerate(images)]
            votes = (float(processes.first), 0.5)
            values, votes_of_all = step.train_on_batch(
                training,
                processes.share(batch),
                SHIPPED_RECIPES["paper"],
                rate=RATES,
                images=count,
                processes=processes,
                votes=votes,
            )
            assert votes_of_all == [1.0, 0.5 * processes.size], "every process learns of the vote of one"
            losses.append(values["loss"])
        processes.average_statistics(toy)
        state = {"weight": toy.weight.detach(), "mean": toy.running_mean, "losses": torch.tensor(losses)}
        torch.save(state, f"{out}.{processes.rank}")


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def test_a_batch_shared_by_two_processes_teaches_the_same(tmp_path: Path) -> None:
    learn(str(tmp_path / "alone"))
    code = f"from tests.train.test_distributed import learn; learn({str(tmp_path / 'both')!r})"
    common = {**os.environ, "WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port())}
    members = [
        subprocess.Popen([sys.executable, "-c", code], env={**common, "RANK": str(rank), "LOCAL_RANK": str(rank)})
        for rank in range(2)
    ]
    assert [member.wait(timeout=HANG_S) for member in members] == [0, 0]
    alone, *both = (torch.load(tmp_path / name, weights_only=True) for name in ("alone.0", "both.0", "both.1"))
    for state in both:
        torch.testing.assert_close(state["weight"], alone["weight"])
        torch.testing.assert_close(state["losses"], alone["losses"])
    assert torch.equal(both[0]["mean"], both[1]["mean"])
    assert both[0]["mean"].min() > 0


def test_parts_of_a_batch_teach_what_the_batch_does(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(step, "detection_losses", Toy.losses)
    weights = []
    for at_once in (None, 2):
        toy = Toy()
        sgd = torch.optim.SGD(toy.parameters(), lr=RATES)
        training: Any = SimpleNamespace(model=toy, optimizer=sgd, epochs_done=0, teacher=None)
        pixels = np.random.default_rng(0).integers(0, 256, (5, 3, 4, 4), dtype=np.uint8)
        batch = [TrainingSample(str(i), torch.as_tensor(each), {}) for i, each in enumerate(pixels)]
        recipe = replace(SHIPPED_RECIPES["paper"], images_at_once=at_once)
        step.train_on_batch(training, batch, recipe, rate=RATES, images=5, processes=ProcessGroup(), votes=())
        weights.append(toy.weight.detach())
    torch.testing.assert_close(weights[0], weights[1])
    assert not torch.equal(weights[0], Toy().weight)


def torchrun(folder: Path, *more: str) -> subprocess.CompletedProcess[str]:
    start = ("-m", "torch.distributed.run", "--nproc-per-node", "2", "--master-port", str(free_port()))
    flags = ("--data", str(folder / "data"), "--out", str(folder / "run"), "--device", "cpu", "--epochs", "1")
    values = [part for value in SMALL for part in ("--set", value)]
    small_skope = ("-m", "tests.train.small_skope", "train")
    command = [sys.executable, *start, *small_skope, "--recipe", "scratch", *flags, *values, *more]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)


@pytest.mark.slow
def test_under_torchrun_one_process_writes_and_talks(tmp_path: Path) -> None:
    samples.make_dataset(tmp_path / "data", images=5, splits=("train",))  # 3 to learn: the last batch is one image
    done = torchrun(tmp_path, "--batch-size", "2")
    assert done.returncode == 0, done.stderr
    assert "on cpu x 2" in done.stdout
    assert done.stdout.count("images with") == 1
    (row,) = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert row["validation"]["images"] == 1
    assert list(checkpoints(tmp_path / "run")) == [1]


@pytest.mark.slow
def test_a_mistake_ends_all_processes(tmp_path: Path) -> None:
    done = torchrun(tmp_path)
    assert done.returncode != 0
    assert "data: no such dataset folder" in done.stderr
    assert not (tmp_path / "run").exists()


def test_shares_of_a_batch() -> None:
    batch = list(range(5))
    assert [ProcessGroup(rank, 2).share(batch) for rank in range(2)] == [[0, 2, 4], [1, 3]]
    assert [list(ProcessGroup(rank, 3).share([7])) for rank in range(3)] == [[7], [], []]
    alone = torch.ones(2)
    ProcessGroup().sum_over_all([alone])
    assert alone.tolist() == [1, 1]
