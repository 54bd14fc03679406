"""Every script and every make target runs: with --help, at its smallest, and with the flags that it has today."""

import argparse
import importlib
import json
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final
from xml.etree import ElementTree

import numpy as np
import pytest
import torch

from skope.camera.model import Camera
from skope.dataset import coco
from skope.detector.checkpoint import find_checkpoint, read_checkpoint
from skope.errors import UserError
from skope.schema import AnnotationFile, Result
from skope.train.recipe import choose_recipe
from tests.eval.cli.test_footage import numbered_video
from tests.samples import make_dataset, make_image
from tests.sightings import drive
from tests.train.conftest import shrink
from tests.waiting import HANG_S

ROOT: Final = Path(__file__).parents[1]
SCRIPTS: Final = ROOT / "scripts"
SHARED: Final = "benchmark.py"
"""What the benchmarks share, no script itself."""
PYTHON: Final = sorted({path.relative_to(SCRIPTS).as_posix() for path in SCRIPTS.rglob("*.py")} - {SHARED})
SHELL: Final = sorted(path.name for path in SCRIPTS.glob("*.sh"))
MAKEFILE: Final = (ROOT / "Makefile").read_text(encoding="utf-8")
TARGETS: Final = sorted(set(re.findall(r"^([a-z][a-z-]*):", MAKEFILE, re.MULTILINE)))

Script = Callable[..., tuple[int, str, str]]


@dataclass(frozen=True)
class Run:
    """A script at its smallest."""

    script: str
    arguments: str
    """May name the `inputs` in braces. Where they name `checkpoint`, all detectors are as small as it."""
    says: str = ""
    """What is in its output."""
    code: int = 0
    apart: bool = False
    """Whether it needs a process of its own: it starts others, or draws."""
    slow: bool = False

    @property
    def marks(self) -> list[pytest.MarkDecorator]:
        return [pytest.mark.slow] if self.slow else []


