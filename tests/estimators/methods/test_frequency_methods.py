"""Frequency response, output error and equation error: on arrays of known truth, and on the small closed loop."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import small_vehicle
from scipy.signal import lfilter

from upright.estimators.contract import Estimate, EstimationError, Status
from upright.estimators.data.segments import DataError
from upright.estimators.methods.balance import split
from upright.estimators.methods.frequency_equation_error import equation_fit, frequency_equation_error
from upright.estimators.methods.frequency_output_error import (
    Denominator,
    amplitude_fit,
    denominator_of,
    frequency_output_error,
    narrowed,
    usable,
)
from upright.estimators.methods.frequency_response import (
    Detrend,
    FrequencyResponse,
    cross_spectra,
    force_spectra,
    frequency_response,
    response,
)
from upright.models.library import get
from upright.models.library.axis import axis
from upright.models.model import Model
from upright.models.parts import Parameter
from upright.telemetry.channels import Channel, ChannelTable
from upright.telemetry.recording import Recording

Method = Callable[..., Estimate]
METHODS = [frequency_output_error, frequency_equation_error]
SUPPORT = float(np.radians(4.0))
TRUTH = {"inertia": 1650.0, "gravity_stiffness": 14500.0}
ROLL = get("monocab_roll").add("static_torque")
EXACT_ANCHORS = ROLL.change(deviations=dict.fromkeys(("angular_momentum", "trim_mass", "trim_height"), 0.0))


@pytest.fixture(scope="module")
def sweep() -> Recording:
    stamps, table = small_vehicle.run(1, 61.0, reference=small_vehicle.sweep)
    return small_vehicle.recording(stamps, table, 0)


def with_channels(recording: Recording, **channels: np.ndarray) -> Recording:
    return replace(recording, values={**recording.values, **channels})


def error(estimate: Estimate, name: str) -> float:
    value = estimate.parameters[name].value
    assert value is not None, estimate.reason
    return value / TRUTH[name] - 1.0


# --- the response


def noisy_system(seed: int) -> np.ndarray:
    """(n, 2) force and coordinate of y' = -5 y + 5 u, sampled every 10 ms, with white noise on y."""
    random = np.random.default_rng(seed)
    force = random.standard_normal(12_000)
    pole = np.exp(-0.05)
    coordinate = lfilter([0.0, 1.0 - pole], [1.0, -pole], force)
    return np.stack((force, coordinate + 0.05 * random.standard_normal(len(force))), axis=1)


def test_response_and_its_standard_deviations_are_correct() -> None:
    covered_magnitude, covered_phase = [], []
    pole = np.exp(-0.05)
    for seed in range(4):
        found = response(cross_spectra([noisy_system(seed)], 0.01, 400, Detrend.NONE), 0, 1)
        at = (found.frequency > 0.5) & (found.frequency < 5.0)
        turn = np.exp(-2j * np.pi * found.frequency * 0.01)
        truth = (1.0 - pole) * turn / (1.0 - pole * turn)
        assert np.abs(found.response / truth - 1.0)[at].max() < 0.25
        covered_magnitude.append((np.abs(np.abs(found.response) - np.abs(truth)) < 1.96 * found.magnitude_std)[at])
        covered_phase.append((np.abs(np.angle(found.response / truth)) < 1.96 * found.phase_std)[at])
    # 4 x 17 frequencies with correlated neighbours: about 35 independent intervals of 95 %. Fewer than 85 % of them
    # contain the truth with a probability of 1 %.
    assert np.mean(covered_magnitude) >= 0.85
    assert np.mean(covered_phase) >= 0.85
    assert found.averages == pytest.approx(2 * 12_000 / 400, rel=0.1)  # independent Hann windows in the record
    assert np.all((found.coherence >= 0.0) & (found.coherence <= 1.0))


