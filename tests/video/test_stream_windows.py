"""Windows of a stream: they have each of its frames once, and end by the clock."""

from collections.abc import Iterator
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from skope.schema import Image
from skope.types import Pixels
from skope.video.container import VideoInfo
from skope.video.footage import FrameRange, LiveStream
from skope.video.stream_windows import StreamWindows

BEGIN = datetime(2026, 11, 26, 10, 0, 0, tzinfo=UTC)


class Played(LiveStream):
    """A stream of frames at given times, whose first frame arrives at `BEGIN`."""

    def __init__(self, times_s: list[float]) -> None:
        clip = VideoInfo(address="rtsp://camera/stream", live=True)
        super().__init__("camera", FrameRange(), clip=clip)
        self.times_s, self.played = times_s, 0

    def frames(self, first: int = 0) -> Iterator[tuple[Image, Pixels]]:
        for number, time_s in enumerate(self.times_s, 1):
            self.start_time = self.start_time or BEGIN  # time of second 0
            self.played = number
            pixels = np.full((4, 6, 3), number % 256, np.uint8)
            name = f"camera/{number}"
            yield Image(id=number, file_name=name, width=6, height=4, frame_index=number, time_s=time_s), pixels


class Clock:
    """The computer's clock while a stream is played: it is exact, but for steps at given times of the stream."""

    def __init__(self, stream: Played, steps: dict[float, float] | None = None) -> None:
        self._stream, self._steps = stream, steps or {}

    def __call__(self) -> datetime:
        now_s = self._stream.times_s[max(0, self._stream.played - 1)]
        step_s = sum(step_s for at_s, step_s in self._steps.items() if at_s <= now_s)
        return BEGIN + timedelta(seconds=now_s + step_s)


def test_windows_have_each_frame_once_and_end_by_the_clock() -> None:
    times_s = [7.0 + k / 10 for k in range(2000)]
    stream = Played(times_s)
    found, begins = [], []
    for window in StreamWindows(stream, 60.0, Clock(stream)):
        frames = list(window.frames())
        assert window.start_time is not None
        assert [image.id for image, _ in frames] == list(range(1, len(frames) + 1))
        assert frames[0][0].time_s == 0
        begins.append(window.start_time)
        found += [(image.frame_index, window.start_time + timedelta(seconds=image.time_s or 0)) for image, _ in frames]
    assert [index for index, _ in found] == list(range(1, 2001))
    wanted = [BEGIN + timedelta(seconds=time_s) for time_s in times_s]
    assert max(abs((time - known).total_seconds()) for (_, time), known in zip(found, wanted, strict=True)) < 1e-3
    assert [round(begin.timestamp() % 60, 3) for begin in begins[1:]] == [0.0] * (len(begins) - 1)
    assert len(begins) == 4


@pytest.mark.parametrize("step_s", [3600.0, -3600.0])
def test_a_window_after_a_step_of_the_clock_has_the_new_time(step_s: float) -> None:
    stream = Played([k / 10 for k in range(2000)])
    windows = [
        (window.start_time, [image.frame_index for image, _ in window.frames()])
        for window in StreamWindows(stream, 60.0, Clock(stream, {70.0: step_s}))
    ]
    assert [index for _, frames in windows for index in frames] == list(range(1, 2001))
    seconds = [round((begin - BEGIN).total_seconds(), 3) for begin, _ in windows if begin]
    assert seconds == [0.0, 60.0, 120.0 + step_s, 180.0 + step_s]


def test_a_first_window_of_a_moment_is_part_of_the_second() -> None:
    stream = Played([57.0 + k / 10 for k in range(1300)])
    lengths = [len(list(window.frames())) for window in StreamWindows(stream, 60.0, Clock(stream))]
    assert lengths == [630, 600, 70]


def test_what_is_not_read_of_a_window_is_passed_over() -> None:
    stream = Played([float(k) for k in range(180)])
    firsts = [next(window.frames())[0].frame_index for window in StreamWindows(stream, 60.0, Clock(stream))]
    assert firsts == [1, 61, 121]


def test_a_window_after_silence_begins_with_its_first_frame() -> None:
    stream = Played([0.0, 1.0, 2.0, 200.0, 201.0])
    windows = [
        ((window.start_time - BEGIN).total_seconds(), len(list(window.frames())))
        for window in StreamWindows(stream, 60.0, Clock(stream))
        if window.start_time
    ]
    assert windows == [(0.0, 3), (200.0, 2)]


def test_a_stream_without_frames_has_no_window() -> None:
    stream = Played([])
    assert list(StreamWindows(stream, 60.0)) == []
