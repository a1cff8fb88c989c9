"""The daemon's end of the control socket (`service.control.clients.api`).

It shares a process with the control loop, which no client may delay. So it does everything in turns, after a control
cycle (`service.turns`), in bounded pieces: some connections accepted, one line of a connection read, one piece of an
answer written, and one request of all begun. A client that wants more waits in the kernel. Connections are limited, of
a process and altogether, and nobody is waited for: neither for the rest of a request nor for the reading of an answer.
Write access to the socket allows moving the vehicle: only its owner and group have read and write permission, and the
credentials of whoever has connected are checked (`service.control.clients.peers`).
"""

from __future__ import annotations

import asyncio
import json
import logging
import os
import socket
import time
from collections.abc import AsyncGenerator, Callable
from contextlib import aclosing, suppress
from itertools import count
from pathlib import Path

from upright.service.control.clients.api import GONE, ApiError, ExitCode, Message, result, temporary
from upright.service.control.clients.peers import check_own, names, peer_of
from upright.service.turns import HANG_UP, MOST_A_TURN, READ, WRITE, Turns
from upright.telemetry.documents import from_json
from upright.telemetry.errors import UprightError

MAX_LINE = 32 << 10
"""Bytes of a request."""

MAX_SIGN = 256
"""Bytes of a further line: a renewal or a release."""

CHUNK = 4096
"""Bytes that are read at once."""

PIECE = 64 << 10
"""Bytes that are written at once."""

MOST_WAITING = 256 << 10
"""Bytes that may wait for a client when a further message is added."""

MOST_CONNECTIONS = 32
MOST_OF_A_PROCESS = 8
"""Connections of all clients, and of one process."""

PATIENCE = 5.0
"""s for a client to complete its request, and to read some of what waits for it."""

Answer = Callable[[Message], AsyncGenerator[Message]]
Sign = Callable[[Message], object]


def _line(message: Message) -> bytes:
    return json.dumps(message).encode() + b"\n"


_BUSY = _line(result(ExitCode.REFUSED, "busy", "Too many connections to the daemon. Close some, or try again."))


