"""Train a shipped detector for as long as a machine is to be had: one leg, whole, within a time that is told.

    python scripts/train_leg.py run 2 --state runs/legs/1 --minutes 24 --gpus 0,1 --out runs/legs/2
    python scripts/train_leg.py join runs/legs/2 --out road33_2.safetensors

A leg (legs.toml) goes on from the weights of the one before. Its places are simulated and drawn beside the training,
which runs in rounds: each learns from all that is drawn when it begins, at a constant rate (recipes/), and
hands the running mean of its weights to the next; the last one may have a lower rate. At the end the tests are
measured, and the weights are packed for the way: in 16 bits, norms and counts as they are, in parts of at most 15 MiB
with their SHA-256 in parts.json. `join` puts them together again where all are there and whole. leg.json has what was
done and found.

Legs that have the same places can learn side by side, each on a GPU of its own: one makes them, the others run with
--workers 0 and the same --data.

What is finished is not done again: after an interruption the same command goes on. --miniature tries a leg on a laptop.
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
"""A round lasts so long, the last one until training has to end."""
LEAST_ROUND_S: Final = 60.0
MEASURING_S: Final = 150.0
"""Of a leg's time, for measuring and packing."""
RANDOM: Final = "random"
"""Where a leg begins from nothing."""
AT_ONCE: Final = 4
"""Datasets that are simulated side by side."""
TESTS_AFTER: Final = 5
"""So many datasets to learn from are made before the tests."""
TINY_PLACES: Final = {"--frames": "1", "--size": "480x270"}
TINY_SETTINGS: Final = ("min_size=120", "max_size=214", "batch_size=1", "bfloat16=false", "keypoint_regions=4")
"""What --miniature sets otherwise."""


@dataclass(frozen=True)
class Leg:
    """What a leg learns from, and from where it goes on."""

    name: str
    start: str
    """`RANDOM`, or empty: it goes on from the weights of --init, or of the leg before, --state."""
    places: Mapping[str, str]
    """Datasets: name -> options of `skope gen simulate`."""
    recipe: str
    """A recipe's file beside this one."""
    settings: tuple[str, ...] = ()
    """Values of the recipe, as --set takes them."""
    last: tuple[str, ...] = ()
    """More of them, for the last round."""


def named_places(row: Mapping[str, Any], lists: Mapping[str, Sequence[str]]) -> dict[str, str]:
    """A leg's datasets by name: a list of its own, or the name of the leg that has it."""
    owner = row["places"] if isinstance(row["places"], str) else row["name"]
    return {f"leg_{owner}_{number}": text for number, text in enumerate(lists[owner], start=1)}


def read_legs(path: Path = HERE / "legs.toml") -> tuple[dict[str, Leg], dict[str, dict[str, str]]]:
    """The legs by name, and the tests: dataset -> its `places` and `splits`."""
    values = tomllib.loads(path.read_text())
    own = {row["name"]: row["places"] for row in values["legs"] if isinstance(row["places"], list)}
    legs = [
        Leg(
            name=row["name"],
            start=row.get("start", ""),
            places=named_places(row, own),
            recipe=row.get("recipe", "leg.toml"),
            settings=tuple(row.get("settings", ())),
            last=tuple(row.get("last", ())),
        )
        for row in values["legs"]
    ]
    return {leg.name: leg for leg in legs}, values["tests"]


# ------------------------------------------------------------------------------------------------------------- places


