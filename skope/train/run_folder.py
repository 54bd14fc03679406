"""The run folder: its checkpoints, and room for them.

    recipe.json               configuration of the run
    epoch_NNN.safetensors     weights after NNN epochs (the newest ones)
    best.safetensors          weights of the epoch with the best validation
    metrics.jsonl             losses and validation of each epoch
    resume.pt                 the whole state: weights, optimiser, position in the epoch, history, best figure
    README.md, curves.png, progress/, tensorboard/    the model card, and what lets one see it learn

`skope.train.training_state` says what a run goes on from.
"""

import contextlib
import json
import shutil
from collections.abc import Iterable, Iterator
from pathlib import Path

from torch import Tensor

from skope.detector.checkpoint import BEST, checkpoint_name, checkpoints, read_checkpoint, save_weights
from skope.errors import UserError
from skope.files.atomic import locked, unwritable, write_text
from skope.terminal.console import disk_size
from skope.train import validate
from skope.train.run_config import RunConfig
from skope.train.training_state import TrainingState, save_state

_METRICS = "metrics.jsonl"


@contextlib.contextmanager
def exclusive(run: Path) -> Iterator[None]:
    """Keep other processes from training in the same folder; one that was made for it and stays empty goes again."""
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
                with contextlib.suppress(OSError):  # not empty any more: it holds the run
                    run.rmdir()


def check_room(run: Path, training: TrainingState, *, keep: int) -> None:
    """Raise a UserError where the disk has no room for what a run keeps: better now than after hours.

    At most there are `keep` checkpoints and a new one, the best one, and the state twice, while it is replaced.
    """
    weights = _size(training.shown.state_dict().values())
    learning = _size(p for p in training.model.parameters() if p.requires_grad)  # the optimiser's momentum
    state = _size(training.model.state_dict().values()) + learning + (weights if training.mean is not None else 0)
    needed = (keep + 2) * weights + 2 * state
    there = sum(path.stat().st_size for path in run.iterdir() if path.is_file()) if run.is_dir() else 0
    free = shutil.disk_usage(next(path for path in (run, *run.absolute().parents) if path.is_dir())).free
    if free + there < needed:
        raise UserError(
            f"{run}: {disk_size(free)} free on its disk, and this run writes up to {disk_size(needed - there)} there; "
            "make room, or choose another folder by --out"
        )


def _size(tensors: Iterable[Tensor]) -> int:
    return sum(tensor.numel() * tensor.element_size() for tensor in tensors)


def save_epoch(run: Path, config: RunConfig, training: TrainingState, *, keep: int) -> Path:
    """Write the state after an epoch and its checkpoint, of which the newest `keep` stay; returns the checkpoint."""
    checkpoint = run / checkpoint_name(training.epochs_done)
    _save_weights(checkpoint, config, training)
    write_text(run / _METRICS, "".join(json.dumps(row) + "\n" for row in training.history))
    save_state(run, training)
    older = [epoch for epoch in checkpoints(run) if epoch <= training.epochs_done][:-keep]
    for epoch, path in checkpoints(run).items():
        if epoch in older or epoch > training.epochs_done:
            path.unlink()
    return checkpoint


def save_best(run: Path, config: RunConfig, training: TrainingState) -> None:
    """Write the weights of the epoch with the best validation so far."""
    _save_weights(run / BEST, config, training)


def ensure_best(run: Path, config: RunConfig, training: TrainingState) -> None:
    """Write the best checkpoint of a resumed run where the last epoch is the best, and that stopped before it was
    written: the state is written first, since what is lost with it cannot be made again."""
    ranks = [validate.rank(row["validation"]) for row in training.history if "validation" in row]
    last = bool(training.history) and "validation" in training.history[-1]
    if training.steps_done or not last or ranks[-1] != training.best or training.best in ranks[:-1]:
        return
    if not (run / BEST).is_file() or read_checkpoint(run / BEST)[0]["metadata"]["epoch"] < training.epochs_done:
        save_best(run, config, training)


def _save_weights(path: Path, config: RunConfig, training: TrainingState) -> None:
    metadata = {"run": config.to_dict(), "epoch": training.epochs_done, "origin": training.origin}
    save_weights(path, training.shown, training.config, metadata)
