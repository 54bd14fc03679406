"""Times and interruptions of live streams: arrival is the reference, whatever a camera's clock does."""

import socket
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest

from skope.errors import UserError
from skope.video import container, live
from skope.video.footage import FrameRange, open_footage
from skope.video.live import CameraClock
from tests.footage import streams

FPS = 10.0


def times_of(stamps: list[float | None], arrivals: list[float]) -> tuple[CameraClock, list[float]]:
    clock = CameraClock()
    return clock, [clock.time_of(stamp, arrived) for stamp, arrived in zip(stamps, arrivals, strict=True)]


def late(count: int, most_s: float = 0.08, seed: int = 0) -> list[float]:
    """Times of arrival of frames that a network delays by up to `most_s`; the first one by nothing."""
    delays = np.random.default_rng(seed).uniform(0, most_s, count)
    delays[0] = 0
    return np.maximum.accumulate(np.arange(count) / FPS + delays).tolist()


def taken(count: int, first: float = 5000.0) -> list[float | None]:
    return [first + k / FPS for k in range(count)]


def test_the_network_s_delays_are_not_in_the_times() -> None:
    clock, times = times_of(taken(300), late(300))
    # The smallest of 100 delays counts as none: it is 1% of the largest.
    assert times == pytest.approx([k / FPS for k in range(300)], abs=0.05 * 0.08)
    assert (clock.steps, clock.strays) == ([], 0)


def test_a_network_that_stalls_delivers_late_what_was_taken_in_time() -> None:
    arrivals = [max(k / FPS, 6.0) if 30 <= k < 60 else k / FPS for k in range(100)]  # three seconds at once
    assert times_of(taken(100), arrivals)[1] == pytest.approx([k / FPS for k in range(100)], abs=1e-6)


@pytest.mark.parametrize(
    "step_s", [-7200.0, -3.0, -0.7, 0.7, 3.0, 600.0, 20000.0, live.LIVE_LIMITS.stamp_round_s - 600]
)
def test_a_clock_that_is_set_does_not_move_the_times(step_s: float) -> None:
    stamps = [stamp + (step_s if k >= 100 else 0) for k, stamp in enumerate(taken(300)) if stamp is not None]
    arrivals = late(300)
    clock, times = times_of(list(stamps), arrivals)
    assert np.all(np.diff(times) > 0)
    assert np.max(np.abs(np.array(times) - arrivals)) < 1.0
    # Small steps look like a delay, and are taken back within the time that a slow clock is.
    if abs(step_s) > 1:
        known = -600.0 if step_s > live.LIVE_LIMITS.stamp_round_s / 2 else step_s  # it began a new round
        assert [round(by_s) for _, by_s in clock.steps] == [known]
        assert clock.steps[0][0] == pytest.approx(10.4, abs=0.3)
    assert np.max(np.abs(np.array(times) - np.arange(300) / FPS)) < 0.8


@pytest.mark.parametrize("off_s", [-80000.0, -5.0, 5.0, 80000.0])
def test_a_stray_time_stamp_costs_no_frame(off_s: float) -> None:
    stamps = [stamp + (off_s if k % 37 == 36 else 0) for k, stamp in enumerate(taken(300)) if stamp is not None]
    arrivals = late(300)
    clock, times = times_of(list(stamps), arrivals)
    assert np.all(np.diff(times) > 0)
    assert np.max(np.abs(np.array(times) - np.arange(300) / FPS)) < 0.1
    assert (clock.strays, clock.steps) == (8, [])


@pytest.mark.parametrize("rate", [0.995, 1.005])
def test_a_clock_that_is_slow_or_fast_is_followed(rate: float) -> None:
    stamps = [5000 + rate * k / FPS for k in range(3000)]
    times = times_of(list(stamps), late(3000))[1]
    assert np.max(np.abs(np.array(times) - np.arange(3000) / FPS)) < 0.25


def test_without_time_stamps_arrival_counts_and_times_rise() -> None:
    arrivals = [0.0, 0.1, 0.1, 0.1, 0.4]
    assert times_of([None] * 5, arrivals)[1] == pytest.approx([0.0, 0.1, 0.101, 0.102, 0.4])


# ------------------------------------------------------------------------------------------------------------- networks


