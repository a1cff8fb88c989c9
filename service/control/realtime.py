"""What keeps the control process from being held up: pages that are not there, garbage collection, its own threads.

**Pages.** All memory that is mapped after the set-up is loaded and locked (MCL_CURRENT), with the code that has never
run, as that of a quick stop; what is mapped later is locked when it is first touched (MCL_FUTURE | MCL_ONFAULT), so
that the stack of a thread does not take 8 MB. Only an unlimited RLIMIT_MEMLOCK allows it: with a limit, an allocation
beyond it would fail in the middle of a run.

**Garbage.** What exists after the set-up stays, and is taken out of the collector's sight (gc.freeze). The automatic
collection is switched off: it strikes in the middle of a cycle. `collect` is called between cycles instead. Cyclic
garbage comes from setting up drives and from exceptions, and none from cycles. So at rest everything is collected each
time, in a fraction of a ms, and during an experiment only beyond `MOST_YOUNG` objects, which bounds the memory however
long an experiment lasts.

**Threads.** One that computes, as the design of a controller does, yields to the loop after `SWITCH_INTERVAL`; Python's
own 5 ms are more than a cycle.
"""

from __future__ import annotations

import ctypes
import gc
import os
import resource
import sys

MCL_CURRENT, MCL_FUTURE, MCL_ONFAULT = 1, 2, 4

MOST_YOUNG = 10_000
"""Objects since the last collection that a running experiment may leave: looking at them takes a few ms."""

SWITCH_INTERVAL = 5e-4
"""s for which a thread may go on while the loop waits for the interpreter."""

REMEDY = (
    "install systemd/upright.service.d/realtime.conf, or give LimitMEMLOCK=infinity to the unit "
    "(`ulimit -l unlimited` in a terminal)"
)


def settle(*, lock: bool = True) -> str:
    """Freeze what exists, switch automatic collection off, let threads yield and, if `lock`, lock the memory.

    Call it after the set-up. Returns why the memory could not be locked, as a sentence with the remedy, or "".
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(SWITCH_INTERVAL)
    return lock_memory() if lock else ""


def collect(*, running: bool) -> None:
    """Collect garbage now, between two cycles. During a run only if much has accumulated."""
    if not gc.isenabled() and (not running or gc.get_count()[0] > MOST_YOUNG):
        gc.collect()


def lock_memory() -> str:
    """Lock the memory of this process. Returns why not, as a sentence with the remedy, or ""."""
    limit, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    if limit != resource.RLIM_INFINITY:
        return (
            f"The memory of the control process is not locked, as no more than {limit / 1e6:.0f} MB may be: when "
            f"memory runs short, a cycle may wait for the disk. Remedy: {REMEDY}."
        )
    library = ctypes.CDLL(None, use_errno=True)
    for flags in (MCL_CURRENT, MCL_FUTURE | MCL_ONFAULT):
        if library.mlockall(flags):
            why = os.strerror(ctypes.get_errno())
            library.munlockall()
            return f"The memory of the control process is not locked ({why}). Remedy: {REMEDY}."
    return ""
