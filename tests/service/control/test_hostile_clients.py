"""Clients of the control socket that hammer, send garbage, never read, hold a thousand connections, or never finish.

The turns are taken by hand: what is counted is what a control cycle can cost at most, whatever the clients do.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import resource
import socket
from collections.abc import AsyncIterator, Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from types import SimpleNamespace

import pytest

from upright.service import turns as turns_module
from upright.service.control import daemon as daemon_module
from upright.service.control.clients import server as server_module
from upright.service.control.clients.api import ExitCode, Message, result
from upright.service.control.clients.peers import Peer
from upright.service.control.clients.server import (
    MAX_LINE,
    MOST_CONNECTIONS,
    MOST_OF_A_PROCESS,
    MOST_WAITING,
    ApiServer,
    parse,
)
from upright.service.control.daemon import STATUS_AGE, Daemon, Places
from upright.service.turns import MOST_A_TURN, Turns
from upright.vehicles.file import load

FIRST = f"terminal 1 of {Peer(1, os.geteuid(), frozenset()).name}"


class Rig:
    """A server whose turns are taken by hand, and clients that are processes of their own for it, if they say so."""

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.begun: list[str] = []
        self.signs: list[Message] = []
        self.closed: list[str] = []
        """Clients whose answers have ended."""
        self.turns = Turns()
        self.server = ApiServer(path, self.answer, self.signs.append, self.turns)
        self._path = path
        self._stack = ExitStack()
        self._processes: dict[int, int] = {}
        monkeypatch.setattr(
            server_module, "peer_of", lambda accepted: Peer(self._next_process, os.geteuid(), frozenset())
        )
        self._next_process = 1

    async def answer(self, request: Message) -> AsyncIterator[Message]:
        self.begun.append(request["verb"])
        try:
            while request["verb"] == "flood":
                yield {"type": "progress", "text": "x" * 10_000}
                await asyncio.sleep(0)
            while request["verb"] == "experiment":
                await asyncio.sleep(0)
            yield result(ExitCode.DONE, text=request["verb"])
        finally:
            self.closed.append(request["client"])

    async def turn(self) -> None:
        """One turn, and what the event loop does until the next."""
        self.turns.take()
        for _ in range(4):
            await asyncio.sleep(0)

    async def turn_until(self, what: object, most: int) -> int:
        """The number of turns until `what()` is true, at most `most`."""
        for number in range(most + 1):
            if what():  # type: ignore[operator]
                return number
            await self.turn()
        raise AssertionError(f"not in {most} turns")

    def connect(self, data: bytes = b"") -> socket.socket:
        """A client that has sent `data`."""
        client = self._stack.enter_context(socket.socket(socket.AF_UNIX))
        client.setblocking(False)
        client.connect(str(self._path))
        if data:
            client.send(data)
        return client

    async def accept(self, process: int, data: bytes = b"") -> socket.socket:
        """A client of `process`, once the server has accepted or refused its connection."""
        client = self.connect(data)
        self._next_process = process
        await self.turn()
        return client

    def close(self) -> None:
        self._stack.close()


@pytest.fixture
async def rig(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> AsyncIterator[Rig]:
    monkeypatch.setattr(turns_module, "PERIOD", 1e6)
    made = Rig(tmp_path / "s.sock", monkeypatch)
    await made.server.start()
    yield made
    made.close()
    await made.server.close()


def received(client: socket.socket) -> bytes:
    """What has arrived, b"" if nothing has, or the connection is closed."""
    try:
        return client.recv(1 << 20)
    except (BlockingIOError, ConnectionError):
        return b""


def is_closed(client: socket.socket) -> bool:
    try:
        while client.recv(1 << 20):
            pass
    except BlockingIOError:
        return False
    except ConnectionError:
        return True
    return True


async def test_hammering_begins_one_request_a_turn_and_a_stop_is_among_the_next(rig: Rig) -> None:
    hammer = [await rig.accept(1 + number // MOST_OF_A_PROCESS) for number in range(MOST_CONNECTIONS - 1)]
    operator = await rig.accept(99)
    for client in hammer:
        client.send(b'{"verb": "status"}\n')
    operator.send(b'{"verb": "stop"}\n')
    turns = 0
    while b"stop" not in received(operator):
        before = len(rig.begun)
        await rig.turn()
        assert len(rig.begun) <= before + 1
        turns += 1
        assert turns < 2 * MOST_CONNECTIONS
        for number, client in enumerate(hammer):  # they ask again as soon as they are answered
            if is_closed(client):
                hammer[number] = rig.connect(b'{"verb": "status"}\n')
    assert len(rig.begun) > 1


async def test_renewals_get_through_while_others_hammer_and_send_signs_that_count_for_nothing(rig: Rig) -> None:
    holder = await rig.accept(1, b'{"verb": "experiment"}\n')
    await rig.turn_until(lambda: "experiment" in rig.begun, 3)
    others = [await rig.accept(2 + number // 4, b'{"verb": "experiment"}\n') for number in range(MOST_CONNECTIONS - 1)]
    for _ in range(10):
        for client in others:
            client.send(b'{"verb": "renew"}\n' * 50)
        holder.send(b'{"verb": "renew"}\n')
        before = len(rig.signs)

        def heard(before: int = before) -> bool:
            return any(sign["client"] == FIRST for sign in rig.signs[before:])

        turns = await rig.turn_until(heard, MOST_CONNECTIONS // MOST_A_TURN + 2)
        assert len(rig.signs) - before <= turns * MOST_A_TURN


@pytest.mark.parametrize(
    "line",
    [b"\0\xff\xfe\n", b"[" * 20_000 + b"\n", b'{"verb": ' + b"9" * 5000 + b"}\n", b'{"verb": null}\n', b"\n"],
    ids=["bytes", "deep", "long number", "no verb", "empty"],
)
async def test_garbage_is_refused_and_the_connection_closed(rig: Rig, line: bytes) -> None:
    client = await rig.accept(1, line)
    for _ in range(20):
        await rig.turn()
    assert b"bad_request" in received(client)
    assert is_closed(client)
    assert rig.begun == []
    assert rig.server.statistics()["connected"] == 0


async def test_garbage_from_the_holder_of_a_lease_ends_its_answer(rig: Rig) -> None:
    holder = await rig.accept(1, b'{"verb": "experiment"}\n')
    await rig.turn_until(lambda: rig.begun, 3)
    holder.send(b"garbage\n")
    await rig.turn_until(lambda: rig.closed == [FIRST], 3)
    assert rig.signs == [{"verb": "gone", "client": FIRST}]


async def test_client_that_never_reads_is_disconnected_and_its_memory_bounded(rig: Rig) -> None:
    client = await rig.accept(1, b'{"verb": "flood"}\n')
    await rig.turn_until(lambda: rig.closed, 2000)
    assert rig.server.statistics() == {"connected": 0, "refused": 0, "dropped": 1}
    client.setblocking(True)
    there = 0
    while data := client.recv(1 << 20):
        there += len(data)
    assert there < 2 * MOST_WAITING + 300_000  # what waited, and what the kernel held


async def test_client_that_reads_nothing_of_a_short_answer_is_not_waited_for(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = rig.connect()
    client.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1)
    await rig.turn()
    (connection,) = rig.server._connections
    connection._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 1)
    connection.requested = True
    connection.send({"type": "result", "text": "x" * 100_000})
    connection.finish()
    for _ in range(5):
        await rig.turn()
    assert rig.server.statistics()["connected"] == 1
    monkeypatch.setattr(server_module, "PATIENCE", 0.0)
    rig.server._look_for_the_idle()
    assert rig.server.statistics() == {"connected": 0, "refused": 0, "dropped": 1}


@pytest.fixture
def descriptors() -> Iterator[None]:
    """Enough of them for a thousand clients in this process."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(4096, hard), hard))
    yield
    resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