class ApiServer:
    """Serves `answer(request)` on a Unix socket until closed, in `turns`.

    If `sign` is given, it gets the requests on a connection after the first line, and the verb GONE when the connection
    ends before its answer. All requests have a `client` that identifies their connection; the sender cannot choose it.
    """

    def __init__(self, path: Path, answer: Answer, sign: Sign | None = None, turns: Turns | None = None) -> None:
        self.refused = 0
        """Connections that were refused: there were too many, or their user is not allowed."""
        self.dropped = 0
        """Connections that were ended because of what the client did, or did not do."""
        self._path = path
        self._answer = answer
        self._sign = sign
        self._turns = turns or Turns()
        self._group = -1
        self._numbers = count(1)
        self._socket: socket.socket | None = None
        self._connections: dict[_Connection, None] = {}
        self._look: asyncio.TimerHandle | None = None
        self._last: tuple[Message, bytes] = ({}, b"")

    def line(self, message: Message) -> bytes:
        """`message` as it is sent. One that is sent to several clients is encoded once."""
        if message is not self._last[0]:
            self._last = message, _line(message)
        return self._last[1]

    def statistics(self) -> dict[str, int]:
        """For `upright status`."""
        return {"connected": len(self._connections), "refused": self.refused, "dropped": self.dropped}

    async def start(self) -> None:
        """Listen. Raises ApiError if another daemon already listens or the folder cannot be written, FolderError if it
        has to be this user's own and is not."""
        try:
            self._path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
            if self._path.parent == temporary():
                check_own(self._path.parent)
            if self._path.exists():
                with socket.socket(socket.AF_UNIX) as probe:
                    try:
                        probe.connect(str(self._path))
                    except OSError:
                        self._path.unlink()
                    else:
                        raise ApiError(
                            f"another daemon serves this vehicle at {self._path}.",
                            remedy="Stop it (systemctl stop upright), or give this one its own --socket.",
                        )
            listening = socket.socket(socket.AF_UNIX)
            try:
                listening.setblocking(False)
                listening.bind(str(self._path))
                self._path.chmod(0o660)
                self._group = self._path.stat().st_gid
                listening.listen()
            except OSError:
                listening.close()
                raise
        except OSError as error:
            raise ApiError(
                f"cannot listen at {self._path}: {error.strerror}.", remedy="Give a writable path with --socket PATH."
            ) from error
        names()
        self._socket = listening
        self._turns.watch(listening.fileno(), READ, self._accept)
        self._look_later()

    async def close(self) -> None:
        """End all connections, after what can be sent at once."""
        if self._socket is None:
            return
        self._turns.forget(self._socket.fileno())
        self._socket.close()
        self._socket = None
        if self._look is not None:
            self._look.cancel()
        answers = [each.answer for each in self._connections if each.answer is not None]
        for connection in list(self._connections):
            connection.write()
            connection.end()
        await asyncio.gather(*answers, return_exceptions=True)
        self._path.unlink(missing_ok=True)

    def _accept(self, events: int) -> None:
        for _ in range(MOST_A_TURN):
            try:
                assert self._socket is not None
                accepted, _ = self._socket.accept()
            except OSError:  # there is none, or no descriptor is left
                return
            accepted.setblocking(False)
            peer = peer_of(accepted)
            if not peer.may_use(os.geteuid(), self._group):
                text = f"user {peer.name} is neither the owner nor in the group of {self._path}."
                self._refuse(accepted, _line(result(ExitCode.REFUSED, "not_allowed", text)))
            elif self._make_room(peer.process):
                client = f"terminal {next(self._numbers)} of {peer.name}"
                self._connections[_Connection(self, accepted, client, peer.process)] = None
            else:
                self._refuse(accepted, _BUSY)

    def _refuse(self, accepted: socket.socket, answer: bytes) -> None:
        self.refused += 1
        with accepted, suppress(OSError):
            accepted.send(answer)

    def _make_room(self, process: int) -> bool:
        """Whether there is room for a connection of `process`. One that has not requested anything yet has to go for
        it, the oldest first."""
        if sum(each.process == process for each in self._connections) >= MOST_OF_A_PROCESS:
            return False
        if len(self._connections) >= MOST_CONNECTIONS:
            idle = next((each for each in self._connections if not each.requested), None)
            if idle is None:
                return False
            self.dropped += 1
            idle.end()
        return True

    def _look_later(self) -> None:
        self._look = asyncio.get_running_loop().call_later(1.0, self._look_for_the_idle)

    def _look_for_the_idle(self) -> None:
        self._look_later()
        limit = time.monotonic() - PATIENCE
        for connection in [each for each in self._connections if each.waits_since < limit]:
            self.dropped += 1
            connection.end()

    # What the connections need

    def begin(self, connection: _Connection, line: bytes) -> None:
        """Answer the request in `line`, when it is its turn."""
        self._turns.queue(lambda: self._begin(connection, line))

    def sign(self, connection: _Connection, message: Message) -> None:
        if self._sign is not None:
            self._sign({**message, "client": connection.client})

    def forget(self, connection: _Connection) -> None:
        self._connections.pop(connection, None)

    @property
    def turns(self) -> Turns:
        return self._turns

    def _begin(self, connection: _Connection, line: bytes) -> None:
        if connection.ended:
            return
        try:
            request = {**parse(line), "client": connection.client}
        except ValueError as error:
            connection.send(result(ExitCode.USAGE, "bad_request", f"Not a request: {error}."))
            connection.finish()
            return
        connection.answer = asyncio.create_task(self._reply(connection, request), name=f"answer {connection.client}")

    async def _reply(self, connection: _Connection, request: Message) -> None:
        try:
            async with aclosing(self._answer(request)) as messages:
                async for message in messages:
                    connection.send(message)
        except UprightError as error:
            connection.send(result(ExitCode.FAILED, "failed", str(error)))
        except ConnectionError:
            pass
        except Exception as error:
            logging.getLogger(__name__).exception("a request failed")
            text = f"internal error: {type(error).__name__}: {error}; the daemon's log has more"
            connection.send(result(ExitCode.FAILED, "internal_error", text))
        connection.finish()


