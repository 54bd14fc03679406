"""Small annotated images with people on foot and on two wheels beside the vehicles of `tests.samples`."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import schema
from skope.dataset import coco
from skope.dataset.folder import read_image
from skope.schema import AnnotationFile, RoadUser
from tests import samples

PLACES: Final = {"pedestrian": (104.0, 6.0, 18.0, 42.0), "bicycle": (16.0, 70.0, 34.0, 36.0)}
"""Boxes of the road users in each image, clear of its vehicles."""
COLOURS: Final = {"bicycle": (30, 190, 60), "motorcycle": (200, 160, 20), "pedestrian": (210, 40, 40)}


def draw(pixels: NDArray[np.uint8], users: Iterable[RoadUser]) -> None:
    """Draw an ellipse of the category's colour into each box, in place."""
    for user in users:
        x, y, w, h = user.bbox.tolist()
        middle, half = (round(x + w / 2), round(y + h / 2)), (round(w / 2), round(h / 2))
        cv2.ellipse(pixels, middle, half, 0, 0, 360, COLOURS[user.category], -1)


def make_dataset(
    root: Path,
    images: int = 2,
    splits: tuple[str, ...] = ("train", "easy"),
    categories: tuple[str, ...] = schema.CATEGORY_NAMES,
    users: tuple[str, ...] = ("pedestrian", "bicycle"),
    ignored: bool = False,
) -> Path:
    """The folder of `samples.make_dataset` with one of each of `users` in every image; returns `root`.

    Args:
        root: The folder to write.
        images: Images of each split.
        splits: Names of the splits.
        categories: What the files say that they label.
        users: Who is drawn and labelled.
        ignored: Whether the road users are ignored ones.
    """
    samples.make_dataset(root, images, splits)
    for split in splits:
        path = root / "annotations" / f"{split}.json"
        file = coco.read(path)
        file = replace(file, categories=categories, road_users=tuple(_users(file, users, ignored=ignored)))
        by_image = file.road_users_by_image()
        for image in file.images:
            pixels = read_image(root / image.file_name)
            draw(pixels, by_image[image.id])
            cv2.imwrite(str(root / image.file_name), cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR))
        coco.write(path, file)
    return root


def _users(file: AnnotationFile, names: Iterable[str], *, ignored: bool) -> Iterable[RoadUser]:
    number = max((annotation.id for annotation in file.annotations), default=0)
    for image in file.images:
        for name in names:
            number += 1
            yield samples.make_road_user(number, image.id, PLACES[name], name, iscrowd=int(ignored))
