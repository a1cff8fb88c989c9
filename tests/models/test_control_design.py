"""LQI design: compared with a simulation of the plant, and everything that it must refuse."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest

from upright.models.control_design.lqi import (
    ControlDesignError,
    LqiGains,
    LqiWeights,
    StateSpace,
    closed_loop,
    continuous_poles,
    design_lqi,
    discretise,
)
from upright.models.control_design.robustness import Estimated, Spread, checked_design, corners, margins
from upright.vehicles.monocab.control.linear_model import MonocabParameters, full_model, reduced_model
from upright.vehicles.monocab.control.roll_design import UNCERTAIN, design_roll_controller

CAD = MonocabParameters(1450.0, 12600.0, 3300.0, 0.04, 500.0, 0.4)
TRUTH = replace(CAD, inertia=1795.0, gravity_stiffness=14500.0)
WEIGHTS = LqiWeights((4.0e3, 1.0e2, 0.0, 0.0, 0.0), (4.0e4,), (4.0,))
RATES = (100, 250, 500)


def _at(factors: Mapping[str, float]) -> StateSpace:
    return reduced_model(CAD.scaled(factors))


def simulate(parameters: MonocabParameters, gains: LqiGains, seconds: float, delay: int) -> list[float]:
    """Roll over time after a start at 0.01 rad, by plain recursion: independent of the design's matrices."""
    model = reduced_model(parameters)
    A, B = discretise(model.A, model.B, gains.period)
    x, q, previous, in_transit = np.array([0.01, 0.0, 0.0, 0.0, 0.0]), 0.0, 0.0, [0.0] * delay
    rolls, computed, own = [], gains.computed, np.zeros(3)  # rate, acceleration and jerk as the controller has them
    assert computed is not None
    for _ in range(round(seconds / gains.period)):
        u = -float(gains.matrix[0] @ [*x[:3], *own[1:], previous, q])
        own = computed.transition @ own + computed.inputs[:, 0] * previous
        q += gains.period * x[0]
        previous = u
        in_transit.append(u)
        x = A @ x + B[:, 0] * in_transit.pop(0)
        rolls.append(float(x[0]))
    return rolls


@pytest.mark.parametrize("rate", RATES)
@pytest.mark.parametrize("delay", [0, 1, 2])
@pytest.mark.parametrize("parameters", [CAD, TRUTH], ids=["cad", "truth"])
def test_controller_designed_from_cad_balances_the_true_plant_with_delay(
    parameters: MonocabParameters, rate: int, delay: int
) -> None:
    gains = design_lqi(reduced_model(CAD), WEIGHTS, 1.0 / rate)
    rolls = simulate(parameters, gains, 4.0, delay)
    assert max(abs(roll) for roll in rolls) < 0.015
    # The slowest pole of both plants is faster than 3 1/s.
    assert abs(rolls[-1]) < 1e-5
    slowest = continuous_poles(closed_loop(reduced_model(parameters), gains, delay), gains.period)[0]
    assert slowest.real < -3.0


def test_closed_loop_matrix_agrees_with_the_recursive_simulation() -> None:
    gains = design_lqi(reduced_model(CAD), WEIGHTS, 0.004)
    for delay in (0, 1, 3):
        matrix = closed_loop(reduced_model(TRUTH), gains, delay)
        state = np.zeros(len(matrix))
        state[0] = 0.01
        rolls = []
        for _ in range(50):
            state = matrix @ state
            rolls.append(state[0])
        assert np.allclose(rolls, simulate(TRUTH, gains, 0.2, delay), rtol=1e-9, atol=1e-15)


def test_constant_torque_leaves_no_steady_state_roll_error() -> None:
    gains = design_lqi(reduced_model(CAD), WEIGHTS, 0.004)
    matrix = closed_loop(reduced_model(TRUTH), gains)
    model = reduced_model(TRUTH)
    torque = np.zeros(len(matrix))
    torque[:5] = discretise(model.A, np.array([[0.0, 550.0 / TRUTH.inertia, 0.0, 0.0, 0.0]]).T, 0.004)[1][:, 0]
    steady = np.linalg.solve(np.eye(len(matrix)) - matrix, torque)
    assert steady[0] == pytest.approx(0.0, abs=1e-12)
    assert steady[2] == pytest.approx(-550.0 / 3300.0)


