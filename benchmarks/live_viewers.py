"""Measure what a viewer of every cycle (`upright serve --foxglove`) costs the control loop, in one run.

    OPENBLAS_NUM_THREADS=1 python benchmarks/live_viewers.py [--rate 500] [--rounds 12] [--seconds 6]

A virtual MONOCAB at the given rate, paced by the wall clock, and its daemon; the observer is a process of its own, as
always. In each round there is a window with a viewer that has subscribed to every cycle, and one with a viewer that is
connected and idle, in an order of its own, so that what the computer does otherwise is in both. The viewers, which
would be on another computer, have the lowest priority.

Measured is the time in which the control process answers a frame set: by the wall clock, which has in it what other
processes and the vehicle's thread take, and as CPU time of the loop's thread. Printed are quantiles over all windows of
a kind, and the ratio of the quantiles of a round with its 95 % interval over the rounds.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np
from dashboard_parts import free_port
from dashboard_watchers import interval
from vehicle_at import at_rate

from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Daemon, Places
from upright.service.virtual.serving import virtual_vehicle_beside
from upright.telemetry.samples import CanFrame
from upright.vehicles.file import load

HERE = Path(__file__).resolve().parent
BUS = "virtual:benchmark-live-viewers"
QUANTILES = {"p50": 0.5, "p99": 0.99, "p99.9": 0.999}
CLOCKS = {"wall clock": time.perf_counter, "CPU time": time.thread_time}
KINDS = ("idle", "subscribed")
SETTLE = 0.5
"""s from the change of the viewers to the window."""

Windows = list[dict[str, np.ndarray]]
"""By round and kind: the times (cycles, clocks) in s."""


@contextmanager
def viewer(port: int, kind: str) -> Iterator[list[float]]:
    """A viewer in a process of its own; afterwards the list has the messages that it got per second of data."""
    command = ["nice", "-n", "19", sys.executable, str(HERE / "live_viewer.py"), str(port), kind]
    rate: list[float] = []
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        yield rate
        rate.append(float(process.communicate()[0]))


class Stopwatch:
    """The times in which a daemon answers frame sets, by each of CLOCKS, in s."""

    def __init__(self, daemon: Daemon) -> None:
        self.times: list[list[float]] = []
        self._loop = daemon.loop
        self._answer = daemon._on_frames
        daemon._on_frames = self._timed  # type: ignore[method-assign]

    def _timed(self, frames: list[CanFrame]) -> None:
        cycles, begin = self._loop.cycles, [clock() for clock in CLOCKS.values()]
        self._answer(frames)
        if self._loop.cycles > cycles:
            self.times.append([clock() - began for clock, began in zip(CLOCKS.values(), begin, strict=True)])


async def measure(rate: float, rounds: int, seconds: float, port: int) -> tuple[Windows, list[float]]:
    """A window of each kind in each round, and the messages that the viewers got per second of data."""
    orders, received = np.random.default_rng(1), list[float]()  # the seed is arbitrary
    with tempfile.TemporaryDirectory() as name:
        file, folder = Path(name) / "monocab.toml", Path(name)
        file.write_text(at_rate(rate))
        vehicle = load(file)
        with virtual_vehicle_beside(vehicle, ["disturbance=0"], 1, BUS):
            daemon = Daemon(vehicle, Places(BUS, BUS, folder, folder / "s.sock", foxglove_port=port), lock_step=True)
            stopwatch = Stopwatch(daemon)
            serving = asyncio.create_task(daemon.run())
            while daemon.loop.mode is not Mode.DISARMED or daemon.loop.interlocks():
                await asyncio.sleep(0.1)

            async def window(kind: str) -> np.ndarray:
                with ExitStack() as watching:
                    rates = await asyncio.to_thread(watching.enter_context, viewer(port, kind))
                    await asyncio.sleep(SETTLE)
                    stopwatch.times = []
                    await asyncio.sleep(seconds)
                    times = np.array(stopwatch.times)
                    await asyncio.to_thread(watching.close)
                if kind == "subscribed":
                    received.extend(rates)
                return times

            found = [{kind: await window(kind) for kind in orders.permutation(KINDS).tolist()} for _ in range(rounds)]
            daemon.stop()
            await serving
    return found, received


def report(rounds: Windows, received: list[float]) -> None:
    for place, clock in enumerate(CLOCKS):
        print(clock)
        for kind in KINDS:
            times = np.concatenate([each[kind][:, place] for each in rounds])
            quantiles = ", ".join(f"{name} {1e6 * np.quantile(times, q):.0f} us" for name, q in QUANTILES.items())
            print(f"  {kind}: {times.size} cycles, {quantiles}")
        for name, q in QUANTILES.items():
            seen, alone = (np.array([np.quantile(each[kind][:, place], q) for each in rounds]) for kind in KINDS[::-1])
            low, centre, high = np.exp(interval(np.log(seen / alone)))
            print(f"  {name}: subscribed over idle {centre:.3f}, 95 % interval {low:.3f} to {high:.3f}")
    print(f"subscribed viewers got {np.mean(received):.1f} messages per second of data, at least {min(received):.1f}")
    print(f"load of the computer {os.getloadavg()[0]:.1f}, processors {len(os.sched_getaffinity(0))}")


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rate", type=float, default=500.0, help="Hz")
    parser.add_argument("--rounds", type=int, default=12)
    parser.add_argument("--seconds", type=float, default=6.0, help="of each window")
    options = parser.parse_args()
    report(*asyncio.run(measure(options.rate, options.rounds, options.seconds, free_port())))


if __name__ == "__main__":
    main()
