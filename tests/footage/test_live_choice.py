"""Which detector looks at a live stream."""

import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.detector import weights
from skope.files.json_files import read_json
from skope.footage.live_choice import LiveDetectorSelector
from skope.schema import AnyResult, Image
from skope.terminal.console import Console
from skope.types import Pixels
from tests.footage import streams

Frames = Iterator[tuple[Image, Pixels]]


class Slow:
    """A detector that takes so many seconds for a frame."""

    scheme, categories, files = None, ("vehicle",), (Path("file"),)

    def __init__(self, name: str, seconds: float) -> None:
        self.name, self.seconds = name, seconds
        self.seen: list[int] = []

    def each(self, images: Frames) -> Iterator[tuple[Image, list[AnyResult]]]:
        for image, _ in images:
            time.sleep(self.seconds)
            self.seen.append(image.id)
            yield image, []


def camera(fps: float) -> Frames:
    """Five frames of a camera, the newest whenever one is asked for."""
    begun = time.monotonic()
    image = Image(id=1, file_name="a/0", width=4, height=4, site="a", frame_index=0, time_s=0.0)
    for number in range(1, 6):
        at = int((time.monotonic() - begun) * fps)
        yield replace(image, id=number, frame_index=at, time_s=at / fps), np.zeros((4, 4, 3), np.uint8)


@pytest.mark.parametrize(
    ("fps", "names", "expected", "said"),
    [
        (4.0, ("exact", "quick"), "exact", ": exact runs (--checkpoint names another)"),
        (12.0, ("exact", "quick"), "quick", ": quick runs (--checkpoint names another)"),
        (5000.0, ("exact", "quick"), "quick", " are passed over"),
        (12.0, ("exact",), "exact", "detector speed on this machine, frames/s: exact "),
    ],
)
def test_the_first_one_that_keeps_up_looks(
    fps: float, names: tuple[str, ...], expected: str, said: str, capsys: pytest.CaptureFixture[str]
) -> None:
    detectors = [Slow(name, {"exact": 0.1, "quick": 0.001}[name]) for name in names]
    loaded: Any = detectors
    choice = LiveDetectorSelector(loaded, 1, Console())
    assert choice.files == (Path("file"),) * len(names)
    found = [image.id for image, _ in choice.each(camera(fps))]
    assert found == [1, 2, 3, 4, 5]
    assert choice.name == expected
    assert [one.seen[4:] for one in detectors if one.name == expected] == [found]
    assert [len(one.seen) for one in detectors if one.name != expected] == [4] * (len(names) - 1)
    (line,) = capsys.readouterr().out.splitlines()
    assert said in line


def test_a_stream_of_one_frame_and_none() -> None:
    for count in (0, 1):
        loaded: Any = [Slow("exact", 0.0), Slow("quick", 0.0)]
        frames = (frame for frame, _ in zip(camera(10), range(count), strict=False))
        assert len(list(LiveDetectorSelector(loaded, 1, Console(quiet=True)).each(frames))) == count


def test_predict_says_how_fast_each_is_and_which_one_looks(skope: Any) -> None:
    with streams.mjpeg(31, 4) as address:
        code, out, err = skope("eval", "predict", address, "--end", "4", "--min-size", "96", "--out", "seen")
    assert code == 0, err
    (line,) = [line for line in out.splitlines() if "detector speed on this machine, frames/s: " in line]
    assert all(f"{name} " in line for name in weights.BY_ACCURACY)
    assert line.startswith("the camera sends ")
    assert f": {read_json(Path('seen/frames.json'))['info']['detector']} runs" in line
