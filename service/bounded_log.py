"""The log of a process that must not wait: records are written by a thread, and those that are too many are dropped.

Standard error may be a pipe that nobody reads, or a disk that hangs; and a fault may have something to say every cycle.
"""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from logging.handlers import QueueHandler

MOST_WAITING = 200
"""Records that may wait to be written."""

MOST_A_SECOND = 50
"""Records that are taken in one second."""

LAST_WORDS = 1.0
"""s for what waits when the log is closed."""

FORMAT = "%(levelname)s %(name)s: %(message)s"


class BoundedHandler(QueueHandler):
    """Hands records over to a thread that gives them to `target`. Never waits; `dropped` counts what was too much, and
    the thread reports it."""

    def __init__(self, target: logging.Handler) -> None:
        self._records: queue.Queue[logging.LogRecord | None] = queue.Queue(MOST_WAITING)
        super().__init__(self._records)
        self.dropped = 0
        self._target = target
        self._second = 0
        self._in_second = 0
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._write, name="log", daemon=True)
        self._thread.start()

    def emit(self, record: logging.LogRecord) -> None:
        second = int(time.monotonic())
        if second != self._second:
            self._second, self._in_second = second, 0
        self._in_second += 1
        if self._in_second > MOST_A_SECOND or self._records.full():  # before it is formatted, which takes time
            self.dropped += 1
        else:
            super().emit(record)

    def enqueue(self, record: logging.LogRecord) -> None:
        try:
            self._records.put_nowait(record)
        except queue.Full:  # another thread was faster
            self.dropped += 1

    def close(self) -> None:
        """Write what waits, if it takes no longer than LAST_WORDS, and end the thread."""
        if not self._closed.is_set():
            self._closed.set()
            with suppress(queue.Full):
                self._records.put_nowait(None)
            self._thread.join(LAST_WORDS)
        super().close()

    def _write(self) -> None:
        reported, last = 0, False
        while not last:
            record = self._records.get()
            if record is not None:
                self._target.handle(record)
            last = record is None or (self._closed.is_set() and self._records.empty())
            if self.dropped > reported:
                reported = self.dropped
                text = f"{reported} records of the log were dropped so far: there were too many, or nobody read them"
                self._target.handle(logging.LogRecord(__name__, logging.WARNING, __file__, 0, text, None, None))


@contextmanager
def bounded_log(target: logging.Handler | None = None) -> Iterator[BoundedHandler]:
    """All logging of this process through a BoundedHandler to `target`, by default standard error, in a block."""
    if target is None:
        target = logging.StreamHandler()
        target.setFormatter(logging.Formatter(FORMAT))
    handler, root = BoundedHandler(target), logging.getLogger()
    before = root.handlers[:]
    root.handlers[:] = [handler]
    try:
        yield handler
    finally:
        root.handlers[:] = before
        handler.close()
