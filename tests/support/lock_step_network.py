"""canopen's view of a virtual vehicle's bus in simulated time: whoever waits for an answer lets the time pass."""

from __future__ import annotations

import queue
from collections.abc import Callable

import canopen

from upright.simulation.config import SimulationConfig
from upright.simulation.vehicle import VirtualVehicle

PERIOD = 0.004
"""s in which the vehicle goes on between two looks for an answer."""


class LockStepNetwork(canopen.Network):
    """The bus of a virtual vehicle, and the `drivers.cia402.sdo_client.Clock` of its time.

    `requests` are the SDO requests that were sent, as (node, data); `writes` those that write.
    """

    def __init__(self, config: SimulationConfig) -> None:
        super().__init__()
        self.requests: list[tuple[int, bytes]] = []
        self.lose: Callable[[bytes], bool] = lambda data: False
        """Whether an SDO request gets lost."""
        self._heard: list[tuple[int, bytes]] = []
        self.vehicle = VirtualVehicle(config, self._hear, ())
        self.vehicle.boot()

    @property
    def writes(self) -> list[tuple[int, int]]:
        """Index and subindex of every write that was sent."""
        return [(int.from_bytes(data[1:3], "little"), data[3]) for _, data in self.requests if data[0] >> 5 == 1]

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        if can_id & 0x780 == 0x600:
            self.requests.append((can_id - 0x600, bytes(data)))
            if self.lose(bytes(data)):
                return
        self.vehicle.receive(can_id, bytes(data))
        self._deliver()

    def now(self) -> float:
        return self.vehicle.plant.time

    def sleep(self, seconds: float) -> None:
        until = self.now() + seconds
        while self.now() < until:
            self._pass()

    def answer(self, answers: queue.SimpleQueue[bytes], seconds: float) -> bytes | None:
        until = self.now() + seconds
        while answers.empty() and self.now() < until:
            self._pass()
        return None if answers.empty() else answers.get()

    def _pass(self) -> None:
        config = self.vehicle.config
        self.vehicle.begin_cycle()
        self.vehicle.advance_steps(config.steps_per_period)
        self._deliver()

    def _hear(self, can_id: int, data: bytes, timestamp_ns: int, *, of_imu: bool) -> None:
        if not of_imu:
            self._heard.append((can_id, bytes(data)))

    def _deliver(self) -> None:
        heard, self._heard = self._heard, []
        for can_id, data in heard:
            self.notify(can_id, bytearray(data), self.now())
