"""Train a detector: set up the run, train epoch by epoch, validate and save."""

import contextlib
import math
import time
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Self

import torch

from skope.detector.checkpoint import checkpoint_name
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.schema import CATEGORY_NAMES, AnnotationFile
from skope.terminal.console import Console, counted
from skope.train import (
    distributed,
    monitor,
    run_config,
    run_folder,
    splits,
    step,
    training_samples,
    training_state,
    validate,
)
from skope.train.distributed import ProcessGroup
from skope.train.fold_batchnorm import fold_norms
from skope.train.monitor import TrainingProgress, announce, figures_text
from skope.train.optimizer import learning_rate_at
from skope.train.recipe import SMALL_SIZE
from skope.train.run_config import RunConfig
from skope.train.sample_loader import Loader
from skope.train.splits import TrainingSource
from skope.train.step import StopRequest
from skope.train.teacher import Teacher
from skope.train.training_samples import Draw, TrainingSample, TrainingSet
from skope.train.training_state import TrainingState


@dataclass(frozen=True)
class TrainingIntervals:
    """Intervals of saving and drawing, and limits of validation."""

    checkpoint_s: float = 60.0
    """Minimum time between checkpoints, seconds. Each takes half a gigabyte."""
    state_s: float = 600.0
    """Minimum time between saved states, seconds."""
    curves_s: float = 5.0
    """Minimum time between drawn curves, seconds. Drawing takes a third of a second."""
    least_validated: int = 4
    """Minimum number of validated images."""
    validated_part: int = 5
    """Minimum number of training images per validated image. It matters in small datasets."""
    least_inside: float = 0.8
    """Minimum share of the labelled keypoints of the first batch that must lie inside their vehicle's box."""


TRAINING_INTERVALS: Final = TrainingIntervals()


@dataclass(frozen=True, kw_only=True)
class CheckpointPolicy:
    """Times at which the state of a run is written, and number of files that are kept."""

    keep: int = 1
    """Number of epoch checkpoints that are kept, in addition to the best one."""
    checkpoint_interval_s: float = TRAINING_INTERVALS.checkpoint_s
    """Minimum age of the last checkpoint for writing a new one after an epoch, seconds."""
    state_interval_s: float = TRAINING_INTERVALS.state_s
    """Interval between saves of the state within an epoch, seconds."""


def train(
    config: RunConfig,
    out: Path,
    *,
    device: torch.device,
    workers: int,
    resume: bool,
    console: Console,
    saving: CheckpointPolicy,
) -> Path:
    """Train a detector.

    A checkpoint is written after the last epoch, and after other epochs as set by `saving`.

    Args:
        config: Datasets, recipe and seed.
        out: The run folder.
        device: Device for training; each of several processes uses its own GPU.
        workers: Number of additional processes that load images; 0: none.
        resume: Whether to resume the run in `out`.
        console: Receives messages and progress.
        saving: Times at which the state is written.

    Returns:
        The last checkpoint.

    Raises:
        UserError: A dataset has no training data, an image is broken, the folder contains another run or is in use by
            another process, the loss is no longer finite, or memory is insufficient.
        KeyboardInterrupt: After SIGINT or SIGTERM, when the state has been saved.
    """
    with (
        distributed.process_group(device) as (processes, device),
        StopRequest(tell=processes.first) as stop,
        _explain_out_of_memory(config),
        _isolated_randomness(device),
    ):
        console = console if processes.first else Console(quiet=True)
        parts = [_read(Path(root), config) for root in config.data]
        categories = splits.common_categories(parts, config.categories)
        unlearnt = [name for name in CATEGORY_NAMES if any(name in part.categories for part in parts)]
        unlearnt = [name for name in unlearnt if name not in categories]
        parts = [part.of_categories(categories) for part in parts]
        config = config.of([part.dataset for part in parts], splits.common_scheme(parts), categories)
        recipe = config.recipe
        training_set = TrainingSet(
            parts, seed=config.seed, augment=recipe.augment, supervise=recipe.supervise, inside=recipe.inside
        )
        with run_folder.exclusive(out) if processes.first else contextlib.nullcontext():
            begin = training_state.resume if resume else training_state.start
            training = begin(out, config, [part.fingerprint for part in parts], device)
            if processes.first:
                run_folder.check_room(out, training, keep=saving.keep)
                run_folder.ensure_best(out, config, training)
            training.teacher = Teacher.load(recipe.teacher, training.config, device)
            if recipe.fold_norms:
                fold_norms(training.model)
            if processes.first:
                run_config.record_config(out, config)
            where = f"on {device} x {processes.size}, {workers} extra processes"
            announce(config, training, training_set, parts, where, console)
            if unlearnt:
                console.say(f"{', '.join(unlearnt)}: labelled, and background to this run, as --categories has it")
            run = _Run.begun(
                config, out, training, training_set, parts, processes, device, workers, saving, stop, console
            )
            return run.go()


