"""`skope eval site` refuses in one line what it cannot begin with, and Ctrl-C ends it without anything written."""

import json
import signal
import urllib.request
from pathlib import Path
from typing import Any

import pytest

from skope.site.write_site import save_site
from tests.local_page import begun
from tests.waiting import HANG_S


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "FOOTAGE: needed; without any, --points and --size begin on an empty canvas"),
        (["gone.mp4"], "gone.mp4: no such file or folder"),
        (["rtsp://camera/1", "--size", "8x8"], "--size: is for an empty canvas; the footage has its own"),
        (["--size", "8x8"], "--size: expected 16 to 8192 pixels, got 8x8"),
        (["--points", "marks.json"], "--points: marks.json: expected .otrfpts or .csv"),
        (["--points", "gone.csv"], "gone.csv: no such file"),
    ],
)
def test_what_it_cannot_begin_with_is_one_line(
    skope: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], said: str
) -> None:
    monkeypatch.chdir(tmp_path)
    assert skope("eval", "site", *words, "-q") == (2, "", f"skope: {said}\n")
    assert list(tmp_path.iterdir()) == []


def test_marks_of_images_of_another_size_are_refused(skope: Any, image: Path) -> None:
    site = image.parent / "site.toml"
    points = [{"pixel": [1.0, 2.0], "place": [3.0, 4.0]}]
    save_site(site, {"calibration": {"size": [800, 600], "points": points}}, None)
    code, out, error = skope("eval", "site", image, "--site", site, "-q")
    assert (code, out) == (2, "")
    assert "calibration.size: marks are in 800x600, but the images are 640x360" in error


def test_a_camera_of_another_image_size_is_scaled_or_rejected(skope: Any, image: Path) -> None:
    site = image.parent / "site.toml"
    camera = {"fov_deg": 60.0, "position": [0.0, 0.0, 6.0], "yaw_deg": 90.0, "pitch_deg": 20.0}
    save_site(site, {"camera": {"size": [1280, 1000], **camera}}, None)
    code, out, error = skope("eval", "site", image, "--site", site, "-q")
    assert (code, out) == (2, "")
    assert "site.toml: camera: image size: expected the aspect ratio of the footage, 640x360, got 1280x1000" in error
    site.unlink()
    save_site(site, {"camera": {"size": [1280, 720], **camera}}, None)
    process, line = begun("eval", "site", str(image), "--site", str(site))
    assert line == f"{site}: camera: camera of 1280x720, scaled to the 640x360 of road.png\n"
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=HANG_S)


def test_ctrl_c_ends_it_and_nothing_is_written(image: Path) -> None:
    site = image.parent / "new.toml"
    process, line = begun("eval", "site", str(image), "--site", str(site))
    address = line.split(" ")[2]
    assert address.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(address + "begin.json", timeout=HANG_S) as answer:
        assert json.load(answer)["size"] == [640, 360]
    process.send_signal(signal.SIGINT)
    out, error = process.communicate(timeout=HANG_S)
    assert (process.returncode, out, error) == (0, "", "")
    assert not site.exists()
