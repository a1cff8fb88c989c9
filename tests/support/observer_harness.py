"""An observer process and a small vehicle's control cycles to feed it: for the tests of observer and MQTT."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import small_vehicle

from upright.service.observer.client import ObserverClient
from upright.telemetry.samples import Frame
from upright.vehicles.file import load

VEHICLE = load("monocab")


def hello(data: Path, broker: str = "", **mqtt: Any) -> dict[str, Any]:
    """The hello message of the control process for the shipped vehicle, with in-process buses."""
    from upright.service.control.assembly import observer_hello

    return {
        **observer_hello(VEHICLE, data, []),
        "mqtt": {**VEHICLE.mqtt.model_dump(), "broker": broker, **mqtt},
    }


@cache
def cycles() -> list[Frame]:
    """8 s of control cycles of the small vehicle under a sweep, 250 Hz."""
    stamps, table = small_vehicle.run(1, 8.0, reference=small_vehicle.sweep)
    return list(small_vehicle.frames(stamps, table, 0))


async def until(what: Callable[[], object], seconds: float = 20.0) -> None:
    """Wait in the running loop until `what()` is true."""
    limit = time.monotonic() + seconds
    while not what():
        assert time.monotonic() < limit, f"not within {seconds} s"
        await asyncio.sleep(0.01)


async def record(client: ObserverClient, frames: list[Frame], name: str = "sweep") -> dict[str, Any]:
    """Record all of `frames` and return the summary."""
    client.start_recording(name, frames[0].timestamp_ns, {"kind": "monocab"})
    for frame in frames[:-1]:
        client.offer(frame)
    client.stop_recording("done", frames[-1].timestamp_ns)
    # As in the control loop, the cycle in which the recording was stopped is offered after the command.
    client.offer(frames[-1])
    return await client.finished_recording()
