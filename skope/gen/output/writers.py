"""Write a dataset's frames and read them back: one annotation file per split beside the images, or tar shards.

Also counts images and vehicles for the card.
"""

import hashlib
import math
from abc import ABC, abstractmethod
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, Any, Final

import orjson

from skope.dataset import coco, shards
from skope.dataset.folder import MANIFEST_FILE, Dataset, read_manifest
from skope.errors import UserError
from skope.files import safe_names
from skope.files.atomic import link, sha256_of, write_bytes
from skope.files.json_files import json_bytes, read_json
from skope.keypoints import SKOPE33, Scheme
from skope.schema import CATEGORY_ID, CATEGORY_NAMES, ROAD_USER_IDS, VEHICLE_ALONE, Annotation, RoadUser

CountKind = tuple[str, str | None, str]
"""Key under which a label is counted: "ground_truth" or "ignored", the vehicle type, and the category."""


def count_kind(iscrowd: int, vehicle_type: str | None, category: str = "vehicle") -> CountKind:
    """Return the count key of a vehicle (from two annotation fields) or another road user (from its category)."""
    return "ignored" if iscrowd else "ground_truth", vehicle_type, category


class Counts:
    """Counts for the card: images, ground truth and ignored vehicles by split, site, weather, type and reason.

    Pedestrians and two-wheelers are counted separately, by category.
    """

    def __init__(self) -> None:
        self.images = self.labels = 0
        self.by: dict[str, defaultdict[str, Counter[str]]] = {
            group: defaultdict(Counter) for group in ("split", "site", "weather", "vehicle_type", "category")
        }
        self.tally: Counter[str] = Counter()
        self.ignored: Counter[str] = Counter()
        self.apart_m: list[float] = []
        self.most_apart_m = 0.0

    def add(self, places: Mapping[str, str | None], kinds: Iterable[CountKind], tally: Mapping[str, Any]) -> None:
        """Count an image with its labels; `places` contains its split, site and weather.

        Unknown properties of an image or a vehicle are not counted.
        """
        known = [(group, name) for group, name in places.items() if name is not None]
        for group, name in known:
            self.by[group][name]["images"] += 1
        for (kind, type_, category), number in Counter(kinds).items():
            if category != "vehicle":
                self.by["category"][category][kind] += number
                continue
            for group, name in (*known, *([("vehicle_type", type_)] if type_ is not None else [])):
                self.by[group][name][kind] += number
        tally = dict(tally)
        self.ignored.update(tally.pop("ignored"))
        self.apart_m.append(tally.pop("apart_m", 0.0))
        self.most_apart_m = max(self.most_apart_m, tally.pop("most_apart_m", 0.0))
        self.tally.update(tally)

    def localizer_difference(self) -> dict[str, float | None]:
        """Return mean and maximum distance between trilateration and rigid transform over all keypoints, metres."""
        vehicles = self.tally["vehicles"]
        if not vehicles:
            return {"mean": None, "max": None}
        # The exact sum does not depend on the order of its terms.
        return {"mean": round(math.fsum(self.apart_m) / vehicles, 6), "max": round(self.most_apart_m, 6)}

    def to_dict(self) -> dict[str, Any]:
        return {
            "images": self.images,
            "ground_truth": sum(counter["ground_truth"] for counter in self.by["split"].values()),
            "ignored": dict(sorted(self.ignored.items())),
            "by_split": self._table("split", "images", "ground_truth", "ignored"),
            "by_site": self._table("site", "images", "ground_truth", "ignored"),
            "by_weather": self._table("weather", "images", "ground_truth", "ignored"),
            "by_vehicle_type": self._table("vehicle_type", "ground_truth", "ignored"),
            **({"by_category": self._table("category", "ground_truth", "ignored")} if self.by["category"] else {}),
        }

    def _table(self, group: str, *columns: str) -> dict[str, dict[str, int]]:
        return {name: {column: counter[column] for column in columns} for name, counter in self.by[group].items()}


DATASET_FORMATS: Final = ("folder", "shards")
_IN_MEMORY: Final = 1 << 26
"""Maximum size of the label rows of a split in memory, bytes; larger ones are in a temporary file."""


