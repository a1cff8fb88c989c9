"""An IMU whose values are milliseconds old when they arrive, as stated in the vehicle file."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from upright.diagnosis.findings import Verdict
from upright.diagnosis.parts import diagnose_parts
from upright.diagnosis.prediction.compare import compare
from upright.diagnosis.prepare.ready import ready
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import problem
from upright.estimators.fit.random.disturbance import disturbances
from upright.estimators.fit.released import released
from upright.estimators.identify.run import with_values
from upright.estimators.methods.prediction_error import prediction_error
from upright.models.library import get
from upright.models.model import Model
from upright.service.hidden_effects.cases import Case
from upright.service.hidden_effects.disturbances import drawn_for
from upright.service.hidden_effects.trial import Bench, disturbance_of
from upright.service.hidden_effects.vehicles import drawn
from upright.service.offline.inputs import replay
from upright.service.virtual.run import record
from upright.simulation.bus.imu_node import SensorPath
from upright.simulation.config import ImuNode, SimulationConfig
from upright.simulation.monocab.truth import PlantTruth
from upright.telemetry.recording import Recording
from upright.vehicles import registry
from upright.vehicles.file import VehicleFile, load
from upright.vehicles.monocab.identification.own import drive_lag
from upright.vehicles.registry import recorded_loop

LATENCY = 0.0075
"""s: not a multiple of the sampling period, and the drives are sampled after the IMU."""


@cache
def vehicle(kind: str, latency: float) -> VehicleFile:
    file = load(kind)
    return file.model_copy(update={"imu": file.imu.model_copy(update={"latency": latency})})


@cache
def recorded(kind: str, experiment: str, latency: float, seed: int = 41) -> Recording:
    return record(vehicle(kind, latency), experiment, seed=seed, duration=20.0)


def known(model: Model, kind: str = "monocab") -> Model:
    parameters = load(kind).parameters
    return with_values(model, parameters.values, parameters.deviations)


def without_age(recording: Recording) -> Recording:
    """`recording` as before the channel existed."""
    values = {name: column for name, column in recording.values.items() if name != "setpoint_age"}
    channels = type(recording.channels)(each for each in recording.channels if each.name != "setpoint_age")
    return replace(recording, channels=channels, values=values)


# --- the virtual IMU


def test_virtual_imu_is_as_late_as_its_file_states() -> None:
    """For a swing of 5 Hz, linear interpolation between samples would lose 2e-3 of it; Hermite's cubics lose 1e-5."""
    period, omega = 0.004, 2.0 * math.pi * 5.0

    def motion(time: float) -> tuple[float, ...]:
        sine, cosine = math.sin(omega * time), math.cos(omega * time)
        return sine, omega * cosine, -(omega**2) * sine

    path = SensorPath(0.0, LATENCY, period)
    seen = [path.pass_on(motion(sample * period)) for sample in range(200)]
    true = [motion(sample * period - LATENCY) for sample in range(200)]
    angle, rate, _ = np.abs(np.array(seen) - np.array(true))[5:].max(axis=0)
    assert angle < 2e-5
    assert rate < 2e-5 * omega


def test_imu_without_latency_passes_values_on_unchanged() -> None:
    path = SensorPath(0.0, 0.0, 0.004)
    for sample in range(5):
        assert path.pass_on((float(sample), 2.0, 3.0)) == (float(sample), 2.0, 3.0)
    assert ImuNode().latency == 0.0


# --- recordings


@pytest.mark.parametrize(("kind", "experiment"), [("monocab", "multisine"), ("twsbr", "square")])
def test_samples_state_when_their_setpoints_were_sent(kind: str, experiment: str) -> None:
    assert set(recorded(kind, experiment, LATENCY)["setpoint_age"]) == {-LATENCY}
    assert set(recorded(kind, experiment, 0.0)["setpoint_age"]) == {0.0}


def test_setpoint_offset_does_not_depend_on_the_imu_latency() -> None:
    """What remains is the transmission over the bus, as with an IMU that is not late. Before, it was 7.5 ms more."""
    prompt, late = recorded("monocab", "multisine", 0.0), recorded("monocab", "multisine", LATENCY)

    def offset(recording: Recording) -> float:
        return float(drive_lag([recording]).parameters["setpoint_offset"].value or 0.0)

    assert offset(late) == pytest.approx(offset(prompt), abs=1e-3)
    assert offset(without_age(late)) == pytest.approx(offset(late) + LATENCY, abs=2e-4)


def test_voltage_offset_of_the_robot_does_not_depend_on_the_imu_latency() -> None:
    def offset(recording: Recording) -> float:
        found = prediction_error(known(get("twsbr"), "twsbr"), [recording], estimate=["voltage_offset"])
        return float(found.parameters["voltage_offset"].value or 0.0)

    prompt, late = recorded("twsbr", "square", 0.0), recorded("twsbr", "square", LATENCY)
    assert offset(late) == pytest.approx(offset(prompt), abs=5e-4)


def test_closed_loop_is_simulated_with_the_delay_of_the_recording() -> None:
    """The correct model follows the record to the noise, as with an IMU that is not late; with setpoints 7.5 ms too
    early it does not."""
    late = recorded("monocab", "multisine", LATENCY)
    right = get("monocab_roll").change({"inertia": PlantTruth().inertia, "gravity_stiffness": 14500.0})
    file = vehicle("monocab", LATENCY)

    def over_floor(recording: Recording) -> float:
        (found,) = compare({"right": right}, [recording], support=file.support, loops=[recorded_loop(file, recording)])
        assert found.closed_loop.reason == ""
        return found.closed_loop.over_floor("precession_rate")

    assert 0.5 < over_floor(late) < 1.25
    assert over_floor(without_age(late)) > 2.0


