"""The dashboard's server in a thread."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn

from upright.service.dashboard.app import Dashboard
from upright.service.dashboard.guard import LIMITS

TOKEN = "token-of-the-tests"


@contextmanager
def served(dashboard: Dashboard) -> Iterator[str]:
    """The address of the dashboard, served until the block ends."""
    place = socket.create_server(("127.0.0.1", 0))
    server = uvicorn.Server(uvicorn.Config(dashboard.app, **LIMITS))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [place]})
    thread.start()
    try:
        yield f"http://localhost:{place.getsockname()[1]}/"
    finally:
        server.should_exit = True
        thread.join()
        place.close()


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listening(*ports: int) -> None:
    """Wait until something listens at these ports."""
    end = time.monotonic() + 20.0
    for port in ports:
        while True:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert time.monotonic() < end, f"nothing listens at {port}"
            time.sleep(0.05)
