"""Merge datasets into one (`skope gen merge`)."""

import shlex
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from skope.dataset import shards
from skope.dataset.folder import MANIFEST_FILE, Dataset, read_manifest
from skope.dataset.image_selection import recordings
from skope.errors import UserError
from skope.files.atomic import replacing_folder
from skope.gen.formats.dataset_builder import bare_name, check_outside, dataset_at, finish_dataset, labelled_frame
from skope.gen.output.licences import united
from skope.gen.output.writers import FolderWriter, FrameFiles
from skope.schema import VEHICLE_ALONE, AnnotationFile, Image
from skope.terminal.console import Console


def merge(sources: Sequence[Path], out: Path, console: Console, *, vehicles_alone: bool = False) -> None:
    """Write a dataset with the images of several datasets.

    Images and depth are hard links if the file system supports them. Splits keep their names. A site in several
    datasets becomes one site per dataset, and so does a recording of an unknown site. The files of recordings are left
    out, because a merged dataset is not rendered again.

    Args:
        sources: Two or more dataset folders.
        out: An empty or missing folder. It is written completely or not at all.
        console: Shows progress.
        vehicles_alone: Whether labels of people on foot and on two wheels are left out.

    Raises:
        UserError: The datasets have different keypoint schemes, or, without `vehicles_alone`, different categories;
            licences that exclude each other, or a site or image in different splits.
    """
    datasets = _opened(sources, out)
    first = datasets[0]
    categories = VEHICLE_ALONE if vehicles_alone else first.categories
    licence = united([dataset.licence for dataset in datasets])
    with replacing_folder(out) as folder:
        writer = FolderWriter(folder, first.scheme, categories)
        for dataset in datasets:
            if not vehicles_alone:
                _check_categories(dataset.root, dataset.categories, first.root, categories)
        names, left_out = _write_images(writer, datasets, categories, console, vehicles_alone=vehicles_alone)
        if left_out:
            console.say(f"{left_out} labels of people on foot and on two wheels are left out")
        finish_dataset(
            writer,
            # Names without folders: the card is published, and must not show the user's folders.
            command=shlex.join(
                [
                    *("skope", "gen", "merge", *(dataset.root.resolve().name for dataset in datasets)),
                    *(["--vehicles-alone"] if vehicles_alone else []),
                ]
            ),
            licence=licence,
            label_rules=list(dict.fromkeys(rule for d in datasets for rule in d.card.get("label_rules", ()))),
            sources=[_source_row(dataset, names) for dataset in datasets],
            **_fleet(datasets),
        )


def _opened(sources: Sequence[Path], out: Path) -> list[Dataset]:
    """Return the datasets, with one keypoint scheme.

    Raises:
        UserError: Their schemes differ, a dataset is listed twice, or `out` is inside one of them.
    """
    if len(sources) < 2:
        raise UserError(f"expected two or more datasets and a new folder, got {len(sources)} before {out}")
    if len({source.resolve() for source in sources}) < len(sources):
        raise UserError("a dataset is listed twice")
    check_outside(out, sources)
    datasets = [dataset_at(source) for source in sources]
    first = datasets[0]
    for dataset in datasets[1:]:
        if dataset.scheme is not first.scheme:
            raise UserError(
                f"{dataset.root}: has keypoint scheme {dataset.scheme.name}, {first.root} has {first.scheme.name}"
            )
    return datasets


def _write_images(
    writer: FolderWriter,
    datasets: Sequence[Dataset],
    categories: Sequence[str],
    console: Console,
    *,
    vehicles_alone: bool,
) -> tuple["_Sites", int]:
    """Write the images of all datasets, and report duplicate recordings.

    Returns:
        The new names of sites, and the number of labels of other road users that are left out.
    """
    first = datasets[0]
    names, begun, taken, left_out = _Sites(), dict[str, tuple[Path, str]](), set[str](), 0
    for dataset in datasets:
        twice = Counter[Path]()
        sums = read_manifest(dataset.root)["sha256"] if (dataset.root / MANIFEST_FILE).is_file() else {}
        for split in dataset.splits:
            file = dataset.read(split)
            if vehicles_alone:
                left_out += len(file.road_users)
                file = replace(file, road_users=())
            else:
                _check_categories(dataset.root / split, file.categories, first.root, categories)
            names.check(dataset, split, file)
            twice.update(_twice(dataset, split, file, begun))
            images = console.bar(file.images, unit="image", label=f"{dataset.root.resolve().name}: {split}")
            writer.add(split, _frames(dataset, split, file, images, names, sums, taken))
        names.close(dataset)
        for other_root, count in twice.items():
            console.say(f"{dataset.root}: {count} recordings are duplicates of recordings of {other_root}")
    return names, left_out


def _source_row(dataset: Dataset, names: "_Sites") -> dict[str, Any]:
    """Return the row of one source in the card of the merged dataset."""
    return {
        "name": dataset.root.resolve().name,
        "command": dataset.card.get("command"),
        "licence": dataset.licence,
        "sites": names.of(dataset),
    }


def _check_categories(where: Path, has: Sequence[str], first_root: Path, wanted: Sequence[str]) -> None:
    """Raise a UserError if a dataset labels other categories than the first dataset (at `first_root`).

    People that one dataset shows and does not label would count as background.
    """
    if tuple(has) != tuple(wanted):
        raise UserError(
            f"{where}: labels {', '.join(has)}, {first_root} labels {', '.join(wanted)}: "
            "objects that one does not label would count as background; --vehicles-alone leaves those labels out"
        )


