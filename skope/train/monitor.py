"""Progress of a training: initial messages, progress bar and losses, curves, images, TensorBoard."""

import importlib.util
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Protocol, Self

import torch
from torchvision.models.detection import KeypointRCNN

from skope.dataset.folder import read_image
from skope.files.atomic import replacing
from skope.pictures import draw
from skope.schema import CATEGORY_NAMES, Annotation, AnnotationFile
from skope.terminal.console import Console, counted, minutes
from skope.train import validate
from skope.train.run_config import RunConfig
from skope.train.splits import TrainingSource
from skope.train.training_samples import TrainingSet
from skope.train.training_state import TrainingState
from skope.types import Pixels


@dataclass(frozen=True)
class MonitorLimits:
    """Settings of the progress reports of a run."""

    measured_steps: int = 2
    """Number of timed steps from which the remaining time of the run is estimated."""
    sheet_images: int = 4
    """Number of images on the progress sheet."""
    drawn_score: float = 0.5
    """Score above which detections are drawn."""


MONITOR_LIMITS: Final = MonitorLimits()


class TrainingProgress:
    """Progress bar over all images of the run, with the mean losses of the epoch and the expected run time."""

    def __init__(self, images: int, epochs: int, console: Console) -> None:
        self._console = console
        self._epochs, self._total, self._seen, self._images = epochs, images, 0, 0
        self._bar = console.bar(total=images, unit="image", label="training")
        self._since = time.perf_counter()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def note(self, text: str) -> None:
        """Print a line above the bar."""
        self._bar.clear()
        self._console.say(text)

    def tick(self, epoch: int, images: int, losses: Mapping[str, float]) -> None:
        """Record that a step over `images` images is done."""
        values = {name.removeprefix("loss_"): f"{value:.3f}" for name, value in losses.items()}
        self._bar.set_postfix({"epoch": f"{epoch + 1}/{self._epochs}", **values}, refresh=False)
        self._bar.update(images)
        self._seen += 1
        if self._seen == 1:  # the first step is slower: libraries select algorithms and allocate memory
            self._since, self._images = time.perf_counter(), 0
            return
        self._images += images
        if self._seen == 1 + MONITOR_LIMITS.measured_steps:
            seconds = time.perf_counter() - self._since
            rate, each = self._images / seconds, seconds / MONITOR_LIMITS.measured_steps
            self.note(f"{each:.2g} s a step: about {minutes(self._total / rate)} for {self._total} images")


def figures_text(figures: Mapping[str, Any]) -> str:
    """Return the figures of a validation (`skope.train.validate.validate`) on one line."""

    def percent(name: str) -> str:
        return "-" if figures[name] is None else f"{figures[name]:.1%}"

    return (
        f"PCK {percent('pck')} of found vehicles ({percent('box_recall')} of {figures['vehicles']}), "
        f"{percent('pck_given')} in given boxes; keypoint recall {percent('keypoint_recall')}"
        + "".join(
            f"; {name} recall {percent(f'{name}_recall')}" for name in CATEGORY_NAMES if f"{name}_recall" in figures
        )
    )


def announce(
    config: RunConfig,
    training: TrainingState,
    training_set: TrainingSet,
    parts: Sequence[TrainingSource],
    where: str,
    console: Console,
) -> None:
    """Print recipe, device and data of a run, and warnings about unusual ones.

    Args:
        config: Datasets, recipe and seed.
        training: The state at the start or after resuming.
        training_set: Training images of all datasets.
        parts: The datasets, one by one.
        where: Description of device and processes.
        console: Receives the messages.
    """
    recipe = config.recipe
    console.say(f"{recipe.describe(training.config.min_size)}; {training.origin}; seed {config.seed}; {where}")
    if not training.config.stock:
        console.say(f"network: {training.config.architecture}")
    if training.teacher is not None:
        console.say(f"learns from {recipe.teacher.checkpoint} beside the labels")
    names = " + ".join(config.data)
    if config.scheme.flip is None:
        console.say(f"images are not mirrored: of scheme {config.scheme.name} no mirror partners are known")
    learnt = f"{counted(len(training_set), 'image')} with {counted(training_set.vehicles, 'vehicle')} to learn from"
    kept = [part.validated for part in parts]
    images, vehicles = sum(len(file.images) for file in kept), sum(not a.ignored for f in kept for a in f.annotations)
    checked = f"{counted(images, 'image')} with {counted(vehicles, 'vehicle')}" if images else "none"
    console.say(f"{names}: {learnt}, {checked} to validate on")
    if len(config.detector_categories) > 1:
        learnt = f"{counted(training_set.road_users, 'other road user')} to learn from"
        console.say(f"categories {', '.join(config.detector_categories)}: {learnt}; keypoints of vehicles alone")
    for part in parts if recipe.exclude_types else ():
        types = ", ".join(recipe.exclude_types)
        console.say(f"{part.dataset.root}: {counted(part.excluded, 'vehicle')} left out by type ({types})")
        if part.untyped:
            console.warn(
                f"{part.dataset.root}: does not say the type of {counted(part.untyped, 'vehicle')}: they are learnt, "
                f"whether {types} or not"
            )
    if training.epochs_done or training.steps_done:
        within = f" and {training.steps_done} steps" if training.steps_done else ""
        console.say(f"resumed after epoch {training.epochs_done}{within}")
    elif training.config.norm == "batch" and recipe.learning_rate < 0.01 and "random" in training.origin:
        console.say(f"recipe {recipe.name} fine-tunes trained weights; `--recipe scratch` is made for random ones")


