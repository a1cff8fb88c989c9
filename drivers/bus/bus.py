"""The CAN bus as the event loop sees it: frames arrive in lists, sends never block, and a lost bus is reported once.

python-can opens the interface; the reading is our own. Each wake-up reads all waiting frames, up to a bound, so that a
flooded bus cannot stop the rest of the process; the others are read in the next iteration of the loop. A frame that the
transmit queue does not accept is kept and retried, in order, for at most `TRANSMIT_TIME`: an old setpoint is useless.
An interface that goes down, a bus-off and a transmit queue that stays full are reported as `BusDown`, once, and nothing
is read afterwards.
"""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from operator import attrgetter
from typing import Protocol, cast

from upright.drivers.bus.address import connect, split
from upright.drivers.bus.error_frames import ErrorClass, ErrorReport, decode
from upright.drivers.bus.errors import BusDown, BusError
from upright.drivers.bus.frame_clock import FrameClock
from upright.drivers.bus.message_port import MessagePort
from upright.drivers.bus.socketcan import SocketcanPort, SocketHolder
from upright.telemetry.samples import CanFrame

__all__ = ["Bus", "BusDown", "BusError", "BusGroup", "BusStatistics"]

TRANSMIT_TIME = 0.05
"""s that a frame may wait for a place in the transmit queue."""

RETRY_PERIOD = 0.001
"""s between two attempts to send the waiting frames."""

PENDING_LIMIT = 256
"""Frames that may wait for the transmit queue."""

OnFrames = Callable[[list[CanFrame]], None]
OnDown = Callable[[BusDown], None]


class Port(Protocol):
    """Access to a bus: a SocketCAN socket or a python-can bus with threads.

    After `start` the loop calls `on_readable` as long as frames wait or the bus has failed; `stop` ends that at once.
    `receive` and `send` never block and raise OSError when the bus is gone; `send` is False when the queue is full.
    """

    receive_dropped: int

    def start(self, loop: asyncio.AbstractEventLoop, on_readable: Callable[[], None]) -> None: ...
    def stop(self) -> None: ...
    def receive(self) -> list[CanFrame]: ...
    def send(self, can_id: int, data: bytes, timestamp_ns: int) -> bool: ...
    def close(self) -> None: ...


@dataclass(slots=True)
class BusStatistics:
    """Counts since the bus was opened. Dropped frames are lost, in the kernel (receive) or here (transmit)."""

    received: int = 0
    sent: int = 0
    transmit_retries: int = 0
    transmit_dropped: int = 0
    receive_dropped: int = 0
    error_frames: int = 0
    wakeups: int = 0
    largest_drain: int = 0


