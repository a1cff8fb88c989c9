"""MQTT: publishes the vehicle's data at a broker, and works on without one.

Topics, under BASE/VEHICLE: `status` (online/offline, with last will), `state`, `parameters`, `methods` and `diagnosis`
retained, `telemetry` batches, `progress`, `event` and replies. `cmd/+/+` is subscribed to if commands are enabled, and
its messages are forwarded unread (`service.mqtt.command_inbox`). Publishing only queues a message; one task
communicates with the broker, and reconnects by itself. Of a retained topic only the latest message is kept; the others
wait in bounded queues, and messages that do not fit are dropped and counted.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import ssl
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import aiomqtt

from upright.telemetry.errors import UprightError

FIRST_RETRY, LONGEST_RETRY = 0.25, 10.0
"""s before the first and between later attempts to reach the broker; doubled each time."""

ANSWER_TIME = 5.0
"""Timeout of an answer by the broker, s."""

KEEPALIVE = 10
"""s: after one and a half times this without a message the broker publishes the last will."""

GOODBYE_TIME = 2.0
"""Time limit for the last messages when the process ends, s."""

MOST_TELEMETRY = 60
MOST_EVENTS = 200
"""Maximum number of messages that wait for the broker; the oldest are dropped."""

RETAINED = ("state", "parameters", "methods", "diagnosis", "commissioning")
"""Topics whose last message the broker keeps, besides `status`."""

MOST_COMMANDS = 200
"""Maximum number of commands that wait to be processed; further ones are lost."""

OnCommand = Callable[[str, str, bytes, bool], None]
"""Called with user, verb, payload, and whether it was retained."""


class MqttConfigError(UprightError):
    """The broker's address or password cannot be used."""


@dataclass(frozen=True, slots=True)
class MqttConfig:
    """Where to publish. `topic` is BASE/VEHICLE; `client_id` identifies the session, one per vehicle, so that a new one
    ends an old one that hangs (and its last will comes before our `online`)."""

    host: str
    port: int
    topic: str
    client_id: str
    username: str | None = None
    password: str | None = field(default=None, repr=False)
    tls: ssl.SSLContext | None = None
    commands: bool = False

    @classmethod
    def of(cls, section: dict[str, Any], vehicle: str) -> MqttConfig | None:
        """From the vehicle file's section [mqtt]; None if no broker is given. Raises MqttConfigError."""
        if not section["broker"]:
            return None
        host, _, port = section["broker"].rpartition(":")
        if not 0 < int(port) < 65536:
            raise MqttConfigError(f"mqtt.broker: there is no port {port}.", remedy="The standard port is 1883.")
        password = None
        if section["password_file"]:
            try:
                password = Path(section["password_file"]).read_text(encoding="utf-8").partition("\n")[0]
            except OSError as error:
                raise MqttConfigError(
                    f"mqtt.password_file {section['password_file']}: {error.strerror}.",
                    remedy="Give a file that the service may read, with the password in its first line.",
                ) from error
        return cls(
            host=host,
            port=int(port),
            topic=f"{section['base']}/{vehicle}",
            client_id=f"upright-{vehicle}",
            username=section["username"] or None,
            password=password,
            tls=_tls(section["ca_file"]) if section["tls"] else None,
            commands=section["commands"],
        )


def _tls(ca_file: str) -> ssl.SSLContext:
    """A context that checks the broker's certificate and host name. Raises MqttConfigError."""
    try:
        return ssl.create_default_context(cafile=ca_file or None)
    except (OSError, ssl.SSLError) as error:
        raise MqttConfigError(
            f"mqtt.ca_file {ca_file}: {error.strerror or error}.",
            remedy="Give a PEM file that the service may read, with the CA certificate that signed the broker's.",
        ) from error


@dataclass(slots=True)
class MqttStatistics:
    """Counts since the start. `trouble` is the reason why there is no connection, empty while there is one."""

    connected: bool = False
    connections: int = 0
    published: int = 0
    dropped: int = 0
    trouble: str = "not connected yet"


