"""A thread beside an event loop whose end can be awaited, and that the end of the process does not wait for."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def beside(work: Callable[[], T], name: str) -> asyncio.Future[T]:
    """Begin `work` in a daemon thread; what it returns or raises. To be called in a running event loop."""
    loop = asyncio.get_running_loop()
    finished: asyncio.Future[T] = loop.create_future()

    def tell(how: Callable[[Any], None], what: Any) -> None:
        if not finished.done():
            how(what)

    def run() -> None:
        try:
            end: tuple[Callable[[Any], None], Any] = finished.set_result, work()
        except Exception as error:
            end = finished.set_exception, error
        with contextlib.suppress(RuntimeError):  # the loop is closed: nobody waits any more
            loop.call_soon_threadsafe(tell, *end)

    threading.Thread(target=run, name=name, daemon=True).start()
    return finished
