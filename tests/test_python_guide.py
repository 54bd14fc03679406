"""The examples of docs/python.md run as they stand, a section after the other, each in an empty folder."""

import re
import runpy
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import skope as door
from skope.dataset import coco
from skope.schema import Result
from tests import hostile
from tests.samples import make_dataset
from tests.test_footage_door import detector, seen
from tests.train.conftest import shrink

__all__ = ["detector", "seen"]

ROOT = Path(__file__).parents[1]
PAGE = (ROOT / "docs" / "python.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
SECTIONS = {
    part.partition("\n")[0]: "".join(BLOCK.findall(part)) for part in PAGE.split("\n## ")[1:] if BLOCK.search(part)
}
SLOW = ("Datasets", "Training")


@pytest.fixture
def folder(seen: Path, detector: door.Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What the page takes for granted: a video, its camera, a site, an image; the detector is the perfect one."""
    for path in seen.iterdir():
        shutil.copy(path, tmp_path)
    (tmp_path / "v.mp4").rename(tmp_path / "crossing.mp4")
    frame = next(iter(detector.video(tmp_path / "crossing.mp4", start_s=1.0)))
    door.draw.write(tmp_path / "noon.jpg", frame.image)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("skope.api.detector.load_detector", lambda *_, **__: detector)
    return tmp_path


@pytest.mark.parametrize("section", [name for name in SECTIONS if name not in (*SLOW, "Scores")])
def test_examples_with_a_detector(section: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    exec(compile(SECTIONS[section], f"docs/python.md: {section}", "exec"), {})
    said = capsys.readouterr().out
    assert said
    if section == "From a video to a table of counts":
        assert len(SECTIONS[section].partition("```")[0].partition("report =")[0].strip().splitlines()) <= 11
        assert re.search(r"^ +0 s  gate +\w+ +\w+ +1  \d+ to \d+$", said, re.MULTILINE)
    if section == "Videos":
        assert len((folder / "tracks.csv").read_text().splitlines()) > 40


def test_the_example_counts(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    example = runpy.run_path(str(ROOT / "examples" / "count_vehicles.py"))
    example["main"]("crossing.mp4", "camera.json", "site.toml")
    assert re.search(r"^ +0 s  gate +\w+ +\w+ +1  \d+ to \d+$", capsys.readouterr().out, re.MULTILINE)


def test_example_of_scores(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    root = make_dataset(tmp_path / "data" / "roads", images=1, splits=("easy",))
    truth = coco.read(root / "annotations" / "easy.json").annotations
    found = [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in truth]
    coco.write_results(tmp_path / "predictions.json", found)
    monkeypatch.chdir(tmp_path)
    exec(SECTIONS["Scores"], {})
    assert capsys.readouterr().out == "1.0\n"


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """Small networks, and pictures that nobody renders."""
    shrink(monkeypatch)
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
    monkeypatch.chdir(tmp_path)
    make_dataset(tmp_path / "data" / "roads", images=2, splits=("train",))
    return


@pytest.mark.slow
@pytest.mark.parametrize("section", SLOW)
def test_examples_that_take_their_time(section: str, small: None, capsys: pytest.CaptureFixture[str]) -> None:
    code = SECTIONS[section].replace("epochs=1)", 'epochs=1, init="random", min_size=64, device="cpu")')
    exec(code.replace('weather="rain")', 'weather="rain", workers=1, renderer="pybullet")'), {})
    assert capsys.readouterr().out


def test_every_section_is_run() -> None:
    assert {*SECTIONS} >= {*SLOW, "Images", "Videos", "Threads", "Your own camera", "Scores", "Metres in one image"}
    assert len(SECTIONS) == PAGE.count("\n## ") - 1  # the last one names the examples
