"""Build a dataset folder image by image from other files, and helpers that all format converters share."""

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path, PurePosixPath
from typing import Any, Final

import numpy as np

from skope import coco, schema, shards
from skope.dataset import CARD, Dataset, open_dataset
from skope.errors import UserError
from skope.files import link, read_bytes, write_bytes, write_json, write_text
from skope.gen.output import card_text
from skope.gen.output.card_counts import Counts, kind_of
from skope.keypoints import Scheme
from skope.schema import Annotation, AnnotationFile, Image
from skope.version import __version__

LICENCE_FILE: Final = "LICENCE.txt"
"""File of every export that holds the dataset's licence."""

SPLIT_NAME: Final = re.compile(r"\w[\w.-]*")
"""What a split may be called: the name becomes that of its annotation file."""


@dataclass
class DatasetBuilder:
    """Writes a dataset folder at `root`, image by image; ids count through all splits from 1."""

    root: Path
    scheme: Scheme
    counts: Counts = field(default_factory=Counts)
    _splits: dict[str, tuple[list[Image], list[Annotation]]] = field(default_factory=dict)

    def add(self, split: str, image: Image, vehicles: Iterable[Annotation], files: Mapping[str, Path | bytes]) -> None:
        """Add an image.

        Args:
            split: Split that it goes to.
            image: Its record; `id` and `split` are set here.
            vehicles: Its annotations; their ids are set here.
            files: Path in the dataset to what it is to hold: bytes, or the file (or member of a shard) at a path.
        """
        images, annotations = self._splits.setdefault(split, ([], []))
        for name, content in files.items():
            place_file(content, self.root / name)
        self.counts.images += 1
        number = self.counts.images
        images.append(replace(image, id=number, split=split))
        own = []
        for vehicle in vehicles:
            self.counts.vehicles += 1
            own.append(replace(vehicle, id=self.counts.vehicles, image_id=number, category_id=schema.CATEGORY_ID))
        annotations += own
        ignored = Counter(vehicle.ignore_reason or "unnamed" for vehicle in own if vehicle.ignored)
        kinds = [kind_of(vehicle.iscrowd, vehicle.vehicle_type) for vehicle in own]
        places = {"split": split, "site": image.site, "weather": image.weather}
        self.counts.add(places, kinds, {"ignored": ignored})

    def finish(self, *, command: str, licence: str, label_rules: Sequence[str], **more: Any) -> None:
        """Write annotation files, card and README.

        Args:
            command: Command line that makes this dataset, for the card.
            licence: What the images may be used under.
            label_rules: Sentences that say what is labelled.
            more: Further fields of the card.

        Raises:
            UserError: No image was added.
        """
        if not self.counts.images:
            raise UserError("no image was found: nothing to write")
        for split, (images, annotations) in self._splits.items():
            file = AnnotationFile(
                images=tuple(images),
                annotations=tuple(annotations),
                info={"split": split},
                name=split,
                scheme=self.scheme,
            )
            coco.write(self.root / "annotations" / f"{split}.json", file)
        card = {
            "version": schema.VERSION,
            "keypoint_scheme": self.scheme.name,
            "format": "folder",
            "command": command,
            "counts": self.counts.to_dict(),
            "label_rules": list(label_rules),
            "versions": {"skope": __version__},
            "licence": licence,
            **more,
        }
        write_text(self.root / "README.md", card_text.markdown(card))
        write_json(self.root / CARD, card)


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


def place_file(content: Path | bytes, target: Path) -> None:
    """Put a file in place at `target`: write bytes, link the file at a path, or extract that member of a shard."""
    if isinstance(content, bytes):
        write_bytes(target, content)
    elif shards.split_member(content):
        write_bytes(target, shards.read(content))
    else:
        link(content, target)


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
    return " ".join(read_bytes(path).decode(errors="replace").split()) if path.is_file() else "not stated"
