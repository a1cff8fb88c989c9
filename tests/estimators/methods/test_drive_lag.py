"""The drives' speed loops, from synthetic records of known truth and from the virtual vehicle; the apparent inertia."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import golden
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.signal import lfilter

from upright.estimators.contract import Estimate, EstimationError, ParameterEstimate, Status
from upright.estimators.methods.drive_lag import drive_lag as any_drive_lag
from upright.estimators.speed_loop import MODES, Loop, predict, windows_of
from upright.service.virtual.run import record
from upright.simulation.monocab.truth import PlantTruth
from upright.telemetry.errors import RecordingError
from upright.telemetry.recording import Recording, describe
from upright.vehicles.file import load
from upright.vehicles.monocab.identification.apparent_inertia import (
    apparent_inertia_estimate,
    measured_apparent_inertia,
)
from upright.vehicles.monocab.identification.own import GIMBALS

CHANNELS = ("precession_rate_setpoint", "precession_rate", "drive_age", "roll_rate")
FINE = 1e-4
"""s, the grid on which all times of the synthetic loop lie."""
LAG, OFFSET, REACTION, AGE, PERIOD = 0.032, 0.0013, 0.05, 0.0029, 0.004
TRUTH = PlantTruth()
MOMENTUM = (TRUTH.angular_momentum, 15.0)
INERTIA = ParameterEstimate(1650.0, 3.0, "kg m^2", Status.OK, 100.0)


def recording_of(time: np.ndarray, *columns: np.ndarray) -> Recording:
    values = dict(zip(CHANNELS, columns, strict=True))
    units = dict.fromkeys(CHANNELS, "")
    return Recording(describe(units), np.round(time * 1e9).astype(np.int64), values)


def matrices(loop: Loop) -> tuple[np.ndarray, np.ndarray]:
    """The loop in controllable form, x' = A x + b input; the first state is the response to the setpoint."""
    if loop is Loop.FIRST_ORDER:
        return np.array([[-1.0 / LAG]]), np.array([1.0 / LAG])
    tau = LAG / 4.0
    last = -np.array([1.0, 4.0 * tau, 8.0 * tau**2]) / (8.0 * tau**3)
    shape = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], last])
    return shape, np.array([0.0, 0.0, -last[0]])


