"""Boxes linked from frame to frame: by where they are expected, and by points that were followed."""

import numpy as np

from skope.tracking.box_links import BoxLinks


def boxes(*at: float) -> np.ndarray:
    return np.array([[x, 100.0, 40.0, 30.0] for x in at]).reshape(-1, 4)


def test_vehicles_keep_their_numbers_while_they_pass_one_another() -> None:
    links = BoxLinks()
    ways = [(10 + 12 * k, 300 - 12 * k) for k in range(25)]
    numbers = [links.add_boxes(k / 10, boxes(*way)).tolist() for k, way in enumerate(ways)]
    assert all(one == [0, 1] for one in numbers)


def test_who_comes_back_too_late_is_another_one() -> None:
    links = BoxLinks()
    assert links.add_boxes(0.0, boxes(10)).tolist() == [0]
    assert links.add_boxes(0.9, boxes(12)).tolist() == [0]
    assert links.add_boxes(2.0, boxes(12)).tolist() == [1]
    assert links.add_boxes(2.1, boxes()).tolist() == []


def test_points_that_were_followed_go_before_places() -> None:
    links = BoxLinks()
    links.add_boxes(0.0, boxes(10, 60), followed=[7, 8])
    assert links.add_boxes(0.5, boxes(12, 62), followed=[8, 7]).tolist() == [1, 0]
    assert links.add_boxes(1.0, boxes(12, 14), followed=[8, 8]).tolist()[0] == 1


def test_sure_boxes_choose_first() -> None:
    links = BoxLinks()
    links.add_boxes(0.0, boxes(10))
    assert links.add_boxes(0.1, boxes(11, 14), first=[False, True]).tolist() == [1, 0]
