"""The likelihood of a record: its derivatives, those of the Kalman gain, and passes with a varying gain."""

from __future__ import annotations

from dataclasses import replace

import golden
import numpy as np
import pytest

from upright.estimators.fit import innovations
from upright.estimators.fit.gauss_newton import common_information
from upright.estimators.fit.innovations import NoiseModel
from upright.estimators.fit.likelihood import Likelihood, _at_least, _products
from upright.estimators.fit.problem import Problem, problem
from upright.estimators.fit.stationary import stationary_all
from upright.models import library
from upright.models.compiler.kernel import ELSEWHERE
from upright.telemetry.recording import Recording


@pytest.fixture(scope="module")
def task() -> Problem:
    """Segments of an unstable vehicle, separated by unknown readings and by a gap."""
    recording = golden.recorded("monocab", "multisine", seed=5, duration=15.0)
    rate = recording["roll_rate"].copy()
    rate[2000:2010] = np.nan
    holes = replace(recording, values={**recording.values, "roll_rate": rate})
    return problem(
        library.get("monocab_reduced").add("static_torque"), [_part(holes, 0, 3400), _part(holes, 3500, 4800)]
    )


def _part(recording: Recording, first: int, last: int) -> Recording:
    values = {name: column[first:last] for name, column in recording.values.items()}
    return replace(recording, timestamp_ns=recording.timestamp_ns[first:last], values=values)


@pytest.fixture(scope="module")
def noise(task: Problem) -> NoiseModel:
    return NoiseModel.of(task)


def _values(task: Problem) -> np.ndarray:
    return task.values(1.03 * task.start)


def test_gain_derivatives_match_finite_differences(task: Problem, noise: NoiseModel) -> None:
    """Four-point differences of the gain itself: their error is some 1e-8 of the largest."""
    values, logarithms = _values(task), 0.3 * np.cos(np.arange(noise.size))
    found = noise.steady_state(values, logarithms, task.free, task.scale)
    assert found is not None
    gain, slopes = found.gain, found.slopes
    assert np.array_equal(gain, noise.gain(values, logarithms))

    def moved(column: int, steps: float) -> np.ndarray:
        there, also = values.copy(), logarithms.copy()
        if column < len(task.free):
            there[task.free[column]] += steps * task.scale[column]
        else:
            also[column - len(task.free)] += steps
        return noise.gain(there, also).ravel()

    for column in range(slopes.shape[1]):
        h = 1e-2
        near, far = (moved(column, each * h) - moved(column, -each * h) for each in (1.0, 2.0))
        expected = (8.0 * near - far) / (12.0 * h)
        if column < len(task.free):
            expected = expected / task.scale[column]
        assert slopes[:, column] == pytest.approx(
            expected, rel=1e-4, abs=1e-5 * float(np.max(np.abs(expected)) + 1e-300)
        )


