"""The live server read by others: by the libraries of Lichtblick in Node, and by Foxglove Studio in a browser.

`make viewer-test` fetches them from the npm registry. PlotJuggler was not tried: Debian, PyPI and npm do not have it.
"""

from __future__ import annotations

import asyncio
import json
import math
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from monocab_channels import MONOCAB as CHANNELS
from observer_harness import cycles, hello, record
from playwright.sync_api import Browser, Page, expect
from served import free_port, listening
from studio import PACKAGES, VIEWERS, studio
from watched import PATIENCE, chromium

from upright.service.observer.client import ObserverClient
from upright.telemetry.samples import Frame
from upright.telemetry.storage import load

pytestmark = [
    pytest.mark.viewer,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not PACKAGES.is_dir(), reason="the viewers are not here: `make viewer-test` fetches them"),
]
UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]
SERIES = ("/vehicle.roll", "/prediction.roll", "/vehicle.roll_rate", "/health.rate")
TOPICS = ("/vehicle", "/prediction", "/state", "/health", "/log")


@asynccontextmanager
async def lichtblick(port: int, *topics: str) -> AsyncIterator[asyncio.StreamReader]:
    """What its libraries read of the topics, a line of JSON each. First comes what the server says of itself."""
    program = ["node", str(VIEWERS / "lichtblick.js"), f"ws://127.0.0.1:{port}", *topics]
    node = await asyncio.create_subprocess_exec(*program, stdout=asyncio.subprocess.PIPE, limit=1 << 20)
    assert node.stdout is not None
    try:
        yield node.stdout
    finally:
        if node.returncode is None:
            node.kill()
        await node.wait()


async def line(source: asyncio.StreamReader) -> dict[str, Any]:
    async with asyncio.timeout(40.0):
        found: dict[str, Any] = json.loads(await source.readline())
        return found


async def test_lichtblick_reads_every_cycle_as_it_is_recorded(tmp_path: Path) -> None:
    port = free_port()
    client = ObserverClient({**hello(tmp_path), "foxglove_port": port}, lossless=True)
    await client.start()
    try:
        await asyncio.to_thread(listening, port)
        frames = [replace(frame, timestamp_ns=frame.timestamp_ns // 2) for frame in cycles()[:1500]]  # 500 Hz
        frames[3] = Frame(frames[3].timestamp_ns, (math.nan, *frames[3].values[1:]))
        async with lichtblick(port, "/vehicle") as source:
            info = await line(source)
            assert (info["protocol"], info["capabilities"]) == ("foxglove.sdk.v1", [])
            assert (await line(source))["subscribed"] == ["/vehicle"]
            summary = await record(client, frames)
            client.offer(frames[-1])  # the last one had no successor that would have filled its batch
            received = [await line(source) for _ in frames]
    finally:
        await client.stop()
    recorded = list(load(Path(summary["recording"])).frames(CHANNELS))
    stamps = [each["content"]["header"]["stamp"] for each in received]
    assert [int(each["timestamp"]) for each in received] == [frame.timestamp_ns for frame in recorded]
    assert [int(each["sec"]) * 10**9 + int(each["nsec"]) for each in stamps] == [f.timestamp_ns for f in recorded]
    shown = [tuple(float(each["content"][name]) for name in CHANNELS.names) for each in received]
    assert repr(shown) == repr([frame.values for frame in recorded])


# In a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.fixture
def daemon(tmp_path: Path) -> Iterator[int]:
    """The port at which a virtual vehicle is shown; its socket is `s.sock`."""
    port = free_port()
    places = ("--data", str(tmp_path), "--socket", str(tmp_path / "s.sock"))
    command = [*UPRIGHT, "serve", "monocab", "--virtual", "--foxglove", str(port), *places]
    process = subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    try:
        listening(port)
        yield port
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30.0)


def test_foxglove_studio_shows_an_experiment(daemon: int, browser: Browser, tmp_path: Path) -> None:
    errors: list[str] = []
    with studio(daemon) as address:
        page = browser.new_context(viewport={"width": 1400, "height": 850}).new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        body = page.locator("body")
        expect(body).to_contain_text("monocab (upright", timeout=PATIENCE)
        for topic in TOPICS:
            expect(page.get_by_text(topic, exact=True).first).to_be_visible(timeout=PATIENCE)
        expect(body).to_contain_text('"disarmed"', timeout=PATIENCE)
        experiment = started(tmp_path, "hold")
        try:
            expect(body).to_contain_text("started hold", timeout=PATIENCE)  # in the panel of the log
            expect(body).to_contain_text('"excite"', timeout=PATIENCE)
            until(page, lambda: all(value(page, name) is not None for name in SERIES))
            assert abs(value(page, "/vehicle.roll") or 0.0) < math.radians(3.0), "it balances"
            if picture := os.environ.get("UPRIGHT_PICTURE"):
                page.wait_for_timeout(8000)
                page.screenshot(path=picture)
            assert page.get_by_text("Hz").count() >= 2
            page.get_by_role("tab", name="Problems").click()
            expect(body).to_contain_text("No problems found")
        finally:
            experiment.kill()
            experiment.wait()
    assert errors == []


def started(folder: Path, name: str) -> subprocess.Popen[bytes]:
    """The experiment, asked for until no interlock refuses it."""
    end = time.monotonic() + 60.0
    while True:
        command = [*UPRIGHT, "experiment", name, "--socket", str(folder / "s.sock")]
        asked = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            asked.wait(4.0)
        except subprocess.TimeoutExpired:
            return asked
        assert time.monotonic() < end, "refused"


def until(page: Page, what: Any) -> None:
    end = time.monotonic() + 1e-3 * PATIENCE
    while not what():
        assert time.monotonic() < end, page.inner_text("body")
        page.wait_for_timeout(100)


def value(page: Page, series: str) -> float | None:
    """What the legend of a plot says of a series."""
    found = re.search(rf"^{re.escape(series)}\n(-?[\d.e-]+)$", page.inner_text("body"), re.MULTILINE)
    return float(found[1]) if found else None
