"""Notifications to the service manager: the sd_notify(3) protocol of systemd's Type=notify units.

Each notification is a datagram of KEY=VALUE lines to the Unix socket named by $NOTIFY_SOCKET (a name that begins with @
is in the abstract namespace). Without that variable every call does nothing, so the daemon also runs from a terminal.
"""

from __future__ import annotations

import os
import socket
from collections.abc import Mapping
from typing import Self

from upright.telemetry.errors import UprightError

_WATCHDOG = b"WATCHDOG=1"


class NotifyError(UprightError):
    """The service manager expects notifications, but cannot be reached."""


class Notifier:
    """Readiness, status line and watchdog of this process.

    Nothing here waits: a message that does not fit into the service manager's buffer is dropped and counted in
    `unsent`. If watchdog pings are lost, the service manager restarts the process, which is safe.
    """

    __slots__ = ("_socket", "unsent", "watchdog_timeout")

    def __init__(self, address: str = "", *, watchdog_timeout: float | None = None) -> None:
        """`address` is a path, `@name`, or empty for none; `watchdog_timeout` is in s, None if there is no watchdog.

        Raises NotifyError if no process listens at `address`.
        """
        self.watchdog_timeout = watchdog_timeout
        self.unsent = 0
        self._socket: socket.socket | None = None
        if not address:
            return
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect("\0" + address[1:] if address.startswith("@") else address)
        except OSError as error:
            self._socket.close()
            raise NotifyError(
                f"cannot reach the service manager at {address}: {error.strerror}.",
                remedy="Start the daemon by its unit (systemctl start upright), or unset NOTIFY_SOCKET.",
            ) from error

    @classmethod
    def from_environment(cls, environment: Mapping[str, str] = os.environ) -> Self:
        """The notifier according to $NOTIFY_SOCKET, $WATCHDOG_USEC and $WATCHDOG_PID (sd_watchdog_enabled(3)).

        Raises NotifyError like the constructor.
        """
        microseconds = environment.get("WATCHDOG_USEC", "")
        watched = microseconds.isdecimal() and environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
        return cls(environment.get("NOTIFY_SOCKET", ""), watchdog_timeout=int(microseconds) / 1e6 if watched else None)

    def ready(self, status: str = "") -> None:
        """Start-up is complete: units that wait for this one may start. `status` is a line for `systemctl status`."""
        self._send(b"READY=1" + _status_line(status))

    def status(self, status: str) -> None:
        """A line for `systemctl status`."""
        self._send(_status_line(status).lstrip())

    def watchdog(self) -> None:
        """The control step ran. Call it at least twice in every `watchdog_timeout`."""
        self._send(_WATCHDOG)

    def stopping(self, status: str = "") -> None:
        """The process is about to end in order."""
        self._send(b"STOPPING=1" + _status_line(status))

    def close(self) -> None:
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _send(self, message: bytes) -> None:
        if self._socket is None:
            return
        try:
            self._socket.send(message)
        except OSError:
            self.unsent += 1


def _status_line(status: str) -> bytes:
    return f"\nSTATUS={status}".encode() if status else b""
