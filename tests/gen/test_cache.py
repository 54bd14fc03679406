import os
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from skope.gen import cache
from skope.gen.mesh import Mesh
from skope.gen.scenery import build as towns
from skope.gen.towns.town import Town
from skope.gen.vehicles.fleet import build_vehicle, fleet
from skope.gen.vehicles.model import simplified_parts


@pytest.fixture(autouse=True)
def empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of its own for each test."""
    monkeypatch.setenv("SKOPE_CACHE", str(tmp_path))
    return tmp_path


def test_each_kind_is_bounded(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cache, "CACHE_LIMITS", replace(cache.CACHE_LIMITS, most_bytes=30_000))
    for i in range(6):
        cache.cached("light", f"{i}", lambda: {"ambient": np.zeros(4000, np.float16)})
        os.utime(empty / f"light_{i}.npz", (i, i))
    cache.cached("town", "x", lambda: {"mesh": np.zeros(12000, np.float16)})
    left = [path.name for path in sorted(empty.iterdir())]
    assert left == ["light_3.npz", "light_4.npz", "light_5.npz", "town_x.npz"]


def test_a_cache_that_cannot_be_written_is_none(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (empty / "file").write_text("in the way")
    monkeypatch.setenv("SKOPE_CACHE", str(empty / "file" / "below"))
    made = cache.cached("light", "x", lambda: {"ambient": np.ones(3, np.float16)})
    np.testing.assert_array_equal(made["ambient"], [1, 1, 1])


def test_what_can_only_be_read_is_used(monkeypatch: pytest.MonkeyPatch) -> None:
    cache.cached("light", "x", lambda: {"ambient": np.ones(3)})

    def refuse(*_: object) -> None:
        raise PermissionError

    monkeypatch.setattr(Path, "touch", refuse)
    found = cache.cached("light", "x", lambda: {"ambient": np.zeros(3)})
    np.testing.assert_array_equal(found["ambient"], np.ones(3))


def test_shapes_that_are_seen_once_are_not_kept(empty: Path) -> None:
    model = fleet()["sedan"].vehicle
    replace(model, shape=replace(model.shape, length=model.shape.length * 1.01)).coarse  # type: ignore[type-var] # noqa: B018
    assert not list(empty.iterdir())


def test_random_shapes_that_recur_are_kept(empty: Path) -> None:
    shape = {**fleet()["sedan"].vehicle.shape.to_dict(), "length": 4.61}
    assert build_vehicle("sedan", shape, recurs=True).coarse
    assert {path.name.split("_")[0] for path in empty.glob("*.npz")} == {"vehicle", "coarse"}


def test_what_two_want_at_once_is_made_once() -> None:
    made, start = [], threading.Barrier(2)

    def make() -> dict[str, np.ndarray]:
        made.append(threading.get_ident())
        threading.Event().wait(0.3)
        return {"a": np.arange(3)}

    def want() -> None:
        start.wait()
        np.testing.assert_array_equal(cache.cached("light", "x", make)["a"], [0, 1, 2])

    threads = [threading.Thread(target=want) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(made) == 1


def numbered_parts(made: list[int], wait_s: float = 0.0) -> list[Callable[[], dict[str, np.ndarray]]]:
    def make(k: int) -> dict[str, np.ndarray]:
        made.append(k)
        threading.Event().wait(wait_s)
        return {"a": np.array([k])}

    return [partial(make, k) for k in range(4)]


def in_order(parts: Sequence[cache.Arrays]) -> dict[str, np.ndarray]:
    return {"a": np.concatenate([part["a"] for part in parts])}


def test_parts_of_what_two_want_at_once_are_shared(empty: Path) -> None:
    made: list[list[int]] = [[], []]
    start = threading.Barrier(2)

    def want(mine: list[int]) -> None:
        start.wait()
        whole = cache.cached_from_parts("light", "x", numbered_parts(mine, 0.2), in_order)
        np.testing.assert_array_equal(whole["a"], [0, 1, 2, 3])

    threads = [threading.Thread(target=want, args=(mine,)) for mine in made]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(made[0] + made[1]) == [0, 1, 2, 3]
    assert len(made[0]) == len(made[1]) == 2
    assert [path.name for path in empty.iterdir()] == ["light_x.npz"]


def test_a_part_whose_maker_was_killed_is_made_by_who_waits(empty: Path) -> None:
    """A lock goes with its process: what it was making is begun again, what it has made is not."""
    code = (
        "import time, numpy as np; from skope.gen import cache\n"
        "def slow(): print('begun', flush=True); time.sleep(60)\n"
        "cache.cached_from_parts('light', 'x', [lambda: {'a': np.array([0])}, slow, slow, slow], None)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        other.stdout.readline()
        threading.Timer(0.5, other.kill).start()
        made: list[int] = []
        whole = cache.cached_from_parts("light", "x", numbered_parts(made), in_order)
    np.testing.assert_array_equal(whole["a"], [0, 1, 2, 3])
    assert made == [2, 3, 1]


def test_parts_are_made_where_nothing_can_be_kept(empty: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (empty / "file").write_text("in the way")
    monkeypatch.setenv("SKOPE_CACHE", str(empty / "file" / "below"))
    made: list[int] = []
    whole = cache.cached_from_parts("light", "x", numbered_parts(made), in_order)
    np.testing.assert_array_equal(whole["a"], [0, 1, 2, 3])
    assert made == [0, 1, 2, 3]


def test_a_town_is_found_as_it_was_built(empty: Path) -> None:
    towns.scenery.cache_clear()
    built = towns.scenery(Town("town01"))
    towns.scenery.cache_clear()
    found = towns.scenery(Town("town01"))
    (file,) = empty.iterdir()
    assert file.name.startswith("town_")
    assert found is not built
    _assert_same(found.mesh, built.mesh)
    assert (found.buildings, found.trees, found.bays) == (built.buildings, built.trees, built.bays)
    np.testing.assert_array_equal(found.lamps, built.lamps)
    assert len(found.signals) == len(built.signals) > 0
    for signal, other in zip(found.signals, built.signals, strict=True):
        assert (signal.program, signal.link) == (other.program, other.link)
        np.testing.assert_array_equal(signal.lamps, other.lamps)
        np.testing.assert_array_equal(signal.facing, other.facing)


@pytest.mark.parametrize("model", ["sedan", "box_truck", "bus"])
def test_a_vehicle_is_found_as_it_was_built(model: str) -> None:
    built = replace(fleet()[model].vehicle)  # type: ignore[type-var]
    for mesh, simple in zip(built.coarse, simplified_parts(built.parts), strict=True):
        _assert_same(mesh, simple)
    found = replace(built)
    _assert_same(found.mesh, built.mesh)
    _assert_same(found.interior, built.interior)
    for mesh, other in zip(found.coarse, built.coarse, strict=True):
        _assert_same(mesh, other)
    np.testing.assert_array_equal(found.points, built.points)


def test_another_program_builds_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = cache.digest_of("town01")
    assert before == cache.digest_of("town01") != cache.digest_of("town02")
    (tmp_path / "gen").mkdir()
    (tmp_path / "gen" / "trees.py").write_text("HEIGHT = 9\n")
    monkeypatch.setattr(cache, "__file__", str(tmp_path / "gen" / "cache.py"))
    cache._program_digest.cache_clear()
    changed = cache.digest_of("town01")
    monkeypatch.undo()
    cache._program_digest.cache_clear()
    assert changed != before == cache.digest_of("town01")


def _assert_same(mesh: Mesh | None, other: Mesh | None) -> None:
    assert mesh is not None
    assert other is not None
    assert mesh.materials == other.materials
    for field in ("vertices", "normals", "triangles", "material"):
        np.testing.assert_array_equal(getattr(mesh, field), getattr(other, field))
