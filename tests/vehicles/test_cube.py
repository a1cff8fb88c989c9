"""The reaction-wheel cube, a vehicle that was added by its folders alone: balanced, recorded, identified, compared."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache
from pathlib import Path

import golden
import numpy as np
import pytest
from typer.testing import CliRunner

from upright.diagnosis.prediction.closed_loop_error import Loop
from upright.diagnosis.prediction.compare import compare
from upright.drivers.cia402.drive import Drive
from upright.drivers.cia402.states import State
from upright.models.compiler.kernel import compile_model
from upright.models.segment import Segment
from upright.service.cli import app
from upright.service.control.cycle.operation import Mode
from upright.service.observer.live.online_estimators import estimators_of
from upright.service.offline.next_experiment import experiments_of
from upright.service.virtual.run import ClosedLoop, VirtualRunError, record
from upright.simulation.config import SimulationConfig
from upright.simulation.cube.plant import CubePlant
from upright.simulation.cube.truth import CubeTruth
from upright.telemetry.recording import Recording
from upright.telemetry.samples import CanFrame
from upright.telemetry.storage import save
from upright.vehicles.cube.channels import CHANNELS
from upright.vehicles.cube.model import CUBE
from upright.vehicles.drives import drive_config
from upright.vehicles.experiment.phases import Phase
from upright.vehicles.file import VehicleFileError, load
from upright.vehicles.registry import recorded_loop

VEHICLE = load("cube")
FILE = Path(VEHICLE.path).read_text()
DT = VEHICLE.period
UP = (Phase.SETTLE, Phase.EXCITE, Phase.FADE)
TRUE_MODEL = CUBE.change(CubeTruth().parameters)
SECONDS = 10.0


@cache
def recorded(experiment: str, *hide: str, seed: int = 31) -> Recording:
    return golden.recorded("cube", experiment, hide=hide, seed=seed, duration=SECONDS)


# --- vehicle file and drive


def test_cad_values_match_the_parameter_table_of_the_model() -> None:
    table = {each.name: each for each in CUBE.base_parameters}
    for name, value in VEHICLE.parameters.values.items():
        assert (value, VEHICLE.parameters.deviations[name]) == (table[name].value, table[name].std)
        assert VEHICLE.parameters.UNITS[name] == table[name].unit


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('role = "wheel"', 'role = "gimbal"', "a cube has 1"),
        ('at = "controller_output"', 'at = "tilt_reference"', "not an injection point of a cube"),
        ("upright_deg = 6.0 ", "upright_deg = 9.0 ", "must be below support_deg"),
        ("wheel_rate_budget = 250.0", "wheel_rate_budget = 400.0", "must be below wheel_rate"),
        ("gear_ratio = 1.0", "lead = 1.0", "needs gear_ratio, and no lead"),
        ("mode = 10 ", "mode = 8 ", "mode"),
    ],
)
def test_errors_in_the_cube_vehicle_file_are_reported(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in FILE
    path = tmp_path / "mine.toml"
    path.write_text(FILE.replace(old, new, 1))
    with pytest.raises(VehicleFileError, match=said):
        load(str(path))


@pytest.mark.parametrize("direction", [1, -1])
def test_torque_is_sent_in_thousandths_of_rated_torque_and_read_back(direction: int) -> None:
    config = replace(drive_config(VEHICLE, VEHICLE.drive[0]), direction=direction)
    drive, reader = Drive(config), Drive(config)
    drive.handle(CanFrame(1, 0x181, (0x0237).to_bytes(2, "little") + bytes(4)))
    ((cob_id, data),) = drive.command(State.OPERATION_ENABLED, 0.05)
    assert cob_id == 0x201
    assert int.from_bytes(data[2:], "little", signed=True) == direction * round(0.05 / 0.083 * 1000.0)
    reader.handle(CanFrame(2, cob_id, data))
    assert reader.setpoint == drive.setpoint == pytest.approx(0.05, abs=0.5e-3 * 0.083)
    drive.handle(CanFrame(3, 0x281, bytes(4) + (-direction * 100).to_bytes(2, "little", signed=True)))
    assert drive.torque == pytest.approx(-0.1 * 0.083)


def test_config_check_reports_controller_and_experiments() -> None:
    answer = CliRunner().invoke(app, ["config", "check", "cube", "--json"])
    assert answer.exit_code == 0, answer.output
    report = json.loads(answer.stdout)
    assert report["controller"]["delay_margin"] > 4.0 * DT
    assert set(report["experiments"]) == set(VEHICLE.experiments)


# --- model


def test_model_trajectory_matches_the_plant() -> None:
    """From the same state, the plant without hidden effects and the model with its parameters agree for 0.1 s, except
    for the integration error: the plant takes three steps for each step of the model."""
    config = SimulationConfig(plant=replace(CubeTruth(), support_angle=100.0, torque_lag=1e-9, torque_noise=0.0))
    kernel = compile_model(TRUE_MODEL)
    time = 1e-3 * np.arange(101)
    random = np.random.default_rng(5)
    for tilt, tilt_rate, angle, rate, torque in random.uniform(-1.0, 1.0, (10, 5)) * (0.1, 1.0, 3.0, 40.0, 0.1):
        plant = CubePlant(config)
        plant.wheel.powered, plant.wheel.target = True, torque
        plant.place(tilt)
        plant.tilt_rate, plant.wheel_angle, plant.wheel_rate = tilt_rate, angle, rate
        plant._balance()
        plant.advance(round(0.1 / plant.step_size))
        held = np.tile([torque, 1e-3], (len(time), 1))
        given = Segment(time, np.repeat(time[:, None], 2, axis=1), held, np.full((len(time), 4), np.nan))
        *_, last = kernel.run(given, kernel.vector(), np.array([tilt, tilt_rate, angle, rate, 0.0, 0.0])).predicted
        assert last[1:3] == pytest.approx([plant.tilt_rate, plant.wheel_angle], rel=1e-3, abs=1e-3)


# --- runs


@pytest.mark.parametrize("name", [name for name, each in VEHICLE.experiments.items() if each.gets_up])
def test_cube_balances_through_every_experiment_and_returns_to_its_support(name: str) -> None:
    """The true tilt stays within 3 deg from upright to the command to get down; then the cube and its wheel rest."""
    closed, worst = ClosedLoop(VEHICLE, hide=["disturbance"]), 0.0
    plant = closed.plant_side.plant
    assert isinstance(plant, CubePlant)
    closed.loop.start_experiment(name)
    while closed.loop.mode is Mode.RUNNING:
        closed.advance(DT)
        if closed.loop.run is not None and closed.loop.run.phase in UP:
            worst = max(worst, abs(plant.tilt))
    assert (closed.loop.mode, closed.loop.reason) == (Mode.DISARMED, "")
    assert 0.0 < worst < math.radians(3.0)
    closed.advance(1.0)
    assert closed.loop.io.state is State.SWITCH_ON_DISABLED
    assert abs(plant.tilt) == pytest.approx(VEHICLE.support, abs=math.radians(0.3))
    assert abs(plant.wheel_rate) < 2.0


def test_cube_leans_against_a_static_load_and_its_wheel_comes_to_rest() -> None:
    recording = record("cube", "hold", hide=["static_torque"])
    last = np.flatnonzero(recording["phase"] == Phase.EXCITE)[-1000:]
    assert recording["tilt"][last].mean() == pytest.approx(-4e-3 / CubeTruth().gravity_stiffness, rel=0.05)
    assert np.abs(recording["wheel_rate"][last].mean()) < 0.2
    assert recording.channels == CHANNELS


def test_cube_that_cannot_get_up_reports_that_it_was_not_upright_in_time() -> None:
    with pytest.raises(VirtualRunError, match="was not upright within"):
        record("cube", "hold", hide=["static_torque=30"])


def test_cube_rests_on_its_support_after_an_immediate_stop() -> None:
    closed = ClosedLoop(VEHICLE)
    closed.loop.start_experiment("hold")
    closed.advance(8.0)
    closed.loop.stop_now("somebody pressed the button")
    closed.advance(2.0)
    assert closed.loop.mode is Mode.FAULT
    plant = closed.plant_side.plant
    assert isinstance(plant, CubePlant)
    assert abs(plant.tilt) == pytest.approx(VEHICLE.support, abs=math.radians(0.3))


@pytest.mark.parametrize(("fault", "code"), [("imu_gap@9", "imu_silent"), ("drive_silent:wheel@9", "drive_silent")])
def test_fault_stops_the_cube_with_its_code_and_it_rests_on_its_support(fault: str, code: str) -> None:
    closed = ClosedLoop(VEHICLE, faults=[fault])
    closed.loop.start_experiment("hold")
    closed.until(lambda: closed.loop.mode is Mode.FAULT, 15.0)
    assert closed.loop.code == code
    assert closed.loop.reason
    closed.advance(3.0)
    plant = closed.plant_side.plant
    assert isinstance(plant, CubePlant)
    assert abs(plant.tilt) == pytest.approx(VEHICLE.support, abs=math.radians(0.3))


# --- identification and diagnosis


def test_prediction_error_fit_finds_the_true_parameters_within_1_percent() -> None:
    from upright.estimators.methods.prediction_error import prediction_error

    found = prediction_error(CUBE, [recorded("multisine")], support=VEHICLE.support)
    for name, true in CubeTruth().parameters.items():
        assert found.values[name] == pytest.approx(true, rel=0.01), name


@pytest.mark.parametrize("experiment", ["doublet", "multisine"])
def test_true_model_reproduces_the_record_in_closed_loop(experiment: str) -> None:
    recording = recorded(experiment)
    loop = recorded_loop(VEHICLE, recording)
    assert isinstance(loop, Loop)
    assert loop.begins == pytest.approx(recording.time[recording["phase"] == Phase.EXCITE][0])
    found = compare(
        {"right": TRUE_MODEL, "file": CUBE.change(VEHICLE.parameters.values)},
        [recording],
        support=VEHICLE.support,
        loops=[loop],
    )
    right, file = (each.closed_loop for each in found)
    assert right.reason == file.reason == ""
    assert right.over_floor("tilt") < 2.0
    assert file.over_floor("tilt") > 2.0 * right.over_floor("tilt")


def test_recorded_loop_rejects_the_torques_of_another_controller() -> None:
    section = VEHICLE.controller.model_copy(update={"effort_weight": 100.0})
    other = VEHICLE.model_copy(update={"controller": section})
    assert "does not give the recorded torques" in str(recorded_loop(other, recorded("doublet")))


def test_all_experiments_with_excitation_can_be_predicted() -> None:
    found, left_out = experiments_of(VEHICLE)
    assert {each.name for each in found} == {"doublet", "square", "sweep", "multisine"}
    assert set(left_out) == {"hold", "rest", "tilt", "silence"}


def test_live_estimators_are_recursive_and_the_diagnosis_finds_nothing() -> None:
    bank = estimators_of(VEHICLE)
    bank.join()
    bank.update(recorded("multisine").frames(CHANNELS))
    for method in ("recursive_output_error", "recursive_prediction_error"):
        found = bank.results()[method]["parameters"]
        for name, true in CubeTruth().parameters.items():
            assert found[name]["value"] == pytest.approx(true, rel=0.05), (method, name)
    report = bank.diagnosis()
    assert report is not None
    assert report["findings"] == []


def test_identify_compare_and_model_show_accept_the_cube(tmp_path: Path) -> None:
    path = tmp_path / "doublet.arrow"
    save(recorded("doublet"), path)
    for words in (
        ["identify", str(path), "--vehicle", "cube", "--json"],
        ["compare", str(path), "--vehicle", "cube", "--json"],
        ["model", "show", "cube", "--effect", "coulomb_friction@wheel"],
    ):
        answer = CliRunner().invoke(app, words)
        assert answer.exit_code == 0, answer.output
