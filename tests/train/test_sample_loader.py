"""Loading processes: as many as shared memory holds, and none lost with a sample."""

import itertools
import os
import signal
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from torch.utils.data import DataLoader

from skope.terminal.console import Console
from skope.train import sample_loader
from skope.train.sample_loader import Loader
from skope.train.training_samples import Draw, TrainingSet
from tests import samples
from tests.train.test_training_samples import training_set

IMAGE = 160 * 120 * 3
GROUPS = [[(0, i, 0)] for i in range(6)]


@pytest.fixture
def images(tmp_path: Path) -> TrainingSet:
    return training_set(samples.make_dataset(tmp_path, images=6, splits=("train",)))


@pytest.fixture
def room(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Sets the bytes that are free in shared memory."""

    def put(free: int) -> None:
        monkeypatch.setattr(sample_loader.os, "statvfs", lambda _: SimpleNamespace(f_bavail=free, f_frsize=1))

    return put


@pytest.mark.parametrize(
    ("free", "workers", "expected", "prefetch"),
    [
        (100 * IMAGE, 2, 2, 4),
        (14 * IMAGE, 2, 2, 2),  # 4 batches of each, the one being made and the one learnt from do not fit
        (9 * IMAGE, 2, 1, 2),
        (3 * IMAGE, 2, 0, 2),
        (0, 0, 0, 0),
    ],
)
def test_as_many_as_shared_memory_holds(
    images: TrainingSet,
    room: Callable[[int], None],
    capsys: pytest.CaptureFixture[str],
    free: int,
    workers: int,
    expected: int,
    prefetch: int,
) -> None:
    room(free)
    loader = Loader(images, workers=workers, console=Console(quiet=True))
    assert (loader._fit(1), loader.workers) == (prefetch, expected)
    said = capsys.readouterr().err
    assert said.count("\n") == int(expected < workers)
    assert ("/dev/shm" in said and "--shm-size" in said) == (expected < workers)


def test_several_processes_of_one_machine_share_it(
    images: TrainingSet, room: Callable[[int], None], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LOCAL_WORLD_SIZE", "4")
    room(40 * IMAGE)
    loader = Loader(images, workers=2, console=Console(quiet=True))
    loader._fit(1)
    assert loader.workers == 2
    room(20 * IMAGE)
    loader._fit(1)
    assert loader.workers == 1


def test_a_system_without_shared_memory_is_not_asked(images: TrainingSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_loader, "SHARED_MEMORY", Path("/nowhere/at/all"))
    loader = Loader(images, workers=1, console=Console(quiet=True))
    assert (loader._fit(1), loader.workers) == (4, 1)


@pytest.mark.parametrize("workers", [0, 1])
def test_groups_without_end_are_asked_for_as_they_are_wanted(images: TrainingSet, workers: int) -> None:
    asked: list[int] = []

    def groups() -> Iterator[list[Draw]]:
        for epoch in itertools.count():
            asked.append(epoch)
            yield [(epoch, epoch % 6, 0)]

    batches = Loader(images, workers=workers, console=Console(quiet=True)).batches(groups(), 1)
    names = [batch[0].name for batch in itertools.islice(batches, 8)]
    assert names == [*names[:6], *names[:2]]
    assert len(set(names)) == 6
    assert 8 <= len(asked) <= 8 + 4 * workers


class _Ending(TrainingSet):
    """A training set at one of whose samples the process that loads it ends, or falls silent."""

    how: str

    def __getitem__(self, index: Any) -> Any:
        if index[1] == 2 and os.getpid() != self.parent:  # type: ignore[attr-defined]
            if self.how == "ends":
                os.kill(os.getpid(), signal.SIGKILL)
            signal.pause()
        return super().__getitem__(index)


@pytest.mark.parametrize("how", ["ends", "falls silent"])
def test_no_sample_is_lost_with_a_process(
    images: TrainingSet, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], how: str
) -> None:
    monkeypatch.setattr(sample_loader, "LOADER_LIMITS", replace(sample_loader.LOADER_LIMITS, poll_s=0.5))
    monkeypatch.setattr(sample_loader, "LOADER_LIMITS", replace(sample_loader.LOADER_LIMITS, silent_s=2.0))
    expected = [batch[0].name for batch in Loader(images, workers=0, console=Console()).batches(GROUPS, 1)]
    images.__class__ = _Ending
    images.how, images.parent = how, os.getpid()  # type: ignore[attr-defined]
    loader = Loader(images, workers=2, console=Console(quiet=True))
    assert [batch[0].name for batch in loader.batches(GROUPS, 1)] == expected
    assert loader.workers == 0
    said = capsys.readouterr().err
    assert "warning: processes that load images have " in said
    assert "this process loads them from here (--workers)" in said


@pytest.mark.parametrize("error", [EOFError, ConnectionRefusedError, ConnectionResetError])
def test_no_sample_is_lost_with_a_process_that_ends_while_it_hands_one_over(
    images: TrainingSet, monkeypatch: pytest.MonkeyPatch, error: type[Exception]
) -> None:
    expected = [batch[0].name for batch in Loader(images, workers=0, console=Console()).batches(GROUPS, 1)]

    class Breaking(DataLoader[Any]):
        def __iter__(self) -> Any:
            yield next(super().__iter__())
            raise error

    monkeypatch.setattr(sample_loader, "DataLoader", Breaking)
    loader = Loader(images, workers=1, console=Console(quiet=True))
    names = []
    for batch in loader.batches(GROUPS, 1):
        names.append(batch[0].name)
        monkeypatch.setattr(sample_loader, "DataLoader", DataLoader)
    assert (names, loader.workers) == (expected, 0)


def test_waiting_for_a_silent_process_can_be_stopped(images: TrainingSet, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sample_loader, "LOADER_LIMITS", replace(sample_loader.LOADER_LIMITS, poll_s=0.3))
    images.__class__ = _Ending
    images.how, images.parent = "falls silent", os.getpid()  # type: ignore[attr-defined]
    loader = Loader(images, workers=1, console=Console(quiet=True), stopping=lambda: True)
    with pytest.raises(KeyboardInterrupt):
        list(loader.batches(GROUPS, 1))
