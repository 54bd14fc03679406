"""Numbers through a video are given category by category."""

from functools import partial

import numpy as np

from skope.footage.confirmation import Confirmation
from skope.footage.predict_job import Linked, NumbersByCategory
from skope.schema import AnyResult, RoadUserResult
from tests.footage.test_confirmation import driving, result


def walker(frame: int, score: float = 0.9, category: int = 4, x: float = 700.0) -> RoadUserResult:
    box = np.array([x + 4.0 * frame, 300.0, 30.0, 80.0])
    return RoadUserResult(image_id=1, bbox=box, score=score, category_id=category)


def numbers(frames: list[list[AnyResult]], numbering: NumbersByCategory) -> list[list[int]]:
    for i, found in enumerate(frames):
        numbering.add(i / 10, found)
    return [each.tolist() for each in numbering.confirmed()]


def test_vehicles_have_the_first_numbers_and_those_that_they_have_alone() -> None:
    cars = [[result(driving(0, i)), result(driving(3, i))] for i in range(12)]
    everyone: list[list[AnyResult]] = [
        [*cars[i], walker(i), walker(i, category=2)] if i >= 2 else [*cars[i]] for i in range(12)
    ]
    alone = numbers([list(found) for found in cars], NumbersByCategory(partial(Confirmation, 0.5)))
    confirmation = Confirmation(0.5)
    for i, found in enumerate(cars):
        confirmation.add(i / 10, found)
    assert alone == [each.tolist() for each in confirmation.confirmed()] == [[0, 1]] * 12
    together = numbers(everyone, NumbersByCategory(partial(Confirmation, 0.5)))
    assert together == [[0, 1]] * 2 + [[0, 1, 3, 2]] * 10  # bicycle before pedestrian


def test_what_one_frame_shows_is_not_confirmed_by_another_category() -> None:
    frames: list[list[AnyResult]] = [[walker(i, category=4 if i % 2 else 3)] for i in range(5)]
    assert numbers(frames, NumbersByCategory(partial(Confirmation, 0.5))) == [[0], [-1], [0], [-1], [0]]


def test_without_confirmation_all_above_the_score_have_numbers() -> None:
    frames: list[list[AnyResult]] = [[result(driving(0, 0)), walker(0), walker(0, 0.3, x=100.0)]]
    assert numbers(frames, NumbersByCategory(partial(Linked, 0.5))) == [[0, 1, -1]]
    assert numbers([[]], NumbersByCategory(partial(Linked, 0.5))) == [[]]
