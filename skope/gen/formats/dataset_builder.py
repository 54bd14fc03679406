"""A dataset folder made of images and vehicles that come from elsewhere."""

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
from skope.gen.output.counts import Counts, kind_of
from skope.keypoints import Scheme
from skope.schema import Annotation, AnnotationFile, Image
from skope.version import __version__

LICENCE_FILE: Final = "LICENCE.txt"
"""In every export: the dataset's licence."""


SPLIT_NAME: Final = re.compile(r"\w[\w.-]*")
"""What a split may be called: its file bears the name."""


@dataclass
class Gathered:
    """A dataset that grows image by image below `root`; ids count through all of it from 1."""

    root: Path
    scheme: Scheme
    counts: Counts = field(default_factory=Counts)
    _splits: dict[str, tuple[list[Image], list[Annotation]]] = field(default_factory=dict)

    def add(self, split: str, image: Image, vehicles: Iterable[Annotation], files: Mapping[str, Path | bytes]) -> None:
        """Take an image with its vehicles; `files` are what lies, or shall lie, under its file names."""
        images, annotations = self._splits.setdefault(split, ([], []))
        for name, content in files.items():
            put(content, self.root / name)
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
        """Write annotations and card; `more` are further fields of the card."""
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
    """A dataset to read from; one without a split is a UserError."""
    dataset = open_dataset(root)
    if not dataset.splits:
        raise UserError(f"{root}: has no annotations")
    return dataset


def outside(out: Path, sources: Iterable[Path]) -> None:
    """Raise a UserError where `out` lies in one of the folders that are read from."""
    for source in sources:
        if source.resolve() in out.resolve().parents:
            raise UserError(f"{out}: is inside {source}, which is left as it is; choose another folder")


def put(content: Path | bytes, target: Path) -> None:
    """Write bytes, or bring the file (or member of a shard) at a path, to `target`."""
    if isinstance(content, bytes):
        write_bytes(target, content)
    elif shards.split_member(content):
        write_bytes(target, shards.read(content))
    else:
        link(content, target)


def plain(name: str) -> str:
    """A file name of ours, in a folder or in a shard, without what stands before site and frame."""
    parts = PurePosixPath(name).parts
    after = max((i + 1 for i, part in enumerate(parts) if part.endswith(".tar")), default=0)
    if after:
        return re.sub(r"(?<=[^/])\.depth(?=\.\w+$)", "", "/".join(parts[after:]))
    return "/".join(parts[1:] if parts[0] in ("images", "depth") else parts)


def frame_rate(images: Sequence[Image]) -> float:
    """Frames a second of a recording's images; 2, this program's usual rate, where no times say it."""
    times = [image.time_s for image in images if image.time_s is not None]
    steps = np.diff(times)
    return float(1 / np.median(steps)) if len(steps) and (steps > 0).all() else 2.0


def licence_beside(folder: Path) -> str:
    """What an export of ours says in `LICENCE_FILE`; "not stated" without one."""
    path = folder / LICENCE_FILE
    return " ".join(read_bytes(path).decode(errors="replace").split()) if path.is_file() else "not stated"
