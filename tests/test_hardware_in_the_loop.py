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
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from service.api import ApiError, call
from service.online_estimators import online_estimators
from service.vehicle_file import load
from telemetry.candump import CandumpReader
from telemetry.recording import load as load_recording

pytestmark = [pytest.mark.vcan, pytest.mark.timeout(300)]

UPRIGHT = [sys.executable, "-c", "from service.cli import main; main()"]
VEHICLE = load("monocab")

FIRST, SECOND = (["chrt", "--reset-on-fork", "--fifo", priority] for priority in ("20", "10"))
"""Real-time priorities, as systemd/upright.service.d/realtime.conf gives the daemon: the guest has one processor for
everything. The vehicle comes first, since a real one waits for nobody."""


HEARTBEAT_TIMEOUT = 0.6


def patient(text: str) -> str:
    """The shipped vehicle file for a machine that is itself not real-time.

    A virtual machine shares its processor with others: a bare loop with 4 ms to sleep was seen held up for 76 ms on
    such a host, and for 7 ms every few seconds in the guest; with other work on the host a set of IMU frames was seen
    114 ms late. The shipped limit of 12 ms would stop a run then, rightly.
    """
    for key, shipped, here in (("missed_cycles", "3 ", "50 "), ("heartbeat_timeout", "0.12", str(HEARTBEAT_TIMEOUT))):
        assert f"{key} = {shipped}" in text
        text = text.replace(f"{key} = {shipped}", f"{key} = {here}")
    return text


@dataclass
class Rig:
    """A virtual vehicle and its daemon."""

    vehicle: subprocess.Popen[bytes]
    daemon: subprocess.Popen[bytes]
    data: Path
    socket: Path

    def ask(self, verb: str, **arguments: Any) -> tuple[int, dict[str, Any]]:
        """Exit code and result of a request, as the command line makes it.

        Without starting a process for it: that would hold up the guest, which has one processor, for many cycles.
        """
        answer = list(call([self.socket], {"verb": verb, **arguments}, timeout=200.0))[-1]
        return answer["exit_code"], answer

    def status(self) -> dict[str, Any]:
        try:
            found: dict[str, Any] = self.ask("status")[1]["status"]
        except ApiError as error:
            return {"mode": "absent", "phase": "none", "code": "", "interlocks": [str(error)]}
        return found

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
        status: dict[str, Any] = {}
        for _ in range(int(limit / 0.3)):
            status = self.status()
            if status["phase"] == phase:
                return
            assert status["mode"] != "fault", f"phase {phase} not reached: {status['reason']}"
            time.sleep(0.3)
        raise AssertionError(f"phase {phase} not reached within {limit} s: {status}")

    @contextmanager
    def experiment(self, name: str) -> Iterator[Future[tuple[int, dict[str, Any]]]]:
        """An experiment in the background; its exit code and result to come, ApiError where the daemon went away."""
        with ThreadPoolExecutor(1) as pool:
            yield pool.submit(self.ask, "experiment", name=name)


