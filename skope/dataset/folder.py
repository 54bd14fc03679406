"""Read a dataset folder: its card, splits, images and depth."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from skope import keypoints, schema
from skope.camera.model import Camera
from skope.dataset import coco, shards
from skope.dataset.depth_files import read_depth
from skope.errors import UserError
from skope.files import safe_names
from skope.files.json_files import check_version, read_json
from skope.keypoints import Scheme
from skope.schema import Annotation, AnnotationFile, Image, RoadUser

CARD_FILE: Final = "dataset.json"
MANIFEST_FILE: Final = "manifest.json"
"""Checksums (SHA-256) of a dataset's files, and the counts of each image for the card."""
FRAMES_FILE: Final = "frames.json"
PREDICTIONS_FILE: Final = "predictions.json"
"""File of `skope eval predict` with the images and, as annotations, the detections."""
FOLLOWED_KEY: Final = "followed"
"""Key in `info` of the frames: whether vehicles were tracked by points from image to image."""
CHANGES_KEY: Final = "view_changes"
"""Key in `info` of the frames: when a video shows another view. Objects with `time_s`, `cut` and `shift`, and of a view
that was registered with `settled_s`, `homography`, `residual_px` and `corner_error_px`."""
DETECTOR_KEY: Final = "detector"
"""Key in `info` of the frames: the detector, as the name of shipped weights or the path of a file."""
VISIBILITY_KEY: Final = "visibility_samples"
"""Key in `info` of the frames: brightness and contrast of a video, as rows of time (s), brightness (0 to 1) and
contrast."""
PIXEL_WIDTH: Final = "pixel_width"
"""Key in `info` of the frames: width of a pixel relative to its height, if a video states that they are not square."""
SKIPPED_KEY: Final = "skipped"
"""Key in `info` of the frames: messages on unreadable parts of the footage. Absent if all of it was read."""
START_TIME_KEY: Final = "start_time"
"""Key in `info` of the frames: the time of second 0 of a live stream, with its offset."""

_CARD_FIELDS: Final[dict[str, type]] = {
    **dict.fromkeys(("counts", "fleet", "localizer_difference_m", "occlusion_rules", "parameters", "versions"), dict),
    **dict.fromkeys(("categories", "label_rules", "sources", "takes"), list),
    **dict.fromkeys(("command", "depth", "format", "licence", "renderer"), str),
}
TYPE_NAMES: Final[dict[type, str]] = {dict: "an object", list: "a list", str: "text"}


