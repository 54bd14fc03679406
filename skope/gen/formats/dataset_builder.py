"""Frames and card of a dataset made from other files, and common helpers of the format converters."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from skope import schema
from skope.dataset import coco, shards
from skope.dataset.folder import CARD_FILE, Dataset, open_dataset
from skope.errors import UserError
from skope.files.atomic import read_bytes, sha256_of, write_text
from skope.files.json_files import write_json
from skope.gen.output import card_text, licences
from skope.gen.output.writers import FolderWriter, FrameFiles, Labels, categories_field, checksum, label_fields
from skope.schema import Annotation, Image, RoadUser
from skope.terminal.console import Console, counted
from skope.version import __version__

LICENCE_FILE: Final = "LICENCE.txt"
"""File with the dataset's licence in every export."""

SPLIT_NAME: Final = re.compile(r"\w[\w.-]*")
"""Valid names of splits: the name becomes that of the annotation file."""


def labelled_frame(
    split: str,
    image: Image,
    vehicles: Iterable[Annotation],
    files: Mapping[str, Path | bytes],
    sums: Mapping[str, str] | None = None,
    road_users: Iterable[RoadUser] = (),
) -> FrameFiles:
    """Return a frame of a dataset folder under construction; the writer assigns the ids.

    Args:
        split: Split of the frame.
        image: Its record, with the new names of its files.
        vehicles: Its annotations.
        files: Content of its files by these names.
        sums: Known SHA-256 sums; others are computed.
        road_users: Its labels of people on foot and on two wheels.
    """
    known = schema.CATEGORY_ID
    annotations = [each if each.category_id == known else replace(each, category_id=known) for each in vehicles]
    ignored = Counter(vehicle.ignore_reason or "unnamed" for vehicle in annotations if vehicle.ignored)
    contents = {name: _in_memory(content) for name, content in files.items()}
    known_sums = sums or {}
    labels = Labels(
        name=str(PurePosixPath(*PurePosixPath(image.file_name).parts[1:]).with_suffix("")),
        image=coco.image_to_dict(replace(image, split=split)),
        **label_fields(annotations, road_users),
        sha256={name: known_sums.get(name) or _sum_of(content) for name, content in contents.items()},
        tally={"ignored": dict(ignored)},
    )
    return FrameFiles(contents, labels)


def _in_memory(content: Path | bytes) -> Path | bytes:
    """Return the content; a shard's member is loaded to memory, so that it is read once."""
    return shards.read(content) if isinstance(content, Path) and shards.split_member(content) else content


def _sum_of(content: Path | bytes) -> str:
    return checksum(content) if isinstance(content, bytes) else sha256_of(content)


def finish_dataset(
    writer: FolderWriter, *, command: str, licence: str, label_rules: Sequence[str], **more: Any
) -> None:
    """Write annotation files, manifest, README and card of a dataset that was merged or imported.

    Args:
        writer: Writer that has received all frames.
        command: Command line that makes this dataset, for the card.
        licence: Licence of the images.
        label_rules: Sentences that describe the labels.
        more: Further fields of the card.

    Raises:
        UserError: There is no frame.
    """
    counts = writer.finish()
    if not counts.images:
        raise UserError("no image was found: nothing to write")
    card = {
        "version": schema.SCHEMA_VERSION,
        **writer.scheme.fields(),
        **categories_field(writer.categories),
        "format": "folder",
        "command": command,
        "counts": counts.to_dict(),
        "label_rules": list(label_rules),
        "versions": {"skope": __version__},
        "licence": licence,
        **more,
    }
    write_text(writer.root / "README.md", card_text.markdown(card))
    write_json(writer.root / CARD_FILE, card)


def dataset_at(root: Path) -> Dataset:
    """Open the dataset folder at `root`.

    Raises:
        UserError: It has no annotations.
    """
    dataset = open_dataset(root)
    if not dataset.splits:
        raise UserError(f"{root}: has no annotations")
    return dataset


def check_outside(out: Path, sources: Iterable[Path]) -> None:
    """Raise a UserError if the output `out` is inside one of the source folders, which must not change."""
    for source in sources:
        if source.resolve() in out.resolve().parents:
            raise UserError(f"{out}: is inside {source}, which must not change; choose another folder")


def bare_name(name: str) -> str:
    """Return <site>/<frame>.<suffix> of a skope file name, without its top folder or the shard's path."""
    parts = PurePosixPath(name).parts
    after = max((i + 1 for i, part in enumerate(parts) if part.endswith(".tar")), default=0)
    if after:
        return re.sub(r"(?<=[^/])\.depth(?=\.\w+$)", "", "/".join(parts[after:]))
    return "/".join(parts[1:] if parts[0] in ("images", "depth") else parts)


def frame_rate(images: Sequence[Image]) -> float:
    """Return the frame rate of a recording's images, frames/s.

    It is computed from the median of their time steps; without times it is 2, as in presets.
    """
    times = [image.time_s for image in images if image.time_s is not None]
    steps = np.diff(times)
    return float(1 / np.median(steps)) if len(steps) and (steps > 0).all() else 2.0


def licence_beside(folder: Path) -> str:
    """Return the licence in `LICENCE_FILE` of a folder; "not stated" without that file."""
    path = folder / LICENCE_FILE
    return licences.in_text(read_bytes(path).decode(errors="replace")) if path.is_file() else licences.NOT_STATED


class Remarks:
    """Collector of remarks on records. Equal remarks are reported once, with their number."""

    def __init__(self) -> None:
        self._met: dict[tuple[str, str], tuple[int, str]] = {}

    def add(self, noun: str, text: str, where: str) -> None:
        """Add a remark `text` on an object of the kind `noun` (for example "image"), in the record `where`."""
        count, first = self._met.get((noun, text), (0, where))
        self._met[noun, text] = count + 1, first

    def say(self, console: Console) -> None:
        """Report all remarks, in the order of their first occurrence."""
        for (noun, text), (count, where) in self._met.items():
            console.warn(f"{counted(count, noun)} {text}; first: {where}")
