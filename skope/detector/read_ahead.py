"""Make items in a thread while the caller works on those before."""

import contextlib
import queue
import threading
from collections.abc import Generator, Iterable
from typing import Final, TypeVar

T = TypeVar("T")

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


class _Raised:
    def __init__(self, error: BaseException) -> None:
        self.error = error
