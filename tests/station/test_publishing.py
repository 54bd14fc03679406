"""What a station publishes: HTTP API, page and metrics by a real server, messages by a real broker."""

import json
import shutil
import socket
import subprocess
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

pytest.importorskip("fastapi")
pytest.importorskip("paho.mqtt")

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from skope.camera.model import Camera
from skope.errors import UserError
from skope.files.json_files import write_json
from skope.keypoints import SKOPE33
from skope.schema import Image
from skope.site.gates_zones_lanes import Gate
from skope.station.check import check_broker, check_port
from skope.station.database import Database
from skope.station.health import RUNNING, SILENT, STARTING, CameraHealth, health_of
from skope.station.http_api import HttpServer, make_app, metrics_text
from skope.station.latest_picture import LatestPicture
from skope.station.mqtt import MqttPublisher
from skope.station.page import observed_minutes, totals
from skope.station.station_file import HttpAddress, MqttBroker, StationCamera, read_station
from skope.station.watch_stream import StreamState
from skope.terminal.console import Console
from tests.station.test_station import SITE, STATION, record
from tests.waiting import HANG_S, until

Skope = Callable[..., tuple[int, str, str]]
HEALTH = CameraHealth(camera="north", state=RUNNING, last_frame="2026-11-27T10:00:00+00:00", rate=9.9, skipped=0.02)


@pytest.fixture
def database(skope: Skope) -> Database:
    """The database of a station with one camera that was measured on two days."""
    Path("site.toml").write_text(SITE)
    Path("station.toml").write_text(STATION.format(address="sqlite:///traffic.db"))
    record("north/a", "2026-11-26T10:00:00+01:00", 7)
    record("north/c", "2026-11-27T00:30:00+01:00", 2)
    assert skope("eval", "station", "station.toml", "--once")[0] == 0
    return Database.open(read_station(Path("station.toml")).database)


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as server:
        return int(server.getsockname()[1])


@pytest.fixture
def served(database: Database) -> Iterator[str]:
    """The address of the API of the station; it requires a token."""
    address = HttpAddress(port=free_port(), token="secret")
    cameras = [replace(camera, picture="blurred") for camera in read_station(Path("station.toml")).cameras]
    server = HttpServer(make_app(cameras, database, lambda: [HEALTH], address.token), address)
    try:
        yield f"http://127.0.0.1:{address.port}"
    finally:
        server.close()


def get(address: str, token: str = "secret") -> tuple[int, str]:
    request = urllib.request.Request(address, headers={"Authorization": f"Bearer {token}"} if token else {})

    def answered() -> tuple[int, str] | None:
        try:
            with urllib.request.urlopen(request, timeout=HANG_S) as answer:
                return answer.status, answer.read().decode()
        except urllib.error.HTTPError as error:
            return error.code, error.read().decode()
        except urllib.error.URLError:  # it is still starting
            return None

    return until(answered)


def test_the_api_has_the_rows_of_the_database(served: str, database: Database) -> None:
    assert json.loads(get(f"{served}/api/cameras")[1]) == [HEALTH.to_dict()]
    days = json.loads(get(f"{served}/api/cameras/north/days")[1])
    assert [row["day"] for row in days] == ["2026-11-27", "2026-11-26"]
    events = json.loads(get(f"{served}/api/cameras/north/days/2026-11-26/events")[1])
    known = database.rows("events", "north", datetime(2026, 11, 26, tzinfo=UTC).date())
    assert len(events) == 7
    assert [row["track"] for row in events] == [row["track"] for row in known]
    assert datetime.fromisoformat(events[0]["time"]) == known[0]["time"]
    part = json.loads(get(f"{served}/api/cameras/north/days/2026-11-26/events?first=2&limit=3")[1])
    assert part == events[2:5]


@pytest.mark.parametrize(
    ("path", "code"),
    [
        ("/api/cameras/south/days", 404),
        ("/api/cameras/north/days/2026-11-26/days", 422),
        ("/api/cameras/north/days/yesterday/counts", 422),
        ("/api/cameras/north/days/2026-11-26/counts?limit=0", 422),
        ("/api/cameras/..%2f..%2fetc/days", 404),
        ("/nothing", 404),
    ],
)
def test_wrong_requests_are_rejected(served: str, path: str, code: int) -> None:
    assert get(served + path)[0] == code


@pytest.mark.parametrize("path", ["/api/cameras", "/", "/metrics", "/openapi.json"])
def test_without_the_token_nothing_is_told(served: str, path: str) -> None:
    for token in ("", "secre", "secret2"):
        assert get(served + path, token)[0] == 401
    assert get(f"{served}{path}?token=%C3%BC", "")[0] == 401
    assert get(f"{served}{path}?token=secret", "")[0] == 200


def test_the_api_only_reads(served: str) -> None:
    described = json.loads(get(f"{served}/openapi.json")[1])
    assert {method for path in described["paths"].values() for method in path} == {"get"}
    request = urllib.request.Request(f"{served}/api/cameras", method="POST", headers={"Authorization": "Bearer secret"})
    with pytest.raises(urllib.error.HTTPError) as error:
        urllib.request.urlopen(request, timeout=HANG_S)
    assert error.value.code == 405