@dataclass(frozen=True)
class Labels:
    """A frame's rows of the annotation file, and its entries in the manifest."""

    name: str
    """Name of the frame: <site>/<recording>_<frame>."""
    image: Mapping[str, Any]
    """Image record; its files have the names in a dataset folder: images/<name>.jpg, depth/<name>.png."""
    rows: list[bytes]
    """Annotations of the frame, one JSON object each; `id` and `image_id` come first."""
    kinds: list[CountKind]
    """Kind of each annotation."""
    sha256: Mapping[str, str]
    """Checksums of the frame's files by name."""
    tally: Any
    """Effects of the rules on the frame's vehicles, for the counts on the card."""


@dataclass(frozen=True)
class FrameFiles:
    """A frame to write: the content of its files by name, and its labels."""

    files: Mapping[str, Path | bytes]
    """Content of the files: bytes, or the path of a file or shard member with the content."""
    labels: Labels


class DatasetWriter(ABC):
    """Writer of frames to the dataset folder at `root`, recording by recording, and then of the manifest.

    Ids of images and annotations count from 1 through the whole dataset, in the order in which frames are added.
    `categories` are the names of the labelled categories.
    """

    def __init__(self, root: Path, scheme: Scheme = SKOPE33, categories: tuple[str, ...] = VEHICLE_ALONE) -> None:
        self.root, self.scheme, self.categories = root, scheme, categories
        self._counts = Counts()
        self._sums: dict[str, str] = {}
        self._tallies: dict[str, Any] = {}

    def add_file(self, path: Path) -> None:
        """Add a file of the dataset to the manifest, by its path in the dataset."""
        self._sums[str(path)] = sha256_of(self.root / path)

    @abstractmethod
    def add(self, split: str, frames: Iterable[FrameFiles]) -> None:
        """Write the frames of a recording; files that are already at their place in the folder are not copied."""

    def finish(self) -> Counts:
        """Write the remaining content, with the manifest last; return the counts of images and vehicles."""
        content = {"sha256": dict(sorted(self._sums.items())), "tallies": self._tallies}
        write_bytes(
            self.root / MANIFEST_FILE, orjson.dumps(content, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE)
        )
        return self._counts

    def _numbered(self, split: str, labels: Labels) -> Labels:
        """Count the labels and return them with the next ids."""
        counts = self._counts
        places = {"split": split, "site": labels.image.get("site"), "weather": labels.image.get("weather")}
        counts.add(places, labels.kinds, labels.tally)
        counts.images += 1
        rows = [_with_ids(row, counts.labels + k, counts.images) for k, row in enumerate(labels.rows, start=1)]
        counts.labels += len(rows)
        return replace(labels, image={**labels.image, "id": counts.images}, rows=rows)


class FolderWriter(DatasetWriter):
    """Writer of annotation files beside loose images and depth files."""

    def __init__(self, root: Path, scheme: Scheme = SKOPE33, categories: tuple[str, ...] = VEHICLE_ALONE) -> None:
        super().__init__(root, scheme, categories)
        self._open = ExitStack()
        self._splits: dict[str, tuple[list[bytes], IO[bytes]]] = {}
        """Rows of images (in memory) and of labels (one per line, in a temporary file if there are many), by split."""

    def add(self, split: str, frames: Iterable[FrameFiles]) -> None:
        if split not in self._splits:
            rows = SpooledTemporaryFile(_IN_MEMORY, dir=str(self.root))  # noqa: SIM115 - the stack closes it
            self._splits[split] = [], self._open.enter_context(rows)
        images, annotations = self._splits[split]
        for frame in frames:
            labels = self._numbered(split, frame.labels)
            for name, content in frame.files.items():
                if content != self.root / name:
                    place_file(content, self.root / name)
                self._sums[name] = labels.sha256[name]
            images.append(json_bytes(labels.image))
            annotations.writelines(row + b"\n" for row in labels.rows)
            self._tallies[labels.image["file_name"]] = labels.tally

    def finish(self) -> Counts:
        with self._open:
            for split, (images, annotations) in self._splits.items():
                path = Path("annotations") / f"{split}.json"
                annotations.seek(0)
                rows = (row[:-1] for row in annotations)
                coco.write_lines(self.root / path, {"split": split}, images, rows, self.scheme, self.categories)
                self.add_file(path)
        return super().finish()


