"""The daemon's control socket, as its clients use it: a Unix socket with one JSON object per line.

A request is `{"verb": ..., arguments}`. The answer is a stream of lines, each with a `type` (`event`, `progress`,
`estimates`), that ends with one of type `result` with `exit_code` and, if it failed, `code` and `text`.
The client that runs an experiment holds a lease on it and sends `{"verb": "renew"}` on the same connection
periodically. If the connection ends or no renewal comes in time, the experiment ends.
The other end is `service.control.clients.server`.
Write access to the socket allows moving the vehicle: only its owner and group have read and write permission, and the
credentials of whoever has connected are checked (`service.control.clients.peers`).
"""

from __future__ import annotations

import json
import os
import socket
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from enum import IntEnum
from pathlib import Path
from typing import Any

from upright.service.control.clients.peers import FolderError, check_own
from upright.telemetry.errors import UprightError

Message = dict[str, Any]

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
    places = [Path("/run/upright"), temporary()]
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


def temporary() -> Path:
    """This user's folder for a socket where there is no runtime directory. Everybody can make one of this name."""
    return Path(tempfile.gettempdir()) / f"upright-{os.getuid()}"


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
            if path.parent == temporary() and path.parent.exists():
                check_own(path.parent)
            connection.connect(str(path))
        except (OSError, FolderError) as error:
            connection.close()
            reasons.append(f"{path}: {error.strerror if isinstance(error, OSError) else str(error).rstrip('.')}")
        else:
            return connection
    raise ApiError(
        f"no daemon answers ({'; '.join(dict.fromkeys(reasons))}).",
        remedy="Start one with `upright serve VEHICLE`, or point to its socket with --socket PATH.",
    )
