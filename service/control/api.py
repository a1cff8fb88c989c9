"""The daemon's control socket: a Unix socket with one JSON object per line.

A request is `{"verb": ..., arguments}`. The answer is a stream of lines, each with a `type` (`event`, `progress`,
`estimates`), that ends with one of type `result` with `exit_code` and, if it failed, `code` and `text`.
The client that runs an experiment holds a lease on it and sends `{"verb": "renew"}` on the same connection
periodically. If the connection ends or no renewal comes in time, the experiment ends.
Write access to the socket allows moving the vehicle: only its owner and group have read and write permission.
"""

from __future__ import annotations

import asyncio
import json
import os
import socket
import tempfile
import threading
from collections.abc import AsyncGenerator, Callable, Iterator
from contextlib import aclosing, contextmanager, nullcontext, suppress
from enum import IntEnum
from itertools import count
from pathlib import Path
from typing import Any

from telemetry.errors import UprightError

Message = dict[str, Any]
MAX_LINE = 1 << 16

HELD = ("experiment",)
"""Verbs that need a lease."""

GONE = "gone"
"""The verb with which a transport reports that a client has disconnected."""

RENEWAL_PERIOD = 0.075
"""s between two renewals by a client that holds a lease."""


class ExitCode(IntEnum):
    """Exit codes of the command line, and `exit_code` of a result."""

    DONE = 0
    FAILED = 1
    USAGE = 2
    REFUSED = 3
    VEHICLE_FAULT = 4


class ApiError(UprightError):
    """The daemon cannot be reached, or did not understand the request."""


def socket_candidates(vehicle_id: str) -> list[Path]:
    """The possible paths of the socket of a vehicle's daemon, that of the service first."""
    places = [Path("/run/upright"), Path(tempfile.gettempdir()) / f"upright-{os.getuid()}"]
    for variable in ("XDG_RUNTIME_DIR", "RUNTIME_DIRECTORY"):
        if os.environ.get(variable):
            root = Path(os.environ[variable])
            places.insert(0, root if variable == "RUNTIME_DIRECTORY" else root / "upright")
    return [place / f"{vehicle_id}.sock" for place in places]


def default_socket(vehicle_id: str) -> Path:
    """The socket path of a daemon started here: in systemd's runtime directory, the user's, or one in /tmp."""
    if os.environ.get("RUNTIME_DIRECTORY") or os.environ.get("XDG_RUNTIME_DIR"):
        return socket_candidates(vehicle_id)[0]
    return socket_candidates(vehicle_id)[-1]


class ApiServer:
    """Serves `answer(request)` on a Unix socket until closed.

    If `sign` is given, it gets the requests on a connection after the first line, and the verb GONE when the connection
    ends. All requests then have a `client` that identifies their connection; the sender cannot choose it.
    """

    def __init__(
        self,
        path: Path,
        answer: Callable[[Message], AsyncGenerator[Message]],
        sign: Callable[[Message], object] | None = None,
    ) -> None:
        self._path = path
        self._answer = answer
        self._sign = sign
        self._numbers = count(1)
        self._server: asyncio.Server | None = None
        self._connections: set[asyncio.StreamWriter] = set()

    async def start(self) -> None:
        """Listen. Raises ApiError if another daemon already listens or the folder cannot be written."""
        try:
            self._path.parent.mkdir(mode=0o750, parents=True, exist_ok=True)
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
            self._server = await asyncio.start_unix_server(self._serve, str(self._path), limit=MAX_LINE)
            self._path.chmod(0o660)
        except OSError as error:
            raise ApiError(
                f"cannot listen at {self._path}: {error.strerror}.", remedy="Give a writable path with --socket PATH."
            ) from error

    async def close(self) -> None:
        if self._server is not None:
            self._server.close()
            for writer in list(self._connections):
                writer.close()
            await self._server.wait_closed()
            self._path.unlink(missing_ok=True)
            self._server = None

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._connections.add(writer)
        client = f"terminal {next(self._numbers)}"
        listening: asyncio.Task[None] | None = None
        try:
            line = await reader.readline()
            if not line:
                return
            try:
                request = _request(line)
            except ValueError as error:
                await _write(writer, result(ExitCode.USAGE, "bad_request", f"Not a request: {error}."))
                return
            if self._sign is not None:
                request["client"] = client
                listening = asyncio.create_task(_listen(reader, client, self._sign), name=f"listen to {client}")
            try:
                async with aclosing(self._answer(request)) as messages:
                    async for message in messages:
                        await _write(writer, message)
            except UprightError as error:
                await _write(writer, result(ExitCode.FAILED, "failed", str(error)))
        except (ConnectionError, asyncio.LimitOverrunError, ValueError):
            pass  # The client disconnected, or sent a line without an end: nothing to answer.
        finally:
            if listening is not None:
                listening.cancel()
            self._connections.discard(writer)
            writer.close()


