"""The model card beside the checkpoints: what the model is, what it learnt from, and how good it was."""

from collections.abc import Mapping, Sequence
from typing import Any

from skope import keypoints
from skope.dataset.folder import Dataset
from skope.detector.checkpoint import BEST
from skope.terminal.console import counted
from skope.train.run_config import RunConfig
from skope.train.training_state import TrainingState
from skope.train.validate import rank
from skope.version import __version__

_WEIGHTS = (
    ("COCO", "weights published with torchvision (BSD-3-Clause), trained on COCO's photographs (Flickr's terms)"),
    ("ImageNet", "weights published with torchvision (BSD-3-Clause), trained on ImageNet (research only)"),
    ("random", "nothing but the seed"),
)


def text(
    config: RunConfig,
    training: TrainingState,
    datasets: Sequence[Dataset],
    counts: Sequence[tuple[int, int]],
    others: int = 0,
) -> str:
    """The model card as Markdown.

    Args:
        config: Configuration of the run.
        training: Its state.
        datasets: What it has learnt from.
        counts: Images and vehicles that each dataset gave.
        others: Number of all other road users.
    """
    recipe = config.recipe
    lines = [
        "# Vehicle keypoint detector",
        "",
        f"torchvision's Keypoint R-CNN ({training.config.architecture}), {_classes(config)}, {keypoints.K} keypoints "
        f"(`{config.scheme.title}`), "
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
        *_road_users(config, others),
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
    return [f"Besides, {counted(count, 'road user')} of the categories {', '.join(names)}.", ""] if names else []


def _terms(origin: str) -> str:
    return next((terms for word, terms in _WEIGHTS if word in origin), "under the terms of that file")


def _figures(history: Sequence[Mapping[str, Any]]) -> list[str]:
    rows = [row for row in history if "validation" in row]
    if not rows:
        return ["No part of the training recordings was validated on (`val_fraction` is 0)."]
    names = [name for name in rows[-1]["validation"] if name not in ("images", "vehicles")]
    best = max(rows, key=lambda row: rank(row["validation"]))
    images, vehicles = (rows[-1]["validation"][name] for name in ("images", "vehicles"))
    lines = [
        f"On {counted(images, 'image')} with {counted(vehicles, 'vehicle')} at the end of the training recordings, "
        f"score above 0.9, IoU 0.6, alpha 0.1, visible keypoints, pooled; the best epoch's weights are `{BEST}`.",
        "",
        "| epoch | " + " | ".join(names) + " |",
        "|---" * (len(names) + 1) + "|",
    ]
    for row in {id(row): row for row in (best, rows[-1])}.values():
        values = (row["validation"][name] for name in names)
        lines.append(f"| {row['epoch']} | " + " | ".join("-" if v is None else f"{v:.3f}" for v in values) + " |")
    return lines