def test_the_page_shows_counts_and_escapes_names(served: str) -> None:
    code, page = get(f"{served}/")
    assert code == 200
    assert "Counts of 2026-11-27" in page
    assert "west, in" in page
    assert "2026-11-26" in page
    assert "of its counting intervals are observed" in page


def test_a_gone_database_is_an_error_not_a_crash(served: str) -> None:
    Path("traffic.db").rename("elsewhere.db")
    Path("traffic.db").mkdir()
    code, text = get(f"{served}/api/cameras/north/days")
    assert code in (200, 503)  # an open connection may still read the file
    if code == 503:
        assert "database" in text


def test_a_picture_is_there_when_it_was_written(served: str) -> None:
    assert get(f"{served}/api/cameras/north/picture")[0] == 404
    assert "<img" not in get(f"{served}/")[1]
    path = read_station(Path("station.toml")).cameras[0].latest_picture
    gate = Gate(name="west", line=((10.0, -6.0), (10.0, 6.0)))
    camera = Camera.looking([0, 0, 6.0], yaw=0.0, pitch_down=0.3, size=(320, 180), fov=1.0)
    picture = LatestPicture(path, [gate], blur=True)
    frame = np.full((180, 320, 3), 90, np.uint8)
    list(picture.watch(iter([(Image(id=1, file_name="a", width=320, height=180), frame)])))
    path.parent.mkdir(parents=True)
    picture.write([], camera, SKOPE33)
    request = urllib.request.Request(f"{served}/api/cameras/north/picture?token=secret")
    with urllib.request.urlopen(request, timeout=HANG_S) as answer:
        shown = cv2.imdecode(np.frombuffer(answer.read(), np.uint8), cv2.IMREAD_COLOR)
    ends = camera.project(np.array([[10.0, -6.0, 0.0], [10.0, 6.0, 0.0]]))[0]
    middle = ends.mean(axis=0).round().astype(int)
    shown = shown[-180:]  # below the time
    assert shown[middle[1], middle[0]].tolist() == pytest.approx([0, 220, 255], abs=40)
    assert shown[20, 160].tolist() == pytest.approx([90, 90, 90], abs=6)
    assert 'src="/api/cameras/north/picture?token=secret"' in get(f"{served}/?token=secret", "")[1]


def test_metrics_are_those_of_prometheus() -> None:
    from prometheus_client.parser import text_string_to_metric_families

    odd = replace(HEALTH, camera='a"b\\c', state=SILENT, rate=None)
    found = {
        (sample.name, *sorted(sample.labels.items())): sample.value
        for family in text_string_to_metric_families(metrics_text([HEALTH, odd]))
        for sample in family.samples
    }
    assert found["skope_frames_per_second", ("camera", "north")] == 9.9
    assert ("skope_frames_per_second", ("camera", odd.camera)) not in found
    assert found["skope_camera_state", ("camera", odd.camera), ("state", SILENT)] == 1
    assert found["skope_camera_state", ("camera", odd.camera), ("state", RUNNING)] == 0


def test_what_was_not_observed_is_not_zero() -> None:
    row = {"lane": "all", "gate": "g", "direction": "in", "class": "car", "begin_s": 0.0, "end_s": 60.0}
    rows = [
        {**row, "count": None, "observed_s": 0.0},
        {**row, "begin_s": 60.0, "end_s": 120.0, "count": 3, "observed_s": 30.0},
    ]
    assert totals(rows[:1]) == {("g", "in"): {"car": None}}
    assert totals(rows) == {("g", "in"): {"car": 3}}
    assert observed_minutes([*rows, *rows]) == "0 of 2 min"
    assert observed_minutes([{**row, "observed_s": 59.0}]) == "1 of 1 min"
    assert observed_minutes([]) == "0 of 0 min"


# --------------------------------------------------------------------------------------------------------------- health


def camera_at(folder: Path) -> StationCamera:
    (folder / "site.toml").write_text(SITE)
    (folder / "station.toml").write_text(STATION.format(address="sqlite:///traffic.db"))
    read = read_station(folder / "station.toml").cameras[0]
    return replace(read, stream="rtsp://camera", folder=folder)


def test_a_camera_without_frames_is_silent(tmp_path: Path) -> None:
    camera, now = camera_at(tmp_path), datetime(2026, 11, 27, 10, tzinfo=UTC)
    assert health_of(camera, now=now).state == STARTING
    for last_s, message, wanted in ((3, "", RUNNING), (60, "", SILENT), (3, "broke off", SILENT)):
        last = datetime.fromtimestamp(now.timestamp() - last_s, UTC)
        write_json(camera.state, StreamState(updated=now, last_frame=last, rate=10.0, message=message).to_dict())
        found = health_of(camera, now=now)
        assert (found.state, found.message) == (wanted, message)
    camera.state.write_text("{")
    assert health_of(camera, now=now).state == STARTING