class _Sites:
    """Names of each dataset's sites in the merged dataset."""

    def __init__(self) -> None:
        self._splits: dict[str, dict[Path, set[str]]] = {}
        self._taken: set[str] = set()
        self._named: dict[Path, dict[str, str]] = {}
        self._recordings: dict[str, tuple[Path, str]] = {}

    def check(self, dataset: Dataset, split: str, file: AnnotationFile) -> None:
        """Choose the names of a split's sites in the merged dataset.

        Raises UserError for a site that another dataset has in another split.
        """
        new_names = self._named.setdefault(dataset.root, {})
        for site in dict.fromkeys(image.site for image in file.images if image.site is not None):
            uses = self._splits.setdefault(site, {})
            for other_root, splits in uses.items():
                if other_root != dataset.root and splits != {split}:
                    raise UserError(
                        f"{dataset.root}: site {site} is in split {split}, and in {', '.join(sorted(splits))} of "
                        f"{other_root}: if it is one camera, test images would be training data; if there are two, "
                        "give one of them another name"
                    )
            uses.setdefault(dataset.root, set()).add(split)
            if site not in new_names:
                number, name = 1, site
                while name in self._taken or name in new_names.values():
                    number += 1
                    name = f"{site}_{number}"
                new_names[site] = name

    def close(self, dataset: Dataset) -> None:
        """Reserve the new names of a dataset's sites. Call this after its last split."""
        self._taken |= set(self._named[dataset.root].values())

    def of(self, dataset: Dataset) -> dict[str, str]:
        """Return the new names of a dataset's sites: name in the dataset -> name in the merged dataset."""
        return self._named[dataset.root]

    def recording(self, dataset: Dataset, name: str) -> str:
        """Return the name of a dataset's recording of an unknown site in the merged dataset."""
        number, free = 1, name
        while self._recordings.setdefault(free, (dataset.root, name)) != (dataset.root, name):
            number += 1
            free = f"{name}_{number}"
        return free


def _twice(dataset: Dataset, split: str, file: AnnotationFile, begun: dict[str, tuple[Path, str]]) -> Iterator[Path]:
    """Find recordings that another dataset has too; yield that dataset's folder for each.

    Recordings are equal if their first images with a vehicle are; images of empty roads can be equal by chance.

    Args:
        dataset: The dataset to search.
        split: The split to search.
        file: Annotations of the split.
        begun: Those images of the previous datasets (digest to folder and split); extended by this dataset's.

    Raises:
        UserError: The other dataset has the recording in another split.
    """
    annotations_by_image = file.by_image()
    for images in recordings(file):
        first = next((image for image in images if annotations_by_image[image.id]), None)
        if first is None:
            continue
        digest = sha256(shards.read(dataset.root / first.file_name)).hexdigest()
        other_root, of = begun.setdefault(digest, (dataset.root, split))
        if other_root == dataset.root:
            continue
        if of != split:
            raise UserError(
                f"{dataset.root}: {first.file_name} is in split {split}, the same image in {of} of {other_root}: "
                "test images would be training data"
            )
        yield other_root


def _frames(
    dataset: Dataset,
    split: str,
    file: AnnotationFile,
    images: Iterable[Image],
    names: _Sites,
    sums: Mapping[str, str],
    taken: set[str],
) -> Iterator[FrameFiles]:
    """Yield the images of a split under free names, which are added to `taken`.

    `sums` are checksums by current names.
    """
    annotations_by_image, road_users_by_image = file.by_image(), file.road_users_by_image()
    for image in images:
        new, files = _rename(image, names, dataset, taken)
        known = {name: sums[path] for name, path in files.items() if path in sums}
        contents = {name: dataset.root / path for name, path in files.items()}
        yield labelled_frame(split, new, annotations_by_image[image.id], contents, known, road_users_by_image[image.id])


def _rename(image: Image, names: _Sites, dataset: Dataset, taken: set[str]) -> tuple[Image, dict[str, str]]:
    """Return an image's record with its names in the merged dataset, and the current name of each file by new name."""
    site, recording = None, image.recording
    if image.site is not None:
        site = names.of(dataset)[image.site]
    elif recording is not None:
        recording = names.recording(dataset, recording)
    new: dict[str, str] = {}
    files: dict[str, str] = {}
    for key, kind in (("file_name", "images"), ("depth_file_name", "depth")):
        old = getattr(image, key)
        if old is None:
            continue
        name = bare_name(old)
        if site is not None:
            name = f"{site}/{name.removeprefix(f'{image.site}/')}"
        candidates = (f"{kind}/{name}", f"{kind}/{dataset.root.resolve().name}/{name}")
        free = next((c for c in candidates if c not in taken), None)
        if free is None:
            raise UserError(f"{dataset.root}: {old}: another image has this name")
        taken.add(free)
        new[key], files[free] = free, old
    return replace(image, site=site, recording=recording, **new), files  # type: ignore[arg-type]


def _fleet(datasets: Sequence[Dataset]) -> dict[str, object]:
    """Return the card's field `fleet` if all datasets have one; a model is held out if all datasets hold it out."""
    fleets = [dataset.card.get("fleet") for dataset in datasets]
    if not all(isinstance(fleet, dict) and {"held_out", "substituted"} <= fleet.keys() for fleet in fleets):
        return {}
    held_out = set.intersection(*(set(fleet["held_out"]) for fleet in fleets if fleet))
    substituted = {model: names for fleet in fleets if fleet for model, names in fleet["substituted"].items()}
    return {"fleet": {"held_out": sorted(held_out), "substituted": substituted}}
