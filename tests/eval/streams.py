"""Cameras on this machine: an RTSP server (RFC 2326; RFC 3551's payload 33, a transport stream), MJPEG over HTTP."""

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import numpy as np

PACKET = 7 * 188
SDP = b"v=0\r\no=- 0 0 IN IP4 127.0.0.1\r\ns=-\r\nt=0 0\r\nm=video 0 RTP/AVP 33\r\na=control:video\r\n"


@contextlib.contextmanager
def _served(answer: Callable[[socket.socket], None]) -> Iterator[int]:
    """The port of a server that `answer`s each client in a thread."""

    def one(client: socket.socket) -> None:
        with client, contextlib.suppress(OSError):
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
def rtsp(video: Path) -> Iterator[str]:
    """The address of a camera that sends a transport stream (.ts) over TCP, as fast as it is taken, and hangs up."""
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

    with _served(answer) as port:
        yield f"rtsp://127.0.0.1:{port}/camera"


@contextlib.contextmanager
def mjpeg(count: int, fps: float) -> Iterator[str]:
    """The address of a web camera that sends `count` pictures in real time; picture i has brightness 8 i."""

    def answer(client: socket.socket) -> None:
        client.recv(4096)
        client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
        for i in range(count):
            picture = cv2.imencode(".jpg", np.full((64, 96, 3), 8 * i, dtype=np.uint8))[1].tobytes()
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(picture)}\r\n\r\n"
            client.sendall(head.encode() + picture + b"\r\n")
            time.sleep(1 / fps)

    with _served(answer) as port:
        yield f"http://127.0.0.1:{port}/camera.mjpg"
