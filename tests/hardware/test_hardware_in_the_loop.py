"""The complete system without the hardware: daemon and virtual vehicle as two processes on SocketCAN, in real time.

Enable, balance, each excitation, stop; the master killed; the bus going down and coming back; two buses.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rig as shared
from monocab_channels import MONOCAB as CHANNELS
from numpy.typing import NDArray
from rig import HEARTBEAT_TIMEOUT, UPRIGHT, Rig

from upright.service.control.clients.api import ApiError
from upright.service.observer.live.online_estimators import estimators_of
from upright.service.offline.inputs import replay
from upright.telemetry.candump import CandumpReader
from upright.telemetry.storage import load as load_recording
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import load

ON_THE_BUS = CHANNELS.names[: CHANNELS.index_of("drive_age") + 1]
SETPOINTS = {"precession_rate_setpoint", "trim_rate_setpoint"}

pytestmark = [pytest.mark.vcan, pytest.mark.timeout(300)]

VEHICLE = load("monocab")
DURATIONS = {
    "hold": 8.0,
    "sweep": 30.0,
    "output_sweep": 20.0,
    "square": 10.0,
    "sine_stream": 20.0,
    "side_load": 22.0,
}
"""s, shorter durations for the experiments that are longer than is needed to show that they run in real time."""
OF_COMMISSIONING = {"rest", "tilt", "silence", "drives", "trim", "full_sweep"}
"""test_commission_vcan runs these."""


@contextmanager
def rig(folder: Path, *simulate: str, **options: Any) -> Iterator[Rig]:
    """The shipped vehicle with its long experiments shortened."""
    text = Path(VEHICLE.path).read_text()
    for name, duration in DURATIONS.items():
        before, section = text.split(f"[experiments.{name}]")
        shipped = f"duration = {VEHICLE.experiments[name].duration}"
        assert shipped in section.split("[experiments")[0]
        text = f"{before}[experiments.{name}]{section.replace(shipped, f'duration = {duration}', 1)}"
    with shared.rig(folder, text, *simulate, **options) as made:
        yield made


@pytest.fixture(scope="module", autouse=True)
def compiled() -> None:
    """Compiles the live estimator's model into the cache: on the guest's one processor that takes a minute."""
    estimators_of(VEHICLE).join()


@pytest.fixture(scope="class")
def class_rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Rig]:
    with rig(tmp_path_factory.mktemp("hil")) as made:
        yield made


@pytest.fixture
def shared_rig(class_rig: Rig) -> Rig:
    """A rig that is ready, whatever the result of the previous test."""
    if class_rig.status()["mode"] == "fault":
        class_rig.ask("reset")
    class_rig.until_ready()
    return class_rig


def in_order(setpoints: NDArray[np.float64]) -> NDArray[np.float64]:
    """The setpoints (n,) without those that are the same as the one before, (m,)."""
    return setpoints[np.diff(setpoints, prepend=np.nan) != 0.0]


def assert_rebuilt(answer: dict[str, Any]) -> dict[str, Any]:
    """The raw log has the rows of the recording and leads to the same estimates, bit for bit; these, by method.

    Which sample a set of setpoints answers is in no frame (service/control/cycle/rows.py): if the guest was held up for
    several cycles, the rows of the log may take up a set some samples late, and the instruments with it.
    """
    live, rebuilt = (replay.load(Path(answer[key]), load("monocab")) for key in ("recording", "raw_log"))
    np.testing.assert_array_equal(rebuilt.timestamp_ns, live.timestamp_ns)
    off = {name for name in ON_THE_BUS if not np.array_equal(rebuilt[name], live[name])}
    assert off <= SETPOINTS
    for name in SETPOINTS:
        np.testing.assert_array_equal(in_order(rebuilt[name]), in_order(live[name]))
    done = subprocess.run(
        [*UPRIGHT, "replay", answer["recording"], answer["raw_log"], "--json"], capture_output=True, check=True
    )
    results = json.loads(done.stdout)["recordings"]
    from_recording, from_log = results[answer["recording"]], results[answer["raw_log"]]
    using = {"recursive_instrumental_variables"} if off else set[str]()
    assert {name: from_recording[name] for name in from_recording.keys() - using} == {
        name: from_log[name] for name in from_log.keys() - using
    }
    return from_recording


class TestOnOneRig:
    """One vehicle and one daemon for all of these tests."""

    @pytest.mark.parametrize("name", [name for name in VEHICLE.experiments if name not in OF_COMMISSIONING])
    def test_each_experiment_succeeds_and_is_recorded(self, shared_rig: Rig, name: str) -> None:
        code, answer = shared_rig.ask("experiment", name=name)
        assert code == 0, answer
        recording = load_recording(Path(answer["recording"]))
        assert recording.duration > DURATIONS.get(name, VEHICLE.experiments[name].duration) * 0.9
        assert recording.rate == pytest.approx(250, rel=0.01)
        if name == "side_load":  # the person beside the virtual vehicle hears of it over the control socket
            assert recording["trim_position"][recording["phase"] == Phase.EXCITE][-1] == pytest.approx(-0.112, rel=0.1)
        if name in ("sweep", "multisine"):
            found = answer["estimates"]["recursive_least_squares"]["parameters"]
            for parameter, true in (("inertia", 1650.0), ("gravity_stiffness", 14500.0)):
                assert found[parameter]["value"] == pytest.approx(true, rel=0.01)
                assert abs(found[parameter]["value"] - true) < 1.96 * found[parameter]["std"]

    def test_raw_log_gives_the_same_estimates_bit_for_bit(self, shared_rig: Rig) -> None:
        code, answer = shared_rig.ask("experiment", name="step")
        assert code == 0, answer
        for parameter, true in (("inertia", 1650.0), ("gravity_stiffness", 14500.0)):
            found = answer["estimates"]["recursive_least_squares"]["parameters"][parameter]
            assert found["value"] == pytest.approx(true, rel=0.03)
        assert answer["rows"] == len(load_recording(Path(answer["recording"])))
        assert shared_rig.status()["observer"]["frames_dropped"] == 0
        replayed = assert_rebuilt(answer)
        for method, estimate in answer["estimates"].items():
            assert replayed[method]["parameters"] == estimate["parameters"]

    def test_a_second_experiment_is_refused_while_one_runs_and_stop_ends_it(self, shared_rig: Rig) -> None:
        with shared_rig.experiment("hold") as running:
            shared_rig.until_phase("excite")
            code, answer = shared_rig.ask("experiment", name="step")
            assert code == 3
            assert "is running" in answer["text"]
            code, _ = shared_rig.ask("stop")
            assert code == 0
            assert running.result(30)[0] == 0
        shared_rig.until_ready()

    def test_command_line_refuses_an_unknown_experiment_and_reports_the_status(self, shared_rig: Rig) -> None:
        to_rig = ["--socket", str(shared_rig.socket), "--json"]
        done = subprocess.run([*UPRIGHT, "experiment", "salto", *to_rig], capture_output=True, check=False)
        assert done.returncode == 2
        assert "multisine" in json.loads(done.stdout)["text"]
        done = subprocess.run([*UPRIGHT, "status", *to_rig], capture_output=True, check=True)
        assert json.loads(done.stdout)["vehicle"] == "monocab"


def test_drives_report_lost_heartbeat_or_setpoints_when_the_master_is_killed(tmp_path: Path) -> None:
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


def test_silent_imu_stops_the_experiment(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "imu_silent@25") as made:
        code, answer = made.ask("experiment", name="sweep")
        assert code == 4, answer
        assert answer["code"] == "imu_silent"
        assert "No IMU frames" in " ".join(made.status()["interlocks"]) or made.status()["mode"] == "fault"


def test_bus_going_down_is_a_fault_from_which_reset_recovers(tmp_path: Path) -> None:
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


def test_experiment_and_replay_work_with_drives_and_imu_on_two_buses(tmp_path: Path) -> None:
    two = ("--bus", "drives=socketcan:vcan0", "--bus", "imu=socketcan:vcan1")
    with rig(tmp_path, bus=two) as made:
        code, answer = made.ask("experiment", name="step")
        assert code == 0, answer
        assert_rebuilt(answer)


def test_imu_with_another_format_is_reported_with_the_key_to_change(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "imu_wrong_format@0", ready=False) as made:
        made.until_said("imu.precision")
        assert made.ask("experiment", name="hold")[0] == 3


def test_missing_drive_is_reported_with_its_node(tmp_path: Path) -> None:
    with rig(tmp_path, "--fault", "drive_silent:trim@0", ready=False) as made:
        made.until_said("node 3")
        assert made.ask("experiment", name="hold")[0] == 3