def synthetic(loop: Loop, seconds: float = 6.0, late: float = 0.0) -> Recording:
    """Three steps and an oscillating vehicle, computed by matrix exponentials on the fine grid. Every 25th sample is
    taken `late`, as a share of the sampling period, and its setpoint sent then."""
    steps = round(seconds / FINE)
    fine = FINE * np.arange(steps + 1)
    every = round(PERIOD / FINE)
    places = every * np.arange(steps // every + 1)
    places[12::25] += round(late * every)
    time = fine[places]
    setpoint = 0.4 * ((time > 2.0).astype(float) - 2.0 * (time > 2.8) + 1.0 * (time > 3.5))
    roll_rate = 0.1 * np.sin(9.0 * time) + 0.02 * np.cos(31.0 * time)
    shape, drives = matrices(loop)
    held = np.interp(fine - OFFSET, time, np.arange(len(time)))
    held = setpoint[np.clip(np.floor(held + 1e-9).astype(int), 0, len(time) - 1)]
    sample = np.searchsorted(places, np.arange(steps + 1), side="right") - 1
    slope = np.append(np.diff(roll_rate) / np.diff(time), 0.0)[sample]
    size = len(shape)
    transition = expm(np.block([[shape, drives[:, None]], [np.zeros((1, size + 1))]]) * FINE)
    rate = np.empty(steps + 1)
    to_setpoint, to_load = np.zeros(size), np.zeros(size)
    for step in range(steps + 1):
        # The load's response to the roll acceleration is (1 + tau s) / (...): x1 + tau x2 of a copy of the loop.
        load = to_load[0] + (LAG / 4.0 * to_load[1] if size == 3 else 0.0)
        rate[step] = to_setpoint[0] - REACTION * load
        to_setpoint = transition[:size] @ np.append(to_setpoint, held[step])
        to_load = transition[:size] @ np.append(to_load, slope[step])
    sampled = np.interp(time - AGE, fine, rate)
    return recording_of(time, setpoint, sampled, np.full(len(time), AGE), roll_rate)


def with_rate(recording: Recording, change: Callable[[np.ndarray], np.ndarray]) -> Recording:
    return replace(recording, values={**recording.values, "precession_rate": change(recording["precession_rate"])})


drive_lag = partial(any_drive_lag, **GIMBALS)


@pytest.fixture(scope="module")
def clean() -> Recording:
    return synthetic(Loop.SYMMETRIC_OPTIMUM)


@pytest.fixture(scope="module")
def step() -> Recording:
    """A step from rest of the virtual vehicle."""
    return record("monocab", "step")


@pytest.mark.parametrize("loop", Loop)
def test_noise_free_record_gives_the_exact_values(loop: Loop) -> None:
    estimate = drive_lag([synthetic(loop)], loop=loop)
    assert estimate.status is Status.OK
    # Both sides are exact, except for sampling between two points of the fine grid.
    assert estimate.values == pytest.approx(
        {"speed_loop_lag": LAG, "setpoint_offset": OFFSET, "roll_reaction": REACTION}, rel=1e-3, abs=1e-6
    )
    assert estimate.fit_percent["precession_rate"] > 99.95


@pytest.mark.parametrize("loop", Loop)
def test_derivatives_match_finite_differences(clean: Recording, loop: Loop) -> None:
    windows = windows_of(clean, CHANNELS, 0.04)
    values = np.array((0.021, 0.0017, 0.03))
    _, slopes = predict(windows, MODES[loop], values)
    for place, size in enumerate((1e-6, 1e-7, 1e-5)):
        step = np.zeros(3)
        step[place] = size
        above, below = (predict(windows, MODES[loop], values + sign * step)[0] for sign in (1.0, -1.0))
        difference = (above - below) / (2.0 * size)
        scale = np.max(np.abs(slopes[:, place]))
        # A first-order response has a corner where the setpoint jumps: a sample that it passes has two slopes.
        smooth = np.abs(difference - slopes[:, place]) < 1e-4 * scale
        assert smooth.mean() > (0.999 if loop is Loop.SYMMETRIC_OPTIMUM else 0.98)


def test_standard_deviations_are_valid_for_correlated_residuals(clean: Recording) -> None:
    """40 records, noise correlated over 20 ms. Squares of normalised errors average 1 +- 0.45 (chi squared, 95 %).

    Three quarters of a second contain only some 20 independent values of that noise, so the standard deviations are up
    to 25 % too small.
    """
    errors = []
    for seed in range(40):
        noise = lfilter([0.002], [1.0, -0.8], np.random.default_rng(seed).standard_normal(len(clean)))
        found = drive_lag([with_rate(clean, lambda rate, noise=noise: rate + noise)]).parameters
        truths = (("speed_loop_lag", LAG), ("roll_reaction", REACTION))
        errors.append([(found[name].value - truth) / found[name].std for name, truth in truths])
    variance = np.mean(np.square(errors), axis=0)
    assert (variance > 0.55).all()
    assert (variance < 1.45 * 1.25**2).all()


def test_drive_at_its_torque_limit_does_not_bias_the_result(clean: Recording) -> None:
    time = clean.time
    stuck = (time > 2.83) & (time < 2.98)
    limited = with_rate(clean, lambda rate: np.where(stuck, 0.15, rate) + 2e-4 * np.sin(1e3 * time))
    values = drive_lag([limited]).values
    assert values["speed_loop_lag"] == pytest.approx(LAG, rel=0.01)
    assert values["roll_reaction"] == pytest.approx(REACTION, rel=0.02)


def test_gap_costs_samples_but_does_not_bias_the_lag(clean: Recording) -> None:
    kept = (clean.time < 2.1) | (clean.time > 2.3)
    cut = Recording(clean.channels, clean.timestamp_ns[kept], {n: v[kept] for n, v in clean.values.items()})
    estimate = drive_lag([cut])
    assert estimate.values["speed_loop_lag"] == pytest.approx(LAG, rel=1e-3)
    assert estimate.samples < drive_lag([clean]).samples


def test_samples_that_are_late_are_no_gap_and_their_setpoints_act_from_then_on() -> None:
    estimate = drive_lag([synthetic(Loop.SYMMETRIC_OPTIMUM, late=0.7)])
    assert estimate.values["speed_loop_lag"] == pytest.approx(LAG, rel=1e-3)
    assert estimate.values["roll_reaction"] == pytest.approx(REACTION, rel=0.01)


def test_lag_offset_and_reaction_of_the_virtual_vehicle_are_estimated(step: Recording) -> None:
    """The lag is 4 tau = 40 ms, the rest is the drives' own sampling. The reaction is that of the formula."""
    estimate = drive_lag([step])
    values = estimate.values
    lag = 4.0 * TRUTH.gimbal_time_constant
    assert values["speed_loop_lag"] == pytest.approx(lag, rel=0.02)
    assert values["setpoint_offset"] == pytest.approx(1e-3, abs=4e-4)
    added = TRUTH.angular_momentum * values["roll_reaction"]
    assert added == pytest.approx(1795.2 - 1650.0, rel=0.05)
    # A first-order lag has another shape: part of the lag is attributed to the offset.
    multisine = golden.recorded("monocab", "multisine", seed=1, duration=30.0)
    first_order = drive_lag([multisine], body_rate="", loop=Loop.FIRST_ORDER).values
    assert first_order["speed_loop_lag"] < 0.8 * lag
    assert first_order["setpoint_offset"] > 0.3 * lag


def test_apparent_inertia_of_the_virtual_vehicle(step: Recording) -> None:
    estimate, cad = drive_lag([step]), load("monocab").parameters.gimbal_inertia
    assert cad is not None
    lag, reaction = estimate.parameters["speed_loop_lag"], estimate.parameters["roll_reaction"]
    by_formula = apparent_inertia_estimate(INERTIA, lag, MOMENTUM, (TRUTH.gimbal_inertia, 0.0))
    assert by_formula.value == pytest.approx(1795.2, rel=0.005)
    by_cad = apparent_inertia_estimate(INERTIA, lag, MOMENTUM, (cad.value, cad.std))
    assert by_cad.value is not None
    assert by_cad.std is not None
    assert abs(by_cad.value - 1795.2) < 2.0 * by_cad.std
    measured = measured_apparent_inertia(INERTIA, reaction, MOMENTUM)
    assert measured.value == pytest.approx(1795.2, rel=0.005)
    assert measured.std is not None
    assert measured.std < by_cad.std


def test_standard_deviation_of_the_apparent_inertia_is_propagated() -> None:
    lag = ParameterEstimate(0.04, 0.002, "s", Status.OK, 80.0)
    found = apparent_inertia_estimate(INERTIA, lag, (3300.0, 30.0), (60.0, 6.0))
    draws = np.random.default_rng(0).standard_normal((4, 200_000))
    tau, momentum = (0.04 + 0.002 * draws[0]) / 4.0, 3300.0 + 30.0 * draws[1]
    sampled = 1650.0 + 3.0 * draws[2] + 8.0 * tau**2 * momentum**2 / (60.0 + 6.0 * draws[3])
    assert found.value == pytest.approx(1795.2, abs=1e-9)
    # Propagated to first order; with 10 % of gimbal inertia the second order contributes 1.5 %.
    assert found.std == pytest.approx(np.std(sampled), rel=0.03)
    assert found.coverage_percent == 80.0


def test_apparent_inertia_is_unknown_if_one_of_its_inputs_is() -> None:
    unknown = ParameterEstimate(None, None, "s", Status.TOO_LITTLE_EXCITATION, 12.0, "the setpoint never moves")
    found = apparent_inertia_estimate(INERTIA, unknown, MOMENTUM, (60.0, 6.0))
    assert (found.value, found.std, found.status) == (None, None, Status.TOO_LITTLE_EXCITATION)
    assert found.reason == "speed_loop_lag is not known: the setpoint never moves"
    assert measured_apparent_inertia(INERTIA, unknown, MOMENTUM).reason.startswith("roll_reaction is not known")
    assert measured_apparent_inertia(unknown, INERTIA, MOMENTUM).reason.startswith("inertia is not known")


@pytest.mark.parametrize(
    ("momentum", "gimbal"), [((0.0, 1.0), (60.0, 6.0)), ((3300.0, 1.0), (60.0, -1.0)), ((3300.0, 1.0), (math.nan, 1.0))]
)
def test_impossible_values_are_refused(momentum: tuple[float, float], gimbal: tuple[float, float]) -> None:
    lag = ParameterEstimate(0.04, 0.002, "s", Status.OK, 100.0)
    with pytest.raises(EstimationError, match="give it in"):
        apparent_inertia_estimate(INERTIA, lag, momentum, gimbal)


def assert_refused(estimate: Estimate, status: Status, words: str) -> None:
    assert estimate.status is status
    assert words in estimate.reason
    assert all(p.value is None and p.std is None and p.reason for p in estimate.parameters.values())


def test_setpoint_that_never_moves_is_reported_as_too_little_excitation(clean: Recording) -> None:
    still = replace(clean, values={**clean.values, "precession_rate_setpoint": np.full(len(clean), 0.2)})
    assert_refused(drive_lag([still]), Status.TOO_LITTLE_EXCITATION, "never moves")
    unknown = replace(clean, values={**clean.values, "precession_rate_setpoint": np.full(len(clean), np.nan)})
    assert_refused(drive_lag([unknown]), Status.TOO_LITTLE_EXCITATION, "never moves")
    assert_refused(drive_lag([]), Status.TOO_LITTLE_EXCITATION, "never moves")


def test_step_without_a_second_before_it_is_reported_as_too_few_samples(clean: Recording) -> None:
    late = clean.time > 3.2
    cut = Recording(clean.channels, clean.timestamp_ns[late], {n: v[late] for n, v in clean.values.items()})
    assert_refused(drive_lag([cut]), Status.TOO_FEW_SAMPLES, "1 s before it")


def test_rate_of_pure_noise_gives_no_lag_but_a_reason(clean: Recording) -> None:
    noise = np.random.default_rng(3).standard_normal(len(clean))
    found = drive_lag([with_rate(clean, lambda rate: noise)])
    assert found.parameters["speed_loop_lag"].value is None
    assert found.parameters["speed_loop_lag"].reason


def test_roll_reaction_is_unidentifiable_without_roll_motion(clean: Recording) -> None:
    quiet = replace(clean, values={**clean.values, "roll_rate": np.zeros(len(clean))})
    found = drive_lag([quiet])
    assert found.parameters["roll_reaction"].status is Status.UNIDENTIFIABLE
    assert drive_lag([quiet], body_rate="").parameters.keys() == {"speed_loop_lag", "setpoint_offset"}


def test_missing_channel_error_names_the_channel(clean: Recording) -> None:
    with pytest.raises(RecordingError, match="wheel_rate"):
        drive_lag([clean], rate="wheel_rate")
