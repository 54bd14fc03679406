"""A live camera hour by hour: each recording knows when it began, and one report is made of all."""

import csv
import json
import os
import shutil
import signal
import threading
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from skope.camera.fit.write_camera import write_camera
from skope.camera.model import Camera
from skope.files.json_files import write_json
from tests.footage import streams
from tests.waiting import until

Skope = Callable[..., tuple[int, str, str]]
SITE = """time_zone = "Europe/Berlin"
[[gates]]
name = "g"
line = [[-20, 30], [20, 30]]
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


def start_time_of(path: str) -> datetime:
    return datetime.fromisoformat(json.loads(Path(path).read_text())["start_time"])


def test_a_stream_knows_when_it_began(skope: Skope, random_run: Path) -> None:
    first, last = predicted(skope, random_run, "seen", "--end", "0.4")
    frames = json.loads(Path("seen/frames.json").read_text())
    begin = datetime.fromisoformat(frames["info"]["start_time"])
    assert first - timedelta(milliseconds=1) <= begin <= last
    code, _, err = skope("eval", "traffic", "seen", "--site", "site.toml", "--out", "image")
    assert code == 0, err
    assert datetime.fromisoformat(json.loads(Path("image/summary.json").read_text())["start"]) == begin
    frames["info"]["start_time"] = "noon"
    write_json(Path("seen/frames.json"), frames)
    code, _, err = skope("eval", "track", "seen", "--out", "other")
    assert (code, "info.start_time: expected a time" in err) == (2, True)


@pytest.mark.slow
def test_hours_of_a_stream_make_one_report(skope: Skope, random_run: Path) -> None:
    predicted(skope, random_run, "seen/0", "--end", "3.6", fps=8)
    frames = json.loads(Path("seen/0/frames.json").read_text())
    begin = datetime.fromisoformat(frames["info"]["start_time"])
    # The next hour, in the same loop.
    shutil.copytree("seen/0", "seen/1")
    frames["info"]["start_time"] = (begin + timedelta(hours=1)).isoformat()
    write_json(Path("seen/1/frames.json"), frames)
    for k in range(2):
        code, _, err = skope("eval", "track", f"seen/{k}", "--out", f"tracking/{k}")
        assert code == 0, err
        # Finished hours lie apart, as the loop in docs/hours-and-days.md has it.
        shutil.move(f"tracking/{k}", f"tracks/{k}")
        assert start_time_of(f"tracks/{k}/footage.json") == begin + timedelta(hours=k)
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
    with Path("reports/1/counts.csv").open(encoding="utf-8-sig", newline="") as file:
        assert datetime.fromisoformat(next(csv.DictReader(file))["begin"]).tzinfo
    code, _, err = skope("eval", "traffic", "tracks/0", "tracks/1", "--site", "site.toml", "--out", "reports/0")
    assert (code, "another run" in err) == (2, True), "the report of all is another folder"


@pytest.mark.slow
def test_what_a_killed_run_has_is_written_by_the_same_command(
    skope: Skope, random_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun = datetime.now(UTC)
    with monkeypatch.context() as patch:
        patch.setattr("skope.footage.predict_footage._kept", _killed)
        with pytest.raises(SystemError):
            predicted(skope, random_run, "seen", "--end", "3.6", fps=8)
    rows = Path("seen/.predict.jsonl").read_text().splitlines()
    assert rows
    assert not Path("seen/frames.json").exists()
    ended = datetime.now(UTC)
    predicted(skope, random_run, "seen", "--end", "3.6")
    frames = json.loads(Path("seen/frames.json").read_text())
    assert len(frames["images"]) == len(rows), "nothing of the stream that plays now"
    assert begun <= datetime.fromisoformat(frames["info"]["start_time"]) <= ended
    assert not any("start_time" in image for image in frames["images"])
    with streams.mjpeg(31, 20) as address:
        words = ("--checkpoint", random_run, "--camera", "camera.json", "--out", "seen", "--end", "3.6")
        code, _, err = skope("eval", "predict", address, *words)
    assert (code, "another run" in err) == (2, True), "what is finished is another recording"


def _killed(*_: object) -> None:
    raise SystemError("killed")


@pytest.mark.slow
def test_a_service_that_is_stopped_writes_what_has_come(skope: Skope, random_run: Path) -> None:
    ignored: list[Any] = []
    before = signal.signal(signal.SIGTERM, lambda *_: ignored.append(1))

    def stop() -> None:
        progress = Path("seen/.predict.jsonl")
        until(lambda: progress.is_file() and progress.stat().st_size >= 10)
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
