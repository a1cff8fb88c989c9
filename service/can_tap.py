"""Listens to one SocketCAN interface in batches: recvmmsg(2), one system call for up to 64 frames with kernel times.

Python's socket module takes one frame a call, which on a busy bus costs more than all else that a log does with it.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import os
import socket
import struct

from telemetry.samples import CanFrame

MOST = 64
"""Frames a system call."""

RECEIVE_BUFFER = 4 << 20
"""Bytes asked for; without privilege the kernel gives what net.core.rmem_max allows, usually some 500 frames."""

_CAN_RAW_ERR_FILTER = 2
_SO_RCVBUFFORCE = 33
_SO_TIMESTAMPNS = 35
_SO_RXQ_OVFL = 40
_ERROR_CLASSES = 0x1FFFFFFF
_EXTENDED, _REMOTE, _ERROR = 0x80000000, 0x40000000, 0x20000000

_FRAME = struct.Struct("=IB3x8s")
_CONTROL = struct.Struct("@16xqq16xI4x")
"""Ancillary data: header and timespec, then header and the count of lost frames, which is there once there are any."""

_TIME_ALONE = 32
"""Bytes of ancillary data while no frame was lost."""


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Header(ctypes.Structure):
    """struct msghdr."""

    _fields_ = (
        ("name", ctypes.c_void_p),
        ("name_length", ctypes.c_uint32),
        ("vectors", ctypes.POINTER(_IoVector)),
        ("vector_count", ctypes.c_size_t),
        ("control", ctypes.c_void_p),
        ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )


class _Message(ctypes.Structure):
    """struct mmsghdr."""

    _fields_ = (("header", _Header), ("received", ctypes.c_uint))


_recvmmsg = ctypes.CDLL(None, use_errno=True).recvmmsg


class CanTap:
    """A listening socket on interface `channel`, whose frames get bus index `bus`.

    `lost` counts the frames that found its buffer full. Raises OSError where there is no such interface.
    """

    def __init__(self, channel: str, bus: int) -> None:
        self.channel = channel
        self.lost = 0
        self._bus = bus
        self._data = ctypes.create_string_buffer(MOST * _FRAME.size)
        self._control = ctypes.create_string_buffer(MOST * _CONTROL.size)
        data, control = ctypes.addressof(self._data), ctypes.addressof(self._control)
        self._vectors = (_IoVector * MOST)()
        self._messages = (_Message * MOST)()
        for place, (vector, message) in enumerate(zip(self._vectors, self._messages, strict=True)):
            vector.base, vector.length = data + place * _FRAME.size, _FRAME.size
            header = message.header
            header.vectors, header.vector_count = ctypes.pointer(vector), 1
            header.control, header.control_length = control + place * _CONTROL.size, _CONTROL.size
        self._socket = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        try:
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, _SO_RXQ_OVFL, 1)
            self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
            with contextlib.suppress(PermissionError):
                self._socket.setsockopt(socket.SOL_SOCKET, _SO_RCVBUFFORCE, RECEIVE_BUFFER)
            self._socket.setsockopt(socket.SOL_CAN_RAW, _CAN_RAW_ERR_FILTER, _ERROR_CLASSES)
            self._socket.bind((channel,))
        except OSError:
            self._socket.close()
            raise

    def read(self, into: list[CanFrame]) -> None:
        """Take all that has gathered. Raises OSError once when the interface went down; it is heard again when up."""
        messages, descriptor = self._messages, self._socket.fileno()
        count = MOST
        while count == MOST:
            count = _recvmmsg(descriptor, messages, MOST, socket.MSG_DONTWAIT, None)
            if count < 0:
                number = ctypes.get_errno()
                if number in (errno.EAGAIN, errno.EINTR):
                    return
                raise OSError(number, os.strerror(number))
            self._take(count, into)

    def _take(self, count: int, into: list[CanFrame]) -> None:
        bus = self._bus
        frames, control = _FRAME.iter_unpack(self._data), _CONTROL.iter_unpack(self._control)
        lost = 0
        for _, (flagged, length, data), (seconds, nanoseconds, lost) in zip(  # noqa: B007
            range(count), frames, control, strict=False
        ):
            timestamp_ns = seconds * 1_000_000_000 + nanoseconds
            if flagged <= 0x7FF:
                into.append(CanFrame(timestamp_ns, flagged, data[:length], bus))
                continue
            error, extended, remote = flagged & _ERROR, flagged & _EXTENDED, flagged & _REMOTE
            can_id = flagged & (0x1FFFFFFF if extended or error else 0x7FF)
            flags = (bool(extended and not error), bool(remote), bool(error))
            into.append(CanFrame(timestamp_ns, can_id, data[:length], bus, *flags))
        if count and self._messages[count - 1].header.control_length > _TIME_ALONE:
            self.lost = lost
        for place in range(count):
            self._messages[place].header.control_length = _CONTROL.size

    def close(self) -> None:
        self._socket.close()
