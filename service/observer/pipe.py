"""The sending side of the pipe to the observer: batches of frames and messages, in their order, without waiting.

If the pipe is full, packets wait in a bounded queue, which is sufficient for an observer that stalls for half a minute.
If the queue is full, too, they are dropped and counted. A `lossless` pipe waits instead; that is for a simulated bus,
whose time can stand still.
"""

from __future__ import annotations

import asyncio
import select
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from upright.service.observer import link
from upright.service.turns import READ, Turns
from upright.telemetry.samples import CanFrame, Frame

BATCH_NS = 20_000_000
"""Time span of a batch, by the data's clock."""

MOST_FRAMES = 32
MOST_CAN_FRAMES = 512
"""Frames at which a batch is sent regardless of its time: a clock that was set back must not delay it."""

MOST_WAITING = 2 << 20
"""Maximum bytes that wait for room in the pipe: half a minute at 250 Hz, less if raw frames wait, too."""

RESERVED = 64 << 10
"""Bytes of it that are reserved for messages: they are few, and more important than another cycle."""

PACKETS_A_TURN = 32
"""Maximum number of waiting packets that are sent in one turn."""

MESSAGES_A_TURN = 4
"""Maximum number of messages of the observer that are read in one turn (`service.turns`)."""

LONGEST_WAIT = 5.0
"""s that a lossless pipe waits for room."""


@dataclass(slots=True)
class PipeStatistics:
    """Counts of all pipes to one observer. `dropped`: pipe and queue were full, or the observer had ended."""

    frames: int = 0
    frames_dropped: int = 0
    can_frames: int = 0
    can_frames_dropped: int = 0
    messages_dropped: int = 0
    exits: int = 0


class ObserverPipe:
    """Control's end `connection`, in a running event loop, for cycles of `channels` values.

    `on_message` gets the JSON objects from the observer, in `turns`. `is_open` is False once the other end is closed.
    """

    def __init__(
        self,
        connection: socket.socket,
        channels: int,
        statistics: PipeStatistics,
        on_message: Callable[[dict[str, Any]], None],
        *,
        lossless: bool,
        turns: Turns,
    ) -> None:
        self.is_open = True
        self._socket = connection
        self._codec = link.FrameCodec(channels)
        self._statistics = statistics
        self._on_message = on_message
        self._lossless = lossless
        self._loop = asyncio.get_running_loop()
        self._frames: list[Frame] = []
        self._flush_at_ns = 0
        self._can_frames: list[CanFrame] = []
        self._flush_can_at_ns = 0
        self._waiting: deque[bytes] = deque()
        self._waiting_size = 0
        self._awaits_room = False
        self._turns = turns
        turns.watch(connection.fileno(), READ, self._receive_some)

    def offer(self, frame: Frame) -> None:
        """Send one control cycle."""
        self._frames.append(frame)
        if frame.timestamp_ns >= self._flush_at_ns or len(self._frames) >= MOST_FRAMES:
            self._flush_at_ns = frame.timestamp_ns + BATCH_NS
            self._flush_frames()

    def offer_can(self, frame: CanFrame) -> None:
        """Send one raw frame."""
        self._can_frames.append(frame)
        if frame.timestamp_ns >= self._flush_can_at_ns or len(self._can_frames) >= MOST_CAN_FRAMES:
            self._flush_can_at_ns = frame.timestamp_ns + BATCH_NS
            self._flush_can_frames()

    def post(self, packet: bytes, *, order: bool = False) -> None:
        """Send a message after all earlier frames. An `order` is never dropped, however many bytes are waiting."""
        self.flush()
        self._flush_at_ns = 0  # The next cycle may be the last one needed for an order.
        if not self._send(packet, MOST_WAITING if not order else None):
            self._statistics.messages_dropped += 1

    def flush(self) -> None:
        """Send all collected frames."""
        if self._frames:
            self._flush_frames()
        if self._can_frames:
            self._flush_can_frames()

    async def end(self, time: float) -> None:
        """Shut down the sending direction, after the waiting packets, for which there are `time` s."""
        self.flush()
        limit = self._loop.time() + time
        while self._waiting and self.is_open and self._loop.time() < limit:
            await asyncio.sleep(0.01)
        if self.is_open:
            self._socket.shutdown(socket.SHUT_WR)

    def close(self) -> None:
        """Discard waiting packets, and close this end."""
        if self.is_open:
            self.is_open = False
            self._turns.forget(self._socket.fileno())
            self._loop.remove_writer(self._socket)
            self._socket.close()

    def receive(self) -> None:
        """Read all that the observer has sent."""
        while self._receive_one():
            pass

    def _receive_some(self, events: int) -> None:
        for _ in range(MESSAGES_A_TURN):
            if not self._receive_one():
                return

    def _receive_one(self) -> bool:
        if not self.is_open:
            return False
        try:
            packet = link.receive(self._socket)
        except BlockingIOError:
            return False
        except OSError:
            packet = b""
        if not packet:
            self.close()
            return False
        self._on_message(link.unpack_json(packet))
        return True

    def _flush_frames(self) -> None:
        frames, self._frames = self._frames, []
        if self._send(self._codec.pack(frames), MOST_WAITING - RESERVED):
            self._statistics.frames += len(frames)
        else:
            self._statistics.frames_dropped += len(frames)

    def _flush_can_frames(self) -> None:
        frames, self._can_frames = self._can_frames, []
        if self._send(link.pack_can(frames), MOST_WAITING - RESERVED):
            self._statistics.can_frames += len(frames)
        else:
            self._statistics.can_frames_dropped += len(frames)

    def _send_waiting(self) -> bool:
        """Send a few waiting packets, not to delay the next control cycle; return whether none are left."""
        for _ in range(min(PACKETS_A_TURN, len(self._waiting))):
            if not self._try_send(self._waiting[0]):
                return False
            self._waiting_size -= len(self._waiting.popleft())
        if self._waiting:
            return False
        if self._awaits_room and self.is_open:
            self._awaits_room = False
            self._loop.remove_writer(self._socket)
        return True

    def _send(self, packet: bytes, most_waiting: int | None) -> bool:
        """Send or queue the packet; False if more than `most_waiting` bytes would wait (None: no limit)."""
        while not (self._send_waiting() and self._try_send(packet)):
            if not (self._lossless and self._wait_for_room()):
                return self._queue(packet, most_waiting)
        return True

    def _queue(self, packet: bytes, most: int | None) -> bool:
        size = self._waiting_size + len(packet)
        if not self.is_open or (most is not None and size > most):
            return False
        self._waiting.append(packet)
        self._waiting_size = size
        if not self._awaits_room:
            self._awaits_room = True
            self._loop.add_writer(self._socket, self._send_waiting)
        return True

    def _try_send(self, packet: bytes) -> bool:
        if not self.is_open:
            return False
        try:
            self._socket.send(packet)
        except BlockingIOError:
            return False
        except OSError:
            self.close()  # The observer has ended; its exit status follows.
            return False
        return True

    def _wait_for_room(self) -> bool:
        if not self.is_open:
            return False
        poll = select.poll()
        poll.register(self._socket, select.POLLOUT)
        return bool(poll.poll(LONGEST_WAIT * 1000))
