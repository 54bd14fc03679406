"""One rule for every command that writes.

It goes on with what is the same work, refuses what is other work in one line that says how to get one or the other, and
overwrites nothing of anybody else's. The table below has a row for each command; docs/files.md says the same in words.
"""

import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
import typer
from typer.testing import CliRunner

from skope import cli
from skope.dataset import coco
from skope.detector.build import DetectorConfig, build
from skope.detector.checkpoint import checkpoint_bytes, checkpoint_name, save_weights
from skope.detector.network_settings import Settings
from skope.detector.predictor import Predictor
from skope.terminal.console import Console
from tests import hostile
from tests.eval.test_evaluate import POINTS, scene
from tests.gen.vehicles.test_marked_models import nodes, written
from tests.samples import make_annotation, make_dataset
from tests.sightings import drive
from tests.train.conftest import shrink

DOCS = Path(__file__).parent.parent / "docs/files.md"
ROAD = Path(__file__).parent.parent / "examples/own_road"
Loss = Callable[[Path], object]
"""Takes the last of what a command has written away, as if it had been stopped before."""


# -------------------------------------------------------------------------------------------------------- the commands


@dataclass(frozen=True, kw_only=True)
class Row:
    """A command: IN stands for the folder of what it works on, OUT for the file or folder that it writes."""

    own: str
    """The command."""
    other: str | None
    """Other work for the same place; None where a place says what the work is."""
    again: str | None = None
    """How finished work is gone on with; by default the same command."""
    ready: str | None = None
    """For commands that work where their input lies: what makes OUT, or the folder that OUT is a copy of."""
    half: str | None = None
    """A command that does a part of the same work."""
    lost: Loss | None = None
    """With neither, all is written at once: nothing unfinished is ever there."""
    passing: tuple[str, ...] = ()
    """Folders whose files are written anew with other bytes."""
    beside: bool = False
    """Whether its files lie beside what others have in OUT."""
    foreign: str = "move|choose"
    """What is said of how to go on where OUT holds nothing that a command has made."""


def without(*names: str) -> Loss:
    """Takes files away, and whether they were there is asserted."""

    def lose(out: Path) -> None:
        for name in names:
            (found,) = out.glob(name)
            found.unlink()

    return lose


def only(*names: str) -> Loss:
    """Takes all files and folders but these away."""

    def lose(out: Path) -> None:
        for path in out.iterdir():
            if path.name not in names:
                shutil.rmtree(path) if path.is_dir() else path.unlink()

    return lose


_GEN = "--sites t01_main_west --frames 1 --size 96x54 --renderer pybullet --workers 1"
_VIDEO = "--fps 5 --seconds 0.2 --size 96x54 --renderer pybullet"
_TINY = "--set min_size=64 --set max_size=96 --set regions=8 --set keypoint_regions=1 --val-fraction 0"
_TRAIN = f"--max-images 1 --recipe scratch --set bfloat16=false --epochs 1 {_TINY} --device cpu"
_FIT = "--split train --last 1 --score 0.05 --device cpu"

