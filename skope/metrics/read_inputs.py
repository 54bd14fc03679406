"""Readers for evaluations: the splits of a dataset or one annotation file, and results of another program."""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeVar

from skope import keypoints
from skope.dataset import coco
from skope.dataset.folder import CARD_FILE, MANIFEST_FILE, open_dataset
from skope.dataset.image_selection import take
from skope.errors import UserError, one_of
from skope.keypoints import Scheme
from skope.metrics.breakdown import FleetInfo
from skope.metrics.match import box_of
from skope.schema import AnnotationFile, AnyResult, Found, Result, RoadUserResult

F = TypeVar("F", bound=Found)

TEST_SPLITS: Final = ("easy", "medium", "hard", "extra")


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """Ground truth: splits in the order in which they are reported, and the folder of their images."""

    splits: tuple[AnnotationFile, ...]
    root: Path
    """Folder that file names are relative to."""
    fleet: FleetInfo
    sources: tuple[Path, ...]
    """Files of the ground truth. For a folder with a manifest: only the manifest, which has their checksums."""

    @property
    def scheme(self) -> Scheme:
        """Keypoint scheme, which is the same for all splits."""
        return self.splits[0].scheme


def read_dataset(root: Path, names: Sequence[str]) -> GroundTruth:
    """Read the named splits of a dataset folder; without names, all test splits that it has."""
    data = open_dataset(root)
    wanted = tuple(dict.fromkeys(names)) or tuple(name for name in TEST_SPLITS if name in data.splits)
    if not wanted:
        available = ", ".join(data.splits) or "none"
        raise UserError(
            f"{root}: has none of the splits {', '.join(TEST_SPLITS)}; choose one with --split: {available}"
        )
    splits = tuple(data.read(name) for name in wanted)
    manifest = root / MANIFEST_FILE
    sources = (manifest,) if manifest.is_file() else tuple(root / "annotations" / f"{name}.json" for name in wanted)
    return GroundTruth(splits=splits, root=root, fleet=_fleet(root, data.card), sources=sources)


def _fleet(root: Path, card: dict[str, Any]) -> FleetInfo:
    """Return the vehicle models from the card of a dataset. Datasets of other programs have none."""
    entry = card.get("fleet")
    if entry is None:
        return FleetInfo()
    try:
        substituted = {str(model): tuple(names) for model, names in entry["substituted"].items()}
        unknown = {name for names in substituted.values() for name in names} - set(keypoints.NAMES)
        if unknown:
            raise UserError(f"{root / CARD_FILE}: fleet.substituted: no keypoint {min(unknown)!r}")
        return FleetInfo(held_out=frozenset(entry["held_out"]), substituted=substituted)
    except (KeyError, TypeError, AttributeError):
        raise UserError(f"{root / CARD_FILE}: fleet: expected held_out and substituted") from None


def read_annotations(path: Path) -> GroundTruth:
    """Read a single annotation file. Its images, if present, are located as in a dataset folder."""
    return GroundTruth(splits=(coco.read(path),), root=path.parent.parent, fleet=FleetInfo(), sources=(path,))


def scheme_points(scheme: str, truth: Scheme = keypoints.SKOPE33) -> tuple[int, ...]:
    """Return the indices of ground-truth keypoints that a detector of `scheme` predicts too.

    Raises:
        UserError: The scheme is unknown. The message lists the schemes.
    """
    one_of("--scheme", scheme, keypoints.RESULT_SCHEMES if truth.name == keypoints.SCHEME else (truth.name,))
    if scheme == truth.name:
        return tuple(range(keypoints.K))
    return tuple(sorted(keypoints.FOREIGN_SCHEMES.get(scheme, {}).values()))


def read_vehicle_results(path: Path, file: AnnotationFile, scheme: str | None = None) -> tuple[Result, ...]:
    """Read the vehicles of a results file.

    Args:
        path: COCO results file.
        file: Annotation file with the images that the results refer to by id.
        scheme: Keypoint scheme of the detector; None: that of `file`.

    Raises:
        UserError: The file is malformed, or a result refers to an unknown image.
    """
    return tuple(_for_file(path, file, scheme))


def read_all_results(path: Path, file: AnnotationFile, scheme: str | None = None) -> tuple[AnyResult, ...]:
    """Read the vehicles and the other road users of a results file, in its order.

    Args:
        path: COCO results file.
        file: Annotation file with the images that the results refer to by id.
        scheme: Keypoint scheme of the detector; None: that of `file`.

    Raises:
        UserError: The file is malformed, or a result refers to an unknown image.
    """
    return tuple(_all_for_file(path, file, scheme))


@dataclass(frozen=True)
class ResultsFile:
    """Results in the order of the images of `file`, read from disk each time, because files can be large."""

    path: Path
    file: AnnotationFile

    def __iter__(self) -> Iterator[Result]:
        return _for_file(self.path, self.file, None)


@dataclass(frozen=True)
class RoadUsersFile:
    """Return other road users of a results file for the images of `file`, in its order, read from disk each time."""

    path: Path
    file: AnnotationFile

    def __iter__(self) -> Iterator[RoadUserResult]:
        return (result for result in _all_for_file(self.path, self.file, None) if isinstance(result, RoadUserResult))


def stream_results(path: Path, file: AnnotationFile) -> ResultsFile | tuple[Result, ...]:
    """Return the checked results of vehicles. They are loaded only if they are not in the order of the images."""
    index_of = {image.id: i for i, image in enumerate(file.images)}
    places = (index_of[result.image_id] for result in _for_file(path, file, None))
    if all(a <= b for a, b in itertools.pairwise(places)):
        return ResultsFile(path, file)
    return read_vehicle_results(path, file)


def _for_file(path: Path, file: AnnotationFile, scheme: str | None) -> Iterator[Result]:
    return (result for result in _all_for_file(path, file, scheme) if isinstance(result, Result))


def _all_for_file(path: Path, file: AnnotationFile, scheme: str | None) -> Iterator[AnyResult]:
    images = {image.id for image in file.images}
    categories = {a.category_id for a in file.annotations}
    for i, result in coco.numbered_results(path, None if scheme == file.scheme.name else scheme):
        if result.image_id not in images:
            raise UserError(f"{path}: results[{i}]: image_id {result.image_id} is not among the images of {file.name}")
        if isinstance(result, Result) and categories and result.category_id not in categories:
            expected = ", ".join(map(str, sorted(categories)))
            raise UserError(f"{path}: results[{i}]: category_id {result.category_id} is not the vehicles' {expected}")
        yield result


def limit(file: AnnotationFile, max_images: int | None) -> AnnotationFile:
    """Return `file`, limited to `--max-images` images."""
    return file if max_images is None else take(file, max_images)


def check_boxes(file: AnnotationFile, kind: str) -> None:
    """Raise a UserError if a label of `file` has no box of `kind`. This is checked before a long prediction."""
    for annotation in (*file.annotations, *file.road_users):
        try:
            box_of(annotation, kind)
        except UserError as error:
            raise UserError(f"{file.name}: {error}") from None


def for_images(results: Sequence[F], file: AnnotationFile) -> tuple[F, ...]:
    """Return the results that belong to the images of `file`."""
    images = {image.id for image in file.images}
    return tuple(result for result in results if result.image_id in images)