def test_gains_hardly_depend_on_the_control_rate() -> None:
    gains = [design_lqi(reduced_model(CAD), WEIGHTS, 1.0 / rate) for rate in RATES]
    assert gains[0].states[0][0] == pytest.approx(gains[2].states[0][0], rel=0.1)
    assert gains[0].integral[0] == pytest.approx(gains[2].integral[0], rel=0.12)


@pytest.mark.parametrize("rate", RATES)
def test_loop_becomes_unstable_just_beyond_its_margins(rate: int) -> None:
    gains = design_lqi(reduced_model(CAD), WEIGHTS, 1.0 / rate)
    (found,) = margins(reduced_model(CAD), gains).values()
    assert found.gain_decrease < 0.5
    assert found.gain_increase > 2.0
    assert np.degrees(found.phase) > 45.0
    assert found.delay > 0.03

    def stable(factor: float, extra_delay: int = 0) -> bool:
        # A factor on the loop gain scales the torque of a setpoint and nothing else: the plant's B.
        model = reduced_model(CAD)
        scaled = replace(model, B=model.B * factor)
        return bool(np.max(np.abs(np.linalg.eigvals(closed_loop(scaled, gains, 1 + extra_delay)))) < 1.0)

    # The margins are read off a grid of 2,000 frequencies, hence the 2 %.
    assert stable(found.gain_increase * 0.98)
    assert not stable(found.gain_increase * 1.02)
    assert stable(found.gain_decrease * 1.02)
    assert not stable(found.gain_decrease * 0.98)
    cycles = found.delay * rate
    assert stable(1.0, int(cycles))
    assert not stable(1.0, int(cycles) + 1)


@pytest.mark.parametrize("rate", RATES)
def test_design_is_checked_at_every_corner_and_reports_the_worst(rate: int) -> None:
    design = design_roll_controller(CAD, WEIGHTS, 1.0 / rate)
    every = list(corners(_at, Spread(UNCERTAIN), design.gains))
    assert len(every) == 2 * 2**3
    assert design.worst.damping == min(corner.damping for corner in every)
    assert design.worst.damping > 0.1
    assert min(corner.slowest for corner in every) > 1.0
    assert "inertia x" in str(design.worst)
    assert all(pole.real < 0.0 for pole in design.poles)


@pytest.mark.parametrize(("effort", "phase", "gain", "unstable"), [(1.0, 12.0, 1.1, 4), (4.0, 51.0, 4.5, 0)])
def test_design_with_one_lag_has_little_margin_with_the_whole_speed_loop(
    effort: float, phase: float, gain: float, unstable: int
) -> None:
    """As in the paper; angles in deg, gains in dB. It sees the first three states of the real loop."""
    inertia, lag = CAD.inertia, CAD.speed_loop_lag
    A = np.array([[0.0, 1.0, 0.0], [CAD.gravity_stiffness / inertia, 0.0, 3300.0 / inertia], [0.0, 0.0, -1.0 / lag]])
    B, C = np.array([[0.0], [0.0], [1.0 / lag]]), np.array([[1.0, 0.0, 0.0]])
    of_paper = StateSpace(A, B, C, ("roll", "roll_rate", "precession_rate"), ("setpoint",), ("roll",))
    gains = design_lqi(of_paper, LqiWeights(WEIGHTS.states[:3], WEIGHTS.integral, (effort,)), 0.004)

    def real(factors: Mapping[str, float]) -> StateSpace:
        return replace(_at(factors), measured=np.eye(3, 5), computed=())

    (found,) = margins(real({}), gains).values()
    assert np.degrees(found.phase) == pytest.approx(phase, abs=1.0)
    assert 20.0 * np.log10(found.gain_increase) == pytest.approx(gain, abs=0.1)
    every = corners(real, Spread(UNCERTAIN), gains)
    assert len({corner.factors for corner in every if corner.slowest <= 0.0}) == unstable


def test_controller_unstable_at_a_corner_is_refused_and_the_corner_named() -> None:
    aggressive = LqiWeights((4.0e8, 1.0e6, 0.0, 0.0, 0.0), (4.0e8,), (1.0,))
    with pytest.raises(
        ControlDesignError, match=r"inertia x 0[.]8, gravity_stiffness x 0[.]8, speed_loop_lag x 1[.]2"
    ) as caught:
        design_roll_controller(CAD, aggressive, 0.02, spread=0.2)
    assert "effort_weight" in caught.value.remedy


