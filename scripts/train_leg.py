"""Train a shipped detector in stages, each of which finishes within a given time on a machine.

    python scripts/train_leg.py run 2 --state runs/legs/1 --minutes 24 --gpus 0,1 --out runs/legs/2
    python scripts/train_leg.py join runs/legs/2 --out road33_2.safetensors

A stage (legs.toml) starts from the weights of the previous one. Its places are simulated and rendered while it trains.
Training has rounds: each trains on all places that are rendered when it begins, at a constant rate (recipes/), and
passes the running mean of its weights to the next; the last round may have a lower rate. At the end the tests are
measured, and the weights are packed for transfer: in 16 bits (norms and counts unchanged), in parts of at most 15 MiB
with their SHA-256 in parts.json. `join` puts them together again if all parts are present and undamaged. leg.json
records the steps and the figures.

Stages that have the same places can train in parallel, each on a GPU of its own: one makes the places, the others run
with --workers 0 and the same --data.

Finished steps are not repeated: after an interruption the same command resumes. --miniature tries a stage on a laptop.
"""

import argparse
import hashlib
import json
import subprocess
import sys
import threading
import time
import tomllib
from collections.abc import Mapping, Sequence
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import torch
from reference_run import EXTRA, GRACE_S, TESTED, TRAIN, Clock, TimeIsUpError
from safetensors.torch import load as deserialized
from safetensors.torch import save as serialized

from skope.dataset.folder import CARD_FILE, open_dataset
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import HEADER_FIELD, find_checkpoint, read_checkpoint, save_weights
from skope.errors import UserError
from skope.files.atomic import write_bytes
from skope.files.json_files import read_json, write_json
from skope.train.training_state import resumable

HERE: Final = Path(__file__).parent
PART_BYTES: Final = 15 * 2**20
PARTS: Final = "parts.json"
ROUND_S: Final = 240.0
"""Duration of a round; the last one lasts until training has to end."""
LEAST_ROUND_S: Final = 60.0
MEASURING_S: Final = 150.0
"""Part of a stage's time that is kept for measuring and packing."""
RANDOM: Final = "random"
"""Start of a stage with random weights."""
AT_ONCE: Final = 4
"""Number of datasets that are simulated in parallel."""
TESTS_AFTER: Final = 5
"""Number of training datasets that are made before the tests."""
TINY_PLACES: Final = {"--frames": "1", "--size": "480x270"}
TINY_SETTINGS: Final = ("min_size=120", "max_size=214", "batch_size=1", "bfloat16=false", "keypoint_regions=4")
"""Settings that --miniature changes."""


@dataclass(frozen=True)
class Stage:
    """Data and settings of a training stage, and the weights that it starts from."""

    name: str
    start: str
    """`RANDOM`, or empty: it starts from the weights of --init, or of the previous stage, --state."""
    places: Mapping[str, str]
    """Datasets: name -> options of `skope gen simulate`."""
    recipe: str
    """Name of a recipe file in the folder recipes."""
    settings: tuple[str, ...] = ()
    """Values of the recipe, as --set takes them."""
    last: tuple[str, ...] = ()
    """Further values for the last round."""