def test_power_matches_that_of_the_signal() -> None:
    sine = 2.0 * np.sin(2.0 * np.pi * 3.0 * 0.01 * np.arange(4000))
    spectra = cross_spectra([np.stack((sine, sine), axis=1)], 0.01, 400, Detrend.NONE)
    found = response(spectra, 0, 1)
    assert np.sum(found.power) == pytest.approx(2.0, rel=0.01)
    assert found.frequency[np.argmax(found.power)] == pytest.approx(3.0)


def test_direct_form_is_biased_in_closed_loop_and_joint_form_is_not() -> None:
    # y = 0.5 u(-1) + disturbance, u = r - 0.8 y: if the disturbance is as large as r, direct tends to -1 / 0.8.
    random = np.random.default_rng(3)
    reference, disturbance = random.standard_normal((2, 40_000))
    table = np.zeros((40_000, 3))
    force = 0.0
    for row in range(40_000):
        coordinate = 0.5 * force + disturbance[row]
        force = reference[row] - 0.8 * coordinate
        table[row] = force, coordinate, reference[row]
    spectra = cross_spectra([table], 0.01, 256, Detrend.NONE)
    at = spectra.frequency < 5.0
    truth = 0.5 * np.exp(-2j * np.pi * spectra.frequency[at] * 0.01)
    direct, joint = response(spectra, 0, 1), response(spectra, 0, 1, reference=2)
    assert np.abs(np.mean(direct.response[at] - truth)) > 0.3
    assert np.abs(np.mean(joint.response[at] - truth)) < 0.1  # 4 of its standard deviations
    assert "biased" in direct.form
    assert "not biased" in joint.form
    within = np.abs(np.abs(joint.response[at]) - np.abs(truth)) < 1.96 * joint.magnitude_std[at]
    assert np.mean(within) > 0.8


def test_standard_deviation_includes_leakage_that_coherence_does_not_show() -> None:
    # A noise-free step of a slow system: every window gives the same response, which depends on the window's length.
    force = np.where(np.arange(4000) < 3000, 0.0, 1.0)
    table = np.stack((force, lfilter([0.0, 0.001], [1.0, -0.999], force)), axis=1)
    spectra = cross_spectra([table], 0.01, 1000, Detrend.NONE)
    plain = response(spectra, 0, 1)
    with_leakage = response(replace(spectra, half=cross_spectra([table], 0.01, 500, Detrend.NONE)), 0, 1)
    np.testing.assert_array_equal(plain.response, with_leakage.response)
    truth = 0.001 / (np.exp(2j * np.pi * plain.frequency * 0.01) - 0.999)
    off = np.abs(plain.response - truth)[2:20]  # the constant before the step is in the two lowest bins
    assert np.max(off / plain.magnitude_std[2:20]) > 3.0
    assert np.max(off / with_leakage.magnitude_std[2:20]) < 2.0


@pytest.mark.parametrize("detrend", [Detrend.MEAN, Detrend.LINEAR])
def test_detrending_removes_a_constant_or_a_drift_completely(detrend: Detrend) -> None:
    table = noisy_system(2)
    shifted = table + 5.0 + (0.01 * np.arange(len(table))[:, None] if detrend is Detrend.LINEAR else 0.0)
    clean, found = (response(cross_spectra([each], 0.01, 400, detrend), 0, 1) for each in (table, shifted))
    np.testing.assert_allclose(found.response, clean.response, rtol=1e-6, atol=1e-9)
    assert found.frequency[0] == pytest.approx(2 / 4.0)  # no result in the bins from which power was removed


def test_monocab_response_matches_that_of_the_vehicle(sweep: Recording) -> None:
    found = frequency_response(ROLL, [sweep], support=SUPPORT, excitation="excitation", detrend="mean")
    at = (found.frequency > 0.2) & (found.frequency < 2.0)
    truth = 1.0 / (1650.0 * (2j * np.pi * found.frequency) ** 2 - 14500.0)
    assert np.abs(found.response / truth - 1.0)[at].max() < 0.05
    assert np.all(found.coherence[at] > 0.9)


# --- fits to a known response


