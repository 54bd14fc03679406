"""What a dataset's labels are kept in: one annotation file a split beside the images, or shards of tar; both ways."""

from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import SpooledTemporaryFile
from typing import IO, Any, Final, Protocol

import orjson

from skope import coco, safe_names, shards
from skope.dataset import MANIFEST, Dataset, read_manifest
from skope.errors import UserError
from skope.files import json_bytes, read_bytes, read_json, sha256_of, write_bytes
from skope.gen.output.card_counts import Kind, kind_of

FORMATS: Final = ("folder", "shards")
_IN_MEMORY: Final = 1 << 26
"""Bytes of rows that are kept there."""


@dataclass(frozen=True)
class Labels:
    """A frame's rows of the annotation file, with its files."""

    name: str
    """<site>/<recording>_<frame>."""
    image: Mapping[str, Any]
    rows: list[bytes]
    """Annotations of the frame, a JSON object each; `id` and `image_id` come first."""
    kinds: list[Kind]
    """Kind of each annotation."""
    sha256: Mapping[str, str]
    """Checksums of the frame's files, by path in the dataset."""
    tally: Any
    """What the rules did to the frame's vehicles, for the card's counts."""


class DatasetWriter(Protocol):
    """Writes the labels of recordings, one after the other, and then the manifest."""

    def add_file(self, path: Path) -> None:
        """Name a file of the dataset, by its path in it, in the manifest."""
        ...

    def add(self, split: str, frames: Iterable[Labels], source: Path) -> None:
        """Write the frames of a recording, whose image and depth files are in the folder `source`."""
        ...

    def finish(self) -> None: ...


class _Manifest:
    def __init__(self, root: Path) -> None:
        self.root = root
        self.sums: dict[str, str] = {}
        self.tallies: dict[str, Any] = {}

    def add_file(self, path: Path) -> None:
        self.sums[str(path)] = sha256_of(self.root / path)

    def finish(self) -> None:
        content = {"sha256": dict(sorted(self.sums.items())), "tallies": self.tallies}
        write_bytes(self.root / MANIFEST, orjson.dumps(content, option=orjson.OPT_INDENT_2 | orjson.OPT_APPEND_NEWLINE))


