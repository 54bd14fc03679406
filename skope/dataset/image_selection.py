"""Select images of an annotation file: training and validation parts, and small samples."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeVar

from skope.errors import UserError
from skope.schema import AnnotationFile, Image, Labelled

L = TypeVar("L", bound=Labelled)

GAP_S: Final = 1.0
"""Gap between training and validation frames of a recording, seconds. A vehicle moves on by about its own length or
more."""


def part(file: AnnotationFile, images: Iterable[Image]) -> AnnotationFile:
    """Return some images of a file, with their annotations, in file order."""
    wanted = {image.id for image in images}
    return replace(
        file,
        images=tuple(image for image in file.images if image.id in wanted),
        annotations=tuple(a for a in file.annotations if a.image_id in wanted),
        road_users=tuple(user for user in file.road_users if user.image_id in wanted),
    )


def recordings(file: AnnotationFile) -> list[list[Image]]:
    """Return the images of each recording, in the order of its frames."""
    groups: dict[tuple[str | None, str | None], list[Image]] = {}
    for image in file.images:
        groups.setdefault((image.site, image.recording), []).append(image)
    return [sorted(images, key=_frame_order) for images in groups.values()]


def _frame_order(image: Image) -> tuple[bool, int]:
    return image.frame_index is None, image.frame_index or 0


def held_back(file: AnnotationFile, fraction: float) -> tuple[AnnotationFile, AnnotationFile]:
    """Split a file into a training and a validation part.

    Of sites with several recordings, whole recordings are held back, starting with the last. Of other sites, the last
    frames are held back, after a gap of `GAP_S` that is in neither part. Many vehicles in the last frames of a
    recording also appear earlier; see `ignoring`.

    Args:
        file: The images and annotations.
        fraction: Approximate share of the frames for validation, from 0 to 1.

    Returns:
        The training part and the validation part.
    """
    sites: dict[tuple[str | None, str | None], list[list[Image]]] = {}
    for ordered in recordings(file):
        site, recording = ordered[0].site, ordered[0].recording
        # Recordings of unknown sites may be from different cameras.
        sites.setdefault((site, recording if site is None else None), []).append(ordered)
    learnt: list[Image] = []
    validated: list[Image] = []
    due = 0.0  # frames that are still to be held back
    for of_site in sites.values():
        if len(of_site) == 1:
            before, last = _split(of_site[0], fraction)
            learnt += before
            validated += last
            continue
        due += fraction * sum(map(len, of_site))
        # If a short recording holds back too little, another site holds back more.
        while len(of_site) > 1 and due >= len(of_site[-1]) / 2:
            due -= len(of_site[-1])
            validated += of_site.pop()
        learnt += [image for recording in of_site for image in recording]
    return part(file, learnt), part(file, validated)


def ignoring(learnt: AnnotationFile, validated: AnnotationFile) -> AnnotationFile:
    """Return `validated` with vehicles ignored (`iscrowd` = 1) that also appear in `learnt`, by recording and track."""
    return replace(
        validated,
        annotations=_ignoring(learnt, learnt.annotations, validated, validated.annotations),
        road_users=_ignoring(learnt, learnt.road_users, validated, validated.road_users),
    )


def _ignoring(
    learnt: AnnotationFile, known: Sequence[Labelled], validated: AnnotationFile, labels: Sequence[L]
) -> tuple[L, ...]:
    """Return `labels` of `validated`; those whose track is in `known`, from `learnt`, are marked as ignored."""
    seen = {
        track for image, a in _with_images(learnt, known) if not a.ignored and (track := _track(image, a)) is not None
    }
    rows = _with_images(validated, labels)
    return tuple(replace(a, iscrowd=1) if _track(image, a) in seen else a for image, a in rows)


def _with_images(file: AnnotationFile, labels: Iterable[L]) -> Iterator[tuple[Image, L]]:
    images = {image.id: image for image in file.images}
    return ((images[label.image_id], label) for label in labels)


def _track(image: Image, label: Labelled) -> tuple[str | None, str | None, int] | None:
    """Return site, recording and track of a road user; None if its track is not known."""
    return None if label.track_id is None else (image.site, image.recording, label.track_id)


def last_frames(file: AnnotationFile, fraction: float) -> AnnotationFile:
    """Return the last `fraction` (0 to 1) of each recording's frames, rounded to whole frames."""
    return part(file, (image for ordered in recordings(file) for image in _split(ordered, fraction)[1]))


def _split(ordered: Sequence[Image], fraction: float) -> tuple[list[Image], list[Image]]:
    """Return the frames of a recording before the gap, and its last `fraction`."""
    first = len(ordered) - round(fraction * len(ordered))  # past the end for a recording that is too short
    before = [image for i, image in enumerate(ordered[:first]) if not _in_gap(image, i, ordered, first)]
    return before, [*ordered[first:]]


def _in_gap(image: Image, i: int, ordered: Sequence[Image], first: int) -> bool:
    """Return whether frame `i` is in the gap before the first validated frame `first`, by time.

    If a time is missing, the gap is one frame.
    """
    if first == len(ordered):
        return False
    begins = ordered[first].time_s
    if image.time_s is None or begins is None:
        return i == first - 1
    return begins - image.time_s < GAP_S


def take(file: AnnotationFile, n: int) -> AnnotationFile:
    """Return at most `n` images with a ground-truth (not ignored) vehicle, evenly spread, with their annotations.

    Training and evaluation use the same rule, so that the same number selects the same images.

    Raises:
        UserError: `n` is less than 1; the message names `--max-images`.
    """
    if n < 1:
        raise UserError(f"--max-images: expected a whole number from 1, got {n}")
    occupied = {annotation.image_id for annotation in file.annotations if not annotation.ignored}
    candidates = [image for image in file.images if image.id in occupied]
    count = min(n, len(candidates))
    return part(file, (candidates[i * len(candidates) // count] for i in range(count)))
