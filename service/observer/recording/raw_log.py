"""The raw log process: writes all frames on one or two SocketCAN interfaces to candump files, on request.

    python -m upright.service.observer.recording.raw_log can0 [can1] [--base NS]

Orders come as lines on stdin: `open START_NS PATH`, `close END_NS`, `quit`. For each closed file and each error, a line
of JSON is written to stdout. Times are those of the control process, whose clock has the base NS
(`drivers.bus.frame_clock`). The process has sockets of its own with the kernel's receive times, reads the waiting
frames every 20 ms and writes them in the order of time. If stdin ends without `quit`, its master has died: it logs for
`GRACE` s more, so that the log shows how the drives stopped, and then closes the file. It imports very little.
"""

from __future__ import annotations

import json
import os
import select
import signal
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import IO

from upright.drivers.bus.frame_clock import FrameClock
from upright.drivers.bus.socketcan import start_clock
from upright.service.observer.cpus import leave_to_control
from upright.service.observer.recording.can_tap import CanTap
from upright.telemetry.candump import format_frames
from upright.telemetry.samples import CanFrame

READ_PERIOD = 0.02
"""s between two reads of the sockets."""

SYNC_PERIOD = 1.0
"""s between two synchronisations of the file with the disk."""

GRACE = 2.0
"""s of logging after the master's death."""

SETTLED_NS = 5_000_000
"""A frame is written when it is older than this: by then the other interface has delivered its older ones, too."""

NICENESS = 5


class RawLog:
    """One log file, from `open` to `close`. `channels` are the interfaces, in the order of their bus index."""

    def __init__(self, channels: Sequence[str], base_ns: int | None = None) -> None:
        self.channels = tuple(channels)
        self._clock = start_clock() if base_ns is None else FrameClock(base_ns)
        self.end_ns = 0
        """The file is closed after this time; 0 while it is not known."""
        self._file: IO[str] | None = None
        self._taps: list[CanTap] = []
        self._waiting: list[CanFrame] = []
        self._start_ns = 0
        self._frames = 0
        self._synced = 0.0

    @property
    def is_open(self) -> bool:
        return self._file is not None

    def open(self, path: Path, start_ns: int) -> None:
        """Log to the new file `path` from `start_ns` on. Raises OSError."""
        self.close()
        path.parent.mkdir(parents=True, exist_ok=True)
        self._file = path.open("x", encoding="ascii")
        self._start_ns, self.end_ns, self._frames = start_ns, 0, 0
        try:
            self._taps = [CanTap(channel, bus, self._clock) for bus, channel in enumerate(self.channels)]
        except OSError:
            self.close()
            raise

    def step(self) -> None:
        """Read, and write the frames that no older frame can precede any more. Raises OSError."""
        horizon_ns = time.monotonic_ns() + self._clock.base_ns - SETTLED_NS
        for tap in self._taps:
            listen(tap, self._waiting)
        self._write(horizon_ns)
        if self._file is not None and time.monotonic() - self._synced > SYNC_PERIOD:
            self._synced = time.monotonic()
            self._file.flush()
            os.fsync(self._file.fileno())
        if self.end_ns and horizon_ns > self.end_ns:
            self.close()

    def close(self) -> None:
        """Write all received frames, close the file, if one is open, and report it on stdout. Raises OSError."""
        file, taps, waiting = self._file, self._taps, self._waiting
        self._file, self._taps, self._waiting = None, [], []
        for tap in taps:
            listen(tap, waiting)
            tap.close()
        waiting.sort(key=lambda frame: frame.timestamp_ns)
        if file is None:
            return
        try:
            with file:
                self._write_to(file, waiting)
                file.flush()
                os.fsync(file.fileno())
        finally:
            report(path=file.name, frames=self._frames, lost=sum(tap.lost for tap in taps))

    def _write(self, horizon_ns: int) -> None:
        self._waiting.sort(key=lambda frame: frame.timestamp_ns)
        ready = sum(frame.timestamp_ns < horizon_ns for frame in self._waiting)
        if ready and self._file is not None:
            self._write_to(self._file, self._waiting[:ready])
            del self._waiting[:ready]

    def _write_to(self, file: IO[str], frames: Sequence[CanFrame]) -> None:
        end_ns = self.end_ns or (1 << 62)
        wanted = [frame for frame in frames if self._start_ns <= frame.timestamp_ns <= end_ns]
        self._frames += len(wanted)
        file.write(format_frames(wanted, self.channels))


def listen(tap: CanTap, into: list[CanFrame]) -> None:
    """Take the received frames. An interface that goes down is reported, and read again when it is back."""
    try:
        tap.read(into)
    except OSError as error:
        report(error=f"{tap.channel}: {error.strerror}")


def report(**account: object) -> None:
    """Write a line of JSON for the master; discard it if the master has ended."""
    try:
        sys.stdout.write(json.dumps(account) + "\n")
        sys.stdout.flush()
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def main(channels: Sequence[str], base_ns: int | None = None) -> None:
    # Only the end of stdin ends this process: a stopped service first ends its experiment, which shall be in the log.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    os.nice(NICENESS)
    leave_to_control()
    log = RawLog(channels, base_ns)
    orders = Orders()
    while True:
        if select.select([sys.stdin], (), (), READ_PERIOD if log.is_open else None)[0]:
            for order in orders.read():
                obey(log, order)
            if orders.ended:
                break
        follow(log)
    if log.is_open and not orders.quit:
        limit = time.monotonic() + GRACE
        while log.is_open and time.monotonic() < limit:
            time.sleep(READ_PERIOD)
            follow(log)
    attempt(log.close)


class Orders:
    """Lines of stdin, read without waiting. `ended`: there will be no more; `quit`: the master requested it."""

    def __init__(self) -> None:
        self.ended = False
        self.quit = False
        self._rest = b""

    def read(self) -> list[str]:
        content = os.read(sys.stdin.fileno(), 65536)
        *lines, self._rest = (self._rest + content).split(b"\n")
        self.quit = self.quit or b"quit" in lines
        self.ended = self.quit or not content
        return [line.decode() for line in lines if line != b"quit"]


def obey(log: RawLog, order: str) -> None:
    verb, _, arguments = order.partition(" ")
    if verb == "open":
        start_ns, _, path = arguments.partition(" ")
        attempt(partial(log.open, Path(path), int(start_ns)))
    elif verb == "close":
        log.end_ns = int(arguments)


def follow(log: RawLog) -> None:
    """Log the received frames; an error, such as a full disk, closes the file."""
    if log.is_open and not attempt(log.step):
        attempt(log.close)


def attempt(action: Callable[[], None]) -> bool:
    """Execute `action`; return whether it succeeded, and report a failure on stdout."""
    try:
        action()
    except OSError as error:
        report(error=f"raw log: {error}")
        return False
    return True


if __name__ == "__main__":
    names = sys.argv[1:]
    given = names.index("--base") if "--base" in names else len(names)
    main(names[:given], int(names[given + 1]) if given < len(names) else None)
