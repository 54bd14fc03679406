"""Videos that are written here, read by OpenCV and played by a browser."""

import base64
import os
import resource
import signal
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from skope.errors import UserError
from skope.files.atomic import replacing
from skope.video.write import create_video, write_video
from tests.chromium import Browser

COLORS = ((200, 30, 40), (30, 160, 60), (40, 60, 210), (128, 128, 128), (250, 250, 250))
"""RGB that every way between light, chroma and back keeps, if it is the same way."""
SIZE = (96, 64)


def shades(size: tuple[int, int] = SIZE) -> Iterator[NDArray[np.uint8]]:
    for color in COLORS:
        yield np.full((size[1], size[0], 3), color, dtype=np.uint8)


def read(path: Path) -> tuple[list[float], list[NDArray[np.uint8]]]:
    """Times in seconds and frames (H, W, 3) RGB, by OpenCV."""
    capture = cv2.VideoCapture(str(path))
    times, frames = [], []
    while True:
        whole, frame = capture.read()
        if not whole:
            return times, frames
        times.append(capture.get(cv2.CAP_PROP_POS_MSEC) / 1000)
        frames.append(np.asarray(frame[:, :, ::-1]))


@pytest.mark.parametrize("name", ["v.mp4", "%03d.mp4", "v.avi"])
@pytest.mark.parametrize("fps", [5.0, 12.5, 30 / 1.001])
def test_times_and_colors_are_read_back(tmp_path: Path, name: str, fps: float) -> None:
    """Also of a file whose name FFmpeg would take for a pattern."""
    write_video(tmp_path / name, shades(), fps)
    times, frames = read(tmp_path / name)
    assert times == pytest.approx([k / fps for k in range(len(COLORS))], abs=1e-3)
    for frame, color in zip(frames, COLORS, strict=True):
        assert frame.shape == (SIZE[1], SIZE[0], 3)
        assert np.abs(frame.astype(int) - color).max() <= 4


def test_a_path_that_is_not_utf_8_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="FFmpeg takes no path that is not UTF-8"):
        write_video(tmp_path / os.fsdecode(b"\xff.mp4"), shades(), 10)


@pytest.mark.parametrize("fps", [0.0, -1.0, float("nan"), float("inf")])
def test_a_rate_that_is_none_is_refused(tmp_path: Path, fps: float) -> None:
    with pytest.raises(UserError, match="cannot be written as a video of"):
        write_video(tmp_path / "v.mp4", shades(), fps)


@pytest.mark.parametrize("fps", [1e-3, np.float32(0.5), 240])
def test_slow_and_fast_videos(tmp_path: Path, fps: float) -> None:
    write_video(tmp_path / "v.mp4", shades(), fps)
    times, _ = read(tmp_path / "v.mp4")
    assert times == pytest.approx([k / fps for k in range(len(COLORS))], rel=1e-3, abs=1e-3)


def test_a_full_disk_is_named(tmp_path: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (240, 320, 3), dtype=np.uint8)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    held = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, before[1]))
        with (
            pytest.raises(UserError, match=rf"^{tmp_path}/v\.mp4: .*File too large"),
            replacing(tmp_path / "v.mp4") as temporary,
        ):
            write_video(temporary, [noise] * 30, 10)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, held)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("other", [np.zeros((64, 98, 3), np.uint8), np.zeros((64, 96, 3), np.uint16)])
def test_a_frame_of_another_kind_is_refused(tmp_path: Path, other: NDArray[np.uint8]) -> None:
    with pytest.raises(ValueError, match="expected a frame of"):
        write_video(tmp_path / "v.mp4", [*shades(), other], 10)


def test_an_odd_size_gains_a_pixel(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mp4", shades((95, 63)), 10)
    _, frames = read(tmp_path / "v.mp4")
    assert {frame.shape for frame in frames} == {(64, 96, 3)}
    assert np.abs(frames[0].astype(int) - COLORS[0]).max() <= 4


def test_a_moving_picture_keeps_its_detail(tmp_path: Path) -> None:
    picture = cv2.imread(str(Path(__file__).parents[2] / "docs/noon.jpg"))[:, :, ::-1]
    frames = [np.ascontiguousarray(picture[k : k + 360, 2 * k : 2 * k + 640]) for k in range(12)]
    write_video(tmp_path / "v.mp4", frames, 10)
    _, back = read(tmp_path / "v.mp4")
    assert min(cv2.PSNR(a, b) for a, b in zip(frames, back, strict=True)) > 32


def test_what_cannot_be_written_is_said(tmp_path: Path) -> None:
    with (
        pytest.raises(UserError, match=r"v\.mp4: cannot be written as a video"),
        create_video(tmp_path / "v.mp4", (20_000, 20_000), 10) as video,
    ):
        video.add(np.zeros((20_000, 20_000, 3), dtype=np.uint8))
    write_video(tmp_path / "none.mp4", [], 10)
    assert not (tmp_path / "none.mp4").exists()


def test_a_browser_plays_it_in_its_colors(
    chromium_pages: Callable[[], AbstractContextManager[Browser]], tmp_path: Path
) -> None:
    write_video(tmp_path / "v.mp4", shades(), 5)
    data = base64.b64encode((tmp_path / "v.mp4").read_bytes()).decode()
    with chromium_pages() as browser:
        browser.run(f"document.body.innerHTML = '<video muted src=\"data:video/mp4;base64,{data}\"></video>'")
        browser.until("document.querySelector('video').readyState >= 2")
        assert browser.run("document.querySelector('video').duration") == pytest.approx(1.0, abs=0.01)
        for k, color in enumerate(COLORS):
            browser.run(f"document.querySelector('video').currentTime = {(k + 0.5) / 5}")
            # A busy browser may end a seek before the canvas is given the frame that it has come to.
            browser.until(
                "(() => { const canvas = document.createElement('canvas'), pen = canvas.getContext('2d');"
                "pen.drawImage(document.querySelector('video'), 0, 0);"
                "const shown = pen.getImageData(40, 30, 1, 1).data;"
                f"return {list(color)}.every((expected, i) => Math.abs(shown[i] - expected) <= 6); }})()"
            )
