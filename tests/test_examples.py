"""The examples run as they stand, one after the other, in an empty folder."""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import pytest

ROOT = Path(__file__).parents[1]


def run(folder: Path, name: str, *arguments: object) -> str:
    """Run an example in a process of its own; returns what it printed."""
    command = [sys.executable, str(ROOT / "examples" / name), *map(str, arguments)]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), os.environ["PYTHONPATH"]])}
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder in which the example has made a dataset."""
    folder = tmp_path_factory.mktemp("examples")
    said = run(folder, "generate_and_look.py", "two")
    assert said.count("images/") == 6
    assert "a batch of 2 images with" in said
    return folder


@pytest.mark.slow
def test_the_files_of_the_own_road_can_be_made_again(tmp_path: Path) -> None:
    folder = ROOT / "examples" / "own_road"
    shutil.copytree(folder, tmp_path / "road")
    for name in ("camera.yml", "marks.csv", "empty.jpg"):
        (tmp_path / "road" / name).unlink()
    run(tmp_path, str(tmp_path / "road" / "make_files.py"))
    assert (tmp_path / "road" / "camera.yml").read_bytes() == (folder / "camera.yml").read_bytes()
    assert (tmp_path / "road" / "marks.csv").read_bytes() == (folder / "marks.csv").read_bytes()
    made, kept = (cv2.imread(str(place / "empty.jpg")) for place in (tmp_path / "road", folder))
    assert made.shape == kept.shape  # houses and hedges there are others since the picture was made


def test_every_example_is_run() -> None:
    names = {path.name for path in (ROOT / "examples").glob("*.py")}
    assert names == {"count_vehicles.py", "generate_and_look.py", "label_images.py", "locate_vehicles.py"}
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    assert all(f"examples/{name}" in readme for name in names)


def test_generated_images_are_drawn(generated: Path) -> None:
    drawn = sorted(path.name for path in (generated / "two_seen").iterdir())
    assert drawn == [f"{site}_{k}.jpg" for site in ("t01_mill_corner", "t05_market_first") for k in range(3)]


def test_a_folder_of_images_is_labelled(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    shutil.copy(ROOT / "docs" / "noon.jpg", tmp_path / "in")
    said = run(tmp_path, "label_images.py", "in", "out")
    results = json.loads((tmp_path / "out" / "predictions.json").read_text())
    assert len(results) >= 6
    assert said == f"noon.jpg: {len(results)} vehicles\n"
    picture = cv2.imread(str(tmp_path / "out" / "noon.jpg"))
    assert picture.shape == cv2.imread(str(ROOT / "docs" / "noon.jpg")).shape


def test_vehicles_of_a_frame_are_located(generated: Path) -> None:
    """Against the ground truth of the generated image: most of what is said to stand somewhere does."""
    labels = next((generated / "two" / "annotations").glob("*.json"))
    document = json.loads(labels.read_text())
    image = document["images"][0]
    said = run(generated, "locate_vehicles.py", Path("two") / image["file_name"], labels)
    rows = [line.split() for line in said.splitlines()[1:-1]]
    assert len(rows) > 2
    truth = [a["box_3d"]["center"][:2] for a in document["annotations"] if a["image_id"] == image["id"]]
    near = [min(abs(float(x) - u) + abs(float(y) - v) for u, v in truth) < 2.0 for x, y, *_ in rows]
    assert sum(near) > 0.7 * len(near)
