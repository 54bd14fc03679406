"""Decode the frames of a video in display order: RGB, upright, progressive, without damaged ones."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import cv2
import numpy as np

from skope.types import Pixels

if TYPE_CHECKING:
    from av.container import InputContainer
    from av.packet import Packet
    from av.video.frame import VideoFrame
    from av.video.stream import VideoStream


@dataclass(frozen=True)
class DecodeLimits:
    """Limits for reading damaged files."""

    retries: int = 20
    """Consecutive read errors after which a file counts as ended."""
    damaged_frames: int = 300
    """Number of frames after damage at which frames are used again without a key frame: some cameras send none."""


DECODE_LIMITS: Final = DecodeLimits()


def packets(
    container: "InputContainer", stream: "VideoStream", retries: int = DECODE_LIMITS.retries
) -> Iterator["Packet[VideoStream]"]:
    """Yield the packets of a stream up to its end, including the empty packet that ends it.

    Args:
        container: The opened file or stream.
        stream: The stream to read.
        retries: Number of consecutive read errors after which it counts as ended.
    """
    from av.error import FFmpegError

    failed = 0
    while failed < retries:
        try:
            for packet in container.demux(stream):
                failed = 0
                yield packet
            return
        except FFmpegError:
            failed += 1


def decode_frames(container: "InputContainer", stream: "VideoStream") -> Iterator["VideoFrame"]:
    """Decode frames from the container's position. Interlaced frames are made progressive; damaged ones are dropped."""
    decoder = Decoder(stream)
    for packet in packets(container, stream):
        yield from decoder.frames_of(packet)
    yield from decoder.frames_of(None)


class Decoder:
    """Decodes the packets of a stream to progressive frames without damage.

    A frame that is damaged, or has a packet that cannot be decoded, is dropped. The frames after it up to the next key
    frame are also dropped, because they depend on it.
    """

    def __init__(self, stream: "VideoStream") -> None:
        """`stream` must not have been decoded yet."""
        self.damaged = 0
        """Number of dropped frames."""
        self._stream, self._fields = stream, Deinterlacer()
        self._since_damage: int | None = None
        self._suspect: int | None = None
        """Time stamp of the newest packet that is incomplete."""
        # Damage is reported instead of a concealed frame.
        stream.codec_context.options = {"err_detect": "explode"}

    def frames_of(self, packet: "Packet[VideoStream] | None") -> Iterator["VideoFrame"]:
        """Yield the frames that a packet completes; None: the remaining frames at the end of the stream."""
        from av.error import EOFError as EndError
        from av.error import FFmpegError

        if packet is not None and packet.is_corrupt:
            self._suspect = packet.pts
        try:
            frames = self._stream.decode(packet)
        except EndError:  # the end was signalled before
            frames = []
        except FFmpegError:
            frames = []
            self._note_damage()
        for frame in filter(self._is_whole, frames):
            yield from self._fields.add(frame)
        if packet is None:
            yield from self._fields.end()

    def _note_damage(self) -> None:
        self.damaged += 1
        self._since_damage = 0

    def _is_whole(self, frame: "VideoFrame") -> bool:
        if frame.is_corrupt or (self._suspect is not None and frame.pts == self._suspect):
            self._suspect = None
            self._note_damage()
            return False
        if self._since_damage is None or frame.key_frame or self._since_damage >= DECODE_LIMITS.damaged_frames:
            self._since_damage = None
            return True
        self.damaged += 1
        self._since_damage += 1
        return False


class Deinterlacer:
    """Makes interlaced frames progressive (FFmpeg's bwdif), from the first interlaced frame on.

    Frames keep their order and time stamps. The filter holds a frame until the next one arrives.
    """

    def __init__(self) -> None:
        self._graph: Any = None
        self._form: tuple[int, int, str] | None = None
        self._waiting: deque[VideoFrame] = deque()

    def add(self, frame: "VideoFrame") -> Iterator["VideoFrame"]:
        """Add a frame; yield those that are ready."""
        form = (frame.width, frame.height, frame.format.name)
        if self._graph is not None and form != self._form:
            yield from self.end()
        if self._graph is None:
            if not frame.interlaced_frame:
                yield frame
                return
            self._graph, self._form = _filter(frame), form
        self._waiting.append(frame)
        self._graph.push(frame)
        yield from self._ready()

    def end(self) -> Iterator["VideoFrame"]:
        """Yield the frames that are still in the filter, and reset it."""
        if self._graph is not None:
            self._graph.push(None)
            yield from self._ready()
            self._graph, self._form = None, None
            self._waiting.clear()

    def _ready(self) -> Iterator["VideoFrame"]:
        from av.error import BlockingIOError as NotYetError
        from av.error import EOFError as EndError

        while True:
            try:
                made = self._graph.pull()
            except (NotYetError, EndError):
                return
            if not self._waiting:
                return
            before = self._waiting.popleft()
            made.pts, made.time_base = before.pts, before.time_base
            yield made


def _filter(frame: "VideoFrame") -> Any:
    from av.filter import Graph

    graph = Graph()
    source = graph.add_buffer(width=frame.width, height=frame.height, format=frame.format, time_base=frame.time_base)
    bwdif, sink = graph.add("bwdif", "mode=send_frame:deint=interlaced"), graph.add("buffersink")
    source.link_to(bwdif)
    bwdif.link_to(sink)
    graph.configure()
    return graph


def rgb_of(frame: "VideoFrame") -> Pixels:
    """Return (H, W, 3) RGB of a frame, rotated upright in quarter turns as its container states."""
    pixels = frame.to_ndarray(format="rgb24")
    quarters = _quarters(frame)
    return np.ascontiguousarray(np.rot90(pixels, quarters)) if quarters else np.asarray(pixels, dtype=np.uint8)


def shown_size(frame: "VideoFrame") -> tuple[int, int]:
    """Return width and height of an upright frame, pixels."""
    return (frame.height, frame.width) if _quarters(frame) % 2 else (frame.width, frame.height)


def _quarters(frame: "VideoFrame") -> int:
    return round(frame.rotation / 90) % 4


def same_shape(first: tuple[int, int], second: tuple[int, int]) -> bool:
    """Return whether two sizes (width, height) have one aspect ratio, within a pixel of the smaller one."""
    return abs(first[0] * second[1] - first[1] * second[0]) <= max(*first, *second)


def fitted(pixels: Pixels, size: tuple[int, int]) -> Pixels | None:
    """Scale pixels to a size (width, height) of the same aspect ratio; None if the aspect ratio differs."""
    height, width = pixels.shape[:2]
    if (width, height) == size:
        return pixels
    if not same_shape((width, height), size):
        return None
    how = cv2.INTER_AREA if width > size[0] else cv2.INTER_LINEAR
    return np.asarray(cv2.resize(pixels, size, interpolation=how), dtype=np.uint8)