FREQUENCY = np.linspace(0.1, 3.0, 30)
PARAMETERS = tuple(get("monocab_roll").parameter(name) for name in TRUTH)
ROLLING = Denominator(tuple(TRUTH), np.zeros(3), np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]]), {})


def exact(denominator: Denominator, values: list[float], relative: float = 0.01) -> FrequencyResponse:
    known, terms = denominator.at(FREQUENCY)
    found = 1.0 / (known + terms @ values)
    size = np.full(len(FREQUENCY), relative)
    return FrequencyResponse(
        FREQUENCY, found, 1.0 - size**2, size * np.abs(found), size, np.ones_like(size), 10.0, "made up"
    )


@pytest.mark.parametrize("solver", [amplitude_fit, equation_fit])
def test_exact_response_is_fitted_exactly(solver: Callable[..., object]) -> None:
    fit = solver(ROLLING, exact(ROLLING, [1650.0, 14500.0]), PARAMETERS)
    assert fit.converged
    np.testing.assert_allclose(fit.values, (1650.0, 14500.0), rtol=1e-4)


@pytest.mark.parametrize(
    ("known", "terms", "values"),
    [
        ((0.0, 0.0, 0.0), [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)], [95.0, 203.0]),  # no stiffness to divide by
        ((-14500.0, 0.0, 0.0), [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0)], [1650.0, 400.0]),  # the stiffness is known
        ((0.0, 0.0, 0.0), [(0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (2.0, 0.0, 0.0)], [0.3, 0.1, 4.0]),
        ((0.0, 0.0, 0.0), [(0.0, 0.0, 1.0), (1.0, 0.5, 0.0)], [0.3, 2.0]),
    ],
)
def test_other_denominators_are_fitted_by_equation_error(
    known: tuple[float, ...], terms: list[tuple[float, ...]], values: list[float]
) -> None:
    names = tuple("abc"[: len(values)])
    denominator = Denominator(names, np.array(known), np.array(terms), {})
    parameters = [Parameter(name, "1", value) for name, value in zip(names, values, strict=True)]
    fit = equation_fit(denominator, exact(denominator, values), parameters)
    np.testing.assert_allclose(fit.values, values, rtol=1e-6)


@pytest.mark.parametrize("solver", [amplitude_fit, equation_fit])
def test_standard_deviations_match_the_scatter_of_many_draws(solver: Callable[..., object]) -> None:
    random = np.random.default_rng(6)
    clean = exact(ROLLING, [1650.0, 14500.0], relative=0.02)
    values, stds = [], []
    for _ in range(200):
        white = random.standard_normal((len(FREQUENCY), 2)) @ (1.0, 1j)
        fit = solver(ROLLING, replace(clean, response=clean.response + clean.magnitude_std * white), PARAMETERS)
        values.append(fit.values)
        stds.append(np.sqrt(np.diag(fit.covariance)))
    scatter = np.std(values, axis=0)
    # Errors are independent here. Those of neighbouring bins of a Hann window may add up, which the standard deviations
    # account for: up to 1.4.
    assert np.all(np.mean(stds, axis=0) > 0.95 * scatter)
    assert np.all(np.mean(stds, axis=0) < 1.6 * scatter)


# --- the MONOCAB


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("settings", [{}, {"excitation": "excitation", "detrend": "mean"}])
def test_sweep_gives_inertia_and_stiffness_within_three_percent(
    sweep: Recording, method: Method, settings: dict[str, str]
) -> None:
    estimate = method(ROLL, [sweep], support=SUPPORT, **settings)
    assert estimate.status is Status.OK
    for name, truth in TRUTH.items():
        assert abs(error(estimate, name)) < 0.03
        assert abs(estimate.values[name] - truth) < 3.0 * estimate.parameters[name].std
    assert estimate.correlation is not None
    assert np.isfinite(estimate.correlation[:2, :2]).all()
    assert estimate.seconds > 0.0


