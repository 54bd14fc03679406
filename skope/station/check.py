"""`skope eval station --check`: try each part of a station, and print a line for each."""

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from skope.dataset.camera_of_file import fitted_camera
from skope.errors import UserError
from skope.station.database import Database
from skope.station.station_file import HttpAddress, MqttBroker, Station, StationCamera
from skope.terminal.console import Console
from skope.video.footage import LiveStream, open_footage


@dataclass(frozen=True)
class CheckLimits:
    """Duration of the checks."""

    measured_s: float = 5.0
    """Time over which the frame rate of a stream is measured, seconds."""
    broker_s: float = 5.0
    """Maximum time to wait for a broker, seconds."""


CHECK_LIMITS: Final = CheckLimits()


def check_station(station: Station, console: Console) -> bool:
    """Try streams, cameras, database and broker; print a line for each, and return whether all are well."""
    checks: list[tuple[str, Callable[[], str]]] = [
        (camera.name, lambda camera=camera: check_camera(camera))  # type: ignore[misc]
        for camera in station.cameras
    ]
    checks.append(("database", lambda: Database.open(station.database).name))
    if station.http:
        address = station.http
        checks.append(("http", lambda: check_port(address)))
    if station.mqtt:
        broker = station.mqtt
        checks.append(("mqtt", lambda: check_broker(broker)))
    well = True
    for name, check in checks:
        try:
            console.result(f"{name}: ok: {check()}")
        except UserError as error:
            well = False
            console.result(f"{name}: FAILED: {error}")
    return well


def check_camera(camera: StationCamera) -> str:
    """Read some seconds of a camera's stream; return its size, frame rate and camera.

    Raises:
        UserError: The stream cannot be read, or the camera of the site file does not fit it.
    """
    if camera.stream is None:
        count = sum(1 for _ in camera.tracks.iterdir()) if camera.tracks.is_dir() else 0
        return f"{count} folders in {camera.tracks}"
    stream = open_footage(camera.stream)
    if not isinstance(stream, LiveStream):
        raise UserError(f"{camera.name}: stream: it is a video, not a live stream")
    first = time.monotonic()
    last, size, arrived = first, None, 0
    for image, _ in stream.frames():
        last = time.monotonic()
        if size is None:
            size, first = (image.width, image.height), last
        arrived = 1 + (image.frame_index or 0)
        if last - first > CHECK_LIMITS.measured_s:
            break
    if size is None:
        raise UserError(f"{camera.name}: stream: no frame arrived")
    rate = f"{(arrived - 1) / (last - first):.1f} frames/s" if last > first else "1 frame"
    assert camera.site.camera is not None
    where = f"{camera.site.path}: camera"
    _, scaled = fitted_camera(camera.site.camera.camera, size, where, camera.name)
    return f"{size[0]}x{size[1]}, {rate}; {scaled or f'{where} fits'}"


def check_port(address: HttpAddress) -> str:
    """Try the port of the page; return its address. Raises UserError if it is in use."""
    from skope.station.http_api import bound_socket

    bound_socket(address).close()
    return f"http://{address.host}:{address.port}"


def check_broker(broker: MqttBroker) -> str:
    """Connect to a broker; return its address.

    Raises:
        UserError: The broker cannot be reached, or refuses the name or the password.
    """
    from skope.station.mqtt import client_of

    answers: list[str] = []
    client = client_of(broker)
    client.on_connect = lambda _client, _data, _flags, reason, _properties: answers.append(
        str(reason) if reason.is_failure else ""
    )
    where = f"mqtt: {broker.host}:{broker.port}"
    try:
        client.connect(broker.host, broker.port, keepalive=10)
    except (OSError, socket.gaierror) as error:
        raise UserError(f"{where}: cannot be reached: {error}") from None
    until = time.monotonic() + CHECK_LIMITS.broker_s
    while not answers and time.monotonic() < until:
        client.loop(0.2)
    client.disconnect()
    if not answers or answers[0]:
        raise UserError(f"{where}: {answers[0] if answers else 'no answer'}")
    return f"{broker.host}:{broker.port}, topic {broker.topic}"
