"""A station that reads a stream: killed, started again and stopped, it has each frame at most once, in order."""

import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("sqlalchemy")

from skope.dataset import coco
from skope.dataset.folder import FRAMES_FILE, START_TIME_KEY
from skope.detector.network_settings import Settings
from skope.eval.cli.tracked_footage import track_folder
from skope.schema import Image
from skope.station.station_file import read_station
from skope.station.watch_stream import StreamWatch
from skope.terminal.console import Console
from skope.traffic.observation import read_observation
from skope.types import Pixels
from skope.video.container import VideoInfo
from skope.video.footage import FrameRange, LiveStream
from skope.video.stream_windows import StreamWindows
from skope.video.write import write_video
from tests.video.test_live import Web
from tests.waiting import HANG_S, until

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_road"
STATION = """window_minutes = 0.1

[[cameras]]
name = "north"
site = "traffic.toml"
stream = "{address}"
detector = "road33-lite"
"""


def state() -> dict[str, Any]:
    try:
        return dict(json.loads(Path("station/north/state.json").read_bytes()))
    except FileNotFoundError:
        return {"frames": 0, "process": 0}


def frame_times() -> list[datetime]:
    """Times of all frames in the recordings and in the windows that are not tracked yet."""
    found: list[datetime] = []
    for folder in Path("station/north/tracks").glob("*"):
        observation = read_observation(folder)
        assert observation.start_time is not None
        found += [observation.start_time + timedelta(seconds=float(time_s)) for time_s in observation.times_s]
    for folder in Path("station/north/seen").glob("*"):
        file = coco.read(folder / FRAMES_FILE)
        begin = datetime.fromisoformat(file.info[START_TIME_KEY])
        found += [begin + timedelta(seconds=image.time_s or 0.0) for image in file.images]
    return sorted(found)


