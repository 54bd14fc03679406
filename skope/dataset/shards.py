"""Datasets of many frames as tar shards in the WebDataset convention: image, depth and one JSON of labels per frame.

`shards/<split>-<number>.tar` contains `<site>/<recording>_<frame>` with `.json` and the suffixes of image and depth
file. Beside it, `<split>-<number>.json` contains the position of each member, so that members can be read one by one in
any order. The path of a member is like that of a file: `shards/train-000000.tar/t01_mill_corner/00_000000.jpg`.
"""

import io
import tarfile
from collections.abc import Iterable, Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Any, Final

from skope.errors import UserError
from skope.files.atomic import read_bytes, replacing
from skope.files.json_files import parse_json, read_json, write_json
from skope.files.safe_names import is_relative

SHARD_FOLDER: Final = "shards"
KEPT_INDICES: Final = 4096
"""Number of indices in memory."""


def write_shard(path: Path, members: Iterable[tuple[str, bytes]]) -> None:
    """Write a shard and its index, each atomically and the index last; equal members give equal bytes."""
    index = {}
    with replacing(path) as temporary, tarfile.open(temporary, "w", format=tarfile.USTAR_FORMAT) as tar:
        for name, data in members:
            info = tarfile.TarInfo(name)
            info.size = len(data)
            header = tar.offset
            tar.addfile(info, io.BytesIO(data))
            index[name] = [header + tarfile.BLOCKSIZE, len(data)]
    write_json(path.with_suffix(".json"), index)


def members_of(path: Path) -> tuple[str, ...]:
    """Return the names of the members of a complete shard; empty before its index is written."""
    index = path.with_suffix(".json")
    return tuple(_index(index, True)) if index.is_file() else ()


def split_member(path: Path) -> tuple[Path, str] | None:
    """Return the shard and the member of a path like `shards/train-000000.tar/a/b.jpg`; None for other paths."""
    parts = path.parts
    for k in range(len(parts) - 1, 0, -1):
        if parts[k - 1].endswith(".tar"):
            return Path(*parts[:k]), "/".join(parts[k:])
    return None


def read(path: Path) -> bytes:
    """Return the content of a file or, if the path is that of a member, of the member."""
    member = split_member(path)
    return read_member(*member) if member else read_bytes(path)


def read_member(shard: Path, name: str) -> bytes:
    """Return a member's bytes. Raises UserError if the shard or the member is missing or broken."""
    offset, size = _byte_range(shard, name)
    try:
        with shard.open("rb") as file:
            file.seek(offset)
            data = file.read(size)
    except FileNotFoundError:
        raise UserError(f"{shard}: no such file") from None
    except OSError as error:
        raise UserError(f"{shard}: cannot be read: {error.strerror or error}") from None
    if len(data) < size:
        raise UserError(f"{shard}/{name}: truncated shard")
    return data


def size(path: Path) -> int:
    """Return the size of a file or member in bytes, without reading it; -1 if it does not exist."""
    try:
        member = split_member(path)
        return _byte_range(*member)[1] if member else path.stat().st_size
    except (OSError, UserError):
        return -1


def _byte_range(shard: Path, name: str) -> tuple[int, int]:
    places = _index(shard.with_suffix(".json"), shard.with_suffix(".json").is_file())
    if name not in places:
        raise UserError(f"{shard}/{name}: no such file")
    offset, size = places[name]
    return offset, size


@lru_cache(maxsize=KEPT_INDICES)
def _index(path: Path, _exists: bool) -> Mapping[str, tuple[int, int]]:
    value = read_json(path)
    good = isinstance(value, dict) and all(
        is_relative(name)
        and isinstance(entry, list)
        and len(entry) == 2
        and all(isinstance(n, int) and n >= 0 for n in entry)
        for name, entry in value.items()
    )
    if not good:
        raise UserError(f"{path}: not an index of a shard")
    return {name: (offset, size) for name, (offset, size) in value.items()}


def shards_of(root: Path, split: str) -> list[Path]:
    """Return the shards of a split in order."""
    return sorted((root / SHARD_FOLDER).glob(f"{split}-[0-9][0-9][0-9][0-9][0-9][0-9].tar"))


def splits_of(root: Path) -> tuple[str, ...]:
    """Return the splits that have shards, in alphabetical order."""
    return tuple(sorted({path.name.rpartition("-")[0] for path in (root / SHARD_FOLDER).glob("[!.]*-*.tar")}))


def labels_in(shard: Path) -> Iterator[dict[str, Any]]:
    """Yield the labels of a shard's frames, {"image": ..., "annotations": [...]}, in one pass through the file."""
    names = sorted(_index(shard.with_suffix(".json"), True).items(), key=lambda item: item[1])
    for name, _ in names:
        if name.endswith(".json"):
            data = read_member(shard, name)
            try:
                labels = parse_json(data)
            except ValueError as error:
                raise UserError(f"{shard}/{name}: not valid JSON: {error}") from None
            if not isinstance(labels, dict) or not {"image", "annotations"} <= labels.keys():
                raise UserError(f"{shard}/{name}: expected an object with image and annotations")
            yield labels