# ----------------------------------------------------------------------------------------------------------------- MQTT


def is_open(port: int) -> bool:
    """Whether a program of this machine accepts connections at a port."""
    with socket.socket() as line:
        return line.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture(scope="module")
def broker() -> Iterator[MqttBroker]:
    """A Mosquitto broker that runs for these tests."""
    program = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")
    if not program:
        pytest.skip("Mosquitto was not found")
    port = free_port()
    with subprocess.Popen([program, "-p", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as run:
        try:
            until(lambda: is_open(port))
            yield MqttBroker(host="127.0.0.1", port=port, topic="roads/a1")
        finally:
            run.terminate()


def heard(broker: MqttBroker, count: int, wait_s: float = HANG_S) -> dict[str, Any]:
    """Retained messages of a broker, by topic, as soon as there are `count`, or after a time."""
    found: dict[str, Any] = {}
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    client.on_message = lambda _client, _data, message: found.update({message.topic: message.payload.decode()})
    client.connect(broker.host, broker.port)
    client.subscribe("#", qos=1)
    end = time.monotonic() + wait_s
    while len(found) < count and time.monotonic() < end:
        client.loop(0.1)
    client.disconnect()
    return found


def test_the_broker_has_health_and_counts(database: Database, broker: MqttBroker) -> None:
    publisher = MqttPublisher(broker, database, Console())

    def published() -> dict[str, Any] | None:
        publisher.publish([HEALTH])
        found = heard(broker, 3, 0.5)
        return found if len(found) == 3 else None

    found = until(published)
    assert found["roads/a1/station"] == "online"
    assert json.loads(found["roads/a1/north/health"]) == HEALTH.to_dict()
    counts = json.loads(found["roads/a1/north/counts"])
    assert counts["day"] == "2026-11-27"
    known = database.rows("counts", "north", datetime(2026, 11, 27, tzinfo=UTC).date())
    assert [row["count"] for row in counts["rows"]] == [row["count"] for row in known]
    publisher.close()
    assert heard(broker, 3)["roads/a1/station"] == "offline"


def test_a_broker_that_is_gone_delays_nothing(database: Database) -> None:
    gone = MqttBroker(host="127.0.0.1", port=free_port())
    publisher = MqttPublisher(gone, database, Console())
    begun = time.monotonic()
    publisher.publish([HEALTH])
    assert time.monotonic() - begun < 1
    publisher.close()
    with pytest.raises(UserError, match="cannot be reached"):
        check_broker(gone)


def test_the_check_finds_the_broker(broker: MqttBroker) -> None:
    assert "topic roads/a1" in check_broker(broker)


# ------------------------------------------------------------------------------------------------------------ files

STREAMS = """
[[cameras]]
name = "south"
site = "traffic.toml"
stream = "rtsp://camera/stream"
"""


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[http]\nhost = "0.0.0.0"\n', "http.token: missing"),
        ("[http]\nport = 70000\n", "http.port: expected"),
        ('[mqtt]\nhost = "broker"\ntopic = "a/#"\n', "mqtt.topic: expected"),
        ("[mqtt]\nport = 1883\n", "mqtt.host: missing"),
        (STREAMS + 'tracks = "south"\n', "cameras[1]: expected one of stream, videos and tracks"),
        (STREAMS.replace("rtsp://camera/stream", "camera"), "cameras[1].stream: expected an address"),
        (STREAMS.replace("traffic.toml", "site.toml"), "has no camera"),
        (STREAMS.replace("traffic.toml", "bare.toml"), "bare.toml has no gates, zones or lanes"),
        (STREAMS.replace("traffic.toml", "none.toml"), "cameras[1].site: none.toml: no such file"),
        (STREAMS + 'detector = "road99"\n', "cameras[1].detector: expected auto, road33, road33-lite or a file"),
    ],
)
def test_a_wrong_station_file_is_one_line(skope: Skope, text: str, said: str) -> None:
    Path("site.toml").write_text(SITE)
    shutil.copy(EXAMPLE / "camera.yml", "camera.yml")
    Path("traffic.toml").write_text('[camera]\nfile = "camera.yml"\n' + SITE.replace('time_zone = "Europe/Berlin"', ""))
    Path("bare.toml").write_text('[camera]\nfile = "camera.yml"\n')
    Path("station.toml").write_text(STATION.format(address="sqlite:///traffic.db") + text)
    code, _, err = skope("eval", "station", "station.toml", "--once")
    assert (code, err.count("\n")) == (2, 1)
    assert said in err


EXAMPLE = Path(__file__).parents[2] / "examples" / "own_road"


def test_a_port_in_use_is_one_line(database: Database) -> None:
    with socket.create_server(("127.0.0.1", 0)) as held:
        address = HttpAddress(port=held.getsockname()[1])
        for attempt in (lambda: HttpServer(make_app([], database, list), address), lambda: check_port(address)):
            with pytest.raises(UserError, match=f"http: 127.0.0.1:{address.port}: Address already in use"):
                attempt()