async def _listen(reader: asyncio.StreamReader, client: str, sign: Callable[[Message], object]) -> None:
    """Forward further requests of a client while it is answered, and GONE when it disconnects."""
    try:
        while line := await reader.readline():
            sign({**_request(line), "client": client})
    except (ConnectionError, asyncio.LimitOverrunError, ValueError):
        pass  # A client that sends invalid lines counts as disconnected.
    sign({"verb": GONE, "client": client})


def _request(line: bytes) -> Message:
    """The request in `line`. Raises ValueError if it is not one."""
    request = json.loads(line)
    if not isinstance(request, dict) or not isinstance(request.get("verb"), str):
        raise ValueError("a request is an object with a verb")
    return request


async def _write(writer: asyncio.StreamWriter, message: Message) -> None:
    writer.write(json.dumps(message).encode() + b"\n")
    await writer.drain()


def result(exit_code: ExitCode, code: str = "", text: str = "", **more: Any) -> Message:
    """The last line of an answer."""
    return {"type": "result", "exit_code": int(exit_code), "code": code, "text": text, **more}


def call(paths: list[Path], request: Message, *, timeout: float | None = 10.0) -> Iterator[Message]:
    """Send the request to the daemon at the first of `paths` that answers; yield its lines, the result last.

    A thread renews the lease, if the request needs one, until the result, or until the caller stops reading lines and
    the connection is closed.

    Raises:
        ApiError: there is no daemon, or it ended before the result.
    """
    connection = _connect(paths)
    connection.settimeout(timeout)
    with connection, connection.makefile("rb") as stream:
        try:
            connection.sendall(json.dumps(request).encode() + b"\n")
            with _renewed(connection) if request["verb"] in HELD else nullcontext():
                for line in stream:
                    message = json.loads(line)
                    yield message
                    if message.get("type") == "result":
                        return
        except TimeoutError as error:
            raise ApiError(f"the daemon did not answer within {timeout} s.", remedy="See its log.") from error
        except ConnectionError:
            pass  # a daemon that is killed before it has read a renewal resets the connection, otherwise it is closed
    raise ApiError("the daemon ended before it answered.", remedy="See its log; `upright status` shows if it is back.")


@contextmanager
def _renewed(connection: socket.socket) -> Iterator[None]:
    """Renew the lease on `connection` by a thread."""
    over = threading.Event()

    def renew() -> None:
        with suppress(OSError):  # The connection has ended, which the reader reports.
            while not over.wait(RENEWAL_PERIOD):
                connection.sendall(b'{"verb":"renew"}\n')

    thread = threading.Thread(target=renew, name="renew", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()


def _connect(paths: list[Path]) -> socket.socket:
    reasons = []
    for path in paths:
        connection = socket.socket(socket.AF_UNIX)
        try:
            connection.connect(str(path))
        except OSError as error:
            connection.close()
            reasons.append(f"{path}: {error.strerror}")
        else:
            return connection
    raise ApiError(
        f"no daemon answers ({'; '.join(dict.fromkeys(reasons))}).",
        remedy="Start one with `upright serve VEHICLE`, or point to its socket with --socket PATH.",
    )
