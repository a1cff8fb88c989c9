"""The whole demo without hardware: a virtual vehicle on a lock-step bus, the real daemon, and a broker.

The simulation runs in a thread of this process and passes its time with every frame, so the demo runs as fast as the
machine allows, or in real time with the dashboard. All other parts are the same as on a vehicle: the control loop,
observer process, recorder and MQTT.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

from upright.service.control.clients import api
from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Daemon, Places
from upright.service.mqtt.embedded_broker import USER, EmbeddedBroker
from upright.service.output import live_estimates, missing_effects, page, people
from upright.service.virtual.passenger import carried
from upright.service.virtual.serving import virtual_vehicle_beside
from upright.service.virtual.vehicle import usual_disturbance
from upright.telemetry.errors import UprightError
from upright.vehicles.file import VehicleFile

BUS = "virtual:upright-demo"
READY_TIMEOUT = 30.0
"""s for the drives to be set up and the roll filter to settle."""


class DemoError(UprightError):
    """The demo's vehicle did not get ready, or an experiment failed."""


Follow = Callable[[Iterator[dict[str, Any]]], dict[str, Any]]
Evaluate = Callable[[list[Path]], None]


def run_demo(
    vehicle: VehicleFile,
    hide: list[str],
    experiments: list[str],
    data: Path,
    seed: int,
    follow: Follow,
    evaluate: Evaluate,
    *,
    port: int | None = None,
) -> None:
    """Run `experiments` on a virtual vehicle. `follow` shows one, returning its result; `evaluate` gets the recordings.

    With `port` the dashboard is served there meanwhile, and until Ctrl-C.

    Raises:
        DemoError: the vehicle did not get ready, an experiment failed, or the port is in use.
    """
    recordings = asyncio.run(_run(vehicle, hide, experiments, data, seed, follow, evaluate, port))
    if port is None:
        evaluate(recordings)


async def _run(
    vehicle: VehicleFile,
    hide: list[str],
    experiments: list[str],
    data: Path,
    seed: int,
    follow: Follow,
    evaluate: Evaluate,
    port: int | None,
) -> list[Path]:
    async with EmbeddedBroker() as broker:
        mqtt = {"broker": broker.address, "commands": port is not None}
        vehicle = vehicle.model_copy(update={"mqtt": vehicle.mqtt.model_copy(update=mqtt)})
        places = Places(BUS, BUS, data, data / f"{vehicle.vehicle.id}.sock")
        daemon = Daemon(vehicle, places, lock_step=True)
        shown = nullcontext("") if port is None else _dashboard(vehicle, places, broker, port)
        disturbance = usual_disturbance(vehicle)
        with (
            shown as address,
            virtual_vehicle_beside(
                vehicle,
                hide,
                seed,
                BUS,
                punctual=port is not None,
                disturbance=disturbance,
                load=lambda: carried(daemon.loop.asked),
            ),
        ):
            serving = asyncio.create_task(daemon.run(), name="daemon")
            try:
                people.print(f"MQTT: {broker.address}, topics {vehicle.mqtt.base}/{vehicle.vehicle.id}/#")
                await _until_ready(daemon, serving)
                recordings = [await _experiment(name, places.socket, follow) for name in experiments]
                if port is not None:
                    try:
                        await asyncio.to_thread(evaluate, recordings)
                    except UprightError as error:  # for example if the run was stopped before the vehicle rose
                        people.print(f"[yellow]No report: {error}[/yellow]")
                    people.print(f"Dashboard, until Ctrl-C: {address}", soft_wrap=True)
                    await serving
                return recordings
            finally:
                daemon.stop()
                await serving


@contextmanager
def _dashboard(vehicle: VehicleFile, places: Places, broker: EmbeddedBroker, port: int) -> Iterator[str]:
    """The dashboard on this machine's `port`, in a thread of its own: its address. Raises DemoError if the port is in
    use."""
    import uvicorn

    from upright.service.dashboard.app import Dashboard, Settings
    from upright.service.dashboard.guard import LIMITS

    try:
        place = socket.create_server(("127.0.0.1", port))
    except OSError as error:
        raise DemoError(f"port {port}: {error.strerror}.", remedy="Choose another one with --port.") from error
    settings = Settings(vehicle, places.data, broker.websocket, USER, broker.password, socket=places.socket)
    server = uvicorn.Server(uvicorn.Config(Dashboard(settings).app, **LIMITS))
    thread = threading.Thread(target=server.run, kwargs={"sockets": [place]}, name="dashboard")
    thread.start()
    address = f"http://localhost:{port}/#token={settings.token}"
    people.print(f"Dashboard: {address}", soft_wrap=True)
    try:
        yield address
    finally:
        server.should_exit = True
        thread.join()
        place.close()


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
        page.print(live_estimates(answer["estimates"]))
        page.print(missing_effects(answer.get("diagnosis")))
    return Path(answer["recording"])
