"""The run folder: what was asked for, checkpoints, and what `--resume` needs.

    recipe.json            configuration of the run
    epoch_NNN.safetensors  weights after NNN epochs (the newest one only)
    metrics.jsonl          mean losses of each epoch
    resume.pt              optimiser, and the epoch whose weights belong to it

A checkpoint is written before the resume.pt that names it, and older ones are removed after that: whenever the
process is killed, resume.pt and the checkpoint that it names lie there whole.
"""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

import torch
from torchvision.models.detection import KeypointRCNN

from skope import detector, keypoints
from skope.detector import DetectorConfig
from skope.errors import UserError
from skope.files import read_json, replacing, write_json, write_text
from skope.train.recipe import Recipe

_VERSION = 1
_CONFIG = "recipe.json"
_METRICS = "metrics.jsonl"
_RESUME = "resume.pt"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Everything that shapes the result of a run."""

    recipe: Recipe
    init: str
    seed: int
    data: str
    """Dataset folder."""
    max_images: int | None

    def to_dict(self) -> dict[str, Any]:
        return {
            "version": _VERSION,
            "scheme": keypoints.SCHEME,
            "recipe": self.recipe.to_dict(),
            "init": self.init,
            "seed": self.seed,
            "data": self.data,
            "max_images": self.max_images,
        }

    @classmethod
    def read(cls, run: Path) -> Self:
        """The configuration that a run folder records."""
        values = read_json(run / _CONFIG)
        try:
            if not isinstance(values, dict) or values.get("version") != _VERSION:
                raise UserError(f"version: expected {_VERSION}")
            names = ("init", "seed", "data", "max_images")
            return cls(recipe=Recipe.from_dict(values["recipe"]), **{name: values[name] for name in names})
        except KeyError as error:
            raise UserError(f"{run / _CONFIG}: field {error.args[0]} is missing") from None
        except UserError as error:
            raise UserError(f"{run / _CONFIG}: {error}") from None


@dataclass
class Training:
    """A run in progress: what changes from step to step."""

    model: KeypointRCNN
    config: DetectorConfig
    optimizer: torch.optim.SGD
    origin: str
    """Where the first weights came from, in words."""
    epochs_done: int
    history: list[dict[str, float]]
    """Mean losses of the epochs so far."""


def resumable(run: Path) -> bool:
    """Whether a run folder holds an epoch to resume from."""
    return (run / _RESUME).is_file()


def start(run: Path, config: RunConfig, device: torch.device) -> Training:
    """Begin a run in a folder that holds none."""
    if resumable(run) or detector.checkpoints(run):
        raise UserError(f"{run}: holds a run already; go on with it by --resume, or choose another folder by --out")
    recipe = config.recipe
    model, detector_config, origin = detector.initialise(
        config.init,
        min_size=recipe.min_size,
        max_size=recipe.max_size,
        trainable_layers=recipe.trainable_layers,
        seed=config.seed,
    )
    model.to(device)
    write_json(run / _CONFIG, config.to_dict())
    return Training(model, detector_config, _optimizer(model, recipe), origin, 0, [])


def resume(run: Path, config: RunConfig, device: torch.device) -> Training:
    """Take up the run in a folder after the last epoch that it saved."""
    path = run / _RESUME
    if not resumable(run):
        raise UserError(f"{run}: no finished epoch to resume from ({_RESUME} is missing); leave out --resume")
    try:
        saved = torch.load(path, map_location=device, weights_only=True)
        epochs_done, optimizer_state = int(saved["epochs_done"]), saved["optimizer"]
    except Exception as error:  # torch.load raises whatever the broken archive or pickle led to
        raise UserError(f"{path}: cannot be read ({(str(error).splitlines() or [''])[0]})") from None
    if epochs_done > config.recipe.epochs:
        raise UserError(f"--epochs {config.recipe.epochs}: the run in {run} has {epochs_done} epochs behind it already")
    model, detector_config, metadata = detector.load_weights(
        run / detector.checkpoint_name(epochs_done), device, trainable_layers=config.recipe.trainable_layers
    )
    optimizer = _optimizer(model, config.recipe)
    try:
        optimizer.load_state_dict(optimizer_state)
    except (ValueError, KeyError) as error:
        raise UserError(f"{path}: does not fit the run's recipe ({error})") from None
    write_json(run / _CONFIG, config.to_dict())
    return Training(model, detector_config, optimizer, metadata["origin"], epochs_done, _history(run, epochs_done))


def save(run: Path, config: RunConfig, training: Training) -> Path:
    """Write the state after an epoch; returns the checkpoint."""
    done = training.epochs_done
    checkpoint = run / detector.checkpoint_name(done)
    metadata = {"run": config.to_dict(), "epoch": done, "origin": training.origin}
    detector.save_weights(checkpoint, training.model, training.config, metadata)
    write_text(run / _METRICS, "".join(json.dumps(row) + "\n" for row in training.history))
    with replacing(run / _RESUME) as temporary:
        torch.save({"epochs_done": done, "optimizer": training.optimizer.state_dict()}, temporary)
    for epoch, path in detector.checkpoints(run).items():
        if epoch != done:
            path.unlink()
    return checkpoint


def _optimizer(model: KeypointRCNN, recipe: Recipe) -> torch.optim.SGD:
    return torch.optim.SGD(
        [parameter for parameter in model.parameters() if parameter.requires_grad],
        lr=recipe.learning_rate,
        momentum=recipe.momentum,
        weight_decay=recipe.weight_decay,
    )


def _history(run: Path, epochs: int) -> list[dict[str, float]]:
    path = run / _METRICS
    try:
        rows = [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]
        return [row for row in rows if row["epoch"] <= epochs]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: cannot be read ({error})") from None