TRAINING: Final = "--data {dataset} --min-size 64 --device cpu"
RENDERING: Final = "--size 96x54 --processes 1"
RUNS: Final[Sequence[Run]] = (
    Run(
        "bench_detector.py",
        "backbones --size 64x96 --vehicles 1 --rounds 1 --backend torch --precision float32"
        " --variants mobilenet-64-4x128",
        says="| mobilenet-64-4x128 | 4.7 | ",
    ),
    Run("bench_detector.py", "metrics --images 2", says="figures differ by at most 0.0e+00"),
    Run(
        "bench_detector.py",
        "inference --checkpoint {checkpoint} --data {dataset} --split easy --images 1 --device cpu",
        says="PCK@0.1 on the ground truth's boxes",
    ),
    Run("bench_gen.py", "dataset --flat 1 --processes 1", says="1 images", apart=True, slow=True),
    Run("bench_gen.py", f"dataset {RENDERING} --images 1 --peer-frames 1", says="EGL plugin", apart=True, slow=True),
    Run(
        "bench_footage.py",
        "steps {footage}/v.mp4 --camera {camera} --checkpoint {checkpoint}",
        says="v.mp4                 track",
    ),
    Run("legs_table.py", "--curve {out}/legs.svg", says="| wet_night |"),
    Run("research/camera_errors.py", "vehicles {road}", says="1 cameras answered"),
    Run("research/camera_errors.py", "shake {road} --picture {photograph}", says="| 10 px | "),
    Run(
        "bench_footage.py",
        "ways {footage} --checkpoint {checkpoint} --frames 2 --times 2 --only torch-float32@64",
        says='"cells": ["0", ',
    ),
    Run(
        "bench_stages.py",
        "{footage}/v.mp4 --checkpoint {checkpoint} --min-size 64 --backend torch --precision float32 --numbers 1,3"
        " --frames 2 --rounds 1",
        says="| keypoint head | ",
    ),
    Run(
        "bench/cameras_on_a_gpu.py",
        "{dataset}/images --cameras 2 --device cpu --seconds 0.1",
        says="2 cameras, shared batches: ",
        apart=True,
        slow=True,
    ),
    Run(
        "bench/yolo_pose.py",
        "train yolo11n-pose.yaml --data none --minutes 1 --out {out}",
        says="this environment lacks the package ultralytics",
        code=2,
    ),
    Run("bench_gen.py", f"frames {RENDERING} --vehicles 1 --frames 1 --skope-only", says="files", apart=True),
    Run("bench_gen.py", f"frames {RENDERING} --vehicles 1 --frames 1", says="EGL plugin", apart=True, slow=True),
    Run(
        "bench_train.py",
        f"{TRAINING} --batch-size 1 --steps 1 --warm-up 0 --rounds 1 --workers 0",
        says="| torchvision |",
        apart=True,
        slow=True,
    ),
    Run(
        "bench_gen.py",
        f"world {RENDERING} --frames 1",
        says="1 images of t01_mill_corner",
        apart=True,
        slow=True,
    ),
    Run("compile_towns.py", "town01 --out {out}", says="town01.net.xml"),
    Run("demo_page.py", "{out}/none --data {dataset}", says="no such file", code=2),  # a page: test_demo_page.py
    Run("draw_docs.py", "nonsense", says="no image is called nonsense", code=2),
    Run("draw_docs.py", "vehicle_sheet --out {out}", says="vehicle_sheet.jpg", apart=True, slow=True),
    Run(
        "draw_docs.py",
        "method_trilateration method_occlusion --out {out}",
        says="method_occlusion.jpg",
        apart=True,
        slow=True,
    ),
    Run(
        "research/experiment_train.py",
        f"{TRAINING} --init {{checkpoint}} --epochs 1 --max-images 1 --seeds 0 --variants exact --splits easy"
        " --test-images 1 --workers 0 --out {out}",
        says="| exact | easy |",
    ),
    Run(
        "research/experiment_train.py",
        f"{TRAINING} --init {{checkpoint}} --epochs 1 --max-images 1 --seeds 0 --images mine={{dataset}} --splits easy"
        " --test-images 1 --workers 0 --photographs {labels} --out {out}",
        says="| mine | ",
        slow=True,
    ),
    Run("house_figures.py", "{out}", says="has no folder skope", code=2),  # of a small tree: test_house_figures.py
    Run("infer_order.py", "{out}", says="no scene_K.zip", code=2),  # from scenes: test_infer_order.py
    Run("reference_run.py", "nonsense", says="invalid choice: 'nonsense'", code=2),
    Run("score_photographs.py", "{labels} --predictions {predictions} --out {out}", says="Wrote metrics.json"),
    Run(
        "bench_footage.py",
        "live {footage}/v.mp4 --fps 5 --minutes 0.03 --min-size 64 --checkpoint {checkpoint}",
        says="| minutes | images/s |",
    ),
    Run(
        "bench_footage.py",
        "curve {out} --look {checkpoint}@64@every --paths {footage}/v.json",
        says='{"rate": ',
    ),
    Run("research/night_statistics.py", "real={dataset} now={dataset}", says="luma_50"),
    Run("research/marker_offsets.py", "{road}", says="kind                points"),
    Run("train_leg.py", "run 1 --out {out}", says="stage 1 starts from weights: pass --state", code=2),
    Run("train_leg.py", "join {out} --out {out}/a.safetensors", says="parts.json", code=2),
    Run(
        "research/camera_calibration.py",
        "marks --draws 1 --cameras 1 --rows 4-points 6-points-one-wrong lengths",
        says="all cameras: ",
        slow=True,
    ),
    Run(
        "research/camera_calibration.py",
        "vehicles --draws 1 --cameras 1 --vehicles 5 --size-sigma 0.04",
        says="mean over the cameras",
        slow=True,
    ),
    Run("research/footage_scores.py", "tracks {road} --fps 10", says="  10    0/0"),
    Run("research/gate_coverage.py", "{clips}/t06_plaza_opening_day --true-keypoints", says="busy gate-minutes"),
    Run("research/traffic_scores.py", "counts {clips} --true-keypoints", says="why missed: -"),
    Run("research/traffic_scores.py", "lengths {clips} --true-keypoints", says="2 tracks; shares"),
    Run(
        "research/traffic_clips.py",
        "detect {clips} --only t06_plaza_opening_night",
        says="not all clips",
        code=1,
        apart=True,
    ),
    Run(
        "research/traffic_clips.py",
        "make --only t06_plaza_opening_day --seconds 0.5 --size 96x54 --out {out}",
        says="t06_plaza_opening_day: made",
        apart=True,
        slow=True,
    ),
    Run(
        "research/traffic_hours.py",
        "--hours 0.02 --kills 2 --recordings 2 --out {out}/hours",
        says="20 files: the same bytes",
        apart=True,
        slow=True,
    ),
    Run("research/footage_scores.py", "frames {clip} {clip}/seen", says="| 1.000 | 0.000 | 1.000 | - | 100.0 |"),
    Run("research/camera_calibration.py", "bound --draws 1", says="of 8 sets: forced", slow=True),
    Run("vehicle_shapes.py", "--samples 1 --azimuth-step 180 --out {out}", says="keypoint_visibility.json", slow=True),
)


