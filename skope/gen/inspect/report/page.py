"""The page: the gallery with its filters, numbers and plots, and the card."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from html import escape
from pathlib import Path
from typing import Final

from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.files.atomic import write_text
from skope.gen.inspect.report.layers import LAYER_TITLES, SHOWN, figure, filter_kind
from skope.gen.inspect.report.plots import Spread, spread_of, spread_plots
from skope.gen.inspect.report.sample import spread
from skope.gen.inspect.stats import SplitStats, rows, split_stats
from skope.gen.output import card_text
from skope.page import html_document
from skope.page.html_pieces import table, tag
from skope.page.image_viewer import switches
from skope.schema import Annotation, Image, RoadUser
from skope.terminal.console import Console

ShownImage = tuple[Image, Sequence[Annotation | RoadUser]]

_FILTERS: Final = {"split": "split", "site": "site", "weather": "weather", "type": "vehicle type"}
_HINT: Final = "Each vehicle has its own colour; point at its box, or touch it, for what is known of it."


def write_dataset_report(dataset: Dataset, count: int, path: Path, console: Console) -> Path:
    """Write the page with at most `count` images to `path`, and return that; splits are read one at a time."""
    if count < 1:
        raise UserError(f"--max-images: expected a whole number from 1, got {count}")
    stats: dict[str, SplitStats] = {}
    spreads: dict[str, Spread] = {}
    candidates: list[ShownImage] = []
    for split in console.bar(dataset.splits, unit="split", label="reading"):
        file = dataset.read(split)
        stats[split], spreads[split] = split_stats(dataset, file), spread_of(file)
        own = file.labels_by_image()
        # Files of other tools leave the split to their name.
        images = [replace(image, split=image.split or split) for image in file.images]
        candidates += [(images[i], own[images[i].id]) for i in spread(images, count)]
    if not candidates:
        raise UserError(f"{dataset.root}: has no images")
    chosen = [candidates[i] for i in spread([image for image, _ in candidates], count)]
    figures = [figure(dataset, *pair) for pair in console.bar(chosen, unit="image", label="drawing")]
    write_text(path, _page(dataset, stats, spreads, chosen, figures))
    return path


def _page(
    dataset: Dataset,
    stats: Mapping[str, SplitStats],
    spreads: Mapping[str, Spread],
    chosen: Sequence[ShownImage],
    figures: Sequence[str],
) -> str:
    total = sum(of.images for of in stats.values())
    shown = f"{len(chosen)} of {total} images" if len(chosen) < total else f"All {total} images"
    how = (
        ", spread evenly over splits, sites and recordings. Numbers and plots are of all."
        if len(chosen) < total
        else "."
    )
    numbers = [[escape(name.strip()), *map(escape, cells)] for name, cells in rows(stats)]
    return html_document(
        f"skope gen: {dataset.root.resolve().name}",
        tag("h1", card_text.TITLE),
        tag("p", tag("b", escape(dataset.root.resolve().name)), escape(f": {card_text.card_summary(dataset.card)}")),
        tag(
            "section",
            tag("h2", "Images"),
            tag("p", escape(f"{shown}{how} {_HINT}")),
            tag("div", _controls(chosen), *figures, class_="gallery"),
        ),
        tag(
            "section",
            tag("h2", "Numbers"),
            table(("", *stats), numbers, caption="Of ground truth; distance and height: median and quartiles"),
            tag("div", *spread_plots(spreads, dataset.scheme), class_="grid"),
        ),
        tag("section", card_text.html(dataset.card)),
    )


def _controls(chosen: Sequence[ShownImage]) -> str:
    filters = "".join(
        _select(key, words, counts) for key, words in _FILTERS.items() if len(counts := _kinds(key, chosen)) > 1
    )
    status = tag("output", f"{len(chosen)} images", class_="count")
    parts = [switches("Layers", {name: words for name, words in LAYER_TITLES.items() if _has(name, chosen)}, SHOWN)]
    parts.append(tag("fieldset", tag("legend", "Filters"), filters, status, class_="choices filters"))
    return tag("div", *parts, class_="controls")


def _select(key: str, words: str, counts: Mapping[str, int]) -> str:
    """A choice among what the images are of, with how many are."""
    options = [tag("option", "all", value="")]
    options += [tag("option", escape(f"{name} ({count})"), value=name) for name, count in sorted(counts.items())]
    return tag("label", escape(f"{words} "), tag("select", *options, data_filter=key))


def _kinds(key: str, chosen: Sequence[ShownImage]) -> Counter[str]:
    """Number of images of each value that a filter has."""
    counts = Counter[str]()
    for image, labels in chosen:
        if key == "type":
            counts.update({filter_kind(label) for label in labels if not label.ignored})
        else:
            counts.update(filter(None, [getattr(image, key)]))
    return counts


def _has(layer: str, chosen: Sequence[ShownImage]) -> bool:
    """Whether any image has something to show on a layer."""
    every = [label for _, labels in chosen for label in labels]
    return {
        "boxes": True,
        "points": True,
        "boxes3d": any(label.box_3d is not None for label in every),
        "masks": any(isinstance(label.segmentation, Mapping) for label in every),
        "depth": any(image.depth_file_name for image, _ in chosen),
        "ignored": any(label.ignored for label in every),
    }[layer]
