"""Make `road33` and `road33-lite`, which come with skope, from nothing: train, pack the weights, measure.

    python scripts/reference_run.py paper                 # on a machine with a GPU -> runs/reference/paper
    python scripts/reference_run.py varied --gpus 2,3     # beside it on other GPUs, or after it
    python scripts/reference_run.py world --gpus 0,1      # after `varied`, from whose weights it goes on
    python scripts/reference_run.py road33 --gpus 0,1     # after `world`
    python scripts/reference_run.py lite --gpus 0,1       # from random weights, with road33 as it ships as teacher

`paper` learns from that preset alone, `varied` from both, half of the images each, with all augmentations on
(recipes/reference.toml): both from random weights. `world` goes on from `varied` with 960 places of that preset, while
a quarter of the images are still of `paper` with its small vehicles (recipes/world.toml). `road33` goes on from `world`
in the legs of train_leg.py, with new places in each, by day and night, and bicycles, motorcycles and people; `lite`
learns in legs of its own. Scores are calibrated on places that were not learnt from. `make reference` does `varied`,
`world` and `road33`, `make lite` does `lite`.

Datasets that are missing under --data are made. Recordings need SUMO and pybullet; where these are not, bring folders
of `skope gen simulate` (DATASETS has their options), and they are drawn. What is finished is not done again, and what
was interrupted goes on: with --minutes, in commands of limited time. `make paper` is the paper's own experiment.
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
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from skope.dataset.folder import CARD_FILE
from skope.detector.checkpoint import find_checkpoint
from skope.gen.towns.sites import sites
from skope.train.training_state import resumable

HERE: Final = Path(__file__).parent


def of_splits(*splits: str) -> str:
    """The names of their sites."""
    return ",".join(name for name, site in sites().items() if site.split in splits)


TRAIN, TESTED, EXTRA = of_splits("train"), of_splits("easy", "medium", "hard"), of_splits("extra")
DATASETS: Final = {
    "paper": "--preset paper",
    "varied": "--preset varied",
    "world_31": "--preset world --frames 576 --seed 31",
    "world_51": "--preset world --frames 576 --seed 51",
    "paper_22": f"--preset paper --frames 240 --seed 22 --sites {TRAIN}",
    "varied_22": f"--preset varied --frames 144 --seed 22 --sites {TRAIN}",
    "world_777": "--preset world --frames 24 --seed 777 --size 1280x720",
    "paper_7": f"--preset paper --frames 150 --seed 7 --sites {TESTED}",
    "varied_7": f"--preset varied --frames 120 --seed 7 --sites {TESTED}",
    "extra_7": "--preset extra --frames 12 --seed 7",
    "world_7": f"--preset world --frames 12 --views 0 --seed 7 --sites {EXTRA}",
    "conditions_4711": "--preset conditions --frames 64 --seed 4711 --size 1280x720",
}
"""Folders under --data, and how `skope gen simulate` makes their recordings."""
TESTS: Final = {
    "paper_7": "easy,medium,hard",
    "varied_7": "easy,medium,hard",
    "extra_7": "extra",
    "world_7": "extra",
    "conditions_4711": "night,wet_night,fog,snow,spray,low_sun,queues,heavy",
}
"""Dataset -> splits that are measured."""
CALIBRATION: Final = "world_777"
LIVELY: Final = {
    **{"crop": 0.7, "occluders": 0.3, "color": 0.5, "brightness": 0.5, "infrared": 0.1, "rain": 0.1},
    **{"blur": 0.3, "noise": 0.3, "resample": 0.3, "jpeg": 0.3, "video": 0.2},
}
PACKED: Final = "packed.safetensors"
LEG_MINUTES: Final = 25
GRACE_S: Final = 25
"""For a training to save its state when time is up."""


@dataclass(frozen=True)
class Training:
    """What a detector learns from, and how."""

    datasets: Sequence[str] = ()
    recipe: str = ""
    images: int | None = None
    """Images with vehicles that are learnt from, each seen in every epoch; None: all, those without vehicles too."""
    mix: float | None = None
    """Share of the first dataset in each epoch; None: as large as it is."""
    augment: Mapping[str, float] = field(default_factory=dict)
    """Changes of the images besides the recipe's."""
    after: str | None = None
    """The training that it goes on from; None: random weights."""
    legs: Sequence[str] = ()
    """It learns in these legs of train_leg.py, which make their own datasets."""
    calibrated: bool = False


TRAININGS: Final = {
    "paper": Training(("paper",), "reference.toml", images=10_500),
    "varied": Training(("paper", "varied"), "reference.toml", images=10_500, augment=LIVELY),
    "world": Training(
        ("paper_22", "world_31", "world_51", "varied_22"),
        "world.toml",
        mix=0.25,
        after="varied",
        calibrated=True,
    ),
    "road33": Training(after="world", legs=("1", "2", "3", "4"), calibrated=True),
    "lite": Training(legs=("lite-1", "lite-2"), calibrated=True),
}


class TimeIsUpError(Exception):
    """The limit came before the end; the same command goes on."""


