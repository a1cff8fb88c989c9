"""Runs independent pieces of one diagnosis in parallel: compiled passes and matrix products let other threads run."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Item = TypeVar("Item")
Answer = TypeVar("Answer")

THREADS = 2
"""More would wait for each other: half of the work is Python's."""


def side_by_side(work: Callable[[Item], Answer], items: Iterable[Item]) -> Iterator[Answer]:
    """`work(item)` of each of `items`, in their order. If one raises, or the caller stops, items that have not been
    started are skipped."""
    pool = ThreadPoolExecutor(THREADS)
    try:
        yield from pool.map(work, items)
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
