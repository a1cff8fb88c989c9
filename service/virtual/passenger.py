"""The person beside a virtual vehicle: reads the daemon's announcements and does what they ask for.

Only the daemon knows when an experiment wants its load, and nothing on the bus says so. So this reads the same state as
the screen in front of a real person does, and is as late as a quick one.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from upright.service.control.clients import api
from upright.simulation.physics.load import Action, Load, Spin, Tilt
from upright.vehicles.sections import ASKED, Asked, LoadSection, SpinSection, TiltSection

LOOK = 0.2
"""s between two looks at the daemon's state."""


def carried(asked: Asked | None) -> Action | None:
    """What a virtual vehicle undergoes when its daemon asks for `asked`."""
    match asked:
        case LoadSection():
            return Load(asked.torque, asked.ramp)
        case TiltSection():
            return Tilt(asked.duration)
        case SpinSection():
            return Spin(asked.up)
    return None


class Passenger:
    """What is on the vehicle whose daemon listens at one of `sockets`: call it for the load, any time, in any thread.
    Without a daemon there is none."""

    def __init__(self, sockets: Sequence[Path]) -> None:
        self._sockets = list(sockets)
        self._load: Action | None = None

    def __call__(self) -> Action | None:
        return self._load

    def look(self) -> None:
        """Read the daemon's state."""
        try:
            status = list(api.call(self._sockets, {"verb": "status"}, timeout=1.0))[-1].get("status") or {}
            asked = [kind.model_validate(status[key]) for key, kind in ASKED.items() if status.get(key)]
        except (api.ApiError, ValueError):
            asked = []
        self._load = carried(asked[0] if asked else None)


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
