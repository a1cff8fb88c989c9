"""Distribute cases over the cores of this machine, or over machines with Dask. Both yield lines as they are finished.

If a worker process is killed (memory, a crash in compiled code), no case is lost: its case is started again, at most
`TRIES` times. Cases that were running together when a worker was killed are repeated one by one, so that only the one
at fault reaches the limit.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any
from uuid import uuid4

from upright.service.hidden_effects import trial
from upright.service.hidden_effects.cases import Case
from upright.service.hidden_effects.results.trials import failed
from upright.service.hidden_effects.trial import Bench, Line
from upright.telemetry.errors import UprightError

TRIES = 3
"""Maximum number of starts of a case whose worker dies."""
CONNECT_TIMEOUT = 10.0
"""Timeout for a Dask scheduler, s."""

Detectable = Callable[[Case], Mapping[str, float]]
"""The minimum detectable sizes for a case, from its reference case."""
Spread = Callable[[Sequence[Case], Bench, Detectable], Iterator[Line]]
"""Runs cases in any order."""


class SchedulerError(UprightError):
    """The scheduler at `address` cannot be reached."""

    def __init__(self, address: str, message: str, *, remedy: str) -> None:
        super().__init__(f"scheduler {address}: {message}.", remedy=remedy)
        self.address = address


def processes(workers: int) -> Spread:
    """Distribute over `workers` processes of this machine."""

    def spread(cases: Sequence[Case], bench: Bench, detectable: Detectable) -> Iterator[Line]:
        suspects: list[Case] = []
        waiting = list(reversed(cases))
        while waiting:
            yield from _together(waiting, suspects, workers, bench, detectable)
        for case in suspects:
            yield _alone(case, bench, detectable)

    return spread


def _together(
    waiting: list[Case], suspects: list[Case], workers: int, bench: Bench, detectable: Detectable
) -> Iterator[Line]:
    """Run the `waiting` cases until all are finished or the pool breaks; then running cases become `suspects`."""
    with _Pool(workers) as pool:
        running: dict[Future[Line], Case] = {}
        broken = False
        while running or (waiting and not broken):
            # At most one case per worker is submitted, so that only cases being run are affected when a worker dies.
            while waiting and len(running) < workers and not broken:
                case = waiting.pop()
                try:
                    running[pool.submit(trial.run, case, bench, detectable(case))] = case
                except BrokenProcessPool:
                    waiting.append(case)
                    broken = True
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                case = running.pop(future)
                try:
                    yield future.result()
                except BrokenProcessPool:
                    suspects.append(case)
                    broken = True
                except Exception as error:  # a failure of one case must not affect the others
                    yield failed(case, bench, f"{type(error).__name__}: {error}")


def _alone(case: Case, bench: Bench, detectable: Detectable) -> Line:
    """Run a case whose worker may have died once before."""
    for _ in range(TRIES - 1):
        with _Pool(1) as pool:
            try:
                return pool.submit(trial.run, case, bench, detectable(case)).result()
            except BrokenProcessPool:
                continue
            except Exception as error:
                return failed(case, bench, f"{type(error).__name__}: {error}")
    return failed(case, bench, f"its worker process died {TRIES} times")


class _Pool:
    """A pool of spawned processes that are terminated in any case when it ends."""

    def __init__(self, workers: int) -> None:
        spawn = multiprocessing.get_context("spawn")
        self._before = set(multiprocessing.active_children())
        self._pool = ProcessPoolExecutor(workers, mp_context=spawn, initializer=_quiet)

    def __enter__(self) -> ProcessPoolExecutor:
        return self._pool

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self._pool.shutdown()
            return
        # Interrupted: running cases are not awaited. They are not in the file, so a later run repeats them.
        started = set(multiprocessing.active_children()) - self._before
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in started:
            process.terminate()


def _quiet() -> None:
    """Ignore Ctrl-C, which a terminal sends to all of its processes; the first process ends the workers."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def machines(address: str) -> Spread:
    """Distribute over the workers of the Dask scheduler at `address`, as tcp://HOST:8786. Raises SchedulerError."""
    try:
        import distributed
    except ImportError as error:
        remedy = "install it here and on every worker: pip install 'upright[bench]'."
        raise SchedulerError(address, "Dask is not installed", remedy=remedy) from error
    # It has no type annotations.
    dask: Any = distributed

    def spread(cases: Sequence[Case], bench: Bench, detectable: Detectable) -> Iterator[Line]:
        if not cases:
            return
        try:
            client = dask.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            remedy = "start one with `dask scheduler`, and `dask worker ADDRESS` on each machine."
            raise SchedulerError(address, f"does not answer ({error})", remedy=remedy) from error
        with client:
            futures = {
                # Dask keeps keys permanently: a case that is run again needs a new one.
                client.submit(trial.run, case, bench, detectable(case), key=f"{case.key}|{uuid4().hex}"): case
                for case in cases
            }
            try:
                for future in dask.as_completed(list(futures), loop=client.loop):
                    # The scheduler itself restarts a case whose worker died, and gives up after three times.
                    wrong = future.exception()
                    if wrong is None:
                        yield future.result()
                    else:
                        yield failed(futures[future], bench, f"{type(wrong).__name__}: {wrong}")
            finally:
                client.cancel(list(futures))

    return spread
