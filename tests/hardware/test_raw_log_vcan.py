"""The raw log process on real SocketCAN: kernel timestamps, both buses in order, and the end of its master."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest
from observer_harness import until

from upright.service.observer.recording.raw_log_client import RawLogProcess
from upright.telemetry.candump import CandumpReader
from upright.telemetry.samples import CanFrame

pytestmark = pytest.mark.vcan


class EventList(list[tuple[str, str, str]]):
    """Events: severity, code, text."""

    def __call__(self, severity: str, code: str, text: str) -> None:
        self.append((severity, code, text))


class Sender:
    """Sends frames on vcan0 and vcan1 and gets the kernel's timestamp of each from a listener of its own."""

    def __init__(self) -> None:
        self._sockets = [self._open(channel) for channel in ("vcan0", "vcan1")]
        self._listeners = [self._open(channel) for channel in ("vcan0", "vcan1")]
        for listener in self._listeners:
            listener.setsockopt(socket.SOL_SOCKET, 35, 1)  # SO_TIMESTAMPNS

    def _open(self, channel: str) -> socket.socket:
        raw = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
        raw.bind((channel,))
        return raw

    def send(self, bus: int, can_id: int, data: bytes) -> CanFrame:
        self._sockets[bus].send(struct.pack("=IB3x8s", can_id, len(data), data))
        _, ancillary, _, _ = self._listeners[bus].recvmsg(16, 64)
        seconds, nanoseconds = struct.unpack("@qq", ancillary[0][2])
        flags = {"extended": bool(can_id & 0x80000000), "remote": bool(can_id & 0x40000000)}
        return CanFrame(seconds * 1_000_000_000 + nanoseconds, can_id & 0x1FFFFFFF, data, bus, **flags)

    def send_untimed(self, bus: int, can_id: int, data: bytes) -> None:
        self._sockets[bus].send(struct.pack("=IB3x8s", can_id, len(data), data))

    def close(self) -> None:
        for raw in (*self._sockets, *self._listeners):
            raw.close()


@pytest.fixture
def events() -> EventList:
    return EventList()


Start = Callable[..., RawLogProcess]


@pytest.fixture
async def start(events: EventList) -> AsyncIterator[Start]:
    """A function that starts a raw log process on the given channels; the process is stopped after the test."""
    started: list[RawLogProcess] = []

    def start(*channels: str) -> RawLogProcess:
        started.append(RawLogProcess(channels, events))
        return started[-1]

    yield start
    for process in started:
        await process.stop()


@pytest.fixture
def sender() -> Iterator[Sender]:
    sender = Sender()
    yield sender
    sender.close()


def link(channel: str, state: str) -> None:
    subprocess.run(["ip", "link", "set", channel, state], check=True)


async def test_every_frame_of_both_buses_is_logged_from_start_to_end(
    sender: Sender, start: Start, events: EventList, tmp_path: Path
) -> None:
    process = start("vcan0", "vcan1")
    process.open(tmp_path / "first.log", 0)
    await until((tmp_path / "first.log").exists)  # It listens now, however long a slow machine takes to start it.
    path = tmp_path / "folder" / "run.log"
    start_ns = time.time_ns() + 300_000_000
    process.open(path, start_ns)
    sent = []
    while time.time_ns() < start_ns + 700_000_000:
        for i in range(20):
            sent.append(sender.send(i % 2, 0x180 + i, bytes([len(sent) % 256] * (i % 9))))
        await asyncio.sleep(0.01)
    sent.append(sender.send(0, 0x80000000 | 0x18ABCDEF, b"\x01"))
    sent.append(sender.send(1, 0x40000000 | 0x181, b""))
    end_ns = sent[-1].timestamp_ns
    process.close(end_ns)
    sender.send(0, 0x700, b"too late")
    await process.stop()
    reader = CandumpReader(path)
    logged = list(reader)
    # A reader numbers the buses as they appear, and the first frame after the start may be from the second bus.
    expected = [
        replace(frame, bus=reader.buses[f"vcan{frame.bus}"]) for frame in sent if frame.timestamp_ns >= start_ns
    ]
    assert logged == expected
    assert len(logged) > 500
    assert reader.truncated == ""
    assert not events


