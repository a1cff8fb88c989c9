"""The server for Foxglove, Lichtblick and PlotJuggler: what it shows, and that nobody has to wait for its clients."""

from __future__ import annotations

import asyncio
import math
import os
import re
import signal
import socket
import sys
import time
from collections.abc import AsyncIterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from foxglove.messages import Log, LogLevel, Timestamp
from foxglove_viewer import Viewer, viewer
from hypothesis import given, settings
from hypothesis import strategies as st
from monocab_channels import MONOCAB
from observer_harness import VEHICLE, cycles, hello, record, until
from served import free_port

from upright.service.observer import link
from upright.service.observer.client import ObserverClient
from upright.service.observer.live.live_gap import LATEST
from upright.service.observer.live.live_prediction import live_prediction
from upright.service.observer.live.online_estimators import estimators_of
from upright.service.observer.process import Observer
from upright.service.observer.viewers.foxglove_server import BACKLOG, STATE
from upright.service.observer.viewers.ros_message import MessageType
from upright.telemetry.formats.ros_messages import ros2
from upright.telemetry.samples import Frame
from upright.telemetry.storage import load
from upright.vehicles import registry

UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]
HEALTH = {
    "cycles": 4,
    "missed_cycles": 1,
    "rate": None,
    "buses": [
        {"address": "a", "load_percent": 20.5, "dropped": 2, "error_frames": 0},
        {"address": "b", "load_percent": None, "dropped": 1, "error_frames": 3},
    ],
    "nearest_limit": {"code": "roll", "percent": 71.0},
}
STATE_OF_TEST = {"mode": "running", "experiment": None, "phase": "hold", "code": "ok", "reason": "grüß\0e"}


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Put the compiled model into the cache."""
    estimators_of(VEHICLE).join()


@pytest.fixture
def port() -> int:
    return free_port()


@pytest.fixture
async def client(tmp_path: Path, port: int) -> AsyncIterator[ObserverClient]:
    """A started client, which waits for its observer and so loses nothing; the observer serves viewers at `port`."""
    client = ObserverClient({**hello(tmp_path), "foxglove_port": port}, lossless=True)
    await client.start()
    yield client
    await client.stop()


def stamp_ns(content: Any) -> int:
    return int(content.header.stamp.sec) * 1_000_000_000 + int(content.header.stamp.nanosec)


def values(content: Any) -> tuple[float, ...]:
    return tuple(getattr(content, name) for name in MONOCAB.names)


# Messages


@settings(max_examples=50, deadline=None)
@given(
    st.integers(0, 2**31 * 10**9 - 1),
    st.lists(st.floats(allow_nan=False), max_size=5),
    st.lists(st.text(st.characters(exclude_categories=("Cs",), exclude_characters="\0")), max_size=4),
)
def test_message_is_read_by_its_definition(time_ns: int, numbers: list[float], texts: list[str]) -> None:
    names = [f"n{place}" for place in range(len(numbers))], [f"t{place}" for place in range(len(texts))]
    type = MessageType("Thing", dict.fromkeys(names[0], "of # (1)"), dict.fromkeys(names[1], "a text"))
    decode = ros2(type.definition, type.name)
    assert not isinstance(decode, str)
    content = decode(type.encode(time_ns, numbers, texts))
    assert stamp_ns(content) == time_ns
    assert [getattr(content, name) for name in names[0]] == numbers
    assert [getattr(content, name) for name in names[1]] == texts


@pytest.mark.parametrize("kind", registry.names())
def test_channels_of_every_vehicle_are_names_of_ros(kind: str) -> None:
    for channel in registry.channels_of(kind):
        assert re.fullmatch(r"[a-z][a-z0-9]*(_[a-z0-9]+)*", channel.name)
        assert "\n" not in channel.meaning


# What is shown


async def test_viewer_gets_every_cycle_as_it_is_recorded(client: ObserverClient, port: int) -> None:
    frames = [replace(frame, timestamp_ns=frame.timestamp_ns // 2) for frame in cycles()[:1500]]  # 500 Hz
    frames[3] = Frame(frames[3].timestamp_ns, (math.nan, *frames[3].values[1:]))
    async with viewer(port) as seen:
        await seen.watch("/vehicle")
        summary = await record(client, frames)
        client.offer(frames[-1])  # the last one had no successor that would have filled its batch
        await seen.until(lambda: len(seen.received("/vehicle")) >= len(frames))
    recorded = list(load(Path(summary["recording"])).frames(MONOCAB))
    received = seen.received("/vehicle")[: len(frames)]
    assert len(recorded) == len(frames)
    assert [time_ns for time_ns, _ in received] == [frame.timestamp_ns for frame in recorded]
    assert [stamp_ns(content) for _, content in received] == [frame.timestamp_ns for frame in recorded]
    assert repr([values(content) for _, content in received]) == repr([frame.values for frame in recorded])
    channel = seen.topics["/vehicle"]
    assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg"), "PlotJuggler plots no other"
    assert re.search(r"^float64 roll  # .*\(rad\)$", channel["schema"], re.M)


async def test_viewer_gets_predictions_and_innovations(client: ObserverClient, port: int, tmp_path: Path) -> None:
    prediction = live_prediction(hello(tmp_path), MONOCAB)
    assert prediction is not None
    async with viewer(port) as seen:
        await seen.watch("/prediction", "/log")
        turn = 0
        earlier: list[Frame] = []
        while not seen.received("/prediction"):  # the observer loads its model meanwhile
            turn += 1
            earlier = later(cycles()[:500], turn)
            await shown(client, seen, earlier)
        begin = len(seen.received("/prediction"))
        frames = later(cycles(), turn + 1)
        await shown(client, seen, frames)
    list(prediction.update(earlier))
    expected = []
    for segment in prediction.update(frames):
        for place in range(len(segment["values"]["roll"])):
            time_ns = round(segment["t0"] * 1e9 + place * (segment["dt"] * 1e9))
            expected.append((time_ns, [segment[key]["roll"][place] for key in ("values", "innovations")]))
    # An innovation depends on the noise of the latest segments, of which the observer may have had others before.
    settled = frames[0].timestamp_ns + (LATEST + 1) * 500_000_000
    received = seen.received("/prediction")[begin:]
    shown_values = [(time_ns, [each.roll, each.roll_innovation]) for time_ns, each in received if time_ns >= settled]
    assert len(shown_values) > 100
    assert shown_values == [(time_ns, values) for time_ns, values in expected if time_ns >= settled]


def later(frames: list[Frame], turns: int) -> list[Frame]:
    """The same cycles, so many times 20 s later."""
    return [replace(frame, timestamp_ns=frame.timestamp_ns + turns * 20_000_000_000) for frame in frames]


async def shown(client: ObserverClient, seen: Viewer, frames: list[Frame]) -> None:
    """Send cycles and an event, until the viewer has the event."""
    for frame in frames:
        client.offer(frame)
    before = len(seen.received("/log"))
    client.event("info", "x", "all cycles are sent")
    await seen.until(lambda: len(seen.received("/log")) > before)


async def test_viewer_gets_state_health_and_events(client: ObserverClient, port: int) -> None:
    async with viewer(port) as seen:
        await seen.watch("/state", "/health", "/log")
        client.offer(cycles()[0])
        client.retain("state", STATE_OF_TEST)
        client.health(HEALTH)
        client.event("warning", "drive_set_up", "a drive is slow")
        await seen.until(lambda: seen.received("/log"))
    states, (health,) = seen.received("/state"), seen.received("/health")
    assert len(states) == 2, "at its change, and with the health for those who came later"
    for _, content in states:
        shown = {name: getattr(content, name) for name in STATE_OF_TEST}
        assert shown == {**STATE_OF_TEST, "experiment": "", "reason": "grüß e"}
    numbers = health[1]
    assert math.isnan(numbers.rate)
    assert (numbers.cycles, numbers.missed_cycles, numbers.bus_load) == (4.0, 1.0, 20.5)
    assert (numbers.bus_dropped, numbers.bus_error_frames, numbers.nearest_limit) == (3.0, 3.0, 71.0)
    ((time_ns, entry),) = seen.received("/log")
    assert 0 <= time_ns - cycles()[0].timestamp_ns < 40e9, "on the time axis of the data"
    stamp = Timestamp(*divmod(time_ns, 1_000_000_000))
    expected = Log(timestamp=stamp, level=LogLevel.Warning, message="a drive is slow", name="drive_set_up")
    assert entry == expected.encode()
    assert seen.topics["/log"]["schemaName"] == "foxglove.Log"
    assert seen.topics["/state"]["schema"] == STATE.definition


async def test_daemon_shows_a_virtual_vehicle_as_of_now(tmp_path: Path, port: int) -> None:
    path = tmp_path / "s.sock"
    command = [*UPRIGHT, "serve", "monocab", "--virtual", "--data", str(tmp_path), "--socket", str(path)]
    surroundings = {**os.environ, "UPRIGHT_FOXGLOVE": str(port)}
    daemon = await asyncio.create_subprocess_exec(*command, env=surroundings, stderr=asyncio.subprocess.DEVNULL)
    try:
        async with viewer(port, 80.0) as seen:
            await seen.watch("/vehicle", "/state")
            await seen.until(lambda: len(seen.received("/vehicle")) > 100 and seen.received("/state"))
    finally:
        daemon.send_signal(signal.SIGTERM)
        await asyncio.wait_for(daemon.wait(), 30.0)
    times = [time_ns for time_ns, _ in seen.received("/vehicle")]
    assert all(abs(after - before - 4_000_000) < 1_000 for before, after in pairwise(times))
    for time_ns in (times[0], seen.received("/state")[0][0]):
        assert abs(time_ns - time.time_ns()) < 60e9
    assert seen.info["name"].startswith("monocab (upright ")


# What nobody can do


async def test_viewer_cannot_command(client: ObserverClient, port: int) -> None:
    commands: list[Any] = []
    client.on_command = commands.append
    async with viewer(port) as seen:
        await seen.watch("/vehicle")
        assert seen.info["capabilities"] == []
        channel = {"id": 1, "topic": "/vehicle", "encoding": "json", "schemaName": ""}
        await seen.send(op="advertise", channels=[channel])
        await seen.send(op="setParameters", parameters=[{"name": "mode", "value": "running"}])
        await seen.send(op="fetchAsset", uri="file:///etc/hostname", requestId=1)
        await seen.socket.send(b"\x02" + bytes(16))  # a call of a service
        await seen.until(lambda: len(seen.refusals) == 4)
        assert all(refusal.startswith("Server does not support") for refusal in seen.refusals), seen.refusals
    assert not commands


async def test_client_that_never_reads_takes_no_memory_and_delays_nobody(client: ObserverClient, port: int) -> None:
    frames = cycles()
    assert len(frames) < BACKLOG
    async with viewer(port) as deaf, viewer(port) as seen:
        for each in (deaf, seen):
            await each.watch("/vehicle", "/prediction", "/log")
        deaf.socket.transport.pause_reading()
        first = 0
        while not seen.received("/prediction"):  # the observer still loads its model, which takes memory, too
            first += 1
            await shown(client, seen, later(frames, first))
        before = resident(client)
        for turn in range(first + 1, first + 41):
            await shown(client, seen, later(frames, turn))
        assert len(seen.received("/vehicle")) == (first + 40) * len(frames)
        sent = 40 * len(frames) * len(frames[0].values) * 8
        assert sent > 10_000_000
        assert resident(client) - before < sent / 3
        summary = await record(client, frames)
        assert (summary["failure"], summary["rows"]) == ("", len(frames))
        await client.stop()
        assert client._process is not None
        assert client._process.returncode == 0  # by itself: one that waits for the client is killed
        deaf.socket.transport.resume_reading()  # it finds that the server has gone


def resident(client: ObserverClient) -> int:
    """Memory of the observer, bytes."""
    return int(Path(f"/proc/{client.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")


# Switched off, or not to be had


async def test_nothing_is_served_or_loaded_unless_asked_for(tmp_path: Path) -> None:
    client = ObserverClient(hello(tmp_path))
    await client.start()
    await until(lambda: "trouble" in client.statistics())
    assert "_foxglove_py" not in Path(f"/proc/{client.pid}/maps").read_text()
    assert not listening_sockets(client.pid)
    await client.stop()


async def test_port_listens_on_this_computer_alone(client: ObserverClient, port: int) -> None:
    async with viewer(port):
        assert listening_sockets(client.pid) == [f"0100007F:{port:04X}"]


def listening_sockets(pid: int | None) -> list[str]:
    """The addresses at which a process listens, as in /proc/net/tcp."""
    own = {os.readlink(link) for link in Path(f"/proc/{pid}/fd").iterdir()}
    found = []
    for table in ("tcp", "tcp6"):
        for line in Path(f"/proc/{pid}/net/{table}").read_text().splitlines()[1:]:
            columns = line.split()
            if columns[3] == "0A" and f"socket:[{columns[9]}]" in own:
                found.append(columns[1])
    return found


async def test_taken_port_is_an_event_with_the_remedy_and_cycles_are_recorded(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        client = ObserverClient({**hello(tmp_path), "foxglove_port": port})
        await client.start()
        await until(lambda: client.statistics().get("trouble"))
        trouble = client.statistics()["trouble"]
        assert f"at port {port} of this computer" in trouble
        assert "--foxglove PORT" in trouble
        summary = await record(client, cycles()[:500])
        assert (summary["failure"], summary["rows"]) == ("", 500)
        await client.stop()


async def test_missing_package_is_an_event_with_the_remedy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delitem(sys.modules, "upright.service.observer.viewers.foxglove_server")
    monkeypatch.setitem(sys.modules, "foxglove", None)
    own, other = link.pair()
    with own, other:
        given = {**hello(tmp_path), "foxglove_port": free_port()}
        observer = Observer(other, given)
        observer.serve_foxglove(given)
        assert "pip install 'upright[foxglove]'" in observer._trouble
        loop = asyncio.get_running_loop()
        running = asyncio.create_task(observer.run())
        codec = link.FrameCodec(len(MONOCAB))
        await loop.sock_sendall(own, codec.pack(cycles()[:20]))
        own.shutdown(socket.SHUT_WR)
        await running