def test_steady_state_and_likelihood_are_none_at_the_edge_of_stability(
    task: Problem, noise: NoiseModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A filter without correction of a constant state: its error never decays, and its covariance has no derivative.
    No real model is exactly at this edge; a fit that comes past it must step back, not end."""
    steady = innovations._steady

    def edge(*system: np.ndarray) -> innovations._Steady | None:
        found = steady(*system)
        assert found is not None
        states = len(found.transition)
        return replace(found, transition=np.eye(states), ahead=np.zeros_like(found.ahead))

    monkeypatch.setattr(innovations, "_steady", edge)
    assert noise.steady_state(_values(task), np.zeros(noise.size), task.free, task.scale) is None
    likelihood = Likelihood.of(task, np.zeros(len(task.free)))
    assert likelihood(likelihood.centre, [*task.own_start, np.zeros(0)]) is None


def test_sensitivity_with_a_varying_gain_is_the_sum_over_its_entries(task: Problem, noise: NoiseModel) -> None:
    """Derivatives with respect to the gain's entries (compared with differences in test_kernel) times those of the
    entries."""
    kernel, segment, values = task.kernel, task.segments[0], _values(task)
    found = noise.steady_state(values, np.zeros(noise.size), task.free, task.scale)
    assert found is not None
    gain, slopes = found.gain, found.slopes
    entries = range(
        len(kernel.parameters) + len(kernel.states), len(kernel.parameters) + len(kernel.states) + gain.size
    )
    active = (*task.free, *[ELSEWHERE] * noise.size)
    moving = kernel.run(segment, values, task.initials[0], gain=gain, gain_slopes=slopes, active=active).sensitivity
    apart = kernel.run(segment, values, task.initials[0], gain=gain, active=(*task.free, *entries)).sensitivity
    expected = apart[:, :, len(task.free) :] @ slopes
    expected[:, :, : len(task.free)] += apart[:, :, : len(task.free)]
    assert np.max(np.abs(moving - expected)) < 1e-11 * np.max(np.abs(expected))


def test_likelihood_gradient_matches_finite_differences(task: Problem) -> None:
    """Central differences with respect to parameters, noise and initial states: for 10,000 samples their error is some
    1e-5."""
    likelihood = Likelihood.of(task, np.array([parameter.std for parameter in task.parameters]))
    size = np.concatenate((task.scale, np.ones(likelihood.noise.size)))
    common = likelihood.centre + 0.02 * size
    common[: len(task.free)] = np.clip(common[: len(task.free)], *task.bounds)
    spread = np.array([task.model.states[state].initial_std for state in task.own])
    own = [part + 0.5 * spread for part in task.own_start]
    seen = likelihood(common, [*own, np.zeros(0)])
    assert seen is not None
    gradient = sum(normal.vector[: len(size)] for normal in seen.normals)
    curvature = common_information(seen.normals, len(size))
    for column in range(len(size)):
        step = np.zeros(len(size))
        step[column] = 1e-2 / np.sqrt(curvature[column, column])
        above, below = (likelihood(common + each, [*own, np.zeros(0)]) for each in (step, -step))
        assert above is not None
        assert below is not None
        slope = (above.cost - below.cost) / (2.0 * step[column])
        assert gradient[column] == pytest.approx(slope, rel=1e-3, abs=1e-2 * np.sqrt(curvature[column, column]))
    for column in range(len(spread)):
        moved = [part.copy() for part in own]
        costs = []
        for sign in (1.0, -1.0):
            moved[1][column] = own[1][column] + sign * 1e-2 * spread[column]
            there = likelihood(common, [*moved, np.zeros(0)])
            assert there is not None
            costs.append(there.cost)
        slope = (costs[0] - costs[1]) / (2e-2 * spread[column])
        assert seen.normals[1].vector[len(size) + column] == pytest.approx(slope, rel=1e-3, abs=1e-2 / spread[column])


def test_covariance_is_that_of_the_innovations(task: Problem) -> None:
    likelihood = Likelihood.of(task, np.zeros(len(task.free)))
    seen = likelihood(likelihood.centre, [*task.own_start, np.zeros(0)])
    assert seen is not None
    errors = np.concatenate(
        [
            segment.measured - task.kernel.run(segment, task.values(task.start), start, gain=seen.gain).predicted
            for segment, start in zip(task.segments, task.initials, strict=True)
        ]
    )
    known = np.where(np.isfinite(errors), errors, 0.0)
    added = seen.covariance - known.T @ known / len(known)
    assert np.all(np.diag(added) > -1e-12 * np.diag(seen.covariance))
    assert added == pytest.approx(np.diag(np.diag(added)), abs=1e-12 * float(np.max(seen.covariance)))


# --- counted outputs (encoders)


def _cost(covariance: np.ndarray, squares: np.ndarray) -> float:
    return float(np.linalg.slogdet(covariance)[1] + np.trace(np.linalg.solve(covariance, squares)))


def test_two_encoders_that_count_simultaneously_do_not_affect_another_sensor() -> None:
    """Both wheels turn identically: their readings differ by 1e-5 of a count, which is correlated with the gyro's noise
    by chance. If that correlation were kept while the difference is given a quantiser's variance, the gyro would seem a
    thousand times worse."""
    random = np.random.default_rng(1)
    gyro, wheel = random.standard_normal((2, 5000))
    errors = np.stack([1e-3 * gyro, wheel, wheel + 1e-5 * random.standard_normal(5000) + 1e-6 * gyro], axis=1)
    squares = errors.T @ errors / 5000
    found = _at_least(squares, np.array([0.0, 0.25, 0.25]))
    assert found[0] == pytest.approx(squares[0])
    difference = np.array([0.0, 1.0, -1.0]) / np.sqrt(2.0)
    assert difference @ found @ difference == pytest.approx(0.25)


def test_constrained_covariance_is_the_likeliest_of_those_allowed() -> None:
    """The allowed covariances are a convex set, so a step towards any of them reduces the likelihood."""
    random = np.random.default_rng(2)
    mixed = random.standard_normal((4, 4))
    squares, least = mixed @ np.diag([1e-4, 0.1, 1.0, 3.0]) @ mixed.T, np.array([0.0, 0.4, 0.4, 0.0])
    found = _at_least(squares, least)
    assert np.all(np.linalg.eigvalsh(found) > 0.0)
    for _ in range(200):
        other = random.standard_normal((4, 4))
        allowed = _at_least(squares + 0.1 * other @ other.T, least)
        assert _cost(0.99 * found + 0.01 * allowed, squares) >= _cost(found, squares) - 1e-9
    assert _cost(found, squares) > _cost(squares, squares)


def test_stationary_covariance_is_kept_when_that_of_another_noise_has_not_settled() -> None:
    """The first settles in a few doublings, the other needs a hundred thousand samples. By then, the powers of a state
    that doubles with each sample overflow, although nothing drives it."""
    transition = np.diag([2.0, 0.5, 0.9999])
    fast, _ = stationary_all(transition, np.array([np.diag([0.0, 1.0, 0.0]), np.diag([0.0, 0.0, 1.0])]))
    assert np.allclose(fast, np.diag([0.0, 1.0 / (1.0 - 0.25), 0.0]))


def test_derivatives_that_run_away_do_not_hide_those_of_the_other_samples() -> None:
    """More samples never make a standard deviation larger, if nothing is lost in rounding, as in a QR decomposition."""
    rows = np.random.default_rng(3).standard_normal((2000, 5))
    away = slice(700, 716)
    rows[700:715] += np.outer(10.0 ** np.arange(15), (1.0, -2.0, 0.5, 3.0, 1.0))
    rows[715] = 1e29  # a pass with more is said to diverge
    all_samples, others = (_deviations(np.delete(rows, each, axis=0)) for each in (715, away))

    known = np.delete(rows, 715, axis=0)
    assert np.linalg.matrix_rank(known.T @ known) == 1, "nothing is lost in this example"
    found = np.sqrt(np.diag(np.linalg.inv(_products(part := rows.copy()))))
    assert np.all(0.99 * all_samples < found)
    assert np.all(found < 1.01 * others)
    assert set(np.flatnonzero(~part.any(axis=1))) <= set(range(700, 716))


def _deviations(rows: np.ndarray) -> np.ndarray:
    return np.asarray(np.linalg.norm(np.linalg.inv(np.linalg.qr(rows)[1]), axis=1))


def test_no_sample_of_an_ordinary_record_is_left_out(task: Problem) -> None:
    values = task.values(task.start)
    active = task.free
    for segment, initial, part in zip(task.segments, task.initials, task.own_start, strict=True):
        run = task.kernel.run(segment, values, task.begin(initial, part), active=active, substeps=task.substeps)
        columns = run.sensitivity[np.isfinite(segment.measured).all(axis=1)].reshape(-1, run.sensitivity[0].size)
        _products(kept := columns.copy())
        assert np.array_equal(kept, columns)
