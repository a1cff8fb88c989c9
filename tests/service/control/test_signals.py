"""Signals to `upright serve`: every one that ends it ends it in order, as a client on the control socket sees."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from upright.service.control.clients.api import ApiError, call

SERVE = "from upright.service.cli import main; main()"


@contextmanager
def serve(folder: Path, *before: str) -> Iterator[subprocess.Popen[bytes]]:
    """A daemon with a virtual vehicle, once it answers."""
    place = ["--data", str(folder), "--socket", str(folder / "s.sock")]
    log = (folder / "log").open("wb")
    daemon = subprocess.Popen(
        [*before, sys.executable, "-c", SERVE, "serve", "monocab", "--virtual", *place], stderr=log
    )
    try:
        until(lambda: (folder / "s.sock").exists())
        yield daemon
    finally:
        daemon.kill()
        daemon.wait()
        log.close()


def until(what: object, seconds: float = 40.0) -> None:
    end = time.monotonic() + seconds
    while not what():  # type: ignore[operator]
        assert time.monotonic() < end, "not in time"
        time.sleep(0.1)


def status(folder: Path) -> dict[str, object]:
    found: dict[str, object] = list(call([folder / "s.sock"], {"verb": "status"}))[-1]["status"]
    return found


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGTERM])
def test_vehicle_is_lowered_before_the_daemon_ends(tmp_path: Path, number: signal.Signals) -> None:
    with serve(tmp_path) as daemon:
        until(lambda: not status(tmp_path)["interlocks"])
        phases: list[str] = []
        with suppress(ApiError):  # it closes its socket when the vehicle is down
            for message in call([tmp_path / "s.sock"], {"verb": "experiment", "name": "hold"}, timeout=60.0):
                if message["type"] == "progress" and message["phase"] not in phases:
                    phases.append(message["phase"])
                    if message["phase"] == "settle":
                        daemon.send_signal(number)
        assert phases[-3:-1] == ["settle", "lower"] or phases[-4:-2] == ["settle", "lower"], phases
        assert daemon.wait(30) == 0


def test_ignored_hangup_stays_ignored(tmp_path: Path) -> None:
    with serve(tmp_path, "nohup") as daemon:
        daemon.send_signal(signal.SIGHUP)
        time.sleep(0.5)
        assert status(tmp_path)["vehicle"] == "monocab"
        assert daemon.poll() is None


def test_second_daemon_on_a_bus_is_refused_whatever_its_socket(tmp_path: Path) -> None:
    bus = f"udp_multicast:239.74.163.{os.getpid() % 200 + 20}"
    first_place, second_place = tmp_path / "first", tmp_path / "second"
    command = [sys.executable, "-c", SERVE, "serve", "monocab", "--bus", bus]
    with (tmp_path / "log").open("wb") as log:
        first = subprocess.Popen([*command, "--data", first_place, "--socket", first_place / "s.sock"], stderr=log)
        try:
            until((first_place / "s.sock").exists)
            second = subprocess.run(
                [*command, "--data", second_place, "--socket", second_place / "s.sock"], capture_output=True, timeout=30
            )
            assert second.returncode == 1
            said = " ".join(second.stderr.decode().split())
            assert f"{bus} is already served by process {first.pid} (upright serve monocab" in said
            assert first.poll() is None
        finally:
            first.terminate()
            first.wait(30)
