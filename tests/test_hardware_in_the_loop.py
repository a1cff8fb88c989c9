"""The real thing but for the iron: daemon and virtual vehicle as two processes on real SocketCAN, in real time.

Enable, balance, each excitation, stop; the master killed; the bus going down and coming back; two buses.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from service.api import ApiError, call
from service.vehicle_file import load
from telemetry.candump import CandumpReader
from telemetry.recording import load as load_recording

pytestmark = [pytest.mark.vcan, pytest.mark.timeout(300)]

UPRIGHT = [sys.executable, "-c", "from service.cli import main; main()"]
VEHICLE = load("monocab")

FIRST, SECOND = (["chrt", "--reset-on-fork", "--fifo", priority] for priority in ("20", "10"))
"""Real-time priorities, as systemd/upright.service.d/realtime.conf gives the daemon: the guest has one processor for
everything. The vehicle comes first, since a real one waits for nobody."""


@dataclass
class Rig:
    """A virtual vehicle and its daemon."""

    vehicle: subprocess.Popen[bytes]
    daemon: subprocess.Popen[bytes]
    data: Path
    socket: Path

    def ask(self, *words: str, timeout: float = 150.0) -> tuple[int, dict[str, Any]]:
        """Exit code and JSON of a command."""
        done = subprocess.run(
            [*UPRIGHT, *words, "--json", "--socket", str(self.socket)],
            capture_output=True,
            timeout=timeout,
            check=False,
        )
        if done.returncode == 1 and not done.stdout:
            return 1, {"text": done.stderr.decode()}
        return done.returncode, json.loads(done.stdout)

    def status(self) -> dict[str, Any]:
        """Asked without starting a process, which would hold up a guest with one processor."""
        try:
            answer: dict[str, Any] = list(call([self.socket], {"verb": "status"}))[-1]["status"]
        except ApiError as error:
            return {"mode": "absent", "phase": "none", "interlocks": [str(error)]}
        return answer

    def until_ready(self, limit: float = 40.0) -> None:
        """Wait until an experiment may start."""
        status: dict[str, Any] = {}
        for _ in range(int(limit / 0.5)):
            status = self.status()
            if status["mode"] == "disarmed" and not status["interlocks"]:
                return
            time.sleep(0.5)
        raise AssertionError(f"not ready after {limit} s: {status}")

    def until_said(self, words: str, limit: float = 40.0) -> None:
        """Wait until the status gives a reason with these words."""
        said = ""
        for _ in range(int(limit / 0.5)):
            said = " ".join(self.status()["interlocks"])
            if words in said:
                return
            time.sleep(0.5)
        raise AssertionError(f"{words!r} not said within {limit} s, but {said!r}")

    def until_phase(self, phase: str, limit: float = 40.0) -> None:
        for _ in range(int(limit / 0.3)):
            if self.status()["phase"] == phase:
                return
            time.sleep(0.3)
        raise AssertionError(f"phase {phase} not reached within {limit} s: {self.status()}")

    @contextmanager
    def experiment(self, name: str) -> Iterator[subprocess.Popen[bytes]]:
        """An experiment in the background."""
        with subprocess.Popen(
            [*UPRIGHT, "experiment", name, "--json", "--socket", str(self.socket)],
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
        ) as process:
            yield process


@contextmanager
def rig(
    folder: Path, *simulate: str, bus: tuple[str, ...] = ("--bus", "socketcan:vcan0"), ready: bool = True
) -> Iterator[Rig]:
    log = (folder / "daemon.log").open("wb")
    vehicle = subprocess.Popen([*FIRST, *UPRIGHT, "simulate", "monocab", *bus, *simulate], stderr=log)
    socket = folder / "s.sock"
    daemon = subprocess.Popen(
        [*SECOND, *UPRIGHT, "serve", "monocab", *bus, "--data", str(folder), "--socket", str(socket)], stderr=log
    )
    made = Rig(vehicle, daemon, folder, socket)
    try:
        if ready:
            made.until_ready()
        yield made
    finally:
        for process in (daemon, vehicle):
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(40)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        log.close()
        sys.stderr.write((folder / "daemon.log").read_text())


@pytest.fixture(scope="class")
def shared_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with rig(tmp_path_factory.mktemp("hil")) as made:
        yield made


class TestOnOneRig:
    """One vehicle and one daemon for all of these, as on a day at the track."""

    @pytest.mark.parametrize("name", list(VEHICLE.experiments))
    def test_each_experiment_ends_well_and_is_recorded(self, shared_rig: Rig, name: str) -> None:
        shared_rig.until_ready()
        code, answer = shared_rig.ask("experiment", name)
        assert code == 0, answer
        recording = load_recording(Path(answer["recording"]))
        assert recording.duration > VEHICLE.experiments[name].duration * 0.9
        assert recording.rate == pytest.approx(250, rel=0.01)
        assert (recording.timestamp_ns[1:] - recording.timestamp_ns[:-1]).max() < 40_000_000
        if name in ("sweep", "multisine"):
            found = answer["estimates"]["recursive_least_squares"]["parameters"]
            for parameter, true in (("inertia", 1650.0), ("gravity_stiffness", 14500.0)):
                assert found[parameter]["value"] == pytest.approx(true, rel=0.01)
                assert abs(found[parameter]["value"] - true) < 1.96 * found[parameter]["std"]

    def test_the_raw_log_gives_the_same_estimates_bit_for_bit(self, shared_rig: Rig) -> None:
        shared_rig.until_ready()
        code, answer = shared_rig.ask("experiment", "step")
        assert code == 0, answer
        for parameter, true in (("inertia", 1650.0), ("gravity_stiffness", 14500.0)):
            found = answer["estimates"]["recursive_least_squares"]["parameters"][parameter]
            assert found["value"] == pytest.approx(true, rel=0.03)
        done = subprocess.run(
            [*UPRIGHT, "replay", answer["recording"], answer["raw_log"], "--json"], capture_output=True, check=True
        )
        assert answer["rows"] == len(load_recording(Path(answer["recording"])))
        assert shared_rig.status()["observer"]["frames_dropped"] == 0
        results = json.loads(done.stdout)["recordings"]
        from_arrow, from_log = results[answer["recording"]], results[answer["raw_log"]]
        assert from_arrow == from_log
        for method, estimate in answer["estimates"].items():
            assert from_arrow[method]["parameters"] == estimate["parameters"]

    def test_a_second_experiment_is_refused_while_one_runs_and_stop_ends_it(self, shared_rig: Rig) -> None:
        shared_rig.until_ready()
        with shared_rig.experiment("hold") as running:
            shared_rig.until_phase("excite")
            code, answer = shared_rig.ask("experiment", "step")
            assert code == 3
            assert "is running" in answer["text"]
            code, _ = shared_rig.ask("stop")
            assert code == 0
            assert running.wait(30) == 0
        shared_rig.until_ready()

    def test_an_unknown_experiment_is_a_usage_error(self, shared_rig: Rig) -> None:
        code, answer = shared_rig.ask("experiment", "salto")
        assert code == 2
        assert "multisine" in answer["text"]


def test_the_drives_stop_by_themselves_when_the_master_is_killed(tmp_path: Path) -> None:
    with rig(tmp_path) as made:
        with made.experiment("hold") as running:
            made.until_phase("excite")
            os.kill(made.daemon.pid, signal.SIGKILL)
            running.wait(30)
        time.sleep(3.0)
        raw_logs = list(tmp_path.glob("*.log"))
        frames = [frame for path in raw_logs if path.name != "daemon.log" for frame in CandumpReader(path)]
        last_setpoint = max(frame.timestamp_ns for frame in frames if frame.can_id == 0x201)
        after = [frame for frame in frames if frame.timestamp_ns > last_setpoint]
        for node in (1, 2, 3):
            emergencies = [frame for frame in after if frame.can_id == 0x080 + node]
            assert emergencies, f"node {node} says nothing"
            assert emergencies[0].data[:2] in (b"\x30\x81", b"\x50\x82"), "heartbeat lost, or setpoints lost"
            assert emergencies[0].timestamp_ns - last_setpoint < 250_000_000


def test_a_fault_stops_the_vehicle_and_reset_makes_it_ready_again(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "drive_fault:gimbal_left@30") as made:
        code, answer = made.ask("experiment", "sweep")
        assert code == 4, answer
        assert answer["code"] == "drive_emergency"
        assert "gimbal_left" in answer["text"]
        assert made.ask("experiment", "hold")[0] == 3
        time.sleep(3.0)
        assert made.ask("reset")[0] == 0
        made.until_ready()


def test_a_silent_imu_is_noticed(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "imu_silent@25") as made:
        code, answer = made.ask("experiment", "sweep")
        assert code == 4, answer
        assert answer["code"] == "imu_silent"
        assert "No IMU frames" in " ".join(made.status()["interlocks"]) or made.status()["mode"] == "fault"


def test_the_bus_going_down_is_a_fault_and_it_comes_back(tmp_path: Path) -> None:
    with rig(tmp_path) as made:
        with made.experiment("hold") as running:
            made.until_phase("excite")
            subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
            try:
                assert running.wait(10) == 4
                assert made.status()["code"] == "bus_down"
            finally:
                subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
        time.sleep(3.0)
        assert made.ask("reset")[0] == 0
        made.until_ready()


def test_drives_and_imu_on_two_buses(tmp_path: Path) -> None:
    two = ("--bus", "drives=socketcan:vcan0", "--bus", "imu=socketcan:vcan1")
    with rig(tmp_path, bus=two) as made:
        code, answer = made.ask("experiment", "step")
        assert code == 0, answer
        done = subprocess.run(
            [*UPRIGHT, "replay", answer["recording"], answer["raw_log"], "--json"], capture_output=True, check=True
        )
        results = json.loads(done.stdout)["recordings"]
        assert results[answer["recording"]] == results[answer["raw_log"]]


def test_an_imu_with_another_format_is_told_with_the_key_to_change(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "imu_wrong_format@0", ready=False) as made:
        made.until_said("imu.precision")
        assert made.ask("experiment", "hold")[0] == 3


def test_a_missing_drive_is_told_with_its_node(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "drive_silent:trim@0", ready=False) as made:
        made.until_said("node 3")
        assert made.ask("experiment", "hold")[0] == 3
