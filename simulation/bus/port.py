"""How the virtual vehicle reads and writes its buses: few system calls, nothing that can stop the simulation.

On SocketCAN the socket is read and written directly and without blocking; one `select` waits. Other python-can buses
are used through their own recv and send.
"""

from __future__ import annotations

import errno
import select
import socket
import struct
import time
from dataclasses import dataclass

import can

CAN_FRAME = struct.Struct("=IB3x8s")
STANDARD_ID = 0x7FF
FLAGS = 0xE000_0000
"""Extended, remote and error frames: none of them is for these nodes."""
OUTAGE_PAUSE = 0.01
"""s to wait before a bus that is down is read again."""

MOST_FRAMES = 256
"""Frames handed over at most at once, so that a flooded bus cannot stop the vehicle's time."""

Received = list[tuple[int, bytes]]
"""CAN id and data of frames."""


@dataclass(slots=True)
class PortStatistics:
    """Counts of a port. `transmit_dropped` counts frames the bus did not take, `errors` failed reads."""

    received: int = 0
    sent: int = 0
    transmit_dropped: int = 0
    errors: int = 0


class BusPort:
    """One bus."""

    def __init__(self, bus: can.BusABC) -> None:
        self.statistics = PortStatistics()
        self._bus = bus
        self._socket: socket.socket | None = getattr(bus, "socket", None) if _is_socketcan(bus) else None
        if self._socket is not None:
            self._socket.setblocking(False)

    def receive(self, timeout: float) -> Received:
        """Wait up to `timeout` s for a frame; returns all that have arrived."""
        try:
            frames = self._receive_raw(timeout) if self._socket is not None else self._receive_messages(timeout)
        except (OSError, can.CanError):
            self.statistics.errors += 1
            time.sleep(min(OUTAGE_PAUSE, max(0.0, timeout)))
            return []
        self.statistics.received += len(frames)
        return frames

    def send(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        """Send a frame; one that the bus does not take is counted and lost, as on a wire."""
        try:
            if self._socket is not None:
                self._socket.send(CAN_FRAME.pack(can_id, len(data), data))
            else:
                self._bus.send(
                    can.Message(timestamp=timestamp_ns * 1e-9, arbitration_id=can_id, data=data, is_extended_id=False)
                )
        except (OSError, can.CanError):
            self.statistics.transmit_dropped += 1
        else:
            self.statistics.sent += 1

    def _receive_raw(self, timeout: float) -> Received:
        assert self._socket is not None
        frames: Received = []
        if timeout > 0.0 and not select.select([self._socket], [], [], timeout)[0]:
            return frames
        receive = self._socket.recv
        while len(frames) < MOST_FRAMES:
            try:
                can_id, length, data = CAN_FRAME.unpack_from(receive(16))
            except BlockingIOError:
                return frames
            except OSError as error:
                if error.errno == errno.ENOBUFS:  # the queue overflowed; its content is still valid
                    continue
                raise
            if not can_id & FLAGS:
                frames.append((can_id & STANDARD_ID, data[:length]))
        return frames

    def _receive_messages(self, timeout: float) -> Received:
        frames: Received = []
        message = self._bus.recv(max(0.0, timeout))
        while message is not None and len(frames) < MOST_FRAMES:
            if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
                frames.append((message.arbitration_id, bytes(message.data)))
            message = self._bus.recv(0)
        return frames


def _is_socketcan(bus: can.BusABC) -> bool:
    return type(bus).__name__ == "SocketcanBus"
