"""Least squares and instrumental variables on a joint's balance: synthetic data of known truth, fixed seeds; EMPS."""

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

from upright.estimators.contract import Estimate, EstimationError, Status
from upright.estimators.data.state_variable_filter import StateVariableFilter
from upright.estimators.methods.balance import Pieces, split
from upright.estimators.methods.instrumental_variables import instrumental_variables as any_instruments
from upright.estimators.methods.least_squares import filtered, least_squares
from upright.models.library import get
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording, describe

Method = Callable[..., Estimate]
instrumental_variables = partial(any_instruments, setpoint="precession_rate_setpoint")
METHODS = [least_squares, instrumental_variables]
SUPPORT = float(np.radians(4.0))
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0, "static_torque.torque": 40.0}
ROLL = get("monocab_roll").add("static_torque")
DRIVEN = replace(ROLL, actuators=tuple(replace(each, commanded=True) for each in ROLL.actuators))
"""The same model with gimbals that follow a command immediately."""
MIXED = replace(
    ROLL,
    outputs=tuple(replace(each, expression="roll + roll_rate") for each in ROLL.outputs),
)
"""Both sensors show the same sum of angle and rate, so neither of the two can be solved for."""
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


def part_of(recording: Recording, kept: np.ndarray) -> Recording:
    values = {name: column[kept] for name, column in recording.values.items()}
    return replace(recording, timestamp_ns=recording.timestamp_ns[kept], values=values)


def error(estimate: Estimate, name: str) -> float:
    """Relative error."""
    value = estimate.parameters[name].value
    assert value is not None, estimate.reason
    return value / TRUTH[name] - 1.0


# --- the balance as a regression


def test_monocab_balance_is_split_into_known_terms_and_one_regressor_per_parameter() -> None:
    balance = split(ROLL)
    assert balance.free == ("inertia", "gravity_stiffness", "static_torque.torque")
    assert balance.shifts == ("drive_offset",)
    assert [str(each) for each in balance.regressors] == ["roll_rate measured'", "-roll measured", "-1"]
    assert balance.anchors == ("angular_momentum", "trim_mass", "trim_height")
    names = {symbol.name: symbol for symbol in balance.known.free_symbols}
    assert set(names) == {"precession_rate", "trim_position", "trim_rate_slope"}
    at = {names["precession_rate"]: 0.1, names["trim_position"]: 0.2, names["trim_rate_slope"]: 0.3}
    assert float(balance.known.subs(at)) == pytest.approx(3300 * 0.1 + 500 * (9.81 * 0.2 - 0.4 * 0.3))


def test_states_are_solved_from_the_outputs_that_measure_them() -> None:
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
def test_balance_that_gives_no_regression_is_refused_with_reason_and_remedy(model: Model, words: str) -> None:
    with pytest.raises(EstimationError, match=words) as caught:
        least_squares(model, [])
    assert caught.value.remedy


def test_batch_filter_matches_the_recursive_filter() -> None:
    random = np.random.default_rng(1)
    time = np.cumsum(random.uniform(0.001, 0.004, 400))
    signal = random.standard_normal(400)
    signal[0] = 0.0  # the recursive filter subtracts the start value
    recursive = StateVariableFilter(1, 25.0, 3)
    recursive.start([0.0])
    batch = filtered(Pieces(time, signal[:-1, None], signal[1:, None]), 25.0, 3, 3)
    for place, (before, now) in enumerate(pairwise(time), start=1):
        recursive.update(now - before, [signal[place]])
        np.testing.assert_allclose(batch[:, place, 0], recursive.outputs()[:, 0], rtol=1e-9, atol=1e-9)


# --- estimates


@pytest.mark.parametrize("method", METHODS)
def test_sweep_gives_the_true_parameters_within_one_percent(sweep: list[Recording], method: Method) -> None:
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
    assert sum(inside) >= 7  # of nine 95 % intervals; the probability of fewer is 0.8 %


@pytest.mark.parametrize("method", METHODS)
def test_step_from_rest_gives_the_true_parameters_within_three_percent(method: Method) -> None:
    stamps, table = small_vehicle.run(2, 8.0, from_support=True)
    for seed in range(2):
        estimate = method(ROLL, [small_vehicle.recording(stamps, table, seed)], support=SUPPORT)
        assert abs(error(estimate, "inertia")) < 0.03
        assert abs(error(estimate, "gravity_stiffness")) < 0.03
        assert estimate.span < 7.0  # samples on the support are not used


def test_gyro_noise_biases_least_squares_but_not_instrumental_variables(noisy_sweep: list[Recording]) -> None:
    # As in the paper: least squares is biased because the differentiated rate contains the noise.
    for recording in noisy_sweep:
        plain = error(least_squares(ROLL, [recording], support=SUPPORT), "inertia")
        assert plain < -0.05
        assert error(least_squares(ROLL, [recording], support=SUPPORT, bandwidth=60.0), "inertia") < 2.0 * plain
        assert abs(error(instrumental_variables(ROLL, [recording], support=SUPPORT), "inertia")) < 0.02