def _steps_of(training_set: TrainingSet, config: RunConfig) -> int:
    """Return the number of steps of an epoch."""
    return math.ceil(len(training_set) / config.recipe.batch_size)


def _read(root: Path, config: RunConfig) -> TrainingSource:
    recipe = config.recipe
    return splits.read(
        root, exclude_types=recipe.exclude_types, val_fraction=recipe.val_fraction, max_images=config.max_images
    )


@dataclass
class _Run:
    """A training in progress: objects that its epochs share."""

    config: RunConfig
    out: Path
    training: TrainingState
    training_set: TrainingSet
    parts: Sequence[TrainingSource]
    processes: ProcessGroup
    device: torch.device
    saving: CheckpointPolicy
    stop: StopRequest
    console: Console
    file: AnnotationFile
    """Validation images; none if no image shows a vehicle."""
    paths: Sequence[Path]
    """Files of these images."""
    loader: Loader
    board: Any
    """Writer of TensorBoard; None without the extra, and in all processes except the first."""
    progress: TrainingProgress
    saved_at: float
    """Time of the last saved state, from `time.monotonic`; the following fields likewise."""
    checkpoint_at: float
    drawn_at: float

    @classmethod
    def begun(
        cls,
        config: RunConfig,
        out: Path,
        training: TrainingState,
        training_set: TrainingSet,
        parts: Sequence[TrainingSource],
        processes: ProcessGroup,
        device: torch.device,
        workers: int,
        saving: CheckpointPolicy,
        stop: StopRequest,
        console: Console,
    ) -> Self:
        """Prepare the objects for the epochs: validation images, loader and progress display."""
        recipe = config.recipe
        left = len(training_set) * (recipe.epochs - training.epochs_done) - training.steps_done * recipe.batch_size
        most = min(
            recipe.val_images,
            max(TRAINING_INTERVALS.least_validated, len(training_set) // TRAINING_INTERVALS.validated_part),
        )
        file, paths = splits.validation_images(parts, most)
        if file.images and all(vehicle.ignored for vehicle in file.annotations):
            message = f"{counted(len(file.images), 'image')} to validate on show no vehicle: nothing is validated"
            console.say(f"{message} (--val-fraction)")
            file = replace(file, images=(), annotations=(), road_users=())
        loader = Loader(
            training_set,
            workers=workers,
            console=console,
            pin=device.type == "cuda",
            stopping=lambda: stop.asked is not None,
        )
        step_done = training.epochs_done * _steps_of(training_set, config) + training.steps_done
        now = time.monotonic()
        return cls(
            config=config,
            out=out,
            training=training,
            training_set=training_set,
            parts=parts,
            processes=processes,
            device=device,
            saving=saving,
            stop=stop,
            console=console,
            file=file,
            paths=paths,
            loader=loader,
            board=monitor.tensorboard(out / "tensorboard", step_done) if processes.first else None,
            progress=TrainingProgress(left, recipe.epochs, console),
            saved_at=now,
            checkpoint_at=now,
            drawn_at=now,
        )

    def go(self) -> Path:
        """Train all remaining epochs; return the last checkpoint."""
        # Loading continues through all epochs: restarting the processes takes seconds, longer than a small epoch.
        board = contextlib.nullcontext() if self.board is None else contextlib.closing(self.board)
        with self.progress, board, contextlib.closing(self._loaded()) as samples:
            while self.training.epochs_done < self.config.recipe.epochs:
                self._epoch(samples)
                if self.processes.first:
                    self._validate_and_save()
        return self.out / checkpoint_name(self.training.epochs_done)

    @property
    def _steps(self) -> int:
        """Number of steps of an epoch."""
        return _steps_of(self.training_set, self.config)

    @property
    def _step(self) -> int:
        """Number of steps done in the whole run."""
        return self.training.epochs_done * self._steps + self.training.steps_done

    def _left(self, epoch: int) -> list[list[Draw]]:
        """Return the sample requests of each remaining step of an epoch, for all processes together."""
        draws = training_samples.order(self.training_set.sizes, self.config.mix, seed=self.config.seed, epoch=epoch)
        size = self.config.recipe.batch_size
        groups = [draws[i : i + size] for i in range(0, len(draws), size)]
        return groups[self.training.steps_done :] if epoch == self.training.epochs_done else groups

    def _epoch(self, samples: Iterator[list[TrainingSample]]) -> None:
        """Train the remaining part of one pass over the images, which ends with its mean losses in the history."""
        training, recipe, seed = self.training, self.config.recipe, self.config.seed
        epoch = training.epochs_done
        training.model.train()
        # One sample per group, and none of the next epoch.
        for group, batch in zip(self._left(epoch), samples, strict=False):
            if self._step == 0 and batch:
                _check_first(batch, self.console)
            step.seed(seed, epoch, training.steps_done, self.processes)
            rate = learning_rate_at(recipe, self._step, self._steps)
            losses, (stops, saves) = step.train_on_batch(
                training, batch, recipe, rate=rate, images=len(group), processes=self.processes, votes=self._votes()
            )
            if training.mean is not None:
                training.mean.update_parameters(training.model)
            training.sums = {name: training.sums.get(name, 0.0) + value for name, value in losses.items()}
            training.steps_done += 1
            means = {name: value / training.steps_done for name, value in training.sums.items()}
            self.progress.tick(epoch, len(group), means)
            if self.board is not None:
                for name, value in {**losses, "rate": rate}.items():
                    self.board.add_scalar(f"train/{name}", value, self._step)
            if stops or saves:
                self._save_within(stops > 0)
        row = {"epoch": epoch + 1, **{name: value / self._steps for name, value in training.sums.items()}}
        training.epochs_done, training.steps_done, training.sums = epoch + 1, 0, {}
        training.history.append(row)
        self.processes.average_statistics(training.model)

    def _loaded(self) -> Generator[list[TrainingSample]]:
        """Yield this process's samples of each step; if waiting is interrupted, the state of the run is saved first."""
        epochs = range(self.training.epochs_done, self.config.recipe.epochs)
        try:
            shares = (self.processes.share(group) for epoch in epochs for group in self._left(epoch))
            largest = math.ceil(min(self.config.recipe.batch_size, len(self.training_set)) / self.processes.size)
            yield from self.loader.batches(shares, largest)
        except KeyboardInterrupt:
            if self.processes.size == 1:  # several processes would have to agree
                self._save_within(stopped=False)
            raise

    def _votes(self) -> tuple[float, float]:
        """Return two votes, 1 or 0: whether this process was asked to stop, and whether a save is due.

        All processes act on the sums of these votes, and therefore in the same way.
        """
        due = self.processes.first and time.monotonic() - self.saved_at >= self.saving.state_interval_s
        return float(self.stop.asked is not None), float(due)

    def _save_within(self, stopped: bool) -> None:
        self.processes.average_statistics(self.training.model)
        if self.processes.first:
            training_state.save_state(self.out, self.training)
        self.saved_at = time.monotonic()
        if stopped:
            raise KeyboardInterrupt

    def _validate_and_save(self) -> None:
        """Validate after an epoch; write curves, sample predictions, and the checkpoint."""
        training, recipe, better = self.training, self.config.recipe, False
        row = training.history[-1]
        if self.file.images:
            model, file = training.shown, self.file
            figures = validate.validate(model, file, self.paths, self.device)
            row["validation"] = figures
            self.progress.note(f"epoch {row['epoch']}: {figures_text(figures)}")
            sheet = self.out / "progress" / f"epoch_{row['epoch']:03d}.jpg"
            monitor.prediction_sheet(sheet, model, file, self.paths, row["epoch"], self.device)
            if self.board is not None:
                for name, value in figures.items():
                    if value is not None:
                        self.board.add_scalar(f"validation/{name}", value, self._step)
            better = training.best is None or validate.rank(figures) > training.best
            training.best = validate.rank(figures) if better else training.best
        last = training.epochs_done == recipe.epochs
        if last or time.monotonic() - self.drawn_at >= TRAINING_INTERVALS.curves_s:
            monitor.curves(self.out / "curves.png", training.history)
            self.drawn_at = time.monotonic()
        if last or time.monotonic() - self.checkpoint_at >= self.saving.checkpoint_interval_s:
            run_folder.save_epoch(self.out, self.config, training, keep=self.saving.keep)
            self._write_card()
            self.checkpoint_at = self.saved_at = time.monotonic()
        if better:  # after the state, without which the epoch is lost if the disk is too full for both
            run_folder.save_best(self.out, self.config, training)

    def _write_card(self) -> None:
        datasets = [part.dataset for part in self.parts]
        counts = [
            (len(part.learnt.images), sum(len(each.boxes_xyxy) for each in part.vehicles())) for part in self.parts
        ]
        road_user_count = self.training_set.road_users
        write_text(
            self.out / "README.md", run_folder.text(self.config, self.training, datasets, counts, road_user_count)
        )


@contextlib.contextmanager
def _isolated_randomness(device: torch.device) -> Iterator[None]:
    """Restore torch's random state afterwards."""
    with torch.random.fork_rng(devices=[device] if device.type == "cuda" else []):
        yield


@contextlib.contextmanager
def _explain_out_of_memory(config: RunConfig) -> Iterator[None]:
    """Turn an out-of-memory error into a UserError that names the settings to reduce."""
    try:
        yield
    except RuntimeError as error:  # torch.OutOfMemoryError is one; on a CPU there is no separate class
        if not isinstance(error, torch.OutOfMemoryError) and "can't allocate memory" not in str(error):
            raise
        recipe = config.recipe
        regions = "all" if recipe.keypoint_regions is None else recipe.keypoint_regions
        short = "" if recipe.min_size is None else f"short side {recipe.min_size}, "
        smaller = SMALL_SIZE[0] if recipe.min_size is None else recipe.min_size * 3 // 4
        fewer = 32 if recipe.keypoint_regions is None or recipe.keypoint_regions > 32 else 16
        raise UserError(
            f"out of memory at {recipe.images_at_once or recipe.batch_size} images at once, {short}{regions} keypoint "
            f"regions: lower one of them (--set images_at_once=1 changes the result least, then --set "
            f"keypoint_regions={fewer}, then --min-size {smaller})"
        ) from None


def _check_first(batch: Sequence[TrainingSample], console: Console) -> None:
    """Raise a UserError if keypoints lie outside their boxes, because Keypoint R-CNN learns only points inside."""
    share = training_samples.mean_share_inside(batch)
    if share is None or share >= TRAINING_INTERVALS.least_inside:
        return
    names = ", ".join(sample.name for sample in batch)
    if share == 0:
        raise UserError(
            f"{names}: no labelled keypoint lies inside its vehicle's bbox: fields bbox and keypoints differ"
        )
    console.say(f"warning: {names}: only {share:.0%} of the labelled keypoints lie inside their vehicle's bbox")