class Clock:
    """Runs commands on some GPUs until a limit of time for all of them together."""

    def __init__(self, minutes: float, gpus: Sequence[str], *, grace_s: float = GRACE_S) -> None:
        self._end = time.monotonic() + 60 * minutes
        self._gpus, self._grace_s = gpus, grace_s

    def train(self, *options: str) -> None:
        """Run `skope train` in a process on each GPU."""
        count = len(self._gpus)
        several = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(count), "-m"] if count > 1 else []
        self._run([["-m", *several, "skope", "train", *options]], [",".join(self._gpus)])

    def script(self, name: str, *options: str) -> None:
        """Run a script beside this one, which shares out the GPUs itself."""
        self._run([[str(HERE / name), *options]], [",".join(self._gpus)])

    def run(self, *commands: Sequence[str]) -> None:
        """Run `skope ...` side by side, each on one GPU."""
        self._run([["-m", "skope", *command] for command in commands], self._gpus)

    def _run(self, commands: Sequence[Sequence[str]], devices: Sequence[str]) -> None:
        """Run `python ...` side by side; stop them gently when time is up, exit when one fails."""
        running = []
        for command, device in zip(commands, itertools.cycle(devices), strict=False):
            environment = {**os.environ, "CUDA_VISIBLE_DEVICES": device}
            running.append(subprocess.Popen([sys.executable, *command], env=environment))
        try:
            for process in running:
                process.wait(max(0.0, self._end - self._grace_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            for process in running:
                process.send_signal(signal.SIGTERM)
            for process in running:
                try:
                    process.wait(self._grace_s)
                except subprocess.TimeoutExpired:
                    process.kill()
            raise TimeIsUpError from None
        failed = [command for command, process in zip(commands, running, strict=True) if process.returncode]
        if failed:
            sys.exit(f"{' '.join(failed[0])}: failed")


def make(clock: Clock, data: Path, names: Sequence[str]) -> None:
    """Simulate what is not simulated, on a machine that can, and draw what has no images."""
    for name in names:
        if (data / name / CARD_FILE).is_file():
            continue
        if find_spec("pybullet"):
            clock.run(["gen", "simulate", *DATASETS[name].split(), "--no-depth", "--out", str(data / name)])
        clock.run(["gen", "render", str(data / name)])


def train(clock: Clock, options: argparse.Namespace, training: Training) -> Path:
    """Train, or go on; returns the weights."""
    run: Path = options.out / "run"
    if not (run / ".trained").is_file():
        new = ["--recipe", str(HERE / "recipes" / training.recipe)]
        if training.images:
            new += ["--max-images", str((options.images or training.images) // len(training.datasets))]
        if training.mix:
            new += ["--mix", str(training.mix)]
        new += [flag for name, value in training.augment.items() for flag in ("--set", f"augment.{name}={value}")]
        new += [flag for name in training.datasets for flag in ("--data", str(options.data / name))]
        if training.after:
            new += ["--init", str(options.out.parent / training.after / PACKED)]
        always = ["--workers", str(options.workers), "--save-minutes", "3", "--out", str(run)]
        clock.train(*always, *(["--resume"] if resumable(run) else new))
        (run / ".trained").touch()
    return find_checkpoint(run)


def learn_in_legs(clock: Clock, options: argparse.Namespace, training: Training) -> Path:
    """Do the legs that are not done; returns the weights of the last one."""
    begin = ["--init", str(options.out.parent / training.after / PACKED)] if training.after else []
    always = ["--data", str(options.data / "legs"), "--gpus", options.gpus, "--loaders", str(options.workers)]
    always += ["--workers", str(os.cpu_count()), "--minutes", str(LEG_MINUTES)]
    for name in training.legs:
        leg: Path = options.out / f"leg_{name}"
        if not (leg / ".learnt").is_file():
            clock.script("train_leg.py", "run", name, *begin, *always, "--out", str(leg))
            (leg / ".learnt").touch()
        begin = ["--state", str(leg / "state")]
    weights: Path = options.out / "joined.safetensors"
    if not weights.is_file():
        clock.script("train_leg.py", "join", begin[-1], "--out", str(weights))
    return weights


def calibrate(clock: Clock, options: argparse.Namespace, full: Path) -> Path:
    """Give the scores their meaning on places of their own."""
    out: Path = options.out / "calibrated.safetensors"
    if not out.is_file():
        what = ["--data", str(options.data / CALIBRATION), "--split", "train", "--last", "1", "--score", "0.5"]
        clock.run(["eval", "calibrate-scores", "--checkpoint", str(full), *what, "--out", str(out)])
    return out


def measure(clock: Clock, options: argparse.Namespace, forms: Mapping[str, Path]) -> None:
    """All tests with all forms of the weights side by side: one leaves most of a GPU idle."""
    commands = []
    for form, name in itertools.product(forms, TESTS):
        out = options.out / form / name
        if not (out / "metrics.json").is_file():
            what = ["--data", str(options.data / name), "--checkpoint", str(forms[form]), "--split", TESTS[name]]
            commands.append(["eval", *what, "--out", str(out), "--batch-size", "8"])
    clock.run(*commands)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("training", choices=tuple(TRAININGS))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder of the datasets' folders")
    parser.add_argument("--out", type=Path, help="by default runs/reference/TRAINING")
    parser.add_argument("--gpus", default="0", help="numbers, separated by commas")
    parser.add_argument("--images", type=int, help="of `paper` and `varied`: images to learn from (10500)")
    parser.add_argument("--workers", type=int, default=8, help="processes that load images, a GPU")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop, resumably, after so many")
    options = parser.parse_args()
    options.out = options.out or Path("runs/reference") / options.training
    training, clock = TRAININGS[options.training], Clock(options.minutes, options.gpus.split(","))
    try:
        make(clock, options.data, training.datasets)
        full = (learn_in_legs if training.legs else train)(clock, options, training)
        packed = options.out / PACKED
        make(clock, options.data, [CALIBRATION])
        full = calibrate(clock, options, full) if training.calibrated else full
        if not packed.is_file():
            seen = ["--data", str(options.data / CALIBRATION)]
            clock.run(["train", "export", str(full), "--to", "compact", *seen, "--out", str(packed)])
        make(clock, options.data, tuple(TESTS))
        measure(clock, options, {"full": full, "packed": packed})
    except TimeIsUpError:
        print("time is up: the same command goes on")
        sys.exit(75)
    print("done")


if __name__ == "__main__":
    main()
