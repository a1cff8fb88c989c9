"""MQTT in a thread of its own, so that commands and lease renewals are processed while the observer's loop is busy.

The estimators run in the observer's event loop, and sometimes process all cycles again, which takes the better part of
a second on a busy machine; a lease of 0.3 s would expire. Compiled kernels let other threads run meanwhile. Published
data may wait; commands must not.
"""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterable
from typing import Any

from upright.service.beside import beside
from upright.service.mqtt.client import MqttConfig, MqttPublisher
from upright.service.mqtt.command_inbox import CommandInbox


class MqttThread:
    """Publishes for one vehicle, and passes its commands to `forward`, which is called in the thread.

    It starts at once, in a running event loop. `ended` is done when the thread has ended, with its exception if it
    failed. The methods are for the thread that created it, and neither wait nor fail.
    """

    def __init__(
        self,
        config: MqttConfig,
        forward: Callable[[dict[str, Any]], bool],
        announced: Iterable[tuple[str, Any]] = (),
    ) -> None:
        self._loop = asyncio.new_event_loop()
        self._publisher = MqttPublisher(config, self._take, announced)
        self._inbox = CommandInbox(forward, self._publisher.publish, time.time)
        self.ended = beside(self._work, "mqtt")

    def close(self) -> None:
        """Send the last messages and end; allow `service.mqtt.client.GOODBYE_TIME` for it."""
        self._call(self._publisher.close)

    def retain(self, name: str, document: Any) -> None:
        """Publish the new value of a retained topic."""
        self._call(self._publisher.retain, name, document)

    def publish(self, name: str, document: Any) -> None:
        """Publish a message of a topic that is not retained."""
        self._call(self._publisher.publish, name, document)

    def telemetry(self, payload: bytes) -> None:
        """Publish one batch."""
        self._call(self._publisher.telemetry, payload)

    def reply(self, client: str, reply: dict[str, Any]) -> None:
        """Publish the reply of control to a command."""
        self._call(self._inbox.reply, client, reply)

    def summary(self) -> dict[str, Any]:
        """For `upright status`."""
        return {**self._publisher.summary(), "commands": dict(self._inbox.gate.counts)}

    def _take(self, user: str, verb: str, payload: bytes, retained: bool) -> None:
        self._inbox.take(user, verb, payload, retained)

    def _work(self) -> None:
        try:
            self._loop.run_until_complete(self._publisher.run())
        finally:
            self._loop.close()

    def _call(self, what: Callable[..., None], *arguments: Any) -> None:
        with contextlib.suppress(RuntimeError):  # the thread has ended
            self._loop.call_soon_threadsafe(what, *arguments)
