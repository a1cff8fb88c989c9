"""Buses without a SocketCAN socket (virtual, udp_multicast, slcan and the other interfaces of python-can).

python-can's `recv` blocks, so a separate thread waits and wakes the event loop once for all the frames that have
arrived. If `send` may block, too (a serial line), a second thread sends. Timestamps are python-can's; on a virtual bus
they are the sender's, so that simulated time travels with the frames.
"""

from __future__ import annotations

import asyncio
import errno
import queue
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from uuid import uuid4

import can

from upright.drivers.bus.frame_clock import FrameClock
from upright.drivers.bus.socketcan import STANDARD_ID, read_clocks
from upright.telemetry.samples import CanFrame

POLL_PERIOD = 0.05
"""s after which a waiting reader checks whether it has to end."""

MOST_FRAMES = 128
"""Frames handed over at most at once; the others wait for the next iteration of the event loop."""

CLOSE_TIME = 1.0
"""s that a thread has to end; one that a broken device blocks is abandoned."""

INBOX_LIMIT = 8192
OUTBOX_LIMIT = 64
MALFORMED_LIMIT = 16
"""Consecutive malformed messages after which the line is taken not to carry CAN."""

OF_THE_WALL_CLOCK = ("udp_multicast", "slcan")
"""Interfaces whose frames have the time of this computer's wall clock."""

NEVER_WAITS = ("virtual", "udp_multicast")
"""Interfaces whose `send` returns at once."""


class MessagePort:
    """A python-can bus as a `drivers.bus.bus.Port`. `clock` converts stamps of the wall clock, None leaves them."""

    def __init__(self, bus: can.BusABC, interface: str, index: int, clock: FrameClock | None = None) -> None:
        self._clock = clock if interface in OF_THE_WALL_CLOCK else None
        self.receive_dropped = 0
        self._bus = bus
        self._index = index
        self._inbox: deque[CanFrame] = deque()
        self._outbox: queue.SimpleQueue[can.Message | None] | None = (
            None if interface in NEVER_WAITS else queue.SimpleQueue()
        )
        # Multicast returns a sender's own frames; this mark identifies them.
        self._mark = uuid4().hex[:8] if interface == "udp_multicast" else None
        self._threads: list[threading.Thread] = []
        self._failure: OSError | None = None
        self._running = False
        self._woken = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_readable: Callable[[], None] = lambda: None

    def start(self, loop: asyncio.AbstractEventLoop, on_readable: Callable[[], None]) -> None:
        self._loop, self._on_readable, self._running = loop, on_readable, True
        targets = [self._read] if self._outbox is None else [self._read, self._write]
        self._threads = [threading.Thread(target=target, name="CAN bus", daemon=True) for target in targets]
        for thread in self._threads:
            thread.start()

    def stop(self) -> None:
        self._running = False

    def receive(self) -> list[CanFrame]:
        """The frames that wait, the oldest first. Raises OSError when the bus has failed and nothing is left."""
        self._woken = False  # before the inbox is read: frames that arrive later wake the loop again
        inbox = self._inbox
        if not inbox and self._failure is not None:
            raise self._failure
        frames = [inbox.popleft() for _ in range(min(len(inbox), MOST_FRAMES))]
        if inbox or self._failure is not None:
            self._wake()
        return frames if self._clock is None else converted(frames, self._clock)

    def send(self, can_id: int, data: bytes, timestamp_ns: int) -> bool:
        """Send a frame; False when too many are waiting already. Raises OSError when the bus is gone."""
        message = can.Message(
            timestamp=timestamp_ns * 1e-9,
            arbitration_id=can_id,
            data=data,
            is_extended_id=can_id > STANDARD_ID,
            channel=self._mark,
        )
        if self._outbox is not None:
            if self._outbox.qsize() >= OUTBOX_LIMIT:
                return False
            self._outbox.put(message)
            return True
        try:
            self._bus.send(message)
        except can.CanError as error:
            raise OSError(errno.EIO, str(error)) from error
        return True

    def close(self) -> None:
        self.stop()
        if self._outbox is not None:
            self._outbox.put(None)
        for thread in self._threads:
            thread.join(CLOSE_TIME)
        try:
            self._bus.shutdown()
        except (OSError, can.CanError) as error:  # a serial device that was unplugged cannot be closed
            self._failure = OSError(errno.EIO, str(error))

    # In the threads

    def _read(self) -> None:
        malformed = 0
        inbox, receive = self._inbox, self._bus.recv
        while self._running:
            try:
                message = receive(POLL_PERIOD)
            except (OSError, can.CanError, ValueError, IndexError) as error:
                malformed += 1
                lost = isinstance(error, OSError) or isinstance(error.__cause__, OSError)
                if lost or malformed >= MALFORMED_LIMIT:
                    self._fail(str(error) if lost else f"the received data is not CAN ({error})")
                    return
                continue
            if message is None or message.is_fd or (self._mark is not None and message.channel == self._mark):
                continue
            malformed = 0
            if len(inbox) >= INBOX_LIMIT:
                self.receive_dropped += 1
                continue
            inbox.append(_frame(message, self._index))
            if not self._woken:
                self._wake()

    def _write(self) -> None:
        assert self._outbox is not None
        while (message := self._outbox.get()) is not None:
            try:
                self._bus.send(message)
            except (OSError, can.CanError) as error:
                self._fail(str(error))
                return

    def _fail(self, reason: str) -> None:
        self._failure = OSError(errno.EIO, reason)
        self._wake()

    def _wake(self) -> None:
        self._woken = True
        if self._loop is None or not self._running:
            return
        try:
            self._loop.call_soon_threadsafe(self._on_readable)
        except RuntimeError:  # the loop was closed before this bus was: nobody reads any more
            self._running = False


def converted(frames: list[CanFrame], clock: FrameClock) -> list[CanFrame]:
    """`frames`, which were received since the last call, with their stamps converted."""
    read_clocks(clock)
    if clock.stepping:
        return [replace(frame, timestamp_ns=clock.convert(frame.timestamp_ns)) for frame in frames]
    if clock.shift_ns:
        return [replace(frame, timestamp_ns=frame.timestamp_ns + clock.shift_ns) for frame in frames]
    return frames


def _frame(message: can.Message, index: int) -> CanFrame:
    # A sender without a clock leaves 0; the time of arrival is then the best there is.
    timestamp_ns = round(message.timestamp * 1e9) if message.timestamp else time.time_ns()
    return CanFrame(
        timestamp_ns,
        message.arbitration_id,
        bytes(message.data),
        index,
        extended=message.is_extended_id,
        remote=message.is_remote_frame,
        error=message.is_error_frame,
    )