def test_dry_friction_is_estimated_jointly_with_the_inertia() -> None:
    (recording,) = sweeps(1, 16.0, small_vehicle.Truth(coulomb_friction=60.0))
    for method in METHODS:
        estimate = method(ROLL.add("coulomb_friction"), [recording], support=SUPPORT)
        assert estimate.values["coulomb_friction.torque"] == pytest.approx(60.0, rel=0.05)
        assert abs(error(estimate, "inertia")) < 0.01


def test_several_recordings_are_combined_in_one_regression(sweep: list[Recording]) -> None:
    alone = least_squares(ROLL, sweep[:1], support=SUPPORT)
    together = least_squares(ROLL, sweep, support=SUPPORT)
    assert together.samples == 3 * alone.samples
    assert together.span == pytest.approx(3 * alone.span)
    exact = [
        least_squares(with_exact_anchors(ROLL), part, support=SUPPORT).parameters["inertia"].std
        for part in (sweep[:1], sweep)
    ]
    assert exact[1] == pytest.approx(exact[0] / np.sqrt(3.0), rel=0.3)


def with_exact_anchors(model: Model) -> Model:
    """`model` with exactly known anchors."""
    return model.change(deviations=dict.fromkeys(("angular_momentum", "trim_mass", "trim_height"), 0.0))


def test_uncertainty_of_the_anchor_is_propagated(sweep: list[Recording]) -> None:
    exact = least_squares(with_exact_anchors(ROLL), sweep[:1], support=SUPPORT).parameters["inertia"]
    doubtful = with_exact_anchors(ROLL).change(deviations={"angular_momentum": 33.0})
    anchored = least_squares(doubtful, sweep[:1], support=SUPPORT)
    inertia = anchored.parameters["inertia"]
    assert inertia.value == exact.value
    assert inertia.std == pytest.approx(np.hypot(exact.std, 0.01 * inertia.value), rel=0.01)
    assert anchored.correlation is not None
    assert anchored.correlation[0, 1] > 0.8  # both are proportional to the angular momentum


def test_held_parameter_serves_as_an_anchor(sweep: list[Recording]) -> None:
    held = least_squares(ROLL.change({"gravity_stiffness": 14500.0}), sweep[:1], support=SUPPORT, estimate=["inertia"])
    assert list(held.parameters) == ["inertia"]
    assert abs(error(held, "inertia")) < 0.02
    free = least_squares(ROLL, sweep[:1], support=SUPPORT)
    assert held.parameters["inertia"].std > free.parameters["inertia"].std  # the held CAD value is that uncertain


@pytest.mark.parametrize("method", METHODS)
def test_time_offset_of_the_drives_is_estimated_and_does_not_bias_the_inertia(
    sweep: list[Recording], method: Method
) -> None:
    # The recorded age is 3 ms too small: the values were sampled 3 ms earlier than recorded.
    late = with_channels(sweep[0], drive_age=sweep[0]["drive_age"] - 0.003)
    estimate = method(ROLL, [late], support=SUPPORT)
    assert estimate.values["drive_offset"] == pytest.approx(-0.003, abs=0.0003)
    assert abs(error(estimate, "inertia")) < 0.01


@pytest.mark.parametrize("method", METHODS)
def test_gaps_and_unknown_values_do_not_bias_the_inertia(sweep: list[Recording], method: Method) -> None:
    kept = np.ones(len(sweep[0]), dtype=bool)
    kept[2000:2100] = False  # no bus traffic for 0.4 s
    speed = sweep[0]["precession_rate"].copy()
    speed[4000:4010] = np.nan
    estimate = method(ROLL, [part_of(with_channels(sweep[0], precession_rate=speed), kept)], support=SUPPORT)
    assert estimate.status is Status.OK
    assert abs(error(estimate, "inertia")) < 0.02


def test_result_is_complete_and_its_json_contains_no_nan(sweep: list[Recording]) -> None:
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


# --- no estimate, with a reason


def assert_unknown(estimate: Estimate, status: Status, words: str) -> None:
    assert estimate.status is status
    assert words in estimate.reason
    assert estimate.parameters["inertia"].value is None
    assert estimate.parameters["inertia"].std is None
    assert "NaN" not in json.dumps(estimate.to_json())


def test_standing_still_is_reported_as_too_little_excitation() -> None:
    stamps, table = small_vehicle.run(1, 6.0)
    recording = small_vehicle.recording(stamps, table, 0)
    plain = least_squares(ROLL, [recording], support=SUPPORT)
    assert_unknown(plain, Status.TOO_LITTLE_EXCITATION, "the term of inertia varies by")
    assert plain.parameters["inertia"].coverage_percent < 60.0
    instrumental = instrumental_variables(ROLL, [recording], support=SUPPORT)
    assert_unknown(instrumental, Status.TOO_LITTLE_EXCITATION, "excitation never moves")


