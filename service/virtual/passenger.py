"""The person beside a virtual vehicle: reads the daemon's announcements and puts on the loads that they ask for.

Only the daemon knows when an experiment wants its load, and nothing on the bus says so. So this reads the same state as
the screen in front of a real person does, and is as late as a quick one.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from service.control import api
from simulation.load import Load
from vehicles.sections import LoadSection

LOOK = 0.2
"""s between two looks at the daemon's state."""


def carried(asked: LoadSection | None) -> Load | None:
    """The load that a virtual vehicle carries when its daemon asks for `asked`."""
    return Load(asked.torque, asked.ramp) if asked is not None else None


class Passenger:
    """What is on the vehicle whose daemon listens at one of `sockets`: call it for the load, any time, in any thread.
    Without a daemon there is none."""

    def __init__(self, sockets: Sequence[Path]) -> None:
        self._sockets = list(sockets)
        self._load: Load | None = None

    def __call__(self) -> Load | None:
        return self._load

    def look(self) -> None:
        """Read the daemon's state."""
        try:
            status = list(api.call(self._sockets, {"verb": "status"}, timeout=1.0))[-1].get("status") or {}
        except (api.ApiError, ValueError):
            status = {}
        asked = status.get("load")
        self._load = Load(asked["torque"], asked["ramp"]) if asked else None


@contextmanager
def passenger(sockets: Sequence[Path]) -> Iterator[Passenger]:
    """A person beside the vehicle until the end of the block."""
    person, over = Passenger(sockets), threading.Event()

    def attend() -> None:
        while not over.wait(LOOK):
            person.look()

    thread = threading.Thread(target=attend, name="passenger", daemon=True)
    thread.start()
    try:
        yield person
    finally:
        over.set()
        thread.join()
