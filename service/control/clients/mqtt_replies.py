"""Answer commands received by MQTT, with the same command layer as for the terminal.

A reply is `{"id", "ok", "code", "text", "done"}`. An experiment is answered twice: `accepted`, not done, when it has
started, and done when it has ended. A renewal is answered only if it is refused: it comes many times a second.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from contextlib import aclosing
from typing import Any

from upright.service.control.clients.api import ExitCode, Message, result
from upright.service.control.clients.commands import Commands
from upright.telemetry.errors import UprightError

MOST_RUNNING = 16
"""Maximum number of commands that are answered concurrently. A stop always is: the gate limits their number."""

SUMMARY = ("recording", "interlocks")
"""Keys of a result that are included in a reply."""


class MqttReplies:
    """Takes commands and passes each reply to `send(client, reply)`. For use in a running event loop."""

    def __init__(self, commands: Commands, send: Callable[[str, dict[str, Any]], None]) -> None:
        self._commands = commands
        self._send = send
        self._running: set[asyncio.Task[None]] = set()

    def take(self, command: dict[str, Any]) -> None:
        """Take a command that the observer forwards: `verb`, `client`, `id`, `arguments`. Neither waits nor fails."""
        client, identity = command["client"], command["id"]
        request: Message = {**command["arguments"], "verb": command["verb"], "client": f"mqtt {client}"}
        if request["verb"] in ("renew", "release"):
            answer = self._commands.sign(request)
            if answer["exit_code"] or request["verb"] == "release":
                self._send(client, _reply(identity, answer))
            return
        if len(self._running) >= MOST_RUNNING and request["verb"] != "stop":
            self._send(
                client, {"id": identity, "ok": False, "code": "busy", "text": "Too many commands.", "done": True}
            )
            return
        task = asyncio.create_task(self._answer(request, client, identity), name=f"answer {client}")
        self._running.add(task)
        task.add_done_callback(self._running.discard)

    async def _answer(self, request: Message, client: str, identity: str) -> None:
        accepted = False
        try:
            async with aclosing(self._commands.answer(request)) as messages:
                async for message in messages:
                    if message["type"] == "result":
                        self._send(client, _reply(identity, message))
                    elif not accepted:
                        accepted = True
                        self._send(client, {"id": identity, "ok": True, "code": "accepted", "text": "", "done": False})
        except UprightError as error:
            self._send(client, _reply(identity, result(ExitCode.FAILED, "failed", str(error))))


def _reply(identity: str, answer: Message) -> dict[str, Any]:
    done = answer["exit_code"] == ExitCode.DONE
    return {
        "id": identity,
        "ok": done,
        "code": answer["code"] or ("done" if done else "failed"),
        "text": answer["text"],
        "done": True,
        **{key: answer[key] for key in SUMMARY if answer.get(key)},
    }