class Bus:
    """One CAN bus. `index` is its place among the buses of a vehicle, and is part of every frame it delivers.

    `tap` is called with every frame received or sent. A frame that is sent without a time stamp carries that of the
    latest received frame.
    """

    def __init__(self, port: Port, address: str, index: int = 0) -> None:
        self.address = address
        self.index = index
        self.statistics = BusStatistics()
        self.down: BusDown | None = None
        self.tap: Callable[[CanFrame], None] | None = None
        self._port = port
        self._loop: asyncio.AbstractEventLoop | None = None
        self._on_frames: OnFrames = lambda frames: None
        self._on_down: OnDown = lambda down: None
        self._pending: deque[tuple[float, int, bytes, int]] = deque()
        self._retry: asyncio.TimerHandle | None = None
        self._latest_ns = 0
        self._error_frame: CanFrame | None = None

    @classmethod
    def open(
        cls,
        address: str,
        *,
        index: int = 0,
        bitrate: int | None = None,
        can_ids: Sequence[int] | None = None,
        clock: FrameClock | None = None,
    ) -> Bus:
        """Open the bus at IFACE:CHANNEL, delivering `can_ids` only (None: everything); `bitrate` in bit/s.

        `clock` makes the stamps of received frames independent of steps of the wall clock. Raises BusError, with the
        remedy. A serial adapter takes 2 s to open.
        """
        bus = connect(address, bitrate, can_ids)
        interface, channel = split(address)
        if interface == "socketcan":
            return cls(SocketcanPort(cast(SocketHolder, bus), channel, index, clock), address, index)
        return cls(MessagePort(bus, interface, index, clock), address, index)

    def start(self, on_frames: OnFrames, on_down: OnDown) -> None:
        """Deliver frames in the running event loop from now on; `on_down` is called at most once, after them."""
        self._on_frames, self._on_down = on_frames, on_down
        self._loop = asyncio.get_running_loop()
        self._port.start(self._loop, self._on_readable)

    def drain(self) -> list[CanFrame]:
        """The frames that wait now, the oldest first, up to a bound."""
        if self.down is not None:
            return []
        try:
            frames = self._port.receive()
        except OSError as error:
            self._fail(error.strerror or str(error))
            return []
        if frames:
            self._account(frames)
        return frames

    def send(self, can_id: int, data: bytes, timestamp_ns: int = 0) -> None:
        """Send a data frame, after those that still wait. Never blocks, never raises: `on_down` reports a loss.

        `timestamp_ns` is the time of the data it was computed from.
        """
        timestamp_ns = timestamp_ns or self._latest_ns or time.time_ns()
        if self._pending or self.down is not None:
            self._keep(can_id, data, timestamp_ns)
        elif not self._try(can_id, data, timestamp_ns):
            self._keep(can_id, data, timestamp_ns)
            self._retry_later()

    def send_threadsafe(self, can_id: int, data: bytes) -> None:
        """`send` from any thread, once started. Raises BusDown when the bus is lost or closed."""
        if self.down is not None:
            raise self.down
        if self._loop is None:
            raise BusError(f"{self.address} has not been started.", bus=self.address)
        self._loop.call_soon_threadsafe(self.send, can_id, data)

    def close(self) -> None:
        """Release the interface. Nothing is delivered any more, not even `on_down`."""
        self._end()
        self._on_down = lambda down: None
        self.down = self.down or BusDown(self.address, "it was closed")
        self._port.close()

    @property
    def last_error(self) -> ErrorReport | None:
        """The latest error frame, decoded."""
        return decode(self._error_frame) if self._error_frame is not None else None

    def summary(self) -> dict[str, int | str]:
        """The statistics for `upright status`: counts, whether the bus is down and what the last error frame said."""
        error = self.last_error
        return {
            "address": self.address,
            "down": self.down.reason if self.down is not None else "",
            "last_error": error.text if error is not None else "",
            **asdict(self.statistics),
        }

    # Receiving

    def _on_readable(self) -> None:
        self.statistics.wakeups += 1
        frames = self.drain()
        if frames:
            self._on_frames(frames)

    def _account(self, frames: list[CanFrame]) -> None:
        statistics = self.statistics
        statistics.received += len(frames)
        statistics.receive_dropped = self._port.receive_dropped
        if len(frames) > statistics.largest_drain:
            statistics.largest_drain = len(frames)
        self._latest_ns = frames[-1].timestamp_ns
        for frame in frames:
            if frame.error:
                statistics.error_frames += 1
                self._error_frame = frame
                if frame.can_id & ErrorClass.BUS_OFF:
                    self._fail(f"the controller went bus-off ({decode(frame).text})")
        if self.tap is not None:
            for frame in frames:
                self.tap(frame)

    # Sending

    def _try(self, can_id: int, data: bytes, timestamp_ns: int) -> bool:
        try:
            if not self._port.send(can_id, data, timestamp_ns):
                return False
        except OSError as error:
            self._fail(error.strerror or str(error))
            return False
        self.statistics.sent += 1
        if self.tap is not None:
            self.tap(CanFrame(timestamp_ns, can_id, data, self.index, extended=can_id > 0x7FF))
        return True

    def _keep(self, can_id: int, data: bytes, timestamp_ns: int) -> None:
        if self.down is not None:
            self.statistics.transmit_dropped += 1
            return
        self._pending.append((time.monotonic(), can_id, data, timestamp_ns))
        if len(self._pending) > PENDING_LIMIT:
            self._fail(f"the transmit queue is full and {PENDING_LIMIT} more frames wait{self._transmit_hint()}")

    def _retry_later(self) -> None:
        if self._loop is not None and self.down is None:
            self._retry = self._loop.call_later(RETRY_PERIOD, self._send_pending)

    def _send_pending(self) -> None:
        while self._pending and self.down is None:
            self.statistics.transmit_retries += 1
            waiting_since, can_id, data, timestamp_ns = self._pending[0]
            if not self._try(can_id, data, timestamp_ns):
                if time.monotonic() - waiting_since >= TRANSMIT_TIME:
                    self._fail(f"transmit queue stayed full for {1e3 * TRANSMIT_TIME:.0f} ms{self._transmit_hint()}")
                break
            self._pending.popleft()
        if self._pending:
            self._retry_later()

    def _transmit_hint(self) -> str:
        error = self.last_error
        return f"; the last error frame said: {error.text}" if error is not None else ", does any other node listen?"

    # Ending

    def _fail(self, reason: str) -> None:
        """Stop everything at once; call `on_down` after the frames that are still on their way to their consumer."""
        if self.down is None:
            self.down = BusDown(self.address, reason)
            self._end()
            if self._loop is not None:
                self._loop.call_soon(lambda down: self._on_down(down), self.down)

    def _end(self) -> None:
        self._port.stop()
        self.statistics.transmit_dropped += len(self._pending)
        self._pending.clear()
        if self._retry is not None:
            self._retry.cancel()


class BusGroup:
    """The buses of one vehicle, delivered as one stream in the order of the frames' timestamps.

    When one bus wakes the loop the others are drained too: a frame that the kernel received earlier is already there,
    so a list never misses an older frame of another bus.
    """

    def __init__(self, buses: Sequence[Bus]) -> None:
        self._buses = tuple(buses)
        self._on_frames: OnFrames = lambda frames: None

    def start(self, on_frames: OnFrames, on_down: OnDown) -> None:
        """Deliver the frames of all buses in the running event loop; `on_down` is called for each that is lost."""
        self._on_frames = on_frames
        for bus in self._buses:
            bus.start(on_frames if len(self._buses) == 1 else self._merger(bus), on_down)

    def send(self, index: int, can_id: int, data: bytes, timestamp_ns: int = 0) -> None:
        """Send on the bus number `index`; see `Bus.send`."""
        self._buses[index].send(can_id, data, timestamp_ns)

    def close(self) -> None:
        for bus in self._buses:
            bus.close()

    def statistics(self) -> list[dict[str, int | str]]:
        """The summary of each bus."""
        return [bus.summary() for bus in self._buses]

    def _merger(self, woken: Bus) -> OnFrames:
        others = [bus for bus in self._buses if bus is not woken]

        def merge(frames: list[CanFrame]) -> None:
            merged = list(frames)
            for bus in others:
                merged += bus.drain()
            if len(merged) > len(frames):
                merged.sort(key=attrgetter("timestamp_ns"))
            self._on_frames(merged)

        return merge
