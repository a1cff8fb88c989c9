"""Detects whether the machine itself stood still for longer than a real-time test allows.

A guest's processor is a share of its host's, which may take it away at any time without notice. A process that sleeps
at the highest priority of the guest and wakes up far too late has detected that.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

REPORTED = 0.1
"""Shortest standstill that is reported, s: half of what a vehicle file for such a machine tolerates (`rig.patient`)."""


class MachineStoodStill(Exception):
    """The machine delayed the failed test, so that the failure shows nothing: the test is run again."""


class Witness:
    """A process, of the highest priority if possible, that records every standstill above `REPORTED` in a file."""

    def __init__(self, file: Path) -> None:
        self.file = file
        file.touch()
        ahead = ["chrt", "--fifo", "90"] if shutil.which("chrt") else []
        self._process = subprocess.Popen([*ahead, sys.executable, "-S", __file__, str(file)])

    def longest_since(self, start: float) -> float:
        """s, the longest standstill since `start` (of `time.monotonic`); 0 if there was none."""
        seen = [tuple(map(float, line.split())) for line in self.file.read_text().splitlines()]
        return max((lasted for at, lasted in seen if at >= start), default=0.0)

    def close(self) -> None:
        self._process.terminate()
        self._process.wait()


def _watch(file: Path, pause: float = 0.02) -> None:
    parent, before = os.getppid(), time.monotonic()
    while os.getppid() == parent:
        time.sleep(pause)
        now = time.monotonic()
        if now - before > REPORTED:
            with file.open("a") as log:
                log.write(f"{now} {now - before}\n")
        before = now


if __name__ == "__main__":
    _watch(Path(sys.argv[1]))
