"""What a thread makes ahead comes in order, with its errors, and is not made for nobody."""

import threading
import time
from collections.abc import Iterator

import pytest

from skope.detector.predictor import read_ahead
from tests.waiting import until


def counting(made: list[int], last: int = 1000) -> Iterator[int]:
    for i in range(last):
        made.append(i)
        yield i


def test_items_come_in_order() -> None:
    assert list(read_ahead(counting([], 50), 3)) == list(range(50))


def test_items_are_made_while_the_caller_works() -> None:
    made: list[int] = []
    items = read_ahead(counting(made), 4)
    assert next(items) == 0
    until(lambda: len(made) >= 6)
    time.sleep(0.1)
    assert len(made) == 6, "one was taken, four wait, and one waits for a place"
    items.close()


def test_the_thread_ends_with_the_caller() -> None:
    before = threading.active_count()
    items = read_ahead(counting([]), 2)
    next(items)
    assert threading.active_count() == before + 1
    items.close()
    assert threading.active_count() == before


def test_errors_come_where_their_item_would() -> None:
    def broken() -> Iterator[int]:
        yield 1
        raise OSError("gone")

    items = read_ahead(broken(), 5)
    assert next(items) == 1
    with pytest.raises(OSError, match="gone"):
        next(items)
