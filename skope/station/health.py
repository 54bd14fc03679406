"""Health of the cameras of a station: whether each delivers images, how fast and how late."""

from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from typing import Any, Final

from skope.errors import UserError
from skope.files.json_files import read_json
from skope.station.station_file import StationCamera

SILENT_S: Final = 15.0
"""Time since the last frame after which a camera is silent, seconds."""
RUNNING, SILENT, STARTING, RECORDED = "running", "silent", "starting", "recordings only"
STATES: Final = (RUNNING, SILENT, STARTING, RECORDED)


@dataclass(frozen=True, kw_only=True)
class CameraHealth:
    """Health of a camera."""

    camera: str
    state: str
    """One of `STATES`."""
    last_frame: str | None = None
    """Time of the last analysed frame (ISO 8601, UTC)."""
    rate: float | None = None
    """Analysed frames per second."""
    skipped: float | None = None
    """Share of the received frames that were not analysed."""
    delay_s: float | None = None
    """Time from the arrival of the last frame to its detections, seconds."""
    in_view: int | None = None
    """Number of road users in the last frame. Provisional: they are not confirmed by other frames."""
    restarts: int = 0
    """Number of times that the process that reads the stream was started again."""
    message: str = ""
    """Why no stream is read."""

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON object."""
        return asdict(self)


def health_of(camera: StationCamera, restarts: int = 0, now: datetime | None = None) -> CameraHealth:
    """Return the health of a camera by the state that its process has written; `now` is the time."""
    if camera.stream is None:
        return CameraHealth(camera=camera.name, state=RECORDED)
    now = now or datetime.now(UTC)
    try:
        state = read_json(camera.state)
        last = state["last_frame"]
        quiet_s = None if last is None else (now - datetime.fromisoformat(last)).total_seconds()
        shown = ("last_frame", "rate", "skipped", "delay_s", "in_view", "message") if last else ("message",)
        measured = {name: state[name] for name in shown}
    except (UserError, KeyError, TypeError, ValueError):  # not written yet
        return CameraHealth(camera=camera.name, state=STARTING, restarts=restarts)
    silent = bool(state["message"]) or (quiet_s is not None and quiet_s > SILENT_S)
    found = SILENT if silent else STARTING if quiet_s is None else RUNNING
    return CameraHealth(camera=camera.name, state=found, restarts=restarts, **measured)