class MqttPublisher:
    """Publishes for one vehicle. `run()` is the task that communicates with the broker; other methods neither wait nor
    fail.

    `on_command` gets the messages on cmd/+/+, if the configuration enables commands. `announced` are full topics and
    documents that are retained on each connection.
    """

    def __init__(
        self,
        config: MqttConfig,
        on_command: OnCommand = lambda user, verb, payload, retained: None,
        announced: Iterable[tuple[str, Any]] = (),
    ) -> None:
        self.statistics = MqttStatistics()
        self._config = config
        self._on_command = on_command
        self._announced = [(topic, encode(document)) for topic, document in announced]
        self._retained: dict[str, bytes] = {}
        self._changed: dict[str, None] = {}
        self._telemetry: deque[bytes] = deque()
        self._events: deque[tuple[str, bytes]] = deque()
        self._wake = asyncio.Event()
        self._closing = asyncio.Event()

    def retain(self, name: str, document: Any) -> None:
        """Publish the new value of topic `name`, one of RETAINED."""
        payload = encode(document)
        if self._retained.get(name) != payload:
            self._retained[name] = payload
            self._changed[name] = None
            self._wake.set()

    def telemetry(self, payload: bytes) -> None:
        """Publish one batch; without a broker it is dropped, since old telemetry is useless."""
        if not self.statistics.connected:
            self.statistics.dropped += 1
            return
        if len(self._telemetry) >= MOST_TELEMETRY:
            self._telemetry.popleft()
            self.statistics.dropped += 1
        self._telemetry.append(payload)
        self._wake.set()

    def publish(self, name: str, document: Any) -> None:
        """Publish a message of a topic that is not retained (`progress`, `event`, `reply/CLIENT`). It waits for the
        broker."""
        if len(self._events) >= MOST_EVENTS:
            self._events.popleft()
            self.statistics.dropped += 1
        self._events.append((name, encode(document)))
        self._wake.set()

    async def run(self) -> None:
        """Connect, publish, reconnect, until `close`."""
        retry = FIRST_RETRY
        while not self._closing.is_set():
            try:
                async with self._client() as client:
                    retry = FIRST_RETRY
                    await self._serve(client)
            except (aiomqtt.MqttError, UnicodeError, OSError) as error:  # an invalid host name; a bad certificate
                self.statistics.trouble = str(error) or type(error).__name__
            finally:
                self.statistics.connected = False
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._closing.wait(), retry)
            retry = min(2.0 * retry, LONGEST_RETRY)

    def close(self) -> None:
        """Publish the waiting messages and `offline`, and end `run`; allow `GOODBYE_TIME` for it."""
        self._closing.set()
        self._wake.set()

    def _client(self) -> aiomqtt.Client:
        config = self._config
        return aiomqtt.Client(
            config.host,
            config.port,
            username=config.username,
            password=config.password,
            identifier=config.client_id,
            will=aiomqtt.Will(f"{config.topic}/status", b"offline", qos=1, retain=True),
            timeout=ANSWER_TIME,
            keepalive=KEEPALIVE,
            tls_context=config.tls,
            max_queued_incoming_messages=MOST_COMMANDS,
        )

    async def _serve(self, client: aiomqtt.Client) -> None:
        """Serve while the connection lasts. Raises MqttError when it is lost, even while nothing is published."""
        listening = asyncio.create_task(self._listen(client), name="listen to the broker")
        publishing = asyncio.create_task(self._publish(client), name="publish")
        try:
            await asyncio.wait({listening, publishing}, return_when=asyncio.FIRST_COMPLETED)
        finally:
            listening.cancel()
            publishing.cancel()
            outcomes = await asyncio.gather(listening, publishing, return_exceptions=True)
        for outcome in outcomes:
            if isinstance(outcome, Exception):
                raise outcome

    async def _listen(self, client: aiomqtt.Client) -> None:
        """Forward the messages on cmd/USER/VERB; ends with the connection, even if nothing is subscribed to."""
        prefix = f"{self._config.topic}/cmd/"
        async for message in client.messages:
            topic = str(message.topic)
            user, _, verb = topic.removeprefix(prefix).partition("/")
            if topic.startswith(prefix) and isinstance(message.payload, bytes):
                self._on_command(user, verb, message.payload, bool(message.retain))

    async def _publish(self, client: aiomqtt.Client) -> None:
        statistics, prefix = self.statistics, self._config.topic
        if self._config.commands:
            await client.subscribe(f"{prefix}/cmd/+/+", qos=1)
        await client.publish(f"{prefix}/status", b"online", qos=1, retain=True)
        for topic, payload in self._announced:
            await client.publish(topic, payload, qos=1, retain=True)
        statistics.connected, statistics.trouble = True, ""
        statistics.connections += 1
        self._changed = dict.fromkeys(self._retained)
        statistics.dropped += len(self._telemetry)
        self._telemetry.clear()
        self._wake.set()
        while True:
            await self._wake.wait()
            self._wake.clear()
            while self._changed:
                name = next(iter(self._changed))
                del self._changed[name]
                await client.publish(f"{prefix}/{name}", self._retained[name], qos=1, retain=True)
                statistics.published += 1
            while self._events:
                event = name, payload = self._events.popleft()
                try:
                    await client.publish(f"{prefix}/{name}", payload, qos=1)
                except aiomqtt.MqttError:
                    self._events.appendleft(event)
                    raise
                statistics.published += 1
            while self._telemetry:
                await client.publish(f"{prefix}/telemetry", self._telemetry.popleft())
                statistics.published += 1
            if self._closing.is_set():
                await client.publish(f"{prefix}/status", b"offline", qos=1, retain=True)
                return

    def summary(self) -> dict[str, Any]:
        """For `upright status`."""
        return asdict(self.statistics)


def encode(document: Any) -> bytes:
    """Compact JSON."""
    return json.dumps(document, separators=(",", ":")).encode()
