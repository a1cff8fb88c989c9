"""Run work in a daemon thread and await its result in an event loop."""

from __future__ import annotations

import asyncio
import contextlib
import threading
from collections.abc import Callable
from typing import Any, TypeVar

T = TypeVar("T")


def beside(work: Callable[[], T], name: str) -> asyncio.Future[T]:
    """Start `work` in a daemon thread; the future gets its result or exception. Call it in a running event loop."""
    loop = asyncio.get_running_loop()
    finished: asyncio.Future[T] = loop.create_future()

    def finish(how: Callable[[Any], None], what: Any) -> None:
        if not finished.done():
            how(what)

    def run() -> None:
        try:
            end: tuple[Callable[[Any], None], Any] = finished.set_result, work()
        except Exception as error:
            end = finished.set_exception, error
        with contextlib.suppress(RuntimeError):  # the loop is closed, and nothing awaits the result
            loop.call_soon_threadsafe(finish, *end)

    threading.Thread(target=run, name=name, daemon=True).start()
    return finished
