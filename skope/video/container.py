"""A video file or stream as PyAV opens it: which stream is read, when its frames are shown, how its pixels lie."""

import itertools
import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from skope.errors import UserError
from skope.files.safe_names import for_ffmpeg
from skope.video.decode import decode_frames, packets, shown_size

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.video.stream import VideoStream


@dataclass(frozen=True)
class ContainerLimits:
    """Defaults and limits of times in containers."""

    assumed_fps: float = 25.0
    """Frame rate of a video that states none."""
    usual_fps: float = 120.0
    """Frame rates above this are reported: containers often state the unit of their clock instead of a frame rate."""
    silence_s: float = 5.0
    """A server that sends nothing for this long counts as broken off, seconds."""
    square_within: float = 0.005
    """Deviation of a pixel's aspect ratio from 1 that is ignored."""
    same_s: float = 5e-4
    """Times that differ by less are the same, seconds: containers count in thousandths of a second, or finer."""
    gap_s: float = 1.0
    """A time without frames is reported from this length on, seconds."""
    gap_frames: float = 5.0
    """It is also longer than this many frames last."""
    most_gaps: int = 3
    """Number of gaps that are reported."""
    default_stream_pixels: int = 5_000_000
    """A stream that its container marks as the default one counts as this many pixels larger, as in FFmpeg."""


CONTAINER_LIMITS: Final = ContainerLimits()

_RTSP_OPTIONS: Final = {"rtsp_transport": "tcp", "fpsprobesize": "0", "fflags": "nobuffer"}
"""Options of FFmpeg for cameras: no lost packets, and no seconds spent on guessing the frame rate."""
CREDENTIALS_PATTERN: Final = re.compile(r"^(\w+://)[^/]*@")
_RAW_FORMATS: Final = frozenset(
    ("h264", "hevc", "vvc", "mjpeg", "mpegvideo", "m4v", "h263", "vc1", "obu", "dirac", "cavsvideo", "rawvideo")
)
"""FFmpeg's names of formats that are nothing but coded frames, without times."""
_LISTS_FRAMES: Final = ("avi", "mov,")
"""Beginnings of FFmpeg's names of containers which list all their frames; others state estimates."""


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """What a video file or stream says about itself. It is opened once for this."""

    address: str
    """Path of a file on this machine, or address on a server."""
    live: bool = False
    """Whether its frames come as they are recorded, and only once."""
    count: int = 0
    """Number of frames; of a file on a server as its container states it. 0: unknown."""
    lost: int = 0
    """Number of frames that a file on this machine lists, and that it ends without."""
    given_fps: float | None = None
    """Frame rate that the user gave in place of the time stamps, frames per second."""
    rate: float = CONTAINER_LIMITS.assumed_fps
    """Mean frame rate, frames per second."""
    times_s: tuple[float, ...] = ()
    """Time of each frame since the first one, seconds, of a file on this machine; empty for others."""
    stamps: tuple[int, ...] = ()
    """Time stamp of each frame, in the stream's unit; empty where frames have no reliable ones and are counted."""
    size: tuple[int, int] | None = None
    """Width and height of the first frame of a file on this machine, upright, pixels; None for others."""
    pixel_width: float = 1.0
    """Width of a stored pixel as it is to be shown, divided by its height."""
    notes: tuple[str, ...] = ()
    """Assumptions that a user must know of, a line each."""

    @property
    def square(self) -> bool:
        """Whether its pixels are as wide as high."""
        return abs(self.pixel_width - 1) < CONTAINER_LIMITS.square_within

    @property
    def on_server(self) -> bool:
        """Whether it is read from a server."""
        return "://" in self.address


@contextmanager
def opened(address: str) -> Iterator[tuple["InputContainer", "VideoStream"]]:
    """Open a video, and choose the stream that players show.

    Args:
        address: Path of a file, or an address on a server.

    Raises:
        UserError: It is no video, its server does not answer, or FFmpeg cannot decode it.
    """
    import av
    from av.error import FFmpegError

    server = "://" in address
    options = _RTSP_OPTIONS if address.startswith("rtsp") else {}
    # Named as a file: FFmpeg takes a name with a colon for an address.
    name = address if server else f"file:{for_ffmpeg(address)}"
    try:
        container = av.open(
            name, options=options, timeout=(CONTAINER_LIMITS.silence_s, CONTAINER_LIMITS.silence_s) if server else None
        )
    except (FFmpegError, ValueError) as error:
        raise UserError(
            f"{shown_address(address)}: neither an image nor a video that can be opened ({_reason(error)})"
        ) from None
    with container:
        streams = _video_streams(container)
        if not streams:
            raise UserError(
                f"{shown_address(address)}: neither an image nor a video that can be opened (no video stream)"
            )
        stream = streams[0]
        # Frame threads delay each frame of a live stream by several others.
        stream.thread_type = "SLICE" if server else "AUTO"
        yield container, stream


def shown_address(address: str) -> str:
    """An address for messages: without the user and password that it may hold. Paths of files stay as they are."""
    return CREDENTIALS_PATTERN.sub(r"\1", address) if "://" in address else address


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def _video_streams(container: "InputContainer") -> list["VideoStream"]:
    """The streams of pictures, without covers; first the one that FFmpeg and players show."""
    from av.stream import Disposition

    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]

    def size(stream: "VideoStream") -> int:
        default = CONTAINER_LIMITS.default_stream_pixels if stream.disposition & Disposition.default else 0
        return stream.width * stream.height + default

    return sorted(streams, key=size, reverse=True)  # equals stay in their order


