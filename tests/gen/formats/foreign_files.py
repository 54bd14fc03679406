"""COCO keypoints files as other programs write them, with their pictures."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from skope import keypoints

SIZE = (160, 90)
"""Width and height of the pictures."""
BOX = (40.0, 30.0, 60.0, 40.0)

Document = dict[str, Any]


def picture(seed: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """(H, W, 3) a picture that no other seed gives."""
    rng = np.random.default_rng(seed)
    return np.asarray(
        cv2.resize(rng.integers(60, 190, (5, 8, 3), dtype=np.uint8), size, interpolation=cv2.INTER_CUBIC), np.uint8
    )


def jpeg(seed: int = 0, size: tuple[int, int] = SIZE) -> bytes:
    """A picture as the bytes of a JPEG file."""
    return bytes(cv2.imencode(".jpg", picture(seed, size))[1])


def points(box: Sequence[float] = BOX) -> list[float]:
    """33 visible points inside a box, as COCO has them."""
    x, y, w, h = box
    rows = ((x + w * (0.1 + 0.15 * (i % 6)), y + h * (0.1 + 0.15 * (i // 6)), 2) for i in range(keypoints.K))
    return [value for row in rows for value in row]


def category(id_: int = 1, name: str = "vehicle") -> Document:
    return {"id": id_, "name": name, "keypoints": list(keypoints.NAMES), "skeleton": []}


def vehicle(id_: int, image_id: int, **fields: Any) -> Document:
    return {
        "id": id_, "image_id": image_id, "category_id": 1, "bbox": list(BOX), "area": 2400, "iscrowd": 0,
        "keypoints": points(), **fields,
    }  # fmt: skip


def document(names: Sequence[str], **fields: Any) -> Document:
    """A document with a vehicle in each of the images of these names."""
    return {
        "images": [
            {"id": i, "file_name": name, "width": SIZE[0], "height": SIZE[1]} for i, name in enumerate(names, start=1)
        ],
        "annotations": [vehicle(i, i) for i, _ in enumerate(names, start=1)],
        "categories": [category()],
        **fields,
    }


def save(path: Path, content: bytes | Document) -> None:
    """Write a file, with the folders above it."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())


def write(
    root: Path,
    names: Sequence[str],
    *,
    annotations: str = "annotations/train.json",
    images: str = "images",
    seed: int = 0,
    change: Callable[[Document], Any] = lambda _: None,
    **fields: Any,
) -> Document:
    """Write a folder with an annotation file and pictures; returns the document."""
    for i, name in enumerate(names):
        save(root / images / name, jpeg(seed + i))
    made = document(names, **fields)
    change(made)
    save(root / annotations, made)
    return made
