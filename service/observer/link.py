"""The pipe between control and observer: messages over a SOCK_SEQPACKET pair of Unix sockets.

A message is one packet, and its first byte is its kind: a batch of control cycles, a batch of raw CAN frames, or a JSON
object. Packets are sent completely or not at all: if the pipe is full, the message is dropped, and the following ones
stay synchronised. Numbers are in the machine's own byte order, as both ends are on one machine.
"""

from __future__ import annotations

import asyncio
import json
import socket
import struct
from collections.abc import Sequence
from typing import Any

from upright.telemetry.samples import CanFrame, Frame

FRAMES = b"F"
CAN_FRAMES = b"C"
JSON = b"J"

LARGEST = 131072
"""Maximum size of a packet, bytes: half of the kernel's default socket buffer, so that it fits beside waiting ones."""

BUFFER = 1 << 20
"""Bytes of socket buffer requested, half a minute at 250 Hz; the kernel grants what net.core.wmem_max allows."""

_CAN = struct.Struct("=qIBBB8s")
_EXTENDED, _REMOTE, _ERROR = 1, 2, 4


def pair() -> tuple[socket.socket, socket.socket]:
    """Two connected ends, both non-blocking."""
    ends = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    for end in ends:
        end.setblocking(False)
        end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, BUFFER)
    return ends


def receive(connection: socket.socket) -> bytes:
    """The next packet, also of an end that is gone; b"" if there will be none.

    Raises BlockingIOError if there is none yet. Where the other end went without reading all it was sent, the kernel
    reports that first (ECONNRESET), and after it what that end had sent.
    """
    try:
        return connection.recv(LARGEST)
    except ConnectionResetError:
        return connection.recv(LARGEST)


async def receive_soon(connection: socket.socket) -> bytes:
    """As `receive`, waiting for it."""
    loop = asyncio.get_running_loop()
    try:
        return await loop.sock_recv(connection, LARGEST)
    except ConnectionResetError:
        return await loop.sock_recv(connection, LARGEST)


class FrameCodec:
    """Batches of control cycles with `channels` values each."""

    def __init__(self, channels: int) -> None:
        self._frame = struct.Struct(f"=q{channels}d")
        self.most = (LARGEST - 1) // self._frame.size

    def pack(self, frames: Sequence[Frame]) -> bytes:
        """One packet of up to `most` frames."""
        pack = self._frame.pack
        return FRAMES + b"".join([pack(frame.timestamp_ns, *frame.values) for frame in frames])

    def unpack(self, packet: bytes) -> list[Frame]:
        return [Frame(row[0], row[1:]) for row in self._frame.iter_unpack(memoryview(packet)[1:])]


def pack_can(frames: Sequence[CanFrame]) -> bytes:
    """One packet of raw frames, at most LARGEST / 23 of them."""
    packed = [
        _CAN.pack(
            frame.timestamp_ns,
            frame.can_id,
            frame.extended * _EXTENDED + frame.remote * _REMOTE + frame.error * _ERROR,
            frame.bus,
            len(frame.data),
            frame.data,
        )
        for frame in frames
    ]
    return CAN_FRAMES + b"".join(packed)


def unpack_can(packet: bytes) -> list[CanFrame]:
    return [
        CanFrame(
            stamp, can_id, data[:length], bus, bool(flags & _EXTENDED), bool(flags & _REMOTE), bool(flags & _ERROR)
        )
        for stamp, can_id, flags, bus, length, data in _CAN.iter_unpack(memoryview(packet)[1:])
    ]


def pack_json(message: dict[str, Any]) -> bytes:
    """One packet of a JSON object. Raises ValueError if it is larger than the maximum size."""
    packet = JSON + json.dumps(message, separators=(",", ":")).encode()
    if len(packet) > LARGEST:
        raise ValueError(f"a message of {len(packet)} bytes; the limit is {LARGEST}")
    return packet


def unpack_json(packet: bytes) -> dict[str, Any]:
    message: dict[str, Any] = json.loads(memoryview(packet)[1:].tobytes())
    return message
