"""Frames and card of a dataset made from other files, and helpers that all format converters share."""

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
"""File of every export that holds the dataset's licence."""

SPLIT_NAME: Final = re.compile(r"\w[\w.-]*")
"""Names that a split may have: the name becomes that of its annotation file."""


def labelled_frame(
    split: str,
    image: Image,
    vehicles: Iterable[Annotation],
    files: Mapping[str, Path | bytes],
    sums: Mapping[str, str] | None = None,
    road_users: Iterable[RoadUser] = (),
) -> FrameFiles:
    """A frame of a dataset folder under construction, whose ids its writer gives.

    Args:
        split: Split that it goes to.
        image: Its record, with the names that its files are to have.
        vehicles: Its annotations.
        files: Content of its files by these names.
        sums: Their SHA-256 as far as it is known; that of others is computed.
        road_users: Its labels of people on foot and on two wheels.
    """
    known = schema.CATEGORY_ID
    own = [each if each.category_id == known else replace(each, category_id=known) for each in vehicles]
    ignored = Counter(vehicle.ignore_reason or "unnamed" for vehicle in own if vehicle.ignored)
    contents = {name: _in_memory(content) for name, content in files.items()}
    told = sums or {}
    labels = Labels(
        name=str(PurePosixPath(*PurePosixPath(image.file_name).parts[1:]).with_suffix("")),
        image=coco.image_to_dict(replace(image, split=split)),
        **label_fields(own, road_users),
        sha256={name: told.get(name) or _sum_of(content) for name, content in contents.items()},
        tally={"ignored": dict(ignored)},
    )
    return FrameFiles(contents, labels)


def _in_memory(content: Path | bytes) -> Path | bytes:
    """The content itself where it is a shard's member, so that it is read once."""
    return shards.read(content) if isinstance(content, Path) and shards.split_member(content) else content


def _sum_of(content: Path | bytes) -> str:
    return checksum(content) if isinstance(content, bytes) else sha256_of(content)


def finish_dataset(
    writer: FolderWriter, *, command: str, licence: str, label_rules: Sequence[str], **more: Any
) -> None:
    """Write annotation files, manifest, README and card of a dataset that was joined or imported.

    Args:
        writer: It was given all frames.
        command: Command line that makes this dataset, for the card.
        licence: What the images may be used under.
        label_rules: Sentences that say what is labelled.
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
    """Open the dataset folder at `root`; a UserError where it has no annotations."""
    dataset = open_dataset(root)
    if not dataset.splits:
        raise UserError(f"{root}: has no annotations")
    return dataset


def check_outside(out: Path, sources: Iterable[Path]) -> None:
    """Raise a UserError where the output `out` lies inside one of the source folders, which must not change."""
    for source in sources:
        if source.resolve() in out.resolve().parents:
            raise UserError(f"{out}: is inside {source}, which is left as it is; choose another folder")


def bare_name(name: str) -> str:
    """<site>/<frame>.<suffix> of a skope file name: without the folder `images/` or `depth/`, or the shard's path."""
    parts = PurePosixPath(name).parts
    after = max((i + 1 for i, part in enumerate(parts) if part.endswith(".tar")), default=0)
    if after:
        return re.sub(r"(?<=[^/])\.depth(?=\.\w+$)", "", "/".join(parts[after:]))
    return "/".join(parts[1:] if parts[0] in ("images", "depth") else parts)


def frame_rate(images: Sequence[Image]) -> float:
    """Frames a second of a recording's images, from the median of their time steps; 2, as in presets, without times."""
    times = [image.time_s for image in images if image.time_s is not None]
    steps = np.diff(times)
    return float(1 / np.median(steps)) if len(steps) and (steps > 0).all() else 2.0


def licence_beside(folder: Path) -> str:
    """The licence that `LICENCE_FILE` in a folder states; "not stated" where there is no such file."""
    path = folder / LICENCE_FILE
    return licences.in_text(read_bytes(path).decode(errors="replace")) if path.is_file() else licences.NOT_STATED


class Remarks:
    """Collects remarks while records are read one after the other."""

    def __init__(self) -> None:
        self._met: dict[tuple[str, str], tuple[int, str]] = {}

    def add(self, noun: str, text: str, where: str) -> None:
        """Note that `text` holds for one more thing that `noun` names, at `where`."""
        count, first = self._met.get((noun, text), (0, where))
        self._met[noun, text] = count + 1, first

    def say(self, console: Console) -> None:
        """Say all that was noted, in the order in which it was first met."""
        for (noun, text), (count, where) in self._met.items():
            console.warn(f"{counted(count, noun)} {text}; first: {where}")