@pytest.mark.parametrize("age", [math.nan, 0.02])
def test_unknown_or_excessive_setpoint_age_prevents_the_closed_loop(age: float) -> None:
    late = recorded("monocab", "multisine", LATENCY)
    ages = late["setpoint_age"].copy()
    ages[len(ages) // 2] = age
    found = recorded_loop(vehicle("monocab", LATENCY), replace(late, values={**late.values, "setpoint_age": ages}))
    assert isinstance(found, str)
    assert "setpoint_age" in found


def test_sample_with_unknown_setpoint_age_is_skipped_by_the_drive_lag() -> None:
    late = recorded("monocab", "multisine", LATENCY)
    ages = late["setpoint_age"].copy()
    ages[len(ages) // 2] = math.nan
    lag = drive_lag([replace(late, values={**late.values, "setpoint_age": ages})]).parameters["speed_loop_lag"]
    assert lag.value == pytest.approx(drive_lag([late]).parameters["speed_loop_lag"].value, rel=0.01)


def inertia(recording: Recording, method: str) -> float:
    return float(replay.replay(recording, load("monocab"))[method]["parameters"]["inertia"]["value"] or 0.0)


@pytest.mark.parametrize("method", ["recursive_least_squares", "recursive_prediction_error"])
def test_live_estimators_accept_drives_sampled_after_the_imu(method: str) -> None:
    """Least squares used to have no sample then, and reported that the vehicle had hardly left its supports."""
    assert (recorded("monocab", "multisine", LATENCY)["drive_age"] < 0.0).all()
    late, prompt = (inertia(recorded("monocab", "multisine", latency), method) for latency in (LATENCY, 0.0))
    assert late == pytest.approx(prompt, rel=0.02)


def test_live_estimators_accept_recordings_without_setpoint_age() -> None:
    old = without_age(recorded("monocab", "multisine", LATENCY))
    assert inertia(old, "recursive_prediction_error") > 1000.0


# --- the diagnosis


def verdict(recording: Recording) -> tuple[Verdict, list[str]]:
    found = diagnose_parts(
        known(get("monocab_roll")),
        [known(each) for each in registry.of("monocab").models().actuators],
        [recording],
        support=load("monocab").support,
    )
    return found.verdict, [each.effect for each in found.findings]


def test_late_imu_is_not_diagnosed_as_input_delay() -> None:
    """Without the channel `setpoint_age`, setpoints look 7.5 ms late: this is why it exists."""
    recording = recorded("monocab", "multisine", LATENCY)
    assert verdict(recording) == (Verdict.ADEQUATE, [])
    assert verdict(without_age(recording)) == (Verdict.MISSING_EFFECT, ["input_delay"])


# --- CAD values that the recordings determine better


def higher(configuration: SimulationConfig) -> SimulationConfig:
    """A trim mass one and a half standard deviations higher than the vehicle file states."""
    return replace(configuration, plant=PlantTruth(trim_height=0.475))


def test_cad_value_that_the_record_determines_better_is_estimated() -> None:
    recording = record("monocab", "multisine", seed=42, duration=20.0, configure=higher)
    model, support = ready(known(get("monocab_roll")), [recording]), load("monocab").support
    alone = fit(problem(model, [recording], support=support))
    more = released(model, alone)
    before = {each.name for each in model.base_parameters if each.estimated}
    assert {each.name for each in more.base_parameters if each.estimated} - before == {"trim_height"}
    fitted = fit(problem(more, [recording], support=support))
    assert released(more, fitted) is more, "what else is held, the record does not tell"
    found = dict(zip(fitted.problem.kernel.parameters, fitted.values.tolist(), strict=True))
    # To half of the prior standard deviation or better: this is the condition for its release.
    assert found["trim_height"] == pytest.approx(0.475, abs=3.0 * 0.025)
    assert verdict(recording) == (Verdict.ADEQUATE, [])


def test_estimating_a_wrong_cad_value_keeps_its_error_out_of_the_disturbance() -> None:
    """A vehicle of the benchmark whose trim mass is three standard deviations higher than its file states, and moves
    when the vehicle is disturbed. With the height held at that of the file, the estimated disturbance absorbs it."""
    bench, case = Bench(disturbances=drawn_for("monocab")), Case((), 0.0, 1.0, "multisine", 9057)
    stated, others = load("monocab").parameters, drawn(case.seed("vehicle"))
    higher = stated.values["trim_height"] + 3.0 * stated.deviations["trim_height"]
    true_vehicle = replace(others, plant=replace(others.plant, trim_height=higher))
    true, _ = disturbance_of(case, bench, true_vehicle)
    assert true is not None
    recording = bench.record(case.excitation, {}, case.noise, bench.duration, case.seed(), true_vehicle, true)
    support = load("monocab").support
    (estimated,) = prediction_error(bench.nominal, [recording], support=support).disturbance
    (held,) = disturbances(fit(problem(ready(bench.nominal, [recording]), [recording], support=support)))
    assert estimated.std_error is not None
    assert held.std_error is not None
    assert abs(estimated.std - true.rms) < 3.0 * estimated.std_error
    assert held.std - true.rms > 3.0 * held.std_error
