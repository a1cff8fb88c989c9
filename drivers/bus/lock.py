"""One master on a bus: a lock that belongs to the bus itself, and that its holder cannot leave behind.

The lock is an abstract Unix socket named after the address of the bus. Such names live in the network namespace, as CAN
interfaces do, need no folder, and vanish with their process. Who connects to it learns the holder's process id from the
kernel (SO_PEERCRED). The buses of python-can's interface `virtual` exist within a process, and need no lock.
"""

from __future__ import annotations

import asyncio
import errno
import os
import socket
import struct
from collections.abc import Iterable
from contextlib import ExitStack, suppress
from pathlib import Path

from upright.drivers.bus.address import split
from upright.drivers.bus.errors import BusError

LONGEST = 100
"""Characters of a name, of the 108 bytes that the kernel allows."""
WAITING = 8
"""Processes that may ask who holds the lock before they are answered."""


class BusLock:
    """The lock on the bus at `address`, held until `close`. Raises BusError, which names the holder, if it is taken."""

    def __init__(self, address: str) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind(_name(address))
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EADDRINUSE:
                raise BusError(f"{address} cannot be locked: {error.strerror}.", bus=address) from error
            raise BusError(
                f"{address} is already served by {_holder(address)}; two masters on a bus would drop the vehicle.",
                bus=address,
                remedy="stop that one first (systemctl stop upright), or give this one another --bus.",
            ) from error
        self._socket.listen(WAITING)

    def start(self) -> None:
        """Let go of those who have asked; in a running event loop."""
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._socket, self._answer)

    def close(self) -> None:
        """Release the bus."""
        if self._loop is not None:
            self._loop.remove_reader(self._socket)
            self._loop = None
        self._socket.close()

    def _answer(self) -> None:
        with suppress(OSError):
            self._socket.accept()[0].close()


def lock_buses(addresses: Iterable[str]) -> list[BusLock]:
    """The locks on the buses at `addresses`, all of them or, with a BusError, none."""
    with ExitStack() as taken:
        locks = []
        for address in dict.fromkeys(addresses):
            if split(address)[0] != "virtual":
                locks.append(BusLock(address))
                taken.callback(locks[-1].close)
        taken.pop_all()
    return locks


def _name(address: str) -> str:
    return f"\0upright/bus/{address}"[:LONGEST]


def _holder(address: str) -> str:
    """The process that holds the lock, in words."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.setblocking(False)
        try:
            asking.connect(_name(address))
            credentials = asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, struct.calcsize("3i"))
        except OSError:
            return "another process"
    pid, _, _ = struct.unpack("3i", credentials)
    if pid == os.getpid():
        return "this process"
    words: list[str] = []
    with suppress(OSError):
        words = Path(f"/proc/{pid}/cmdline").read_bytes().decode(errors="replace").split("\0")
    if "serve" not in words:
        return f"process {pid}"
    return f"process {pid} (upright {' '.join(words[words.index('serve') :]).strip()})"