async def test_consecutive_recordings_are_kept_and_none_is_overwritten(
    sender: Sender, start: Start, events: EventList, tmp_path: Path
) -> None:
    process = start("vcan0")
    for name in ("a", "b"):
        process.open(tmp_path / f"{name}.log", 0)
        await until(lambda name=name: (tmp_path / f"{name}.log").exists())  # type: ignore[misc]
        await asyncio.sleep(0.1)
        sender.send(0, 0x100, name.encode())
    await asyncio.sleep(0.1)
    process.open(tmp_path / "a.log", 0)
    await until(lambda: events)
    await process.stop()
    assert "File exists" in events[0][2]
    assert [[frame.data for frame in CandumpReader(tmp_path / f"{name}.log")] for name in ("a", "b")] == [
        [b"a"],
        [b"b"],
    ]


async def test_missing_interface_is_reported_as_an_error(start: Start, events: EventList, tmp_path: Path) -> None:
    process = start("vcan9")
    process.open(tmp_path / "run.log", 0)
    await until(lambda: events)
    assert events[0][:2] == ("error", "raw_log")
    assert "No such device" in events[0][2]


async def test_logging_continues_after_the_interface_went_down_and_came_back(
    sender: Sender, start: Start, events: EventList, tmp_path: Path
) -> None:
    process = start("vcan1")
    process.open(tmp_path / "run.log", 0)
    await until((tmp_path / "run.log").exists)
    await asyncio.sleep(0.2)
    sender.send(1, 0x100, b"before")
    link("vcan1", "down")
    try:
        await until(lambda: events)
    finally:
        link("vcan1", "up")
    assert "vcan1" in events[0][2]
    sender.close()
    again = Sender()
    again.send(1, 0x100, b"after")
    again.close()
    await asyncio.sleep(0.2)
    await process.stop()
    assert [frame.data for frame in CandumpReader(tmp_path / "run.log")] == [b"before", b"after"]
    assert len(events) == 1


async def test_frames_lost_to_a_full_buffer_are_counted(
    sender: Sender, start: Start, events: EventList, tmp_path: Path
) -> None:
    process = start("vcan0")
    path = tmp_path / "run.log"
    process.open(path, 0)
    await until(path.exists)
    await asyncio.sleep(0.2)
    os.kill(process.pid, signal.SIGSTOP)
    total = 20_000  # twice the capacity of the buffer even of a privileged process
    for i in range(total):
        sender.send_untimed(0, 0x123, i.to_bytes(2, "big"))
    os.kill(process.pid, signal.SIGCONT)
    await until(lambda: path.stat().st_size)
    sender.send(0, 0x123, b"the last")
    await process.stop()
    logged = list(CandumpReader(path))
    ((severity, _, text),) = events
    assert severity == "warning"
    assert text.startswith(f"{total + 1 - len(logged)} frames did not reach")
    assert 100 < len(logged) < total


async def test_killed_process_leaves_complete_lines_and_its_end_is_reported(
    sender: Sender, start: Start, events: EventList, tmp_path: Path
) -> None:
    process = start("vcan0")
    path = tmp_path / "run.log"
    process.open(path, 0)
    await until(path.exists)
    await asyncio.sleep(0.1)
    sent = [sender.send(0, 0x123, bytes([i])) for i in range(50)]
    await until(lambda: path.stat().st_size)  # on the disk within a second
    os.kill(process.pid, signal.SIGKILL)
    await asyncio.sleep(0.1)
    process.close(0)
    await until(lambda: events)
    assert "ended" in events[0][2]
    logged = list(CandumpReader(path))
    assert logged == sent[: len(logged)]


MASTER = """
import subprocess, sys, time
command = [sys.executable, "-m", "upright.service.observer.recording.raw_log", "vcan0"]
log = subprocess.Popen(command, stdin=subprocess.PIPE, bufsize=0)
log.stdin.write(b"open 0 {path}\\n")
print(log.pid, flush=True)
time.sleep(60)
"""


def test_process_outlives_its_master_by_a_second_ignores_signals_and_ends(sender: Sender, tmp_path: Path) -> None:
    path = tmp_path / "run.log"
    master = subprocess.Popen([sys.executable, "-c", MASTER.format(path=path)], stdout=subprocess.PIPE, text=True)
    assert master.stdout is not None
    log = int(master.stdout.readline())
    while not path.exists():
        time.sleep(0.02)
    time.sleep(0.1)
    first = sender.send(0, 0x100, b"alive")
    master.kill()
    master.wait()
    master.stdout.close()
    os.kill(log, signal.SIGTERM)
    os.kill(log, signal.SIGINT)
    time.sleep(1.0)
    later = sender.send(0, 0x100, b"stopping")
    limit = time.monotonic() + 10.0
    while Path(f"/proc/{log}").exists() and "zombie" not in Path(f"/proc/{log}/status").read_text():
        assert time.monotonic() < limit, "the raw log is still there"
        time.sleep(0.05)
    assert list(CandumpReader(path)) == [first, later]
