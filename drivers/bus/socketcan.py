"""SocketCAN, read and written without python-can's per-frame cost: one system call for all waiting frames.

python-can opens and configures the socket (CAN_RAW, error frames on, SO_TIMESTAMPNS); from then on `recvmmsg` reads up
to `SLOTS` frames at once, each with the kernel's receive time in ns (converted by `drivers.bus.frame_clock`) and the
count of frames that the kernel had to drop (SO_RXQ_OVFL). Its return value shows when the queue is empty, whereas
`recvmsg` in a loop takes three calls for one frame: the read, a look-up of the interface's name (CPython does that for
AF_CAN), and the read that finds nothing.

A slot is struct can_frame followed by the frame's control messages (64-bit offsets in brackets):
can_id [0] u32, length [4] u8, data [8] 8 bytes, cmsghdr [16], struct timespec [32], cmsghdr [48], drop count [64] u32.
"""

from __future__ import annotations

import ctypes
import errno
import os
import socket
import struct
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

from upright.drivers.bus.frame_clock import DEADBAND, FrameClock
from upright.telemetry.samples import CanFrame

if TYPE_CHECKING:
    import asyncio

SLOTS = 128
"""Frames read at most at once; the others wait for the next iteration of the event loop."""

RECEIVE_BUFFER = 1 << 20
"""Bytes requested from the kernel for frames that wait to be read; it grants what net.core.rmem_max allows."""

EXTENDED, REMOTE, ERROR = 0x8000_0000, 0x4000_0000, 0x2000_0000
"""Flag bits of can_id (linux/can.h)."""
STANDARD_ID, EXTENDED_ID = 0x7FF, 0x1FFF_FFFF
SO_RXQ_OVFL = 40

FRAME = struct.Struct("=IB3x8s")
SLOT = struct.Struct("@IB3x8s Nii ll NiiI4x")
TIMESTAMP_SPACE = struct.calcsize("@Nii ll")
"""Bytes of the timestamp's control message: more of them mean that a drop count follows."""

