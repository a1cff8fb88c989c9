"""Tasks in packs over processes and over a Dask cluster: each has one result, whatever becomes of its neighbours."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import dask_scheduler
import pytest
import spread_tasks
from hypothesis import given
from hypothesis import strategies as st
from spread_tasks import DEADLY, SLOW, WRONG, square, square_or_die

from upright.service import spread
from upright.service.spread import Work, machines, processes

TASKS = range(40)
EXPECTED: dict[int, Any] = {task: task * task for task in TASKS} | {WRONG: "ValueError: a wrong one"}


@pytest.fixture
def scheduler(tmp_path: Path) -> Iterator[str]:
    pytest.importorskip("distributed", reason="Dask is not installed: pip install 'upright[fleet]'")
    with dask_scheduler.scheduler(tmp_path) as address:
        yield address


def test_every_task_has_one_result_and_a_failure_is_its_own() -> None:
    found = list(processes(2)(TASKS, Work(square, spread_tasks.failed)))
    assert len(found) == len(TASKS)
    assert dict(found) == EXPECTED


def test_task_that_kills_its_worker_is_the_only_one_without_a_result() -> None:
    found = list(processes(2)(TASKS, Work(square_or_die, spread_tasks.failed)))
    assert len(found) == len(TASKS)
    assert dict(found) == EXPECTED | {DEADLY: "its worker process died 3 times"}


@pytest.mark.filterwarnings("default")  # Dask's own, about its event loop
def test_on_machines_it_is_the_only_one_too(scheduler: str) -> None:
    found = list(machines(scheduler)(TASKS, Work(square_or_die, spread_tasks.failed)))
    assert len(found) == len(TASKS)
    answers: dict[int, Any] = dict(found)
    assert "KilledWorker" in answers.pop(DEADLY)
    assert answers == {task: answer for task, answer in EXPECTED.items() if task != DEADLY}


def test_worker_returns_what_it_has_when_its_time_is_over() -> None:
    done = spread._do(square, [1, SLOW, 3, 4])
    assert [outcome.result for outcome in done] == [(1, 1), (SLOW, SLOW * SLOW)]


@given(st.integers(0, 300), st.integers(1, 9), st.randoms(use_true_random=False))
def test_packs_hold_every_task_once_and_leave_one_for_each_worker(count: int, workers: int, random: Any) -> None:
    waiting, seen = spread._Waiting(range(count)), []
    while waiting:
        left = count - len(seen)
        pack = waiting.pack(workers)
        assert 1 <= len(pack) <= max(1, left // workers)
        done = random.randint(1, len(pack))
        seen += pack[:done]
        waiting.done(pack, done)
    assert sorted(seen) == list(range(count))
