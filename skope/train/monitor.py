"""Pictures of how training goes: curves, predictions beside ground truth, TensorBoard."""

import importlib.util
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, Protocol

import torch
from torchvision.models.detection import KeypointRCNN

from skope.dataset.folder import read_image
from skope.files.atomic import replacing
from skope.pictures import draw
from skope.schema import CATEGORIES, Annotation, AnnotationFile
from skope.terminal.console import counted
from skope.train import validate
from skope.types import Pixels

SHEET_IMAGES: Final = 4
"""Images of the progress sheet."""

_SURE_SCORE = 0.5
_SHARES: Final = {
    "pck": "PCK@0.1 of found vehicles",
    "pck_given": "PCK@0.1 in given boxes",
    "keypoint_recall": "keypoint recall",
    "box_recall": "box recall",
}


def curves(path: Path, history: Sequence[Mapping[str, Any]]) -> None:
    """Write losses, and the validation's figures where there are any, over epochs as PNG."""
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
    others = {
        name: name.replace("_", " ")
        for name in (validated[0]["validation"] if validated else ())
        if name.removesuffix("_recall") in CATEGORIES
    }
    for name, label in {**_SHARES, **others}.items() if validated else ():
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
    """Write predictions (right) beside ground truth (left) for the first images that hold vehicles.

    Args:
        path: The picture to write.
        model: The model.
        file: The ground truth.
        images: Files of its images.
        epoch: Number of the epoch, for the caption.
        device: Where the model is.
    """
    vehicles, users = file.by_image(), file.road_users_by_image()
    pairs: list[Pixels] = []
    # The same images each time, so that one sees them change.
    for image, place in zip(file.images, images, strict=True):
        if len(pairs) == 2 * SHEET_IMAGES:
            break
        truth: list[Annotation] = vehicles[image.id]
        if all(vehicle.ignored for vehicle in truth):
            continue
        pixels = read_image(place, size=(image.width, image.height))
        found, others = validate.detect_in_image(model, pixels, image.id, device, _SURE_SCORE, file.categories)
        labels = draw.annotations(pixels, truth, users[image.id], scheme=file.scheme)
        answers = draw.results(pixels, found, others, scheme=file.scheme)
        pairs.append(draw.caption(labels, f"{image.file_name}: ground truth"))
        pairs.append(draw.caption(answers, f"after epoch {epoch}: {len(found) + len(others)} found"))
    if pairs:
        draw.write(path, draw.contact_sheet(pairs, 2))


class ScalarWriter(Protocol):
    """The methods of TensorBoard's SummaryWriter that are used."""

    def add_scalar(self, tag: str, scalar_value: float, global_step: int) -> None: ...
    def close(self) -> None: ...


def tensorboard(folder: Path, purge_step: int) -> ScalarWriter | None:
    """A writer into `folder` that forgets what lies there from `purge_step` on; None without the extra `logging`."""
    if importlib.util.find_spec("tensorboard") is None:
        return None
    from torch.utils.tensorboard import SummaryWriter

    return SummaryWriter(str(folder), purge_step=purge_step)
