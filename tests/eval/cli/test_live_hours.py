"""A live camera hour by hour: each recording knows when it began, and one report is made of all."""

import csv
import json
import os
import shutil
import signal
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.camera.model import Camera
from skope.eval.pose.write_camera import write_camera
from skope.files.json_files import write_json
from tests.eval.inference import streams

Skope = Callable[..., tuple[int, str, str]]
SITE = """time_zone = "Europe/Berlin"
[[gates]]
name = "g"
line = [[-20, 30], [20, 30]]
[[image_gates]]
name = "g"
pixels = [[10, 60], [10, 5]]
"""


@pytest.fixture(autouse=True)
def files(skope: Skope) -> None:
    """A site and the camera of small frames."""
    camera = Camera.looking((0.0, 0.0, 8.0), yaw=0.0, pitch_down=0.3, size=(96, 64))
    list(write_camera(Path("camera.json"), camera, {}))
    Path("site.toml").write_text(SITE)


def predicted(skope: Skope, run: Path, out: str, *more: str, fps: float = 20) -> tuple[datetime, datetime]:
    """Look at a live stream until a second of it; from and to when that took."""
    with streams.mjpeg(31, fps) as address:
        begun = datetime.now(UTC)
        words = ("--checkpoint", run, "--camera", "camera.json", "--out", out, *more)
        code, _, err = skope("eval", "predict", address, *words)
    assert code == 0, err
    return begun, datetime.now(UTC)


def begins_of(path: str) -> datetime:
    return datetime.fromisoformat(json.loads(Path(path).read_text())["begins"])


def test_recordings_of_a_stream_know_when_they_began(skope: Skope, random_run: Path) -> None:
    first, last = predicted(skope, random_run, "seen/0", "--end", "3.5", fps=8)
    frames = json.loads(Path("seen/0/frames.json").read_text())
    begin = datetime.fromisoformat(frames["info"]["begins"])
    assert first - timedelta(milliseconds=1) <= begin <= last
    # The next hour, in the same loop.
    shutil.copytree("seen/0", "seen/1")
    frames["info"]["begins"] = (begin + timedelta(hours=1)).isoformat()
    write_json(Path("seen/1/frames.json"), frames)
    for k in range(2):
        code, _, err = skope("eval", "track", f"seen/{k}", "--out", f"tracks/{k}")
        assert code == 0, err
        assert begins_of(f"tracks/{k}/footage.json") == begin + timedelta(hours=k)
    assert skope("eval", "traffic", "tracks/0", "--site", "site.toml", "--out", "reports/0")[0] == 0
    code, _, err = skope("eval", "traffic", "tracks/0", "tracks/1", "--site", "site.toml", "--out", "reports/1")
    assert code == 0, err
    summary = json.loads(Path("reports/1/summary.json").read_text())
    assert [datetime.fromisoformat(one["begin"]) - begin for one in summary["recordings"]] == [
        timedelta(0),
        timedelta(hours=1),
    ]
    assert [one["guessed"] for one in summary["recordings"]] == [False, False]
    assert len(summary["observed_spans_s"]) == 2, "nothing was observed between the two"
    with Path("reports/1/counts.csv").open(newline="") as file:
        assert datetime.fromisoformat(next(csv.DictReader(file))["begin"]).tzinfo
    code, _, err = skope("eval", "traffic", "tracks/0", "tracks/1", "--site", "site.toml", "--out", "reports/0")
    assert (code, "other work" in err) == (2, True), "the report of all is another folder"

    # In the image alone it is known too.
    code, _, err = skope("eval", "traffic", "seen/0", "--site", "site.toml", "--out", "image")
    assert code == 0, err
    assert datetime.fromisoformat(json.loads(Path("image/summary.json").read_text())["start"]) == begin
    frames["info"]["begins"] = "noon"
    write_json(Path("seen/1/frames.json"), frames)
    code, _, err = skope("eval", "track", "seen/1", "--out", "other")
    assert (code, "info.begins: expected a time" in err) == (2, True)


@pytest.mark.slow
def test_a_service_that_is_stopped_writes_what_has_come(skope: Skope, random_run: Path) -> None:
    ignored: list[Any] = []
    before = signal.signal(signal.SIGTERM, lambda *_: ignored.append(1))

    def stop() -> None:
        end = time.monotonic() + 20
        progress = Path("seen/.predict.jsonl")
        while time.monotonic() < end and (not progress.is_file() or progress.stat().st_size < 10):
            time.sleep(0.02)
        os.kill(os.getpid(), signal.SIGTERM)

    thread = threading.Thread(target=stop)
    thread.start()
    try:
        predicted(skope, random_run, "seen", "--end", "8", fps=4)
    finally:
        thread.join()
        signal.signal(signal.SIGTERM, before)
    assert not ignored
    images = json.loads(Path("seen/frames.json").read_text())["images"]
    assert len(images) > 0
    assert np.max([image["time_s"] for image in images]) < 7
    assert not list(Path("seen").glob(".*"))
