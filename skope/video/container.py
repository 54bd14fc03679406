"""A video file or stream as PyAV opens it: the selected stream, the times of its frames, the shape of its pixels."""

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
    """Defaults and limits for times in containers."""

    assumed_fps: float = 25.0
    """Frame rate assumed for a video that states none, frames per second."""
    usual_fps: float = 120.0
    """Frame rate above which it is reported: containers often state the unit of their clock instead."""
    silence_s: float = 5.0
    """Time without data after which a server counts as disconnected, seconds."""
    square_within: float = 0.005
    """Deviation of a pixel's aspect ratio from 1 that is ignored."""
    same_s: float = 5e-4
    """Difference below which times are equal, seconds: containers count in thousandths of a second, or finer."""
    gap_s: float = 1.0
    """Minimum duration of a reported gap without frames, seconds."""
    gap_frames: float = 5.0
    """Minimum duration of a reported gap, in frame intervals."""
    most_gaps: int = 3
    """Maximum number of reported gaps."""
    default_stream_pixels: int = 5_000_000
    """Bonus in pixels for the stream that its container marks as the default one, as in FFmpeg."""


CONTAINER_LIMITS: Final = ContainerLimits()

_RTSP_OPTIONS: Final = {"rtsp_transport": "tcp", "fpsprobesize": "0", "fflags": "nobuffer"}
"""Options of FFmpeg for cameras: no lost packets, and no delay to estimate the frame rate."""
CREDENTIALS_PATTERN: Final = re.compile(r"^(\w+://)[^/]*@")
_RAW_FORMATS: Final = frozenset(
    ("h264", "hevc", "vvc", "mjpeg", "mpegvideo", "m4v", "h263", "vc1", "obu", "dirac", "cavsvideo", "rawvideo")
)
"""FFmpeg's names of formats that consist of coded frames without times."""
_LISTS_FRAMES: Final = ("avi", "mov,")
"""Beginnings of FFmpeg's names of containers that list all their frames; others state estimates."""


@dataclass(frozen=True, kw_only=True)
class VideoInfo:
    """Properties that a video file or stream states about itself. It is opened once to read them."""

    address: str
    """Path of a file on this machine, or address on a server."""
    live: bool = False
    """Whether its frames arrive as they are recorded, and only once."""
    count: int = 0
    """Number of frames; for a file on a server as its container states it. 0: unknown."""
    lost: int = 0
    """Number of frames that a file on this machine lists but does not contain."""
    given_fps: float | None = None
    """Frame rate that the user gave in place of the time stamps, frames per second."""
    rate: float = CONTAINER_LIMITS.assumed_fps
    """Mean frame rate, frames per second."""
    times_s: tuple[float, ...] = ()
    """Time of each frame since the first one, seconds, of a file on this machine; empty for others."""
    stamps: tuple[int, ...] = ()
    """Time stamp of each frame, in the stream's unit; empty if they are unreliable and frames are counted."""
    size: tuple[int, int] | None = None
    """Width and height of the first frame of a file on this machine, upright, pixels; None for others."""
    pixel_width: float = 1.0
    """Ratio of width to height of a stored pixel on display."""
    notes: tuple[str, ...] = ()
    """Assumptions to report to the user, one line each."""

    @property
    def square(self) -> bool:
        """Whether its pixels are square."""
        return abs(self.pixel_width - 1) < CONTAINER_LIMITS.square_within

    @property
    def on_server(self) -> bool:
        """Whether it is read from a server."""
        return "://" in self.address


@contextmanager
def opened(address: str) -> Iterator[tuple["InputContainer", "VideoStream"]]:
    """Open a video, and select the stream that players show.

    Args:
        address: Path of a file, or an address on a server.

    Raises:
        UserError: It is not a video, its server does not answer, or FFmpeg cannot decode it.
    """
    import av
    from av.error import FFmpegError

    server = "://" in address
    options = _RTSP_OPTIONS if address.startswith("rtsp") else {}
    # The prefix marks it as a file: FFmpeg treats a name with a colon as an address.
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
        # Frame threads would delay each frame of a live stream by several frames.
        stream.thread_type = "SLICE" if server else "AUTO"
        yield container, stream


def shown_address(address: str) -> str:
    """Return an address without user and password, for use in messages. Paths of files are unchanged."""
    return CREDENTIALS_PATTERN.sub(r"\1", address) if "://" in address else address


def _reason(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error)


def _video_streams(container: "InputContainer") -> list["VideoStream"]:
    """Return the image streams, without covers; first the one that FFmpeg and players show."""
    from av.stream import Disposition

    streams = [s for s in container.streams.video if not s.disposition & Disposition.attached_pic]

    def size(stream: "VideoStream") -> int:
        default = CONTAINER_LIMITS.default_stream_pixels if stream.disposition & Disposition.default else 0
        return stream.width * stream.height + default

    return sorted(streams, key=size, reverse=True)  # stable for equal sizes


def open_clip(address: str, fps: float | None = None) -> VideoInfo:
    """Open a video and read its properties.

    Args:
        address: Path of a file, or address on a server.
        fps: Frame rate of a file with missing or wrong time stamps; None: use its time stamps.

    Raises:
        UserError: It cannot be opened, or `fps` is given for an address on a server.
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
                raise UserError(f"--fps: {shown_address(address)} is on a server; its frames have their own times")
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
    """Properties of a file's frames from its packets, which are not decoded."""

    times_s: tuple[float, ...]
    """Times of the shown frames since the first one, seconds; empty if some are missing or two are equal."""
    stamps: tuple[int, ...]
    """Time stamps for `VideoInfo.stamps`."""
    count: int
    """Number of frames."""
    lost: int
    """Number of missing frames, for `VideoInfo.lost`."""
    rate: float
    """Frame rate to assume without times, frames per second."""


def _look_through(container: "InputContainer", stream: "VideoStream") -> _Packets:
    """Read all packets of a file. Those that an edit list hides are not counted."""
    # Only these properties of a packet are kept, because a file may be larger than the memory.
    found = [(packet.pts, packet.is_discard) for packet in packets(container, stream) if packet.size]
    shown = [stamp for stamp, hidden in found if not hidden]
    unit = stream.time_base or Fraction(1, 1)
    stamps = sorted(stamp for stamp in shown if stamp is not None)
    steps = [(later - earlier) * unit for earlier, later in itertools.pairwise(stamps)]
    complete = len(stamps) == len(shown) and all(step > CONTAINER_LIMITS.same_s for step in steps)
    name = container.format.name
    if name in _RAW_FORMATS or name.endswith("_pipe"):  # their reader invents time stamps
        complete = False
    times = tuple(float((stamp - stamps[0]) * unit) for stamp in stamps) if complete else ()
    # AVI numbers frames in decoding order, not in display order.
    reliable = complete and not (name == "avi" and stream.codec_context.has_b_frames)
    rate = float(stream.guessed_rate or CONTAINER_LIMITS.assumed_fps)
    lost = max(0, stream.frames - len(found)) if name.startswith(_LISTS_FRAMES) else 0
    return _Packets(times, tuple(stamps) if reliable else (), len(shown), lost, rate)


def _gaps(times_s: Sequence[float]) -> list[tuple[float, float]]:
    """Return begin and end of the longest gaps without frames, seconds, in their order."""
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
