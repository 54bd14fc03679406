"""The run folder: what was asked for, checkpoints, and what `--resume` needs.

    recipe.json               configuration of the run
    epoch_NNN.safetensors     weights after NNN epochs (the newest ones)
    best.safetensors          weights of the epoch with the best validation
    metrics.jsonl             losses and validation of each epoch
    resume.pt                 the whole state: weights, optimiser, position in the epoch, history, best figure
    README.md, curves.png, progress/, tensorboard/    the model card, and what lets one see it learn

resume.pt alone decides where a run goes on, and is replaced in one step: killed at any moment, a run goes on from it
and writes again what came after. The state of every random generator follows from seed, epoch and step.
"""

import contextlib
import io
import json
import shutil
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel
from torchvision.models.detection import KeypointRCNN

from skope import keypoints
from skope.dataset.folder import Dataset
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import BEST, checkpoint_name, checkpoints, read_checkpoint, save_weights
from skope.errors import UserError
from skope.files.atomic import locked, unwritable, write_bytes, write_text
from skope.files.json_files import read_json, write_json
from skope.keypoints import Scheme
from skope.schema import VEHICLE_ALONE, checked_categories
from skope.terminal.console import disk_size
from skope.train import init_weights, validate
from skope.train.optimizer import make_sgd, make_weight_ema, placed
from skope.train.recipe import Recipe
from skope.train.teacher import Teacher

_RUN_VERSION = 2
_CONFIG = "recipe.json"
_METRICS = "metrics.jsonl"
_RESUME = "resume.pt"


@dataclass(frozen=True, kw_only=True)
class RunConfig:
    """Everything that shapes the result of a run."""

    recipe: Recipe
    seed: int
    data: tuple[str, ...]
    """Dataset folders."""
    mix: float | None
    """Share of an epoch's images that the first dataset gives; None: all images of all datasets once."""
    max_images: int | None
    scheme: Scheme = keypoints.SKOPE33
    """The datasets' keypoint scheme."""
    licences: tuple[str, ...] = ()
    """Licences of the datasets, in their order, as their cards state them."""
    categories: tuple[str, ...] | None = None
    """Names of what is learnt; None: all that the datasets label."""

    def of(self, datasets: Sequence[Dataset], scheme: Scheme, categories: tuple[str, ...]) -> Self:
        """The configuration completed by what the datasets say.

        Images are not mirrored where the mirror partners of the scheme's keypoints are not known.
        """
        recipe = self.recipe
        if scheme.flip is None:
            recipe = replace(recipe, augment=replace(recipe.augment, flip=0.0))
        licences = tuple(d.licence for d in datasets)
        return replace(self, recipe=recipe, scheme=scheme, licences=licences, categories=categories)

    @property
    def detector_categories(self) -> tuple[str, ...]:
        """The categories of the detector that is trained; known once `of` has completed the configuration."""
        assert self.categories is not None
        return self.categories

    def to_dict(self) -> dict[str, Any]:
        return {
            "version": _RUN_VERSION,
            "scheme": self.scheme.name,
            "recipe": self.recipe.to_dict(),
            "seed": self.seed,
            "data": list(self.data),
            "mix": self.mix,
            "max_images": self.max_images,
            "licences": list(self.licences),
            # Runs of before there were other categories do not name theirs.
            **({} if self.categories in (None, VEHICLE_ALONE) else {"categories": list(self.categories)}),
        }

    @classmethod
    def read(cls, run: Path) -> Self:
        """The configuration that a run folder records."""
        values = read_json(run / _CONFIG)
        try:
            if not isinstance(values, dict) or values.get("version") != _RUN_VERSION:
                raise UserError(f"version: expected {_RUN_VERSION}")
            names = ("seed", "mix", "max_images")
            recipe, data = Recipe.from_dict(values["recipe"]), tuple(values["data"])
            categories = checked_categories(values.get("categories", VEHICLE_ALONE))
            return cls(recipe=recipe, data=data, categories=categories, **{name: values[name] for name in names})
        except KeyError as error:
            raise UserError(f"{run / _CONFIG}: field {error.args[0]} is missing") from None
        except UserError as error:
            raise UserError(f"{run / _CONFIG}: {error}") from None


