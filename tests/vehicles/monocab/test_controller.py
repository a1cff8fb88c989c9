"""The roll controller alone: limits, anti-windup, takeover, lean."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from upright.models.control_design.lqi import Computed, LqiGains, closed_loop, discretise
from upright.vehicles.commissioning import steps_of
from upright.vehicles.file import load
from upright.vehicles.monocab.control.controller import PrecessionReturn, RollController, SetpointLimits, design
from upright.vehicles.monocab.control.linear_model import MonocabParameters, reduced_model

COMPUTED = Computed(np.zeros((3, 3)), np.zeros((3, 1)), (2, 3, 4), (3, 4))
GAINS = LqiGains(((100.0, 16.0, 1.0, 0.0, 0.0),), ((0.1,),), ((180.0,),), 0.004, COMPUTED)
LIMITS = SetpointLimits(rate=1.0, acceleration=40.0)
PARAMETERS = MonocabParameters(1450.0, 12600.0, 3300.0, 0.04, 500.0, 0.4)
DT = 0.004

finite = st.floats(-10.0, 10.0)


def controller(return_time: float = 0.0, limits: SetpointLimits = LIMITS) -> RollController:
    return RollController(GAINS, limits, PrecessionReturn(PARAMETERS, return_time, math.radians(2.5)))


def test_setpoint_has_the_right_sign_for_roll_rate_reference_and_excitation() -> None:
    assert controller().step(0.001, 0.0, 0.0, 0.0, 0.0, DT) < 0.0
    assert controller().step(0.0, 0.005, 0.0, 0.0, 0.0, DT) < 0.0
    assert controller().step(0.0, 0.0, 0.0, 0.0, 0.001, DT) > 0.0
    assert controller().step(0.0, 0.0, 0.0, 0.0, 0.0, DT, 0.05) == pytest.approx(0.05)


@given(st.lists(st.tuples(finite, finite, finite, finite, finite, finite), min_size=1, max_size=50))
def test_setpoint_never_exceeds_its_limits_for_any_input(rows: list[tuple[float, ...]]) -> None:
    subject, before = controller(6.0), 0.0
    for roll, roll_rate, precession_rate, precession, reference, excitation in rows:
        setpoint = subject.step(roll, roll_rate, precession_rate, precession, reference, DT, excitation)
        assert abs(setpoint) <= LIMITS.rate
        assert abs(setpoint - before) <= LIMITS.acceleration * DT + 1e-12
        before = setpoint


def test_controller_takes_over_from_the_last_setpoint_without_a_jump() -> None:
    subject = controller()
    subject.reset(-0.42)
    setpoint = subject.step(0.0, -0.2, -0.42, -0.3, 0.0, DT)
    assert setpoint == pytest.approx(-0.42 + 40.0 * DT)
    assert subject.limited


def test_reset_clears_the_state_of_the_last_run() -> None:
    used, fresh = controller(6.0), controller(6.0)
    for _ in range(500):
        used.step(0.01, 0.0, 0.0, 0.2, 0.0, DT)
    used.lean_on = False
    used.reset(0.0)
    for cycle in range(100):
        row = (0.001 * math.sin(cycle), 0.0, 0.0, 0.1, 0.0, DT)
        assert used.step(*row) == fresh.step(*row)


def test_anti_windup_keeps_a_long_saturation_from_delaying_recovery() -> None:
    """5 s against the limit: without back-calculation the integral would hold the setpoint there for seconds."""
    subject = controller()
    for _ in range(1250):
        assert subject.step(0.05, 0.0, 0.0, 0.0, 0.0, DT) >= -1.0
    assert subject.setpoint == -1.0
    cycles = 0
    while subject.setpoint < 0.0:
        subject.step(-0.01, 0.0, 0.0, 0.0, 0.0, DT)
        cycles += 1
    assert cycles * DT < 0.2


def test_integral_term_is_the_integral_of_the_error_within_the_limits() -> None:
    """With all other gains at zero, the setpoint after n cycles of a constant error e is -k_i e dt (n - 1)."""
    gains = LqiGains(((0.0,) * 5,), ((0.0,),), ((180.0,),), DT, COMPUTED)
    subject = RollController(gains, LIMITS, PrecessionReturn(PARAMETERS, 0.0, 0.04))
    for _ in range(100):
        subject.step(0.0005, 0.0, 0.0, 0.0, 0.0, DT)
    assert not subject.limited
    assert subject.setpoint == pytest.approx(-180.0 * 0.0005 * DT * 99)


def test_reported_reference_includes_the_lean_only_while_lean_is_on() -> None:
    subject = controller(6.0)
    for _ in range(500):
        subject.step(0.0, 0.0, 0.0, 0.1, 0.002, DT)
    assert subject.reference > 0.002
    subject.lean_on = False
    subject.step(0.0, 0.0, 0.0, 0.1, 0.002, DT)
    assert subject.reference == 0.002


def lean_loop(static_torque: float, seconds: float, limit: float = math.radians(2.5)) -> list[float]:
    """The precession angle if roll follows the lean immediately: precession' = -(T_V roll + static_torque) / L."""
    outer = PrecessionReturn(PARAMETERS, 6.0, limit)
    precession, angles = 0.3, []
    for _ in range(round(seconds / DT)):
        lean = outer.step(precession, DT)
        precession -= (12600.0 * lean + static_torque) / 3300.0 * DT
        angles.append(precession)
    return angles


