"""What other processes want from the control process is looked after in turns, one after each control cycle.

A turn comes when the setpoints are on the bus and the row has been offered to the observer: until the next frames of
the IMU there is time. It serves a bounded number of those who have something to say, in rotation, each with one bounded
piece of work. So neither their number nor what they send can make a cycle late. Where no cycles come, because nothing
sends IMU frames, turns come by a timer.
"""

from __future__ import annotations

import asyncio
import select
from collections import deque
from collections.abc import Callable

MOST_A_TURN = 4
"""Connections that are served in one turn."""

PERIOD = 0.02
"""s between two turns without cycles."""

READ, WRITE, HANG_UP = select.EPOLLIN, select.EPOLLOUT, select.EPOLLHUP | select.EPOLLERR


class Turns:
    """Serves sockets in turns. For use in a running event loop, whose thread calls all methods."""

    def __init__(self) -> None:
        self._epoll: select.epoll | None = None
        self._served: dict[int, Callable[[int], None]] = {}
        self._queue: deque[Callable[[], None]] = deque()
        self._timer: asyncio.TimerHandle | None = None
        self._taken = False

    def watch(self, descriptor: int, events: int, serve: Callable[[int], None]) -> None:
        """Call `serve(events)` in a turn when one of `events` is there: once a turn, for as long as it is. HANG_UP
        always is one of them."""
        if self._epoll is None:
            self._epoll = select.epoll()
            self._timer = asyncio.get_running_loop().call_later(PERIOD, self._by_timer)
        if descriptor in self._served:
            self._epoll.modify(descriptor, events)
        else:
            self._epoll.register(descriptor, events)
        self._served[descriptor] = serve

    def forget(self, descriptor: int) -> None:
        """Serve it no longer; to be called before it is closed."""
        if self._epoll is None or self._served.pop(descriptor, None) is None:
            return
        self._epoll.unregister(descriptor)
        if not self._served:
            self._epoll.close()
            self._epoll = None
            if self._timer is not None:
                self._timer.cancel()

    def queue(self, work: Callable[[], None]) -> None:
        """Do `work` in a turn, after what was queued before it. A turn does one of them: they are larger pieces."""
        self._queue.append(work)

    def take(self) -> None:
        """A turn. The kernel moves those that it names to the end of its list: nobody waits for ever."""
        self._taken = True
        if self._epoll is None:
            return
        for descriptor, events in self._epoll.poll(0, MOST_A_TURN):
            serve = self._served.get(descriptor)
            if serve is not None:  # an earlier one in this turn may have ended it
                serve(events)
        if self._queue:
            self._queue.popleft()()

    def _by_timer(self) -> None:
        self._timer = asyncio.get_running_loop().call_later(PERIOD, self._by_timer)
        if not self._taken:
            self.take()
        self._taken = False