class Web:
    """A web camera (MJPEG) that sends what it is told, to one viewer after the other."""

    def __init__(self, scripts: list[list[tuple[float, tuple[int, int]]]]) -> None:
        """`scripts` is a list for each viewer: seconds to wait, and size of the image that is sent then."""
        self._scripts = iter(scripts)
        self._server = socket.create_server(("127.0.0.1", 0))
        self.address = f"http://127.0.0.1:{self._server.getsockname()[1]}/camera.mjpg"
        self.sent = 0
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        for script in self._scripts:
            client, _ = self._server.accept()
            threading.Thread(target=self._send, args=(client, script), daemon=True).start()
        self._server.close()

    def _send(self, client: socket.socket, script: list[tuple[float, tuple[int, int]]]) -> None:
        try:
            with client:
                client.recv(4096)
                client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
                for wait_s, (width, height) in script:
                    time.sleep(wait_s)
                    jpeg = cv2.imencode(".jpg", np.full((height, width, 3), 99, np.uint8))[1].tobytes()
                    head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
                    client.sendall(head + jpeg + b"\r\n")
                    self.sent += 1
        except OSError:
            pass


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Waits of a second in place of ten."""
    monkeypatch.setattr(live, "LIVE_LIMITS", replace(live.LIVE_LIMITS, return_s=1.0))
    monkeypatch.setattr(container, "CONTAINER_LIMITS", replace(container.CONTAINER_LIMITS, silence_s=0.6))


WIDE, HALF, OTHER = (96, 64), (48, 32), (64, 64)
LOOK = [(0.0, WIDE)] * 30
"""Sent to the viewer that looks what there is."""


@pytest.mark.usefixtures("quick")
def test_a_camera_of_another_size_is_scaled_and_one_of_another_shape_ends_the_recording() -> None:
    script = [(0.03, WIDE)] * 25
    web = Web([LOOK, script, [(0.03, HALF)] * 25, [(0.03, OTHER)] * 25])
    footage = open_footage(web.address)
    sizes = {pixels.shape[:2] for _, pixels in footage.frames()}
    assert sizes == {(64, 96)}
    notes = "\n".join(footage.notes)
    assert "frames are 48x32 from " in notes
    assert "96x64 before; they are scaled" in notes
    assert "broke off at " in notes
    assert "frames are 64x64 from " in footage.broken_off
    assert "the recording ends there" in footage.broken_off


@pytest.mark.usefixtures("quick")
def test_a_camera_that_falls_silent_is_noticed_and_what_arrived_is_counted() -> None:
    silent = [*([(0.03, WIDE)] * 40), (30.0, WIDE)]
    web = Web([LOOK, silent, *[[(30.0, WIDE)]] * 8])
    footage = open_footage(web.address)
    begun = time.monotonic()
    images = [image for image, _ in footage.frames()]
    assert time.monotonic() - begun < 9
    assert images
    assert "did not come back" in footage.broken_off
    line = footage.notes[-1].removeprefix("stream: ")
    words = line.replace(",", "").split()
    received, analysed, passed = int(words[0]), int(words[3]), int(words[5])
    assert received == analysed + passed
    assert analysed == len(images)
    assert 39 <= received <= 40


def test_an_address_that_answers_nothing_gets_one_line() -> None:
    with pytest.raises(
        UserError, match=r"^rtsp://127\.0\.0\.1:9/x: neither an image nor a video .*\(Connection refused"
    ):
        open_footage("rtsp://127.0.0.1:9/x")


@pytest.mark.usefixtures("quick")
def test_no_message_holds_the_password() -> None:
    with pytest.raises(UserError, match=r"^rtsp://127\.0\.0\.1:9/x: neither") as error:
        open_footage("rtsp://who:se@cret@127.0.0.1:9/x")
    assert "cret" not in str(error.value)
    web = Web([LOOK, [(0.03, WIDE)] * 10])
    footage = open_footage(web.address.replace("://", "://who:secret@"))
    list(footage.frames())
    assert footage.broken_off.startswith("stream: broke off after ")
    assert "secret" not in "\n".join([*footage.notes, *footage.skipped])


def test_a_live_stream_has_no_rate_to_give() -> None:
    with streams.mjpeg(100, 50) as address, pytest.raises(UserError, match=r"--fps: .* is on a server"):
        open_footage(address, FrameRange(), fps=10)