def test_static_torque_is_neglected_and_the_reason_says_so(sweep: Recording) -> None:
    estimate = frequency_output_error(ROLL.add("coulomb_friction"), [sweep], support=SUPPORT)
    assert estimate.status is Status.OK  # this method is not expected to estimate them
    reasons = {name: p.reason for name, p in estimate.parameters.items() if p.value is None}
    assert "no transfer function contains it" in reasons["static_torque.torque"]
    assert "not linear in the motion" in reasons["coulomb_friction.torque"]
    assert "delay" in reasons["drive_offset"]


def test_static_torque_causes_the_papers_deviation_if_every_bin_is_used(sweep: Recording) -> None:
    # The constant gyro torque that balances 40 N m corresponds to no angle, so |G| is far too small in the lowest bins,
    # which dominate an unweighted sum of squares. The result is refused; its values would be far off.
    every = {"coherence": 0.0, "band": (0.0, 2.5)}
    refused = frequency_output_error(ROLL, [sweep], support=SUPPORT, **every)
    assert refused.status in (Status.UNIDENTIFIABLE, Status.TOO_LITTLE_EXCITATION)
    assert refused.parameters["inertia"].value is None
    spectra = force_spectra(split(ROLL), [sweep], support=SUPPORT)
    measured = response(spectra, 0, 1)
    all_bins = narrowed(measured, measured.frequency < 2.5)
    fit = amplitude_fit(denominator_of(split(ROLL)), all_bins, PARAMETERS)
    assert fit.values[0] < 0.85 * TRUTH["inertia"]
    assert fit.values[1] > 1.15 * TRUTH["gravity_stiffness"]
    # The weights of the equation error account for the uncertainty of these bins.
    weighted = frequency_equation_error(ROLL, [sweep], support=SUPPORT, **every)
    assert abs(error(weighted, "inertia")) < 0.03
    assert abs(error(weighted, "gravity_stiffness")) < 0.05


def test_uncertainty_of_the_anchor_is_propagated(sweep: Recording) -> None:
    for method in METHODS:
        exact_, doubtful = (
            method(EXACT_ANCHORS.change(deviations={"angular_momentum": std}), [sweep], support=SUPPORT, detrend="mean")
            for std in (0.0, 66.0)
        )
        sharp, anchored = exact_.parameters["inertia"], doubtful.parameters["inertia"]
        assert anchored.value == pytest.approx(sharp.value)
        assert anchored.std == pytest.approx(np.hypot(sharp.std, 0.02 * sharp.value), rel=0.05)


# --- other machines


def servo_axis(*effects: str) -> Model:
    model = axis(inertia=80.0, force_scale=10.0, position_scale=0.02, rate_scale=0.1, load="")
    for effect in effects:
        model = model.add(effect)
    return model


