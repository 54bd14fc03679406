"""State of a training run and resuming from it: weights, optimiser, position in the epoch, history, best validation.

A run resumes from `resume.pt` alone, which is replaced atomically. A run that is killed at any moment resumes from it
and rewrites later files. The state of each random generator follows from seed, epoch and step.
"""

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch.optim.swa_utils import AveragedModel
from torchvision.models.detection import KeypointRCNN

from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import checkpoints
from skope.errors import UserError
from skope.files.atomic import write_bytes
from skope.train import init_weights
from skope.train.optimizer import make_sgd, make_weight_ema, placed
from skope.train.run_config import RunConfig
from skope.train.teacher import Teacher

STATE_FILE = "resume.pt"
STATE_FIELDS = ("origin", "fingerprints", "epochs_done", "steps_done", "sums", "history", "best")


@dataclass
class TrainingState:
    """State of a run: model, optimiser, and progress."""

    model: KeypointRCNN
    config: DetectorConfig
    optimizer: torch.optim.SGD
    origin: str
    """Origin of the initial weights, in words."""
    fingerprints: list[str]
    """Digest of each dataset, in their order."""
    epochs_done: int
    steps_done: int
    """Number of steps done in the current epoch."""
    sums: dict[str, float]
    """Sums of the losses in the current epoch."""
    history: list[dict[str, Any]]
    """Mean losses and validation of the completed epochs."""
    best: list[float] | None
    """Validation metrics of the best epoch, as returned by `skope.train.validate.rank`."""
    mean: AveragedModel | None = None
    """Running mean of the model over the steps, if the recipe requests it."""
    teacher: Teacher | None = None
    """Detector for distillation; it is not saved."""

    @property
    def shown(self) -> KeypointRCNN:
        """Model that is validated and saved."""
        return self.model if self.mean is None else self.mean.module

    def state(self) -> dict[str, Any]:
        """Return the state for `resume.pt`."""
        return {
            "model": self.model.state_dict(),
            "detector": self.config.to_dict(),
            "optimizer": self.optimizer.state_dict(),
            "mean": None if self.mean is None else self.mean.state_dict(),
            **{name: getattr(self, name) for name in STATE_FIELDS},
        }


def resumable(run: Path) -> bool:
    """Return whether a run folder contains a state to resume from."""
    return (run / STATE_FILE).is_file()


def start(run: Path, config: RunConfig, fingerprints: Sequence[str], device: torch.device) -> TrainingState:
    """Begin a run in a folder without a run.

    Args:
        run: The run folder.
        config: Its configuration.
        fingerprints: Digest of each dataset.
        device: Device for training.

    Raises:
        UserError: The folder contains a run or other files.
    """
    if resumable(run):
        raise UserError(f"{run}: already holds a run; resume it with --resume, or choose another folder with --out")
    if checkpoints(run):
        raise UserError(
            f"{run}: holds checkpoints but no state to resume from ({STATE_FILE} is missing); choose another folder by "
            "--out"
        )
    # If several processes train together, the first one may already have written the configuration.
    if run.is_dir() and any(run.glob("[!.]*")) and not _begun(run):
        raise UserError(
            f"{run}: holds other files and no run; choose another folder by --out, or move its content away"
        )
    recipe = config.recipe
    model, detector_config, origin = init_weights.initialise(
        recipe.init,
        norm=recipe.norm,
        min_size=recipe.min_size,
        max_size=recipe.max_size,
        trainable_layers=recipe.trainable_layers,
        seed=config.seed,
        scheme=config.scheme,
        anchors=recipe.anchors,
        box_passes=recipe.box_passes,
        categories=config.detector_categories,
        network=recipe.network,
    )
    model = placed(model, recipe, device)
    sgd, mean = make_sgd(model, recipe), make_weight_ema(model, recipe)
    return TrainingState(model, detector_config, sgd, origin, list(fingerprints), 0, 0, {}, [], None, mean)


def _begun(run: Path) -> bool:
    """Return whether a folder is that of a run that has saved nothing yet."""
    try:
        RunConfig.read(run)
    except UserError:
        return False
    return True


def resume(run: Path, config: RunConfig, fingerprints: Sequence[str], device: torch.device) -> TrainingState:
    """Resume the run in a folder from its last saved state.

    Args:
        run: The run folder.
        config: Its configuration.
        fingerprints: Current digest of each dataset.
        device: Device for training.

    Raises:
        UserError: Nothing was saved, a dataset has changed since, or the run has completed more epochs than `config`
            requests.
    """
    path = run / STATE_FILE
    if not resumable(run):
        raise UserError(f"{run}: nothing saved yet to resume from ({STATE_FILE} is missing); leave out --resume")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        plain = {name: saved[name] for name in STATE_FIELDS}
        detector_config = DetectorConfig.from_dict(saved["detector"])
        model = build(detector_config, trainable_layers=config.recipe.trainable_layers)
        model.load_state_dict(saved["model"])
    except Exception as error:  # torch.load raises various exceptions for broken archives and pickles
        raise UserError(f"{path}: cannot be read ({(str(error).splitlines() or [''])[0]})") from None
    for data, then, now in zip(config.data, plain["fingerprints"], fingerprints, strict=True):
        if then != now:
            raise UserError(
                f"{data}: is not the dataset that the run in {run} began with (annotations or images differ)"
            )
    done = plain["epochs_done"]
    if done > config.recipe.epochs:
        raise UserError(f"--epochs {config.recipe.epochs}: the run in {run} has {done} epochs behind it already")
    model = placed(model, config.recipe, device)
    sgd = make_sgd(model, config.recipe)
    mean = make_weight_ema(model, config.recipe)
    try:
        sgd.load_state_dict(saved["optimizer"])
        if mean is not None:
            mean.load_state_dict(saved["mean"])
    except (ValueError, KeyError, TypeError, RuntimeError) as error:
        raise UserError(f"{path}: does not fit the run's recipe ({error})") from None
    return TrainingState(model, detector_config, sgd, mean=mean, **plain)


def save_state(run: Path, training: TrainingState) -> None:
    """Write the state for `resume`."""
    # Through memory, because torch's own writer ends the process if the disk is full.
    buffer = io.BytesIO()
    torch.save(training.state(), buffer)
    write_bytes(run / STATE_FILE, buffer.getbuffer())
