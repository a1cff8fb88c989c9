"""A Dask scheduler with two workers on this machine, each a process of its own."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

SUPPORT = Path(__file__).resolve().parent


@contextmanager
def scheduler(folder: Path) -> Iterator[str]:
    """Its address; the workers run in `folder`, and find the program and the tests' stand-ins."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = [sys.executable, "-m", "dask"]
    common = ["--no-dashboard"]
    quiet: dict[str, Any] = {
        "env": environment(),
        "cwd": folder,
        "stdout": subprocess.DEVNULL,
        "stderr": subprocess.DEVNULL,
        "start_new_session": True,  # with the process that each worker starts for its tasks
    }
    started = [subprocess.Popen([*dask, "scheduler", "--host", "127.0.0.1", "--port", str(port), *common], **quiet)]
    worker = [*dask, "worker", address, "--nthreads", "1", "--nworkers", "1", *common]
    started += [subprocess.Popen(worker, **quiet) for _ in range(2)]
    try:
        until(lambda: _workers(address) == 2, 60.0)
        yield address
    finally:
        # Not SIGTERM: a worker that is just starting its process anew (a task killed it) may not end on it.
        for process in reversed(started):
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def _workers(address: str) -> int:
    code = (
        "import sys; from distributed import Client\n"
        "with Client(sys.argv[1], timeout=5) as client: print(len(client.scheduler_info(n_workers=-1)['workers']))"
    )
    done = subprocess.run([sys.executable, "-c", code, address], capture_output=True, text=True, timeout=60)
    return int(done.stdout) if done.returncode == 0 else 0


def environment() -> dict[str, str]:
    """The environment of a process that imports the program and the tests' support."""
    return {**os.environ, "PYTHONPATH": os.pathsep.join((str(SUPPORT), str(SUPPORT.parents[1])))}


def until(true: Callable[[], bool], limit: float) -> None:
    """Wait until something is `true`, for at most `limit` s."""
    end = time.monotonic() + limit
    while not true():
        assert time.monotonic() < end, f"not so after {limit:g} s"
        time.sleep(0.1)