WRITERS = {
    "gen": Row(
        own=f"gen {_GEN} --out OUT",
        other=f"gen {_GEN} --seed 1 --out OUT",
        half=f"gen simulate {_GEN} --out OUT",
    ),
    "gen simulate": Row(
        own=f"gen simulate {_GEN} --out OUT",
        other=f"gen simulate {_GEN} --seed 1 --out OUT",
        lost=without("recordings/*.npz"),
    ),
    "gen render": Row(
        own="gen render OUT --renderer pybullet --workers 1",
        other=None,
        ready=f"gen simulate {_GEN} --out OUT",
        foreign="move|make them with `skope gen simulate --out .*`",
    ),
    "gen check --repair": Row(
        own="gen check OUT --repair --workers 1",
        other=None,
        ready=f"gen {_GEN} --out OUT",
        lost=without("images/*/*.jpg"),
        foreign="not valid JSON|run `skope gen --out",
    ),
    "gen convert": Row(own="gen convert IN/one OUT --to coco", other="gen convert IN/two OUT --to coco"),
    "gen convert --to cvat": Row(
        own="gen convert IN/one OUT.zip --to cvat", other="gen convert IN/two OUT.zip --to cvat"
    ),
    "gen merge": Row(own="gen merge IN/left IN/right OUT", other="gen merge IN/right IN/left OUT"),
    "gen video": Row(
        own=f"gen video t01_main_west {_VIDEO} --overlay --out OUT",
        other=f"gen video t01_main_west {_VIDEO} --overlay --seed 1 --out OUT",
        lost=without("*west.mp4"),
        beside=True,
    ),
    "gen show": Row(own="gen show IN/one --out OUT", other="gen show IN/two --out OUT", lost=without("train.png")),
    "gen report": Row(
        own="gen report IN/one --out OUT", other="gen report IN/two --out OUT", lost=without("index.html")
    ),
    "gen stats --plots": Row(
        own="gen stats IN/one --plots OUT", other="gen stats IN/two --plots OUT", lost=without("stats.png")
    ),
    "gen sites --maps": Row(
        own="gen sites --maps --out OUT",
        other="gen sites --site IN/road/site.toml --out OUT",
        lost=without("town07.png"),
    ),
    "gen sites --site": Row(
        own="gen sites --site IN/road/site.toml --out OUT",
        other="gen sites --site IN/lane/site.toml --out OUT",
        lost=without("site.png"),
    ),
    "gen vehicles show": Row(
        own="gen vehicles show suv --out OUT", other="gen sites --maps --out OUT", lost=without("suv.png")
    ),
    "gen vehicles add": Row(
        own="gen vehicles add IN/car.glb --name OUT",
        other="gen vehicles add IN/car.glb --name OUT --mass 900",
        lost=without("vehicle.json"),
        beside=True,
    ),
    "doctor --pictures": Row(
        own="doctor --pictures OUT", other="gen vehicles show suv --out OUT", lost=without("doctor_pybullet.png")
    ),
    "train": Row(
        own=f"train --data IN/one --out OUT {_TRAIN}",
        other=f"train --data IN/two --out OUT --seed 1 {_TRAIN}",
        lost=only("recipe.json", "tensorboard"),
        passing=("tensorboard",),
    ),
    "train export": Row(
        own="train export IN/run --to compact --out OUT.bin", other="train export IN/rerun --to compact --out OUT.bin"
    ),
    "eval": Row(
        own="eval --annotations IN/a.json --predictions IN/a_results.json --out OUT",
        other="eval --annotations IN/b.json --predictions IN/b_results.json --out OUT",
        lost=without("metrics.json"),
    ),
    "eval compare --out": Row(
        own="eval compare IN/scores_a IN/scores_a --out OUT.json",
        other="eval compare IN/scores_b IN/scores_b --out OUT.json",
    ),
    "eval calibrate-scores": Row(
        own=f"eval calibrate-scores --checkpoint OUT --data IN/found {_FIT}",
        other=f"eval calibrate-scores --checkpoint OUT --data IN/found --max-images 1 {_FIT}",
        ready="IN/run",
        lost=without("*.calibration.json"),
        foreign="not a safetensors file|no checkpoint in",
    ),
    "eval calibrate-scores --out": Row(
        own=f"eval calibrate-scores --checkpoint IN/run --data IN/found {_FIT} --out OUT.safetensors",
        other=f"eval calibrate-scores --checkpoint IN/rerun --data IN/found {_FIT} --out OUT.safetensors",
    ),
    "eval predict": Row(
        own="eval predict IN/frames --checkpoint IN/run --device cpu --overlay --out OUT",
        other="eval predict IN/others --checkpoint IN/run --device cpu --out OUT",
        lost=without("predictions.json"),
    ),
    "eval pose": Row(
        own="eval pose --annotations IN/road.json --out OUT",
        other="eval pose --annotations IN/lane.json --out OUT",
        lost=without("pose_errors.json"),
    ),
    "eval track": Row(
        own="eval track --annotations IN/road.json --out OUT",
        other="eval track --annotations IN/lane.json --out OUT",
        lost=without("tracks.csv"),
    ),
    "eval traffic": Row(
        own="eval traffic IN/road_tracks --site IN/gates.toml --out OUT",
        other="eval traffic IN/road_tracks --site IN/gates.toml --start-time 2026-11-26T10:00:00Z --out OUT",
        lost=without("summary.json"),
    ),
    "eval camera": Row(
        own="eval camera --points IN/points.csv --size 640x480 --out OUT.json",
        other="eval camera --points IN/others.csv --size 640x480 --out OUT.json",
    ),
}
"""Killed in the midst of it and gone on with, to the same bytes: `gen` in tests/gen/pipeline/test_generate.py
(test_killed_at_any_moment_it_goes_on_to_the_same_bytes), `train` in tests/train/test_loop.py
(test_a_resumed_run_equals_an_uninterrupted_one), `eval predict` in tests/eval/cli/test_footage.py
(test_a_stopped_run_goes_on_and_ends_as_if_never_stopped), `eval` below."""

READERS = {
    "doctor",
    "gen check",
    "gen stats",
    "gen sites",
    "gen view",
    "eval view",
    "eval site",
    "eval station",  # a database: tests/station
    "gen vehicles list",
    "gen vehicles check",
    "gen vehicles remove",
    "eval compare",
}
"""Commands that write nothing, or only with a flag that has a row above; what `remove` takes away is tested in
tests/gen/vehicles/test_user_models.py, what the page of `site` saves in tests/site/page."""