def test_a_killed_camera_process_loses_what_it_was_working_on_only(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("camera.yml", "traffic.toml"):
        shutil.copy(EXAMPLE / name, name)
    # Pictures with the aspect ratio of the site's camera, 5 per second, for each of several connections.
    camera = Web([[(0.2, (192, 108))] * 3000] * 12)
    Path("station.toml").write_text(STATION.format(address=camera.address))
    command = [sys.executable, "-m", "skope", "eval", "station", "station.toml", "--min-size", "128"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as run:
        try:
            first = until(lambda: state()["frames"] > 15 and state())
            os.kill(first["process"], signal.SIGKILL)
            until(lambda: state()["process"] != first["process"] and state()["frames"] > 15)
        finally:
            run.send_signal(signal.SIGTERM)
            said, _ = run.communicate(timeout=HANG_S)
    assert run.returncode == 0, said
    assert "its process ended with code -9; starting again" in said
    times = frame_times()
    steps = np.array([(b - a).total_seconds() for a, b in itertools.pairwise(times)])
    assert len(times) > 30
    assert steps.min() > 0.05, "a frame is there twice"
    # Long gaps are the restart, and the first image of each process. Windows follow each other without a gap.
    assert np.sum(steps > 1.0) <= 3
    assert not list(Path("station/north").glob("failed/*")), said


def test_a_second_station_on_the_same_folder_is_refused(tmp_path: Path, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("camera.yml", "traffic.toml"):
        shutil.copy(EXAMPLE / name, name)
    Path("station.toml").write_text(STATION.format(address="http://127.0.0.1:9/none.mjpg"))
    command = [sys.executable, "-m", "skope", "eval", "station", "station.toml"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        try:
            until(lambda: Path("station/.lock").exists())
            time.sleep(0.5)
            second = subprocess.run(command, capture_output=True, text=True, timeout=HANG_S, check=False)
        finally:
            run.send_signal(signal.SIGTERM)
            run.wait(HANG_S)
    assert second.returncode == 2
    assert "another process runs this station" in second.stderr


ARCHIVE = """[[cameras]]
name = "bridge"
site = "traffic.toml"
videos = "videos"
"""


def write_archive(folder: Path) -> None:
    """A station with an archive of three clips of the empty road, and a file that is no video."""
    for name in ("camera.yml", "traffic.toml"):
        shutil.copy(EXAMPLE / name, folder / name)
    (folder / "station.toml").write_text(ARCHIVE)
    road = cv2.resize(cv2.imread(str(EXAMPLE / "empty.jpg")), (320, 180))[..., ::-1]
    for minute in range(3):
        frames = (np.roll(road, k, axis=1) for k in range(10))
        (folder / "videos").mkdir(exist_ok=True)
        write_video(folder / "videos" / f"2026-11-26_10-0{minute}-00.mp4", frames, 5.0)
    (folder / "videos" / "2026-11-26_10-09-00.mp4").write_bytes(b"no video")


def ray_workers() -> list[str]:
    """Numbers of the processes that work on a video."""
    found = subprocess.run(["pgrep", "-f", "ray::_problem_of"], capture_output=True, text=True, check=False)
    return found.stdout.split()


def archive_files(folder: Path) -> dict[str, bytes]:
    tracks = folder / "station" / "bridge" / "tracks"
    return {
        path.relative_to(tracks).as_posix(): path.read_bytes()
        for name in ("tracks.csv", "footage.json")
        for path in sorted(tracks.glob(f"*/{name}"))
    }


def test_ray_makes_the_recordings_of_one_process_though_a_worker_is_lost(tmp_path: Path) -> None:
    pytest.importorskip("ray")
    made, said = {}, {}
    for engine in ("local", "ray"):
        folder = tmp_path / engine
        folder.mkdir()
        write_archive(folder)
        command = [sys.executable, "-m", "skope", "eval", "station", "station.toml", "--once", "--min-size", "128"]
        with subprocess.Popen(
            [*command, "--engine", engine], cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        ) as run:
            if engine == "ray":
                os.kill(int(until(ray_workers)[0]), signal.SIGKILL)
            said[engine], _ = run.communicate(timeout=HANG_S)
        assert run.returncode == 0, said[engine]
        made[engine] = archive_files(folder)
    assert len(made["local"]) == 6
    assert made["ray"] == made["local"]
    assert all("2026-11-26: 3 recordings" in text for text in said.values())
    assert all("2026-11-26_10-09-00.mp4: not recorded: " in text for text in said.values())
    again = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=True)
    assert "1 of 1" in again.stdout  # only the file that is no video is tried again


class Turning(LiveStream):
    """A stream of the empty road at 5 frames per second; the camera is turned from one time to another."""

    def __init__(self, count: int, from_s: float, to_s: float) -> None:
        super().__init__("north", FrameRange(), clip=VideoInfo(address="rtsp://camera", live=True))
        self._count, self._from_s, self._to_s = count, from_s, to_s

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        road = cv2.resize(cv2.imread(str(EXAMPLE / "empty.jpg")), (320, 180))[..., ::-1]
        rng = np.random.default_rng(5)
        self.start_time = datetime(2026, 11, 26, 10, tzinfo=UTC)
        for k in range(self._count):
            time_s = k / 5
            turned = np.roll(road, 40 if self._from_s <= time_s < self._to_s else 0, axis=1)
            pixels = np.clip(turned + rng.normal(0, 2, road.shape), 0, 255).astype(np.uint8)
            name = f"north/{k:06d}"
            yield Image(id=k + 1, file_name=name, width=320, height=180, frame_index=k, time_s=time_s), pixels


def test_a_camera_that_was_turned_at_the_seam_of_windows_is_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("camera.yml", "traffic.toml"):
        shutil.copy(EXAMPLE / name, name)
    Path("station.toml").write_text(STATION.format(address="rtsp://camera"))
    (camera,) = read_station(Path("station.toml")).cameras
    stream = Turning(150, 12.0, 18.0)
    clock = iter(datetime(2026, 11, 26, 10, 0, second, tzinfo=UTC) for second in (0, 6, 12, 18, 24))
    monkeypatch.setattr(StreamWindows.__init__, "__defaults__", (lambda: next(clock),))
    watch = StreamWatch(camera, 6.0, Settings(min_size=128, backend="openvino"), Console(quiet=True))
    seen = list(watch.windows(stream))
    assert len(seen) == 5
    for window in seen:
        list(track_folder(window, Path("tracks", window.name), Console(quiet=True)))
    observed = [read_observation(Path("tracks", window.name)).observed_s for window in seen]
    assert observed == [pytest.approx(6.0, abs=0.3) if k != 2 else 0.0 for k in range(5)]