class ShardWriter(DatasetWriter):
    """Writer of one tar shard per recording; it removes the folder's loose files that are in the shard."""

    def __init__(self, root: Path, scheme: Scheme = SKOPE33, categories: tuple[str, ...] = VEHICLE_ALONE) -> None:
        super().__init__(root, scheme, categories)
        self._numbers: dict[str, int] = {}

    def add(self, split: str, frames: Iterable[FrameFiles]) -> None:
        number = self._numbers.get(split, 0)
        self._numbers[split] = number + 1
        path = Path(shards.SHARD_FOLDER) / f"{split}-{number:06d}.tar"
        shard, loose = self.root / path, list[Path]()
        members = self._members(path, split, frames, loose)
        if shard.with_suffix(".json").is_file():
            # The index is written last: the shard is complete, and its loose files may be gone.
            for _ in members:
                pass
        else:
            shards.write_shard(shard, ((name, _content_bytes(content)) for name, content in members))
        for file in (path, path.with_suffix(".json")):
            self.add_file(file)
        for file in loose:
            file.unlink(missing_ok=True)
            with suppress(OSError):  # until it is empty
                file.parent.rmdir()
                file.parent.parent.rmdir()

    def _members(
        self, path: Path, split: str, frames: Iterable[FrameFiles], loose: list[Path]
    ) -> Iterator[tuple[str, Path | bytes]]:
        for frame in frames:
            labels = self._numbered(split, frame.labels)
            image = dict(labels.image)
            for key, kind in (("file_name", ""), ("depth_file_name", ".depth")):
                if key in image:
                    name = image[key]
                    content, member = frame.files[name], f"{labels.name}{kind}{Path(name).suffix}"
                    image[key] = f"{path}/{member}"
                    self._sums[image[key]] = labels.sha256[name]
                    if content == self.root / name:
                        loose.append(self.root / name)
                    yield member, content
            self._tallies[image["file_name"]] = labels.tally
            rows = b",".join(labels.rows)
            yield f"{labels.name}.json", b'{"image":%b,"annotations":[%b]}' % (json_bytes(image), rows)


def writer_of(
    form: str, root: Path, scheme: Scheme = SKOPE33, categories: tuple[str, ...] = VEHICLE_ALONE
) -> DatasetWriter:
    """Return the writer of a format.

    Args:
        form: One of `DATASET_FORMATS`.
        root: Folder of the dataset.
        scheme: Keypoint scheme of the labels.
        categories: Names of the labelled categories.
    """
    return (ShardWriter if form == "shards" else FolderWriter)(root, scheme, categories)


def categories_field(categories: tuple[str, ...]) -> dict[str, Any]:
    """Return the card's field with the labelled categories; empty if vehicles are the only category."""
    return {"categories": list(categories)} if categories != VEHICLE_ALONE else {}


def label_fields(vehicles: Iterable[Annotation], road_users: Iterable[RoadUser]) -> dict[str, Any]:
    """Return the fields of `Labels` for a frame's vehicles, followed by its other road users."""
    annotations, users = list(vehicles), list(road_users)
    rows = [*map(coco.annotation_to_dict, annotations), *map(coco.road_user_to_dict, users)]
    kinds = [count_kind(vehicle.iscrowd, vehicle.vehicle_type) for vehicle in annotations]
    kinds += [count_kind(user.iscrowd, None, user.category) for user in users]
    return {"rows": list(map(json_bytes, rows)), "kinds": kinds}


def checksum(data: bytes) -> str:
    """Return the SHA-256 checksum in hexadecimal."""
    return hashlib.sha256(data).hexdigest()