def commands(command: Any, name: str = "") -> Iterator[str]:
    """Names of all commands of the command line, groups that are commands by themselves included."""
    below = getattr(command, "commands", {})
    if not below or command.invoke_without_command:
        yield name
    for word, one in below.items():
        yield from commands(one, f"{name} {word}".strip())


def test_every_command_has_a_row_or_writes_nothing() -> None:
    every = set(commands(typer.main.get_command(cli.app)))
    assert {name.split(" --")[0] for name in WRITERS} | READERS == every
    assert not READERS & WRITERS.keys()


def test_the_documentation_has_a_row_for_each() -> None:
    told = re.findall(r"^\| `([^`]+)`", DOCS.read_text(encoding="utf-8"), re.MULTILINE)
    assert sorted(told) == sorted(WRITERS)


# ---------------------------------------------------------------------------------------------------- what they work on


def picture(path: Path, seed: int) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), np.random.default_rng(seed).integers(0, 255, (60, 80, 3), dtype=np.uint8))


def run_folder(path: Path, seed: int) -> Path:
    """A run folder with the checkpoint of a small detector that has learned nothing."""
    torch.manual_seed(seed)
    config = DetectorConfig(norm="batch", norm_eps=1e-5, min_size=64, max_size=96)
    model = build(config)
    save_weights(path / checkpoint_name(1), model, config, {})
    return path


def found_dataset(root: Path, run: Path) -> Path:
    """A dataset whose vehicles are what a detector finds."""
    make_dataset(root, splits=("train",))
    predictor = Predictor.load(run, Settings(device="cpu"), Console(quiet=True))
    path = root / "annotations/train.json"
    file = coco.read(path)
    found = predictor.split(file, root)[:12]
    vehicles = [
        replace(make_annotation(i, one.image_id, tuple(one.bbox)), keypoints=np.hstack([one.keypoints[:, :2], seen]))
        for i, one in enumerate(found, start=1)
        for seen in [1 + (np.arange(33)[:, None] % 2)]
    ]
    coco.write(path, replace(file, annotations=tuple(vehicles)))
    return root


