"""Broker, daemon with a virtual vehicle, and dashboard, as `broker/topology` starts them, for tests with real parts."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from upright.service.control.clients.api import ApiError, call

REPOSITORY = Path(__file__).resolve().parents[2]
LEASE = 1.0
"""s, for a machine that runs a browser, a broker, a plant and other tests on two processors: with a load of 12 on them
the page's timer was 0.3 s late, and its signs of life 0.4 s apart. A lease of 300 ms is tested without a browser."""


def vehicle_text(**durations: float) -> str:
    """The shipped vehicle file with a longer lease, and with these durations of experiments, s."""
    text = (REPOSITORY / "vehicles" / "monocab" / "vehicle.toml").read_text()
    text = text.replace("\n[imu]", f"lease = {LEASE}\n\n[imu]", 1)
    for name, seconds in durations.items():
        head, mark, rest = text.partition(f"[experiments.{name}]")
        before, key, after = rest.partition("duration = ")
        text = f"{head}{mark}{before}{key}{seconds}{after[after.index(chr(10)) :]}"
    return text


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Topology:
    """The running parts. `page` is the dashboard's address, with its token."""

    folder: Path
    mqtt: int
    websocket: int
    page: str

    @property
    def recordings(self) -> Path:
        return self.folder / "recordings"

    def password(self, user: str) -> str:
        return (self.folder / "secrets" / user).read_text()

    def ask(self, verb: str, **arguments: Any) -> dict[str, Any]:
        """The daemon's result of a request over its control socket."""
        return list(call([self.folder / "upright.sock"], {"verb": verb, **arguments}, timeout=60.0))[-1]

    def status(self) -> dict[str, Any]:
        found: dict[str, Any] = self.ask("status")["status"]
        return found

    def until(self, what: str, wanted: object, limit: float = 60.0) -> dict[str, Any]:
        """Wait until the entry `what` of the status is `wanted`, and return the status."""
        status: dict[str, Any] = {}
        end = time.monotonic() + limit
        while time.monotonic() < end:
            status = self.status()
            if status[what] == wanted:
                return status
            time.sleep(0.2)
        raise AssertionError(f"{what} is not {wanted!r} within {limit} s, but {status[what]!r}: {status['reason']}")


@contextmanager
def topology(folder: Path, text: str, *options: str) -> Iterator[Topology]:
    """Run the script with this vehicle file until the block ends."""
    if shutil.which("mosquitto", path=f"{os.environ['PATH']}:/usr/sbin:/usr/local/sbin") is None:
        pytest.skip("no mosquitto here: apt-get install mosquitto")
    file = folder / "monocab.toml"
    file.write_text(text)
    made = Topology(folder / "run", free_port(), free_port(), "")
    port = free_port()
    made.page = f"http://localhost:{port}/"
    environment = {
        **os.environ,
        "MQTT_PORT": str(made.mqtt),
        "WEBSOCKET_PORT": str(made.websocket),
        "DASHBOARD_PORT": str(port),
        "UPRIGHT": str(Path(sys.executable).with_name("upright")),
    }
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            [REPOSITORY / "broker" / "topology", made.folder, file, *options],
            env=environment, stdout=log, stderr=log, start_new_session=True,
        )  # fmt: skip
        try:
            _until_answers(made, process)
            made.page += f"#token={made.password('page')}"
            yield made
        finally:
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(40)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
            sys.stderr.write((folder / "log").read_text())


def _until_answers(made: Topology, process: subprocess.Popen[bytes]) -> None:
    end = time.monotonic() + 60.0
    while True:
        with suppress(OSError, ApiError):
            with urllib.request.urlopen(made.page, timeout=5.0):
                pass
            if not made.status()["interlocks"]:
                return
        assert process.poll() is None, "the topology ended"
        assert time.monotonic() < end, "the topology is not ready"
        time.sleep(0.3)