@dataclass
class TrainingState:
    """The state of a run: model, optimiser, and how far it has come."""

    model: KeypointRCNN
    config: DetectorConfig
    optimizer: torch.optim.SGD
    origin: str
    """Origin of the first weights, in words."""
    fingerprints: list[str]
    """Digest of each dataset, in their order."""
    epochs_done: int
    steps_done: int
    """Steps done of the epoch that is under way."""
    sums: dict[str, float]
    """Losses so far of the epoch that is under way."""
    history: list[dict[str, Any]]
    """Mean losses and validation of the epochs so far."""
    best: list[float] | None
    """The figures that decide which epoch is best."""
    mean: AveragedModel | None = None
    """The running mean of the model over the steps, where the recipe asks for one."""
    teacher: Teacher | None = None
    """The detector that it learns from, which is no part of what is saved."""

    @property
    def shown(self) -> KeypointRCNN:
        """The model that is validated and saved."""
        return self.model if self.mean is None else self.mean.module

    def state(self) -> dict[str, Any]:
        """The state as `resume.pt` holds it."""
        return {
            "model": self.model.state_dict(),
            "detector": self.config.to_dict(),
            "optimizer": self.optimizer.state_dict(),
            "mean": None if self.mean is None else self.mean.state_dict(),
            **{name: getattr(self, name) for name in _PLAIN},
        }


_PLAIN = ("origin", "fingerprints", "epochs_done", "steps_done", "sums", "history", "best")


def resumable(run: Path) -> bool:
    """Whether a run folder holds a state to resume from."""
    return (run / _RESUME).is_file()


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


def start(run: Path, config: RunConfig, fingerprints: Sequence[str], device: torch.device) -> TrainingState:
    """Begin a run in a folder that holds none.

    Args:
        run: The run folder.
        config: Its configuration.
        fingerprints: Digest of each dataset.
        device: Where to train.

    Raises:
        UserError: The folder holds a run, or other files.
    """
    if resumable(run):
        raise UserError(f"{run}: holds a run already; go on with it by --resume, or choose another folder by --out")
    if checkpoints(run):
        raise UserError(
            f"{run}: holds checkpoints, and no state to go on from ({_RESUME} is missing); choose another folder by "
            "--out"
        )
    # Where several processes train together, the first one may already have written the configuration.
    if run.is_dir() and any(run.glob("[!.]*")) and not _begun(run):
        raise UserError(
            f"{run}: holds other files and no run; choose another folder by --out, or move what is there away"
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
    """Whether a folder is that of a run that has saved nothing yet."""
    try:
        RunConfig.read(run)
    except UserError:
        return False
    return True


def resume(run: Path, config: RunConfig, fingerprints: Sequence[str], device: torch.device) -> TrainingState:
    """Go on with the run in a folder from where its state was saved last.

    Args:
        run: The run folder.
        config: Its configuration.
        fingerprints: Digest of each dataset as it is now.
        device: Where to train.

    Raises:
        UserError: Nothing was saved, a dataset has changed since, or the run has more epochs behind it than `config`
            asks for.
    """
    path = run / _RESUME
    if not resumable(run):
        raise UserError(f"{run}: nothing saved yet to resume from ({_RESUME} is missing); leave out --resume")
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        plain = {name: saved[name] for name in _PLAIN}
        detector_config = DetectorConfig.from_dict(saved["detector"])
        model = build(detector_config, trainable_layers=config.recipe.trainable_layers)
        model.load_state_dict(saved["model"])
    except Exception as error:  # torch.load raises whatever the broken archive or pickle led to
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


def record(run: Path, config: RunConfig) -> None:
    """Write the configuration of a run into its folder."""
    write_json(run / _CONFIG, config.to_dict())


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


def save_state(run: Path, training: TrainingState) -> None:
    """Write the state that `resume` reads."""
    # Through memory: where there is no room for a file, torch's own writer ends the process.
    buffer = io.BytesIO()
    torch.save(training.state(), buffer)
    write_bytes(run / _RESUME, buffer.getbuffer())


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