# ------------------------------------------------------------------------------------------------------------- inputs


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory, random_weights: Path) -> dict[str, Path]:
    """Small files that the scripts read, by their names in `Run.arguments`."""
    folder = tmp_path_factory.mktemp("scripts")
    dataset = make_dataset(folder / "dataset", images=1)
    labels = coco.read(dataset / "annotations" / "easy.json")
    coco.write(dataset / "labels.json", labels)
    results = [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in labels.annotations]
    coco.write_results(folder / "predictions.json", results)
    road = drive(0.2, 10)
    road = replace(road, annotations=tuple(replace(a, distance=20.0) for a in road.annotations))
    coco.write(folder / "road.json", road)
    seen = [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in road.annotations]
    (folder / "clip" / "seen" / "road").mkdir(parents=True)
    coco.write(folder / "clip" / "road.json", road)
    coco.write_results(folder / "clip" / "seen" / "road" / "predictions.json", seen)
    (folder / "footage").mkdir()
    numbered_video(folder / "footage" / "v.mp4", 3)
    images = tuple(replace(image, time_s=0.1 * image.id) for image in (make_image(1), make_image(2), make_image(3)))
    coco.write(folder / "footage" / "v.json", AnnotationFile(images=images, annotations=()))
    camera = Camera.looking([0, 0, 6], yaw=0, pitch_down=0.4, size=(96, 64))
    (folder / "camera.json").write_text(json.dumps({"width": 96, "height": 64, **camera.to_dict()}))
    return {
        "camera": folder / "camera.json",
        "clips": one_clip(folder / "clips"),
        "dataset": dataset,
        "labels": dataset / "labels.json",
        "predictions": folder / "predictions.json",
        "road": folder / "road.json",
        "photograph": ROOT / "docs" / "noon.jpg",
        "clip": folder / "clip",
        "footage": folder / "footage",
        "checkpoint": random_weights,
    }


