"""The commands of README and docs: each runs here as it stands but smaller, page by page, or `NOT_RUN` says why not."""

import json
import re
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from skope.dataset import coco
from skope.schema import Result
from tests.eval.cli.test_footage import numbered_video
from tests.samples import make_dataset
from tests.test_docs import PAGES, ROOT

Skope = Callable[..., tuple[int, str, str]]

PROGRAM: Final = re.compile(
    r"^ {4,}((?:skope|make|pip|uv|cd|docker|python3?|pytest|torchrun|\S*/bin/\S+) .*|skope gen)$"
)
NOT_RUN: Final = {
    r"make |pip |uv |docker ": "set skope up, which has to be done before any test; CI begins with `make lint test`",
    r"skope eval site ": "serves until it is stopped: tests/site/page",
    r"skope eval station ": "needs recordings of a day: tests/station",
    r"pytest |\.venv/bin/": "are how tests are run",
    r"python scripts/": "test_scripts.py runs every script",
    r"torchrun ": "several processes: train/test_distributed.py",
    r"skope (gen|eval) view ": "serve until they are stopped: tests/viewer",
    r"skope gen --preset \w+(?!.*--dry-run)": "hours: gen/pipeline/test_generate.py makes them small",
    r"skope gen sites --maps": "draws every town: gen/cli tests draw one",
    r"skope eval traffic (tracks|video|runs/tracks|report/seen)": "take a reader's own: tests/traffic",
    r"skope eval predict rtsp://": "watches a reader's own camera: eval/cli/test_live_hours.py watches another one",
    r"python -m OTAnalytics": "another program: tests/traffic/test_otanalytics.py runs it",
    r"python \$SUMO_HOME": "other programs: tests/traffic/test_exports.py runs them",
    r"skope gen (convert (DATASET|SOURCE)|merge A )": "name what a reader puts there",
    r".*(skope3d|data/published|data/both)": "need the files of others: tests/gen/formats",
    r".* --scheme apollo24": "take results with other keypoints: test_keypoints.py has the maps",
    r".* --backend torch --precision float32": "footage/backends tests hold it against the others",
    r".*(\bnight\.toml|--data synthetic)": "name a reader's own files: tests/train",
    r"skope gen (vehicles (add|remove) |--vehicles )tow_truck": "name a reader's model; the example's is run",
    r"skope train (export|--init) road33(-lite)?": "loads the whole network: test_road33.py",
}
"""Why commands that begin like this are not run here."""
DRAWN: Final = (
    "README.md",
    "generating.md",
    "installing.md",
    "own-road.md",
    "rendering.md",
    "vehicles.md",
)
"""Pages whose commands draw images, which takes minutes."""

SMALLER: Final = {
    r"--frames \d+": "--frames 2",
    r"--size \S+": "--size 160x90",
    r"--seconds [\d.]+": "--seconds 1.2",
    r"--fps \d+": "--fps 10",
    r"--epochs \d+": "--epochs 1",
    r"--checkpoint road33(-lite)?": "--checkpoint runs/skope",
    r"teacher.checkpoint=road33": "teacher.checkpoint=runs/skope",
    r"--backbone resnet18": " ".join(
        f"--set network.{part}"
        for part in ("pyramid_width=16", "keypoint_layers=1", "keypoint_width=16", "box_width=16")
    ),
    r"--set network.(keypoint_width=128|box_width=256)": "",
}
OPTIONS: Final = {
    r"skope gen(?= --)": {"--frames": "1"},
    r"skope gen(?! \w)(?!.*\.toml)": {"--size": "160x90"},
    r"skope gen(?! \w)(?!.*--sites?)": {"--sites": "t01_mill_corner,t06_plaza_opening"},
    r"skope gen(?! \w)(?!.*--out)": {"--out": "data/by_default_{number}"},
    r"skope train(?! export)": {"--min-size": "64", "--device": "cpu", "--epochs": "1", "--max-images": "2"},
    r"skope train(?! export)(?!.*--init)": {"--init": "random"},
    r"skope train(?! export)(?!.*--out)": {"--out": "runs/trained_{number}"},
    r"skope eval(?! \w)(?!.*--predictions)": {"--min-size": "64", "--device": "cpu", "--checkpoint": "{run}"},
    r"skope eval calibrate-scores": {"--split": "val", "--score": "0.01"},
    r"skope eval predict": {"--min-size": "64", "--device": "cpu", "--checkpoint": "{run}"},
}
"""What is added to commands, by how they begin, unless they say it; `number` is the line's, `run` a small run."""


