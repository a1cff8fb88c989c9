"""Distribute tasks over the cores of this machine, or over machines with Dask. Both yield results as they are finished.

Tasks are handed over in packs, of which a worker does as much as it can in `PACK` s: what a pack costs beside its tasks
then hardly counts, however short they are, and an interrupted run loses no more than that of what was finished.

If a worker process is killed (memory, a crash in compiled code), no task is lost: each of its pack is started again by
itself, so that only the one at fault reaches the limit of `TRIES` starts.
"""

from __future__ import annotations

import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from time import perf_counter
from typing import Any, Generic, Protocol, TypeVar, cast
from uuid import uuid4

from upright.telemetry.errors import UprightError

TRIES = 3
"""Maximum number of starts of a task whose worker dies."""
AHEAD = 2
"""Packs submitted for each worker: the one that it does, and the next one."""
PACK = 0.25
"""s after which a worker returns what it has finished. Handing over a pack takes some milliseconds, a few per cent of
that (`busy` of benchmarks/fleet.py), and no more than that is lost where a run is interrupted."""
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


@dataclass(frozen=True, slots=True)
class _Outcome(Generic[Result]):
    """`result` of a task, or why there is none."""

    result: Result | None
    reason: str = ""


def _do(run: Callable[[Task], Result], pack: Sequence[Task]) -> list[_Outcome[Result]]:
    """In a worker: the outcomes of the first tasks of a pack, at least of one, as many as `PACK` s are enough for."""
    outcomes: list[_Outcome[Result]] = []
    end = perf_counter() + PACK
    for task in pack:
        try:
            outcomes.append(_Outcome(run(task)))
        except Exception as error:  # a failure of one task must not affect the others
            outcomes.append(_Outcome(None, _words(error)))
        if perf_counter() > end:
            break
    return outcomes


class _Waiting(Generic[Task]):
    """The tasks that no worker has yet, in packs of a size that has been found to fit `PACK`."""

    def __init__(self, tasks: Sequence[Task]) -> None:
        self._tasks = list(reversed(tasks))
        self._size = 1

    def __bool__(self) -> bool:
        return bool(self._tasks)

    def pack(self, workers: int) -> list[Task]:
        """The next pack; while there are enough tasks, as many are left for each of the `workers`."""
        size = min(self._size, max(1, len(self._tasks) // (AHEAD * workers)))
        return [self._tasks.pop() for _ in range(min(size, len(self._tasks)))]

    def again(self, tasks: Sequence[Task]) -> None:
        """These tasks were not begun."""
        self._tasks += reversed(tasks)

    def done(self, pack: Sequence[Task], done: int) -> None:
        """The first `done` tasks of a `pack` are finished, and a worker had no time for the others."""
        self.again(pack[done:])
        self._size = done if done < len(pack) else max(self._size, 2 * done)


def _results(pack: Sequence[Task], outcomes: Sequence[_Outcome[Result]], work: Work[Task, Result]) -> Iterator[Result]:
    """The results of the tasks that were done."""
    for task, outcome in zip(pack, outcomes, strict=False):
        yield work.failed(task, outcome.reason) if outcome.reason else cast("Result", outcome.result)


def processes(workers: int) -> Spread:
    """Distribute over `workers` processes of this machine."""

    def spread(tasks: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
        suspects: list[Task] = []
        waiting = _Waiting(tasks)
        while waiting:
            yield from _together(waiting, suspects, workers, work)
        yield from _one_by_one(suspects, work)

    return spread


def _together(
    waiting: _Waiting[Task], suspects: list[Task], workers: int, work: Work[Task, Result]
) -> Iterator[Result]:
    """Run the `waiting` tasks until all are finished or the pool breaks; then those submitted become `suspects`."""
    with _Pool(workers) as pool:
        running: dict[Future[list[_Outcome[Result]]], list[Task]] = {}
        broken = False
        while running or (waiting and not broken):
            # Few tasks are affected when a worker dies, and yet no worker waits for its next pack.
            while waiting and len(running) < AHEAD * workers and not broken:
                pack = waiting.pack(workers)
                try:
                    running[pool.submit(_do, work.run, pack)] = pack
                except BrokenProcessPool:
                    waiting.again(pack)
                    broken = True
            done, _ = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                pack = running.pop(future)
                try:
                    outcomes = future.result()
                except BrokenProcessPool:
                    suspects.extend(pack)
                    broken = True
                else:
                    waiting.done(pack, len(outcomes))
                    yield from _results(pack, outcomes, work)


def _one_by_one(suspects: Sequence[Task], work: Work[Task, Result]) -> Iterator[Result]:
    """Run tasks whose worker may have died once before, so that it is known which one is at fault."""
    left, starts = list(reversed(suspects)), 1
    while left:
        with _Pool(1) as pool:
            while left and starts < TRIES:
                try:
                    outcomes = pool.submit(_do, work.run, left[-1:]).result()
                except BrokenProcessPool:
                    starts += 1
                    break
                yield from _results([left.pop()], outcomes, work)
                starts = 1
        if starts == TRIES:
            yield work.failed(left.pop(), f"its worker process died {TRIES} times")
            starts = 1


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
            waiting, suspects = _Waiting(tasks), list[Task]()
            running: dict[Any, list[Task]] = {}
            finished = dask.as_completed(loop=client.loop)

            def submit(pack: list[Task]) -> None:
                # Dask keeps keys permanently: a task that is run again needs a new one.
                future = client.submit(_do, work.run, pack, key=f"pack-{uuid4().hex}")
                running[future] = pack
                finished.add(future)

            try:
                while waiting or running or suspects:
                    workers = max(1, sum(client.ncores().values()))
                    while waiting and len(running) < AHEAD * workers:
                        submit(waiting.pack(workers))
                    # Suspects run when all others are finished: if a worker dies then, its only task is at fault.
                    alone = not running
                    if alone:
                        submit([suspects.pop()])
                    future = next(finished)
                    pack, wrong = running.pop(future), future.exception()
                    if wrong is None:
                        outcomes = future.result()
                        waiting.done(pack, len(outcomes))
                        yield from _results(pack, outcomes, work)
                    elif alone:
                        yield work.failed(pack[0], _words(wrong))
                    # The scheduler gives up what ran or waited at a worker that died, after three times.
                    else:
                        suspects += pack
            finally:
                client.cancel(list(running))

    return spread
