"""Train a detector from random weights in one of three ways, pack its weights, and measure them before and after.

    skope gen simulate --preset paper --no-depth --out data/paper       # varied, world and extra: the same
    python scripts/reference_run.py paper                 # on a machine with a GPU -> runs/reference/paper
    python scripts/reference_run.py varied --gpus 2,3     # beside it on other GPUs, or after it
    python scripts/reference_run.py world                 # after `varied`, from whose weights it goes on

`paper` learns from that preset alone, `varied` from both, half of the images each, with all augmentations on
(reference.toml); `world` goes on from there with images of that preset (world.toml). What is finished is not done
again, and what was interrupted goes on: with --minutes, in commands of limited time. `make paper` is the paper's own
experiment.
"""

import argparse
import itertools
import os
import signal
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from skope.dataset import CARD
from skope.detector import find_checkpoint
from skope.train.run_folder import resumable

HERE: Final = Path(__file__).parent
SPLITS: Final = {"paper": ("easy", "medium", "hard"), "extra": ("extra",), "varied": ("easy", "medium", "hard")}
LIVELY: Final = {
    **{"crop": 0.7, "occluders": 0.3, "color": 0.5, "brightness": 0.5, "infrared": 0.1, "rain": 0.1},
    **{"blur": 0.3, "noise": 0.3, "resample": 0.3, "jpeg": 0.3, "video": 0.2},
}
PACKED: Final = "packed.safetensors"
GRACE_S: Final = 25
"""For a training to save its state when time is up."""


@dataclass(frozen=True)
class Training:
    """What a detector learns from, and how."""

    presets: Sequence[str]
    recipe: str = "reference.toml"
    augment: Mapping[str, float] = field(default_factory=dict)
    """Changes of the images besides the recipe's."""
    after: str | None = None
    """The training that it goes on from; None: random weights."""


TRAININGS: Final = {
    "paper": Training(("paper",)),
    "varied": Training(("paper", "varied"), augment=LIVELY),
    "world": Training(("world",), "world.toml", after="varied"),
}


class TimeIsUpError(Exception):
    """The limit came before the end; the same command goes on."""


class Clock:
    """Runs commands on some GPUs until a limit of time for all of them together."""

    def __init__(self, minutes: float, gpus: Sequence[str]) -> None:
        self._end = time.monotonic() + 60 * minutes
        self._gpus = gpus

    def train(self, command: Sequence[str]) -> None:
        """Run `skope train` in one process a GPU."""
        several = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(len(self._gpus)), "-m"]
        self._run([[*several, "skope", "train", *command]], [",".join(self._gpus)])

    def run(self, *commands: Sequence[str]) -> None:
        """Run `skope ...` side by side, each on one GPU."""
        self._run([["skope", *command] for command in commands], self._gpus)

    def _run(self, modules: Sequence[Sequence[str]], devices: Sequence[str]) -> None:
        """Run `python -m ...` side by side; stop them gently when time is up, exit when one fails."""
        running = []
        for module, device in zip(modules, itertools.cycle(devices), strict=False):
            environment = {**os.environ, "CUDA_VISIBLE_DEVICES": device}
            running.append(subprocess.Popen([sys.executable, "-m", *module], env=environment))
        try:
            for process in running:
                process.wait(max(0.0, self._end - GRACE_S - time.monotonic()))
        except subprocess.TimeoutExpired:
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                try:
                    process.wait(GRACE_S)
                except subprocess.TimeoutExpired:
                    process.kill()
            raise TimeIsUpError from None
        failed = [module for module, process in zip(modules, running, strict=True) if process.returncode]
        if failed:
            sys.exit(f"{' '.join(failed[0])}: failed")


def render(clock: Clock, data: Path, presets: Sequence[str]) -> None:
    for preset in presets:
        if not (data / preset / CARD).is_file():
            clock.run(["gen", "render", str(data / preset)])


def train(clock: Clock, options: argparse.Namespace, training: Training) -> Path:
    """Train, or go on; returns the run folder."""
    run = options.out / "run"
    if (run / ".trained").is_file():
        return run
    new = ["--recipe", str(HERE / training.recipe), "--max-images", str(options.images // len(training.presets))]
    new += [flag for name, value in training.augment.items() for flag in ("--set", f"augment.{name}={value}")]
    new += [flag for preset in training.presets for flag in ("--data", str(options.data / preset))]
    if training.after:
        new += ["--init", str(options.out.parent / training.after / PACKED)]
    always = ["--out", str(run), "--workers", str(options.workers), "--save-minutes", "3"]
    clock.train([*always, *(["--resume"] if resumable(run) else new)])
    (run / ".trained").touch()
    return run


def measure(clock: Clock, options: argparse.Namespace, forms: Mapping[str, Path]) -> None:
    """All test splits of all presets with all forms of the weights side by side: one leaves most of a GPU idle."""
    commands = []
    for form, preset in itertools.product(forms, SPLITS):
        for split in SPLITS[preset]:
            out = options.out / form / preset / split
            if not (out / "metrics.json").is_file():
                what = ["--data", str(options.data / preset), "--checkpoint", str(forms[form]), "--split", split]
                commands.append(["eval", *what, "--out", str(out), "--batch-size", "4"])
    clock.run(*commands)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("training", choices=tuple(TRAININGS))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the presets' folders")
    parser.add_argument("--out", type=Path, help="by default runs/reference/TRAINING")
    parser.add_argument("--gpus", default="0", help="numbers, separated by commas")
    parser.add_argument("--images", type=int, default=10_500, help="images to learn from, each seen in every epoch")
    parser.add_argument("--workers", type=int, default=8, help="processes that load images, a GPU")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop, resumably, after so many")
    options = parser.parse_args()
    options.out = options.out or Path("runs/reference") / options.training
    training, clock = TRAININGS[options.training], Clock(options.minutes, options.gpus.split(","))
    try:
        render(clock, options.data, training.presets)
        full, packed = find_checkpoint(train(clock, options, training)), options.out / PACKED
        if not packed.is_file():
            clock.run(["train", "export", str(full), "--to", "compact", "--out", str(packed)])
        render(clock, options.data, tuple(SPLITS))
        measure(clock, options, {"full": full, "packed": packed})
    except TimeIsUpError:
        print("time is up: the same command goes on")
        sys.exit(75)
    print("done")


if __name__ == "__main__":
    main()
