"""Time from the last frame of an IMU set to the first setpoint frame: p50, p99, p99.9, compared with two echoes.

    tests/guest/vcan-guest .venv/bin/python benchmarks/turnaround.py --responder upright "upright serve ..."

The responders answer the same source, one after the other, on the same interface: an echo in C (the cost of kernel and
scheduler), an echo in Python (which adds the interpreter) and the responders given. Both frames have time stamps of the
kernel at a third socket. A process of the lowest priority reads them in large batches, so that the measurement does not
disturb the responders. A set whose answer comes after the next set, or never, is a missed cycle.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from upright.drivers.bus.bus import Bus, BusError

HERE = Path(__file__).resolve().parent
READ_PERIOD = 0.2
"""s between reads: the frames of that time have to fit into the receive buffer of an unprivileged process (500)."""
READY_TIME = 60.0
"""s for a responder's first answer: a daemon first sets up its drives."""
SETTLE_TIME = 2.0
"""s from the first answer to the start of the measurement."""


@dataclass(frozen=True, slots=True)
class Turnaround:
    """The turnaround of one responder. Times in s; `ratio` is the median over that of the Python echo."""

    responder: str
    rate: float
    cycles: int
    missed: int
    p50: float
    p99: float
    p999: float
    longest: float
    ratio: float = float("nan")


class ResponderError(Exception):
    """A responder did not answer or has terminated."""


def listening(address: str, can_ids: Sequence[int]) -> Bus:
    """A bus to be drained from time to time, without an event loop. Raises BusError."""
    bus = Bus.open(address, can_ids=can_ids)
    if not address.startswith("socketcan:"):  # a thread of it reads, and would wake the loop
        bus._port.start(asyncio.new_event_loop(), lambda: None)
    return bus


class Monitor:
    """Kernel receive times (ns) of trigger and reply frames on the bus at `address`."""

    def __init__(self, address: str, trigger: int, reply: int) -> None:
        self._bus = listening(address, [trigger, reply])
        self._trigger, self._reply = trigger, reply

    def read(self, seconds: float) -> tuple[list[int], list[int]]:
        """Times of the triggers and of the replies since the last read and during the next `seconds` s."""
        dropped = self._bus.statistics.receive_dropped
        triggers: list[int] = []
        replies: list[int] = []
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(READ_PERIOD)
            for timestamp_ns, can_id in self._drain():
                (triggers if can_id == self._trigger else replies).append(timestamp_ns)
        if self._bus.statistics.receive_dropped > dropped:
            raise ResponderError("the monitor itself was too slow: the kernel dropped frames for it")
        return triggers, replies

    def discard(self) -> None:
        """Forget what came until now, and what was lost of it, which the kernel says with the next frame."""
        for _ in range(2):
            for _ in self._drain():
                pass
            time.sleep(READ_PERIOD)

    def close(self) -> None:
        self._bus.close()

    def _drain(self) -> Iterator[tuple[int, int]]:
        while frames := self._bus.drain():
            yield from ((frame.timestamp_ns, frame.can_id) for frame in frames)


def answered(triggers: Sequence[int], replies: Sequence[int]) -> tuple[np.ndarray, int]:
    """Turnaround (n,) in s of each trigger with a reply before the next one, and the number of those without. All times
    in ns."""
    trigger = np.asarray(triggers, dtype=np.int64)
    reply = np.asarray(replies, dtype=np.int64)
    first = np.searchsorted(reply, trigger[:-1], side="right")
    there = first < reply.size
    there[there] = reply[first[there]] < trigger[1:][there]
    return (reply[first[there]] - trigger[:-1][there]) * 1e-9, int(np.count_nonzero(~there))


def evaluate(name: str, rate: float, triggers: Sequence[int], replies: Sequence[int]) -> Turnaround:
    """The turnaround of a responder. All times in ns."""
    times, missed = answered(triggers, replies)
    if times.size == 0:
        raise ResponderError(f"{name} answered no frame set in time")
    p50, p99, p999 = np.quantile(times, (0.5, 0.99, 0.999))
    cycles = times.size + missed
    return Turnaround(name, rate, cycles, missed, float(p50), float(p99), float(p999), float(times.max()))


