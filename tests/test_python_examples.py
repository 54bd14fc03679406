"""The examples of the Python reference run as they stand, each in a copy of one folder, and print what they say."""

import re
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

DOCS = Path(__file__).parents[1] / "docs"
with pytest.MonkeyPatch.context() as patch:
    patch.syspath_prepend(DOCS)
    from python_examples import EXAMPLES
    from python_reference import GIVEN, python_reference

SMALLER = {
    "epochs=1)": 'epochs=1, init="random", min_size=64, device="cpu", workers=0)',
    'weather="rain")': 'weather="rain", workers=1, renderer="pybullet")',
}
"""Arguments that a test needs in addition: the network is small, and nothing is rendered."""


@pytest.fixture(scope="module")
def given(seen: Path, detector: door.Detector, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with all that the examples take for granted."""
    folder = tmp_path_factory.mktemp("given") / "given"
    shutil.copytree(seen, folder)
    (folder / "v.mp4").rename(folder / "crossing.mp4")
    shutil.copy(folder / "crossing.mp4", folder / "traffic.mp4")
    frame = next(iter(detector.video(folder / "crossing.mp4", start_s=1.2)))
    door.draw.write(folder / "noon.jpg", frame.image)
    root = make_dataset(folder / "data" / "roads", images=2, splits=("easy", "train"))
    truth = coco.read(root / "annotations" / "easy.json").annotations
    found = [Result(image_id=a.image_id, score=0.95, bbox=a.bbox, keypoints=a.keypoints) for a in truth]
    coco.write_results(folder / "predictions.json", found)
    return folder


@pytest.fixture
def folder(given: Path, detector: door.Detector, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy of the folder as the current one. The detector is the perfect one, new networks are small."""
    copy = shutil.copytree(given, tmp_path / "copy")
    monkeypatch.chdir(copy)
    monkeypatch.setattr("skope.api.detector.load_detector", lambda *_, **__: detector)
    monkeypatch.setattr("skope.gen.pipeline.workers.make_renderer", hostile.FlatRenderer)
    shrink(monkeypatch)
    return copy


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_prints_what_it_says(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = EXAMPLES[name]
    for part, smaller in SMALLER.items():
        code = code.replace(part, smaller)
    capsys.readouterr()
    exec(compile(code, f"docs/python_examples.py: {name}", "exec"), {})
    printed = capsys.readouterr().out.splitlines()
    assert printed
    if expected := re.findall(r"^#> (.*)$", code, re.MULTILINE):
        assert printed == expected


def test_every_public_name_has_an_example_that_uses_it() -> None:
    assert {*EXAMPLES} == {*door.__all__, *(value.__name__ for value in GIVEN)}
    for name, code in EXAMPLES.items():
        assert name not in door.__all__ or name[0].isupper() or f"skope.{name}" in code, name
        assert len(code.strip().splitlines()) <= 12, name


def test_the_reference_has_every_example(monkeypatch: pytest.MonkeyPatch) -> None:
    page = python_reference()
    for name, code in EXAMPLES.items():
        section = page.split(f"\n### `{name if any(name == one.__name__ for one in GIVEN) else f'skope.{name}'}`\n")[1]
        assert f"```python\n{code.strip()}\n```" in section.split("\n### ")[0], name


def test_a_name_without_an_example_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(door, "__all__", [*door.__all__, "Nothing"])
    with pytest.raises(AssertionError):
        test_every_public_name_has_an_example_that_uses_it()