@pytest.fixture(scope="module", autouse=True)
def one_thread() -> Iterator[None]:
    """Threads that wait for each other take longer than such small networks do."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """All that the commands work on."""
    root = tmp_path_factory.mktemp("given")
    with pytest.MonkeyPatch.context() as patch:
        shrink(patch)
        patch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
        make_dataset(root / "one")
        make_dataset(root / "two", seed=1)
        make_dataset(root / "left", splits=("train",))
        make_dataset(root / "right", splits=("train",), seed=1)
        run_folder(root / "rerun", 1)
        found_dataset(root / "found", run_folder(root / "run", 0))
    for name, x in (("a", 10.0), ("b", 20.0)):
        truth, results = scene(root, name, x)
        CliRunner().invoke(
            cli.app,
            f"eval --annotations {truth} --predictions {results} --out {root}/scores_{name} -q".split(),
            catch_exceptions=False,
        )
    coco.write(root / "road.json", drive(1, 5))
    coco.write(root / "lane.json", drive(2, 5))
    track = f"eval track --annotations {root}/road.json --out {root}/road_tracks -q"
    CliRunner().invoke(cli.app, track.split(), catch_exceptions=False)
    (root / "gates.toml").write_text('[[gates]]\nname = "a"\nline = [[-100, 0], [100, 0]]\n')
    for seed in range(2):
        picture(root / f"frames/{seed}.png", seed)
        picture(root / f"others/{seed}.png", seed + 2)
    (root / "points.csv").write_text(POINTS)
    (root / "others.csv").write_text(POINTS.replace("100,400", "101,400"))
    written(root / "car.glb", nodes())
    for name in ("road", "lane"):
        shutil.copytree(ROAD, root / name)
    return root


class Yard:
    """Runs commands in an empty folder and compares what lies there before and after."""

    def __init__(self, skope: Any, given: Path) -> None:
        self._skope, self.given, self.out = skope, given, Path("made")

    def run(self, command: str) -> tuple[int, str, str]:
        words = command.replace("IN/", f"{self.given}/").replace("OUT", str(self.out)).split()
        return self._skope(*words, "-q") if "compare" not in words else self._skope(*words)

    def works(self, command: str) -> None:
        code, out, err = self.run(command)
        assert code == 0, (command, out, err)

    def refused(self, command: str, how: str) -> None:
        before = below(Path())
        code, _, err = self.run(command)
        assert (code, err.count("\n"), err.split(" ")[0]) == (2, 1, "skope:"), (command, err)
        assert re.search(how, err), err
        assert below(Path()) == before


def below(root: Path, passing: tuple[str, ...] = ()) -> dict[str, bytes]:
    """All files and folders by path, with what they hold; those of folders called as in `passing` left out."""
    paths = (path for path in sorted(root.rglob("*")) if not set(passing) & set(path.parts))
    return {str(path.relative_to(root)): path.read_bytes() if path.is_file() else b"" for path in paths}


@pytest.fixture
def yard(skope: Any, given: Path, monkeypatch: pytest.MonkeyPatch) -> Yard:
    """A place where nothing takes long: small networks, and pictures of nothing from roads, towns and vehicles."""
    plain = np.zeros((54, 96, 3), dtype=np.uint8)
    shrink(monkeypatch)
    plainly = checkpoint_bytes
    monkeypatch.setattr("skope.train.export.checkpoint_bytes", lambda *of, **_: plainly(*of))  # packing takes seconds
    # Before the renderer: what is imported for the first time would keep the one of the tests.
    monkeypatch.setattr("skope.gen.inspect.vehicle_models.sheet", lambda *_: plain)
    for module in ("pipeline.workers", "pipeline.write_footage", "render.choose_renderer"):
        monkeypatch.setattr(f"skope.gen.{module}.make_renderer", hostile.FlatRenderer)
    monkeypatch.setattr("skope.gen.inspect.town_maps.town_map", lambda _: plain)
    monkeypatch.setattr("skope.gen.inspect.trial_images._refuse_blank", lambda *_: None)
    monkeypatch.setattr("skope.doctor.PROCESSES", {})
    monkeypatch.setenv("SKOPE_VEHICLES", ".")
    return Yard(skope, given)


# ------------------------------------------------------------------------------------------------------------- the rule


def places(yard: Yard) -> list[Path]:
    """The file or folder that stands for OUT, if there is one."""
    return list(Path().glob(f"{yard.out}*"))


def emptied(yard: Yard) -> None:
    for path in places(yard):
        shutil.rmtree(path) if path.is_dir() else path.unlink()


def begin(yard: Yard, row: Row) -> None:
    """Have what the command works on where it works, if it writes there."""
    if row.ready and row.ready.startswith("IN/"):
        shutil.copytree(yard.given / row.ready.removeprefix("IN/"), yard.out)
    elif row.ready:
        yard.works(row.ready)


@pytest.mark.parametrize("name", WRITERS)
def test_own_work_goes_on_and_nothing_else_is_touched(name: str, yard: Yard) -> None:
    row = WRITERS[name]
    begin(yard, row)
    yard.works(row.own)
    made = below(Path(), row.passing)
    (place,) = places(yard)

    yard.works(row.again or row.own)
    assert below(Path(), row.passing) == made, "made again"

    if row.lost:
        row.lost(yard.out)
        assert below(Path(), row.passing) != made
        yard.works(row.own)
        assert below(Path(), row.passing) == made, "gone on with"

    if row.half:
        emptied(yard)
        yard.works(row.half)
        yard.works(row.own)
        assert below(Path(), row.passing) == made, "gone on with"

    if row.other:
        yard.refused(row.other, "move|choose another")

    # Files of somebody's under the names of those that the command writes; then others, under other names.
    files = [path for path in place.rglob("*") if path.is_file()] or [place]
    emptied(yard)
    for path in files:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(b"mine")
    yard.refused(row.own, row.foreign)
    if place.is_dir():
        emptied(yard)
        place.mkdir()
        (place / "thesis.txt").write_bytes(b"mine")
        if row.beside:
            yard.works(row.own)
            assert below(Path(), row.passing) == made | {str(place / "thesis.txt"): b"mine"}
        else:
            yard.refused(row.own, row.foreign)


def test_an_evaluation_that_was_stopped_goes_on(yard: Yard, monkeypatch: pytest.MonkeyPatch) -> None:
    command = "eval --data IN/one --split easy --checkpoint IN/run --device cpu --out OUT"
    yard.works(command)
    made = below(Path())
    emptied(yard)
    by_image, done = Predictor.by_image, []

    def stops(*arguments: Any) -> Iterator[Any]:
        for pair in by_image(*arguments):
            yield pair
            done.append(pair)
            if len(done) == 1:
                raise KeyboardInterrupt

    monkeypatch.setattr(Predictor, "by_image", stops)
    assert yard.run(command)[0] == 130
    assert not (yard.out / "metrics.json").exists()
    yard.works(command)
    assert len(done) == 2
    assert below(Path()) == made
