"""Faults of the daemon and its machine: held up, or without its observer."""

from __future__ import annotations

from collections.abc import Callable

from faults import clues
from faults.bench import Bench
from faults.fault import Fault, harmless, in_order, stopped
from upright.vehicles.bounds import Code


def held_up(seconds: float) -> Callable[[Bench], None]:
    """The daemon does not get the processor for this long; frames wait for it."""

    def inject(bench: Bench) -> None:
        bench.held, left = True, round(seconds * bench.vehicle.control.rate)

        def wait() -> None:
            nonlocal left
            left -= 1
            if left == 0:
                bench.held = False

        bench.each_cycle.append(wait)

    return inject


def again_and_again(seconds: float, every: float) -> Callable[[Bench], None]:
    """The same, every so often."""

    def inject(bench: Bench) -> None:
        rate, count = bench.vehicle.control.rate, 0

        def wait() -> None:
            nonlocal count
            count += 1
            bench.held = count % round(every * rate) < round(seconds * rate)

        bench.each_cycle.append(wait)

    return inject


def observer_gone(bench: Bench) -> None:
    bench.witness.ready = False
    bench.loop.observer_gone()


FAULTS: tuple[Fault, ...] = (
    *(
        harmless(f"held_up_{ms}ms", f"the daemon is held up for {ms} ms", held_up(ms * 1e-3), passes=True)
        for ms in (4, 8, 20)
    ),
    harmless(
        "held_up_again",
        "the daemon is held up for 4 ms ten times a second",
        again_and_again(0.004, 0.1),
        why="jitter of one cycle",
    ),
    *(
        stopped(
            f"held_up_{ms}ms",
            f"the daemon is held up for {ms} ms",
            held_up(ms * 1e-3),
            Code.DEADLINE,
            Code.IMU_SILENT,
            Code.DRIVE_EMERGENCY,
            since=clues.awake,
            passes=True,
            why="known when it gets the processor again; what takes longer than 120 ms the drives notice, and stop",
        )
        for ms in (40, 60, 200, 1000)
    ),
    in_order("observer_gone", "the observer process ends", observer_gone, says=("observer",)),
)
