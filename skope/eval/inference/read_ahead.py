"""Make items in a thread, or answers to them in several, while the caller works on those before."""

import contextlib
import queue
import threading
from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Final, TypeVar

T = TypeVar("T")
A = TypeVar("A")

_END: Final = object()
_LOOK_S: Final = 0.1
"""A thread that waits for its caller looks so often whether the caller is gone."""


def read_ahead(items: Iterable[T], count: int) -> Generator[T]:
    """The items of an iterable, in order; a thread makes up to `count` of them that the caller has not asked for yet.

    What the iterable raises is raised here in its place. The thread ends when the caller closes this generator.
    """
    made: queue.Queue[object] = queue.Queue(count)
    unwanted = threading.Event()

    def put(item: object) -> None:
        while not unwanted.is_set():
            with contextlib.suppress(queue.Full):
                made.put(item, timeout=_LOOK_S)
                return

    def make() -> None:
        try:
            for item in items:
                put(item)
                if unwanted.is_set():
                    return
            put(_END)
        except BaseException as error:  # raised again where the items are taken
            put(_Raised(error))

    thread = threading.Thread(target=make, daemon=True)
    thread.start()
    try:
        while (item := made.get()) is not _END:
            if isinstance(item, _Raised):
                raise item.error
            yield item  # type: ignore[misc]
    finally:
        unwanted.set()
        thread.join()


def with_answers(items: Iterable[T], answer: Callable[[T], A], threads: int) -> Generator[tuple[T, A]]:
    """Each item with the answer to it, in order.

    Args:
        items: Taken one after the other, by the caller's thread.
        answer: Called for each, by several threads at a time.
        threads: One answers when the caller asks; with more, up to `threads` items are taken before they are asked for.
    """
    if threads == 1:
        yield from ((item, answer(item)) for item in items)
        return
    with ThreadPoolExecutor(threads) as pool:
        begun = deque[tuple[T, Future[A]]]()
        for item in items:
            begun.append((item, pool.submit(answer, item)))
            if len(begun) > threads:
                first, future = begun.popleft()
                yield first, future.result()
        for last, future in begun:
            yield last, future.result()


class _Raised:
    def __init__(self, error: BaseException) -> None:
        self.error = error
