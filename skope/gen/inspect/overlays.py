"""Images of a dataset: overlays of single images, sheets of several, and splits for the viewer."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from skope.dataset.folder import Dataset
from skope.errors import UserError
from skope.pictures import draw
from skope.schema import Annotation, Image, RoadUser
from skope.terminal.console import Console
from skope.types import Pixels
from skope.viewer.collection import Collection, ShownSplit, read_picture

LAYER_NAMES: Final = ("keypoints", "boxes_3d", "mask", "depth", "occlusion")
"""Layers that can be drawn on an image."""


@dataclass(frozen=True)
class SheetSize:
    """Size of a sheet of images."""

    images: int = 12
    """Number of images on a sheet."""
    image_px: int = 640
    """Width of an image on a sheet, pixels."""


SHEET_SIZE: Final = SheetSize()


def overlay(dataset: Dataset, image: Image, labels: Sequence[Annotation | RoadUser], layers: Sequence[str]) -> Pixels:
    """Draw labels on an image.

    Args:
        dataset: Dataset of the image.
        image: Its record.
        labels: Its vehicles and other road users.
        layers: Some of `LAYER_NAMES`; "depth" replaces the photograph.

    Returns:
        (H, W, 3) RGB.

    Raises:
        UserError: A layer needs depth or a camera that the image does not have.
    """
    pixels = dataset.image(image)
    if "depth" in layers:
        metres = dataset.depth(image)
        if metres is None:
            raise UserError(f"{dataset.root}: image {image.id} has no depth file")
        pixels = draw.depth(metres)
    if "mask" in layers:
        pixels = draw.masks(pixels, labels)
    if "boxes_3d" in layers:
        if image.camera is None:
            raise UserError(f"{dataset.root}: image {image.id} has no camera")
        pixels = draw.boxes_3d(pixels, labels, image.camera)
    if "occlusion" in layers:
        pixels = draw.occlusion(pixels, labels)
    if "keypoints" in layers:
        vehicles = [label for label in labels if isinstance(label, Annotation)]
        road_users = [label for label in labels if isinstance(label, RoadUser)]
        pixels = draw.annotations(pixels, vehicles, road_users, scheme=dataset.scheme)
    return pixels


def write_overlay(dataset: Dataset, number: int, layers: Sequence[str], out: Path) -> Path:
    """Write the overlay of the image with the id `number` to the folder `out`; return the file's path."""
    for split in dataset.splits:
        file = dataset.read(split)
        for image in file.images:
            if image.id == number:
                path = out / f"{Path(image.file_name).with_suffix('').as_posix().replace('/', '_')}.png"
                draw.write(path, overlay(dataset, image, file.labels_by_image()[image.id], layers))
                return path
    raise UserError(f"{dataset.root}: no image has id {number}")


def sheets(dataset: Dataset, site: str | None, layers: Sequence[str], out: Path) -> list[Path]:
    """Write sheets of `SHEET_SIZE.images` overlays, evenly spread over each split, or over one site.

    Args:
        dataset: Dataset of the images.
        site: Name of a site; None for a sheet per split.
        layers: Some of `LAYER_NAMES`.
        out: Folder of the sheets.

    Returns:
        Paths of the sheets.

    Raises:
        UserError: No image matches.
    """
    groups: dict[str, list[tuple[Image, list[Annotation | RoadUser]]]] = {}
    for split in dataset.splits:
        file = dataset.read(split)
        labels_by_image = file.labels_by_image()
        for image in file.images:
            if site is None or image.site == site:
                groups.setdefault(site or split, []).append((image, labels_by_image[image.id]))
    if not groups:
        raise UserError(f"{dataset.root}: no image of site {site!r}" if site else f"{dataset.root}: has no images")
    paths = []
    for name, pairs in groups.items():
        chosen = [pairs[i] for i in sorted({round(k) for k in np.linspace(0, len(pairs) - 1, SHEET_SIZE.images)})]
        cells = [
            _cell(overlay(dataset, image, labels, layers), f"{image.id}  {image.file_name}") for image, labels in chosen
        ]
        paths.append(out / f"{name}.png")
        draw.write(paths[-1], draw.contact_sheet(cells, 3))
    return paths


def _cell(pixels: Pixels, text: str) -> Pixels:
    import cv2

    height = round(pixels.shape[0] * SHEET_SIZE.image_px / pixels.shape[1])
    return draw.caption(
        np.asarray(cv2.resize(pixels, (SHEET_SIZE.image_px, height), interpolation=cv2.INTER_AREA), np.uint8), text
    )


def dataset_collection(dataset: Dataset, names: Sequence[str], console: Console) -> Collection:
    """Return the named splits of a dataset, or all of them.

    Raises:
        UserError: A split does not exist or cannot be read.
    """
    wanted = tuple(dict.fromkeys(names)) or dataset.splits
    if not wanted:
        raise UserError(f"{dataset.root}: has no splits")
    files = [dataset.read(name) for name in console.bar(wanted, unit="split", label="reading")]
    return Collection(
        title=f"{dataset.root.resolve().name} ({', '.join(wanted)})",
        splits=tuple(ShownSplit(file=file) for file in files),
        picture=lambda image: read_picture(dataset.root / image.file_name),
    )
