"""canopen's view of the bus, for one simulated node: frames leave through a callable, periods run in simulated time."""

from __future__ import annotations

from collections.abc import Callable

import canopen

Send = Callable[[int, bytes], None]
"""CAN id and data of a frame that leaves a node."""


class PeriodicMessage:
    """A message that canopen sends periodically: the heartbeat."""

    def __init__(self, can_id: int, data: bytes, period: float, due: float) -> None:
        self.can_id = can_id
        self.data = bytes(data)
        self.period = period
        self.due = due

    def update(self, data: bytes) -> None:
        """Change what is sent (called by canopen)."""
        self.data = bytes(data)

    def stop(self) -> None:
        """Never send again (called by canopen)."""
        self.due = float("inf")


class NodeNetwork(canopen.Network):
    """A `canopen.Network` without a bus and without a thread of its own."""

    def __init__(self, send: Send, clock: Callable[[], float]) -> None:
        super().__init__()
        self._periodic: list[PeriodicMessage] = []
        self._send = send
        self._clock = clock

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self._send(can_id, bytes(data))

    def send_periodic(self, can_id: int, data: bytes, period: float, remote: bool = False) -> PeriodicMessage:  # type: ignore[override]
        message = PeriodicMessage(can_id, data, period, self._clock() + period)
        self._periodic = [other for other in self._periodic if other.due != float("inf")]
        self._periodic.append(message)
        return message

    def send_due(self, now: float) -> None:
        """Send the periodic messages that are due."""
        for message in self._periodic:
            if now >= message.due:
                message.due = max(message.due + message.period, now)
                self._send(message.can_id, message.data)