def lines(page: Path) -> list[str]:
    """The commands of a page, in order."""
    found = (PROGRAM.match(line) for line in page.read_text(encoding="utf-8").splitlines())
    return [" ".join(shlex.split(match[1], comments=True)) for match in found if match]


def is_run(line: str) -> bool:
    return not any(re.match(pattern, line) for pattern in NOT_RUN)


def smaller(line: str, number: int, run: Path) -> str:
    """The command on a small scale."""
    for pattern, words in SMALLER.items():
        line = re.sub(pattern, words, line)
    for pattern, options in OPTIONS.items():
        if re.match(pattern, line):
            line += "".join(f" {name} {value}" for name, value in options.items() if f"{name} " not in f"{line} ")
    return line.format(number=number, run=run)


def results_of(labels: Path) -> list[Result]:
    truth = coco.read(labels).annotations
    return [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in truth if not a.ignored]


BEFORE: Final = {
    "README.md": tuple(
        f"skope gen --sites t01_mill_corner,t06_plaza_opening --frames 2 --size 320x180 --out data/{name}"
        for name in ("roads", "tests")
    ),
    "evaluation.md": (
        "skope eval --split easy --min-size 64 --out runs/a/eval",
        "skope eval --split easy --min-size 64 --out runs/b/eval",
    ),
    "formats.md": ("skope gen convert data/skope exported.zip --to cvat",),
    "generating.md": ("skope gen convert data/skope exported.zip --to cvat",),
}
"""What else pages take for granted, as commands."""


def prepare(folder: Path, run: Path) -> None:
    """What the pages take for granted."""
    make_dataset(folder / "data/skope", images=2, splits=("train", "val", "easy", "medium", "hard"))
    shutil.copy(folder / "data/skope/annotations/hard.json", folder)
    coco.write_results(folder / "results.json", results_of(folder / "hard.json"))
    boxes = [{**row, "category_id": 3} for row in json.loads((folder / "results.json").read_text())]
    (folder / "boxes.json").write_text(json.dumps(boxes))
    (folder / "frames").mkdir()
    for path in (folder / "data/skope/images").rglob("*.png"):
        shutil.copy(path, folder / "frames")
    shutil.copytree(run, folder / "runs/skope")
    shutil.copytree(ROOT / "examples", folder / "examples")
    shutil.copy(ROOT / "examples/own_road/camera.yml", folder)
    for name in ("video.mp4", "crossing.mp4", "footage.mp4"):
        numbered_video(folder / name, 3)


def after(line: str, folder: Path) -> None:
    """Let later commands find what the small detector cannot: the vehicles of generated footage."""
    footage = folder / "footage"
    if line.startswith("skope gen video") and footage.exists():
        shutil.copy(footage / "site.mp4", folder / "video.mp4")
    if line.startswith("skope eval predict") and footage.exists():
        coco.write_results(Path("seen/predictions.json"), results_of(footage / "site.json"))


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.name, marks=[pytest.mark.slow] * (page.name in DRAWN))
        for page in PAGES
        if page.name != "from-camera-to-tracks.md"  # eval/test_guide.py holds its figures against the truth
    ],
)
def test_commands(page: Path, skope: Skope, random_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    prepare(tmp_path, random_run)
    for number, line in enumerate([*BEFORE.get(page.name, ()), *filter(is_run, lines(page))]):
        words = shlex.split(smaller(line, number, tmp_path / "runs/skope"))
        if words[0] == "cd":
            monkeypatch.chdir(words[1])
            shutil.copy(tmp_path / "video.mp4", ".")
            continue
        code, said, error = skope(*words[1:])
        assert code == 0, f"{' '.join(words)}: {said[-2000:]}{error[-2000:]}"
        after(line, tmp_path)


def test_each_reason_is_needed() -> None:
    every = [line for page in PAGES for line in lines(page)]
    for pattern in NOT_RUN:
        assert any(re.match(pattern, line) for line in every), pattern
