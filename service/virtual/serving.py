"""A virtual vehicle in the daemon's own process, in lock-step, usually in real time.

It is for demonstrations and tests, in which the vehicle shall need as much time as a real one, but shall not fall if
the computer is busy: in lock-step the plant waits for its master, and catches up afterwards. `upright simulate` runs in
strict real time with a separate daemon.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import can

from upright.drivers.bus.address import connect
from upright.service.virtual import vehicle as virtual_vehicle
from upright.simulation import runner
from upright.simulation.config import SimulationConfig
from upright.simulation.faults import Fault
from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.load import Action
from upright.simulation.vehicle import VirtualVehicle
from upright.vehicles.sections import VehicleFile

BUS = "virtual:upright-virtual"
PATIENCE = 20.0
"""s that the vehicle waits for its daemon, which ends together with it: a busy computer may keep it waiting for
seconds, and in lock-step nothing is lost by that."""


class PunctualBus:
    """A bus on which no message is sent before its time stamp, shifted to wall clock time at the first message.

    `bus` does the rest. If the sender is late, its messages are sent at once until it has caught up.
    """

    def __init__(self, bus: can.BusABC) -> None:
        self._bus = bus
        self._shift: float | None = None

    def send(self, message: can.Message, timeout: float | None = None) -> None:
        if self._shift is None:
            self._shift = time.time() - message.timestamp
        message.timestamp += self._shift
        early = message.timestamp - time.time()
        if early > 0.0:
            time.sleep(early)
        self._bus.send(message, timeout)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._bus, name)


@contextmanager
def virtual_vehicle_beside(
    vehicle: VehicleFile,
    hide: list[str],
    seed: int,
    bus: str = BUS,
    *,
    punctual: bool = True,
    disturbance: Disturbance | None = None,
    load: Callable[[], Action | None] = runner.nothing,
    configure: Callable[[SimulationConfig], SimulationConfig] = lambda configuration: configuration,
    faults: Sequence[Fault] = (),
) -> Iterator[VirtualVehicle]:
    """The virtual vehicle on the in-process `bus`, until the end of the block.

    It runs in real time, or, if not `punctual`, as fast as the daemon answers. It has the random `disturbance` unless
    `hide` defines one. `load()` is asked every cycle what is on it. `configure` may change its physics, and it has the
    `faults`.
    Raises UnknownEffectError if `hide` names an unknown effect.
    """
    configuration = configure(virtual_vehicle.configuration(vehicle, hide, seed, disturbance=disturbance))
    stop = threading.Event()
    with connect(bus, None, None) as own:
        paced: Any = PunctualBus(own) if punctual else own
        running = runner.Runner(
            configuration, paced, lock_step=True, stop=stop, faults=faults, load=load, patience=PATIENCE
        )
        thread = threading.Thread(target=running.run, name="virtual vehicle", daemon=True)
        thread.start()
        try:
            yield running.vehicle
        finally:
            stop.set()
            thread.join()