@dataclass(frozen=True, eq=False)
class LabelledImage:
    """Image of a dataset with its annotations; pixels are read on request."""

    dataset: "Dataset"
    split: str
    record: Image
    annotations: tuple[Annotation, ...]
    """Vehicles in the image."""
    road_users: tuple[RoadUser, ...] = ()
    """Pedestrians and two-wheelers, if the dataset labels them."""

    @property
    def camera(self) -> Camera | None:
        """Camera of the image; None if the dataset does not contain it."""
        return self.record.camera

    def pixels(self) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB."""
        return self.dataset.image(self.record)

    def depth(self) -> NDArray[np.float32] | None:
        """(H, W) planar depth in metres, sky = +inf; None without a depth file."""
        return self.dataset.depth(self.record)


@dataclass(frozen=True)
class Dataset:
    """Dataset folder. Annotation files are read on request.

    Iteration yields the images of all splits; `images(split)` yields those of one.
    """

    root: Path
    card: dict[str, Any]

    @property
    def splits(self) -> tuple[str, ...]:
        """Names of the splits with an annotation file or shards, in alphabetical order."""
        if self.sharded:
            return shards.splits_of(self.root)
        return tuple(sorted(path.stem for path in (self.root / "annotations").glob("[!.]*.json")))

    @property
    def sources(self) -> tuple[Path, ...]:
        """Files that describe the content: annotations, and the manifest (if there is one) for all other files."""
        files = [] if self.sharded else [self.root / "annotations" / f"{split}.json" for split in self.splits]
        return tuple(path for path in (self.root / MANIFEST_FILE, *files) if path.is_file())

    @property
    def sharded(self) -> bool:
        """Whether the frames are in tar shards (see `skope.dataset.shards`)."""
        return self.card.get("format") == "shards"

    @property
    def scheme(self) -> Scheme:
        """Keypoint scheme of the dataset."""
        return keypoints.scheme_in(self.card)

    @property
    def categories(self) -> tuple[str, ...]:
        """Names of the categories that the dataset labels."""
        return schema.checked_categories(self.card.get("categories", schema.VEHICLE_ALONE))

    @property
    def licence(self) -> str:
        """Licence on the card, on one line."""
        stated = self.card.get("licence") or self.card.get("license") or "not stated"
        return " ".join(str(stated).split())

    def read(self, split: str) -> AnnotationFile:
        """Return the annotations of a split. Raises UserError with a list of the splits if there is no such split."""
        if split not in self.splits:
            raise UserError(f"{self.root}: no split {split!r}; there are: {', '.join(self.splits) or 'none'}")
        if not self.sharded:
            return self._read_file(self.root / "annotations" / f"{split}.json")
        rows = (
            (labels["image"], labels["annotations"])
            for shard in shards.shards_of(self.root, split)
            for labels in shards.labels_in(shard)
        )
        return coco.assembled(
            rows, self.root / shards.SHARD_FOLDER / f"{split}-*.tar", split, self.scheme, self.categories
        )

    def __iter__(self) -> Iterator[LabelledImage]:
        return (labelled for split in self.splits for labelled in self.images(split))

    def images(self, split: str) -> Iterator[LabelledImage]:
        """Return the images of a split with their annotations.

        Raises UserError with a list of the splits if there is no such split.
        """
        file = self.read(split)
        vehicles, road_users = file.by_image(), file.road_users_by_image()
        return (
            LabelledImage(self, split, image, tuple(vehicles[image.id]), tuple(road_users[image.id]))
            for image in file.images
        )

    def _read_file(self, path: Path) -> AnnotationFile:
        file = coco.read(path)
        if file.scheme is not self.scheme:
            raise UserError(f"{path}: has keypoint scheme {file.scheme.name}, the dataset's card {self.scheme.name}")
        return file

    def image(self, image: Image) -> NDArray[np.uint8]:
        """(H, W, 3) sRGB pixels."""
        return read_image(self.root / image.file_name, size=(image.width, image.height))

    def depth(self, image: Image) -> NDArray[np.float32] | None:
        """(H, W) planar depth in metres, sky = +inf, 255.99 m for larger values; None without a depth file."""
        return read_depth(self.root / image.depth_file_name) if image.depth_file_name else None


def open_dataset(root: Path) -> Dataset:
    """Open a dataset folder. Raises UserError if the folder or a file in it is missing."""
    if not root.is_dir():
        raise UserError(f"{root}: no such dataset folder; `skope gen --out {root}` makes one")
    if not (root / CARD_FILE).is_file():
        raise UserError(
            f"{root}: no {CARD_FILE} in it, so it is not a (finished) dataset; run `skope gen --out {root}`"
        )
    return Dataset(root, read_card(root))


def read_card(root: Path) -> dict[str, Any]:
    """Return the card of a dataset folder. Raises UserError if a field has the wrong type."""
    path = root / CARD_FILE
    card = read_json(path)
    try:
        keypoints.scheme_in(card if isinstance(card, dict) else {})
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    check_version(path, card.get("version", schema.SCHEMA_VERSION), schema.SCHEMA_VERSION)
    for name, kind in _CARD_FIELDS.items():
        if not isinstance(card.get(name, kind()), kind):
            raise UserError(f"{path}: {name}: expected {TYPE_NAMES[kind]}, got {card[name]!r:.60}")
    check_takes(path, card.get("takes", []))
    try:
        schema.checked_categories(card.get("categories", schema.VEHICLE_ALONE))
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    return dict(card)


def check_takes(path: Path, takes: Any) -> None:
    """Raise a UserError unless `takes` in the file at `path` is a list of site, name, split and frames."""
    if not isinstance(takes, list):
        raise UserError(f"{path}: takes: expected a list, got {takes!r:.60}")
    for i, row in enumerate(takes):
        if not (isinstance(row, list) and [type(value) for value in row] == [str, str, str, int]):
            raise UserError(f"{path}: takes[{i}]: expected site, name, split and frames, got {row!r:.60}")
        for field, value in zip(("site", "name", "split"), row, strict=False):
            safe_names.name(f"{path}: takes[{i}]: {field}", value)


def read_manifest(root: Path) -> dict[str, dict[str, Any]]:
    """Return the manifest of a dataset folder: "sha256" and "tallies", each by paths in the folder."""
    path = root / MANIFEST_FILE
    manifest = read_json(path)
    parts = {}
    for part_name in ("sha256", "tallies"):
        part_of = manifest.get(part_name) if isinstance(manifest, dict) else None
        if not isinstance(part_of, dict):
            raise UserError(f"{path}: {part_name}: expected an object")
        for file_name in part_of:
            safe_names.relative(f"{path}: {part_name}", file_name)
        parts[part_name] = part_of
    return parts


_JPEG_MARKER: Final = re.compile(rb"\xff+([^\x00\xff\xd0-\xd7])")
"""Marker that ends the coded pixels of a scan: neither a stuffed byte nor a restart marker."""
_JPEG_END: Final = 0xD9
_JPEG_ALONE: Final = (0x01, 0xD8)
"""Markers without a length field."""


def _jpeg_ends(data: bytes) -> bool:
    """Return whether the first image in a JPEG file is complete; cameras may write previews, films or text after it."""
    if b"\xff\xd9" in data[-64:]:
        return True
    at = 2
    while marker := _JPEG_MARKER.search(data, at):
        kind = marker[1][0]
        if kind == _JPEG_END:
            return True
        at = marker.end()
        if kind not in _JPEG_ALONE:
            at += max(2, int.from_bytes(data[at : at + 2], "big"))
    return False


def read_image(path: str | Path, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Decode an image file.

    Args:
        path: The file, or a member of a shard.
        size: Width and height that the image must have, pixels; None: any.

    Returns:
        (H, W, 3) RGB pixels.

    Raises:
        UserError: The file is missing, broken or truncated, or has another size.
    """
    import cv2

    path = Path(path)
    data = shards.read(path)
    # OpenCV fills the missing rows of a truncated JPEG with grey and reports no error.
    if data[:2] == b"\xff\xd8" and not _jpeg_ends(data):
        raise UserError(f"{path}: truncated JPEG")
    pixels = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_COLOR_RGB) if data else None
    if pixels is None:
        raise UserError(f"{path}: not an image that can be decoded")
    if size is not None and (pixels.shape[1], pixels.shape[0]) != size:
        raise UserError(f"{path}: is {pixels.shape[1]}x{pixels.shape[0]}, its annotation says {size[0]}x{size[1]}")
    return np.asarray(pixels, dtype=np.uint8)
