"""The linear model of the MONOCAB: signs, physics, refused values."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import expm

from upright.models.control_design.lqi import StateSpace
from upright.models.gravity import GRAVITY
from upright.vehicles.monocab.control.linear_model import (
    MonocabParameters,
    ParameterError,
    apparent_inertia,
    full_model,
    reduced_model,
)

VALUES = {
    "inertia": 1650.0,
    "gravity_stiffness": 14500.0,
    "angular_momentum": 3300.0,
    "speed_loop_lag": 0.04,
    "trim_mass": 500.0,
    "trim_height": 0.4,
}
PARAMETERS = MonocabParameters.from_values(VALUES)


def test_upright_equilibrium_has_the_unstable_pole_of_the_pendulum() -> None:
    poles = np.linalg.eigvals(reduced_model(PARAMETERS).A)
    assert max(poles.real) == pytest.approx(math.sqrt(14500.0 / 1650.0))
    assert PARAMETERS.unstable_pole == pytest.approx(max(poles.real))


def test_constant_precession_rate_holds_roll_at_the_torque_balance_angle() -> None:
    model = reduced_model(PARAMETERS)
    rate = 0.1
    roll = -3300.0 * rate / 14500.0
    derivative = model.A @ np.array([roll, 0.0, rate, 0.0, 0.0]) + model.B[:, 0] * rate
    assert np.allclose(derivative, 0.0)


def test_trim_mass_tips_towards_positive_roll_and_its_acceleration_reacts_opposite() -> None:
    model = full_model(PARAMETERS)
    of = model.A[1, [model.states.index(name) for name in ("trim_position", "trim_acceleration")]]
    assert of == pytest.approx([500.0 * GRAVITY / 1650.0, -500.0 * 0.4 / 1650.0])


def test_full_model_with_centred_trim_mass_matches_the_reduced_model() -> None:
    """While the gimbals turn steadily at their setpoint, as both models of the speed loop have it."""
    full, reduced = full_model(PARAMETERS), reduced_model(PARAMETERS)
    begin = {"roll": 0.01, "roll_rate": -0.02, "precession": 0.3, "precession_rate": 0.05}

    def later(model: StateSpace) -> dict[str, float]:
        forced = model.A + np.outer(model.B[:, -1], np.eye(len(model.A))[model.states.index("precession_rate")])
        start = np.array([begin.get(name, 0.0) for name in model.states])
        return dict(zip(model.states, expm(forced * 0.3) @ start, strict=True))

    assert later(full)["roll"] == pytest.approx(later(reduced)["roll"])
    assert later(full)["precession"] == pytest.approx(0.3 + 0.05 * 0.3)
    assert full.outputs == ("roll", "precession")


def test_speed_loops_of_the_full_model_are_those_of_the_symmetric_optimum() -> None:
    model = full_model(PARAMETERS)
    lag, s = PARAMETERS.speed_loop_lag, 25.0j
    expected = 1.0 / (1.0 + lag * s + (lag * s) ** 2 / 2.0 + (lag * s) ** 3 / 8.0)
    answer = np.linalg.solve(s * np.eye(10) - model.A, model.B)
    for number, name in enumerate(("trim_rate", "precession_rate")):
        assert answer[model.states.index(name), number] == pytest.approx(expected)


def test_static_torque_with_roll_at_zero_requires_a_constant_precession_rate() -> None:
    """The reason why the reduced model omits the precession angle, and why only a lean brings the gimbals back."""
    model = reduced_model(PARAMETERS)
    static_torque = np.array([0.0, 50.0 / 1650.0, 0.0, 0.0, 0.0])
    _, _, precession_rate, _, _, setpoint = np.linalg.solve(
        np.block([[model.A, model.B], [model.C, np.zeros((1, 1))]]), -np.append(static_torque, 0.0)
    )
    assert precession_rate == setpoint == pytest.approx(-50.0 / 3300.0)


def test_apparent_inertia_follows_the_formula_of_the_paper() -> None:
    # 4 tau = 40 ms: 8 * 0.01^2 * 3300^2 / 60 = 145.2 kg m^2.
    assert apparent_inertia(1650.0, 3300.0, 0.04, 60.0) == pytest.approx(1650.0 + 145.2)
    assert apparent_inertia(1650.0, 3300.0, 0.0, 60.0) == 1650.0


@pytest.mark.parametrize(
    ("name", "value"),
    [("inertia", 0.0), ("gravity_stiffness", -14500.0), ("angular_momentum", math.nan), ("speed_loop_lag", math.inf)],
)
def test_impossible_values_are_refused_by_name(name: str, value: float) -> None:
    with pytest.raises(ParameterError, match=name) as caught:
        MonocabParameters.from_values({**VALUES, name: value})
    assert caught.value.name == name
    assert "vehicle file" in caught.value.remedy


def test_missing_parameter_is_named_and_unknown_parameters_are_ignored() -> None:
    with pytest.raises(ParameterError, match="trim_mass"):
        MonocabParameters.from_values({name: value for name, value in VALUES.items() if name != "trim_mass"})
    assert MonocabParameters.from_values({**VALUES, "coulomb_friction.torque": 3.0}) == PARAMETERS
