"""An MQTT broker inside this process, for the demo and for experiments; on a vehicle use a real one.

amqtt, MQTT 3.1.1, only on the loopback interface, open to every process of this machine.
"""

from __future__ import annotations

import logging
import socket
from types import TracebackType
from typing import Any, Self

from amqtt.broker import Broker


class EmbeddedBroker:
    """`async with EmbeddedBroker() as broker:` serves on `broker.address` (HOST:PORT, a free port).

    `broker.websocket` is the same for browsers, ws://HOST:PORT.
    """

    def __init__(self) -> None:
        self.address = ""
        self.websocket = ""
        self._broker: Any = None

    async def __aenter__(self) -> Self:
        # These libraries log every connection as a warning or worse.
        for name in ("amqtt", "transitions", "websockets"):
            logging.getLogger(name).setLevel(logging.CRITICAL)
        with socket.socket() as probe, socket.socket() as other:
            probe.bind(("127.0.0.1", 0))
            other.bind(("127.0.0.1", 0))
            self.address, place = (f"127.0.0.1:{each.getsockname()[1]}" for each in (probe, other))
            self.websocket = f"ws://{place}"
        self._broker = Broker(
            {
                "listeners": {
                    "default": {"type": "tcp", "bind": self.address},
                    "browsers": {"type": "ws", "bind": place},
                },
                "plugins": {"amqtt.plugins.authentication.AnonymousAuthPlugin": {"allow_anonymous": True}},
            }
        )
        await self._broker.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._broker.shutdown()