def test_servo_axis_without_stiffness_is_estimated() -> None:
    random = np.random.default_rng(8)
    spacing, steps = 0.005, 12_000
    pushed = np.repeat(20.0 * random.standard_normal(steps // 20), 20)
    position = rate = 0.0
    table = np.zeros((steps, 2))
    for row in range(steps):
        force = pushed[row] - 2000.0 * position
        table[row] = position, force
        for _ in range(5):
            change = spacing / 5 * (force - 200.0 * rate) / 95.0
            position += spacing / 5 * (rate + 0.5 * change)
            rate += change
    channels = ChannelTable((Channel("position", "m", ""), Channel("force", "N", "")))
    values = {"position": table[:, 0], "force": table[:, 1]}
    recording = Recording(channels, np.arange(steps) * 5_000_000, values)
    estimate = frequency_equation_error(servo_axis("viscous_friction"), [recording], detrend="mean")
    assert estimate.status is Status.OK
    assert estimate.values["inertia"] == pytest.approx(95.0, rel=0.03)
    assert estimate.values["viscous_friction.coefficient"] == pytest.approx(200.0, rel=0.1)


@pytest.mark.parametrize(
    ("model", "words"),
    [
        (servo_axis("static_torque").change(estimated=["static_torque.torque"]), "no estimated parameter is in its"),
        (replace(servo_axis(), joints=(replace(servo_axis().joints[0], load="0"),)), "no known force"),
    ],
)
def test_joint_without_a_transfer_function_is_refused(model: Model, words: str) -> None:
    model = replace(
        model, base_states=(model.base_states[0], replace(model.base_states[1], derivative="axis_force / inertia"))
    )
    with pytest.raises(EstimationError, match=words):
        frequency_output_error(model, [])


# --- no estimate, with a reason


def assert_unknown(estimate: Estimate, status: Status, words: str) -> None:
    assert estimate.status is status
    assert words in estimate.reason
    assert estimate.values == {}


@pytest.mark.parametrize("method", METHODS)
def test_standing_still_is_reported_as_too_little_excitation(method: Method) -> None:
    stamps, table = small_vehicle.run(1, 8.0)
    recording = small_vehicle.recording(stamps, table, 0)
    # Without an excitation, the controller's response to noise is coherent, but does not show the vehicle.
    assert_unknown(method(ROLL, [recording], support=SUPPORT), Status.TOO_LITTLE_EXCITATION, "the force moves by")
    joint = method(ROLL, [recording], support=SUPPORT, excitation="excitation")
    assert_unknown(joint, Status.TOO_LITTLE_EXCITATION, "the coherence is 0.8 or more")


@pytest.mark.parametrize(
    ("change", "settings", "status", "words"),
    [
        (lambda r: r, {"excitation": "push"}, Status.MISSING_CHANNEL, "channel push is missing"),
        (
            lambda r: with_channels(r, excitation=np.full(len(r), np.nan)),
            {"excitation": "excitation"},
            Status.MISSING_CHANNEL,
            "unknown in 15249 samples",
        ),
        (lambda r: r, {"window": 50.0}, Status.TOO_FEW_SAMPLES, "does not fit twice"),
        (lambda r: r, {"window": 0.0}, Status.TOO_FEW_SAMPLES, "does not fit twice"),
        (lambda r: r, {"band": (40.0, 50.0)}, Status.TOO_LITTLE_EXCITATION, "at 0 frequencies"),
        (
            lambda r: with_channels(r, roll_rate=np.degrees(r["roll_rate"])),
            {},
            Status.BAD_DATA,
            "degrees",
        ),
    ],
)
def test_unusable_data_give_a_reason_instead_of_a_value(
    sweep: Recording,
    change: Callable[[Recording], Recording],
    settings: dict[str, object],
    status: Status,
    words: str,
) -> None:
    for method in METHODS:
        assert_unknown(method(ROLL, [change(sweep)], support=SUPPORT, **settings), status, words)


def test_no_recording_and_unknown_detrending_are_refused() -> None:
    assert_unknown(frequency_output_error(ROLL, []), Status.TOO_FEW_SAMPLES, "none is given")
    with pytest.raises(EstimationError, match="none, mean, linear"):
        frequency_response(ROLL, [], detrend="cubic")


def test_response_of_the_wrong_sign_gives_no_values(sweep: Recording) -> None:
    signs = {name: -sweep[name] for name in ("precession", "precession_rate", "precession_rate_setpoint")}
    estimate = frequency_equation_error(ROLL, [with_channels(sweep, **signs)], support=SUPPORT)
    assert_unknown(estimate, Status.AT_BOUND, "check signs and units")
    assert estimate.bounds_hit == ("inertia", "gravity_stiffness")


def test_two_frequencies_are_too_few_for_two_parameters() -> None:
    measured = exact(ROLLING, [1650.0, 14500.0])
    with pytest.raises(DataError, match="3 are needed"):
        usable(narrowed(measured, np.arange(len(FREQUENCY)) < 2), None, 2, 0.0, 0.8)


def test_simplex_that_does_not_converge_gives_no_value(sweep: Recording, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("upright.estimators.methods.frequency_output_error.STEPS", 20)
    estimate = frequency_output_error(EXACT_ANCHORS, [sweep], support=SUPPORT)
    assert_unknown(estimate, Status.NOT_CONVERGED, "did not converge in 20 steps")
