"""The paper's estimation of the balancing robot, on recordings of the virtual robot, whose parameters are known."""

from __future__ import annotations

import json
import runpy
from dataclasses import replace
from functools import cache
from pathlib import Path

import golden
import numpy as np
import pytest
from typer.testing import CliRunner

from upright.estimators.contract import EstimationError, Status
from upright.estimators.data.segments import DataError, clipped_share, segments
from upright.estimators.fit.maximum_likelihood import Begin, Fit, fit
from upright.estimators.fit.problem import problem
from upright.estimators.identify.bounded_fit import RISE, BoundedFit, bounded_fit, profile, with_table
from upright.estimators.identify.combinations import combinations
from upright.estimators.identify.validation import in_windows, on_others
from upright.estimators.methods.prediction_error import predicted_percent, prediction_error
from upright.models.library import get
from upright.models.text.expressions import number
from upright.service.cli import app
from upright.simulation.twsbr.truth import TwsbrTruth
from upright.telemetry.recording import Recording
from upright.telemetry.storage import save
from upright.vehicles.twsbr.model import IDENTIFIABLE_NEAR_UPRIGHT

EXAMPLE = runpy.run_path(str(Path(__file__).parents[3] / "examples" / "estimate_robot.py"))
MODEL = get("twsbr")
PLANT = TwsbrTruth()
TRUTH = PLANT.table_1
SHORT = 8.0
"""s of excitation if accuracy does not matter."""


@cache
def run(name: str, seed: int = 1, seconds: float | None = None) -> Recording:
    return golden.recorded("twsbr", name, seed=seed, duration=seconds)


@cache
def reduced(seed: int) -> Fit:
    return fit(problem(MODEL, [run("square", seed)]))


@pytest.fixture(scope="module")
def complete() -> BoundedFit:
    return bounded_fit(MODEL, [run("square")])


# --- what a record near upright determines


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_identifiable_combinations_are_within_three_standard_deviations_of_the_truth(seed: int) -> None:
    """Six of them: one of eighteen would be beyond three standard deviations in 5 % of all such tests."""
    fitted = reduced(seed)
    assert fitted.minimum.converged
    for name, (value, std) in combinations(fitted, IDENTIFIABLE_NEAR_UPRIGHT).items():
        true = number(IDENTIFIABLE_NEAR_UPRIGHT[name], {**MODEL.values, **TRUTH}, name)
        assert abs(value - true) < 3.0 * std, name
        # Determined to a tenth, although held parameters are known only to a third (body_mass).
        assert std < 0.1 * abs(true), name


@pytest.mark.parametrize("seed", [907, 918])
def test_fit_of_identifiable_combinations_reaches_the_minimum_found_from_the_truth(seed: int) -> None:
    """Of 60 fits, the one that ended 58 nats from the others' minimum, and one that took 122 steps, because a rejected
    step turned the next ones out of the valley. One nat is well below the cost of moving a parameter by two standard
    deviations."""
    task = problem(MODEL, [run("square", seed).between(8.0)])
    fitted = fit(task)
    from_truth = fit(task, begin=Begin(TRUTH, fitted.end.noise))
    assert fitted.minimum.converged
    assert fitted.minimum.iterations < 100
    assert fitted.minimum.cost < from_truth.minimum.cost + 1.0


def test_combinations_include_the_uncertainty_of_held_parameters() -> None:
    found = combinations(reduced(1), {"alone": "com_height", "held": "body_mass", "moment": "body_mass * com_height"})
    assert found["held"][1] == pytest.approx(MODEL.parameter("body_mass").std)
    estimate = prediction_error(MODEL, [run("square")])
    assert estimate.status is Status.OK
    assert found["alone"] == pytest.approx(
        (estimate.parameters["com_height"].value, estimate.parameters["com_height"].std), rel=0.02
    )


@pytest.mark.parametrize("experiment", ["sine", "doublet", "sine_stream"])
def test_other_experiments_are_predicted_as_well_as_with_the_true_values(experiment: str) -> None:
    """Required: 95 % of what the noise allows, which is what the true values reach."""
    true = fit(problem(MODEL.change(TRUTH), [run("square")], estimate=["voltage_offset"]))
    best = predicted_percent(on_others(true, [run(experiment)]), 0.1)
    ours = predicted_percent(on_others(reduced(1), [run(experiment)]), 0.1)
    start = predicted_percent(on_others(reduced(1), [run(experiment)], values=MODEL.values), 0.1)
    for channel, percent in best.items():
        assert ours[channel] > 0.95 * percent, channel
    assert start["tilt_rate"] < ours["tilt_rate"]


