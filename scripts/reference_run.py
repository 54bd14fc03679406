"""Make `road33` and `road33-lite`, which come with skope, from scratch: train, pack the weights, measure.

    python scripts/reference_run.py paper                 # on a machine with a GPU -> runs/reference/paper
    python scripts/reference_run.py varied --gpus 2,3     # beside it on other GPUs, or after it
    python scripts/reference_run.py world --gpus 0,1      # after `varied`, starting from its weights
    python scripts/reference_run.py road33 --gpus 0,1     # after `world`
    python scripts/reference_run.py lite --gpus 0,1       # from random weights, with road33 as it ships as teacher

`paper` trains on that preset alone, `varied` on both, half of the images each, with all augmentations
(recipes/reference.toml). Both start from random weights. `world` starts from the weights of `varied` and adds 960
places of that preset; a quarter of its images still come from `paper` with its small vehicles (recipes/world.toml).
`road33` starts from `world` and trains in the stages of train_leg.py, each with new places, by day and night, and with
bicycles, motorcycles and people. `lite` has stages of its own. Scores are calibrated on places that were not trained
on. `make reference` runs `varied`, `world` and `road33`, `make lite` runs `lite`.

Missing datasets under --data are generated. Recordings need SUMO and pybullet; without these, copy folders of
`skope gen simulate` here (DATASETS has their options), and they are rendered. Finished steps are not repeated, and
interrupted ones resume; --minutes limits the time of a command. `make paper` is the paper's own experiment.
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
    """Return the names of the sites in these splits."""
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
"""Folders under --data, and the options of `skope gen simulate` for their recordings."""
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
STAGE_MINUTES: Final = 25
GRACE_S: Final = 25
"""Time for a training to save its state at the end of the time limit."""


@dataclass(frozen=True)
class Training:
    """Data and settings of a training."""

    datasets: Sequence[str] = ()
    recipe: str = ""
    images: int | None = None
    """Images with vehicles to train on, each seen in every epoch; None: all images, including those without
    vehicles."""
    mix: float | None = None
    """Share of the first dataset in each epoch; None: in proportion to its size."""
    augment: Mapping[str, float] = field(default_factory=dict)
    """Augmentations in addition to the recipe's."""
    after: str | None = None
    """The training whose weights it starts from; None: random weights."""
    stages: Sequence[str] = ()
    """Stages of train_leg.py, which make their own datasets; empty: it trains in one run."""
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
    "road33": Training(after="world", stages=("1", "2", "3", "4", "6"), calibrated=True),
    "lite": Training(stages=("lite-1", "lite-2", "lite-3"), calibrated=True),
}


class TimeIsUpError(Exception):
    """The time limit was reached before the end; the same command resumes."""


class Clock:
    """Runs commands on some GPUs, up to one time limit for all of them together."""

    def __init__(self, minutes: float, gpus: Sequence[str], *, grace_s: float = GRACE_S) -> None:
        self._end = time.monotonic() + 60 * minutes
        self._gpus, self._grace_s = gpus, grace_s

    def train(self, *options: str) -> None:
        """Run `skope train` in a process on each GPU."""
        count = len(self._gpus)
        several = ["torch.distributed.run", "--standalone", "--nproc-per-node", str(count), "-m"] if count > 1 else []
        self._run([["-m", *several, "skope", "train", *options]], [",".join(self._gpus)])

    def script(self, name: str, *options: str) -> None:
        """Run a script of this folder, which distributes the GPUs itself."""
        self._run([[str(HERE / name), *options]], [",".join(self._gpus)])

    def run(self, *commands: Sequence[str]) -> None:
        """Run `skope ...` commands in parallel, each on one GPU."""
        self._run([["-m", "skope", *command] for command in commands], self._gpus)

    def _run(self, commands: Sequence[Sequence[str]], devices: Sequence[str]) -> None:
        """Run `python ...` commands in parallel; stop them gently at the time limit, and exit if one fails."""
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
    """Simulate the missing recordings, on a machine that can, and render those without images."""
    for name in names:
        if (data / name / CARD_FILE).is_file():
            continue
        if find_spec("pybullet"):
            clock.run(["gen", "simulate", *DATASETS[name].split(), "--no-depth", "--out", str(data / name)])
        clock.run(["gen", "render", str(data / name)])