TOGETHER = ("inertia", "gravity_stiffness")


def estimated(std: float, correlation: float = 0.0) -> Estimated:
    """Both parameters with the same relative standard deviation."""
    values = np.array([getattr(CAD, name) for name in TOGETHER])
    relative = std**2 * np.array([[1.0, correlation], [correlation, 1.0]])
    return Estimated(TOGETHER, values, relative * np.outer(values, values))


def test_estimates_are_checked_over_their_region_and_draws() -> None:
    points = [dict(each) for each in estimated(0.05).points()]
    assert len(points) == 4 + 4 + 1000
    off = np.array([[each[name] - 1.0 for name in TOGETHER] for each in points]) / 0.05
    # 95 % of two independent unit deviates lie within 2.448 of zero.
    assert np.hypot(*off[:8].T) == pytest.approx(2.4477, rel=1e-3)
    assert np.mean(np.hypot(*off[8:].T) < 2.4477) == pytest.approx(0.95, abs=0.02)
    design = checked_design(_at, estimated(0.05), WEIGHTS, 0.004)
    assert design.worst.damping > 0.2
    assert "95 % region and 1000 draws" in design.words()[-1]


def test_correlated_estimates_are_off_together() -> None:
    off = np.array([[factor - 1.0 for _, factor in each] for each in estimated(0.05, 0.9).points()])
    assert np.corrcoef(off[8:].T)[0, 1] == pytest.approx(0.9, abs=0.02)


def test_controller_that_estimates_do_not_support_is_refused_with_the_point() -> None:
    aggressive = LqiWeights((4.0e8, 1.0e6, 0.0, 0.0, 0.0), (4.0e8,), (1.0,))
    with pytest.raises(ControlDesignError, match=r"unstable within the estimates' 95 % region.*inertia x") as caught:
        checked_design(_at, estimated(0.08), aggressive, 0.02)
    assert "effort_weight" in caught.value.remedy


def test_estimate_that_may_have_the_other_sign_is_refused() -> None:
    with pytest.raises(ControlDesignError, match="is too uncertain for a controller") as caught:
        checked_design(_at, estimated(0.6), WEIGHTS, 0.004)
    assert "identify again" in caught.value.remedy


@pytest.mark.parametrize("size", range(1, 9))
def test_points_at_which_a_parameter_has_the_other_sign_are_left_out(size: int) -> None:
    """A CAD value with a deviation of 27 % is below zero in one of 9,000 draws, and where the region of eight ends."""
    values, draws = np.arange(1.0, size + 1.0), 10_000
    known = Estimated(tuple("abcdefgh"[:size]), values, np.diag((0.27 * values) ** 2), draws)
    factors = np.array([[factor for _, factor in each] for each in known.points()])[-draws:]
    assert factors.min() > 0.0
    assert np.std(factors, axis=0) == pytest.approx(np.full(size, 0.27), rel=0.03)


def test_model_with_an_uncontrollable_mode_is_refused() -> None:
    """The trim mass of the full model, with the gyroscopes as the only input: its position does not change."""
    model = full_model(CAD)
    with pytest.raises(ControlDesignError, match="not stabilisable"):
        design_lqi(
            replace(model, B=model.B[:, 1:], C=model.C[:1], inputs=model.inputs[1:], outputs=model.outputs[:1]),
            LqiWeights((1.0,) * 10, (1.0,), (1.0,)),
            0.004,
        )


def test_design_without_angular_momentum_is_refused_with_the_unstable_mode() -> None:
    model = reduced_model(CAD)
    A = model.A.copy()
    A[1, 2] = 0.0
    with pytest.raises(ControlDesignError, match=r"\+2\.95 1/s"):
        design_lqi(replace(model, A=A), WEIGHTS, 0.004)


def test_weights_of_zero_are_refused_with_a_remedy() -> None:
    with pytest.raises(ControlDesignError) as caught:
        design_lqi(reduced_model(CAD), LqiWeights((0.0,) * 5, (0.0,), (0.0,)), 0.004)
    assert "[controller]" in caught.value.remedy


def test_wrong_number_of_weights_is_refused() -> None:
    with pytest.raises(ValueError, match="2, 1 and 1 weights for 5 states"):
        design_lqi(reduced_model(CAD), LqiWeights((1.0, 1.0), (1.0,), (1.0,)), 0.004)
