"""A virtual vehicle in the daemon's own process, in lock-step, as a rule at the pace of the wall's clock.

For showing and for tests, where the vehicle is to take its time as a real one does, and a machine that is held up must
not make it fall: in lock-step the plant waits for its master, and what was lost is made up for. Real time against a
daemon of its own is `upright simulate`.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import can

from drivers.bus_address import connect
from service.virtual import vehicle as virtual_vehicle
from simulation import runner
from simulation.disturbance import Disturbance
from vehicles.sections import VehicleFile

BUS = "virtual:upright-virtual"


class PunctualBus:
    """A bus on which no message leaves before its time; their time is the wall's from the first one on.

    `bus` does the rest. Where the sender is late, its messages leave at once until it has caught up.
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
) -> Iterator[None]:
    """The virtual vehicle on the in-process `bus`, for as long as the block lasts.

    It keeps to the wall's clock, or where it need not be `punctual` runs as fast as the daemon answers. It has the
    random `disturbance` where `hide` says nothing of one.
    Raises UnknownEffectError for a `hide` that names no hidden effect.
    """
    configuration = virtual_vehicle.configuration(vehicle, hide, seed, disturbance=disturbance)
    stop = threading.Event()

    def simulate() -> None:
        with connect(bus, None, None) as own:
            paced: Any = PunctualBus(own) if punctual else own
            runner.run(configuration, paced, lock_step=True, stop=stop)

    thread = threading.Thread(target=simulate, name="virtual vehicle", daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
