"""An experiment that ends in order but leaves an incomplete recording is a failure, and its result says so."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from pathlib import Path

import pytest
from serving import connect, serving, until

from upright.service.control.clients.api import RENEWAL_PERIOD, ExitCode
from upright.service.control.cycle.operation import Mode
from upright.telemetry.storage import load

pytestmark = pytest.mark.timeout(120)


async def _renew(writer: asyncio.StreamWriter) -> None:
    while True:
        writer.write(b'{"verb": "renew"}\n')
        await asyncio.sleep(RENEWAL_PERIOD)


async def test_experiment_with_an_incomplete_recording_fails(tmp_path: Path) -> None:
    async with serving(tmp_path, "virtual:unfinished") as daemon:
        reader, writer = await connect(tmp_path)
        renewing = asyncio.create_task(_renew(writer))
        await until(lambda: any(path.stat().st_size > 50_000 for path in tmp_path.glob("*.arrow")))
        assert daemon.observer.pid is not None
        os.kill(daemon.observer.pid, signal.SIGKILL)
        renewing.cancel()
        writer.write(b'{"verb": "release"}\n')
        while (answer := json.loads(await reader.readline()))["type"] != "result":
            pass
        writer.close()
        assert (answer["exit_code"], answer["code"]) == (ExitCode.FAILED, "recording")
        assert "released the lease, but its recording is incomplete: the observer process ended." in answer["text"]
        assert daemon.loop.mode is Mode.DISARMED
        kept = load(Path(answer["recording"]))
        assert len(kept) > 100
        assert kept.truncated