CURVE_TITLES: Final = {
    "pck": "PCK@0.1 of found vehicles",
    "pck_given": "PCK@0.1 in given boxes",
    "keypoint_recall": "keypoint recall",
    "box_recall": "box recall",
}


def curves(path: Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Write the losses, and the validation figures if there are any, over epochs as a PNG image."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    epochs = [row["epoch"] for row in history]
    validated = [row for row in history if "validation" in row]
    figure = Figure(figsize=(10 if validated else 5.5, 3.8), layout="constrained", dpi=100)
    FigureCanvasAgg(figure)
    axes = figure.subplots(1, 2 if validated else 1, squeeze=False)[0]
    for name in (key for key in history[-1] if key == "loss" or key.startswith("loss_")):
        style = {"color": "black", "linewidth": 2} if name == "loss" else {}
        axes[0].plot(epochs, [row[name] for row in history], marker=".", label=name.removeprefix("loss_"), **style)
    axes[0].set(xlabel="epoch", ylabel="mean loss", yscale="log", title="training")
    category_titles = {
        name: name.replace("_", " ")
        for name in (validated[0]["validation"] if validated else ())
        if name.removesuffix("_recall") in CATEGORY_NAMES
    }
    for name, label in {**CURVE_TITLES, **category_titles}.items() if validated else ():
        rows = [(row["epoch"], row["validation"][name]) for row in validated]
        known = [(epoch, value) for epoch, value in rows if value is not None]
        axes[1].plot([epoch for epoch, _ in known], [value for _, value in known], marker=".", label=label)
    if validated:
        images, vehicles = (validated[-1]["validation"][name] for name in ("images", "vehicles"))
        title = f"validation: {counted(images, 'image')}, {counted(vehicles, 'vehicle')}"
        axes[1].set(xlabel="epoch", ylim=(0, 1), title=title)
    for axis in axes:
        axis.xaxis.set_major_locator(MaxNLocator(integer=True))
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    with replacing(path) as temporary:
        figure.savefig(temporary)


def prediction_sheet(
    path: Path, model: KeypointRCNN, file: AnnotationFile, images: Sequence[Path], epoch: int, device: torch.device
) -> None:
    """Write predictions (right) beside ground truth (left) for the first images with vehicles.

    Args:
        path: Path of the image to write.
        model: The model.
        file: The ground truth.
        images: Files of its images.
        epoch: Number of the epoch, for the caption.
        device: Device of the model.
    """
    vehicles, users = file.by_image(), file.road_users_by_image()
    pairs: list[Pixels] = []
    # The same images each time, so that changes are visible.
    for image, path_of_image in zip(file.images, images, strict=True):
        if len(pairs) == 2 * MONITOR_LIMITS.sheet_images:
            break
        truth: list[Annotation] = vehicles[image.id]
        if all(vehicle.ignored for vehicle in truth):
            continue
        pixels = read_image(path_of_image, size=(image.width, image.height))
        found, road_users = validate.detect_in_image(
            model, pixels, image.id, device, MONITOR_LIMITS.drawn_score, file.categories
        )
        labels = draw.annotations(pixels, truth, users[image.id], scheme=file.scheme)
        answers = draw.results(pixels, found, road_users, scheme=file.scheme)
        pairs.append(draw.caption(labels, f"{image.file_name}: ground truth"))
        pairs.append(draw.caption(answers, f"after epoch {epoch}: {len(found) + len(road_users)} found"))
    if pairs:
        draw.write(path, draw.contact_sheet(pairs, 2))


class ScalarWriter(Protocol):
    """Methods of TensorBoard's SummaryWriter that are used."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None: ...
    def close(self) -> None: ...


def tensorboard(folder: Path, purge_step: int) -> ScalarWriter | None:
    """Return a writer into `folder` that discards entries from `purge_step` on; None without the extra `logging`."""
    if importlib.util.find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=purge_step)
