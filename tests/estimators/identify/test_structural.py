"""Structural identifiability: a toy model whose result is known by hand, and the balancing robot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from upright.estimators.contract import EstimationError
from upright.estimators.identify.structural import SMALL, Motion, generic_motions, reduced, structure
from upright.models.library import get
from upright.models.model import Model
from upright.models.parts import Hold, Input, ModelError, Output, Parameter, State
from upright.models.segment import Segment
from upright.vehicles.twsbr.model import IDENTIFIABLE_AT_LARGE_TILT, IDENTIFIABLE_IN_TURNS, IDENTIFIABLE_NEAR_UPRIGHT

TWSBR = get("twsbr")
BOTH_SIDES = (("left_voltage", "right_voltage"), ("left_wheel_rate", "right_wheel_rate"))
STRAIGHT = generic_motions(TWSBR, same=BOTH_SIDES)
NEAR_UPRIGHT = generic_motions(TWSBR, same=BOTH_SIDES, size=SMALL)

TOY = Model(
    name="structural-toy",
    title="a mass on two springs in parallel, with a damper and a motor",
    base_states=(
        State("x", "m", "v", initial_std=0.1),
        State("v", "m/s", "(gain * drive * current - (left + right) * x - damping * v) / mass", initial_std=0.1),
    ),
    inputs=(Input("current", "A", Hold.ZERO_ORDER),),
    outputs=(Output("x", "m", "x", noise=1e-3),),
    base_parameters=(
        Parameter("mass", "kg", 2.0, std=0.01),
        Parameter("left", "N/m", 30.0, std=10.0),
        Parameter("right", "N/m", 50.0, std=2.0),
        Parameter("damping", "N s/m", 1.5, std=1.0),
        Parameter("gain", "N/m", 4.0, std=2.0),
        Parameter("drive", "m/A", 0.5, std=0.1),
        Parameter("colour", "1", 0.3, std=0.1),
    ),
)


def test_products_sums_and_parameters_without_influence_are_distinguished() -> None:
    found = structure(TOY)
    # gain drive / mass, (left + right) / mass, damping / mass
    assert (found.rank, found.generic_rank) == (3, 3)
    # Sensitivities are exact to rounding; the remainder of an unidentifiable direction is 1e-13.
    assert found.gap > 1e6
    ties = {tie.parameter: tie for tie in found.ties}
    # The most precise prior of each tie, in percent: mass 0.5, right 4, drive 20; colour is alone.
    assert set(ties) == set(found.hold) == {"mass", "right", "drive", "colour"}
    assert ties["colour"].changes == {"colour": 1.0}
    assert str(ties["colour"]) == "colour has no influence on any output"
    assert ties["drive"].product
    assert ties["drive"].changes == pytest.approx({"drive": 1.0, "gain": -1.0})
    assert ties["mass"].product
    assert ties["mass"].changes == pytest.approx({"mass": 1.0, "left": 1.0, "right": 1.0, "damping": 1.0, "gain": 1.0})
    assert not ties["right"].product
    assert ties["right"].changes == pytest.approx({"right": 1.0, "left": -50.0 / 30.0})
    assert "right +1 %, left -1.67 %" in str(ties["right"])


def test_other_parameters_are_identifiable_with_the_proposed_ones_held() -> None:
    found = structure(TOY)
    model = reduced(TOY, found)
    free = tuple(parameter.name for parameter in model.parameters if parameter.estimated)
    assert set(free) == set(found.free)
    again = structure(model, parameters=free)
    assert again.rank == len(free)
    assert (again.hold, again.ties) == ((), ())
    assert again.gap == np.inf


def test_combination_is_identifiable_if_no_null_direction_changes_it() -> None:
    found = structure(TOY)
    assert found.identifies("(left + right) / mass")
    assert found.identifies("sqrt(gain * drive / mass)")
    assert not found.identifies("left / mass")
    assert not found.identifies("mass")
    with pytest.raises(ModelError, match="there is no 'spring'"):
        found.identifies("spring / mass")
    with pytest.raises(EstimationError, match="depends on none of the examined parameters"):
        structure(TOY, parameters=["mass", "left"]).identifies("gain")


def test_force_measurement_makes_the_mass_identifiable() -> None:
    weighed = replace(TOY, outputs=(*TOY.outputs, Output("force", "N", "(left + right) * x", noise=1.0)))
    assert structure(weighed).rank == 4
    assert structure(weighed).identifies("mass")


def test_experiment_without_excitation_identifies_fewer_combinations() -> None:
    time = 0.01 * np.arange(100)
    still = Segment(time, time[:, None].copy(), np.zeros((100, 1)), np.full((100, 1), np.nan))
    found = structure(TOY, [Motion(still, np.array([0.3, 0.0]))])
    assert found.rank == 2
    assert not found.identifies("gain * drive / mass")
    assert found.identifies("(left + right) / mass")


def test_values_with_a_lower_rank_than_nearby_ones_are_detected() -> None:
    """The shape of a friction whose amplitude is zero."""
    model = get("axis").add("stribeck_friction")
    shapes = ["stribeck_friction.torque", "stribeck_friction.sliding"]
    found = structure(model, parameters=shapes)
    assert (found.rank, found.generic_rank) == (1, 2)
    assert found.hold == ("stribeck_friction.sliding",)


def test_empty_or_unknown_parameter_list_is_refused() -> None:
    with pytest.raises(EstimationError, match="there are none to examine"):
        structure(TOY, parameters=[])
    with pytest.raises(ModelError, match="model structural-toy has no such parameter"):
        structure(TOY, parameters=["weight"])


# --- the balancing robot


def test_near_upright_six_combinations_of_thirteen_parameters_are_identifiable() -> None:
    found = structure(TWSBR, NEAR_UPRIGHT)
    numbers = set(found.parameters) - {"voltage_offset"}
    assert len(numbers) == 13
    assert found.rank == found.generic_rank == 1 + len(IDENTIFIABLE_NEAR_UPRIGHT) == 7
    assert found.gap > 1e6
    assert all(map(found.identifies, IDENTIFIABLE_NEAR_UPRIGHT.values()))
    others = (
        *IDENTIFIABLE_AT_LARGE_TILT.values(),
        *IDENTIFIABLE_IN_TURNS.values(),
        "body_mass",
        "motor_constant",
        "rotor_inertia",
    )
    assert not any(map(found.identifies, others))
    alone = {tie.parameter for tie in found.ties if len(tie.changes) == 1}
    assert alone == {"wheel_distance", "yaw_inertia", "armature_inductance"}
    # Torques are known only as multiples of volts: all masses scale with the conductance.
    (scale,) = (tie for tie in found.ties if tie.product and len(tie.changes) > 1)
    masses = {"wheel_mass", "body_mass", "tilt_inertia", "rotor_inertia", "motor_friction", "wheel_friction"}
    assert scale.changes == pytest.approx(dict.fromkeys(masses, 1.0) | {"armature_resistance": -1.0}, rel=1e-6)


@pytest.mark.parametrize(
    ("motions", "told"),
    [
        (STRAIGHT, {**IDENTIFIABLE_NEAR_UPRIGHT, **IDENTIFIABLE_AT_LARGE_TILT}),
        (generic_motions(TWSBR), {**IDENTIFIABLE_NEAR_UPRIGHT, **IDENTIFIABLE_AT_LARGE_TILT, **IDENTIFIABLE_IN_TURNS}),
    ],
    ids=["large tilt", "turns"],
)
def test_larger_motion_identifies_more_combinations(motions: tuple[Motion, ...], told: dict[str, str]) -> None:
    found = structure(TWSBR, motions)
    assert found.rank == found.generic_rank == 1 + len(told)
    assert found.gap > 1e6
    assert all(map(found.identifies, told.values()))
    assert not found.identifies("body_mass")


def test_shipped_model_estimates_the_proposed_parameters() -> None:
    found = structure(TWSBR, NEAR_UPRIGHT)
    estimated = {parameter.name for parameter in TWSBR.parameters if parameter.estimated}
    assert estimated == set(found.free)
    assert structure(TWSBR, NEAR_UPRIGHT, sorted(estimated)).rank == len(estimated)


def test_parameters_with_more_precise_priors_are_held_instead() -> None:
    """The user states what is known best: here the body mass and the resistance, not the radius of a wheel."""
    weighed = TWSBR.change(deviations={"body_mass": 1e-3, "armature_resistance": 0.02})
    found = structure(weighed, NEAR_UPRIGHT)
    assert {"body_mass", "armature_resistance"} < set(found.hold)
    assert "wheel_radius" in found.free
