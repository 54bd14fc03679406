import numpy as np
import pytest

from skope import boxes

A = [0.0, 0.0, 100.0, 50.0]


def test_formats_are_each_others_inverse() -> None:
    xywh = np.array([[1.5, 2.0, 3.0, 4.0], [0.0, 0.0, 0.0, 7.0]])
    assert boxes.xywh_to_xyxy(xywh).tolist() == [[1.5, 2.0, 4.5, 6.0], [0.0, 0.0, 0.0, 7.0]]
    assert np.array_equal(boxes.xyxy_to_xywh(boxes.xywh_to_xyxy(xywh)), xywh)


def test_boxes_are_clipped_to_the_image() -> None:
    assert boxes.clip([-5, 10, 200, 90], 160, 80).tolist() == [0, 10, 160, 80]


def test_an_inverted_box_has_no_area() -> None:
    assert boxes.area([[0, 0, 10, 5], [10, 5, 0, 0], [10, 0, 0, 5]]).tolist() == [50, 0, 0]


@pytest.mark.parametrize(
    ("b", "shared", "union"),
    [
        (A, 5000, 5000),
        ([0, 0, 80, 50], 4000, 5000),
        ([50, 25, 150, 75], 1250, 8750),
        ([100, 0, 200, 50], 0, 10000),  # touching
        ([300, 300, 310, 310], 0, 5100),
        ([50, 25, 50, 40], 0, 5000),  # without area
    ],
)
def test_intersection_over_union(b: list[float], shared: float, union: float) -> None:
    assert boxes.intersection([A], [b]).tolist() == [[shared]]
    assert boxes.iou([A], [b]).tolist() == [[shared / union]]
    assert boxes.iou([b], [A]).tolist() == [[shared / union]]


def test_two_empty_boxes_overlap_by_nothing() -> None:
    assert boxes.iou([[5, 5, 5, 5]], [[5, 5, 5, 5]]).tolist() == [[0.0]]


def test_every_box_meets_every_other() -> None:
    assert boxes.iou(np.zeros((0, 4)), [A]).shape == (0, 1)
    assert boxes.iou([A, A, A], [A, A]).shape == (3, 2)


def test_share_inside_is_of_the_first_boxes_own_area() -> None:
    assert boxes.share_inside([[50, 0, 150, 50], A, [7, 7, 7, 9]], [A]).tolist() == [[0.5], [1.0], [0.0]]
