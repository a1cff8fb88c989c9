"""Tasks for the tests of `service.spread`, which a spawned worker can import."""

from __future__ import annotations

import os
import signal
import time

from upright.service.spread import PACK

DEADLY, WRONG, SLOW = 13, 7, 21
SECONDS = 1.5 * PACK
"""s that the slow one takes: a worker has no time for another one."""


def square(task: int) -> tuple[int, int]:
    """The task and its square."""
    if task == WRONG:
        raise ValueError("a wrong one")
    if task == SLOW:
        time.sleep(SECONDS)
    return task, task * task


def square_or_die(task: int) -> tuple[int, int]:
    """The same, but one of the tasks kills its worker."""
    if task == DEADLY:
        os.kill(os.getpid(), signal.SIGKILL)
    return square(task)


def failed(task: int, reason: str) -> tuple[int, str]:
    """The task and the reason."""
    return task, reason
