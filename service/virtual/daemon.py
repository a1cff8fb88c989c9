"""A daemon with a virtual vehicle in this process, beside the caller's own work, for as long as a block lasts."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress

from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Daemon, Places
from upright.service.virtual.passenger import carried
from upright.service.virtual.serving import virtual_vehicle_beside
from upright.simulation.config import SimulationConfig
from upright.simulation.faults import Fault
from upright.simulation.physics.disturbance import Disturbance
from upright.simulation.physics.load import Action
from upright.simulation.vehicle import VirtualVehicle
from upright.vehicles.sections import VehicleFile

READY_TIMEOUT = 30.0
"""s for the drives to be set up and the roll filter to settle. What is not ready then, an interlock names."""
LEASE = 2.0
"""s, the longest that a vehicle file may have. The vehicle waits for the daemon: a terminal that a busy computer holds
up for half a second endangers nothing."""


@contextmanager
def daemon_beside(
    vehicle: VehicleFile,
    places: Places,
    hide: Sequence[str],
    seed: int,
    *,
    disturbance: Disturbance | None = None,
    truth: VehicleFile | None = None,
    configure: Callable[[SimulationConfig], SimulationConfig] = lambda configuration: configuration,
    faults: Sequence[Fault] = (),
    watch: Callable[[VirtualVehicle], None] = lambda virtual: None,
) -> Iterator[Daemon]:
    """The daemon of `vehicle` in a thread of its own, with a virtual vehicle, as fast as the machine allows.

    The virtual vehicle is built as in the file `truth`, by default as in the daemon's own, and then `configure`d. It
    has the `faults`. `watch` is called with it every cycle, in its thread.
    Raises what the daemon raises when it starts, and UnknownEffectError if `hide` names an unknown effect.
    """
    started: list[asyncio.AbstractEventLoop] = []
    failed: list[BaseException] = []
    made: list[Daemon] = []
    there = threading.Event()

    patient = vehicle.model_copy(update={"control": vehicle.control.model_copy(update={"lease": LEASE})})

    async def serve() -> None:
        made.append(Daemon(patient, places, lock_step=True))
        started.append(asyncio.get_running_loop())
        there.set()
        await made[0].run()

    def run() -> None:
        try:
            asyncio.run(serve())
        except BaseException as error:  # it is raised again in the caller's thread
            failed.append(error)
        finally:
            there.set()

    thread = threading.Thread(target=run, name="daemon", daemon=True)
    thread.start()
    there.wait()
    if failed:
        raise failed[0]
    daemon = made[0]
    watched: list[VirtualVehicle] = []

    def undergoes() -> Action | None:
        for each in watched:
            watch(each)
        return carried(daemon.loop.asked)

    with virtual_vehicle_beside(
        truth or vehicle,
        list(hide),
        seed,
        places.drives_bus,
        punctual=False,
        disturbance=disturbance,
        load=undergoes,
        configure=configure,
        faults=faults,
    ) as virtual:
        watched.append(virtual)
        try:
            _wait(lambda: bool(failed) or (daemon.loop.mode is Mode.DISARMED and not daemon.loop.interlocks()))
            if failed:
                raise failed[0]
            yield daemon
        finally:
            with suppress(RuntimeError):  # it ended by itself, and `failed` says why
                started[0].call_soon_threadsafe(daemon.stop)
            thread.join()


def _wait(ready: Callable[[], bool]) -> None:
    limit = time.monotonic() + READY_TIMEOUT
    while not ready() and time.monotonic() < limit:
        time.sleep(0.05)