def one_clip(folder: Path) -> Path:
    """A folder of generated clips with one, in which a sedan drives across a gate and another one stands."""
    name = "t06_plaza_opening_day"
    road = drive(5, 10)
    vehicles = [a for a in road.annotations if a.box_3d and a.velocity is not None]
    state = [[*a.box_3d.center[:2], a.box_3d.yaw, *a.velocity[:2]] for a in vehicles if a.box_3d]
    (folder / name).mkdir(parents=True)
    coco.write(folder / name / "labels.json", road)
    np.savez(
        folder / name / "truth.npz",
        times_s=np.array([image.time_s for image in road.images]),
        frame=np.array([a.image_id - 1 for a in vehicles]),
        track=np.array([a.track_id for a in vehicles]),
        state=np.array(state),
        who=np.array([(str(k), "vehicle", "car", "4.5", "1.8", "False") for k in (1, 2)]),
    )
    moving = np.array([row for row, a in zip(state, vehicles, strict=True) if a.track_id == 1])
    middle, ahead = moving[len(moving) // 2, :2], moving[0, 3:]
    across = 5 * np.array([ahead[1], -ahead[0]]) / np.linalg.norm(ahead)
    line = [(middle + across).tolist(), (middle - across).tolist()]
    (folder / name / "site.toml").write_text(f'[[gates]]\nname = "gate"\nline = {line}\n')
    (folder / name / "clip.json").write_text(json.dumps({"name": name, "light": "day"}))
    return folder


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Script:
    """Run a script of scripts/ in this process; returns exit code, standard output and standard error."""

    def call(name: str, *arguments: str) -> tuple[int, str, str]:
        monkeypatch.syspath_prepend(str((SCRIPTS / name).parent))
        monkeypatch.setattr(sys, "argv", [str(SCRIPTS / name), *arguments])
        capsys.readouterr()
        code: Any = 0
        try:
            runpy.run_path(str(SCRIPTS / name), run_name="__main__")
        except SystemExit as stop:
            code = stop.code or 0
        return code, *capsys.readouterr()

    return call


def apart(name: str, *arguments: str) -> tuple[int, str, str]:
    """Run a script of scripts/ in a process of its own."""
    command = [sys.executable, str(SCRIPTS / name), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=HANG_S)
    return done.returncode, done.stdout, done.stderr


# ------------------------------------------------------------------------------------------------------------ scripts


def test_every_script_is_listed() -> None:
    assert sorted({run.script for run in RUNS}) == PYTHON
    files = [path for path in SCRIPTS.rglob("*") if path.is_file()]
    others = {path.name for path in files if path.suffix not in (".py", ".sh", ".pyc")}
    recipes = {"leg.toml", "lite.toml", "random.toml", "reference.toml", "world.toml"}
    assert others == {*recipes, "legs.toml", "legs.jsonl", "demo_page.html"}
    for name in recipes:
        assert choose_recipe(str(SCRIPTS / "recipes" / name), gpu=True, bfloat16=True).name == Path(name).stem


@pytest.mark.parametrize("name", PYTHON)
def test_help(script: Script, name: str) -> None:
    code, out, error = script(name, "--help")
    assert (code, error) == (0, "")
    assert out.startswith(f"usage: {Path(name).name}")


@pytest.mark.parametrize("run", [pytest.param(run, id=run.script, marks=run.marks) for run in RUNS])
def test_smallest_run(
    script: Script, inputs: dict[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, run: Run
) -> None:
    if "{checkpoint}" in run.arguments:
        shrink(monkeypatch)
        start = subprocess.run

        def start_small(command: Sequence[str], **options: Any) -> Any:
            """Scripts that a script starts have the same small detectors."""
            python, *words = command
            assert python == sys.executable
            return start([python, "-m", "tests.train.small_script", *words], **options)

        monkeypatch.setattr(subprocess, "run", start_small)
        monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(ROOT), os.environ["PYTHONPATH"]]))
    given = dict(inputs)
    given["out"] = tmp_path / "out"
    given["out"].mkdir()
    arguments = run.arguments.format_map(given).split()
    code, out, error = (apart if run.apart else script)(run.script, *arguments)
    assert code == run.code, error
    assert run.says in out + error


@pytest.mark.parametrize("name", SHELL)
def test_shell_scripts_parse(name: str) -> None:
    subprocess.run(["bash", "-n", str(SCRIPTS / name)], check=True)


# ------------------------------------------------------------------------------------------------------- make targets

RECORDER: Final = """#!/bin/sh
printf '%s' "$(basename "$0")" >> "$LOG"
for word; do printf '\\t%s' "$word" >> "$LOG"; done
echo >> "$LOG"
case " $* " in
*" gen --out data/skope "*) mkdir -p data/skope && touch data/skope/dataset.json ;;
*" train "*) mkdir -p runs/skope runs/paper ;;
*" --checkpoint runs/skope "*) mkdir -p runs/skope/eval && touch runs/skope/eval/metrics.json ;;
esac
"""
"""Stands for the programs of the virtual environment: notes what it is called with, and makes what make waits for."""

COMMANDS: Final[Mapping[str, int]] = {
    **{
        "setup": 0,
        "demo": 9,
        "chain": 5,
        "paper": 5,
        "real": 1,
        "test": 1,
        "test-slow": 1,
        "lint": 3,
        "data": 1,
        "model": 2,
    },
    **{"help": 0, "report": 3, "reference": 3, "lite": 1, "docs": 1, "bench": 9, "clean": 0},
}
"""Target -> number of the virtual environment's programs that it runs from nothing."""


