"""Choose images of an annotation file: what is validated on in place of learnt from, and few of many."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Final, TypeVar

from skope.errors import UserError
from skope.schema import AnnotationFile, Image, Labelled

L = TypeVar("L", bound=Labelled)

GAP_S: Final = 1.0
"""Seconds left out between the frames of a recording that are learnt from and those that are validated on: a vehicle
moves on by about its own length or more."""


def part(file: AnnotationFile, images: Iterable[Image]) -> AnnotationFile:
    """Some images of a file, with their annotations, in file order."""
    wanted = {image.id for image in images}
    return replace(
        file,
        images=tuple(image for image in file.images if image.id in wanted),
        annotations=tuple(a for a in file.annotations if a.image_id in wanted),
        road_users=tuple(user for user in file.road_users if user.image_id in wanted),
    )


def recordings(file: AnnotationFile) -> list[list[Image]]:
    """The images of each recording, in the order of its frames."""
    groups: dict[tuple[str | None, str | None], list[Image]] = {}
    for image in file.images:
        groups.setdefault((image.site, image.recording), []).append(image)
    return [sorted(images, key=_frame_order) for images in groups.values()]


def _frame_order(image: Image) -> tuple[bool, int]:
    return image.frame_index is None, image.frame_index or 0


def held_back(file: AnnotationFile, fraction: float) -> tuple[AnnotationFile, AnnotationFile]:
    """Split a file into what is learnt from and what is validated on.

    From sites with several recordings whole recordings are held back, the last of them; from the others the last
    frames, after a gap of `GAP_S` that is in neither part. Many a vehicle of a recording's last frames was there
    before: see `ignoring`.

    Args:
        file: The images and annotations to learn from.
        fraction: About which share of the frames, from 0 to 1, is validated on.

    Returns:
        The part to learn from and the part to validate on.
    """
    sites: dict[tuple[str | None, str | None], list[list[Image]]] = {}
    for ordered in recordings(file):
        site, recording = ordered[0].site, ordered[0].recording
        # Recordings of unknown sites need not be of one camera.
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
        # Where a short recording holds back too little, another site holds back more.
        while len(of_site) > 1 and due >= len(of_site[-1]) / 2:
            due -= len(of_site[-1])
            validated += of_site.pop()
        learnt += [image for recording in of_site for image in recording]
    return part(file, learnt), part(file, validated)


def ignoring(learnt: AnnotationFile, validated: AnnotationFile) -> AnnotationFile:
    """`validated` with those ignored (`iscrowd` = 1) that `learnt` shows too, by recording and track."""
    return replace(
        validated,
        annotations=_ignoring(learnt, learnt.annotations, validated, validated.annotations),
        road_users=_ignoring(learnt, learnt.road_users, validated, validated.road_users),
    )


def _ignoring(
    learnt: AnnotationFile, known: Sequence[Labelled], validated: AnnotationFile, labels: Sequence[L]
) -> tuple[L, ...]:
    """Return `labels` of `validated`; those with the track of one of `known`, of `learnt`, are marked as ignored."""
    seen = {
        track for image, a in _with_images(learnt, known) if not a.ignored and (track := _track(image, a)) is not None
    }
    rows = _with_images(validated, labels)
    return tuple(replace(a, iscrowd=1) if _track(image, a) in seen else a for image, a in rows)


def _with_images(file: AnnotationFile, labels: Iterable[L]) -> Iterator[tuple[Image, L]]:
    images = {image.id: image for image in file.images}
    return ((images[label.image_id], label) for label in labels)


def _track(image: Image, label: Labelled) -> tuple[str | None, str | None, int] | None:
    """Site, recording and track of a road user; None where the file does not say which track it is."""
    return None if label.track_id is None else (image.site, image.recording, label.track_id)


def last_frames(file: AnnotationFile, fraction: float) -> AnnotationFile:
    """The last `fraction` (from 0 to 1) of each recording's frames, rounded to whole frames."""
    return part(file, (image for ordered in recordings(file) for image in _split(ordered, fraction)[1]))


def _split(ordered: Sequence[Image], fraction: float) -> tuple[list[Image], list[Image]]:
    """The frames of a recording before the gap, and its last `fraction`."""
    first = len(ordered) - round(fraction * len(ordered))  # after the last one of a recording too short for it
    before = [image for i, image in enumerate(ordered[:first]) if not _in_gap(image, i, ordered, first)]
    return before, [*ordered[first:]]


def _in_gap(image: Image, i: int, ordered: Sequence[Image], first: int) -> bool:
    """Whether frame `i` lies in the gap before the validated frame `first`: by their times.

    Where a time is missing, the gap is one frame.
    """
    if first == len(ordered):
        return False
    begins = ordered[first].time_s
    if image.time_s is None or begins is None:
        return i == first - 1
    return begins - image.time_s < GAP_S


def take(file: AnnotationFile, n: int) -> AnnotationFile:
    """At most `n` images that have a ground-truth (not ignored) vehicle, evenly spread, with only their annotations.

    Training and evaluation choose by the same rule, so that the same number means the same images. Raises UserError,
    which names `--max-images`, where `n` is less than 1.
    """
    if n < 1:
        raise UserError(f"--max-images: expected a whole number from 1, got {n}")
    occupied = {annotation.image_id for annotation in file.annotations if not annotation.ignored}
    candidates = [image for image in file.images if image.id in occupied]
    count = min(n, len(candidates))
    return part(file, (candidates[i * len(candidates) // count] for i in range(count)))
