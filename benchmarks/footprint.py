"""Measure the idle cost of upright: CPU time of `--help`, time until the daemon answers, memory of its processes.

    .venv/bin/python benchmarks/footprint.py

Peers in the same run: `python -c pass` for the help; for the memory, a process that only imports the libraries that the
control process needs (numpy, scipy, filterpy, canopen, python-can without the optional asammdf).
"""

from __future__ import annotations

import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from upright.service.control.clients.api import ApiError, call

BUS = "udp_multicast:239.74.163.77"
UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]
LIBRARIES = "numpy, scipy.linalg, filterpy.kalman, canopen, can"
IMPORTS = f"import sys; sys.modules['asammdf'] = None; import {LIBRARIES}; sys.stdin.read()"
RUNS = 5


def cpu_of(command: list[str]) -> float:
    """CPU time in s, the minimum of several runs."""
    least = float("inf")
    for _ in range(RUNS):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        least = min(least, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime)
    return least


def memory_of(pid: int) -> float:
    """Resident memory, MB."""
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) / 1024
    raise ProcessLookupError(pid)


def children_of(pid: int) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def main() -> None:
    """Print the figures."""
    bare, helped = cpu_of([sys.executable, "-c", "pass"]), cpu_of([*UPRIGHT, "--help"])
    print(f"upright --help    {helped:.2f} s of CPU ({helped / bare:.0f} x a bare Python)")
    with subprocess.Popen([sys.executable, "-c", IMPORTS], stdin=subprocess.PIPE) as peer:
        time.sleep(3.0)
        imports = memory_of(peer.pid)
        peer.communicate()
    with tempfile.TemporaryDirectory() as folder:
        socket = Path(folder) / "s.sock"
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        with (
            subprocess.Popen([*UPRIGHT, "simulate", "monocab", "--bus", BUS], **quiet) as vehicle,
            subprocess.Popen(
                [*UPRIGHT, "serve", "monocab", "--bus", BUS, "--data", folder, "--socket", str(socket)], **quiet
            ) as daemon,
        ):
            begin = time.monotonic()
            answered = 0.0
            while time.monotonic() - begin < 30.0:
                try:
                    status = list(call([socket], {"verb": "status"}))[-1]["status"]
                except ApiError:
                    time.sleep(0.02)
                    continue
                answered = answered or time.monotonic() - begin
                if status["mode"] == "disarmed" and not status["interlocks"]:
                    break
                time.sleep(0.05)
            ready = time.monotonic() - begin
            print(f"daemon            answers after {answered:.1f} s, vehicle ready after {ready:.1f} s")
            control = memory_of(daemon.pid)
            print(f"control process   {control:.0f} MB ({control / imports:.2f} x its libraries only)")
            for child in children_of(daemon.pid):
                print(f"  child process   {memory_of(child):.0f} MB")
            daemon.terminate()
            daemon.wait()
            vehicle.terminate()


if __name__ == "__main__":
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    main()
