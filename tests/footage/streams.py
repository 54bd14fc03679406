"""Footage as it comes: an RTSP server (RFC 2326; RFC 3551's payload 33, a transport stream), MJPEG over HTTP, and
files whose frames last differently long (ISO/IEC 14496-12)."""

import contextlib
import itertools
import math
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np

PACKET = 7 * 188
SDP = b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=-\r\nt=0 0\r\nm=video 0 RTP/AVP 33\r\na=control:video\r\n"


@contextlib.contextmanager
def _served(answer: Callable[[socket.socket], None], times: float = math.inf) -> Iterator[int]:
    """The port of a server that `answer`s each client in a thread; after so many it hangs up at once."""
    served = itertools.count()

    def one(client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
            if next(served) < times:
                answer(client)

    def clients() -> None:
        with contextlib.suppress(OSError):
            while True:
                threading.Thread(target=one, args=(server.accept()[0],), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=clients, daemon=True).start()
        yield server.getsockname()[1]
        server.shutdown(socket.SHUT_RDWR)


@contextlib.contextmanager
def rtsp(video: Path, times: float = math.inf) -> Iterator[str]:
    """The address of a camera that sends a transport stream (.ts) over TCP, as fast as it is taken, and hangs up.

    It answers so many `times`.
    """
    data = video.read_bytes()

    def answer(client: socket.socket) -> None:
        lines = client.makefile("rb")
        while request := lines.readline().split():
            header = [request, *iter(lambda: lines.readline().split(), [])]
            number = next(words[1].decode() for words in header if words[0].lower() == b"cseq:")
            more, body = "Public: OPTIONS, DESCRIBE, SETUP, PLAY\r\n", b""
            if request[0] == b"DESCRIBE":
                more, body = f"Content-Type: application/sdp\r\nContent-Length: {len(SDP)}\r\n", SDP
            elif request[0] == b"SETUP":
                more = "Transport: RTP/AVP/TCP;unicast;interleaved=0-1\r\nSession: 1\r\n"
            client.sendall(f"RTSP/1.0 200 OK\r\nCSeq: {number}\r\n{more}\r\n".encode() + body)
            if request[0] == b"PLAY":
                for k, at in enumerate(range(0, len(data), PACKET)):
                    packet = struct.pack("!BBHII", 0x80, 33, k, 9000 * k, 1) + data[at : at + PACKET]
                    client.sendall(b"$\0" + struct.pack("!H", len(packet)) + packet)
                return

    with _served(answer, times) as port:
        yield f"rtsp://127.0.0.1:{port}/camera"


@contextlib.contextmanager
def mjpeg(count: int, fps: float, times: float = math.inf) -> Iterator[str]:
    """The address of a web camera that sends `count` pictures in real time; picture i has brightness 8 i.

    In the midst of the next one it hangs up; it answers so many `times`.
    """

    def answer(client: socket.socket) -> None:
        client.recv(4096)
        client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
        for i in range(count):
            picture = cv2.imencode(".jpg", np.full((64, 96, 3), 8 * i, dtype=np.uint8))[1].tobytes()
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
            client.sendall(head.encode() + picture + b"\r\n")
            time.sleep(1 / fps)
        client.sendall(head.encode() + picture[: len(picture) // 2])

    with _served(answer, times) as port:
        yield f"http://127.0.0.1:{port}/camera.mjpg"


def vary(video: Path, lengths: Sequence[int]) -> list[float]:
    """Let the frames of an .mp4 of OpenCV's last `lengths` times as long as now, each; returns when each is shown."""
    data = bytearray(video.read_bytes())
    where: dict[bytes, int] = {}

    def walk(at: int, end: int) -> None:
        while at < end:
            size, name = struct.unpack(">I4s", data[at : at + 8])
            where[name] = at
            if name in (b"moov", b"trak", b"mdia", b"minf", b"stbl", b"edts"):
                walk(at + 8, at + size)
            at += size

    walk(0, len(data))
    assert where[b"moov"] > where[b"mdat"]  # so that nothing else moves
    at = where[b"stts"]
    entries, count, delta = struct.unpack(">III", data[at + 12 : at + 24])
    assert (entries, count) == (1, len(lengths))
    (scale,) = struct.unpack(">I", data[where[b"mdhd"] + 20 : where[b"mdhd"] + 24])
    for name, place in ((b"mvhd", 24), (b"tkhd", 28), (b"mdhd", 24), (b"elst", 16)):
        field = slice(where[name] + place, where[name] + place + 4)
        (length,) = struct.unpack(">I", data[field])
        data[field] = struct.pack(">I", length * sum(lengths) // count)
    table = b"".join(struct.pack(">II", 1, delta * length) for length in lengths)
    whole = b"\0" * 4 + struct.pack(">I", count) + table
    grown = len(whole) + 8 - 24
    data[at : at + 24] = struct.pack(">I4s", len(whole) + 8, b"stts") + whole
    for name in (b"moov", b"trak", b"mdia", b"minf", b"stbl"):
        (size,) = struct.unpack(">I", data[where[name] : where[name] + 4])
        data[where[name] : where[name] + 4] = struct.pack(">I", size + grown)
    video.write_bytes(data)
    return [sum(lengths[:i]) * delta / scale for i in range(count)]
