"""The whole story without hardware: a virtual vehicle on a lock-step bus, the real daemon, and a broker.

The simulation runs in a thread of this process and hands over its time with every frame, so the story runs as fast as
the machine allows. All else is what runs on a vehicle: the same control loop, observer process, recorder and MQTT.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from service import api, virtual_vehicle
from service.cli.output import missing_effects, page, parameter_table, people
from service.control_loop import Mode
from service.daemon import Daemon, Places
from service.embedded_broker import EmbeddedBroker
from service.vehicle_file import VehicleFile
from telemetry.errors import UprightError

BUS = "virtual:upright-demo"
READY_TIMEOUT = 30.0
"""s for the drives to be set up and the roll filter to settle."""


class DemoError(UprightError):
    """The demo's vehicle did not get ready, or an experiment failed."""


Follow = Callable[[Iterator[dict[str, Any]]], dict[str, Any]]


def run_demo(
    vehicle: VehicleFile, hide: list[str], experiments: list[str], data: Path, seed: int, follow: Follow
) -> list[Path]:
    """Run `experiments` on a virtual vehicle; the recordings' paths. `follow` shows an experiment and gives its result.

    Raises:
        DemoError: the vehicle did not get ready, or an experiment did not end well.
    """
    return asyncio.run(_run(vehicle, hide, experiments, data, seed, follow))


async def _run(
    vehicle: VehicleFile, hide: list[str], experiments: list[str], data: Path, seed: int, follow: Follow
) -> list[Path]:
    truth = virtual_vehicle.configuration(vehicle, hide, seed)
    stop = threading.Event()
    simulation = threading.Thread(
        target=virtual_vehicle.run, args=(truth, BUS, BUS), kwargs={"stop": stop, "lock_step": True}, name="simulation"
    )
    async with EmbeddedBroker() as broker:
        vehicle = vehicle.model_copy(update={"mqtt": vehicle.mqtt.model_copy(update={"broker": broker.address})})
        places = Places(BUS, BUS, data, data / f"{vehicle.vehicle.id}.sock")
        daemon = Daemon(vehicle, places, lock_step=True)
        simulation.start()
        serving = asyncio.create_task(daemon.run(), name="daemon")
        try:
            people.print(f"MQTT: {broker.address}, topics {vehicle.mqtt.base}/{vehicle.vehicle.id}/#")
            await _until_ready(daemon, serving)
            return [await _experiment(name, places.socket, follow) for name in experiments]
        finally:
            daemon.stop()
            await serving
            stop.set()
            await asyncio.to_thread(simulation.join)


async def _until_ready(daemon: Daemon, serving: asyncio.Task[None]) -> None:
    for _ in range(int(READY_TIMEOUT / 0.05)):
        if serving.done():
            serving.result()
        if daemon.loop.mode is Mode.DISARMED and not daemon.loop.interlocks():
            return
        await asyncio.sleep(0.05)
    raise DemoError(f"the virtual vehicle did not get ready: {' '.join(daemon.loop.interlocks())}")


async def _experiment(name: str, socket: Path, follow: Follow) -> Path:
    people.print(f"[bold]Experiment {name}[/bold]")
    answers = api.call([socket], {"verb": "experiment", "name": name}, timeout=None)
    answer = await asyncio.to_thread(follow, answers)
    if answer["exit_code"] != api.ExitCode.DONE:
        raise DemoError(f"experiment {name}: {answer['text']}")
    if answer.get("estimates"):
        page.print(parameter_table(answer["estimates"]))
        page.print(missing_effects(answer.get("diagnosis")))
    return Path(answer["recording"])