class Places:
    """Datasets that are simulated and drawn beside whatever else the machine does, in their order."""

    def __init__(self, folder: Path, wanted: Mapping[str, str], workers: int) -> None:
        """Begin with the datasets of `wanted`, name -> options of `skope gen simulate`; 0 workers: others make them."""
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
        """Names of the datasets that are there."""
        return [name for name in self._wanted if (self._folder / name / CARD_FILE).is_file()]

    def _simulate(self, name: str, options: str) -> None:
        share = str(max(1, self._workers // AT_ONCE))
        words = [*options.split(), "--no-depth", "--workers", share, "--out", str(self._folder / name)]
        self._skope("10", "gen", "simulate", "-q", *words)

    def _draw(self, simulated: Mapping[str, Future[None]]) -> None:
        """Draw one after the other what is simulated."""
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
        """Run a command, kinder to the machine than the training."""
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
        """Those of `names` that are drawn, as soon as all are, or nothing more comes, or it is `until`, monotonic."""
        with self._changed:
            while not set(names) <= set(self.drawn) and self._left and time.monotonic() < until:
                self._changed.wait(1.0)
            return [name for name in names if name in self.drawn]

    def stop(self) -> None:
        """End what is being made; what is half made goes on another time."""
        self._stopped = True
        for process in list(self._running):
            process.terminate()
        self._simulating.shutdown(cancel_futures=True)
        self._drawing.join()


def placed(options: str, miniature: bool) -> str:
    """Options of a dataset's places, with the sites' names, and in a miniature fewer and smaller."""
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
    leg: Leg,
    number: int,
    start: Path | None,
    data: Sequence[Path],
    seconds: float,
    *,
    last: bool,
) -> Path | None:
    """Train on some datasets for so long, from weights or from nothing; returns the mean weights.

    Where it ended before anything was saved, these are those that it began with.
    """
    run: Path = options.out / f"round_{number}"
    weights = run.with_suffix(".safetensors")
    if weights.is_file():
        return weights
    settings = (*leg.settings, *(leg.last if last else ()))
    if options.miniature:
        settings = (*settings, *TINY_SETTINGS)
    new = ["--recipe", str(HERE / "recipes" / leg.recipe), "--init", str(start or RANDOM), "--seed", str(number)]
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
    row = write_mean(run, weights, f"round {number} of leg {leg.name}")
    images = sum(len(open_dataset(folder).read("train").images) for folder in data)
    seconds = round(time.monotonic() - begun)
    visits = row["epochs"] * images + row["steps_of_the_last"] * row["batch_size"]
    note(options.out, f"round {number}", {"images": images, "visits": visits, "seconds": seconds, **row})
    return weights


def write_mean(run: Path, out: Path, origin: str) -> dict[str, Any]:
    """Write the running mean of a run's weights as a checkpoint; returns how far the run has come."""
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
    """Figures of the tests that are there, of each form of the weights."""
    _, tests = read_legs()
    commands, outs = [], {}
    for form, weights in forms.items():
        for name, test in tests.items():
            if not (options.data / name / CARD_FILE).is_file():
                continue
            out = options.out / "measured" / form / name
            outs[form, name] = out
            if not (out / "metrics.json").is_file():
                what = ["--data", str(options.data / name), "--checkpoint", str(weights), "--split", test["splits"]]
                commands.append(["eval", *what, "--out", str(out), "--batch-size", "8"])
    gpus = options.gpus.split(",")
    clock = Clock(seconds / 60, gpus)
    try:
        for first in range(0, len(commands), 2 * len(gpus)):
            clock.run(*commands[first : first + 2 * len(gpus)])
    except TimeIsUpError:
        print("time is up: not all tests are measured")
    found: dict[str, Any] = {}
    for (form, name), out in outs.items():
        if (out / "metrics.json").is_file():
            splits = read_json(out / "metrics.json")["splits"]
            found.setdefault(form, {})[name] = {split: in_short(figures) for split, figures in splits.items()}
    return found


def in_short(figures: Mapping[str, Any]) -> dict[str, Any]:
    """Of a split's figures those that legs are compared by."""
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
    """Write a checkpoint in 16 bits, in parts, with what `join` checks."""
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
    """Whether a tensor travels in 16 bits: matrices and kernels do, norms, biases and counts do not."""
    return value.is_floating_point() and value.dim() > 1


def join(folder: Path, out: Path) -> None:
    """Put the parts of `pack` together as a checkpoint in float32.

    Raises UserError where a part is missing or is not what was packed, with its name.
    """
    manifest = read_json(folder / PARTS)
    whole = bytearray()
    for part in manifest["parts"]:
        path = folder / part["name"]
        if not path.is_file():
            raise UserError(f"{path}: missing; bring it again")
        data = path.read_bytes()
        if hashlib.sha256(data).hexdigest() != part["sha256"]:
            raise UserError(f"{path}: damaged (not the SHA-256 of {PARTS}); bring it again")
        whole += data
    if hashlib.sha256(whole).hexdigest() != manifest["sha256"]:
        raise UserError(f"{folder}: the parts do not make the file that was packed")
    length = int.from_bytes(whole[:8], "little")
    header = json.loads(whole[8 : 8 + length])["__metadata__"]
    state = {name: value.float() if halved(value) else value for name, value in deserialized(bytes(whole)).items()}
    write_bytes(out, serialized(state, header))


# ---------------------------------------------------------------------------------------------------------------- leg


def note(out: Path, what: str, values: Any) -> None:
    """Add to leg.json."""
    path = out / "leg.json"
    write_json(path, {**(read_json(path) if path.is_file() else {}), what: values})


def begin(options: argparse.Namespace, leg: Leg) -> Path | None:
    """The weights that a leg begins with; None: it begins from nothing."""
    note(options.out, "start", "the leg before" if options.state else str(options.init or leg.start))
    if not options.state:
        return find_checkpoint(options.init) if options.init else None
    start: Path = options.out / "start.safetensors"
    if not start.is_file():
        join(options.state, start)
    return start


def run(options: argparse.Namespace) -> None:
    """A leg."""
    end = time.monotonic() + 60 * options.minutes
    legs, tests = read_legs()
    leg = legs[options.leg]
    if not (leg.start or options.state or options.init):
        raise UserError(f"leg {leg.name} goes on from weights: --state names those of the leg before, --init others")
    options.out.mkdir(parents=True, exist_ok=True)
    wanted = dict(leg.places)
    learnt = list(wanted)
    # Most rounds need other places than the one before, more than the tests are needed before the end.
    order = [*learnt[:TESTS_AFTER], *tests, *learnt[TESTS_AFTER:]]
    wanted |= {name: test["places"] for name, test in tests.items()}
    places = Places(options.data, {name: placed(wanted[name], options.miniature) for name in order}, options.workers)
    try:
        start = begin(options, leg)
        weights, number = start, 0
        learning_ends = end - MEASURING_S
        while (left := learning_ends - time.monotonic()) > LEAST_ROUND_S:
            places.wait_for(learnt[:2], learning_ends)
            here = places.wait_for(learnt, time.monotonic())
            left = learning_ends - time.monotonic()
            if not here or left <= 0:
                break
            number += 1
            last = left < 1.5 * ROUND_S
            data, seconds = [options.data / name for name in here], left if last else ROUND_S
            weights = train_round(options, leg, number, weights, data, seconds, last=last)
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
    one = commands.add_parser("run", help="do a leg")
    one.add_argument("leg", choices=tuple(read_legs()[0]))
    one.add_argument("--state", type=Path, help="folder of the packed weights of the leg before")
    one.add_argument("--init", type=Path, help="weights to begin with, of a leg before which there is none")
    one.add_argument("--data", type=Path, default=Path("data/legs"), help="folder of the datasets' folders")
    one.add_argument("--out", type=Path, required=True)
    one.add_argument("--minutes", type=float, default=25.0, help="the whole leg's time")
    one.add_argument("--gpus", default="0", help="numbers, separated by commas")
    one.add_argument("--workers", type=int, default=2, help="processes that make places; 0: another run does")
    one.add_argument("--loaders", type=int, default=8, help="processes that load images, a GPU")
    one.add_argument("--measure-start", action="store_true", help="measure the weights that the leg begins with too")
    one.add_argument("--miniature", action="store_true", help="the same with a frame of each place, small")
    two = commands.add_parser("join", help="put packed weights together")
    two.add_argument("folder", type=Path)
    two.add_argument("--out", type=Path, required=True)
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