def test_instrumental_variables_need_a_known_excitation(sweep: list[Recording]) -> None:
    missing = instrumental_variables(ROLL, [without(sweep[0], "excitation")], support=SUPPORT)
    assert_unknown(missing, Status.MISSING_CHANNEL, "channel excitation is missing")
    unknown = with_channels(sweep[0], excitation=np.full(len(sweep[0]), np.nan))
    assert_unknown(
        instrumental_variables(ROLL, [unknown], support=SUPPORT), Status.MISSING_CHANNEL, "unknown in 5249 of 5249"
    )
    other = instrumental_variables(ROLL, [unknown], support=SUPPORT, excitation="roll_reference")
    assert abs(error(other, "inertia")) < 0.01


def test_excitation_unrelated_to_the_motion_is_rejected_as_instrument(sweep: list[Recording]) -> None:
    # The motion is unchanged; the recorded excitation is unrelated to it.
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
        (lambda r: part_of(r, np.arange(len(r)) % 60 < 40), Status.TOO_FEW_SAMPLES, "gapless"),
        (lambda r: with_channels(r, roll=r["roll"] + 0.1), Status.TOO_FEW_SAMPLES, "free of its supports"),
    ],
)
def test_unusable_data_give_a_reason_instead_of_a_value(
    sweep: list[Recording], method: Method, change: Callable[[Recording], Recording], status: Status, words: str
) -> None:
    assert_unknown(method(ROLL, [change(sweep[0])], support=SUPPORT), status, words)


@pytest.mark.parametrize("method", METHODS)
def test_short_record_is_reported_as_too_few_samples(sweep: list[Recording], method: Method) -> None:
    short = part_of(sweep[0], np.arange(len(sweep[0])) < 200)
    assert_unknown(
        method(ROLL, [short], support=SUPPORT, bandwidth=10.0), Status.TOO_FEW_SAMPLES, "independent samples"
    )


def test_no_recordings_are_reported_as_too_few_samples() -> None:
    for method in METHODS:
        assert_unknown(method(ROLL, []), Status.TOO_FEW_SAMPLES, "")


def test_physically_impossible_values_are_not_reported(sweep: list[Recording]) -> None:
    # Angle and rate of the gimbals both have the wrong sign: no check of the channels can detect it.
    signs = {name: -sweep[0][name] for name in ("precession", "precession_rate", "precession_rate_setpoint")}
    estimate = least_squares(ROLL, [with_channels(sweep[0], **signs)], support=SUPPORT)
    assert_unknown(estimate, Status.AT_BOUND, "check signs and units")
    assert estimate.bounds_hit == ("inertia", "gravity_stiffness")


def test_amplitude_that_noise_drives_below_zero_is_reported_as_zero(sweep: list[Recording]) -> None:
    found = [least_squares(ROLL.add("asymmetric_friction"), [each], support=SUPPORT) for each in sweep]
    torques = [
        each.parameters[f"asymmetric_friction.torque_{way}"] for each in found for way in ("forward", "backward")
    ]
    assert all(torque.status is Status.OK and torque.value >= 0.0 for torque in torques)
    assert any(torque.value == 0.0 for torque in torques)
    assert any(each.bounds_hit for each in found)


def test_unanchored_scale_is_unidentifiable_and_names_the_confounded_inertia(sweep: list[Recording]) -> None:
    estimate = least_squares(DRIVEN.add("input_gain"), sweep[:1], support=SUPPORT)
    assert_unknown(estimate, Status.UNIDENTIFIABLE, "input_gain.gain")
    assert "inertia" in estimate.parameters["input_gain.gain"].reason


def test_two_delays_of_the_same_input_are_unidentifiable_and_name_each_other(sweep: list[Recording]) -> None:
    estimate = least_squares(DRIVEN.add("input_delay"), sweep[:1], support=SUPPORT)
    assert estimate.status is Status.UNIDENTIFIABLE
    assert "input_delay.delay" in estimate.parameters["drive_offset"].reason
    assert "drive_offset" in estimate.parameters["input_delay.delay"].reason
    assert abs(error(estimate, "inertia")) < 0.01
    assert estimate.correlation is not None
    assert np.isnan(estimate.correlation[2]).all()


def test_parameter_that_does_not_occur_in_the_balance_is_reported(sweep: list[Recording]) -> None:
    estimate = least_squares(ROLL.add("gyro_bias"), sweep[:1], support=SUPPORT)
    assert estimate.status is Status.UNIDENTIFIABLE
    assert "does not occur" in estimate.parameters["gyro_bias.bias"].reason
    assert abs(error(estimate, "inertia")) < 0.01


@pytest.mark.parametrize("bandwidth", [0.0, -1.0, float("nan")])
def test_invalid_bandwidth_is_refused(sweep: list[Recording], bandwidth: float) -> None:
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


def test_pendulum_parameters_are_recovered_without_a_measured_rate() -> None:
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
    # The reference is the excitation: it contains no noise, so it causes no attenuation.
    instrumental = instrumental_variables(model, [recording], excitation="position_reference")
    assert instrumental.values["inertia"] == pytest.approx(95.11, rel=0.02)
    assert instrumental_variables(model, [recording]).status is Status.MISSING_CHANNEL