@pytest.fixture
def make(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[subprocess.CompletedProcess[str], Any]]:
    """Run make in a copy of the project's top, with recorders in the virtual environment; returns what they noted."""
    for name in ("Makefile", "pyproject.toml", "constraints.txt"):
        shutil.copy(ROOT / name, tmp_path)
    shutil.copytree(SCRIPTS, tmp_path / "scripts")
    programs = tmp_path / ".venv" / "bin"
    programs.mkdir(parents=True)
    for name in ("skope", "python", "ruff", "mypy"):
        (programs / name).write_text(RECORDER)
        (programs / name).chmod(0o755)
    (programs.parent / ".ready").touch()
    log = tmp_path / "log"
    monkeypatch.setenv("LOG", str(log))
    for name in ("MAKEFLAGS", "DATA", "RUN", "REAL"):
        monkeypatch.delenv(name, raising=False)

    def call(*words: str) -> tuple[subprocess.CompletedProcess[str], list[list[str]]]:
        log.write_text("")
        done = subprocess.run(["make", *words], cwd=tmp_path, capture_output=True, text=True, check=False)
        return done, [line.split("\t") for line in log.read_text().splitlines()]

    return call


def test_every_target_is_listed() -> None:
    assert sorted(COMMANDS) == TARGETS
    (phony,) = re.findall(r"^\.PHONY: (.*)$", MAKEFILE, re.MULTILINE)
    assert sorted(phony.split()) == TARGETS
    told = set(re.findall(r"^#   make ([a-z-]+)|\(make ([a-z-]+):", MAKEFILE, re.MULTILINE))
    assert {a or b for a, b in told} <= set(TARGETS)


