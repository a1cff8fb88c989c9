"""The daemon in the test's own process, with a virtual vehicle in wall-clock time."""

from __future__ import annotations

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Daemon, Places
from upright.service.virtual.serving import virtual_vehicle_beside
from upright.vehicles.file import load
from upright.vehicles.sections import VehicleFile


def steady() -> VehicleFile:
    """The shipped MONOCAB, with an experiment `hold` of a minute."""
    vehicle = load("monocab")
    hold = vehicle.experiments["hold"].model_copy(update={"duration": 60.0})
    return vehicle.model_copy(update={"experiments": {**vehicle.experiments, "hold": hold}})


@asynccontextmanager
async def serving(folder: Path, bus: str) -> AsyncIterator[Daemon]:
    """The daemon, once an experiment may start; its socket is `s.sock` in the folder."""
    vehicle = steady()
    with virtual_vehicle_beside(vehicle, [], 1, bus):
        daemon = Daemon(vehicle, Places(bus, bus, folder, folder / "s.sock"), lock_step=True)
        running = asyncio.create_task(daemon.run())
        try:
            await until(lambda: daemon.loop.mode is Mode.DISARMED and not daemon.loop.interlocks())
            yield daemon
        finally:
            daemon.stop()
            await running


async def until(what: Any, seconds: float = 40.0) -> float:
    """Wait until `what()` is true. Returns the time that it took, s."""
    began = time.monotonic()
    while not what():
        assert time.monotonic() - began < seconds, "not in time"
        await asyncio.sleep(0.01)
    return time.monotonic() - began


async def connect(folder: Path, name: str = "hold") -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """A client that has requested an experiment."""
    reader, writer = await asyncio.open_unix_connection(str(folder / "s.sock"))
    writer.write(json.dumps({"verb": "experiment", "name": name}).encode() + b"\n")
    return reader, writer
