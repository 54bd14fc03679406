"""How a live stream is kept up with: lag from a frame's sending to its results, frames passed over, memory.

    skope gen video t06_plaza_opening --fps 10 --seconds 12 --out footage
    python scripts/research/live_stream.py footage/t06_plaza_opening.mp4 --fps 10 --minutes 30

The video is sent round and round as a web camera would (MJPEG over HTTP, on this machine, as JPEG files that were made
before), and `skope eval predict` looks at it in a process of its own. The table has a row for each sixth of the time.
"""

import argparse
import contextlib
import json
import re
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import cv2

PARTS: Final = 6
_LOOK_S: Final = 0.02
_MEMORY_EVERY_S: Final = 2.0


@dataclass
class Camera:
    """A web camera that repeats a video."""

    jpegs: list[bytes]
    fps: float
    sent_s: list[float] = field(default_factory=list)
    """When each frame of the newest connection was sent."""

    def serve(self, server: socket.socket) -> None:
        """Answer one client after another until the server is closed."""
        with contextlib.suppress(OSError):
            while True:
                client = server.accept()[0]
                with client, contextlib.suppress(OSError):
                    client.recv(4096)
                    self._send(client)

    def _send(self, client: socket.socket) -> None:
        client.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
        self.sent_s = []
        begun = time.monotonic()
        while True:
            jpeg = self.jpegs[len(self.sent_s) % len(self.jpegs)]
            head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(jpeg)}\r\n\r\n".encode()
            time.sleep(max(0.0, begun + len(self.sent_s) / self.fps - time.monotonic()))
            self.sent_s.append(time.monotonic())
            client.sendall(head + jpeg + b"\r\n")


@dataclass
class Seen:
    """What came of the stream."""

    frames: list[tuple[int, float, float]] = field(default_factory=list)
    """Number of a frame, when its results were there, and how long after it was sent that was, seconds."""
    memory: list[tuple[float, float]] = field(default_factory=list)
    """When, and resident megabytes of the process."""


def watch(process: subprocess.Popen[bytes], progress: Path, camera: Camera) -> Seen:
    """Note what a run writes down while it looks."""
    seen, rest, at, asked = Seen(), b"", 0, 0.0
    while process.poll() is None:
        time.sleep(_LOOK_S)
        now = time.monotonic()
        if now - asked > _MEMORY_EVERY_S:
            asked = now
            with contextlib.suppress(OSError):
                status = Path(f"/proc/{process.pid}/status").read_text()
                seen.memory += [(now, int(kib) / 1024) for kib in re.findall(r"VmRSS:\s+(\d+)", status)]
        with contextlib.suppress(FileNotFoundError), progress.open("rb") as file:
            file.seek(at)
            data = file.read()
            at += len(data)
            *lines, rest = (rest + data).split(b"\n")
            for line in lines:
                number = json.loads(line)["image"]["frame_index"]
                seen.frames.append((number, now, now - camera.sent_s[number]))
    return seen


def rows(seen: Seen) -> list[str]:
    """A line of the table for each part of the time."""
    out: list[str] = []
    if not seen.frames:
        return out
    begun, end = seen.frames[0][1], seen.frames[-1][1]
    for k in range(PARTS):
        since, until = (begun + (end - begun) * j / PARTS for j in (k, k + 1))
        part = [(number, lag) for number, when, lag in seen.frames if since <= when <= until]
        memory = [megabytes for when, megabytes in seen.memory if since <= when <= until]
        if len(part) < 2:
            continue
        lags = sorted(lag for _, lag in part)
        passed = 1 - (len(part) - 1) / (part[-1][0] - part[0][0])
        cells = [
            f"{(since - begun) / 60:.1f} to {(until - begun) / 60:.1f}",
            f"{(len(part) - 1) / (until - since):.2f}",
            f"{passed:.0%}",
            f"{statistics.median(lags):.2f}",
            f"{lags[round(0.95 * (len(lags) - 1))]:.2f}",
            f"{lags[-1]:.2f}",
            f"{max(memory):.0f}" if memory else "-",
        ]
        out.append("| " + " | ".join(cells) + " |")
    return out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("video", type=Path)
    parser.add_argument("--fps", type=float, default=10.0)
    parser.add_argument("--minutes", type=float, default=30.0)
    parser.add_argument("--checkpoint", default="road33")
    parser.add_argument("--min-size", type=int, default=540)
    options = parser.parse_args()
    capture, jpegs = cv2.VideoCapture(str(options.video)), []
    while (frame := capture.read()[1]) is not None:
        jpegs.append(cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, 90])[1].tobytes())
    camera = Camera(jpegs, options.fps)
    with tempfile.TemporaryDirectory() as folder, socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=camera.serve, args=(server,), daemon=True).start()
        address = f"http://127.0.0.1:{server.getsockname()[1]}/camera.mjpg"
        command = (
            f"eval predict {address} --out {folder} --end {60 * options.minutes} --checkpoint {options.checkpoint}"
        )
        command += f" --min-size {options.min_size} --quiet"
        process = subprocess.Popen([sys.executable, "-m", "skope", *command.split()])
        seen = watch(process, Path(folder) / ".predict.jsonl", camera)
    print("| minutes | images/s | passed over | lag, s: median | 95% | most | memory, MB |")
    print("|---" * 7 + "|")
    print("\n".join(rows(seen)))


if __name__ == "__main__":
    main()
