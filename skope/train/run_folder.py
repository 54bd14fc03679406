"""The run folder: its checkpoints with their model card, and room for them.

    recipe.json               configuration of the run
    epoch_NNN.safetensors     weights after NNN epochs (the newest ones)
    best.safetensors          weights of the epoch with the best validation
    metrics.jsonl             losses and validation of each epoch
    resume.pt                 the whole state: weights, optimiser, position in the epoch, history, best validation
    README.md, curves.png, progress/, tensorboard/    the model card, and what lets one see it learn

`skope.train.training_state` defines what a run resumes from.
"""

import contextlib
import json
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from skope import keypoints
from skope.dataset.folder import Dataset
from skope.detector.checkpoint import BEST_WEIGHTS, checkpoint_name, checkpoints, read_checkpoint, save_weights
from skope.errors import UserError
from skope.files.atomic import locked, unwritable, write_text
from skope.terminal.console import counted, disk_size
from skope.train import validate
from skope.train.run_config import RunConfig
from skope.train.training_state import TrainingState, save_state
from skope.train.validate import rank
from skope.version import __version__

WEIGHT_LICENCES = (
    ("COCO", "weights published with torchvision (BSD-3-Clause), trained on COCO's photographs (Flickr's terms)"),
    ("ImageNet", "weights published with torchvision (BSD-3-Clause), trained on ImageNet (research only)"),
    ("random", "nothing but the seed"),
)


def text(
    config: RunConfig,
    training: TrainingState,
    datasets: Sequence[Dataset],
    counts: Sequence[tuple[int, int]],
    road_user_count: int = 0,
) -> str:
    """Return the model card as Markdown.

    Args:
        config: Configuration of the run.
        training: State of the run.
        datasets: Training datasets.
        counts: Number of images and vehicles from each dataset.
        road_user_count: Number of all other road users.
    """
    recipe = config.recipe
    lines = [
        "# Vehicle keypoint detector",
        "",
        f"torchvision's Keypoint R-CNN ({training.config.architecture}), {_classes(config)}, {keypoints.K} keypoints "
        f"(`{config.scheme.name}`), "
        f"{training.config.norm} normalisation with eps {training.config.norm_eps:g}, images at a short side of "
        f"{training.config.min_size} px. Trained by skope {__version__}, {training.epochs_done} of {recipe.epochs} "
        "epochs.",
        "",
        "## Data",
        "",
        "| dataset | images | vehicles | keypoints learnt | licence |",
        "|---|---|---|---|---|",
        *(
            f"| {root} | {images} | {vehicles} | {recipe.supervise} | {dataset.licence.replace('|', '/')} |"
            for root, dataset, (images, vehicles) in zip(config.data, datasets, counts, strict=True)
        ),
        "",
        *_road_users(config, road_user_count),
        *([f"The first dataset gives {config.mix:.0%} of an epoch's images.", ""] if config.mix is not None else []),
        "## Initial weights",
        "",
        f"{training.origin}: {_terms(training.origin)}.",
        "",
        "## Figures",
        "",
        *_figures(training.history),
        "",
        "## Recipe",
        "",
        "```",
        *(f"{name} = {value}" for name, value in recipe.to_dict().items()),
        f"seed = {config.seed}",
        "```",
        "",
        "## Limits",
        "",
        "The score is that of a vehicle; a keypoint's own score says how sure the network is, not whether the point is "
        "hidden. The figures hold for images like those validated on: measure on footage of your own before relying on "
        "it (`skope eval`).",
    ]
    return "\n".join(lines) + "\n"


def _classes(config: RunConfig) -> str:
    names = config.detector_categories
    return "one class" if len(names) == 1 else f"{len(names)} classes ({', '.join(names)}; of vehicles alone keypoints)"


def _road_users(config: RunConfig, count: int) -> list[str]:
    names = config.detector_categories[1:]
    return [f"In addition, {counted(count, 'road user')} of the categories {', '.join(names)}.", ""] if names else []


def _terms(origin: str) -> str:
    return next((terms for word, terms in WEIGHT_LICENCES if word in origin), "under the terms of that file")


