"""Forward commands from MQTT to the control process, and the replies back.

Commands that the gate refuses are answered here; a repetition gets the reply to the first one. Memory is bounded.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from typing import Any

from upright.service.mqtt.commands import CommandGate, Passed

MOST_REPLIES = 64
"""Number of replies that are kept for repetitions."""


class CommandInbox:
    """`forward(command)` passes a command to control and returns whether it was accepted; `publish(topic, reply)`
    answers; `clock()` is Unix seconds."""

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

    def take(self, user: str, verb: str, payload: bytes, retained: bool) -> None:
        """Take a message on cmd/`user`/`verb`."""
        found = self.gate.judge(user, verb, payload, retained=retained, now=self._clock())
        if isinstance(found, Passed):
            command = {"verb": verb, "client": found.client, "id": found.id, "arguments": found.arguments}
            if not self._forward(command):
                self._answer(found.client, found.id, "unreachable", "The control process cannot be reached.")
            return
        before = self._replies.get((found.client, found.id)) if found.again else None
        if before is not None:
            self._publish(f"reply/{found.client}", before)
        elif found.client and not found.again:
            self._answer(found.client, found.id, found.code, found.text)

    def reply(self, client: str, reply: dict[str, Any]) -> None:
        """Publish the reply of control."""
        self._replies[client, reply["id"]] = reply
        if len(self._replies) > MOST_REPLIES:
            self._replies.popitem(last=False)
        self._publish(f"reply/{client}", reply)

    def _answer(self, client: str, identity: str, code: str, text: str) -> None:
        self._publish(f"reply/{client}", {"id": identity, "ok": False, "code": code, "text": text, "done": True})
