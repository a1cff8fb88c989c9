"""An MQTT broker inside this process, for the demo and for experiments; on a vehicle use a real one.

amqtt, MQTT 3.1.1, only on the loopback interface. Every process of this machine, and so every page in a browser, can
read; commands are taken only from who knows the password.
"""

from __future__ import annotations

import hmac
import logging
import secrets
import socket
from dataclasses import dataclass
from types import TracebackType
from typing import Any, Self

from amqtt.broker import Broker
from amqtt.contexts import Action
from amqtt.plugins.base import BaseAuthPlugin, BaseTopicPlugin
from amqtt.session import Session

USER = "dashboard"


class EmbeddedBroker:
    """`async with EmbeddedBroker() as broker:` serves on `broker.address` (HOST:PORT, a free port).

    `broker.websocket` is the same for browsers, ws://HOST:PORT. Commands need USER and `broker.password`.
    """

    def __init__(self) -> None:
        self.password = secrets.token_urlsafe(24)
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
                "plugins": {
                    f"{__name__}.{plugin.__name__}": {"password": self.password} for plugin in (Login, CommandRights)
                },
            }
        )
        await self._broker.start()
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._broker.shutdown()


@dataclass
class _Config:
    """Of both plugins of amqtt."""

    password: str


class Login(BaseAuthPlugin):  # type: ignore[misc]
    """Lets everybody in, but USER with the password only. A last will is checked here, since amqtt publishes it as it
    is."""

    Config = _Config

    async def authenticate(self, *, session: Session) -> bool:
        known = _is_user(session, self.config.password)
        return known or not (session.username == USER or _is_command(session.will_topic))


class CommandRights(BaseTopicPlugin):  # type: ignore[misc]
    """Lets USER alone publish below `cmd`."""

    Config = _Config

    async def topic_filtering(
        self, *, session: Session | None = None, topic: str | None = None, action: Action | None = None
    ) -> bool | None:
        if action is not Action.PUBLISH or session is None or not _is_command(topic):
            return True
        return _is_user(session, self.config.password)


def _is_command(topic: str | None) -> bool:
    return "cmd" in (topic or "").split("/")


def _is_user(session: Session, password: str) -> bool:
    given = hmac.compare_digest((session.password or "").encode(), password.encode())
    return given and session.username == USER