@pytest.mark.usefixtures("descriptors")
async def test_thousand_connections_of_one_process_leave_room_for_others(rig: Rig) -> None:
    clients = []
    for _ in range(1000 // MOST_A_TURN):
        clients += [rig.connect() for _ in range(MOST_A_TURN)]
        await rig.turn()  # accepts or refuses as many
    assert rig.server.statistics()["connected"] == MOST_OF_A_PROCESS
    assert rig.server.refused == 1000 - MOST_OF_A_PROCESS
    assert b"busy" in received(clients[-1])
    assert is_closed(clients[-1])
    operator = await rig.accept(2, b'{"verb": "stop"}\n')
    await rig.turn_until(lambda: b"stop" in received(operator), 4)


async def test_half_open_requests_make_room_for_others_and_end(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    half = [await rig.accept(10 + number, b'{"verb": "sta') for number in range(MOST_CONNECTIONS)]
    assert rig.server.statistics()["connected"] == MOST_CONNECTIONS
    operator = await rig.accept(2, b'{"verb": "stop"}\n')
    await rig.turn_until(lambda: b"stop" in received(operator), 4 + MOST_CONNECTIONS // MOST_A_TURN)
    assert is_closed(half[0])
    assert not is_closed(half[1])
    rig.server._look_for_the_idle()
    assert rig.server.statistics()["connected"] == MOST_CONNECTIONS - 1
    monkeypatch.setattr(server_module, "PATIENCE", 0.0)
    rig.server._look_for_the_idle()
    assert rig.server.statistics()["connected"] == 0
    assert rig.begun == ["stop"]
    assert rig.signs == [], "who has requested nothing holds no lease"


async def test_all_places_in_use_by_requests_refuse_one_more(rig: Rig) -> None:
    for number in range(MOST_CONNECTIONS):
        await rig.accept(10 + number, b'{"verb": "experiment"}\n')
    await rig.turn_until(lambda: len(rig.begun) == MOST_CONNECTIONS, 2 * MOST_CONNECTIONS)
    late = await rig.accept(2, b'{"verb": "stop"}\n')
    assert json.loads(received(late))["code"] == "busy"


async def test_huge_line_ends_the_connection_before_it_is_long(rig: Rig) -> None:
    client = await rig.accept(1)
    sent = 0
    while not rig.server.dropped:
        with suppress(BlockingIOError):
            sent += client.send(b"x" * 4096)
        await rig.turn()
        assert sent < 1_000_000
    assert is_closed(client)
    assert rig.server.statistics()["connected"] == 0


async def test_long_request_is_answered_although_it_comes_in_parts(rig: Rig) -> None:
    line = json.dumps({"verb": "status", "padding": "x" * (MAX_LINE - 100)}).encode() + b"\n"
    client = await rig.accept(1)
    for begin in range(0, len(line), 5000):
        client.send(line[begin : begin + 5000])
        await rig.turn()
    await rig.turn_until(lambda: b"status" in received(client), 10)


async def test_answer_to_many_is_encoded_once(rig: Rig) -> None:
    message = result(ExitCode.DONE, text="the same")
    assert rig.server.line(message) is rig.server.line(message)
    assert json.loads(rig.server.line(result(ExitCode.DONE, text="another")))["text"] == "another"


async def test_status_is_computed_again_after_a_while_and_when_the_state_changes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    daemon = Daemon(load("monocab"), Places("virtual:status", "virtual:status", tmp_path, tmp_path / "s"))
    now = SimpleNamespace(monotonic=lambda: 100.0)
    monkeypatch.setattr(daemon_module, "time", now)
    first = daemon.status()
    assert daemon.status() is first
    daemon.loop.set_up_done()
    daemon._publish_state()  # as the loop does by itself once the daemon runs
    changed = daemon.status()
    assert changed["mode"] == "disarmed"
    assert daemon.status() is changed
    now.monotonic = lambda: 100.0 + STATUS_AGE
    assert daemon.status() is not changed


async def test_client_that_sends_and_stops_sending_is_answered(rig: Rig) -> None:
    client = await rig.accept(1, b'{"verb": "status"}\n')
    client.shutdown(socket.SHUT_WR)
    await rig.turn_until(lambda: b"status" in received(client), 5)


@pytest.mark.parametrize("seed", range(20))
def test_no_line_raises_anything_but_value_error(seed: int) -> None:
    line = random.Random(seed).randbytes(64 * (seed + 1)) if seed % 2 else b'{"verb":' + b"[{" * 700 * seed
    with pytest.raises(ValueError):
        parse(line)