class _Connection:
    """One client: a request, its answer, and signs of life meanwhile."""

    def __init__(self, server: ApiServer, accepted: socket.socket, client: str, process: int) -> None:
        self.client = client
        self.process = process
        self.requested = False
        self.ended = False
        self.waits_since = time.monotonic()
        """Since when the client is awaited, infinite while it is not."""
        self.answer: asyncio.Task[None] | None = None
        self._server = server
        self._socket = accepted
        self._line = b""
        self._waiting = bytearray()
        self._listening = True
        self._finished = False
        self._watch()

    def send(self, message: Message) -> None:
        """Send one line of the answer, in the next turns. A client that does not read them is disconnected."""
        if self.ended:
            return
        if len(self._waiting) > MOST_WAITING:
            self._drop()
            return
        if not self._waiting:
            self.waits_since = time.monotonic()
        self._waiting += self._server.line(message)
        self._watch()

    def finish(self) -> None:
        """The answer is complete: end the connection when it has been sent."""
        self._finished = True
        if not self._waiting:
            self.end()

    def end(self) -> None:
        """Close it. If the answer is not complete, the client has gone, or is treated as if it had."""
        if self.ended:
            return
        self.ended = True
        self._server.turns.forget(self._socket.fileno())
        self._server.forget(self)
        self._socket.close()
        if not self._finished:
            self._gone()
        if self.answer is not None:
            self.answer.cancel()

    def write(self) -> None:
        """Send a piece of what waits."""
        try:
            sent = self._socket.send(self._waiting[:PIECE])
        except BlockingIOError:
            return
        except OSError:
            self.end()
            return
        del self._waiting[:sent]
        self.waits_since = time.monotonic() if self._waiting else float("inf")
        if not self._waiting and self._finished:
            self.end()
        else:
            self._watch()

    def _watch(self) -> None:
        events = (READ if self._listening else 0) | (WRITE if self._waiting else 0)
        self._server.turns.watch(self._socket.fileno(), events, self._serve)

    def _serve(self, events: int) -> None:
        if events & WRITE and self._waiting:
            self.write()
        if events & READ and not self.ended:
            self._read()
        elif events & HANG_UP:
            self.end()

    def _read(self) -> None:
        """Take the rest of one line, or a chunk of it. What comes after it stays in the kernel."""
        try:
            most = MAX_SIGN if self.requested else CHUNK
            there = self._socket.recv(most, socket.MSG_PEEK)
            end = there.find(b"\n") + 1
            self._line += self._socket.recv(end or most)
        except BlockingIOError:
            return
        except OSError:
            self.end()
            return
        if not there:
            self._stop_listening()
        elif len(self._line) > (MAX_SIGN if self.requested else MAX_LINE):
            self._drop()
        elif end:
            line, self._line = self._line, b""
            self._take(line)

    def _take(self, line: bytes) -> None:
        if not self.requested:
            self.requested = True
            self.waits_since = float("inf")
            self._server.begin(self, line)
            return
        try:
            message = parse(line)
        except ValueError:
            self._drop()
        else:
            self._server.sign(self, message)

    def _stop_listening(self) -> None:
        """The client sends nothing more, but may still read."""
        self._listening = False
        if not self.requested:
            self.end()
            return
        self._gone()
        self._watch()

    def _gone(self) -> None:
        if self.requested:
            self._server.sign(self, {"verb": GONE})

    def _drop(self) -> None:
        self._server.dropped += 1
        self.end()


def parse(line: bytes) -> Message:
    """The request in `line`. Raises ValueError if it is not one."""
    request = from_json(line)
    if not isinstance(request, dict) or not isinstance(request.get("verb"), str):
        raise ValueError("a request is an object with a verb")
    return request