def test_simulation_windows_begin_at_the_filtered_state(complete: BoundedFit) -> None:
    there = on_others(complete.fit, [run("sine")])
    simulated, measured = in_windows(there, 0.1)[0], there.problem.segments[0].measured
    assert simulated.shape == measured.shape
    known = np.isfinite(simulated[:, 2])
    assert known.mean() > 0.95
    assert np.sqrt(np.mean((simulated - measured)[known, 2] ** 2)) < 0.05 * np.std(measured[:, 2])


def test_command_estimates_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "square.arrow"
    save(run("square"), path)
    done = CliRunner().invoke(app, ["identify", str(path), "--vehicle", "twsbr", "--json"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    found = json.loads(done.stdout)["methods"]
    assert list(found) == ["prediction_error"]
    entry = found["prediction_error"]
    assert entry["status"] == "ok"
    assert set(entry["parameters"]) == {each.name for each in MODEL.parameters if each.estimated}
    assert all(each["std"] > 0.0 for each in entry["parameters"].values())


# --- all parameters of the paper


def test_complete_fit_ends_at_a_minimum_within_the_bounds(complete: BoundedFit) -> None:
    assert complete.fit.minimum.converged
    lower, upper = complete.fit.problem.bounds
    assert np.all((complete.values >= lower) & (complete.values <= upper))
    # Half a standard deviation of one parameter alone changes the log-likelihood by 1/8.
    assert complete.kkt_residual < 0.5
    assert len(complete.parameters) == 14
    assert complete.path.shape == (len(complete.costs), 14)
    assert np.all(np.diff(complete.costs) < 0.0)
    assert complete.path[0] == pytest.approx(complete.start, rel=1e-12)  # through logarithms and back


def test_complete_fit_reports_the_parameters_without_influence(complete: BoundedFit) -> None:
    """Near upright, six combinations and the voltages' offset are determined; getting up adds at most one more."""
    assert 7 <= complete.determined <= 8
    silent = {"wheel_distance", "yaw_inertia", "armature_inductance"}
    insensitive = {name for name, rise in zip(complete.parameters, complete.sensitivity, strict=True) if rise < 1e-9}
    assert insensitive == silent
    moved = dict(zip(complete.parameters, complete.values - complete.start, strict=True))
    assert all(abs(moved[name]) < 1e-6 for name in silent)


def test_profile_distinguishes_identifiable_from_unidentifiable_parameters(complete: BoundedFit) -> None:
    silent = profile(complete, "wheel_distance", points=1)
    assert np.all(silent.rises < RISE)
    assert silent.interval == (None, None)
    identified = profile(complete, "voltage_offset", points=1)
    assert identified.identifiable
    with pytest.raises(EstimationError, match="was not estimated"):
        profile(complete, "gear_ratio")


def test_example_draws_the_figures_of_the_paper(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recordings = {name: run(name, 1, SHORT) for name in EXAMPLE["EXPERIMENTS"]}
    found = EXAMPLE["estimate"](recordings, ["wheel_distance"])
    EXAMPLE["print_tables"](found)
    EXAMPLE["draw"](found, tmp_path)
    names = {"convergence", "sensitivity", "profiles", "9_square", "10_sine", "11_doublet", "12_sine_stream"}
    assert {path.stem for path in tmp_path.iterdir()} == names
    output = capsys.readouterr().out
    assert "damping by the motors" in output
    assert "bound to bound" in output


# --- bad input


@pytest.mark.parametrize(
    ("row", "words"),
    [
        ((0.05, 0.03, 0.04), "the start, 0.05 m, is outside 0.03 to 0.04"),
        ((0.035, 0.04, 0.03), "its bounds cross: 0.04 and 0.03 m"),
        ((float("nan"), 0.03, 0.04), "must be numbers"),
    ],
)
def test_invalid_table_is_refused(row: tuple[float, float, float], words: str) -> None:
    with pytest.raises(EstimationError, match=words):
        with_table(MODEL, {"wheel_radius": row})


def test_valid_table_is_applied_and_an_inconsistent_model_is_refused() -> None:
    model = with_table(MODEL, {"wheel_radius": (0.033, 0.032, 0.034)})
    radius = model.parameter("wheel_radius")
    assert (radius.value, radius.lower, radius.upper) == (0.033, 0.032, 0.034)
    with pytest.raises(EstimationError, match="outside"):
        bounded_fit(MODEL.change({"wheel_radius": 0.05}), [run("square")])
    crossed = [replace(each, lower=each.upper, upper=each.lower) for each in MODEL.base_parameters]
    with pytest.raises(EstimationError, match="bounds cross"):
        bounded_fit(replace(MODEL, base_parameters=tuple(crossed)), [run("square")])


def fallen(recording: Recording, after: float) -> Recording:
    """The recording, with a fall to one side from `after` s on that ends on the floor at 90 degrees."""
    time = recording.time
    late = np.flatnonzero(time > after)
    tilt, rate = recording["tilt"].copy(), recording["tilt_rate"].copy()
    begin, since = float(tilt[late[0]]), time[late] - time[late[0]]
    angle = begin + 0.01 * (np.cosh(7.0 * since) - 1.0)
    down = angle > 0.5 * np.pi
    tilt[late], rate[late] = np.where(down, 0.5 * np.pi, angle), np.where(down, 0.0, 0.07 * np.sinh(7.0 * since))
    return replace(recording, values={**recording.values, "tilt": tilt, "tilt_rate": rate})


def test_samples_after_a_fall_are_left_out() -> None:
    recording = fallen(run("square"), 20.0)
    (used,) = segments(MODEL, [recording])
    assert np.max(np.abs(used.measured[:, 0])) < np.radians(12.0)
    assert used.time[-1] < 21.0


def test_no_reading_is_interpolated_between_a_known_and_an_unknown_sample() -> None:
    """The wheels' angles are older than the sample: between the last known angle and the next there is no reading."""
    recording = run("square")
    known = recording.time <= 0.6 * recording.time[-1]
    hidden = {each.name: np.where(known, recording[each.name], np.nan) for each in MODEL.outputs}
    (used,) = segments(MODEL, [replace(recording, values={**recording.values, **hidden})])
    (whole,) = segments(MODEL, [recording])
    assert any(each.age in recording.values for each in MODEL.outputs)
    assert np.isfinite(used.measured).all()
    assert np.array_equal(used.measured, whole.measured[: len(used)])
    assert len(used) == np.count_nonzero(known & (recording.time >= used.time[0])) - 1


@pytest.mark.parametrize("begin", [8.0, 8.005, 8.01, 8.015])
def test_voltage_before_the_first_sample_is_taken_into_account(begin: float) -> None:
    """The voltage acts a millisecond late, so that of the previous sample acts on the first one. If it is not known,
    each of the first three samples of the tilt rate is off by 3 standard deviations. The mean square of 12 innovations
    with unit variance exceeds 2.74 one time in a thousand.
    """
    recording = run("square").between(begin)
    found = fit(problem(MODEL, [recording]))
    (used,) = found.problem.segments
    assert (used.earlier, used.time[0]) == (1, pytest.approx(recording.time[1]))
    errors = found.innovations()[0][:, found.problem.kernel.outputs.index("tilt_rate")]
    assert np.mean(errors[:12] ** 2) < 2.74 * np.mean(errors**2)


def test_segment_after_a_gap_includes_the_earlier_voltages() -> None:
    recording = run("square")
    free = (recording.time > 10.0) & (recording.time < 14.0)
    hidden = {each.name: np.where(free, recording[each.name], np.nan) for each in MODEL.outputs}
    (used,) = segments(MODEL, [replace(recording, values={**recording.values, **hidden})])
    assert used.earlier == 199, "what comes less than 1 s before, at 200 Hz"
    assert np.array_equal(used.row_knots[:, 0], used.time)
    assert np.array_equal(used.inputs[:, 0], recording["left_voltage"][np.isin(recording.time, used.knots[:, 0])])


def test_recorded_voltage_is_quantised_in_pwm_steps() -> None:
    steps = run("square")["left_voltage"] / PLANT.supply_voltage * PLANT.pwm_steps
    assert np.ptp(steps) > 100.0
    assert np.max(np.abs(steps - np.round(steps))) < 1e-3


def test_recording_of_a_robot_that_only_lies_is_refused() -> None:
    recording = run("square")
    lying = {**recording.values, "tilt": np.full(len(recording.time), np.radians(12.4))}
    with pytest.raises(DataError, match="free of its supports"):
        segments(MODEL, [replace(recording, values=lying)])


def test_encoder_that_reverses_is_not_clipped() -> None:
    angle = run("square")["left_wheel_angle"]
    known = angle[np.isfinite(angle)]
    assert clipped_share(known) == 0.0


def test_quantisation_is_not_clipping_but_a_clipped_quantised_signal_is() -> None:
    time = np.arange(0.0, 20.0, 0.005)
    swing = np.round(np.sin(2.0 * np.pi * 0.5 * time) / 0.009) * 0.009
    assert clipped_share(swing) == 0.0
    fast = np.round(20.0 * np.sin(2.0 * np.pi * 0.5 * time) / 0.009) * 0.009
    assert clipped_share(np.clip(fast, -16.0, 16.0)) > 0.3
