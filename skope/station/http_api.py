"""Read-only HTTP API of a station, its metrics for Prometheus, and its page."""

import hmac
import socket
import threading
from collections.abc import Callable, Sequence
from datetime import date
from typing import Annotated, Any, Final, Literal

import uvicorn
from fastapi import Depends, FastAPI, HTTPException, Query, Request
from fastapi.responses import FileResponse, HTMLResponse, PlainTextResponse
from prometheus_client import CollectorRegistry, Gauge, generate_latest
from prometheus_client.exposition import CONTENT_TYPE_PLAIN_0_0_4

from skope.errors import UserError
from skope.station.database import Database
from skope.station.health import STATES, CameraHealth
from skope.station.page import station_page
from skope.station.station_file import HttpAddress, StationCamera
from skope.version import __version__

Table = Literal["counts", "events", "speeds", "visibility", "recordings"]
_GAUGES: Final = {
    "rate": ("skope_frames_per_second", "Analysed frames per second."),
    "skipped": ("skope_skipped_share", "Share of the received frames that were not analysed."),
    "delay_s": ("skope_delay_seconds", "Time from the arrival of the last frame to its detections, seconds."),
    "in_view": ("skope_road_users_in_view", "Road users in the last frame, not confirmed."),
    "restarts": ("skope_process_restarts", "Restarts of the process that reads the stream."),
}


def make_app(
    cameras: Sequence[StationCamera], database: Database, health: Callable[[], list[CameraHealth]], token: str = ""
) -> FastAPI:
    """Return the application.

    Args:
        cameras: The cameras.
        database: The database of the station.
        health: Returns the health of all cameras.
        token: Token that each request must carry, as `Authorization: Bearer TOKEN` or `?token=TOKEN`; empty: none.
    """

    def check(request: Request) -> None:
        given = request.headers.get("authorization", "").removeprefix("Bearer ")
        given = given or request.query_params.get("token", "")
        if token and not hmac.compare_digest(given.encode(), token.encode()):
            raise HTTPException(401, "the token is missing or wrong")

    pictures = {camera.name: camera.latest_picture for camera in cameras if camera.picture != "none"}
    names = [camera.name for camera in cameras]

    def known(camera: str) -> str:
        if camera not in names:
            raise HTTPException(404, f"no camera {camera!r}")
        return camera

    Camera = Annotated[str, Depends(known)]
    app = FastAPI(
        title="skope station",
        version=__version__,
        description="Counts, events and speeds of the cameras of a station, and their health. Read only.",
        dependencies=[Depends(check)],
        docs_url=None,
        redoc_url=None,
        openapi_url=None,  # below, because dependencies do not apply to FastAPI's own
    )

    @app.exception_handler(UserError)
    def unavailable(_request: Request, error: UserError) -> PlainTextResponse:
        return PlainTextResponse(str(error), 503)

    @app.get("/api/cameras")
    def states() -> list[dict[str, Any]]:
        """Return the health of all cameras."""
        return [camera.to_dict() for camera in health()]

    @app.get("/api/cameras/{camera}/days")
    def days(camera: Camera) -> list[dict[str, Any]]:
        """Return the measured days of a camera, the newest first."""
        return database.days(camera)

    @app.get("/api/cameras/{camera}/days/{day}/{table}")
    def rows(
        camera: Camera,
        day: date,
        table: Table,
        first: Annotated[int, Query(ge=0)] = 0,
        limit: Annotated[int, Query(ge=1, le=100_000)] = 10_000,
    ) -> list[dict[str, Any]]:
        """Return rows of a table of a day, from number `first` on."""
        return database.rows(table, camera, day, first, limit)

    @app.get("/api/cameras/{camera}/picture", response_class=FileResponse)
    def picture(camera: Camera) -> FileResponse:
        """Return the latest picture of a camera (JPEG), if the station file asks for it."""
        if camera not in pictures or not pictures[camera].is_file():
            raise HTTPException(404, f"no picture of camera {camera!r}")
        return FileResponse(pictures[camera], media_type="image/jpeg", headers={"Cache-Control": "no-store"})

    @app.get("/openapi.json", include_in_schema=False)
    def description() -> dict[str, Any]:
        """Return the description of the API."""
        return app.openapi()

    @app.get("/metrics", response_class=PlainTextResponse)
    def metrics() -> PlainTextResponse:
        """Return the health of all cameras for Prometheus."""
        return PlainTextResponse(metrics_text(health()), media_type=CONTENT_TYPE_PLAIN_0_0_4)

    @app.get("/", response_class=HTMLResponse)
    def page(request: Request) -> HTMLResponse:
        """Return the page of the station."""
        shown = [name for name, path in pictures.items() if path.is_file()]
        return HTMLResponse(station_page(database, health(), shown, request.url.query))

    return app


def metrics_text(health: Sequence[CameraHealth]) -> str:
    """Return the health of cameras in Prometheus' text format."""
    registry = CollectorRegistry()
    state = Gauge("skope_camera_state", "1 for the state of a camera.", ["camera", "state"], registry=registry)
    gauges = {field: Gauge(name, text, ["camera"], registry=registry) for field, (name, text) in _GAUGES.items()}
    for camera in health:
        for name in STATES:
            state.labels(camera.camera, name).set(float(camera.state == name))
        for field, gauge in gauges.items():
            if (value := getattr(camera, field)) is not None:
                gauge.labels(camera.camera).set(value)
    return generate_latest(registry).decode()


def bound_socket(address: HttpAddress) -> socket.socket:
    """Return a socket that listens at an address.

    Raises:
        UserError: The address is in use, or not one of this machine.
    """
    family = socket.AF_INET6 if ":" in address.host else socket.AF_INET
    try:
        return socket.create_server((address.host, address.port), family=family)
    except OSError as error:
        raise UserError(f"http: {address.host}:{address.port}: {error.strerror or error}") from None


class HttpServer:
    """Serves an application in a thread of its own."""

    def __init__(self, app: FastAPI, address: HttpAddress) -> None:
        """Start to serve.

        Raises:
            UserError: The address is in use, or not one of this machine.
        """
        self._socket = bound_socket(address)
        self._server = uvicorn.Server(uvicorn.Config(app, log_config=None, access_log=False))
        self._server.install_signal_handlers = lambda: None  # type: ignore[attr-defined]
        self._thread = threading.Thread(target=self._server.run, args=([self._socket],), daemon=True)
        self._thread.start()

    def publish(self, health: Sequence[CameraHealth]) -> None:
        """Do nothing: requests are answered when they come."""

    def close(self) -> None:
        """Stop to serve."""
        self._server.should_exit = True
        self._thread.join(5.0)
