"""Listens to one SocketCAN interface in batches, with a socket of its own, for the raw log.

It uses neither python-can nor an event loop: the raw log is a small process that must outlive all others.
"""

from __future__ import annotations

import contextlib
import socket
from dataclasses import dataclass

from upright.drivers.bus.frame_clock import FrameClock
from upright.drivers.bus.socketcan import SocketcanPort
from upright.telemetry.samples import CanFrame

RECEIVE_BUFFER = 4 << 20
"""Bytes requested; without privileges the kernel grants what net.core.rmem_max allows, usually some 500 frames."""

_CAN_RAW_ERR_FILTER = 2
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_ERROR_CLASSES = 0x1FFFFFFF


@dataclass(frozen=True, slots=True)
class _Listener:
    """A CAN_RAW socket in place of a python-can bus."""

    socket: socket.socket

    def shutdown(self) -> None:
        self.socket.close()


class CanTap:
    """A listening socket on interface `channel`, whose frames get bus index `bus` and their time by `clock`, if any.

    Raises OSError if there is no such interface.
    """

    def __init__(self, channel: str, bus: int, clock: FrameClock | None = None) -> None:
        self.channel = channel
        listening = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            listening.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            listening.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ERROR_CLASSES)
            listening.bind((channel,))
            self._port = SocketcanPort(_Listener(listening), channel, bus, clock)
            with contextlib.suppress(PermissionError):
                listening.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
        except OSError:
            listening.close()
            raise

    @property
    def lost(self) -> int:
        """Number of frames lost because the buffer was full."""
        return self._port.receive_dropped

    def read(self, into: list[CanFrame]) -> None:
        """Take all waiting frames. Raises OSError once when the interface goes down; it is read again when up."""
        while frames := self._port.receive():
            into.extend(frames)

    def close(self) -> None:
        self._port.close()
