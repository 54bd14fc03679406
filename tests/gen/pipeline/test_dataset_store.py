"""What is done of a dataset is not lost: recordings that broke, shards that were begun, two that write at once."""

import fcntl
import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from skope.errors import UserError
from skope.files.atomic import locked
from tests import hostile
from tests.gen.small import content, gen

SITES = "t01_mill_corner,t01_main_west"
FLAGS = ["--size", "192x108", "--no-depth", "--workers", "1", "--quiet", "--format", "shards"]


def made(out: Path, sites: str, frames: int, *, before: str = "") -> subprocess.CompletedProcess[str]:
    """`skope gen` in shards, with some Python run before it."""
    arguments = ["skope", "gen", "--out", str(out), "--sites", sites, "--frames", str(frames), *FLAGS]
    code = f"import sys; sys.argv = {arguments!r}\n{before}\nfrom skope.cli import main; main()"
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


DIES_BEFORE_THE_MANIFEST = """import os
from skope.gen.output import writers
writers.DatasetWriter.finish = lambda self: os._exit(9)"""


@pytest.mark.slow
def test_shards_that_were_begun_are_extended(tmp_path: Path) -> None:
    """Killed between shards and manifest, then begun again with more frames, and with a site that comes first."""
    assert made(tmp_path / "d", SITES, 2, before=DIES_BEFORE_THE_MANIFEST).returncode == 9
    assert len(list((tmp_path / "d" / "shards").glob("*.tar"))) == 2
    again = made(tmp_path / "d", f"t02_birch_mast,{SITES}", 3)
    assert again.returncode == 0, again.stderr
    assert made(tmp_path / "direct", f"t02_birch_mast,{SITES}", 3).returncode == 0
    assert content(tmp_path / "d") == content(tmp_path / "direct")


@pytest.mark.slow
def test_shards_that_were_begun_go_on_with_what_is_there(tmp_path: Path) -> None:
    assert made(tmp_path / "d", SITES, 2, before=DIES_BEFORE_THE_MANIFEST).returncode == 9
    first = sorted((tmp_path / "d" / "shards").glob("*.tar"))[0]
    before = first.stat().st_mtime_ns
    assert made(tmp_path / "d", SITES, 2).returncode == 0
    assert first.stat().st_mtime_ns == before


@pytest.mark.slow
def test_a_recording_that_broke_is_made_again(whole: Path, tmp_path: Path) -> None:
    out = tmp_path / "d"
    simulate = gen(out, "--workers", "1")
    simulate.insert(4, "simulate")
    subprocess.run(simulate, check=True)
    path = sorted((out / "recordings").glob("*.npz"))[0]
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    rendered = subprocess.run(
        [sys.executable, "-m", "skope", "gen", "render", str(out)], capture_output=True, text=True, check=False
    )
    assert rendered.returncode == 2
    assert str(path) in rendered.stderr
    assert rendered.stderr.count("\n") == 1
    again = subprocess.run(
        [part for part in gen(out, "--workers", "1") if part != "--quiet"], capture_output=True, text=True, check=False
    )
    assert again.returncode == 0, again.stderr
    assert f"{path}: is damaged, and is made again" in again.stdout
    assert content(out) == content(whole)


ONE = ("--sites", "t01_mill_corner", "--frames", "1", "--size", "160x120", "--renderer", "pybullet", "--workers", "1")
COMMANDS = {
    "gen": ("gen", "--out", "d", *ONE),
    "simulate": ("gen", "simulate", "--out", "d", *ONE),
    "render": ("gen", "render", "d", "--renderer", "pybullet", "--workers", "1"),
    "repair": ("gen", "check", "d", "--repair", "--workers", "1"),
    "shards": ("gen", "convert", "d", "tars", "--to", "shards"),
}


@pytest.mark.parametrize(
    ("make", "name", "commands"),
    [
        (hostile.begun, ".work/parameters.json", ("gen", "simulate", "render")),
        (hostile.complete, "dataset.json", ("gen", "simulate", "render", "repair", "shards")),
    ],
)
def test_damaged_parameters_are_one_line(
    make: Callable[[Path], Path], name: str, commands: tuple[str, ...], skope: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever field is missing, or of another kind, the file and the field are named and nothing is written."""
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
    path = make(Path("d")) / name
    for image in Path("d").glob("images/*/*.jpg"):
        image.unlink()  # so that there is something to repair
    whole = json.loads(path.read_text())
    held = whole["parameters"]
    damaged: list[tuple[str, Any]] = [
        (field, {name: value for name, value in held.items() if name != field}) for field in held
    ]
    damaged += [(field, {**held, field: 1.5}) for field in ("renderer", "rules", "own", "seed", "shape_jitter")]
    damaged += [
        ("fov_deg", {**held, "fov_deg": "x"}),
        ("sites", {**held, "sites": [3]}),
        ("rules", {**held, "rules": {}}),
    ]
    damaged += [("", None), ("", [])]
    for field, parameters in damaged:
        rest = {key: value for key, value in whole.items() if key != "parameters"}
        path.write_text(json.dumps(rest if parameters is None else {**rest, "parameters": parameters}))
        before = content(Path("d"))
        for command in commands:
            code, _, error = skope(*COMMANDS[command], "--quiet")
            assert (code, error.count("\n")) == (2, 1), (field, parameters, command, error)
            assert f"skope: d/{name}: " in error
            assert (f" parameters.{field}" if field else " parameters: ") in error, (command, error)
        assert content(Path("d")) == before


def test_whoever_holds_the_lock_holds_the_file_that_is_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another process ends, and takes its lock's file away, after this one has opened it."""
    path, flock = tmp_path / ".lock", fcntl.flock
    taken_away = []

    def late(file: Any, how: int) -> None:
        if not taken_away:
            taken_away.append(path)
            path.unlink()
        flock(file, how)

    monkeypatch.setattr(fcntl, "flock", late)
    with locked(path, "busy"), path.open("w") as other:
        with pytest.raises(BlockingIOError):
            flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        with pytest.raises(UserError, match="busy"), locked(path, "busy"):
            pass
    assert not path.exists()