class Folder(_Manifest):
    """Annotation files; images and depth beside them."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._files = ExitStack()
        self._splits: dict[str, tuple[list[bytes], IO[bytes]]] = {}
        """Rows of images in memory, and those of vehicles, a line each, in a temporary file when they are many."""

    def add(self, split: str, frames: Iterable[Labels], source: Path) -> None:
        if split not in self._splits:
            rows = SpooledTemporaryFile(_IN_MEMORY, dir=str(self.root))  # noqa: SIM115 - the stack closes it
            self._splits[split] = [], self._files.enter_context(rows)
        images, annotations = self._splits[split]
        for frame in frames:
            image = {**frame.image}
            for key, kind in (("file_name", "images"), ("depth_file_name", "depth")):
                if key in image:
                    there = image[key]
                    image[key] = f"{kind}/{frame.name}{Path(there).suffix}"
                    self.sums[image[key]] = frame.sha256[there]
                    if source != self.root:
                        write_bytes(self.root / image[key], shards.read(source / there))
            images.append(json_bytes(image))
            annotations.writelines(row + b"\n" for row in frame.rows)
            self.tallies[image["file_name"]] = frame.tally

    def finish(self) -> None:
        with self._files:
            for split, (images, annotations) in self._splits.items():
                path = Path("annotations") / f"{split}.json"
                annotations.seek(0)
                coco.write_lines(self.root / path, {"split": split}, images, (row[:-1] for row in annotations))
                self.add_file(path)
        super().finish()


class Shards(_Manifest):
    """Writes a tar shard for each recording, in place of its loose files."""

    def __init__(self, root: Path) -> None:
        super().__init__(root)
        self._numbers: dict[str, int] = {}

    def add(self, split: str, frames: Iterable[Labels], source: Path) -> None:
        number = self._numbers.get(split, 0)
        self._numbers[split] = number + 1
        path = Path(shards.FOLDER) / f"{split}-{number:06d}.tar"
        shard, loose = self.root / path, list[Path]()
        members = self._members(path, frames, source, loose)
        if shard.with_suffix(".json").is_file():
            # Its index came last: it is whole, and its files may be gone.
            for _ in members:
                pass
        else:
            shards.write_shard(shard, ((name, content) for name, content in _read(members)))
        for file in (path, path.with_suffix(".json")):
            self.add_file(file)
        if source == self.root:
            for file in loose:
                file.unlink(missing_ok=True)
                with suppress(OSError):  # until it is empty
                    file.parent.rmdir()
                    file.parent.parent.rmdir()

    def _members(
        self, path: Path, frames: Iterable[Labels], source: Path, loose: list[Path]
    ) -> Iterator[tuple[str, Path | bytes]]:
        for frame in frames:
            image = {**frame.image}
            for key, kind in (("file_name", ""), ("depth_file_name", ".depth")):
                if key in image:
                    there = image[key]
                    member = f"{frame.name}{kind}{Path(there).suffix}"
                    image[key] = f"{path}/{member}"
                    self.sums[image[key]] = frame.sha256[there]
                    loose.append(source / there)
                    yield member, source / there
            self.tallies[image["file_name"]] = frame.tally
            rows = b",".join(frame.rows)
            yield f"{frame.name}.json", b'{"image":%b,"annotations":[%b]}' % (json_bytes(image), rows)


def unpack_shards(root: Path) -> None:
    """Turn the images and depth of all whole shards back into loose files, and remove the shards.

    A shard without its index was not finished: its frames are still loose files.
    """
    for shard in sorted((root / shards.FOLDER).glob("*.tar")):
        for name in shards.members_of(shard):
            stem, _, suffix = name.partition(".")
            kind, ending = ("depth", suffix[len("depth.") :]) if suffix.startswith("depth.") else ("images", suffix)
            if ending != "json":
                loose = safe_names.relative(f"{shard}: {name}", f"{kind}/{stem}.{ending}")
                write_bytes(root / loose, shards.read_member(shard, name))
        shard.with_suffix(".json").unlink(missing_ok=True)
        shard.unlink()


def _read(members: Iterable[tuple[str, Path | bytes]]) -> Iterator[tuple[str, bytes]]:
    for name, content in members:
        yield name, content if isinstance(content, bytes) else read_bytes(content)


def numbered(row: bytes, id_: int, image_id: int) -> bytes:
    """A row of `Labels` under other ids."""
    assert row.startswith(b'{"id":')
    _, _, rest = row.split(b",", 2)
    return b'{"id":%d,"image_id":%d,%b' % (id_, image_id, rest)


def writer_of(form: str, root: Path) -> DatasetWriter:
    """The writer of a format."""
    return Shards(root) if form == "shards" else Folder(root)


def frames_of_split(dataset: Dataset, split: str) -> Iterator[Labels]:
    """Labels of the frames of a split, of a dataset that `skope gen` made; a UserError names what is missing."""
    manifest = read_manifest(dataset.root)
    for image, annotations in rows_of(dataset, split):
        lost = [key for key in ("site", "recording", "frame_index") if image.get(key) is None]
        if lost:
            raise UserError(f"{dataset.root}: {split}: image {image['id']}: field {lost[0]} is missing")
        name = f"{image['site']}/{image['recording']}_{image['frame_index']:06d}"
        files = [image[key] for key in ("file_name", "depth_file_name") if key in image]
        try:
            sums, tally = {file: manifest["sha256"][file] for file in files}, manifest["tallies"][files[0]]
        except KeyError as error:
            raise UserError(f"{dataset.root / MANIFEST}: names no {error}") from None
        # Other tools may have rewritten the file: ids are put first, as `numbered` needs them.
        rows = [json_bytes({"id": row["id"], "image_id": row["image_id"], **row}) for row in annotations]
        kinds = [kind_of(row["iscrowd"], row.get("vehicle_type")) for row in annotations]
        yield Labels(name, image, rows, kinds, sums, tally)


def rows_of(dataset: Dataset, split: str) -> Iterator[tuple[dict[str, Any], list[Any]]]:
    """JSON records of a split's images, each with those of its annotations; a UserError names a wrong image."""
    if dataset.sharded:
        for shard in shards.shards_of(dataset.root, split):
            for labels in shards.labels_in(shard):
                coco.images_of(shard, [labels["image"]])
                yield labels["image"], labels["annotations"]
        return
    path = dataset.root / "annotations" / f"{split}.json"
    document = read_json(path)
    coco.images_of(path, document["images"])
    own: dict[int, list[Any]] = {image["id"]: [] for image in document["images"]}
    for annotation in document["annotations"]:
        own[annotation["image_id"]].append(annotation)
    for image in document["images"]:
        yield image, own[image["id"]]