@contextmanager
def running(command: Sequence[str], log: Path) -> Iterator[subprocess.Popen[bytes]]:
    """A process that is terminated at the end of the block."""
    with log.open("wb") as output:
        process = subprocess.Popen(command, stdout=output, stderr=output, stdin=subprocess.DEVNULL)
    try:
        yield process
    finally:
        process.terminate()
        try:
            process.wait(30.0)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


def measure(
    name: str, command: Sequence[str], source: Sequence[str], monitor: Monitor, rate: float, seconds: float, work: Path
) -> Turnaround:
    """Run source and responder and measure for `seconds` s. Raises ResponderError with the end of its output."""
    log = work / "responder.log"
    with running(source, work / "source.log"), running(command, log) as responder:
        limit = time.monotonic() + READY_TIME
        while not monitor.read(READ_PERIOD)[1]:
            if responder.poll() is not None or time.monotonic() > limit:
                tail = log.read_text(errors="replace")[-2000:]
                raise ResponderError(f"{name} does not answer the IMU frames ({shlex.join(command)}):\n{tail}")
        monitor.read(SETTLE_TIME)
        triggers, replies = monitor.read(seconds)
    return evaluate(name, rate, triggers, replies)


def compile_c(source: Path, work: Path) -> str:
    program = work / source.stem
    subprocess.run([os.environ.get("CC", "cc"), "-O2", "-Wall", "-Werror", "-o", program, source], check=True)
    return str(program)


def with_ratios(results: list[Turnaround]) -> list[dict[str, object]]:
    """The results as plain data, with the ratio to the Python echo of the same rate."""
    base = {result.rate: result.p50 for result in results if result.responder == "Python echo"}
    return [{**asdict(result), "ratio": result.p50 / base[result.rate]} for result in results]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--interface", default="vcan0")
    parser.add_argument("--rate", type=float, action="append", help="Hz, may be repeated (250 and 500)")
    parser.add_argument("--seconds", type=float, default=10.0, help="of measurement per responder and rate")
    parser.add_argument(
        "--trigger", type=lambda text: int(text, 16), default=0x38A, help="id that completes an IMU set"
    )
    parser.add_argument("--reply", type=lambda text: int(text, 16), default=0x201, help="id of the first setpoint")
    parser.add_argument("--responder", nargs=2, metavar=("NAME", "COMMAND"), action="append", default=[])
    parser.add_argument(
        "--source", help="command that sends the IMU frames ({rate} is filled in) instead of imu_source"
    )
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()

    # This process has the lowest priority; its child processes have the normal one again.
    os.sched_setscheduler(0, os.SCHED_IDLE | os.SCHED_RESET_ON_FORK, os.sched_param(0))
    ids = [options.interface, f"{options.trigger:X}", f"{options.reply:X}"]
    results: list[Turnaround] = []
    with ExitStack() as stack:
        work = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        try:
            monitor = Monitor(f"socketcan:{options.interface}", options.trigger, options.reply)
        except BusError as error:
            print(f"{error}\nOr run this in tests/guest/vcan-guest.", file=sys.stderr)
            return 1
        stack.callback(monitor.close)
        responders = {
            "C echo": [compile_c(HERE / "echo.c", work), *ids],
            "Python echo": [sys.executable, str(HERE / "echo.py"), *ids],
            **{name: shlex.split(command) for name, command in options.responder},
        }
        imu_source = compile_c(HERE / "imu_source.c", work)
        for rate in options.rate or (250.0, 500.0):
            source = (
                shlex.split(options.source.format(rate=rate))
                if options.source
                else [imu_source, options.interface, f"{rate:.0f}"]
            )
            for name, command in responders.items():
                try:
                    results.append(measure(name, command, source, monitor, rate, options.seconds, work))
                except ResponderError as error:
                    print(error, file=sys.stderr)
                    return 1
    rows = with_ratios(results)
    if options.json:
        print(json.dumps(rows))
        return 0
    print(f"{'':14}{'Hz':>5}{'p50':>9}{'p99':>9}{'p99.9':>9}{'longest':>9} us{'/ Python':>10}{'missed':>14}")
    for result, row in zip(results, rows, strict=True):
        times = "".join(f"{1e6 * t:9.0f}" for t in (result.p50, result.p99, result.p999, result.longest))
        missed = f"{result.missed} of {result.cycles}"
        print(f"{result.responder:14}{result.rate:5.0f}{times}   {row['ratio']:9.2f}x{missed:>14}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