def open_clip(address: str, fps: float | None = None) -> VideoInfo:
    """Open a video to see what it says about itself.

    Args:
        address: Path of a file, or address on a server.
        fps: The frame rate of a file whose own time stamps are missing or wrong; None: its time stamps count.

    Raises:
        UserError: It cannot be opened, or `fps` is given for what is on a server.
    """
    with opened(address) as (container, stream):
        several = [f"{s.width}x{s.height}" for s in _video_streams(container)]
        notes = []
        if len(several) > 1:
            notes.append(f"has {len(several)} video streams ({', '.join(several)}); the first of these is read")
        pixel_width = _pixel_width(stream)
        rate = _stated_rate(stream)
        if "://" in address:
            if fps is not None:
                raise UserError(f"--fps: {shown_address(address)} is on a server, whose frames have their own times")
            count = stream.frames or (round(container.duration / 1e6 * rate) if container.duration else 0)
            scheme = address.partition("://")[0]
            live = scheme not in ("http", "https") or not count
            return VideoInfo(
                address=address,
                live=live,
                count=0 if live else count,
                rate=rate,
                pixel_width=pixel_width,
                notes=tuple(notes),
            )
        seen = _look_through(container, stream)
    with opened(address) as (container, stream):
        size = next(map(shown_size, decode_frames(container, stream)), None)
    times, count = seen.times_s, len(seen.times_s) or seen.count
    if fps is not None:
        times = tuple(k / fps for k in range(count))
    elif not times:
        notes.append(f"has no time stamps; {seen.rate:g} frames per second are assumed (--fps sets another rate)")
        times = tuple(k / seen.rate for k in range(count))
    if len(times) > 1:
        rate = (len(times) - 1) / times[-1]
    if fps is None and seen.times_s and rate > CONTAINER_LIMITS.usual_fps:
        notes.append(
            f"has {rate:.4g} frames per second by its time stamps. If the camera recorded fewer, all speeds are wrong; "
            "--fps sets the rate"
        )
    notes += [f"has no frames from {begin:.1f} to {end:.1f} s" for begin, end in _gaps(times)]
    return VideoInfo(
        address=address,
        count=count,
        lost=seen.lost,
        given_fps=fps,
        rate=rate,
        times_s=times,
        stamps=seen.stamps,
        size=size,
        pixel_width=pixel_width,
        notes=tuple(notes),
    )


@dataclass(frozen=True)
class _Packets:
    """What the packets of a file say about its frames; none of them is decoded."""

    times_s: tuple[float, ...]
    """Times of the shown frames since the first one, seconds; empty where some are missing or two are alike."""
    stamps: tuple[int, ...]
    """As in `VideoInfo`."""
    count: int
    """Number of frames."""
    lost: int
    """As in `VideoInfo`."""
    rate: float
    """Frame rate to assume where there are no times, frames per second."""


def _look_through(container: "InputContainer", stream: "VideoStream") -> _Packets:
    """Read all packets of a file. Those that an edit list hides are not counted."""
    # Of each packet only this: a file may be larger than the memory.
    found = [(packet.pts, packet.is_discard) for packet in packets(container, stream) if packet.size]
    shown = [stamp for stamp, hidden in found if not hidden]
    unit = stream.time_base or Fraction(1, 1)
    stamps = sorted(stamp for stamp in shown if stamp is not None)
    steps = [(later - earlier) * unit for earlier, later in itertools.pairwise(stamps)]
    complete = len(stamps) == len(shown) and all(step > CONTAINER_LIMITS.same_s for step in steps)
    name = container.format.name
    if name in _RAW_FORMATS or name.endswith("_pipe"):  # whose reader invents time stamps
        complete = False
    times = tuple(float((stamp - stamps[0]) * unit) for stamp in stamps) if complete else ()
    # AVI numbers frames as they are decoded, not as they are shown.
    reliable = complete and not (name == "avi" and stream.codec_context.has_b_frames)
    rate = float(stream.guessed_rate or CONTAINER_LIMITS.assumed_fps)
    lost = max(0, stream.frames - len(found)) if name.startswith(_LISTS_FRAMES) else 0
    return _Packets(times, tuple(stamps) if reliable else (), len(shown), lost, rate)


def _gaps(times_s: Sequence[float]) -> list[tuple[float, float]]:
    """Begin and end of the longest times without frames, seconds, in their order."""
    steps = np.diff(times_s)
    if not len(steps):
        return []
    found = np.flatnonzero(steps > max(CONTAINER_LIMITS.gap_s, CONTAINER_LIMITS.gap_frames * float(np.median(steps))))
    longest = sorted(found[np.argsort(-steps[found], kind="stable")][: CONTAINER_LIMITS.most_gaps].tolist())
    return [(times_s[k], times_s[k + 1]) for k in longest]


def _stated_rate(stream: "VideoStream") -> float:
    for rate in (stream.average_rate, stream.guessed_rate, stream.base_rate):
        if rate and math.isfinite(float(rate)) and 0 < rate <= 1000:
            return float(rate)
    return CONTAINER_LIMITS.assumed_fps


def _pixel_width(stream: "VideoStream") -> float:
    ratio: Any = stream.sample_aspect_ratio
    return float(ratio) if ratio and ratio > 0 else 1.0
