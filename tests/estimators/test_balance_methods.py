"""Least squares and instrumental variables on a joint's balance, on synthetic truth with fixed seeds and on EMPS."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import small_vehicle

from estimators.contract import Estimate, EstimationError, Status
from estimators.data.state_variable_filter import StateVariableFilter
from estimators.methods.balance import Pieces, split
from estimators.methods.instrumental_variables import instrumental_variables as any_instruments
from estimators.methods.least_squares import filtered, least_squares
from models.library import get
from models.library.axis import axis
from models.model import Model
from models.parts import Parameter
from telemetry.channels import Channel, ChannelTable
from telemetry.recording import Recording, describe

Method = Callable[..., Estimate]
instrumental_variables = partial(any_instruments, setpoint="precession_rate_setpoint")
METHODS = [least_squares, instrumental_variables]
SUPPORT = float(np.radians(4.0))
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0, "static_torque.torque": 40.0}
ROLL = get("monocab_roll").add("static_torque")
DRIVEN = replace(ROLL, actuators=tuple(replace(each, commanded=True) for each in ROLL.actuators))
"""The same, had its gimbals followed a command at once."""
MIXED = replace(
    ROLL,
    outputs=tuple(replace(each, expression="roll + roll_rate") for each in ROLL.outputs),
)
"""Every sensor shows the same sum: no solving for one of the two."""
NOMINAL = small_vehicle.Truth()


def sweeps(seeds: int, duration: float, truth: small_vehicle.Truth = NOMINAL) -> list[Recording]:
    reference = partial(small_vehicle.sweep, span=duration - 1.0)
    stamps, table = small_vehicle.run(seeds, duration, truth, reference=reference)
    return [small_vehicle.recording(stamps, table, seed) for seed in range(seeds)]


@pytest.fixture(scope="module")
def sweep() -> list[Recording]:
    return sweeps(3, 21.0)


@pytest.fixture(scope="module")
def noisy_sweep() -> list[Recording]:
    return sweeps(1, 21.0, small_vehicle.Truth(gyro_density=20 * 3.5e-5))


def with_channels(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, values={**recording.values, **channels})


def without(recording: Recording, name: str) -> Recording:
    table = ChannelTable(channel for channel in recording.channels if channel.name != name)
    return Recording(table, recording.timestamp_ns, {n: recording[n] for n in table.names}, recording.metadata)


def rows(recording: Recording, kept: np.ndarray) -> Recording:
    values = {name: column[kept] for name, column in recording.values.items()}
    return replace(recording, timestamp_ns=recording.timestamp_ns[kept], values=values)


def error(estimate: Estimate, name: str) -> float:
    """Relative error."""
    value = estimate.parameters[name].value
    assert value is not None, estimate.reason
    return value / TRUTH[name] - 1.0


# --- the balance as a regression


def test_the_monocab_balance_is_split_into_what_is_known_and_one_regressor_a_parameter() -> None:
    balance = split(ROLL)
    assert balance.free == ("inertia", "gravity_stiffness", "static_torque.torque")
    assert balance.shifts == ("drive_offset",)
    assert [str(each) for each in balance.regressors] == ["roll_rate measured'", "-roll measured", "-1"]
    assert balance.anchors == ("angular_momentum", "trim_mass", "trim_height")
    names = {symbol.name: symbol for symbol in balance.known.free_symbols}
    assert set(names) == {"precession_rate", "trim_position", "trim_rate_slope"}
    at = {names["precession_rate"]: 0.1, names["trim_position"]: 0.2, names["trim_rate_slope"]: 0.3}
    assert float(balance.known.subs(at)) == pytest.approx(3300 * 0.1 + 500 * (9.81 * 0.2 - 0.4 * 0.3))


def test_every_output_that_shows_a_state_is_solved_for_it() -> None:
    model = get("monocab_full").change(estimated=["inertia", "gravity_stiffness"])
    balance = split(model.add("sensor_scale").change({"sensor_scale.scale": 0.1}, estimated=["inertia"]))
    symbols = {symbol.name for part in (balance.known, *balance.regressors) for symbol in part.free_symbols}
    assert {"precession_rate measured", "trim_position measured", "trim_rate_setpoint"} < symbols
    assert float(balance.motion[1].diff(next(iter(balance.motion[1].free_symbols)))) == pytest.approx(1.0 / 1.1)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (get("monocab_full"), "not linear in .*speed_loop_lag"),
        (ROLL.add("sensor_offset"), "not linear in gravity_stiffness, sensor_offset.offset"),
        (ROLL.add("sensor_scale"), "not linear in inertia, sensor_scale.scale"),
        (DRIVEN.add("actuator_lag"), "actuator_lag.lag: a lag is not linear"),
        (ROLL.add("hysteresis"), "needs hysteresis.z, which no output measures"),
        (ROLL.add("sensor_lag"), "not linear in .*sensor_lag.lag"),
        (MIXED, "cannot be solved for the motion"),
        (get("monocab_roll").change(estimated=["drive_offset"]), "no estimated parameter"),
        (replace(ROLL, joints=()), "has none"),
        (replace(ROLL, joints=(replace(ROLL.joints[0], rate="2 * roll_rate"),)), "is not a state"),
    ],
)
def test_a_balance_that_is_no_regression_is_refused_by_name(model: Model, words: str) -> None:
    with pytest.raises(EstimationError, match=words) as caught:
        least_squares(model, [])
    assert caught.value.remedy


def test_the_batch_filter_is_the_recursive_one() -> None:
    random = np.random.default_rng(1)
    time = np.cumsum(random.uniform(0.001, 0.004, 400))
    signal = random.standard_normal(400)
    signal[0] = 0.0  # the recursive one takes the start value off
    recursive = StateVariableFilter(1, 25.0, 3)
    recursive.start([0.0])
    batch = filtered(Pieces(time, signal[:-1, None], signal[1:, None]), 25.0, 3, 3)
    for place, (before, now) in enumerate(pairwise(time), start=1):
        recursive.update(now - before, [signal[place]])
        np.testing.assert_allclose(batch[:, place, 0], recursive.outputs()[:, 0], rtol=1e-9, atol=1e-9)


# --- what is estimated


@pytest.mark.parametrize("method", METHODS)
def test_a_sweep_gives_the_truth_within_one_percent(sweep: list[Recording], method: Method) -> None:
    found = [method(ROLL, [recording], support=SUPPORT) for recording in sweep]
    assert all(estimate.status is Status.OK for estimate in found)
    for estimate in found:
        assert abs(error(estimate, "inertia")) < 0.01
        assert abs(error(estimate, "gravity_stiffness")) < 0.01
        assert estimate.values["static_torque.torque"] == pytest.approx(40.0, abs=2.0)
    inside = [
        abs(estimate.values[name] - truth) < 1.96 * estimate.parameters[name].std
        for estimate in found
        for name, truth in TRUTH.items()
    ]
    assert sum(inside) >= 7  # of 9 intervals of 95 %: fewer has a probability of 0.8 %


@pytest.mark.parametrize("method", METHODS)
def test_a_step_from_rest_gives_the_truth_within_three_percent(method: Method) -> None:
    stamps, table = small_vehicle.run(2, 8.0, from_support=True)
    for seed in range(2):
        estimate = method(ROLL, [small_vehicle.recording(stamps, table, seed)], support=SUPPORT)
        assert abs(error(estimate, "inertia")) < 0.03
        assert abs(error(estimate, "gravity_stiffness")) < 0.03
        assert estimate.span < 7.0  # what happens on the support does not count


def test_gyro_noise_biases_least_squares_and_not_instrumental_variables(noisy_sweep: list[Recording]) -> None:
    # The paper's finding: its least squares is off since the differentiated rate carries the noise.
    for recording in noisy_sweep:
        plain = error(least_squares(ROLL, [recording], support=SUPPORT), "inertia")
        assert plain < -0.05
        assert error(least_squares(ROLL, [recording], support=SUPPORT, bandwidth=60.0), "inertia") < 2.0 * plain
        assert abs(error(instrumental_variables(ROLL, [recording], support=SUPPORT), "inertia")) < 0.02


def test_dry_friction_is_estimated_along() -> None:
    (recording,) = sweeps(1, 16.0, small_vehicle.Truth(coulomb_friction=60.0))
    for method in METHODS:
        estimate = method(ROLL.add("coulomb_friction"), [recording], support=SUPPORT)
        assert estimate.values["coulomb_friction.torque"] == pytest.approx(60.0, rel=0.05)
        assert abs(error(estimate, "inertia")) < 0.01


def test_several_recordings_are_one_regression(sweep: list[Recording]) -> None:
    alone = least_squares(ROLL, sweep[:1], support=SUPPORT)
    together = least_squares(ROLL, sweep, support=SUPPORT)
    assert together.samples == 3 * alone.samples
    assert together.span == pytest.approx(3 * alone.span)
    exact = [least_squares(sharp(ROLL), part, support=SUPPORT).parameters["inertia"].std for part in (sweep[:1], sweep)]
    assert exact[1] == pytest.approx(exact[0] / np.sqrt(3.0), rel=0.3)


def sharp(model: Model) -> Model:
    """With no doubt about what is not estimated."""
    return model.change(deviations=dict.fromkeys(("angular_momentum", "trim_mass", "trim_height"), 0.0))


def test_the_anchor_passes_its_uncertainty_on(sweep: list[Recording]) -> None:
    exact = least_squares(sharp(ROLL), sweep[:1], support=SUPPORT).parameters["inertia"]
    doubtful = sharp(ROLL).change(deviations={"angular_momentum": 33.0})
    anchored = least_squares(doubtful, sweep[:1], support=SUPPORT)
    inertia = anchored.parameters["inertia"]
    assert inertia.value == exact.value
    assert inertia.std == pytest.approx(np.hypot(exact.std, 0.01 * inertia.value), rel=0.01)
    assert anchored.correlation is not None
    assert anchored.correlation[0, 1] > 0.8  # both go with the angular momentum


def test_a_parameter_that_is_held_is_an_anchor_too(sweep: list[Recording]) -> None:
    held = least_squares(ROLL.change({"gravity_stiffness": 14500.0}), sweep[:1], support=SUPPORT, estimate=["inertia"])
    assert list(held.parameters) == ["inertia"]
    assert abs(error(held, "inertia")) < 0.02
    free = least_squares(ROLL, sweep[:1], support=SUPPORT)
    assert held.parameters["inertia"].std > free.parameters["inertia"].std  # CAD's stiffness is that uncertain


@pytest.mark.parametrize("method", METHODS)
def test_a_misalignment_of_the_drives_is_found_and_does_no_harm(sweep: list[Recording], method: Method) -> None:
    # Said to be 3 ms younger than they are: the values were true 3 ms earlier than their time stamps say.
    late = with_channels(sweep[0], drive_age=sweep[0]["drive_age"] - 0.003)
    estimate = method(ROLL, [late], support=SUPPORT)
    assert estimate.values["drive_offset"] == pytest.approx(-0.003, abs=0.0003)
    assert abs(error(estimate, "inertia")) < 0.01


@pytest.mark.parametrize("method", METHODS)
def test_gaps_and_unknown_values_do_no_harm(sweep: list[Recording], method: Method) -> None:
    kept = np.ones(len(sweep[0]), dtype=bool)
    kept[2000:2100] = False  # the bus was away for 0.4 s
    speed = sweep[0]["precession_rate"].copy()
    speed[4000:4010] = np.nan
    estimate = method(ROLL, [rows(with_channels(sweep[0], precession_rate=speed), kept)], support=SUPPORT)
    assert estimate.status is Status.OK
    assert abs(error(estimate, "inertia")) < 0.02


def test_a_result_is_complete_and_becomes_json_without_nan(sweep: list[Recording]) -> None:
    by_name = least_squares("monocab_roll", sweep[:1], support=SUPPORT)
    assert list(by_name.parameters) == ["inertia", "gravity_stiffness", "drive_offset"]
    estimate = least_squares(ROLL, sweep[:1], support=SUPPORT)
    assert estimate.method == "least_squares"
    assert list(estimate.parameters) == ["inertia", "gravity_stiffness", "drive_offset", "static_torque.torque"]
    assert estimate.correlation is not None
    np.testing.assert_allclose(np.diag(estimate.correlation), 1.0)
    assert estimate.seconds > 0.0
    assert estimate.fit_percent == {}
    assert "NaN" not in json.dumps(estimate.to_json())


# --- what is not


def assert_unknown(estimate: Estimate, status: Status, words: str) -> None:
    assert estimate.status is status
    assert words in estimate.reason
    assert estimate.parameters["inertia"].value is None
    assert estimate.parameters["inertia"].std is None
    assert "NaN" not in json.dumps(estimate.to_json())


def test_standing_still_is_too_little_excitation() -> None:
    stamps, table = small_vehicle.run(1, 6.0)
    recording = small_vehicle.recording(stamps, table, 0)
    plain = least_squares(ROLL, [recording], support=SUPPORT)
    assert_unknown(plain, Status.TOO_LITTLE_EXCITATION, "the term of inertia varies by")
    assert plain.parameters["inertia"].coverage_percent < 60.0
    instrumental = instrumental_variables(ROLL, [recording], support=SUPPORT)
    assert_unknown(instrumental, Status.TOO_LITTLE_EXCITATION, "excitation never moves")


def test_without_a_known_excitation_there_are_no_instruments(sweep: list[Recording]) -> None:
    missing = instrumental_variables(ROLL, [without(sweep[0], "excitation")], support=SUPPORT)
    assert_unknown(missing, Status.MISSING_CHANNEL, "channel excitation is missing")
    unknown = with_channels(sweep[0], excitation=np.full(len(sweep[0]), np.nan))
    assert_unknown(
        instrumental_variables(ROLL, [unknown], support=SUPPORT), Status.MISSING_CHANNEL, "unknown in 5249 of 5249"
    )
    other = instrumental_variables(ROLL, [unknown], support=SUPPORT, excitation="roll_reference")
    assert abs(error(other, "inertia")) < 0.01


def test_what_the_excitation_does_not_move_has_no_instrument(sweep: list[Recording]) -> None:
    # The vehicle moves as before; the alleged excitation has nothing to do with it.
    random = np.random.default_rng(4)
    unrelated = with_channels(sweep[0], excitation=0.01 * np.repeat(random.standard_normal(len(sweep[0]) // 25), 25))
    estimate = instrumental_variables(ROLL, [unrelated], support=SUPPORT)
    assert_unknown(estimate, Status.TOO_LITTLE_EXCITATION, "of the variance of roll_rate is explained by excitation")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        (lambda r: without(r, "precession_rate"), Status.MISSING_CHANNEL, "precession_rate"),
        (lambda r: with_channels(r, roll_rate=np.degrees(r["roll_rate"])), Status.BAD_DATA, "degrees"),
        (lambda r: with_channels(r, roll_rate=np.clip(r["roll_rate"], -0.02, 0.02)), Status.BAD_DATA, "is clipped at"),
        (lambda r: with_channels(r, roll=np.zeros(len(r))), Status.BAD_DATA, "never moves"),
        (lambda r: rows(r, np.arange(len(r)) % 60 < 40), Status.TOO_FEW_SAMPLES, "gapless"),
        (lambda r: with_channels(r, roll=r["roll"] + 0.1), Status.TOO_FEW_SAMPLES, "free of its supports"),
    ],
)
def test_data_that_cannot_be_used_give_no_value_but_a_reason(
    sweep: list[Recording], method: Method, change: Callable[[Recording], Recording], status: Status, words: str
) -> None:
    assert_unknown(method(ROLL, [change(sweep[0])], support=SUPPORT), status, words)


@pytest.mark.parametrize("method", METHODS)
def test_a_short_record_is_too_few_rows(sweep: list[Recording], method: Method) -> None:
    short = rows(sweep[0], np.arange(len(sweep[0])) < 200)
    assert_unknown(
        method(ROLL, [short], support=SUPPORT, bandwidth=10.0), Status.TOO_FEW_SAMPLES, "independent samples"
    )


def test_no_recording_is_no_result() -> None:
    for method in METHODS:
        assert_unknown(method(ROLL, []), Status.TOO_FEW_SAMPLES, "")


def test_a_value_that_cannot_be_is_not_given(sweep: list[Recording]) -> None:
    # Gimbals of the wrong sign, angle and rate alike: no check of the channels can see it.
    signs = {name: -sweep[0][name] for name in ("precession", "precession_rate", "precession_rate_setpoint")}
    estimate = least_squares(ROLL, [with_channels(sweep[0], **signs)], support=SUPPORT)
    assert_unknown(estimate, Status.AT_BOUND, "check signs and units")
    assert estimate.bounds_hit == ("inertia", "gravity_stiffness")


def test_an_amplitude_that_noise_takes_below_zero_is_zero(sweep: list[Recording]) -> None:
    found = [least_squares(ROLL.add("asymmetric_friction"), [each], support=SUPPORT) for each in sweep]
    torques = [
        each.parameters[f"asymmetric_friction.torque_{way}"] for each in found for way in ("forward", "backward")
    ]
    assert all(torque.status is Status.OK and torque.value >= 0.0 for torque in torques)
    assert any(torque.value == 0.0 for torque in torques)
    assert any(each.bounds_hit for each in found)


def test_a_scale_that_is_not_anchored_names_what_it_goes_with(sweep: list[Recording]) -> None:
    estimate = least_squares(DRIVEN.add("input_gain"), sweep[:1], support=SUPPORT)
    assert_unknown(estimate, Status.UNIDENTIFIABLE, "input_gain.gain")
    assert "inertia" in estimate.parameters["input_gain.gain"].reason


def test_two_of_the_same_are_not_told_apart(sweep: list[Recording]) -> None:
    estimate = least_squares(DRIVEN.add("input_delay"), sweep[:1], support=SUPPORT)
    assert estimate.status is Status.UNIDENTIFIABLE
    assert "input_delay.delay" in estimate.parameters["drive_offset"].reason
    assert "drive_offset" in estimate.parameters["input_delay.delay"].reason
    assert abs(error(estimate, "inertia")) < 0.01
    assert estimate.correlation is not None
    assert np.isnan(estimate.correlation[2]).all()


def test_what_the_balance_does_not_have_is_said(sweep: list[Recording]) -> None:
    estimate = least_squares(ROLL.add("gyro_bias"), sweep[:1], support=SUPPORT)
    assert estimate.status is Status.UNIDENTIFIABLE
    assert "does not occur" in estimate.parameters["gyro_bias.bias"].reason
    assert abs(error(estimate, "inertia")) < 0.01


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, float("nan")])
def test_a_bandwidth_that_makes_no_filter_is_refused(sweep: list[Recording], bandwidth: float) -> None:
    with pytest.raises(EstimationError, match="is invalid"):
        least_squares(ROLL, sweep[:1], support=SUPPORT, bandwidth=bandwidth)


# --- other machines: only the position is measured


def pendulum(**settings: float) -> Model:
    gravity = Parameter("gravity", "N m", 1.0, scale=1.0)
    model = axis(
        name="pendulum",
        position="angle",
        position_unit="rad",
        rate_unit="rad/s",
        force="torque",
        force_unit="N m",
        inertia_unit="kg m^2",
        load="-gravity * sin(angle)",
        more_parameters=(gravity,),
        force_scale=1.0,
        position_scale=1.0,
        rate_scale=1.0,
        **settings,
    )
    return model.add("viscous_friction").add("coulomb_friction")


def test_a_pendulum_of_which_the_angle_alone_is_measured_is_found_again() -> None:
    spacing, substeps = 0.002, 4
    torque = np.repeat(1.2 * np.random.default_rng(2).standard_normal(100), 100)
    angle, rate, angles = 0.0, 0.0, []
    for push in torque:
        angles.append(angle)
        for _ in range(substeps):
            friction = 0.05 * rate + 0.1 * np.tanh(rate / 1e-3)
            rate += spacing / substeps * (push - 2.0 * np.sin(angle) - friction) / 0.3
            angle += spacing / substeps * rate
    channels = ChannelTable((Channel("angle", "rad", ""), Channel("torque", "N m", "")))
    stamps = np.arange(len(torque)) * 2_000_000
    recording = Recording(channels, stamps, {"angle": np.array(angles), "torque": torque})
    estimate = least_squares(pendulum(), [recording])
    assert estimate.status is Status.OK
    assert estimate.values["inertia"] == pytest.approx(0.3, rel=0.02)
    assert estimate.values["gravity"] == pytest.approx(2.0, rel=0.02)
    assert estimate.values["viscous_friction.coefficient"] == pytest.approx(0.05, abs=0.02)
    assert estimate.values["coulomb_friction.torque"] == pytest.approx(0.1, abs=0.02)


@pytest.mark.measured
def test_emps_within_two_percent_of_the_published_values(measured_data: Path) -> None:
    data = np.genfromtxt(measured_data / "emps" / "emps.csv", delimiter=",", names=True)
    names = {"position": "m", "position_reference": "m", "motor_voltage": "V"}
    stamps = np.round(data["time"] * 1e9).astype(np.int64)
    recording = Recording(describe(names), stamps, {name: data[name] for name in names})
    model = axis(force="motor_voltage", force_gain=35.15065, force_gain_unit="N/V", inertia=100.0, smooth_rate=1e-4)
    for effect in ("viscous_friction", "coulomb_friction", "static_torque"):
        model = model.add(effect)
    # The published offset is on the other side of the equation.
    published = dict(zip((p.name for p in model.parameters if p.estimated), (95.11, 203.5, 20.39, 3.16), strict=True))
    plain = least_squares(model, [recording])
    assert plain.status is Status.OK
    for name, value in published.items():
        assert plain.values[name] == pytest.approx(value, rel=0.02), name
    # The reference as excitation: no noise in it, so nothing is attenuated.
    instrumental = instrumental_variables(model, [recording], excitation="position_reference")
    assert instrumental.values["inertia"] == pytest.approx(95.11, rel=0.02)
    assert instrumental_variables(model, [recording]).status is Status.MISSING_CHANNEL