@contextmanager
def rig(
    folder: Path, *simulate: str, bus: tuple[str, ...] = ("--bus", "socketcan:vcan0"), ready: bool = True
) -> Iterator[Rig]:
    log = (folder / "daemon.log").open("wb")
    file = folder / "patient.toml"
    file.write_text(patient(Path(VEHICLE.path).read_text()))
    vehicle = subprocess.Popen([*FIRST, *UPRIGHT, "simulate", str(file), *bus, *simulate], stderr=log)
    socket = folder / "s.sock"
    daemon = subprocess.Popen(
        [*SECOND, *UPRIGHT, "serve", str(file), *bus, "--data", str(folder), "--socket", str(socket)], stderr=log
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


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """The live estimator's model is in the cache: on the guest's one processor, compiling it takes a minute."""
    values, deviations = VEHICLE.parameters.values, VEHICLE.parameters.deviations
    online_estimators(VEHICLE.vehicle.kind, values, deviations, VEHICLE.support).join()


@pytest.fixture(scope="class")
def shared_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with rig(tmp_path_factory.mktemp("hil")) as made:
        yield made


class TestOnOneRig:
    """One vehicle and one daemon for all of these, as on a day at the track."""

    @pytest.mark.parametrize("name", list(VEHICLE.experiments))
    def test_each_experiment_ends_well_and_is_recorded(self, shared_rig: Rig, name: str) -> None:
        shared_rig.until_ready()
        code, answer = shared_rig.ask("experiment", name=name)
        assert code == 0, answer
        recording = load_recording(Path(answer["recording"]))
        assert recording.duration > VEHICLE.experiments[name].duration * 0.9
        assert recording.rate == pytest.approx(250, rel=0.01)
        if name in ("sweep", "multisine"):
            found = answer["estimates"]["recursive_least_squares"]["parameters"]
            for parameter, true in (("inertia", 1650.0), ("gravity_stiffness", 14500.0)):
                assert found[parameter]["value"] == pytest.approx(true, rel=0.01)
                assert abs(found[parameter]["value"] - true) < 1.96 * found[parameter]["std"]

    def test_the_raw_log_gives_the_same_estimates_bit_for_bit(self, shared_rig: Rig) -> None:
        shared_rig.until_ready()
        code, answer = shared_rig.ask("experiment", name="step")
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
            code, answer = shared_rig.ask("experiment", name="step")
            assert code == 3
            assert "is running" in answer["text"]
            code, _ = shared_rig.ask("stop")
            assert code == 0
            assert running.result(30)[0] == 0
        shared_rig.until_ready()

    def test_the_command_line_tells_the_same(self, shared_rig: Rig) -> None:
        to_rig = ["--socket", str(shared_rig.socket), "--json"]
        done = subprocess.run([*UPRIGHT, "experiment", "salto", *to_rig], capture_output=True, check=False)
        assert done.returncode == 2
        assert "multisine" in json.loads(done.stdout)["text"]
        done = subprocess.run([*UPRIGHT, "status", *to_rig], capture_output=True, check=True)
        assert json.loads(done.stdout)["vehicle"] == "monocab"


def test_the_drives_stop_by_themselves_when_the_master_is_killed(tmp_path: Path) -> None:
    with rig(tmp_path) as made:
        with made.experiment("hold") as running:
            made.until_phase("excite")
            os.kill(made.daemon.pid, signal.SIGKILL)
            with pytest.raises(ApiError):
                running.result(30)
        time.sleep(3.0)
        raw_logs = list(tmp_path.glob("*.log"))
        frames = [frame for path in raw_logs if path.name != "daemon.log" for frame in CandumpReader(path)]
        last_setpoint = max(frame.timestamp_ns for frame in frames if frame.can_id == 0x201)
        after = [frame for frame in frames if frame.timestamp_ns > last_setpoint]
        for node in (1, 2, 3):
            emergencies = [frame for frame in after if frame.can_id == 0x080 + node]
            assert emergencies, f"node {node} says nothing"
            assert emergencies[0].data[:2] in (b"\x30\x81", b"\x50\x82"), "heartbeat lost, or setpoints lost"
            assert (emergencies[0].timestamp_ns - last_setpoint) * 1e-9 < HEARTBEAT_TIMEOUT + 0.15


def test_a_fault_stops_the_vehicle_and_reset_makes_it_ready_again(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "drive_fault:gimbal_left@30") as made:
        code, answer = made.ask("experiment", name="sweep")
        assert code == 4, answer
        assert answer["code"] == "drive_emergency"
        assert "gimbal_left" in answer["text"]
        assert made.ask("experiment", name="hold")[0] == 3
        time.sleep(3.0)
        assert made.ask("reset")[0] == 0
        made.until_ready()


def test_a_silent_imu_is_noticed(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "imu_silent@25") as made:
        code, answer = made.ask("experiment", name="sweep")
        assert code == 4, answer
        assert answer["code"] == "imu_silent"
        assert "No IMU frames" in " ".join(made.status()["interlocks"]) or made.status()["mode"] == "fault"


def test_the_bus_going_down_is_a_fault_and_it_comes_back(tmp_path: Path) -> None:
    with rig(tmp_path) as made:
        with made.experiment("hold") as running:
            made.until_phase("excite")
            subprocess.run(["ip", "link", "set", "vcan0", "down"], check=True)
            try:
                assert running.result(10)[0] == 4
                assert made.status()["code"] == "bus_down"
            finally:
                subprocess.run(["ip", "link", "set", "vcan0", "up"], check=True)
        time.sleep(3.0)
        assert made.ask("reset")[0] == 0
        made.until_ready()


def test_drives_and_imu_on_two_buses(tmp_path: Path) -> None:
    two = ("--bus", "drives=socketcan:vcan0", "--bus", "imu=socketcan:vcan1")
    with rig(tmp_path, bus=two) as made:
        code, answer = made.ask("experiment", name="step")
        assert code == 0, answer
        done = subprocess.run(
            [*UPRIGHT, "replay", answer["recording"], answer["raw_log"], "--json"], capture_output=True, check=True
        )
        results = json.loads(done.stdout)["recordings"]
        assert results[answer["recording"]] == results[answer["raw_log"]]


def test_an_imu_with_another_format_is_told_with_the_key_to_change(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "imu_wrong_format@0", ready=False) as made:
        made.until_said("imu.precision")
        assert made.ask("experiment", name="hold")[0] == 3


def test_a_missing_drive_is_told_with_its_node(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "drive_silent:trim@0", ready=False) as made:
        made.until_said("node 3")
        assert made.ask("experiment", name="hold")[0] == 3