REASONS = {
    errno.ENETDOWN: "the interface was set down (`ip link set {0} up` brings it back)",
    errno.ENODEV: "the interface was removed",
    errno.ENXIO: "the interface was removed",
}


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _MessageHeader(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("io_vector", ctypes.POINTER(_IoVector)),
        ("io_vector_length", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _ReceivedMessage(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("header", _MessageHeader), ("length", ctypes.c_uint))


# PyDLL keeps the interpreter lock: the call never waits (MSG_DONTWAIT), and releasing it could cost a thread switch.
_recvmmsg = ctypes.PyDLL(None, use_errno=True).recvmmsg
_recvmmsg.argtypes = (ctypes.c_int, ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_void_p)
_recvmmsg.restype = ctypes.c_int


def read_clocks(clock: FrameClock) -> None:
    """Give `clock` the wall clock and CLOCK_MONOTONIC of the same moment, if this process is not held up meanwhile."""
    before = time.monotonic_ns()
    realtime = time.time_ns()
    after = time.monotonic_ns()
    if after - before < DEADBAND // 2:
        clock.read(realtime, (before + after) // 2)


def start_clock() -> FrameClock:
    """A clock that agrees with the wall clock now."""
    readings = [(time.monotonic_ns(), time.time_ns(), time.monotonic_ns()) for _ in range(5)]
    before, realtime, after = min(readings, key=lambda reading: reading[2] - reading[0])
    return FrameClock(realtime - (before + after) // 2)


class SocketHolder(Protocol):
    """What is needed of python-can's SocketcanBus."""

    @property
    def socket(self) -> socket.socket: ...

    def shutdown(self) -> None: ...


class SocketcanPort:
    """The socket of one SocketCAN interface as a `drivers.bus.bus.Port`. Without `clock`, stamps are the kernel's."""

    def __init__(self, bus: SocketHolder, channel: str, index: int, clock: FrameClock | None = None) -> None:
        self._clock = clock or FrameClock(0)
        self._converts = clock is not None
        self.receive_dropped = 0
        self._bus = bus
        self._index = index
        self._channel = channel
        self._socket = bus.socket
        self._descriptor = bus.socket.fileno()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        self._socket.setsockopt(socket.SOL_SOCKET, SO_RXQ_OVFL, 1)

        self._slots = ctypes.create_string_buffer(SLOTS * SLOT.size)
        self._view = memoryview(self._slots)
        self._vectors = (_IoVector * SLOTS)()
        self._messages = (_ReceivedMessage * SLOTS)()
        for place in range(SLOTS):
            slot = ctypes.addressof(self._slots) + place * SLOT.size
            self._vectors[place] = _IoVector(slot, FRAME.size)
            header = self._messages[place].header
            header.io_vector = ctypes.pointer(self._vectors[place])
            header.io_vector_length = 1
            header.control = slot + FRAME.size
            header.control_length = SLOT.size - FRAME.size
        self._unused_messages = bytes(self._messages)
        self._address = ctypes.addressof(self._messages)

    def start(self, loop: asyncio.AbstractEventLoop, on_readable: Callable[[], None]) -> None:
        self._loop = loop
        loop.add_reader(self._descriptor, on_readable)

    def stop(self) -> None:
        if self._loop is not None:
            self._loop.remove_reader(self._descriptor)
            self._loop = None

    def receive(self) -> list[CanFrame]:
        """The frames that wait, the oldest first. Raises OSError when the interface is gone or down."""
        count = _recvmmsg(self._descriptor, self._address, SLOTS, socket.MSG_DONTWAIT, None)
        if count < 0:
            code = ctypes.get_errno()
            if code in (errno.EAGAIN, errno.EINTR):
                return []
            raise self._failure(code)
        frames = []
        index, clock = self._index, self._clock
        if self._converts:
            read_clocks(clock)
        shift_ns, stepping = clock.shift_ns, clock.stepping
        filled = self._view[: count * SLOT.size]
        for can_id, length, data, _, _, _, seconds, nanoseconds, _, _, _, _ in SLOT.iter_unpack(filled):
            timestamp_ns = seconds * 1_000_000_000 + nanoseconds + shift_ns
            if stepping:
                timestamp_ns = clock.convert(timestamp_ns - shift_ns)
            if can_id <= STANDARD_ID:
                frames.append(CanFrame(timestamp_ns, can_id, data[:length], index))
            else:
                frames.append(_flagged_frame(timestamp_ns, can_id, data[:length], index))
        if self._messages[count - 1].header.control_length > TIMESTAMP_SPACE:
            self.receive_dropped = SLOT.unpack_from(self._slots, (count - 1) * SLOT.size)[-1]
        ctypes.memmove(self._address, self._unused_messages, count * ctypes.sizeof(_ReceivedMessage))
        return frames

    def send(self, can_id: int, data: bytes, timestamp_ns: int) -> bool:
        """Hand a frame to the kernel; False when its transmit queue is full. Raises OSError when the bus is gone."""
        if can_id > STANDARD_ID:
            can_id |= EXTENDED
        try:
            self._socket.send(FRAME.pack(can_id, len(data), data))
        except OSError as error:
            if error.errno in (errno.ENOBUFS, errno.EAGAIN):
                return False
            raise self._failure(error.errno or 0) from error
        return True

    def close(self) -> None:
        self.stop()
        self._bus.shutdown()

    def _failure(self, code: int) -> OSError:
        return OSError(code, REASONS.get(code, os.strerror(code)).format(self._channel))


def _flagged_frame(timestamp_ns: int, can_id: int, data: bytes, index: int) -> CanFrame:
    extended = bool(can_id & EXTENDED)
    return CanFrame(
        timestamp_ns,
        can_id & (STANDARD_ID if not can_id & (EXTENDED | ERROR) else EXTENDED_ID),
        data,
        index,
        extended=extended,
        remote=bool(can_id & REMOTE),
        error=bool(can_id & ERROR),
    )
