"""Few of many images; what is held back for validation is tested in tests/train/test_splits.py."""

from collections.abc import Sequence

import pytest

from skope.dataset.image_selection import take
from skope.errors import UserError
from skope.schema import AnnotationFile
from tests.samples import make_annotation, make_image


def file_of(vehicles: Sequence[int]) -> AnnotationFile:
    """Images 1, 2, ... with an ignored vehicle each, and so many ground-truth ones."""
    annotations = [
        make_annotation(10 * image_id + i, image_id, (0, 0, 9, 9), iscrowd=int(i == 0))
        for image_id, count in enumerate(vehicles, start=1)
        for i in range(count + 1)
    ]
    images = tuple(make_image(i + 1) for i in range(len(vehicles)))
    return AnnotationFile(images=images, annotations=tuple(annotations), name="train")


@pytest.mark.parametrize(
    ("n", "ids"), [(1, [1]), (2, [1, 5]), (3, [1, 4, 6]), (6, [1, 2, 4, 5, 6, 8]), (99, [1, 2, 4, 5, 6, 8])]
)
def test_images_with_vehicles_are_taken_evenly(n: int, ids: list[int]) -> None:
    taken = take(file_of([1, 2, 0, 1, 3, 1, 0, 1]), n)
    assert [image.id for image in taken.images] == ids
    assert {a.image_id for a in taken.annotations} == set(ids)
    assert sum(a.ignored for a in taken.annotations) == len(ids)  # the ignored vehicles come along
    assert taken.name == "train"


def test_nothing_to_take() -> None:
    assert take(file_of([0, 0]), 3).images == ()
    with pytest.raises(UserError, match="--max-images: expected a whole number from 1, got 0"):
        take(file_of([1]), 0)