def test_gimbals_return_with_the_configured_time_constant() -> None:
    """Double pole at -1/T from rest at 0.3 rad: precession = 0.3 (1 - t/T) exp(-t/T). The slew limit delays it."""
    angles = lean_loop(0.0, 36.0, limit=1.0)
    for t in (3.0, 6.0, 12.0, 18.0):
        assert angles[round(t / DT)] == pytest.approx(0.3 * (1.0 - t / 6.0) * math.exp(-t / 6.0), abs=0.02)
    assert abs(angles[-1]) < 0.005


@pytest.mark.parametrize("static_torque", [50.0, -300.0, 520.0])
def test_gimbals_end_centred_under_a_static_torque(static_torque: float) -> None:
    angles = lean_loop(static_torque, 120.0)
    assert abs(angles[-1]) < 0.002


def test_lean_integral_does_not_wind_up_when_the_torque_exceeds_the_lean_limit() -> None:
    outer = PrecessionReturn(PARAMETERS, 6.0, 0.02)
    for _ in range(5000):
        lean = outer.step(1.0, DT)
        assert lean <= 0.02
    seconds = 0.0
    while lean > 0.0:
        lean = outer.step(-0.1, DT)
        seconds += DT
    assert seconds < 6.0


def test_controller_of_the_shipped_file_saturates_at_its_rate_limit() -> None:
    vehicle = load("monocab")
    subject = RollController.from_design(design(vehicle), vehicle)
    for _ in range(200):
        subject.step(1.0, 0.0, 0.0, 0.0, 0.0, vehicle.period)
    assert subject.setpoint == -vehicle.limits.precession_rate


def test_closed_loop_matrix_agrees_with_a_recursion_of_plant_and_controller() -> None:
    """The plant differs from the model of the design, so that the computed accelerations do, too."""
    vehicle = load("monocab")
    found = design(vehicle)
    subject = RollController.from_design(found, vehicle)
    subject.lean_on = False
    plant = reduced_model(MonocabParameters(1700.0, 12600.0, 3300.0, 0.045, 500.0, 0.4))
    A, B = discretise(plant.A, plant.B, vehicle.period)
    matrix = closed_loop(plant, found.gains)
    x, sent, state, rolls, expected = np.zeros(5), 0.0, np.zeros(len(matrix)), [], []
    x[0] = state[0] = 1e-5  # far from every limit
    for _ in range(400):
        subject.step(x[0], x[1], x[2], 0.0, 0.0, vehicle.period)
        x, sent = A @ x + B[:, 0] * sent, subject.setpoint
        state = matrix @ state
        rolls.append(x[0])
        expected.append(state[0])
    np.testing.assert_allclose(rolls, expected, rtol=1e-6, atol=1e-12)


def test_margins_as_shipped_are_those_that_the_commissioning_accepts() -> None:
    steps = {each.id: each for each in steps_of("monocab").step}
    (found,) = design(load("monocab")).margins.values()
    is_there = {
        "reduced_phase_margin": math.degrees(found.phase),
        "reduced_gain_margin": 20.0 * math.log10(found.gain_increase),
        "reduced_delay_margin": 1e3 * found.delay,
    }
    assert {each.quantity for each in steps["reduced"].acceptance} == set(is_there)
    for each in steps["reduced"].acceptance:
        assert each.least is not None
        assert is_there[each.quantity] > 1.4 * each.least
