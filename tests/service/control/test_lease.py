"""The lease on an experiment: renewals that are regular, repeated, late or missing; clients killed or suspended."""

from __future__ import annotations

import asyncio
import os
import pwd
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from serving import connect, serving, until

from upright.service.control.clients.api import RENEWAL_PERIOD, call
from upright.service.control.clients.lease import LOOK, Lease
from upright.service.control.cycle.operation import Mode
from upright.service.control.daemon import Daemon
from upright.telemetry.storage import load

LENGTH = 0.3
SLACK = 1.0
"""s after the end of the lease that a busy machine may take to detect it."""

UPRIGHT = [sys.executable, "-c", "from upright.service.cli import main; main()"]

pytestmark = pytest.mark.timeout(120)


# --- the lease itself


def test_lease_holds_as_long_as_it_is_renewed() -> None:
    lease = Lease("me", LENGTH)
    for _ in range(1000):
        assert lease.pass_time(LOOK)
        assert lease.renew("me")
    assert not lease.ended


def test_lease_ends_without_renewal_and_a_late_renewal_is_refused() -> None:
    lease = Lease("me", LENGTH)
    held = 0
    while lease.pass_time(LOOK):
        held += 1
    assert held * LOOK == pytest.approx(LENGTH)
    assert lease.ended == "me has not renewed the lease for 300 ms"
    assert not lease.renew("me")
    assert not lease.pass_time(LOOK)
    assert not lease.release("me", "late")


def test_release_ends_the_lease_at_once_and_only_once() -> None:
    lease = Lease("me", LENGTH)
    assert lease.release("me", "me released the lease")
    assert not lease.release("me", "again")
    assert lease.ended == "me released the lease"
    assert not lease.pass_time(0.0)


def test_other_clients_can_neither_renew_nor_release_the_lease() -> None:
    lease = Lease("me", LENGTH)
    assert not lease.renew("you")
    assert not lease.release("you", "you released the lease")
    assert lease.pass_time(LOOK)


def test_delay_of_the_daemon_does_not_end_the_lease() -> None:
    lease = Lease("me", LENGTH)
    assert lease.pass_time(30.0)
    assert lease.renew("me")
    assert lease.pass_time(30.0)


@given(st.lists(st.tuples(st.sampled_from(["sign", "stranger", "pass"]), st.floats(0.0, 0.2)), max_size=60))
def test_lease_ends_exactly_when_the_holder_was_silent_for_its_length(course: list[tuple[str, float]]) -> None:
    lease, silence, over = Lease("me", LENGTH), 0.0, False
    for what, elapsed in course:
        if what == "pass":
            silence += min(elapsed, 2 * LOOK)
            over = over or silence > LENGTH
            assert lease.pass_time(elapsed) is not over
        elif what == "sign":
            assert lease.renew("me") is not over
            silence = 0.0 if not over else silence
        else:
            assert not lease.renew("you")
    assert bool(lease.ended) is over


# --- in the daemon, with a virtual vehicle in real time


async def _ended(daemon: Daemon) -> str:
    """The reason for the end of the run, once it has ended and the next one may start."""
    run = daemon.loop.run
    assert run is not None
    await until(lambda: run.end_reason, LENGTH + SLACK)
    await until(lambda: daemon.loop.mode is not Mode.RUNNING, 30.0)
    assert daemon.loop.mode is Mode.DISARMED, daemon.loop.reason
    assert not any(drive.state and drive.state.value == "Operation enabled" for drive in daemon.loop.io.drives)
    await until(lambda: not daemon.loop.interlocks())
    return run.end_reason


async def test_run_ends_without_renewals_or_connection_and_repeated_renewals_hold_it(tmp_path: Path) -> None:
    async with serving(tmp_path, "virtual:lease-signs") as daemon:
        # No renewal, although the connection is open and the answers are read.
        _, writer = await connect(tmp_path)
        await until(lambda: daemon.loop.mode is Mode.RUNNING)
        assert "not renewed" in await _ended(daemon)
        # A late renewal is refused and does not restart the run.
        assert daemon.commands.sign({"verb": "renew", "client": daemon.commands.lease.holder})["code"] == "no_lease"  # type: ignore[union-attr]
        assert daemon.loop.mode is Mode.DISARMED
        writer.close()
        # Renewals, each sent twice, hold the lease beyond its length; the release ends it.
        _, writer = await connect(tmp_path)
        await until(lambda: daemon.loop.mode is Mode.RUNNING)
        for _ in range(12):
            writer.write(b'{"verb": "renew"}\n{"verb": "renew"}\n')
            await asyncio.sleep(RENEWAL_PERIOD)
        assert daemon.loop.run is not None
        assert not daemon.loop.run.end_reason
        writer.write(b'{"verb": "release"}\n')
        assert "released the lease" in await _ended(daemon)
        writer.close()
        # The connection is cut.
        _, writer = await connect(tmp_path)
        await until(lambda: daemon.loop.mode is Mode.RUNNING)
        writer.transport.abort()
        assert "disconnected" in await _ended(daemon)
        # Garbage instead of a renewal.
        _, writer = await connect(tmp_path)
        await until(lambda: daemon.loop.mode is Mode.RUNNING)
        writer.write(b"nonsense\n")
        assert "disconnected" in await _ended(daemon)
        writer.close()
    # A recording names who started the experiment.
    first = load(min(tmp_path.glob("*.arrow")))
    assert first.metadata["started_by"] == f"terminal 1 of {pwd.getpwuid(os.geteuid()).pw_name}"


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Path]:
    """The socket of a daemon that runs as a process of its own."""
    socket = tmp_path / "s.sock"
    with (tmp_path / "log").open("wb") as log:
        words = ["serve", "monocab", "--virtual", "--data", str(tmp_path), "--socket", str(socket)]
        daemon = subprocess.Popen([*UPRIGHT, *words], stderr=log)
    try:
        _await(socket, lambda status: not status["interlocks"])
        yield socket
    finally:
        daemon.terminate()
        daemon.wait(40)


def _status(socket: Path) -> dict[str, Any]:
    found: dict[str, Any] = list(call([socket], {"verb": "status"}))[-1]["status"]
    return found


def _await(socket: Path, what: Any, limit: float = 40.0) -> dict[str, Any]:
    end = time.monotonic() + limit
    status: dict[str, Any] = {}
    while time.monotonic() < end:
        if socket.exists():
            status = _status(socket)
            if what(status):
                return status
        time.sleep(0.1)
    raise AssertionError(status)


@pytest.mark.parametrize(("blow", "word"), [(signal.SIGKILL, "disconnected"), (signal.SIGSTOP, "not renewed")])
def test_terminal_that_is_killed_or_suspended_ends_its_experiment(
    blow: signal.Signals, word: str, served: Path
) -> None:
    terminal = subprocess.Popen([*UPRIGHT, "experiment", "hold", "--socket", str(served)], stderr=subprocess.DEVNULL)
    try:
        _await(served, lambda status: status["phase"] == "rise")
        os.kill(terminal.pid, blow)
        status = _await(served, lambda status: status["mode"] == "disarmed", 20.0)
        assert word in status["reason"]
        assert word in status["lease"]["ended"]
        assert {drive["state"] for drive in status["drives"]} == {"Switch on disabled"}
    finally:
        terminal.kill()
        terminal.wait()