def named_places(row: Mapping[str, Any], lists: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """Return a stage's datasets by name: its own list, or that of the stage whose name it gives."""
    owner = row["places"] if isinstance(row["places"], str) else row["name"]
    return {f"leg_{owner}_{number}": text for number, text in enumerate(lists[owner], start=1)}


def read_stages(path: Path = HERE / "legs.toml") -> tuple[dict[str, Stage], dict[str, dict[str, str]]]:
    """Read the stages by name, and the tests: dataset -> its `places` and `splits`."""
    values = tomllib.loads(path.read_text())
    place_lists = {row["name"]: row["places"] for row in values["legs"] if isinstance(row["places"], list)}
    stages = [
        Stage(
            name=row["name"],
            start=row.get("start", ""),
            places=named_places(row, place_lists),
            recipe=row.get("recipe", "leg.toml"),
            settings=tuple(row.get("settings", ())),
            last=tuple(row.get("last", ())),
        )
        for row in values["legs"]
    ]
    return {stage.name: stage for stage in stages}, values["tests"]


# ------------------------------------------------------------------------------------------------------------- places


class Places:
    """Datasets that are simulated and rendered in the background, in the given order."""

    def __init__(self, folder: Path, wanted: Mapping[str, str], workers: int) -> None:
        """Start with the datasets of `wanted`, name -> options of `skope gen simulate`.

        With 0 workers another run makes them.
        """
        self._folder, self._wanted, self._workers = folder, tuple(wanted), workers
        self._changed = threading.Condition()
        self._running: set[subprocess.Popen[bytes]] = set()
        self._stopped = False
        self.failed: list[str] = []
        missing = {name: text for name, text in wanted.items() if name not in self.drawn and workers}
        self._left = len(missing) if workers else len(wanted)
        self._simulating = ThreadPoolExecutor(AT_ONCE)
        simulated = {name: self._simulating.submit(self._simulate, name, text) for name, text in missing.items()}
        self._drawing = threading.Thread(target=self._draw, args=(simulated,), daemon=True)
        self._drawing.start()

    @property
    def drawn(self) -> list[str]:
        """Names of the datasets that exist."""
        return [name for name in self._wanted if (self._folder / name / CARD_FILE).is_file()]

    def _simulate(self, name: str, options: str) -> None:
        share = str(max(1, self._workers // AT_ONCE))
        words = [*options.split(), "--no-depth", "--workers", share, "--out", str(self._folder / name)]
        self._skope("10", "gen", "simulate", "-q", *words)

    def _draw(self, simulated: Mapping[str, Future[None]]) -> None:
        """Render the simulated datasets one after the other."""
        for name, done in simulated.items():
            try:
                done.result()
                self._skope("5", "gen", "render", "-q", "--workers", str(self._workers), str(self._folder / name))
            except (subprocess.CalledProcessError, CancelledError):
                self.failed.append(name)
            with self._changed:
                self._left -= 1
                self._changed.notify_all()

    def _skope(self, niceness: str, *command: str) -> None:
        """Run a command with a lower priority than the training."""
        if self._stopped:
            raise CancelledError
        whole = ["nice", "-n", niceness, sys.executable, "-m", "skope", *command]
        process = subprocess.Popen(whole)
        self._running.add(process)
        code = process.wait()
        self._running.discard(process)
        if code:
            raise subprocess.CalledProcessError(code, whole)

    def wait_for(self, names: Sequence[str], until: float) -> list[str]:
        """Return the finished datasets among `names`.

        Waits until all of them are finished, nothing more is coming, or the monotonic time is `until`.
        """
        with self._changed:
            while not set(names) <= set(self.drawn) and self._left and time.monotonic() < until:
                self._changed.wait(1.0)
            return [name for name in names if name in self.drawn]

    def stop(self) -> None:
        """Stop all running work; unfinished datasets resume later."""
        self._stopped = True
        for process in list(self._running):
            process.terminate()
        self._simulating.shutdown(cancel_futures=True)
        self._drawing.join()


def placed(options: str, miniature: bool) -> str:
    """Return the options of a dataset with the names of the sites inserted.

    A miniature has fewer and smaller frames.
    """
    text = options.format(train=TRAIN, tested=TESTED, extra=EXTRA)
    if not miniature:
        return text
    words = text.split()
    for flag, value in TINY_PLACES.items():
        if flag in words:
            words[words.index(flag) + 1] = value
        else:
            words += [flag, value]
    return " ".join(words)


# ----------------------------------------------------------------------------------------------------------- training


def train_round(
    options: argparse.Namespace,
    stage: Stage,
    number: int,
    start: Path | None,
    data: Sequence[Path],
    seconds: float,
    *,
    last: bool,
) -> Path | None:
    """Train on some datasets for `seconds`, from weights or from scratch; returns the mean weights.

    If it ended before anything was saved, it returns the weights that it started with.
    """
    run: Path = options.out / f"round_{number}"
    weights = run.with_suffix(".safetensors")
    if weights.is_file():
        return weights
    settings = (*stage.settings, *(stage.last if last else ()))
    if options.miniature:
        settings = (*settings, *TINY_SETTINGS)
    new = ["--recipe", str(HERE / "recipes" / stage.recipe), "--init", str(start or RANDOM)]
    new += ["--seed", str(100 * options.seed + number)]
    new += [word for setting in settings for word in ("--set", setting)]
    if number > 1:
        new += ["--set", "warmup_steps=50"]
    new += [word for folder in data for word in ("--data", str(folder))]
    begun = time.monotonic()
    try:
        grace_s = 60.0 if options.miniature else GRACE_S
        clock = Clock(seconds / 60, options.gpus.split(","), grace_s=grace_s)
        always = ["--workers", str(options.loaders), "--out", str(run)]
        clock.train(*always, *(["--resume"] if resumable(run) else new))
    except TimeIsUpError:
        pass
    if not resumable(run):
        note(options.out, f"round {number}", "ended before anything was saved")
        return start
    row = write_mean(run, weights, f"training stage {stage.name} of scripts/legs.toml, round {number}")
    images = sum(len(open_dataset(folder).read("train").images) for folder in data)
    seconds = round(time.monotonic() - begun)
    visits = row["epochs"] * images + row["steps_of_the_last"] * row["batch_size"]
    note(options.out, f"round {number}", {"images": images, "visits": visits, "seconds": seconds, **row})
    return weights


def write_mean(run: Path, out: Path, origin: str) -> dict[str, Any]:
    """Write the running mean of a run's weights as a checkpoint; returns the progress of the run."""
    state = torch.load(run / "resume.pt", map_location="cpu", weights_only=True)
    config = DetectorConfig.from_dict(state["detector"])
    model = build(config, trainable_layers=5)
    mean = {key.removeprefix("module."): value for key, value in state["mean"].items() if key.startswith("module.")}
    model.load_state_dict(mean)
    save_weights(out, model, config, {"origin": origin})
    recipe = read_json(run / "recipe.json")["recipe"]
    losses = {name: value / max(1, state["steps_done"]) for name, value in state["sums"].items()}
    return {
        "epochs": state["epochs_done"],
        "steps_of_the_last": state["steps_done"],
        "batch_size": recipe["batch_size"],
        "epochs_losses": state["history"],
        "losses_of_the_last": losses,
    }


# ----------------------------------------------------------------------------------------------------------- measuring


def measure(options: argparse.Namespace, forms: Mapping[str, Path], seconds: float) -> dict[str, Any]:
    """Measure each form of the weights on the tests that exist; returns the figures."""
    _, tests = read_stages()
    commands, outs = [], {}
    for form, weights in forms.items():
        for name, test in tests.items():
            if not (options.data / name / CARD_FILE).is_file():
                continue
            out = options.out / "measured" / form / name
            outs[form, name] = out
            if not (out / "metrics.json").is_file():
                arguments = [
                    "--data",
                    str(options.data / name),
                    "--checkpoint",
                    str(weights),
                    "--split",
                    test["splits"],
                ]
                commands.append(["eval", *arguments, "--out", str(out), "--batch-size", "8"])
    gpus = options.gpus.split(",")
    clock = Clock(seconds / 60, gpus)
    try:
        for first in range(0, len(commands), 2 * len(gpus)):
            clock.run(*commands[first : first + 2 * len(gpus)])
    except TimeIsUpError:
        print("time limit reached: not all tests are measured")
    found: dict[str, Any] = {}
    for (form, name), out in outs.items():
        if (out / "metrics.json").is_file():
            splits = read_json(out / "metrics.json")["splits"]
            found.setdefault(form, {})[name] = {split: in_short(figures) for split, figures in splits.items()}
    return found


def in_short(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Return the figures of a split by which stages are compared."""
    return {
        "box_ap50": figures["coco"]["box_ap50"],
        "keypoint_ap50": figures["coco"]["keypoint_ap50"],
        "recall_at_precision": figures["recall_at_precision"],
        "pck": figures["iou"]["0.6"]["pck"],
        "boxes": {
            iou: {name: at[name]["paper"] for name in ("box_precision", "box_recall")}
            for iou, at in figures["iou"].items()
        },
        "ap50_of": {name: sizes["all"]["ap50"] for name, sizes in figures.get("categories", {}).items()},
    }


# ------------------------------------------------------------------------------------------------------------- packing


def pack(weights: Path, out: Path) -> None:
    """Write a checkpoint in 16 bits and in parts, with checksums for `join`."""
    header, state = read_checkpoint(weights)
    kept = {name: value.half() if halved(value) else value for name, value in state.items()}
    whole = serialized(kept, {HEADER_FIELD: json.dumps(header)})
    out.mkdir(parents=True, exist_ok=True)
    parts = []
    for number, first in enumerate(range(0, len(whole), PART_BYTES), start=1):
        part = whole[first : first + PART_BYTES]
        name = f"part_{number:02d}"
        write_bytes(out / name, part)
        parts.append({"name": name, "bytes": len(part), "sha256": hashlib.sha256(part).hexdigest()})
    write_json(out / PARTS, {"bytes": len(whole), "sha256": hashlib.sha256(whole).hexdigest(), "parts": parts})


def halved(value: torch.Tensor) -> bool:
    """Return whether a tensor is packed in 16 bits: matrices and kernels are, norms, biases and counts are not."""
    return value.is_floating_point() and value.dim() > 1


def join(folder: Path, out: Path) -> None:
    """Join the parts of `pack` to a checkpoint in float32.

    Raises UserError, with the name of the part, if one is missing or damaged.
    """
    manifest = read_json(folder / PARTS)
    whole = bytearray()
    for part in manifest["parts"]:
        path = folder / part["name"]
        if not path.is_file():
            raise UserError(f"{path}: missing; copy it again")
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != part["sha256"]:
            raise UserError(f"{path}: damaged (not the SHA-256 of {PARTS}); copy it again")
        whole += data
    if hashlib.sha256(whole).hexdigest() != manifest["sha256"]:
        raise UserError(f"{folder}: the joined parts are not the file that was packed")
    length = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + length])["__metadata__"]
    state = {name: value.float() if halved(value) else value for name, value in deserialized(bytes(whole)).items()}
    write_bytes(out, serialized(state, header))


# -------------------------------------------------------------------------------------------------------------- stage


def note(out: Path, key: str, values: Any) -> None:
    """Add an entry to leg.json."""
    path = out / "leg.json"
    write_json(path, {**(read_json(path) if path.is_file() else {}), key: values})


def begin(options: argparse.Namespace, stage: Stage) -> Path | None:
    """Return the weights that a stage starts with; None: random weights."""
    note(options.out, "start", "previous stage" if options.state else str(options.init or stage.start))
    if not options.state:
        return find_checkpoint(options.init) if options.init else None
    start: Path = options.out / "start.safetensors"
    if not start.is_file():
        join(options.state, start)
    return start


def run(options: argparse.Namespace) -> None:
    """Run a training stage."""
    end = time.monotonic() + 60 * options.minutes
    stages, tests = read_stages()
    stage = stages[options.leg]
    if not (stage.start or options.state or options.init):
        raise UserError(f"stage {stage.name} starts from weights: pass --state (the previous stage) or --init (others)")
    options.out.mkdir(parents=True, exist_ok=True)
    wanted = dict(stage.places)
    training_places = list(wanted)
    # Most rounds need more places than the round before, and need them earlier than the tests.
    order = [*training_places[:TESTS_AFTER], *tests, *training_places[TESTS_AFTER:]]
    wanted |= {name: test["places"] for name, test in tests.items()}
    places = Places(options.data, {name: placed(wanted[name], options.miniature) for name in order}, options.workers)
    try:
        start = begin(options, stage)
        weights, number = start, 0
        learning_ends = end - MEASURING_S
        while (left := learning_ends - time.monotonic()) > LEAST_ROUND_S:
            places.wait_for(training_places[:2], learning_ends)
            here = places.wait_for(training_places, time.monotonic())
            left = learning_ends - time.monotonic()
            if not here or left <= 0:
                break
            number += 1
            last = left < 1.5 * ROUND_S
            data, seconds = [options.data / name for name in here], left if last else ROUND_S
            weights = train_round(options, stage, number, weights, data, seconds, last=last)
        places.wait_for(list(tests), time.monotonic() + 5)
    finally:
        places.stop()
    note(options.out, "places", {"drawn": places.drawn, "failed": places.failed})
    if weights is None:
        raise UserError(f"{options.out}: no round saved anything; --minutes {options.minutes:g} is too short")
    pack(weights, options.out / "state")
    forms = {"end": weights}
    if options.measure_start and start is not None:
        forms["start"] = start
    note(options.out, "figures", measure(options, forms, max(30.0, end - time.monotonic())))
    print("done")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    run_parser = commands.add_parser("run", help="run a training stage")
    run_parser.add_argument("leg", choices=tuple(read_stages()[0]), help="name of the stage")
    run_parser.add_argument("--state", type=Path, help="folder with the packed weights of the previous stage")
    run_parser.add_argument("--init", type=Path, help="weights to start from, for a stage without a previous one")
    run_parser.add_argument(
        "--data", type=Path, default=Path("data/legs"), help="folder that contains the dataset folders"
    )
    run_parser.add_argument("--out", type=Path, required=True)
    run_parser.add_argument("--minutes", type=float, default=25.0, help="time of the whole stage")
    run_parser.add_argument("--seed", type=int, default=0, help="a different number gives a different order of images")
    run_parser.add_argument("--gpus", default="0", help="GPU numbers, separated by commas")
    run_parser.add_argument(
        "--workers", type=int, default=2, help="processes that make places; 0: another run makes them"
    )
    run_parser.add_argument("--loaders", type=int, default=8, help="processes per GPU that load images")
    run_parser.add_argument(
        "--measure-start", action="store_true", help="also measure the weights that the stage starts with"
    )
    run_parser.add_argument("--miniature", action="store_true", help="one small frame of each place")
    join_parser = commands.add_parser("join", help="join packed weights")
    join_parser.add_argument("folder", type=Path)
    join_parser.add_argument("--out", type=Path, required=True)
    options = parser.parse_args()
    try:
        if options.command == "join":
            join(options.folder, options.out)
        else:
            run(options)
    except UserError as error:
        parser.exit(2, f"{parser.prog}: {error}\n")


if __name__ == "__main__":
    main()
