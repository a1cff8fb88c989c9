"""Cases over the cores of this machine, or over machines with Dask. Either gives the lines as they come.

A worker process that is killed (memory, a crash in compiled code) takes no case with it: what it was at is begun again,
at most `TRIES` times. Cases that were under way together when one was killed go on one by one, so that only the one at
fault runs out of tries.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any
from uuid import uuid4

from service.hidden_effects import trial
from service.hidden_effects.cases import Case
from service.hidden_effects.results.trials import failed
from service.hidden_effects.trial import Bench, Line
from telemetry.errors import UprightError

TRIES = 3
"""Times that a case is begun whose worker dies."""
CONNECT_TIMEOUT = 10.0
"""s to find a Dask scheduler."""

Detectable = Callable[[Case], Mapping[str, float]]
"""What a case's reference says of how small an effect can be seen."""
Spread = Callable[[Sequence[Case], Bench, Detectable], Iterator[Line]]
"""Runs cases in any order."""


class SchedulerError(UprightError):
    """The machines cannot be reached. `address` is the scheduler's."""

    def __init__(self, address: str, message: str, *, remedy: str) -> None:
        super().__init__(f"scheduler {address}: {message}.", remedy=remedy)
        self.address = address


def processes(workers: int) -> Spread:
    """Over `workers` processes of this machine."""

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
    """Runs what is `waiting` until all is done or the pool breaks; what was under way then becomes `suspects`."""
    with _Pool(workers) as pool:
        running: dict[Future[Line], Case] = {}
        broken = False
        while running or (waiting and not broken):
            # No more are submitted than there are workers: what is under way when one dies is then what it was at.
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
                except Exception as error:  # a mistake in one case must not cost the others
                    yield failed(case, bench, f"{type(error).__name__}: {error}")


def _alone(case: Case, bench: Bench, detectable: Detectable) -> Line:
    """A case whose worker may have died once already."""
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
    """A pool of spawned processes that leaves none behind, whatever ends it."""

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
        # Interrupted: what is under way is not waited for. It is not in the file, so a later run begins it again.
        started = set(multiprocessing.active_children()) - self._before
        self._pool.shutdown(wait=False, cancel_futures=True)
        for process in started:
            process.terminate()


def _quiet() -> None:
    """Ctrl-C in a terminal goes to all of its processes; the first one sees to the end of these."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)


def machines(address: str) -> Spread:
    """Over the workers of the Dask scheduler at `address`, as tcp://HOST:8786. Raises SchedulerError."""
    try:
        import distributed
    except ImportError as error:
        remedy = "install it here and on every worker: pip install 'upright[bench]'."
        raise SchedulerError(address, "Dask is not installed", remedy=remedy) from error
    # It has no types that could be checked.
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
                # Keys of Dask's are for ever: a case that is run again needs another.
                client.submit(trial.run, case, bench, detectable(case), key=f"{case.key}|{uuid4().hex}"): case
                for case in cases
            }
            try:
                for future in dask.as_completed(list(futures), loop=client.loop):
                    # The scheduler itself begins a case again whose worker died, and gives up after three deaths.
                    wrong = future.exception()
                    if wrong is None:
                        yield future.result()
                    else:
                        yield failed(futures[future], bench, f"{type(wrong).__name__}: {wrong}")
            finally:
                client.cancel(list(futures))

    return spread
