"""The paper's experiment on a GPU machine, in commands of limited time: each goes on where the one before stopped.

    skope gen simulate --preset paper --out data/paper       # on any machine with SUMO and pybullet
    skope gen simulate --preset extra --out data/extra
    python scripts/reference_run.py work --out runs/reference --minutes 9.5    # on the GPU machine, until it says done
    python scripts/reference_run.py bring --out runs/reference --to FOLDER --half 0                      # then --half 1
    python scripts/reference_run.py join FOLDER FOLDER --out best.safetensors                            # at home

`work` renders the recordings, trains with one process a GPU, and evaluates one split a GPU beside published figures;
`make paper` does the same on one machine without limits. `bring` writes weights as bfloat16, in pieces that pass where
large files do not, half of them at a time, and figures, curves and the model card in one archive.
"""

import argparse
import signal
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from skope.dataset import CARD
from skope.detector import BEST, find_checkpoint, load_weights, save_weights
from skope.files import read_bytes, write_bytes
from skope.train.run import resumable

TESTS = ("easy", "medium", "hard")
PIECES = 8
PIECE = "weights.{:02d}"
FIGURES = ("eval/*/metrics.json", "eval/*/report.html", "*.png", "README.md", "metrics.jsonl")
GRACE_S = 25
"""For a training to save its state when time is up."""


class TimeIsUpError(Exception):
    """The limit came before the end; the same command goes on."""


class Clock:
    """How long commands may take, all together."""

    def __init__(self, minutes: float) -> None:
        self._end = time.monotonic() + 60 * minutes

    def run(self, *commands: Sequence[str]) -> None:
        """Run `python -m ...` commands side by side; stop them gently when time is up."""
        running = [subprocess.Popen([sys.executable, "-m", *command]) for command in commands]
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
        failed = next((process for process in running if process.returncode), None)
        if failed:
            sys.exit(f"{' '.join(map(str, failed.args))}: exit code {failed.returncode}")  # type: ignore[arg-type]


def work(options: argparse.Namespace) -> None:
    """All that is still to do, step by step."""
    clock, gpus = Clock(options.minutes), max(1, torch.cuda.device_count())
    for data in (options.data, options.extra):
        if not (data / CARD).is_file():
            clock.run(["skope", "gen", "render", str(data)])
    trained = options.out / ".trained"
    if not trained.is_file():
        several = ["torch.distributed.run", "--nproc-per-node", str(gpus), "-m"] if gpus > 1 else []
        new = ["--data", str(options.data), "--recipe", options.recipe, *options.train]
        how = ["--resume"] if resumable(options.out) else new
        clock.run([*several, "skope", "train", "--out", str(options.out), "--save-minutes", "2", *how])
        trained.touch()
    waiting = [split for split in (*TESTS, "extra") if not (options.out / "eval" / split / "metrics.json").is_file()]
    while waiting:
        now, waiting = waiting[:gpus], waiting[gpus:]
        clock.run(*(evaluation(options, split, gpu) for gpu, split in enumerate(now)))


def evaluation(options: argparse.Namespace, split: str, gpu: int) -> list[str]:
    """Of one split on one GPU."""
    data, beside = (options.extra, []) if split == "extra" else (options.data, ["--compare", "paper"])
    device = f"cuda:{gpu}" if torch.cuda.is_available() else "cpu"
    command = ["skope", "eval", "--data", str(data), "--checkpoint", str(checkpoint(options.out)), "--split", split]
    return [*command, "--out", str(options.out / "eval" / split), "--device", device, *beside]


def checkpoint(run: Path) -> Path:
    """The best epoch's, where a share of the data was validated on, else the last one's."""
    return run / BEST if (run / BEST).is_file() else find_checkpoint(run)


def bring(options: argparse.Namespace) -> None:
    """Half of the weights' pieces, and all figures."""
    model, config, metadata = load_weights(checkpoint(options.out), "cpu")
    with tempfile.TemporaryDirectory() as folder:
        save_weights(Path(folder) / BEST, model.bfloat16(), config, metadata)
        content = read_bytes(Path(folder) / BEST)
    size = -(-len(content) // PIECES)
    for k in range(options.half * PIECES // 2, (options.half + 1) * PIECES // 2):
        write_bytes(options.to / PIECE.format(k), content[k * size : (k + 1) * size])
    with tarfile.open(options.to / "figures.tar", "w") as archive:
        for path in sorted(path for pattern in FIGURES for path in options.out.glob(pattern)):
            archive.add(path, path.relative_to(options.out))


def join(options: argparse.Namespace) -> None:
    """The weights of all pieces."""
    found = {path.name: path for folder in options.folders for path in folder.glob("weights.*")}
    lost = [name for name in map(PIECE.format, range(PIECES)) if name not in found]
    if lost:
        sys.exit(f"missing: {', '.join(lost)}")
    write_bytes(options.out, b"".join(read_bytes(found[PIECE.format(k)]) for k in range(PIECES)))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    working = commands.add_parser("work")
    working.add_argument("--data", type=Path, default=Path("data/paper"))
    working.add_argument("--extra", type=Path, default=Path("data/extra"))
    working.add_argument("--out", type=Path, default=Path("runs/reference"))
    working.add_argument("--recipe", default="paper", help="as `skope train` takes it")
    working.add_argument("--train", action="append", default=[], help="a flag of `skope train`: --train=--init=FILE")
    working.add_argument("--minutes", type=float, default=float("inf"), help="stop, resumably, after so many")
    working.set_defaults(do=work)
    bringing = commands.add_parser("bring")
    bringing.add_argument("--out", type=Path, default=Path("runs/reference"))
    bringing.add_argument("--to", type=Path, required=True)
    bringing.add_argument("--half", type=int, choices=(0, 1), required=True)
    bringing.set_defaults(do=bring)
    joining = commands.add_parser("join")
    joining.add_argument("folders", type=Path, nargs="+")
    joining.add_argument("--out", type=Path, required=True)
    joining.set_defaults(do=join)
    options = parser.parse_args()
    try:
        options.do(options)
    except TimeIsUpError:
        print("time is up: the same command goes on")
        sys.exit(75)
    print("done")


if __name__ == "__main__":
    main()