def _figures(history: Sequence[Mapping[str, Any]]) -> list[str]:
    rows = [row for row in history if "validation" in row]
    if not rows:
        return ["No part of the training recordings was validated on (`val_fraction` is 0)."]
    names = [name for name in rows[-1]["validation"] if name not in ("images", "vehicles")]
    best = max(rows, key=lambda row: rank(row["validation"]))
    images, vehicles = (rows[-1]["validation"][name] for name in ("images", "vehicles"))
    lines = [
        f"On {counted(images, 'image')} with {counted(vehicles, 'vehicle')} at the end of the training recordings, "
        f"score above 0.9, IoU 0.6, alpha 0.1, visible keypoints, pooled; the best epoch's weights are "
        f"`{BEST_WEIGHTS}`.",
        "",
        "| epoch | " + " | ".join(names) + " |",
        "|---" * (len(names) + 1) + "|",
    ]
    for row in {id(row): row for row in (best, rows[-1])}.values():
        values = (row["validation"][name] for name in names)
        lines.append(f"| {row['epoch']} | " + " | ".join("-" if v is None else f"{v:.3f}" for v in values) + " |")
    return lines


METRICS_LOG = "metrics.jsonl"


@contextlib.contextmanager
def exclusive(run: Path) -> Iterator[None]:
    """Lock the run folder against other processes; remove the folder at the end if it is new and still empty."""
    made = not run.exists()
    with contextlib.ExitStack() as held:
        try:
            run.mkdir(parents=True, exist_ok=True)
            held.enter_context(locked(run / ".lock", f"{run}: another `skope train` is writing to this folder"))
        except OSError as error:
            raise unwritable(run, error) from None
        try:
            yield
        finally:
            held.close()
            if made:
                with contextlib.suppress(OSError):  # not empty any more: it contains the run
                    run.rmdir()


def check_room(run: Path, training: TrainingState, *, keep: int) -> None:
    """Raise a UserError if the disk has too little space for the files of a run.

    At most there are `keep` checkpoints and a new one, the best one, and the state twice while it is replaced.
    """
    weights = _size(training.shown.state_dict().values())
    learning = _size(p for p in training.model.parameters() if p.requires_grad)  # momentum of the optimiser
    state = _size(training.model.state_dict().values()) + learning + (weights if training.mean is not None else 0)
    needed = (keep + 2) * weights + 2 * state
    used = sum(path.stat().st_size for path in run.iterdir() if path.is_file()) if run.is_dir() else 0
    free = shutil.disk_usage(next(path for path in (run, *run.absolute().parents) if path.is_dir())).free
    if free + used < needed:
        raise UserError(
            f"{run}: {disk_size(free)} free on its disk, and this run writes up to {disk_size(needed - used)} there; "
            "make room, or choose another folder by --out"
        )


def _size(tensors: Iterable[Tensor]) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def save_epoch(run: Path, config: RunConfig, training: TrainingState, *, keep: int) -> Path:
    """Write state and checkpoint of an epoch, delete all but the newest `keep` checkpoints, and return the new one."""
    checkpoint = run / checkpoint_name(training.epochs_done)
    _save_weights(checkpoint, config, training)
    write_text(run / METRICS_LOG, "".join(json.dumps(row) + "\n" for row in training.history))
    save_state(run, training)
    older = [epoch for epoch in checkpoints(run) if epoch <= training.epochs_done][:-keep]
    for epoch, path in checkpoints(run).items():
        if epoch in older or epoch > training.epochs_done:
            path.unlink()
    return checkpoint


def save_best(run: Path, config: RunConfig, training: TrainingState) -> None:
    """Write the weights of the best epoch so far."""
    _save_weights(run / BEST_WEIGHTS, config, training)


def ensure_best(run: Path, config: RunConfig, training: TrainingState) -> None:
    """Write the best checkpoint of a resumed run if it was stopped before this was written.

    The state is written first, because nothing else can reproduce it.
    """
    ranks = [validate.rank(row["validation"]) for row in training.history if "validation" in row]
    last = bool(training.history) and "validation" in training.history[-1]
    if training.steps_done or not last or ranks[-1] != training.best or training.best in ranks[:-1]:
        return
    if (
        not (run / BEST_WEIGHTS).is_file()
        or read_checkpoint(run / BEST_WEIGHTS)[0]["metadata"]["epoch"] < training.epochs_done
    ):
        save_best(run, config, training)


def _save_weights(path: Path, config: RunConfig, training: TrainingState) -> None:
    metadata = {"run": config.to_dict(), "epoch": training.epochs_done, "origin": training.origin}
    save_weights(path, training.shown, training.config, metadata)