def train(clock: Clock, options: argparse.Namespace, training: Training) -> Path:
    """Train or resume; returns the weights."""
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


def train_in_stages(clock: Clock, options: argparse.Namespace, training: Training) -> Path:
    """Train the stages that are not finished; returns the weights of the last one."""
    begin = ["--init", str(options.out.parent / training.after / PACKED)] if training.after else []
    always = ["--data", str(options.data / "legs"), "--gpus", options.gpus, "--loaders", str(options.workers)]
    always += ["--workers", str(os.cpu_count()), "--minutes", str(STAGE_MINUTES)]
    for name in training.stages:
        stage_folder: Path = options.out / f"leg_{name}"
        if not (stage_folder / ".learnt").is_file():
            clock.script("train_leg.py", "run", name, *begin, *always, "--out", str(stage_folder))
            (stage_folder / ".learnt").touch()
        begin = ["--state", str(stage_folder / "state")]
    weights: Path = options.out / "joined.safetensors"
    if not weights.is_file():
        clock.script("train_leg.py", "join", begin[-1], "--out", str(weights))
    return weights


def calibrate(clock: Clock, options: argparse.Namespace, full: Path) -> Path:
    """Calibrate the scores on places that were not trained on."""
    out: Path = options.out / "calibrated.safetensors"
    if not out.is_file():
        arguments = ["--data", str(options.data / CALIBRATION), "--split", "train", "--last", "1", "--score", "0.5"]
        clock.run(["eval", "calibrate-scores", "--checkpoint", str(full), *arguments, "--out", str(out)])
    return out


def measure(clock: Clock, options: argparse.Namespace, forms: Mapping[str, Path]) -> None:
    """Run all tests with all forms of the weights in parallel, because one test leaves most of a GPU idle."""
    commands = []
    for form, name in itertools.product(forms, TESTS):
        out = options.out / form / name
        if not (out / "metrics.json").is_file():
            arguments = ["--data", str(options.data / name), "--checkpoint", str(forms[form]), "--split", TESTS[name]]
            commands.append(["eval", *arguments, "--out", str(out), "--batch-size", "8"])
    clock.run(*commands)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("training", choices=tuple(TRAININGS))
    parser.add_argument("--data", type=Path, default=Path("data"), help="folder that contains the dataset folders")
    parser.add_argument("--out", type=Path, help="default: runs/reference/TRAINING")
    parser.add_argument("--gpus", default="0", help="GPU numbers, separated by commas")
    parser.add_argument("--images", type=int, help="images to train on, for `paper` and `varied` (10500)")
    parser.add_argument("--workers", type=int, default=8, help="processes per GPU that load images")
    parser.add_argument("--minutes", type=float, default=float("inf"), help="stop after this time; it can be resumed")
    options = parser.parse_args()
    options.out = options.out or Path("runs/reference") / options.training
    training, clock = TRAININGS[options.training], Clock(options.minutes, options.gpus.split(","))
    try:
        make(clock, options.data, training.datasets)
        full = (train_in_stages if training.stages else train)(clock, options, training)
        packed = options.out / PACKED
        make(clock, options.data, [CALIBRATION])
        full = calibrate(clock, options, full) if training.calibrated else full
        if not packed.is_file():
            seen = ["--data", str(options.data / CALIBRATION)]
            clock.run(["train", "export", str(full), "--to", "compact", *seen, "--out", str(packed)])
        make(clock, options.data, tuple(TESTS))
        measure(clock, options, {"full": full, "packed": packed})
    except TimeIsUpError:
        print("time limit reached: run the same command to resume")
        sys.exit(75)
    print("done")


if __name__ == "__main__":
    main()
