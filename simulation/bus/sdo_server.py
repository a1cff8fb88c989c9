"""The order and the time in which a virtual drive answers SDO requests; what it answers is canopen's matter."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from upright.simulation.drive_habits import DriveHabits

STORED = range(0x1400, 0x1C00)
"""Indices of the PDO parameters, which some drives store at once."""

WRITE = 1
"""Client command specifier of a write (download)."""


class SlowServer:
    """The requests that wait for their answer: one after the other, as the firmware of a drive takes them."""

    def __init__(self, habits: DriveHabits, answer: Callable[[bytes], None]) -> None:
        self._habits = habits
        self._answer = answer
        self._waiting: deque[tuple[float, bytes]] = deque()
        """Requests and when they arrived."""
        self._free = 0.0
        """When the last one is answered."""

    def boot(self, now: float) -> None:
        """Power-on: what waited is lost."""
        self._waiting.clear()
        self._free = now + self._habits.boot_time

    def take(self, request: bytes, now: float) -> None:
        """Take a request at `now` (s)."""
        self._waiting.append((now, request))
        self.tick(now)

    def tick(self, now: float) -> None:
        """Answer what is due."""
        while self._waiting:
            arrival, request = self._waiting[0]
            due = max(arrival, self._free) + self._time_of(request)
            if now < due:
                return
            self._free = due
            self._waiting.popleft()
            self._answer(request)

    def _time_of(self, request: bytes) -> float:
        stores = request[0] >> 5 == WRITE and int.from_bytes(request[1:3], "little") in STORED
        return self._habits.answer_time + (self._habits.store_time if stores else 0.0)
