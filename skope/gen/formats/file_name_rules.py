"""Interpretation of names in external files: path of an image, its camera and recording, its split.

There is no standard for such names. The rules are heuristics that docs/formats.md describes. Callers report their
result.
"""

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath
from typing import Final
from urllib.parse import unquote, urlsplit

from skope.files.safe_names import NAME_LIMITS, is_relative

SPLIT_NAMES: Final[Mapping[str, str]] = {
    **dict.fromkeys(("train", "training", "trainset"), "train"),
    **dict.fromkeys(("val", "valid", "validation", "valset"), "val"),
    **dict.fromkeys(("test", "testing", "testset"), "test"),
}
"""Names of splits in other programs, with the corresponding names in skope."""

_SAYS_NOTHING: Final = frozenset(
    (
        "annotation", "annotations", "annotations.coco", "coco", "data", "dataset", "default", "dsc", "dscf", "dscn",
        "export", "f", "frame", "frames", "image", "images", "img", "imgs", "instances", "jpegimages", "jpg",
        "keypoints", "label", "labels", "media", "obj_train_data", "person_keypoints", "photo", "photos", "pic",
        "picture", "pictures", "png", "result", "results", "screenshot", "snapshot", "upload", "uploads",
    )
)  # fmt: skip
"""Names of folders, annotation files and file prefixes that identify no camera, split or recording."""

_BEFORE_SPLIT: Final = re.compile(r"(?:person_keypoints|instances|keypoints|annotations|labels|coco)[_-]")
YEAR_ENDING: Final = re.compile(r"[_-]?(?:19|20)\d\d")
ROBOFLOW_ENDING: Final = re.compile(r"_(?:jpe?g|png|bmp|webp)\.rf\.\w+\Z", re.ASCII)
"""Suffix that Roboflow appends to a file's name."""
UPLOAD_PREFIX: Final = re.compile(r"\A[0-9a-f]{8}-(?=.)")
"""Prefix that Label Studio adds to a file's name."""
NUMBERED_NAME: Final = re.compile(r"(.*?)[_ .-]*([0-9]{1,15})")
DATED_NAME: Final = re.compile(
    r"(.*?)[_ .-]*((?:19|20)\d\d[_.-]?\d\d[_.-]?\d\d[_ T.-]*\d\d[_.h-]?\d\d(?:[_.m-]?\d\d)?)", re.ASCII
)
"""Name that ends in date and time: 20240501_173000, 2024-05-01T17-30-00."""
SKOPE_NAME: Final = re.compile(r"(.+)_([0-9]{6})")
_RECORDING_BYTES: Final = NAME_LIMITS.name_bytes - 8
"""Maximum bytes of a name before a number that makes it unique."""


@dataclass(frozen=True)
class Place:
    """Camera and recording of an image, derived from its name."""

    site: str | None
    """Camera: the nearest folder with an informative name."""
    film: tuple[str, str] | None
    """Folder and prefix of the file's name if several numbered images share them: a recording."""
    recording: str | None
    """Name of the recording; None if the file's name does not contain it."""
    frame: int | None
    """Number at the end of the file's name, for an image of a recording."""


def named_split(name: str) -> str | None:
    """Return the split that another program's name means, for example `Validation` or `instances_val2017`."""
    return SPLIT_NAMES.get(YEAR_ENDING.sub("", bare_stem(name.lower())))


def bare_stem(stem: str) -> str:
    """Return an annotation file's name without the part for its kind: train2017 for instances_train2017."""
    return _BEFORE_SPLIT.sub("", stem)


def split_of(stem: str, folders: Sequence[str]) -> tuple[str, str]:
    """Return the split of an annotation file.

    Args:
        stem: Its name without suffix.
        folders: Names of the folders above it, the nearest first.

    Returns:
        The split and its origin: "name", "folder" or "default".
    """
    known = named_split(stem)
    if known:
        return known, "name"
    if _telling(bare_stem(stem)):
        return stem, "name"
    by_folder = next((split for folder in folders if (split := named_split(folder))), None)
    return (by_folder, "folder") if by_folder else ("train", "default")


def source_name(parts: Sequence[str]) -> str:
    """Return the name of a source: the last of its folders and files (without suffix) with an informative name."""
    telling = [part for part in parts if _telling(part) and named_split(part) is None]
    return as_name(telling[-1]) if telling else "recording"


def slashed(name: str) -> str:
    """Return a path or the path of an address with forward slashes; Windows paths are converted."""
    if re.match(r"[A-Za-z][A-Za-z0-9+.-]+://", name):
        name = unquote(urlsplit(name).path).lstrip("/")
    name = name.replace("\\", "/")
    first = "/" if name.startswith("/") else ""
    return first + "/".join(part for part in name.split("/") if part not in ("", "."))


def endings(name: str) -> list[str]:
    """Return the relative paths at the end of a path of another machine, the longest first."""
    parts = [part for part in name.split("/") if part not in ("", ".")]
    whole = ["/".join(parts[i:]) for i in range(len(parts))]
    return [ending for ending in whole if is_relative(ending)]


def places(names: Sequence[str]) -> list[Place]:
    """Return camera and recording of the images of one annotation file, derived from all names together.

    Args:
        names: File names with forward slashes.
    """
    split = [_split(name) for name in names]
    numbers: dict[tuple[str, str], Counter[int]] = {}
    for folder, begins, number, _ in split:
        if number is not None:
            numbers.setdefault((folder, begins), Counter())[number] += 1
    out = []
    for folder, begins, number, ours in split:
        site = next((part for part in reversed(folder.split("/")) if _telling(part)), None)
        shared = numbers.get((folder, begins), Counter())
        film = number is not None and max(shared.values()) == 1 and (len(shared) > 1 or (ours and site is not None))
        out.append(
            Place(
                site=as_name(site) if site else None,
                film=(folder, begins) if film else None,
                recording=as_name(begins) if film and _telling(begins) else None,
                frame=number if film else None,
            )
        )
    return out


def as_name(text: str) -> str:
    """Return text as a valid name of a site or recording: at most about 90 bytes, without leading dots."""
    short = text.lstrip(".").encode()[:_RECORDING_BYTES].decode(errors="ignore")
    return short or "unnamed"


def _split(name: str) -> tuple[str, str, int | None, bool]:
    """Return folder, prefix and number of a file's name, and whether it has skope's form."""
    path = PurePosixPath(name)
    stem = UPLOAD_PREFIX.sub("", ROBOFLOW_ENDING.sub("", path.stem))
    match = DATED_NAME.fullmatch(stem) or NUMBERED_NAME.fullmatch(stem)
    folder = path.parent.as_posix()
    if match is None:
        return folder, stem, None, False
    number = int("".join(filter(str.isdecimal, match[2])))
    return folder, match[1], number, SKOPE_NAME.fullmatch(path.stem) is not None


def _telling(name: str) -> bool:
    """Return whether the name of a folder or file identifies a camera, split or recording."""
    bare = name.lower().strip("_-. ")
    return bool(bare) and bare not in _SAYS_NOTHING and named_split(bare) is None
