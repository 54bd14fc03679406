"""Several processes train one model as torchrun starts them (here two on the CPU, over gloo)."""

import json
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from skope import detector
from skope.train.ranks import Team
from tests import samples

RECIPE = """
base = "scratch"
epochs = 2
batch_size = 2
min_size = 64
max_size = 96
regions = 4096
keypoint_regions = "none"
norm = "frozen"
val_fraction = 0.25
warmup_steps = 0
learning_rate = 1e-3
bfloat16 = false
[augment]
flip = 0.0
"""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def skope_train(folder: Path, out: str, processes: int, *more: str) -> subprocess.CompletedProcess[str]:
    torchrun = ("-m", "torch.distributed.run", "--nproc-per-node", str(processes), "--master-port", str(free_port()))
    start = (*torchrun, "-m", "skope") if processes > 1 else ("-m", "skope")
    flags = ("--data", str(folder / "data"), "--recipe", str(folder / "small.toml"), "--out", str(folder / out))
    command = [sys.executable, *start, "train", *flags, "--device", "cpu", *more]
    return subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)


def test_two_processes_learn_what_one_does(tmp_path: Path) -> None:
    """The same batches, shared: losses and weights agree but for the draw of regions; one process writes and talks."""
    samples.make_dataset(tmp_path / "data", images=7, splits=("train",))  # 5 to learn: the last batch is one image
    (tmp_path / "small.toml").write_text(RECIPE)
    runs = {}
    for processes in (1, 2):
        done = skope_train(tmp_path, f"run{processes}", processes)
        assert done.returncode == 0, done.stderr
        out = tmp_path / f"run{processes}"
        rows = [json.loads(line) for line in (out / "metrics.jsonl").read_text().splitlines()]
        runs[processes] = rows, load_file(detector.find_checkpoint(out))
        assert f"on cpu x {processes}" in done.stdout
        assert done.stdout.count("images with") == 1
    (one, weights), (two, shared) = runs[1], runs[2]
    for a, b in zip(one, two, strict=True):
        assert b["loss_classifier"] == pytest.approx(a["loss_classifier"], rel=0.05)
        assert b["loss_keypoint"] == pytest.approx(a["loss_keypoint"], rel=0.05)
    moved = [(shared[n] - weights[n]).norm() for n in weights if n.endswith("weight")]
    state = torch.load(tmp_path / "run2" / "resume.pt", weights_only=True)["optimizer"]["state"]
    assert all(torch.isfinite(value) for value in moved)
    assert sum(moved) < 0.1 * sum(entry["momentum_buffer"].norm() for entry in state.values())


def test_a_mistake_ends_all_processes(tmp_path: Path) -> None:
    (tmp_path / "small.toml").write_text(RECIPE)
    done = skope_train(tmp_path, "run", 2)
    assert done.returncode != 0
    assert "data: no such dataset folder" in done.stderr
    assert not (tmp_path / "run").exists()


def test_shares_of_a_batch() -> None:
    batch = list(range(5))
    assert [Team(rank, 2).share(batch) for rank in range(2)] == [[0, 2, 4], [1, 3]]
    assert [list(Team(rank, 3).share([7])) for rank in range(3)] == [[7], [], []]
    alone = torch.ones(2)
    Team().add_up([alone])
    assert alone.tolist() == [1, 1]
