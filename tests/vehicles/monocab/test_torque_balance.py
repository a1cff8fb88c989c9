"""State-variable filter, recursive least squares and the torque balance, on synthetic data with fixed seeds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import small_vehicle
from hypothesis import given, settings
from hypothesis import strategies as st
from monocab_channels import MONOCAB
from numpy.typing import NDArray

from upright.estimators.contract import Estimate, EstimationError, Status
from upright.estimators.data.state_variable_filter import StateVariableFilter
from upright.estimators.recursive.least_squares import Prior, RecursiveLeastSquares, Solution, continue_autocovariance
from upright.telemetry.samples import Frame
from upright.vehicles.monocab.identification.torque_balance import Method, TorqueBalance, TorqueBalanceConfig
from upright.vehicles.monocab.identification.torque_balance import make as make_from

make = partial(make_from, channels=MONOCAB)
Array = NDArray[np.float64]

CAD = {
    "inertia": 1450.0,
    "gravity_stiffness": 12600.0,
    "angular_momentum": 3300.0,
    "trim_mass": 500.0,
    "trim_height": 0.4,
}
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0, "static_torque.torque": 40.0}
SUPPORT = float(np.radians(4.0))


# --- the state-variable filter


@pytest.mark.parametrize("order", [2, 3, 4, 5])
def test_filter_gives_the_butterworth_response_and_its_derivatives_at_uneven_spacing(order: int) -> None:
    bandwidth, frequency = 30.0, 12.0
    random = np.random.default_rng(1)
    time = np.cumsum(random.uniform(0.0005, 0.0015, 4000))
    svf = StateVariableFilter(1, bandwidth, order)
    svf.start([np.cos(frequency * time[0])])
    for before, now in pairwise(time):
        svf.update(now - before, [np.cos(frequency * now)])
    poles = bandwidth * np.exp(1j * np.pi * (2 * np.arange(order) + order + 1) / (2 * order))
    response = bandwidth**order / np.prod(1j * frequency - poles)
    for derivative, value in enumerate(svf.outputs()[:, 0]):
        expected = ((1j * frequency) ** derivative * response * np.exp(1j * frequency * time[-1])).real
        assert value == pytest.approx(expected, abs=1e-4 * frequency**derivative)  # first-order hold: (w dt)^2 / 12


def test_filter_is_exact_from_its_first_sample() -> None:
    # x = 2 + 3 t: the filtered derivative must equal 3 times the filtered constant at every time, transient or not.
    svf = StateVariableFilter(1, 20.0)
    svf.start([2.0])
    for step in range(1, 200):
        svf.update(0.01, [2.0 + 3.0 * 0.01 * step])
        outputs = svf.outputs()
        assert outputs[1, 0] == pytest.approx(3.0 * outputs[0, 1], abs=1e-9)
    assert svf.outputs()[0, 1] == pytest.approx(1.0, abs=1e-3)


def test_signals_sampled_at_different_times_are_aligned() -> None:
    early, late = StateVariableFilter(1, 30.0), StateVariableFilter(1, 30.0)
    early.start([0.0])
    late.start([0.0])
    for step in range(1, 500):
        early.update(0.004, [np.sin(12.0 * 0.004 * step)])
    for step in range(1, 501):
        late.update(0.004 if step < 500 else 0.003, [np.sin(12.0 * (0.004 * min(step, 499) + 0.003 * (step == 500)))])
    assert early.outputs(0.003)[0, 0] == pytest.approx(late.outputs()[0, 0], abs=1e-6)
    assert abs(early.outputs()[0, 0] - late.outputs()[0, 0]) > 1e-3


@pytest.mark.parametrize(
    ("bandwidth", "order", "what"), [(10.0, 1, "order 1"), (0.0, 4, "bandwidth 0"), (-1.0, 4, "-1")]
)
def test_invalid_filter_order_or_bandwidth_is_refused(bandwidth: float, order: int, what: str) -> None:
    with pytest.raises(EstimationError, match=what) as caught:
        StateVariableFilter(1, bandwidth, order)
    assert caught.value.remedy


# --- the regression


def coloured_regression(seed: int, samples: int, pole: float) -> RecursiveLeastSquares:
    """y = 3 a - 2 b + 0.5 with regressors and a disturbance that are both slow."""
    random = np.random.default_rng(seed)
    regression = RecursiveLeastSquares(3, lags=120, order=10)
    a = b = disturbance = 0.0
    for _ in range(samples):
        noise = random.standard_normal(3)
        a, b = 0.95 * a + noise[0], 0.9 * b + noise[1]
        disturbance = pole * disturbance + noise[2]
        regression.update(3.0 * a - 2.0 * b + 0.5 + disturbance, (a, b, 1.0))
    return regression


@given(st.lists(st.floats(-5.0, 5.0), min_size=3, max_size=3), st.integers(0, 2**31))
@settings(max_examples=25, deadline=None)
def test_recursion_agrees_with_batch_least_squares(parameters: list[float], seed: int) -> None:
    random = np.random.default_rng(seed)
    matrix = random.standard_normal((40, 3)) * (1.0, 1e3, 1e-3)
    output = matrix @ parameters + 0.1 * random.standard_normal(40)
    regression = RecursiveLeastSquares(3)
    for row, value in zip(matrix, output, strict=True):
        regression.update(value, row)
    expected = np.linalg.lstsq(matrix, output, rcond=None)[0]
    solution = regression.solve()
    np.testing.assert_allclose(solution.values * (1.0, 1e3, 1e-3), expected * (1.0, 1e3, 1e-3), rtol=1e-6, atol=1e-8)
    assert (np.diagonal(solution.covariance) > 0.0).all()


def test_confidence_intervals_cover_the_truth_with_slow_disturbances() -> None:
    # 40 records: 95 % intervals of 3 parameters; 120 correlated draws cover 88 to 100 % with near certainty. The
    # textbook covariance, which assumes independent residuals, covers about half.
    covered, textbook = [], []
    for seed in range(40):
        solution = coloured_regression(seed, 1500, 0.95).solve()
        error = np.abs(solution.values - (3.0, -2.0, 0.5))
        covered.append(error < 1.96 * np.sqrt(np.diagonal(solution.covariance)))
        textbook.append(error < 1.96 * solution.residual_std / (solution.movement * np.sqrt(solution.samples)))
    assert 0.88 <= np.mean(covered) <= 1.0
    assert np.mean(textbook) < 0.75


def test_noise_free_regression_is_solved_exactly() -> None:
    regression = RecursiveLeastSquares(2, lags=10)
    for step in range(50):
        regression.update(4.0 * step - 7.0, (step, 1.0))
    solution = regression.solve()
    np.testing.assert_allclose(solution.values, (4.0, -7.0), rtol=1e-9)
    assert np.isfinite(solution.covariance).all()


def test_collinear_regressors_have_no_independent_movement() -> None:
    regression = RecursiveLeastSquares(3, lags=5)
    for step in range(100):
        regression.update(np.sin(step), (np.sin(step), -2.0 * np.sin(step), 1.0))
    solution = regression.solve()
    assert solution.movement[0] == 0.0
    assert solution.movement[1] == 0.0
    assert solution.movement[2] > 0.9


def test_regression_without_samples_determines_no_parameter() -> None:
    solution = RecursiveLeastSquares(2, lags=3).solve()
    assert (solution.movement == 0.0).all()
    assert np.isfinite(solution.values).all()


def test_lagged_products_are_not_formed_across_an_interruption() -> None:
    whole, parts = RecursiveLeastSquares(1, lags=1, order=1), RecursiveLeastSquares(1, lags=1, order=1)
    for step in range(20):
        if step % 2 == 0:
            parts.interrupt()
        for regression in (whole, parts):
            regression.update(float(step % 4), (1.0,))
    assert whole.solve().values == pytest.approx(parts.solve().values)
    assert whole.solve().covariance[0, 0] != pytest.approx(parts.solve().covariance[0, 0], rel=1e-3)


def test_extrapolated_autocovariance_never_exceeds_its_value_at_lag_zero() -> None:
    # A slow residual with rounding-sized errors: its autoregressive process is unstable and would grow without bound.
    random = np.random.default_rng(11)
    for _ in range(50):
        lags = np.arange(200)
        measured = 1e-11 * np.exp(-((lags / 40.0) ** 2)) + 1e-16 * random.standard_normal(len(lags))
        continued = continue_autocovariance(measured, 25)
        np.testing.assert_array_equal(continued[:26], measured[:26])
        assert np.abs(continued).max() <= measured[0]


def test_forgetting_tracks_a_change_and_its_covariance_stays_bounded() -> None:
    prior = Prior(values=np.array([1.0, 0.0]), std=np.array([5.0, 5.0]), residual_std=0.1)
    regression = RecursiveLeastSquares(2, memory=100.0, prior=prior)
    random = np.random.default_rng(3)
    for step in range(3000):
        slope = 2.0 if step < 1500 else 3.0
        x = random.standard_normal()
        regression.update(slope * x + 1.0 + 0.1 * random.standard_normal(), (x, 1.0))
    assert regression.solve().values == pytest.approx((3.0, 1.0), abs=0.05)
    for _ in range(20_000):  # no excitation for 200 time constants
        regression.update(0.0, (0.0, 0.0))
    std = np.sqrt(np.diagonal(regression.solve().covariance))
    assert (std <= 5.0 * 1.0001).all()
    assert regression.solve().values == pytest.approx((1.0, 0.0), abs=0.01)


def test_instruments_remove_the_bias_of_noisy_regressors() -> None:
    random = np.random.default_rng(5)
    plain, instrumental = RecursiveLeastSquares(2), RecursiveLeastSquares(2, instruments=3)
    for _ in range(4000):
        clean = random.standard_normal()
        measured = clean + 0.7 * random.standard_normal()
        output = 2.0 * clean + 1.0 + 0.1 * random.standard_normal()
        plain.update(output, (measured, 1.0))
        instrumental.update(output, (measured, 1.0), (clean, clean**3, 1.0))
    assert plain.solve().values[0] == pytest.approx(2.0 / 1.49, abs=0.06)  # attenuated by 1 / (1 + 0.7^2)
    assert instrumental.solve().values[0] == pytest.approx(2.0, abs=0.1)


def test_unusable_regression_settings_are_refused() -> None:
    with pytest.raises(EstimationError, match="2 are too few for 3 regressors"):
        RecursiveLeastSquares(3, instruments=2)
    with pytest.raises(EstimationError, match="grow without bound"):
        RecursiveLeastSquares(3, memory=100.0)


# --- the torque balance of the MONOCAB


def sweep_in(span: float) -> Callable[[float], float]:
    return partial(small_vehicle.sweep, span=span)


def estimates(method: Method, seeds: int, duration: float, **settings: Any) -> list[Estimate]:
    return estimates_of(method, *small_vehicle.run(seeds, duration, **settings))


def estimates_of(method: Method, stamps: NDArray[np.int64], table: dict[str, Array]) -> list[Estimate]:
    found = []
    seeds = table["roll"].shape[1]
    for seed in range(seeds):
        estimator = TorqueBalance(CAD, SUPPORT, channels=MONOCAB, method=method)
        for frame in small_vehicle.frames(stamps, table, seed):
            estimator.update(frame)
        found.append(estimator.result())
    return found


def errors(found: list[Estimate]) -> dict[str, tuple[Array, NDArray[np.bool_]]]:
    """Relative errors (absolute for the static torque, N m) and whether the 95 % interval contains the truth."""
    result = {}
    for name, truth in TRUTH.items():
        values = np.array([estimate.parameters[name].value for estimate in found], dtype=float)
        stds = np.array([estimate.parameters[name].std for estimate in found], dtype=float)
        scale = truth if name != "static_torque.torque" else 1.0
        result[name] = ((values - truth) / scale, np.abs(values - truth) < 1.96 * stds)
    return result


@pytest.fixture(scope="module")
def sweeps() -> dict[Method, list[Estimate]]:
    stamps, table = small_vehicle.run(3, 31.0, reference=sweep_in(30.0))
    return {method: estimates_of(method, stamps, table) for method in Method}


@pytest.mark.parametrize("method", list(Method))
def test_sweep_gives_inertia_and_stiffness_within_one_percent(
    sweeps: dict[Method, list[Estimate]], method: Method
) -> None:
    found = sweeps[method]
    assert all(estimate.status is Status.OK for estimate in found)
    errs = errors(found)
    assert np.abs(errs["inertia"][0]).max() < 0.01
    assert np.abs(errs["gravity_stiffness"][0]).max() < 0.01
    assert np.abs(errs["static_torque.torque"][0]).max() < 2.0
    # 9 intervals of 95 %: fewer than 7 contain the truth with a probability of 0.8 %
    assert sum(inside.sum() for _, inside in errs.values()) >= 7


@pytest.mark.parametrize("method", list(Method))
def test_step_from_rest_gives_inertia_and_stiffness_within_three_percent(method: Method) -> None:
    errs = errors(estimates(method, 4, 8.0, from_support=True))
    assert np.abs(errs["inertia"][0]).max() < 0.03
    assert np.abs(errs["gravity_stiffness"][0]).max() < 0.03
    # 12 intervals of 95 %: fewer than 9 contain the truth with a probability of 2e-4
    assert sum(inside.sum() for _, inside in errs.values()) >= 9


def test_gyro_noise_biases_the_plain_method_but_not_the_instrumental_one() -> None:
    noisy = small_vehicle.Truth(gyro_density=20 * 3.5e-5)
    stamps, table = small_vehicle.run(2, 31.0, noisy, reference=sweep_in(30.0))
    plain = errors(estimates_of(Method.PLAIN, stamps, table))["inertia"][0]
    instrumental = errors(estimates_of(Method.INSTRUMENTAL, stamps, table))["inertia"][0]
    assert (plain < -0.05).all()  # attenuated, as the paper found
    assert np.abs(instrumental).max() < 0.02


def test_alignment_works_at_another_sample_rate_and_with_jitter() -> None:
    errs = errors(estimates(Method.PLAIN, 2, 31.0, spacing=0.01, jitter=0.0005, reference=sweep_in(30.0)))
    assert np.abs(errs["inertia"][0]).max() < 0.01
    assert np.abs(errs["gravity_stiffness"][0]).max() < 0.02  # 100 Hz: 2.5 times the accelerometer's noise density


def test_uncertainty_of_the_angular_momentum_propagates_to_the_inertia() -> None:
    stamps, table = small_vehicle.run(1, 21.0, reference=sweep_in(20.0))
    results = []
    for deviations in ({}, {"angular_momentum": 33.0}):
        estimator = make(CAD, SUPPORT, deviations=deviations)
        for frame in small_vehicle.frames(stamps, table, 0):
            estimator.update(frame)
        results.append(estimator.result().parameters["inertia"])
    without_uncertainty, with_uncertainty = results
    assert without_uncertainty.value == with_uncertainty.value
    assert without_uncertainty.std is not None
    assert with_uncertainty.value is not None
    assert with_uncertainty.std == pytest.approx(np.hypot(without_uncertainty.std, 0.01 * with_uncertainty.value))


def frames_of_a_sweep(duration: float = 16.0) -> list[Frame]:
    stamps, table = small_vehicle.run(1, duration, reference=sweep_in(duration))
    return list(small_vehicle.frames(stamps, table, 0))


def changed(frame: Frame, name: str, value: float) -> Frame:
    values = list(frame.values)
    values[MONOCAB.index_of(name)] = value
    return replace(frame, values=tuple(values))


def test_gaps_unknown_values_and_repeated_frames_do_not_spoil_the_estimate() -> None:
    frames = frames_of_a_sweep()
    estimator = make(CAD, SUPPORT)
    for place, frame in enumerate(frames):
        if 1000 <= place < 1100:
            continue  # the bus was down for 0.4 s
        if place == 2000:
            frame = changed(frame, "precession_rate", float("nan"))
        estimator.update(frame)
        if place == 3000:
            estimator.update(frame)  # twice
            estimator.update(frames[2900])  # and late
    result = estimator.result()
    assert result.status is Status.OK
    for name in ("inertia", "gravity_stiffness"):
        assert result.parameters[name].value == pytest.approx(TRUTH[name], rel=0.02)


@pytest.mark.parametrize("value", [float("nan"), 0.3])
def test_plain_method_ignores_excitation_reference_setpoint_and_phase(value: float) -> None:
    frames = frames_of_a_sweep()
    as_recorded, as_from_the_log = make(CAD, SUPPORT), make(CAD, SUPPORT)
    for frame in frames:
        as_recorded.update(frame)
        for name in ("excitation", "roll_reference", "precession_rate_setpoint", "phase"):
            frame = changed(frame, name, value)
        as_from_the_log.update(frame)
    assert as_recorded.result().status is Status.OK
    assert as_from_the_log.result() == as_recorded.result()


def test_instrumental_method_reports_the_missing_excitation() -> None:
    estimator = make(CAD, SUPPORT, method=Method.INSTRUMENTAL)
    for frame in frames_of_a_sweep(4.0):
        estimator.update(changed(frame, "excitation", float("nan")))
    result = estimator.result()
    assert result.status is Status.MISSING_CHANNEL
    assert "excitation is unknown in 1000 of 1000 control cycles" in result.reason
    assert Method.PLAIN.value in result.reason
    assert all(parameter.value is None and parameter.std is None for parameter in result.parameters.values())


@pytest.mark.parametrize("method", list(Method))
def test_intermediate_results_never_have_an_invalid_standard_deviation(method: Method) -> None:
    # Without noise the residual is little more than rounding error: an unstable extrapolation of its autocovariance
    # gave variances of -1e18 and 1e14 here.
    quiet = small_vehicle.Truth(gyro_density=0.0, accelerometer_roll_std=0.0)
    stamps, table = small_vehicle.run(1, 3.0, quiet, reference=lambda time: 0.01 * float(np.sin(1.885 * time)))
    estimator = TorqueBalance(CAD, SUPPORT, channels=MONOCAB, method=method)
    for frame in small_vehicle.frames(stamps, table, 0):
        estimator.update(frame)
        if frame.timestamp_ns % 20_000_000 == 0:
            for parameter in estimator.result().parameters.values():
                assert (parameter.std is None) == (parameter.status is not Status.OK)
                assert parameter.std is None or 0.0 <= parameter.std < 1e3


@pytest.mark.parametrize("variance", [-1e-9, float("inf"), float("nan")])
def test_invalid_variance_is_reported_as_a_reason(monkeypatch: pytest.MonkeyPatch, variance: float) -> None:
    estimator = make(CAD, SUPPORT)
    for frame in frames_of_a_sweep():
        estimator.update(frame)
    solve = RecursiveLeastSquares.solve

    def solved(self: RecursiveLeastSquares) -> Solution:
        solution = solve(self)
        return replace(solution, covariance=np.full_like(solution.covariance, variance))

    monkeypatch.setattr(RecursiveLeastSquares, "solve", solved)
    result = estimator.result()
    assert result.status is Status.TOO_FEW_SAMPLES
    assert "the deviation of inertia" in result.reason
    assert result.parameters["inertia"].value is None
    assert result.parameters["inertia"].std is None


def test_samples_on_the_support_are_not_used() -> None:
    stamps, table = small_vehicle.run(1, 5.0, from_support=True)
    frames = list(small_vehicle.frames(stamps, table, 0))
    resting = [frame for frame in frames if frame.values[0] > np.radians(3.8)]
    estimator = make(CAD, SUPPORT)
    for frame in resting:
        estimator.update(frame)
    result = estimator.result()
    assert result.status is Status.TOO_FEW_SAMPLES
    assert "supports" in result.reason
    assert result.span == 0.0
    assert all(parameter.value is None and parameter.std is None for parameter in result.parameters.values())


def test_result_without_samples_reports_that_there_was_no_control_cycle() -> None:
    result = make(CAD, SUPPORT).result()
    assert result.status is Status.TOO_FEW_SAMPLES
    assert "no control cycle" in result.reason


@pytest.mark.parametrize(("method", "words"), [(Method.PLAIN, "independently"), (Method.INSTRUMENTAL, "injected")])
def test_standing_still_is_reported_as_too_little_excitation(method: Method, words: str) -> None:
    (result,) = estimates(method, 1, 10.0)
    assert result.status is Status.TOO_LITTLE_EXCITATION
    assert words in result.reason
    inertia = result.parameters["inertia"]
    assert inertia.value is None
    assert inertia.coverage_percent < 60.0
    assert not inertia.identifiable


def test_gyro_with_the_wrong_sign_gives_an_implausible_status() -> None:
    estimator = make(CAD, SUPPORT)
    rate = MONOCAB.index_of("roll_rate")
    for frame in frames_of_a_sweep():
        estimator.update(changed(frame, "roll_rate", -frame.values[rate]))
    result = estimator.result()
    assert result.status is Status.IMPLAUSIBLE
    assert "sign" in result.reason
    assert result.parameters["inertia"].value is None


def test_run_after_reset_is_identical_bit_for_bit() -> None:
    frames = frames_of_a_sweep(8.0)
    estimator = make(CAD, SUPPORT)
    for frame in frames:
        estimator.update(frame)
    first = estimator.result()
    estimator.reset()
    assert estimator.result().samples == 0
    for frame in frames:
        estimator.update(frame)
    assert estimator.result() == first


def test_displaced_trim_mass_is_accounted_for_as_a_known_torque() -> None:
    stamps, table = small_vehicle.run(1, 21.0, reference=sweep_in(20.0))
    estimator = make(CAD, SUPPORT)
    place = 40.0 / (9.81 * 500.0)  # the trim mass alone causes all of the static torque
    for frame in small_vehicle.frames(stamps, table, 0):
        estimator.update(changed(frame, "trim_position", place))
    static = estimator.result().parameters["static_torque.torque"]
    assert static.value == pytest.approx(0.0, abs=2.0)


def test_estimator_with_forgetting_finds_the_inertia_within_2_percent() -> None:
    estimator = TorqueBalance(CAD, SUPPORT, channels=MONOCAB, config=TorqueBalanceConfig(memory=5.0))
    for frame in frames_of_a_sweep():
        estimator.update(frame)
    inertia = estimator.result().parameters["inertia"]
    assert inertia.value == pytest.approx(TRUTH["inertia"], rel=0.02)


@pytest.mark.parametrize("name", ["inertia", "gravity_stiffness", "angular_momentum", "trim_mass"])
def test_missing_parameter_is_named(name: str) -> None:
    with pytest.raises(EstimationError, match=name) as caught:
        make({key: value for key, value in CAD.items() if key != name}, SUPPORT)
    assert "vehicle file" in caught.value.remedy


def test_a_support_angle_that_leaves_no_free_range_is_refused() -> None:
    with pytest.raises(EstimationError, match="no free range"):
        make(CAD, float(np.radians(0.2)))


def test_estimate_json_has_null_instead_of_nan() -> None:
    document = make(CAD, SUPPORT).result().to_json()
    assert document["parameters"]["inertia"]["value"] is None
    assert document["parameters"]["inertia"]["identifiable"] is False
    assert document["status"] == "too_few_samples"