@pytest.mark.parametrize("target", TARGETS)
def test_dry_run(target: str) -> None:
    words = ["make", "--dry-run", target, *(["REAL=photographs"] if target == "real" else [])]
    done = subprocess.run(words, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.parametrize("target", TARGETS)
def test_targets_call_what_there_is(
    make: Any, skope: Any, script: Script, monkeypatch: pytest.MonkeyPatch, target: str
) -> None:
    """Every command is understood by the command line, or by the script, that it calls."""
    done, called = make(target, *(["REAL=photographs"] if target == "real" else []))
    assert (done.returncode, done.stderr) == (0, "")
    assert len(called) == COMMANDS[target]
    understand_only(monkeypatch)
    for program, *words in called:
        if program == "skope":
            code, _, error = skope(*words, "--help")
            assert code == 0, error
        elif program == "python" and words[0] != "-m":
            code, _, error = script(Path(words[0]).name, *words[1:])
            assert (code, error) == (0, "")


def test_recordings_of_the_reference_can_be_made(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    reference = importlib.import_module("reference_run")
    for words in reference.DATASETS.values():
        code, _, error = skope("gen", "simulate", *words.split(), "--help")
        assert code == 0, error
    legs, _ = importlib.import_module("train_leg").read_stages()
    for training in reference.TRAININGS.values():
        assert set(training.datasets) <= set(reference.DATASETS)
        assert set(training.stages) <= set(legs)
        assert training.after in (None, *reference.TRAININGS)
        assert bool(training.stages) != bool(training.recipe)


def test_places_of_the_legs_can_be_made(skope: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    leg = importlib.import_module("train_leg")
    legs, tests = leg.read_stages()
    numbered = [name for name in legs if name.isdigit()]
    assert numbered == [str(k) for k in range(1, len(numbered) + 1)]
    assert next(name for name in legs if not name.isdigit()) == "lite-1"
    places = list({name: text for one in legs.values() for name, text in one.places.items()}.values())
    seeds = [text.split()[text.split().index("--seed") + 1] for text in places]
    assert len(set(seeds)) == len(seeds), "no leg learns from the places of another"
    kinds = {
        re.sub(r"--seed \d+", "--seed 1", text) for text in (*places, *(test["places"] for test in tests.values()))
    }
    for text in sorted(kinds):
        for miniature in (False, True):
            code, _, error = skope("gen", "simulate", *leg.placed(text, miniature).split(), "--help")
            assert code == 0, error


def test_reference_learns_in_legs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each from the one before, the first from the training before if any; what is done is not done again."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    reference = importlib.import_module("reference_run")
    called: list[tuple[str, ...]] = []

    def script(clock: Any, *words: str) -> None:
        called.append(words)
        if words[1:3] == ("run", "3") and len(called) == 3:
            raise reference.TimeIsUpError

    monkeypatch.setattr(reference.Clock, "script", script)
    out = tmp_path / "road33"
    for leg in "12346":
        (out / f"leg_{leg}").mkdir(parents=True)
    options = argparse.Namespace(out=out, data=tmp_path / "data", gpus="0,1", workers=8)
    clock, training = reference.Clock(1.0, ["0", "1"]), reference.TRAININGS["road33"]
    with pytest.raises(reference.TimeIsUpError):
        reference.train_in_stages(clock, options, training)
    assert reference.train_in_stages(clock, options, training) == out / "joined.safetensors"
    runs = [words[2:5] for words in called if words[1] == "run"]
    first = ("1", "--init", str(tmp_path / "world" / "packed.safetensors"))
    pairs = zip("1234", "2346", strict=True)
    after = [(name, "--state", str(out / f"leg_{before}" / "state")) for before, name in pairs]
    assert runs == [first, *after[:2], *after[1:]]
    assert called[-1][1:3] == ("join", str(out / "leg_6" / "state"))
    called.clear()
    options.out = tmp_path / "lite"
    for leg in ("lite-1", "lite-2", "lite-3"):
        (options.out / f"leg_{leg}").mkdir(parents=True)
    reference.train_in_stages(clock, options, reference.TRAININGS["lite"])
    assert [words[2] for words in called if words[1] == "run"] == ["lite-1", "lite-2", "lite-3"]
    assert not {"--init", "--state"} & set(called[0]), "the first leg begins from nothing"


def test_a_leg_learns_from_places_that_were_drawn_before(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """They are there at once, and do not wait for those before them in the order."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    leg = importlib.import_module("train_leg")
    (tmp_path / "second").mkdir()
    (tmp_path / "second" / leg.CARD_FILE).write_text("{}")

    def make(places: Any, niceness: str, *command: str) -> None:
        time.sleep(0.5)
        if command[1] == "render":
            folder = Path(command[-1])
            folder.mkdir()
            (folder / leg.CARD_FILE).write_text("{}")

    monkeypatch.setattr(leg.Places, "_skope", make)
    places = leg.Places(tmp_path, {"first": "--preset demo", "second": "--preset demo"}, workers=1)
    assert places.wait_for(["first", "second"], time.monotonic()) == ["second"]
    assert sorted(places.wait_for(["first", "second"], time.monotonic() + HANG_S)) == ["first", "second"]
    places.stop()


def test_a_leg_learns_from_places_that_another_makes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It makes none itself, and sees them as soon as they are drawn."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    leg = importlib.import_module("train_leg")
    monkeypatch.setattr(leg.Places, "_skope", lambda places, *command: pytest.fail(f"{command}"))
    places = leg.Places(tmp_path, {"first": "--preset demo", "second": "--preset demo"}, workers=0)
    assert places.wait_for(["first"], time.monotonic()) == []
    (tmp_path / "first").mkdir()
    (tmp_path / "first" / leg.CARD_FILE).write_text("{}")
    assert places.wait_for(["first"], time.monotonic() + HANG_S) == ["first"]
    places.stop()


def test_weights_of_a_leg_travel_in_parts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, random_weights: Path
) -> None:
    """Joined they are the same but for 16 bits; a part that is missing or damaged is named."""
    monkeypatch.syspath_prepend(str(SCRIPTS))
    leg = importlib.import_module("train_leg")
    monkeypatch.setattr(leg, "PART_BYTES", find_checkpoint(random_weights).stat().st_size // 5)
    whole = find_checkpoint(random_weights)
    leg.pack(whole, tmp_path / "parts")
    parts = sorted(path.name for path in (tmp_path / "parts").iterdir())
    assert len(parts) > 2
    leg.join(tmp_path / "parts", tmp_path / "joined.safetensors")
    (before, given), (after, back) = (read_checkpoint(path) for path in (whole, tmp_path / "joined.safetensors"))
    assert before == after
    assert given.keys() == back.keys()
    for name, tensor in given.items():
        assert back[name].dtype == tensor.dtype
        if tensor.dim() > 1:
            assert torch.equal(back[name], tensor.half().float())
        else:
            assert torch.equal(back[name], tensor)
    second = tmp_path / "parts" / "part_02"
    data = bytearray(second.read_bytes())
    data[5] ^= 1
    second.write_bytes(data)
    with pytest.raises(UserError, match="part_02: damaged"):
        leg.join(tmp_path / "parts", tmp_path / "again.safetensors")
    second.unlink()
    with pytest.raises(UserError, match="part_02: missing"):
        leg.join(tmp_path / "parts", tmp_path / "again.safetensors")
    assert not (tmp_path / "again.safetensors").exists()


def understand_only(monkeypatch: pytest.MonkeyPatch) -> None:
    """Scripts end once they have understood their arguments."""
    parse = argparse.ArgumentParser.parse_args

    def parse_and_end(self: argparse.ArgumentParser, *args: Any, **named: Any) -> None:
        parse(self, *args, **named)
        raise SystemExit(0)

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_and_end)


def test_report_does_what_is_out_of_date(make: Any, tmp_path: Path) -> None:
    def words(*targets: str) -> list[str]:
        return [" ".join(call[1:3]) for call in make(*targets)[1]]

    assert words("report") == ["gen --out", "train --data", "eval --data"]
    assert words("report") == []
    newer = (tmp_path / "data" / "skope" / "dataset.json").stat().st_mtime + 10
    os.utime(tmp_path / "data" / "skope" / "dataset.json", (newer, newer))
    assert words("model") == ["train --data"]


def test_clean_keeps_data_and_runs(make: Any, tmp_path: Path) -> None:
    for name in ("data", "runs", "build"):
        (tmp_path / name).mkdir()
    assert make("clean")[0].returncode == 0
    assert {name: (tmp_path / name).exists() for name in ("data", "runs", "build", ".venv")} == {
        "data": True,
        "runs": True,
        "build": False,
        ".venv": False,
    }


def test_real_says_what_is_missing(make: Any) -> None:
    done, called = make("real")
    assert (done.returncode, called) == (2, [])
    assert "REAL is not set" in done.stderr


def test_the_chain_trains_anew_or_goes_on(make: Any, tmp_path: Path) -> None:
    first = [shlex.join(call[1:]) for call in make("chain")[1]]
    assert [line.split()[0] for line in first] == ["gen", "gen", "train", "eval", "eval"]
    (tmp_path / "runs" / "chain").mkdir(parents=True)
    (tmp_path / "runs" / "chain" / "resume.pt").touch()
    assert "train --out runs/chain --resume" in [shlex.join(call[1:]) for call in make("chain")[1]]


def test_the_demonstration_does_what_is_not_done(make: Any, tmp_path: Path) -> None:
    def words() -> list[str]:
        return [" ".join(call[: 2 if call[0] == "python" else 3]) for call in make("demo")[1]]

    whole = ["gen --sites", "eval --data", "gen video", "eval predict", "eval track", "train --data", "eval --data"]
    assert words() == [*(f"skope {step}" for step in [*whole, "eval compare"]), "python scripts/demo_page.py"]
    made = ("data/demo/dataset.json", "runs/demo/road33/report.html", "runs/demo/footage/t06_plaza_opening.json")
    for name in (*made, "runs/demo/tuned/resume.pt"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    going_on = ["eval predict", "eval track", "train --out", "eval --data", "eval compare"]
    assert words() == [*(f"skope {step}" for step in going_on), "python scripts/demo_page.py"]
    for name in ("seen/overlay.mp4", "tracks/birdseye.png", "tuned_score/report.html"):
        (tmp_path / "runs" / "demo" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "runs" / "demo" / name).touch()
    assert words() == ["skope eval compare", "python scripts/demo_page.py"]


def test_tables_of_the_legs_have_what_their_log_says(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.syspath_prepend(str(SCRIPTS))
    table = importlib.import_module("legs_table")
    rows = table.read_log()
    found = list(table.points(rows))
    assert [one.name for one in found] == ["start", *(row["leg"] for row in rows)]
    assert found[-1].visits == sum(one["visits"] for row in rows for one in row["rounds"])
    measured = [row["figures"]["end"].get("conditions_4711") for row in rows]
    night = ["" if splits is None else f"{100 * splits['night']['box_ap50']:.1f}" for splits in measured]
    (line,) = (one for one in table.splits_table(found, table.ap50).splitlines() if one.startswith("| night"))
    assert [cell.strip() for cell in line.split("|")[3:-1]] == night
    assert ElementTree.fromstring(table.curve(found)).tag.endswith("svg")
