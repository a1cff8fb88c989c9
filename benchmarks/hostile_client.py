"""One client of the daemon's control socket that misbehaves, until it is killed: hostile_client.py KIND SOCKET

For benchmarks/clients.py. It imports little, so that it begins at once.
"""

from __future__ import annotations

import os
import socket
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

HELD = 250
"""Connections that one of four processes holds."""


@contextmanager
def connected(path: str) -> Iterator[socket.socket]:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(2.0)
        connection.connect(path)
        yield connection


def hammer(path: str) -> None:
    """Ask for the status again and again."""
    while True:
        with suppress(OSError), connected(path) as connection:
            connection.sendall(b'{"verb": "status"}\n')
            while connection.recv(65536):
                pass


def garbage(path: str) -> None:
    """Send what is no request."""
    while True:
        with suppress(OSError), connected(path) as connection:
            connection.sendall(os.urandom(200).replace(b"\n", b"") + b"\n" + b"[" * 4000 + b"\n")
            connection.recv(65536)


def never_reads(path: str) -> None:
    """Ask, and read no answer; renew a lease that it does not have as fast as that goes."""
    while True:
        with suppress(OSError), connected(path) as connection:
            connection.sendall(b'{"verb": "status"}\n')
            while True:
                connection.sendall(b'{"verb": "renew"}\n' * 200)


def thousand(path: str) -> None:
    """Hold as many connections open as possible, and open those anew that are closed."""
    held: list[socket.socket] = []
    while True:
        connection = socket.socket(socket.AF_UNIX)
        with suppress(OSError):
            connection.connect(path)
        held.append(connection)
        if len(held) >= HELD:
            held.pop(0).close()


def half_open(path: str) -> None:
    """Begin requests, and do not complete them."""
    while True:
        held = []
        for _ in range(100):
            connection = socket.socket(socket.AF_UNIX)
            with suppress(OSError):
                connection.connect(path)
                connection.sendall(b'{"verb": "sta')
            held.append(connection)
        for connection in held:
            connection.close()


def huge_lines(path: str) -> None:
    """Send lines without an end."""
    while True:
        with suppress(OSError), connected(path) as connection:
            while True:
                connection.sendall(b"x" * 65536)


KINDS: dict[str, Callable[[str], None]] = {
    "hammer": hammer,
    "garbage": garbage,
    "never reads": never_reads,
    "thousand": thousand,
    "half open": half_open,
    "huge lines": huge_lines,
}


if __name__ == "__main__":
    print("begun", flush=True)
    KINDS[sys.argv[1]](sys.argv[2])
