"""The effects of a model in the linear model of a controller's design, against the equations and against simulation."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq

from upright.diagnosis.prediction.closed_loop import simulate
from upright.models.control_design.linear_effects import CommandEffects, LinearEffects, Together
from upright.models.control_design.lqi import ControlDesignError, StateSpace, closed_loop, continuous_poles
from upright.models.control_design.robustness import Known
from upright.models.model import Model
from upright.vehicles import registry
from upright.vehicles.file import load
from upright.vehicles.monocab.control.controller import design
from upright.vehicles.monocab.control.linear_model import MonocabParameters, full_model, reduced_model
from upright.vehicles.monocab.file import MonocabFile
from upright.vehicles.monocab.gimbals import MONOCAB_GIMBALS
from upright.vehicles.monocab.model import MONOCAB_ROLL

SHIPPED = load("monocab")
assert isinstance(SHIPPED, MonocabFile)
VEHICLE: MonocabFile = SHIPPED
PARAMETERS = MonocabParameters.from_values(VEHICLE.parameters.values)
PLANT = reduced_model(PARAMETERS)


def with_effect(name: str, **values: float) -> Model:
    return MONOCAB_ROLL.add(name).change({f"{name}.{key}": value for key, value in values.items()})


def known(effects: LinearEffects | Together, share: float = 0.02) -> Known:
    values = VEHICLE.parameters.values
    return Known(values, {name: share * abs(value) for name, value in values.items()}, {}, effects)


def test_viscous_friction_is_a_damping_of_roll() -> None:
    plant = LinearEffects(with_effect("viscous_friction", coefficient=400.0)).on(PLANT, {})
    expected = PLANT.A.copy()
    expected[1, 1] = -400.0 / PARAMETERS.inertia
    np.testing.assert_allclose(plant.A, expected, atol=1e-9)
    np.testing.assert_array_equal(plant.B, PLANT.B)


def test_parameters_of_vehicle_and_effect_are_scaled_together() -> None:
    effects = LinearEffects(with_effect("viscous_friction", coefficient=400.0))
    plant = effects.on(PLANT, {"viscous_friction.coefficient": 1.5, "inertia": 2.0})
    assert plant.A[1, 1] == pytest.approx(-300.0 / PARAMETERS.inertia)


def test_coulomb_friction_is_a_damping_for_motions_of_typical_size() -> None:
    plant = LinearEffects(with_effect("coulomb_friction", torque=60.0)).on(PLANT, {})
    typical = MONOCAB_ROLL.joints[0].rate_scale
    assert plant.A[1, 1] == pytest.approx(-60.0 / typical / PARAMETERS.inertia, rel=1e-3)


def test_deadband_reduces_the_gain_of_the_gimbals() -> None:
    plant = LinearEffects(with_effect("input_deadband", width=0.01)).on(PLANT, {})
    typical = MONOCAB_ROLL.actuators[0].command_scale
    assert plant.A[1, 2] == pytest.approx(PLANT.A[1, 2] * (1.0 - 0.01 / typical), rel=0.02)


def test_a_lag_is_a_state_between_the_gimbals_and_their_torque() -> None:
    plant = LinearEffects(with_effect("actuator_lag", lag=0.02)).on(PLANT, {})
    np.testing.assert_allclose(plant.A[1], [PLANT.A[1, 0], 0.0, 0.0, 0.0, 0.0, PLANT.A[1, 2]])
    np.testing.assert_allclose(plant.A[5], [0.0, 0.0, 50.0, 0.0, 0.0, -50.0])


def test_a_delay_turns_the_phase_of_the_gimbals_and_nothing_else() -> None:
    plant = LinearEffects(with_effect("input_delay", delay=0.012)).on(PLANT, {})
    omega = 20.0

    def response(model: object) -> np.complex128:
        A, B = model.A, model.B  # type: ignore[attr-defined]
        found: np.complex128 = np.linalg.solve(1j * omega * np.eye(len(A)) - A, B)[0, 0]
        return found

    assert response(plant) / response(PLANT) == pytest.approx(np.exp(-0.012j * omega), abs=1e-4)


def test_a_lag_of_the_imu_is_in_what_the_controller_sees() -> None:
    plant = LinearEffects(with_effect("sensor_lag", lag=0.01)).on(PLANT, {})
    assert plant.measured is not None
    seen = plant.measured @ np.linalg.solve(20.0j * np.eye(len(plant.A)) - plant.A, plant.B)
    true = np.linalg.solve(20.0j * np.eye(5) - PLANT.A, PLANT.B)
    np.testing.assert_allclose(seen[:2] / true[:2], 1.0 / (1.0 + 0.2j), rtol=2e-3)
    assert seen[2] == pytest.approx(true[2])


def test_a_memory_that_is_not_linear_is_left_out_and_named() -> None:
    model = with_effect("hysteresis", torque=60.0).add("viscous_friction")
    effects = LinearEffects(model.change({"viscous_friction.coefficient": 400.0}))
    assert (effects.names, effects.left_out) == (("viscous_friction",), ("hysteresis",))
    found = design(VEHICLE, known=known(effects))
    assert found.within.endswith("with viscous_friction, without hysteresis (no linear model)")


def test_a_constant_torque_is_no_part_of_a_linear_model() -> None:
    effects = LinearEffects(with_effect("static_torque", torque=30.0))
    assert (effects.names, effects.parameters, effects.left_out) == ((), (), ())


def test_the_full_model_takes_them_too() -> None:
    plant = full_model(PARAMETERS)
    changed = LinearEffects(with_effect("viscous_friction", coefficient=400.0)).on(plant, {})
    assert changed.A[1, 1] == pytest.approx(-400.0 / PARAMETERS.inertia)
    assert np.count_nonzero(~np.isclose(changed.A, plant.A)) == 1


def test_margins_and_worst_corner_are_those_with_the_effects() -> None:
    without = design(VEHICLE, known=known(LinearEffects(MONOCAB_ROLL)))
    found = design(VEHICLE, known=known(LinearEffects(with_effect("input_delay", delay=0.02))))
    np.testing.assert_array_equal(found.gains.matrix, without.gains.matrix)
    assert found.margins["precession_rate_setpoint"].phase < 0.8 * without.margins["precession_rate_setpoint"].phase
    assert "input_delay.delay" in dict(found.worst.factors)


def test_uncertain_effect_is_tried_within_its_bounds() -> None:
    model = with_effect("viscous_friction", coefficient=400.0)
    model = model.change(deviations={"viscous_friction.coefficient": 400.0})
    points = list(known(LinearEffects(model)).about(("inertia",)).points())
    factors = np.array([dict(each)["viscous_friction.coefficient"] for each in points])
    assert factors.min() == 0.0
    assert factors.max() > 2.0


class TestCommand:
    """The effects on the way of the gimbals' setpoint, which are in the model of the gimbals alone."""

    def gimbals(self, name: str, **values: float) -> Model:
        return MONOCAB_GIMBALS.add(name).change({f"{name}.{key}": value for key, value in values.items()})

    @pytest.mark.parametrize("plant", [PLANT, full_model(PARAMETERS)], ids=["reduced", "full"])
    def test_a_delay_turns_the_phase_of_that_setpoint_alone(self, plant: StateSpace) -> None:
        late = CommandEffects(self.gimbals("input_delay", delay=0.012)).on(plant, {})
        before, after = (np.linalg.solve(20.0j * np.eye(len(each.A)) - each.A, each.B)[0] for each in (plant, late))
        expected = np.where(np.array(plant.inputs) == "precession_rate_setpoint", np.exp(-0.24j), 1.0)
        np.testing.assert_allclose(after / before, expected, atol=1e-4)

    def test_deadband_and_gain_change_how_much_of_a_setpoint_acts(self) -> None:
        found = CommandEffects(self.gimbals("input_gain", gain=-0.2)).on(PLANT, {"gimbals.input_gain.gain": 2.0})
        np.testing.assert_allclose(found.B, 0.6 * PLANT.B)
        found = CommandEffects(self.gimbals("input_deadband", width=0.01)).on(PLANT, {})
        np.testing.assert_allclose(found.B, 0.9 * PLANT.B, rtol=0.02)

    def test_another_plant_is_left_as_it_is(self) -> None:
        other = replace(PLANT, inputs=("torque",))
        assert CommandEffects(self.gimbals("input_delay", delay=0.012)).on(other, {}) is other

    def test_those_of_vehicle_and_actuators_come_together(self) -> None:
        model = with_effect("viscous_friction", coefficient=400.0)
        model = replace(model, actuators_model=self.gimbals("input_delay", delay=0.012))
        both = Together.of(model)
        assert both.names == ("viscous_friction", "input_delay")
        assert [each.name for each in both.parameters] == ["viscous_friction.coefficient", "gimbals.input_delay.delay"]
        plant = both.on(PLANT, {})
        assert plant.A[1, 1] == pytest.approx(-400.0 / PARAMETERS.inertia)
        found = np.linalg.solve(20.0j * np.eye(len(plant.A)) - plant.A, plant.B)[0, 0]
        alone = LinearEffects(with_effect("viscous_friction", coefficient=400.0)).on(PLANT, {})
        bare = np.linalg.solve(20.0j * np.eye(len(alone.A)) - alone.A, alone.B)[0, 0]
        assert found / bare == pytest.approx(np.exp(-0.24j), abs=1e-4)

    def test_they_are_in_margins_and_worst_corner(self) -> None:
        bare = design(VEHICLE, known=known(Together.of(MONOCAB_ROLL)))
        late = replace(MONOCAB_ROLL, actuators_model=self.gimbals("input_delay", delay=0.012))
        found = design(VEHICLE, known=known(Together.of(late)))
        before, after = (each.margins["precession_rate_setpoint"].delay for each in (bare, found))
        assert after == pytest.approx(before - 0.012, abs=5e-4)
        assert "gimbals.input_delay.delay" in dict(found.worst.factors)
        (left,) = found.margins.values()
        assert np.degrees(left.phase) == pytest.approx(37.0, abs=1.0)
        assert 20.0 * np.log10(left.gain_increase) == pytest.approx(5.5, abs=0.2)


@pytest.mark.parametrize(("share", "stable"), [(0.8, True), (1.2, False)])
def test_where_the_loop_becomes_unstable_the_simulated_vehicle_keeps_oscillating(share: float, stable: bool) -> None:
    """The delay is that at which the linear loop is at its limit; the limits of the setpoint bound the oscillation."""
    gains = design(VEHICLE).gains

    def slowest(delay: float) -> float:
        plant = LinearEffects(with_effect("input_delay", delay=delay)).on(PLANT, {})
        return continuous_poles(closed_loop(plant, gains), gains.period)[0].real

    limit = brentq(slowest, 0.02, 0.2)
    experiment = registry.of("monocab").prediction().of(VEHICLE)("doublet")
    course = simulate(with_effect("input_delay", delay=share * limit), replace(experiment, limits=()))
    roll = np.abs(course.rows.measured[:, 0])
    left = roll[-200:].max() / roll.max()
    assert (left < 0.1) if stable else (left > 0.3)


def test_a_loop_that_the_effect_makes_unstable_is_refused_with_the_corner() -> None:
    with pytest.raises(ControlDesignError, match=r"with input_delay .*input_delay\.delay x"):
        design(VEHICLE, known=known(LinearEffects(with_effect("input_delay", delay=0.1))))