def unpack_shards(root: Path) -> None:
    """Extract the images and depth files of all complete shards to loose files, and remove the shards.

    A shard without its index is incomplete: its frames are still loose files.
    """
    for shard in sorted((root / shards.SHARD_FOLDER).glob("*.tar")):
        for name in shards.members_of(shard):
            stem, _, suffix = name.partition(".")
            kind, ending = ("depth", suffix[len("depth.") :]) if suffix.startswith("depth.") else ("images", suffix)
            if ending != "json":
                loose = safe_names.relative(f"{shard}: {name}", f"{kind}/{stem}.{ending}")
                write_bytes(root / loose, shards.read_member(shard, name))
        shard.with_suffix(".json").unlink(missing_ok=True)
        shard.unlink()


def _content_bytes(content: Path | bytes) -> bytes:
    return content if isinstance(content, bytes) else shards.read(content)


def place_file(content: Path | bytes, target: Path) -> None:
    """Put a file in place at `target`: write bytes, link the file at a path, or extract that member of a shard."""
    if isinstance(content, Path) and not shards.split_member(content):
        link(content, target)
    else:
        write_bytes(target, _content_bytes(content))


def _with_ids(row: bytes, id_: int, image_id: int) -> bytes:
    """Return a row of `Labels` with other ids."""
    assert row.startswith(b'{"id":')
    _, _, rest = row.split(b",", 2)
    return b'{"id":%d,"image_id":%d,%b' % (id_, image_id, rest)


def frames_of_split(dataset: Dataset, split: str) -> Iterator[FrameFiles]:
    """Yield the frames of a split of a dataset from `skope gen`. Raises UserError if data are missing."""
    manifest = read_manifest(dataset.root)
    for row, annotations in rows_of(dataset, split):
        lost = [key for key in ("site", "recording", "frame_index") if row.get(key) is None]
        if lost:
            raise UserError(f"{dataset.root}: {split}: image {row['id']}: field {lost[0]} is missing")
        image = {key: value for key, value in row.items() if value is not None}
        name = f"{image['site']}/{image['recording']}_{image['frame_index']:06d}"
        files: dict[str, Path | bytes] = {}
        sums = {}
        try:
            tally = manifest["tallies"][image["file_name"]]
            for key, folder in (("file_name", "images"), ("depth_file_name", "depth")):
                if key in image:
                    path = image[key]
                    image[key] = f"{folder}/{name}{Path(path).suffix}"
                    files[image[key]], sums[image[key]] = dataset.root / path, manifest["sha256"][path]
        except KeyError as error:
            raise UserError(f"{dataset.root / MANIFEST_FILE}: has no entry for {error}") from None
        # Other tools may have rewritten the file, so the ids are put first, as `_with_ids` requires.
        rows = [json_bytes({"id": row["id"], "image_id": row["image_id"], **row}) for row in annotations]
        kinds = [_kind_of_row(row, dataset.categories) for row in annotations]
        yield FrameFiles(files, Labels(name, image, rows, kinds, sums, tally))


def _kind_of_row(row: Mapping[str, Any], categories: tuple[str, ...]) -> CountKind:
    number = row.get("category_id", CATEGORY_ID)
    is_road_user = len(categories) > 1 and number in ROAD_USER_IDS
    return count_kind(
        row["iscrowd"], row.get("vehicle_type"), CATEGORY_NAMES[number - 1] if is_road_user else CATEGORY_NAMES[0]
    )


def rows_of(dataset: Dataset, split: str) -> Iterator[tuple[dict[str, Any], list[Any]]]:
    """Yield JSON records of a split's images, each with its annotations. Raises UserError for an invalid image."""
    if dataset.sharded:
        for shard in shards.shards_of(dataset.root, split):
            for labels in shards.labels_in(shard):
                coco.images_of(shard, [labels["image"]])
                yield labels["image"], labels["annotations"]
        return
    path = dataset.root / "annotations" / f"{split}.json"
    document = read_json(path)
    coco.images_of(path, document["images"])
    rows_by_image: dict[int, list[Any]] = {image["id"]: [] for image in document["images"]}
    for annotation in document["annotations"]:
        rows_by_image[annotation["image_id"]].append(annotation)
    for image in document["images"]:
        yield image, rows_by_image[image["id"]]
