"""Publish a station to an MQTT broker."""

import json
from collections.abc import Sequence
from typing import Any

import paho.mqtt.client as mqtt
from paho.mqtt.enums import CallbackAPIVersion

from skope.errors import UserError
from skope.station.database import Database
from skope.station.health import CameraHealth
from skope.station.station_file import MqttBroker
from skope.terminal.console import Console


def client_of(broker: MqttBroker) -> mqtt.Client:
    """Return a client with the name and password for a broker, not connected."""
    client = mqtt.Client(CallbackAPIVersion.VERSION2)
    if broker.username:
        client.username_pw_set(broker.username, broker.password or None)
    return client


class MqttPublisher:
    """Publishes the health of cameras and their counts as retained JSON messages.

    The topics are `TOPIC/CAMERA/health` and `TOPIC/CAMERA/counts`. Counts are the rows of the newest measured day. A
    broker that cannot be reached is tried again in the background; nothing waits for it. `TOPIC/station` is "online",
    or "offline" after the connection was lost.
    """

    def __init__(self, broker: MqttBroker, database: Database, console: Console) -> None:
        """Connect in the background."""
        self._broker, self._database, self._console = broker, database, console
        self._published: dict[str, str] = {}
        """Digest of the day whose counts were published, by camera."""
        self._client = client_of(broker)
        self._client.will_set(f"{broker.topic}/station", "offline", qos=1, retain=True)
        self._client.on_connect = self._on_connect
        self._client.max_queued_messages_set(1000)
        self._client.connect_async(broker.host, broker.port)
        self._client.loop_start()

    def _on_connect(self, client: mqtt.Client, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        if reason.is_failure:
            self._console.warn(f"MQTT broker {self._broker.host}:{self._broker.port}: {reason}")
            return
        self._published.clear()
        client.publish(f"{self._broker.topic}/station", "online", qos=1, retain=True)

    def publish(self, health: Sequence[CameraHealth]) -> None:
        """Publish the health of all cameras, and the counts of those whose newest day was measured again."""
        if not self._client.is_connected():
            return
        for camera in health:
            self._send(camera.camera, "health", camera.to_dict())
            try:
                day = next(iter(self._database.days(camera.camera, 1)), None)
                if day and self._published.get(camera.camera) != day["digest"]:
                    rows = self._database.rows("counts", camera.camera, day["day"])
                    self._send(camera.camera, "counts", {"day": day["day"], "measured": day["measured"], "rows": rows})
                    self._published[camera.camera] = day["digest"]
            except UserError:  # the measuring process reports it
                return

    def close(self) -> None:
        """Report the station as offline, and disconnect."""
        if self._client.is_connected():
            self._client.publish(f"{self._broker.topic}/station", "offline", qos=1, retain=True).wait_for_publish(2.0)
        self._client.disconnect()
        self._client.loop_stop()

    def _send(self, camera: str, what: str, value: Any) -> None:
        text = json.dumps(value, default=str, allow_nan=False)
        self._client.publish(f"{self._broker.topic}/{camera}/{what}", text, qos=1, retain=True)
