"""The balancing robot on the daemon's code: its vehicle file, its controller, its runs, and every way they can end.

Code shared with the MONOCAB is tested there; the tests here show that the same loop also drives this vehicle.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from closed_loop import ClosedLoop
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.drivers.cia402.config import DriveConfig
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import State
from upright.models.gravity import GRAVITY
from upright.service.cli import app
from upright.service.control import assembly
from upright.service.control.clients import api
from upright.service.control.cycle.operation import Mode
from upright.service.control.cycle.rows import rows_from_frames
from upright.service.control.cycle.safety import Observation, Safety
from upright.service.control.daemon import Daemon, Places
from upright.service.observer.live.online_estimators import estimators_of
from upright.service.offline.inputs import replay
from upright.service.virtual import vehicle as virtual_vehicle
from upright.service.virtual.run import VirtualRunError, record
from upright.simulation.registry import UnknownEffectError
from upright.simulation.twsbr.plant import TwsbrPlant
from upright.telemetry.samples import CanFrame
from upright.telemetry.storage import load as load_recording
from upright.vehicles import registry
from upright.vehicles.bounds import OK, Code, Reaction
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFileError, load
from upright.vehicles.registry import recorded_loop
from upright.vehicles.twsbr.axes import WheelMeasurement
from upright.vehicles.twsbr.channels import CHANNELS as TWSBR
from upright.vehicles.twsbr.controller import TiltController, WheelReturn
from upright.vehicles.twsbr.handling import UPRIGHT
from upright.vehicles.twsbr.kind import TwsbrCode, bounds
from upright.vehicles.twsbr.model import TWSBR as MODEL

VEHICLE = load("twsbr")
FILE = Path(VEHICLE.path).read_text()
DT = VEHICLE.period
PHASE, TILT = TWSBR.index_of("phase"), TWSBR.index_of("tilt")
UP = (Phase.SETTLE, Phase.EXCITE, Phase.FADE)
SHORT = 4.0
"""Duration of the excitation, s, for tests that do not depend on it."""


# --- vehicle file


def test_cad_values_equal_those_of_the_models_table() -> None:
    """The paper's Table 1 and a quarter of Table 2's range, written down twice: here and in vehicles.twsbr.model."""
    values, deviations = VEHICLE.parameters.values, VEHICLE.parameters.deviations
    table = {each.name: each for each in MODEL.base_parameters if each.name in values}
    assert len(table) == len(values) == 14
    for name, value in values.items():
        assert value == pytest.approx(table[name].value, rel=1e-12)
        assert deviations[name] == pytest.approx(table[name].std, rel=1e-9)
        assert VEHICLE.parameters.UNITS[name] == table[name].unit


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('role = "wheel"', 'role = "gimbal"', "a twsbr has 2"),
        ('at = "controller_output"', 'at = "roll_reference"', "tilt_reference, controller_output"),
        ("upright_deg = 8.0 ", "upright_deg = 13.0 ", "must be below support_deg"),
        ("travel_budget = 2.0", "travel_budget = 3.0", "must be below travel"),
        ("proportional_gain = 25.0", "roll_weight = 25.0", "is missing"),
        ('unit = "ohm"', 'unit = "kohm"', "give it in 'ohm'"),
        ('kind = "twsbr"', 'kind = "unicycle"', "there is no kind of vehicle 'unicycle'.*monocab, twsbr"),
    ],
)
def test_error_in_the_vehicle_file_is_named(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in FILE
    path = tmp_path / "mine.toml"
    path.write_text(FILE.replace(old, new, 1))
    with pytest.raises(VehicleFileError, match=said):
        load(str(path))


def test_config_check_reports_controller_experiments_and_bus_load() -> None:
    answer = CliRunner().invoke(app, ["config", "check", "twsbr", "--json"])
    assert answer.exit_code == 0, answer.output
    document = json.loads(answer.stdout)
    assert document["controller"]["proportional_gain"] == 25.0
    assert set(document["experiments"]) == set(VEHICLE.experiments)
    assert 5.0 < document["bus_load_percent"]["socketcan:can0"] < 50.0


# --- drive in voltage mode


def wheel(direction: int = 1) -> DriveConfig:
    """A wheel drive with steps of a millivolt, the resolution of its object, not that of the bridge."""
    return replace(assembly.drive_config(VEHICLE, VEHICLE.drive[0]), direction=direction, setpoint_resolution=0.0)


@pytest.mark.parametrize("direction", [1, -1])
@given(volts=st.floats(-40.0, 40.0))
def test_voltage_is_sent_in_millivolts_and_read_back_bit_for_bit(direction: int, volts: float) -> None:
    drive, reader = Drive(wheel(direction)), Drive(wheel(direction))
    drive.handle(CanFrame(1, 0x181, (0x0237).to_bytes(2, "little") + bytes(4)))
    ((cob_id, data),) = drive.command(State.OPERATION_ENABLED, volts)
    assert cob_id == 0x201
    assert data[:2] == b"\x0f\x00", "no ramp bits: they are of velocity mode"
    sent = int.from_bytes(data[2:], "little", signed=True)
    assert sent == pytest.approx(direction * max(-32.768, min(32.767, volts)) * 1000.0, abs=1.001)
    reader.handle(CanFrame(2, cob_id, data))
    assert reader.setpoint == drive.setpoint == pytest.approx(direction * sent * 1e-3)


# --- controller


def pid(limit: float = 1e3, return_time: float = 0.0) -> TiltController:
    return TiltController(25.0, 3.0, 3.5, limit=limit, wheel_return=WheelReturn(return_time, math.radians(2.0)))


def test_gains_are_in_volts_per_degree() -> None:
    deg = math.radians(1.0)
    assert pid().step(deg, 0.0, 0.0, 0.0, 0.0, DT) == pytest.approx(25.0 + 3.0 * DT)
    assert pid().step(0.0, deg, 0.0, 0.0, 0.0, DT) == pytest.approx(3.5)
    assert pid().step(0.0, 0.0, 0.0, 0.0, 0.0, DT, 8.0) == pytest.approx(8.0)
    assert pid().step(0.0, 0.0, 0.0, 0.0, deg, DT) < 0.0
    integrating = pid()
    for _ in range(200):
        volts = integrating.step(0.1 * deg, 0.0, 0.0, 0.0, 0.0, DT)
    assert volts == pytest.approx(2.5 + 0.3)


@given(st.lists(st.tuples(*[st.floats(-10.0, 10.0)] * 6), min_size=1, max_size=50))
def test_voltage_never_exceeds_the_supply_for_any_input(rows: list[tuple[float, ...]]) -> None:
    subject = pid(12.0, 1.5)
    for tilt, rate, place, speed, reference, excitation in rows:
        assert abs(subject.step(tilt, rate, place, speed, reference, DT, excitation)) <= 12.0


def test_integral_does_not_wind_up_while_getting_up() -> None:
    """After 5 s at the limit with an error of 12 deg, the voltage is zero at once when the robot is upright."""
    subject = pid(12.0)
    for _ in range(1000):
        assert subject.step(math.radians(12.0), 0.0, 0.0, 0.0, 0.0, DT) == 12.0
    assert subject.limited
    assert subject.step(0.0, 0.0, 0.0, 0.0, 0.0, DT) == 0.0


def test_wheels_return_with_the_configured_time_constant() -> None:
    """If the tilt follows the lean at once: place'' = g lean, a double pole at -1/T, from rest 0.1 m off.

    place = 0.1 (1 + t/T) exp(-t/T); a step of 1 ms leaves an error of some thousandths of that.
    """
    outer, place, speed, time = WheelReturn(1.5, 1.0), 0.1, 0.0, 0.0
    for _ in range(6000):
        speed += GRAVITY * outer.lean(place, speed) * 1e-3
        place += speed * 1e-3
        time += 1e-3
        assert place == pytest.approx(0.1 * (1.0 + time / 1.5) * math.exp(-time / 1.5), abs=5e-4)
    assert WheelReturn(0.0, 1.0).lean(3.0, 2.0) == 0.0
    assert WheelReturn(1.5, 0.03).lean(-9.0, 0.0) == 0.03


# --- safety


def balancing(**axes: float) -> Observation:
    still = {"left_angle": 0.0, "right_angle": 0.0, "left_rate": 0.0, "right_rate": 0.0, "travel": 0.0}
    return Observation(
        armed=True, balancing=True, upright=True, imu_age=DT, angle=0.01, axes=WheelMeasurement(1, **{**still, **axes})
    )


@pytest.mark.parametrize(
    ("seen", "code", "reaction"),
    [
        (balancing(), Code.OK, Reaction.CONTINUE),
        (balancing(left_rate=46.0), TwsbrCode.WHEEL_RATE, Reaction.STOP_NOW),
        (balancing(right_rate=-46.0), TwsbrCode.WHEEL_RATE, Reaction.STOP_NOW),
        (balancing(left_rate=math.nan), Code.NOT_FINITE, Reaction.STOP_NOW),
        (balancing(travel=-2.1), TwsbrCode.TRAVEL_BUDGET, Reaction.END_EXPERIMENT),
        (balancing(travel=2.6), TwsbrCode.TRAVEL, Reaction.STOP_NOW),
        (balancing(heading=-0.36), TwsbrCode.HEADING, Reaction.END_EXPERIMENT),
        (replace(balancing(), angle=math.radians(8.1)), TwsbrCode.FALLEN, Reaction.STOP_NOW),
        (replace(balancing(), angle=math.radians(12.1), upright=False), Code.OK, Reaction.CONTINUE),
        (replace(balancing(), angle=math.radians(16.1), armed=False), TwsbrCode.TILT, Reaction.STOP_NOW),
        (replace(balancing(), rate=math.radians(301.0)), TwsbrCode.TILT_RATE, Reaction.STOP_NOW),
        (replace(balancing(), setpoint=12.01), TwsbrCode.SETPOINT, Reaction.STOP_NOW),
        (replace(balancing(), setpoint=math.nan), Code.NOT_FINITE, Reaction.STOP_NOW),
        (replace(balancing(), imu_age=0.018), Code.IMU_SILENT, Reaction.STOP_NOW),
    ],
)
def test_every_limit_of_the_vehicle_file_is_monitored(seen: Observation, code: Code, reaction: Reaction) -> None:
    safety = Safety(bounds(VEHICLE), missed_cycles=3, period=DT)
    verdict = safety.judge(seen)
    assert (verdict.code, verdict.reaction) == (code, reaction)
    assert (verdict is OK) == (code is Code.OK)


# --- runs


def true_tilt(closed: ClosedLoop) -> float:
    plant = closed.plant_side.plant
    assert isinstance(plant, TwsbrPlant)
    return plant.tilt


def assert_lies_disarmed(closed: ClosedLoop) -> None:
    closed.advance(1.0)
    assert closed.loop.io.state is State.SWITCH_ON_DISABLED
    assert closed.loop.lean is not None
    assert abs(closed.loop.lean.angle) == pytest.approx(VEHICLE.support, abs=math.radians(0.3))
    assert abs(closed.loop.lean.rate) < 0.01


@pytest.mark.parametrize("name", [name for name, each in VEHICLE.experiments.items() if each.gets_up])
def test_robot_balances_in_every_experiment_from_its_bumper_and_back(name: str) -> None:
    """Estimated and true tilt stay within 3 deg in every cycle from upright to the order to get down."""
    closed, worst = ClosedLoop(VEHICLE), 0.0
    closed.loop.start_experiment(name)
    while closed.loop.mode is Mode.RUNNING:
        closed.advance(DT)
        if closed.loop.run is not None and closed.loop.run.phase in UP:
            worst = max(worst, abs(true_tilt(closed)))
    assert closed.loop.mode is Mode.DISARMED
    assert closed.loop.reason == ""
    assert {Phase(int(frame.values[PHASE])) for frame in closed.witness.frames} >= set(Phase) - {Phase.NONE, Phase.MOVE}
    assert 0.0 < worst < math.radians(3.0)
    recording = closed.recording("here")
    up = np.isin(recording["phase"], UP)
    assert np.abs(recording["tilt"][up]).max() < math.radians(3.0)
    assert_lies_disarmed(closed)


def test_recording_has_the_robots_channels_and_does_not_name_a_hidden_effect() -> None:
    bare = record("twsbr", "square", duration=SHORT)
    hidden = record("twsbr", "square", hide=["input_gain"], duration=SHORT)
    assert bare.channels == TWSBR
    assert bare.rate == pytest.approx(200.0, rel=1e-6)
    assert all(np.isfinite(bare[name]).all() for name in TWSBR.names)
    assert (bare.metadata["kind"], bare.metadata["experiment"]) == ("twsbr", "square")
    assert json.loads(bare.metadata["parameters"]) == VEHICLE.parameters.values
    exciting = bare["phase"] == Phase.EXCITE
    assert np.abs(bare["excitation"][exciting]).max() == pytest.approx(8.0)
    assert not np.array_equal(bare["tilt"], hidden["tilt"])
    assert "input_gain" not in json.dumps(dict(hidden.metadata))
    again = record("twsbr", "square", duration=SHORT)
    assert all(again[name].tobytes() == bare[name].tobytes() for name in TWSBR.names)


def test_hidden_effect_of_another_vehicle_is_refused_with_a_list() -> None:
    with pytest.raises(UnknownEffectError, match="slope"):
        record("twsbr", "square", hide=["gimbal_imbalance"])


def test_robot_leans_against_a_constant_load() -> None:
    """10 mN m against a gravity stiffness of 345 mN m/rad (CAD): the body leans back by 0.0285 rad, the wheels stay."""
    recording = record("twsbr", "hold", hide=["static_torque"])
    last = np.flatnonzero(recording["phase"] == Phase.EXCITE)[-1000:]
    assert recording["tilt"][last].mean() == pytest.approx(-0.01 / (0.74 * 9.81 * 0.0475), rel=0.05)
    assert np.abs(recording["left_wheel_rate"][last]).mean() < 1.0


def test_without_wheel_return_the_load_uses_up_the_travel_and_the_run_ends_in_order() -> None:
    section = VEHICLE.controller.model_copy(update={"wheel_return_time": 0.0})
    with pytest.raises(VirtualRunError, match=r"travel budget used up: 2\.0 of 2 m") as caught:
        record(VEHICLE.model_copy(update={"controller": section}), "hold", hide=["static_torque"])
    assert caught.value.recording is not None
    assert {Phase.LOWER, Phase.DISABLE} <= {Phase(int(phase)) for phase in caught.value.recording["phase"]}


def test_tilt_reference_is_followed() -> None:
    """0.3 deg at 0.25 Hz: the body leans about as far as the reference, and the excitation is an angle."""
    wave = VEHICLE.experiments["sine"].model_copy(
        update={"at": "tilt_reference", "amplitude": None, "amplitude_deg": 0.3, "frequency": 0.25, "duration": 8.0}
    )
    vehicle = VEHICLE.model_copy(update={"experiments": {"sine": wave}})
    recording = record(vehicle, "sine")
    middle = np.flatnonzero(recording["phase"] == Phase.EXCITE)[400:1200]
    tilt, reference = recording["tilt"][middle], recording["tilt_reference"][middle]
    assert np.abs(recording["excitation"]).max() == pytest.approx(math.radians(0.3), rel=1e-3)
    assert np.corrcoef(tilt, reference)[0, 1] > 0.9
    assert np.ptp(tilt) == pytest.approx(np.ptp(reference), rel=0.5)


def test_measured_samples_are_rebuilt_bit_for_bit_from_raw_frames() -> None:
    closed = ClosedLoop(VEHICLE)
    closed.run("doublet")
    (_, start_ns), (_, end_ns) = closed.witness.recordings[0], closed.witness.ended[0]
    live = [frame for frame in closed.witness.frames if start_ns <= frame.timestamp_ns <= end_ns]
    raw = [frame for frame in closed.raw if start_ns <= frame.timestamp_ns]
    io = assembly.vehicle_io(VEHICLE)
    rows = rows_from_frames(raw, io, registry.kind_of(VEHICLE, io), assembly.roll_filter(VEHICLE), start_ns)
    measured = TWSBR.index_of("drive_age") + 1
    rebuilt = [(row.timestamp_ns, row.values[:measured]) for row in rows if row.timestamp_ns <= end_ns]
    assert len(live) > 4000
    assert rebuilt == [(frame.timestamp_ns, frame.values[:measured]) for frame in live]


# --- every way to end


def running(seconds: float, **options: object) -> ClosedLoop:
    closed = ClosedLoop(VEHICLE, **options)  # type: ignore[arg-type]
    closed.loop.start_experiment("hold")
    closed.advance(seconds)
    return closed


@pytest.mark.parametrize("after", [0.5, 4.3, 4.5, 6.0, 9.0])
def test_operator_request_ends_the_experiment_in_order_from_every_phase(after: float) -> None:
    closed = running(0.2 + after)
    closed.loop.end_experiment("an operator requested the end")
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 20.0)
    assert closed.loop.mode is Mode.DISARMED
    assert closed.loop.reason == "an operator requested the end"
    assert_lies_disarmed(closed)


def test_another_experiment_is_refused_while_one_runs() -> None:
    closed = running(8.0)
    assert closed.loop.interlocks() == ["experiment hold is running."]


def test_immediate_stop_disarms_the_robot_and_is_latched_until_reset() -> None:
    closed = running(8.0)
    closed.loop.stop_now("an operator requested an immediate stop")
    closed.advance(3.0)
    assert closed.loop.mode is Mode.FAULT
    assert "A fault is latched: an operator" in closed.loop.interlocks()[0]
    assert_lies_disarmed(closed)
    assert closed.loop.reset_fault() == ""
    closed.loop.set_up_done()
    closed.loop.look_after_drives()
    closed.advance(1.0)
    assert closed.loop.interlocks() == []


@pytest.mark.parametrize(
    ("fault", "code"),
    [
        ("imu_stuck@10", "imu_stuck"),
        ("imu_gap@10", "imu_silent"),
        ("drive_fault:left_wheel@10", "drive_emergency"),
        ("drive_silent:right_wheel@10", "drive_silent"),
        ("drive_restart:right_wheel@10", "drive_silent"),
    ],
)
def test_fault_stops_the_run_with_its_reason_and_the_robot_lies_on_its_support(fault: str, code: str) -> None:
    closed = running(0.0, faults=[fault])
    closed.until(lambda: closed.loop.mode is not Mode.RUNNING, 20.0)
    assert (closed.loop.mode, closed.loop.code) == (Mode.FAULT, code)
    assert len(closed.loop.reason) > 20
    closed.advance(4.0)
    assert all(drive.setpoint == 0.0 for drive in closed.loop.io.drives)
    assert closed.loop.io.state is not State.OPERATION_ENABLED
    assert abs(true_tilt(closed)) == pytest.approx(VEHICLE.support, abs=math.radians(0.3))
    assert closed.witness.ended, "the recording goes on for a moment, then ends"


def test_fault_is_latched_and_the_robot_lies_down_if_no_frames_reach_the_drives() -> None:
    closed = running(8.0)
    closed.late = True
    closed.advance(3.0)
    assert closed.loop.mode is Mode.FAULT
    assert abs(true_tilt(closed)) == pytest.approx(VEHICLE.support, abs=math.radians(0.3))


def test_robot_that_cannot_get_up_reports_it_and_stays_down() -> None:
    """A twentieth of the voltage arrives: not enough to lift the body off its bumper."""
    with pytest.raises(VirtualRunError, match=f"not upright within {UPRIGHT.timeout:g} s") as caught:
        record("twsbr", "hold", hide=["input_gain=11.9"])
    assert caught.value.recording is not None
    assert not np.isin(UP, caught.value.recording["phase"]).any()


def test_falling_robot_is_stopped_and_its_voltage_is_zero_afterwards() -> None:
    """0.3 N m more than it can bear starts while it stands: forty times the torque of gravity at 1 deg of tilt. It
    accelerates by 100 rad/s^2, which at the lever arm of the IMU may be taken for a contradiction just before."""
    with pytest.raises(VirtualRunError, match=r"tilt while balancing of|accelerometer and gyro contradict") as caught:
        record("twsbr", "hold", hide=["torque_step=90@12"])
    recording = caught.value.recording
    assert recording is not None
    assert (recording["left_voltage"][recording["phase"] == Phase.NONE] == 0.0).all()


# --- features that need a model of the vehicle


def test_live_estimators_are_the_recursions_with_a_diagnosis_beside_one() -> None:
    bank = estimators_of(VEHICLE)
    assert not bank.complete
    bank.join()
    assert bank.complete
    assert list(bank.results()) == ["recursive_output_error", "recursive_prediction_error"]
    document = bank.diagnosis()
    assert document is not None
    assert (document["verdict"], document["findings"]) == ("insufficient_data", [])


def test_control_loop_is_reconstructed_from_a_recording() -> None:
    recording = record("twsbr", "doublet", duration=SHORT)
    found = recorded_loop(VEHICLE, recording)
    assert isinstance(found, Loop)
    assert found.begins == pytest.approx(recording.time[recording["phase"] == Phase.EXCITE][0])


# --- the daemon


async def test_daemon_sets_up_the_motors_by_sdo_and_runs_an_experiment_over_a_bus(tmp_path: Path) -> None:
    """Daemon, observer process and control socket, as for the MONOCAB, on a lock-step bus."""
    doublet = VEHICLE.experiments["doublet"].model_copy(update={"duration": SHORT})
    vehicle = VEHICLE.model_copy(update={"experiments": {**VEHICLE.experiments, "doublet": doublet}})
    bus, stop = "virtual:twsbr-service", threading.Event()
    simulation = threading.Thread(
        target=virtual_vehicle.run,
        args=(virtual_vehicle.configuration(vehicle, [], 1), bus, bus),
        kwargs={"stop": stop, "lock_step": True},
    )
    daemon = Daemon(vehicle, Places(bus, bus, tmp_path, tmp_path / "s.sock"), lock_step=True)
    simulation.start()
    serving = asyncio.create_task(daemon.run())
    try:
        await _until_ready(daemon, serving)
        assert [report.supported_modes for report in daemon.reports] == [(-1,), (-1,)]
        assert [Path(report.eds).name for report in daemon.reports] == ["upright_motor.eds"] * 2
        answer = (await asyncio.to_thread(list, _ask(tmp_path, "experiment", name="doublet")))[-1]
        assert answer["exit_code"] == api.ExitCode.DONE, answer
        assert list(answer["estimates"]) == ["recursive_output_error", "recursive_prediction_error"]
        assert answer["diagnosis"]["verdict"] in ("adequate", "insufficient_data"), answer["diagnosis"]
        unknown = (await asyncio.to_thread(list, _ask(tmp_path, "experiment", name="step")))[-1]
        assert unknown["exit_code"] == api.ExitCode.USAGE
        assert "sine_stream" in unknown["text"]
    finally:
        daemon.stop()
        await serving
        stop.set()
        await asyncio.to_thread(simulation.join)
    recording = load_recording(Path(answer["recording"]))
    assert recording.channels == TWSBR
    assert Phase.EXCITE in recording["phase"]
    assert replay.replay(recording, vehicle) == answer["estimates"]
    assert all(each["samples"] > 200 for each in answer["estimates"].values())
    rebuilt = replay.load(Path(answer["recording"]).with_suffix(".log"), vehicle)
    assert "excitation" in replay.not_on_the_bus(TWSBR)
    for name in TWSBR.names:  # the last sample's setpoints may come after the log's end
        assert np.array_equal(rebuilt[name][: len(recording) - 1], recording[name][:-1]), name
    up = np.isin(recording["phase"], UP)
    assert np.abs(recording["tilt"][up]).max() < math.radians(3.0)


def _ask(folder: Path, verb: str, **arguments: str) -> Iterator[dict[str, object]]:
    return api.call([folder / "s.sock"], {"verb": verb, **arguments}, timeout=100.0)


async def _until_ready(daemon: Daemon, serving: asyncio.Task[None]) -> None:
    for _ in range(600):
        if serving.done():
            serving.result()
        if daemon.loop.mode is Mode.DISARMED and not daemon.loop.interlocks():
            return
        await asyncio.sleep(0.05)
    raise AssertionError(daemon.loop.interlocks())
