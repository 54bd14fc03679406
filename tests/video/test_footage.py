"""Video files as recorders, phones and editors leave them; times and pixels against what was written."""

import re
from collections.abc import Callable, Iterator
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from skope.errors import UserError
from skope.types import Pixels
from skope.video.container import open_clip
from skope.video.decode import same_shape
from skope.video.footage import FOOTAGE_LIMITS, FrameRange, open_footage
from skope.video.write import write_video

Skope = Callable[..., tuple[int, str, str]]
SIZE = (96, 64)
H264 = {"preset": "ultrafast", "crf": "10", "g": "10"}


def flat(k: int, size: tuple[int, int] = SIZE) -> Pixels:
    """An image of brightness 8 k, with a darker upper left quarter."""
    pixels = np.full((size[1], size[0], 3), 8 * k, dtype=np.uint8)
    pixels[: size[1] // 2, : size[0] // 2] //= 2
    return pixels


def noise(count: int, size: tuple[int, int]) -> list[Pixels]:
    """Images of smooth noise, no two alike."""
    rng = np.random.default_rng(0)
    small = [rng.integers(0, 255, (8, 12, 3), dtype=np.uint8) for _ in range(count)]
    return [np.asarray(cv2.resize(one, size), dtype=np.uint8) for one in small]


def written(
    path: Path,
    images: list[Pixels],
    *,
    times: list[int] | None = None,
    codec: str = "libx264",
    options: dict[str, str] = H264,
    rate: int = 10,
    container: str | None = None,
) -> Path:
    """A video of images which are shown at `times`, in thousandths of a second."""
    with av.open(f"file:{path}", "w", format=container) as file:
        stream: Any = file.add_stream(codec, rate=rate, options=options)
        stream.width, stream.height = images[0].shape[1], images[0].shape[0]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if times is not None:
            stream.codec_context.time_base = Fraction(1, 1000)
        for k, pixels in enumerate(images):
            frame = av.VideoFrame.from_ndarray(pixels, format="rgb24")
            if times is not None:
                frame.pts, frame.time_base = times[k], Fraction(1, 1000)
            file.mux(stream.encode(frame))
        file.mux(stream.encode())
    return path


def trimmed(source: Path, out: Path, first: int) -> Path:
    """The video from frame `first` on, cut without encoding: an edit list hides the packets since the key frame."""
    with av.open(str(source)) as file, av.open(str(out), "w", options={"avoid_negative_ts": "disabled"}) as cut:
        stream = file.streams.video[0]
        into = cut.add_stream_from_template(stream)
        packets: list[Any] = [packet for packet in file.demux(stream) if packet.size]
        begin = packets[first].pts
        key = max(k for k in range(first + 1) if packets[k].is_keyframe)
        assert key < first
        for packet in packets[key:]:
            packet.pts, packet.dts, packet.stream = packet.pts - begin, packet.dts - begin, into
            cut.mux(packet)
    return out


def seen(source: Path, **cut: Any) -> list[tuple[int, float, int]]:
    """Index, time and brightness / 8 of each frame."""
    out = []
    for image, pixels in open_footage(str(source), FrameRange(**cut)).frames():
        assert image.frame_index is not None
        assert image.time_s is not None
        out.append((image.frame_index, round(image.time_s, 3), round(float(pixels[-8:, -8:].mean()) / 8)))
    return out


def by_opencv(source: Path) -> Iterator[Pixels]:
    """(H, W, 3) RGB of each frame as OpenCV reads it."""
    capture = cv2.VideoCapture(str(source))
    while True:
        good, pixels = capture.read()
        if not good:
            break
        yield np.asarray(pixels[..., ::-1], dtype=np.uint8)


# ---------------------------------------------------------------------------------------------------------------- times


@pytest.mark.parametrize("first", [3, 13, 27])
def test_packets_that_an_edit_list_hides_are_no_frames(first: int, tmp_path: Path) -> None:
    times = [100 * k + 23 * (k % 4) for k in range(31)]
    whole = written(tmp_path / "whole.mp4", [flat(k) for k in range(31)], times=times, options={**H264, "bf": "0"})
    cut = trimmed(whole, tmp_path / "cut.mp4", first)
    expected = [(k - first, (times[k] - times[first]) / 1000, k) for k in range(first, 31)]
    assert seen(cut) == expected
    footage = open_footage(str(cut))
    assert len(footage) == 31 - first
    list(footage.frames())
    assert footage.skipped == []


@pytest.mark.parametrize("suffix", [".mkv", ".mp4", ".webm"])
def test_frames_of_varying_length_keep_their_times(suffix: str, tmp_path: Path) -> None:
    codec = "libvpx" if suffix == ".webm" else "libx264"
    times = [33 * k if k < 10 else 330 + 100 * (k - 10) for k in range(24)]
    path = written(
        tmp_path / f"v{suffix}",
        [flat(k) for k in range(24)],
        times=times,
        codec=codec,
        options={"crf": "10", "b": "9M"},
    )
    assert seen(path) == [(k, times[k] / 1000, k) for k in range(24)]
    footage = open_footage(str(path))
    list(footage.frames())
    assert (footage.skipped, footage.notes) == ([], [])


@pytest.mark.parametrize(("suffix", "codec"), [("h264", "libx264"), ("hevc", "libx265"), ("mjpeg", "mjpeg")])
def test_a_raw_stream_states_the_assumed_rate_and_takes_another(
    suffix: str, codec: str, skope: Skope, random_run: Path, tmp_path: Path
) -> None:
    options = {"x265-params": "log-level=none"} if codec == "libx265" else {}
    images = [flat(k) for k in range(12)]
    path = written(tmp_path / f"raw.{suffix}", images, codec=codec, options=options, container=suffix)
    footage = open_footage(str(path))
    assert re.search(rf"raw\.{suffix} has no time stamps; \d+ frames per second are assumed", footage.notes[0])
    given = open_footage(str(path), fps=4.0)
    assert given.notes == []
    frames = list(given.frames())
    assert [image.time_s for image, _ in frames] == [k / 4 for k in range(12)]
    assert given.fps == pytest.approx(4.0)
    call = ("eval", "predict", path, "--checkpoint", random_run, "--min-size", 64, "--every-frame", "--out", "seen")
    assert "are assumed (--fps sets another rate)" in skope(*call)[2]
    code, _, error = skope(*call, "--fps", 4)
    assert (code, "holds the output of another run" in error) == (2, True)


@pytest.mark.parametrize("rate", [600, 1000])
def test_a_container_that_states_its_clock_as_frame_rate_is_reported(rate: int, tmp_path: Path) -> None:
    path = written(tmp_path / "v.avi", [flat(k) for k in range(8)], codec="mpeg4", options={}, rate=rate)
    assert f"has {rate} frames per second by its time stamps" in open_footage(str(path)).notes[0]
    given = open_footage(str(path), fps=10)
    assert given.notes == []
    assert [image.time_s for image, _ in given.frames()] == pytest.approx([k / 10 for k in range(8)])


def test_a_gap_in_a_recording_is_reported(tmp_path: Path) -> None:
    times = [100 * k + (5000 if k >= 6 else 0) for k in range(12)]
    footage = open_footage(str(written(tmp_path / "v.mkv", [flat(k) for k in range(12)], times=times)))
    assert footage.notes == [f"{tmp_path}/v.mkv has no frames from 0.5 to 5.6 s"]


@pytest.mark.parametrize(("fps", "source"), [(0, "v.avi"), (2000, "v.avi"), (10, "a.png")])
def test_a_rate_that_cannot_be_is_rejected(fps: float, source: str, tmp_path: Path) -> None:
    write_video(tmp_path / "v.avi", [flat(1), flat(2)], 10)
    cv2.imwrite(str(tmp_path / "a.png"), flat(1))
    with pytest.raises(UserError, match=r"^--fps: "):
        open_footage(str(tmp_path / source), fps=fps)


# --------------------------------------------------------------------------------------------------------------- pixels


@pytest.mark.parametrize(
    ("suffix", "codec", "options"),
    [
        (".mp4", "libx264", H264),
        (".mp4", "libx265", {"x265-params": "log-level=none"}),
        (".ts", "libx264", H264),
        (".mkv", "ffv1", {}),
        (".avi", "mjpeg", {}),
        (".avi", "libx264", {**H264, "bf": "2", "preset": "medium"}),
        (".webm", "libvpx-vp9", {"deadline": "realtime"}),
    ],
)
def test_pixels_are_those_of_opencv(suffix: str, codec: str, options: dict[str, str], tmp_path: Path) -> None:
    images = noise(12, SIZE)
    path = written(tmp_path / f"v{suffix}", images, codec=codec, options=options)
    ours = [pixels for _, pixels in open_footage(str(path)).frames()]
    theirs = list(by_opencv(path))
    assert len(ours) == len(theirs) == 12
    for one, other in zip(ours, theirs, strict=True):
        assert np.array_equal(one, other)


def test_interlaced_frames_are_made_progressive_also_after_a_jump(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two moments in the lines of one frame: none of both is seen in the other's lines any more."""
    images = []
    for k in range(14):
        pixels = np.zeros((64, 96, 3), np.uint8)
        for line in (0, 1):  # the lower field is half a frame later
            pixels[line::2, 4 + 5 * k + 3 * line : 20 + 5 * k + 3 * line] = 240
        images.append(pixels)
    options = {**H264, "flags": "+ilme+ildct", "x264opts": "tff=1", "crf": "4"}
    path = written(tmp_path / "v.mp4", images, options=options)
    with av.open(str(path)) as file:
        assert all(frame.interlaced_frame for frame in file.decode(video=0))
    whole = list(open_footage(str(path)).frames())
    assert [image.frame_index for image, _ in whole] == list(range(14))

    def combed(pixels: Pixels) -> float:
        """How much lines differ from both of their neighbours."""
        grey = pixels[..., 1].astype(float)
        return float(np.abs(grey[1:-1] - (grey[:-2] + grey[2:]) / 2).mean())

    for (_, pixels), interlaced in zip(whole, images, strict=True):
        assert pixels.max() > 100
        assert combed(pixels) < 0.5 * combed(interlaced)
    monkeypatch.setattr("skope.video.footage.FOOTAGE_LIMITS", replace(FOOTAGE_LIMITS, seek_frames=3))
    for first in (3, 9, 11, 13):
        image, pixels = next(open_footage(str(path)).frames(first))
        assert image.frame_index == first
        assert np.array_equal(pixels, whole[first][1])


def test_the_larger_of_two_video_streams_is_read_and_reported(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "two.mkv"), "w") as file:
        streams = []
        for size in ((48, 32), SIZE):
            stream: Any = file.add_stream("libx264", rate=10, options=H264)
            stream.width, stream.height = size
            stream.pix_fmt, stream.disposition = "yuv420p", 0
            streams.append((stream, size))
        for k in range(5):
            for stream, size in streams:
                frame = av.VideoFrame.from_ndarray(flat(k + (10 if size == SIZE else 0), size), format="rgb24")
                file.mux(stream.encode(frame))
        for stream, _ in streams:
            file.mux(stream.encode())
    footage = open_footage(str(tmp_path / "two.mkv"))
    assert footage.frame_size() == SIZE
    assert [brightness for _, _, brightness in seen(tmp_path / "two.mkv")] == [10, 11, 12, 13, 14]
    assert footage.notes == [f"{tmp_path}/two.mkv has 2 video streams (96x64, 48x32); the first of these is read"]


@pytest.mark.parametrize("name", ["12:30:00.mp4", "cam%d:1.mp4", "http:.mp4", "ä ö:1.mp4"])
def test_names_with_colons_are_files(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_video(tmp_path / "v.mp4", [flat(k) for k in range(3)], 10)
    Path("v.mp4").rename(name)
    assert [index for index, _, _ in seen(Path(name))] == [0, 1, 2]


def test_sizes_that_change_are_scaled_or_left_out(tmp_path: Path) -> None:
    parts = {"a": SIZE, "half": (48, 32), "other": (64, 64)}
    for k, (name, size) in enumerate(parts.items()):
        written(tmp_path / f"{name}.ts", [flat(k + 1, size)] * 10, times=[1000 * k + 100 * i for i in range(10)])
    both = tmp_path / "both.ts"
    both.write_bytes(b"".join((tmp_path / f"{name}.ts").read_bytes() for name in parts))
    footage = open_footage(str(both))
    sizes = [(image.width, image.height) for image, _ in footage.frames()]
    # Where one stream ends and another follows, the last frames of the first one may have lost a part.
    assert sizes == [SIZE] * (20 - 2 * 2)
    assert footage.skipped == [
        f"{both}: frames 8 to 9 of 30 cannot be decoded",
        f"{both}: frames 18 to 19 of 30 cannot be decoded",
        f"{both}: frames of 64x64 are left out; the first is 96x64",
    ]


def test_shapes() -> None:
    assert same_shape((1920, 1080), (640, 360))
    assert same_shape((1366, 768), (683, 384))
    assert not same_shape((640, 480), (640, 360))


# --------------------------------------------------------------------------------------------------------------- damage


@pytest.mark.parametrize("damage", ["noise", "zeros"])
def test_what_was_damaged_is_left_out_and_the_rest_is_exact(skope: Skope, damage: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    images = noise(40, (160, 96))
    path = written(tmp_path / "v.mp4", images, options={**H264, "bf": "0"})
    whole = {image.frame_index: pixels for image, pixels in open_footage(str(path)).frames()}
    with av.open(str(path)) as file:
        hit = [packet for packet in file.demux(video=0) if packet.size][14]
        at, size = hit.pos, hit.size
    data = bytearray(path.read_bytes())
    assert at is not None
    part = slice(at + 8, at + size)
    data[part] = bytes(size - 8) if damage == "zeros" else rng.integers(0, 256, size - 8, dtype=np.uint8).tobytes()
    path.write_bytes(data)
    footage = open_footage(str(path))
    left = {image.frame_index: pixels for image, pixels in footage.frames()}
    assert len(left) >= 30  # up to the next key frame at most
    assert {*range(14), *range(20, 40)} <= left.keys()
    assert 14 not in left
    for index, pixels in left.items():
        assert np.array_equal(pixels, whole[index]), index
    assert re.fullmatch(rf"{path}: frames? 14( to 1\d)? of 40 cannot be decoded", "; ".join(footage.skipped))


def test_damage_ends_with_code_0_or_1_as_asked(skope: Skope, random_run: Path, tmp_path: Path) -> None:
    path = written(tmp_path / "v.avi", [flat(k) for k in range(12)], codec="mjpeg", options={})
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])
    call = ("eval", "predict", path, "--checkpoint", random_run, "--min-size", 64)
    for more, expected in (((), 0), (("--strict",), 1)):
        code, _, error = skope(*call, *more, "--out", f"seen{expected}")
        assert code == expected
        assert re.search(r"skope: skipped: .*v\.avi: ends after \d+ of 12 frames that it lists", error)


@pytest.mark.parametrize("content", [b"", b"no video", b"\0\0\0\x18ftypmp42\0\0\0\0mp42isom"])
def test_what_is_no_video_gets_one_line(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(content)
    with pytest.raises(UserError, match=r"v\.mp4: neither an image nor a video that can be opened \("):
        open_clip(str(tmp_path / "v.mp4"))
