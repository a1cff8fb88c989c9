"""Commands over MQTT on their way to the control process, and the replies on their way back.

What the gate refuses is answered here; a repetition gets the reply that the first one got. Nothing is kept for long.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from service.mqtt.commands import CommandGate, Passed

MOST_REPLIES = 64
"""Replies that are remembered for repetitions."""


class CommandInbox:
    """`forward(command)` hands a command to control and says whether that took it; `publish(topic, reply)` answers;
    `clock()` is Unix seconds."""

    def __init__(
        self,
        forward: Callable[[dict[str, Any]], bool],
        publish: Callable[[str, dict[str, Any]], None],
        clock: Callable[[], float],
    ) -> None:
        self.gate = CommandGate()
        self._forward = forward
        self._publish = publish
        self._clock = clock
        self._replies: OrderedDict[tuple[str, str], dict[str, Any]] = OrderedDict()

    def take(self, verb: str, payload: bytes, retained: bool) -> None:
        """What came on cmd/`verb`."""
        found = self.gate.judge(verb, payload, retained=retained, now=self._clock())
        if isinstance(found, Passed):
            command = {"verb": verb, "client": found.client, "id": found.id, "arguments": found.arguments}
            if not self._forward(command):
                self._answer(found.client, found.id, "unreachable", "The control process does not listen.")
            return
        before = self._replies.get((found.client, found.id)) if found.again else None
        if before is not None:
            self._publish(f"reply/{found.client}", before)
        elif found.client and not found.again:
            self._answer(found.client, found.id, found.code, found.text)

    def reply(self, client: str, reply: dict[str, Any]) -> None:
        """What control answers."""
        self._replies[client, reply["id"]] = reply
        if len(self._replies) > MOST_REPLIES:
            self._replies.popitem(last=False)
        self._publish(f"reply/{client}", reply)

    def _answer(self, client: str, identity: str, code: str, text: str) -> None:
        self._publish(f"reply/{client}", {"id": identity, "ok": False, "code": code, "text": text, "done": True})
