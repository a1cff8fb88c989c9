"""A viewer for the tests: a client of Foxglove's WebSocket protocol, whose ROS messages rosbags decodes."""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from functools import cache
from typing import Any

from websockets.asyncio.client import ClientConnection, connect

from upright.telemetry.formats.ros_messages import ros2
from upright.telemetry.formats.topics import Decode

PROTOCOL = "foxglove.sdk.v1"
MESSAGE = struct.Struct("<BIQ")
"""Opcode 1, subscription, log time in ns; the message follows."""


@dataclass
class Viewer:
    """What the server has said. `messages` are (log time in ns, content) by topic."""

    socket: ClientConnection
    info: dict[str, Any] = field(default_factory=dict)
    topics: dict[str, dict[str, Any]] = field(default_factory=dict)
    refusals: list[str] = field(default_factory=list)
    messages: dict[str, list[tuple[int, Any]]] = field(default_factory=dict)

    async def watch(self, *names: str) -> None:
        """Subscribe to topics once they are there."""
        await self.until(lambda: set(names) <= set(self.topics))
        wanted = [{"id": self.topics[name]["id"], "channelId": self.topics[name]["id"]} for name in names]
        await self.send(op="subscribe", subscriptions=wanted)
        await (await self.socket.ping())  # nothing else confirms it

    async def send(self, **message: Any) -> None:
        await self.socket.send(json.dumps(message))

    async def until(self, what: Any, seconds: float = 40.0) -> None:
        """Receive until `what()` is true."""
        async with asyncio.timeout(seconds):
            while not what():
                self._take(await self.socket.recv())

    def received(self, topic: str) -> list[tuple[int, Any]]:
        return self.messages.get(topic, [])

    def _take(self, message: str | bytes) -> None:
        if isinstance(message, str):
            document = json.loads(message)
            match document["op"]:
                case "serverInfo":
                    self.info = document
                case "advertise":
                    self.topics |= {channel["topic"]: channel for channel in document["channels"]}
                case "status" | "serviceCallFailure":
                    self.refusals.append(document["message"])
            return
        opcode, subscription, time_ns = MESSAGE.unpack_from(message)
        assert opcode == 1
        channel = next(each for each in self.topics.values() if each["id"] == subscription)
        self.messages.setdefault(channel["topic"], []).append((time_ns, _content(channel, message[MESSAGE.size :])))


def _content(channel: dict[str, Any], data: bytes) -> Any:
    """The decoded message; one that is not of ROS as its bytes."""
    if channel["encoding"] != "cdr":
        return data
    return _decoder(channel["schema"], channel["schemaName"])(data)


@cache
def _decoder(definition: str, name: str) -> Decode:
    decode = ros2(definition, name)
    assert not isinstance(decode, str), decode
    return decode


@asynccontextmanager
async def viewer(port: int, seconds: float = 40.0) -> AsyncIterator[Viewer]:
    """A viewer that is connected to the server at `port`, once it is there."""
    async with asyncio.timeout(seconds):
        while True:
            try:
                socket = await connect(f"ws://127.0.0.1:{port}", subprotocols=[PROTOCOL], max_queue=None)  # type: ignore[list-item]
                break
            except OSError:
                await asyncio.sleep(0.05)
    async with socket:
        yield Viewer(socket)
