"""Compare two datasets: the differences between their labels and between their files."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from skope.dataset.folder import Dataset, read_manifest
from skope.errors import UserError
from skope.schema import CATEGORY_NAMES, Annotation, Labelled, RoadUser

Key = tuple[str | None, str | None, int | None]


def differences(first: Dataset, second: Dataset) -> Iterator[str]:
    """Yield lines with the differences in parameters, frames, labels and bytes; none for equal datasets."""
    a, b = first.card.get("parameters", {}), second.card.get("parameters", {})
    for name in sorted(a.keys() | b.keys()):
        if a.get(name) != b.get(name):
            yield f"parameters.{name}: {a.get(name)} and {b.get(name)}"
    for split in sorted({*first.splits, *second.splits}):
        if split not in first.splits or split not in second.splits:
            yield f"split {split}: only in {(first if split in first.splits else second).root}"
            continue
        yield from (f"split {split}: {text}" for text in _labels(first, second, split))
    yield from _bytes(first, second)


def _labels(first_dataset: Dataset, second_dataset: Dataset, split: str) -> Iterator[str]:
    first_frames, second_frames = (_frames(dataset, split) for dataset in (first_dataset, second_dataset))
    for frames, compared, root in (
        (first_frames, second_frames, first_dataset.root),
        (second_frames, first_frames, second_dataset.root),
    ):
        if alone := frames.keys() - compared.keys():
            yield f"{len(alone)} frames only in {root}, such as {_named(min(alone, key=str))}"
    common = first_frames.keys() & second_frames.keys()
    label_pairs: list[tuple[Annotation | RoadUser, Annotation | RoadUser]] = []
    odd = Counter[str]()
    for key in common:
        mine, theirs = first_frames[key], second_frames[key]
        for name in CATEGORY_NAMES:
            odd[name] += {track for track in mine if track[0] == name} != {
                track for track in theirs if track[0] == name
            }
        label_pairs += [(mine[track], theirs[track]) for track in mine.keys() & theirs.keys()]
    for name, count in odd.items():
        if count:
            yield f"{count} of {len(common)} frames have different {name}s"
    yield from _boxes(label_pairs)
    pairs = [(a, b) for a, b in label_pairs if isinstance(a, Annotation) and isinstance(b, Annotation)]
    if not pairs:
        return
    v = np.array([a.keypoints[:, 2] != b.keypoints[:, 2] for a, b in pairs])
    if v.any():
        yield f"v differs for {v.mean():.3%} of {v.size} keypoints"
    both_labelled = np.array([(a.keypoints[:, 2] > 0) & (b.keypoints[:, 2] > 0) for a, b in pairs])
    apart = np.array([np.hypot(*(a.keypoints - b.keypoints)[:, :2].T) for a, b in pairs])[both_labelled]
    if (apart > 0).any():
        yield f"keypoints differ by up to {apart.max():.2f} px, on average by {apart.mean():.3f} px"


def _boxes(pairs: Sequence[tuple[Labelled, Labelled]]) -> Iterator[str]:
    if not pairs:
        return
    ignored = sum(a.ignore_reason != b.ignore_reason for a, b in pairs)
    if ignored:
        yield f"{ignored} of {len(pairs)} road users are ignored in one dataset only, or for different reasons"
    boxes = np.array([np.abs(a.bbox - b.bbox).max() for a, b in pairs])
    if (boxes > 0).any():
        yield f"boxes differ by up to {boxes.max():.2f} px, {(boxes > 1).mean():.2%} of them by more than 1 px"


def _frames(dataset: Dataset, split: str) -> dict[Key, dict[tuple[str, Any], Annotation | RoadUser]]:
    """Return the labels of each frame, by category and track."""
    file = dataset.read(split)
    groups = file.labels_by_image()
    return {
        (image.site, image.recording, image.frame_index): {
            ("vehicle" if isinstance(a, Annotation) else a.category, a.track_id): a for a in groups[image.id]
        }
        for image in file.images
    }


def _named(key: Key) -> str:
    site, recording, frame = key
    return f"{site}/{recording}_{frame:06d}"


def _bytes(first: Dataset, second: Dataset) -> Iterator[str]:
    """Yield differences between the files of two datasets with manifests of the same format."""
    if first.sharded != second.sharded:
        yield f"formats: {first.card.get('format')} and {second.card.get('format')}"
        return
    try:
        a, b = (read_manifest(dataset.root)["sha256"] for dataset in (first, second))
    except UserError:
        return
    kinds = Counter(name.split("/")[0] for name in a.keys() & b.keys() if a[name] != b[name])
    for kind, count in sorted(kinds.items()):
        total = sum(name.startswith(f"{kind}/") for name in a.keys() & b.keys())
        yield f"{kind}: {count} of {total} files differ"
