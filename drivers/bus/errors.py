"""What can go wrong with a bus: it cannot be opened or used (`BusError`), or it was lost while in use (`BusDown`)."""

from __future__ import annotations

from upright.telemetry.errors import UprightError


class BusError(UprightError):
    """A bus cannot be opened or used. `bus` is its address."""

    def __init__(self, message: str, *, bus: str = "", remedy: str = "") -> None:
        super().__init__(message, remedy=remedy)
        self.bus = bus


class BusDown(BusError):
    """A bus that was open does not carry frames any more; `reason` says why. Close it and open it again."""

    def __init__(self, bus: str, reason: str) -> None:
        super().__init__(f"{bus} is down: {reason}.", bus=bus)
        self.reason = reason
