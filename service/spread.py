"""Distribute tasks over the cores of this machine, or over machines with Dask. Both yield results as they are finished.

If a worker process is killed (memory, a crash in compiled code), no task is lost: it is started again, at most `TRIES`
times. Tasks that were submitted together when a worker was killed are repeated one by one, so that only the one at
fault reaches the limit.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeVar
from uuid import uuid4

from upright.telemetry.errors import UprightError

TRIES = 3
"""Maximum number of starts of a task whose worker dies."""
AHEAD = 2
"""Tasks submitted for each worker: the one that runs, and the next one."""
CONNECT_TIMEOUT = 10.0
"""Timeout for a Dask scheduler, s."""

Task = TypeVar("Task")
Result = TypeVar("Result")


@dataclass(frozen=True, slots=True)
class Work(Generic[Task, Result]):
    """What is done with each task: `run` in a worker, which has to be picklable, as its argument and its result; if it
    raises an exception or its worker dies, the result is that of `failed`, with the reason."""

    run: Callable[[Task], Result]
    failed: Callable[[Task, str], Result]


class Spread(Protocol):
    """Runs tasks in any order, and yields their results as they come."""

    def __call__(self, tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]: ...


class SchedulerError(UprightError):
    """The scheduler at `address` cannot be reached."""

    def __init__(self, address: str, message: str, *, remedy: str) -> None:
        super().__init__(f"scheduler {address}: {message}.", remedy=remedy)
        self.address = address


def processes(workers: int) -> Spread:
    """Distribute over `workers` processes of this machine."""

    def spread(tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
        suspects: list[Task] = []
        waiting = list(reversed(tasks))
        while waiting:
            yield from _together(waiting, suspects, workers, work)
        for task in suspects:
            yield _alone(task, work)

    return spread


def _together(waiting: list[Task], suspects: list[Task], workers: int, work: Work[Task, Result]) -> Iterator[Result]:
    """Run the `waiting` tasks until all are finished or the pool breaks; then those submitted become `suspects`."""
    with _Pool(workers) as pool:
        running: dict[Future[Result], Task] = {}
        broken = False
        while running or (waiting and not broken):
            # Few tasks are affected when a worker dies, and yet no worker waits for its next one.
            while waiting and len(running) < AHEAD * workers and not broken:
                task = waiting.pop()
                try:
                    running[pool.submit(work.run, task)] = task
                except BrokenProcessPool:
                    waiting.append(task)
                    broken = True
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                task = running.pop(future)
                try:
                    yield future.result()
                except BrokenProcessPool:
                    suspects.append(task)
                    broken = True
                except Exception as error:  # a failure of one task must not affect the others
                    yield work.failed(task, _words(error))


def _alone(task: Task, work: Work[Task, Result]) -> Result:
    """Run a task whose worker may have died once before."""
    for _ in range(TRIES - 1):
        with _Pool(1) as pool:
            try:
                return pool.submit(work.run, task).result()
            except BrokenProcessPool:
                continue
            except Exception as error:
                return work.failed(task, _words(error))
    return work.failed(task, f"its worker process died {TRIES} times")


def _words(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}"


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
        # Interrupted: running tasks are not awaited. They have no result, so a later run repeats them.
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
        remedy = "install it here and on every worker: pip install 'upright[fleet]'."
        raise SchedulerError(address, "Dask is not installed", remedy=remedy) from error
    # It has no type annotations.
    dask: Any = distributed

    def spread(tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
        if not tasks:
            return
        try:
            client = dask.Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, TimeoutError) as error:
            remedy = "start one with `dask scheduler`, and `dask worker ADDRESS` on each machine."
            raise SchedulerError(address, f"does not answer ({error})", remedy=remedy) from error
        with client:
            # Dask keeps keys permanently: a task that is run again needs a new one.
            futures = {client.submit(work.run, task, key=f"task-{uuid4().hex}"): task for task in tasks}
            try:
                for future in dask.as_completed(list(futures), loop=client.loop):
                    # The scheduler itself restarts a task whose worker died, and gives up after three times.
                    wrong = future.exception()
                    yield future.result() if wrong is None else work.failed(futures[future], _words(wrong))
            finally:
                client.cancel(list(futures))

    return spread
