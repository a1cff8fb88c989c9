"""The reduced controller with the speed loop that a drive has by the symmetric optimum, in place of one lag."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from upright.models.control_design.lqi import closed_loop, continuous_poles
from upright.vehicles.file import load
from upright.vehicles.monocab.control.controller import design
from upright.vehicles.monocab.control.linear_model import MonocabParameters, full_model, model_with_speed_loop
from upright.vehicles.monocab.control.roll_design import UNCERTAIN
from upright.vehicles.monocab.file import MonocabFile

SHIPPED = load("monocab")
assert isinstance(SHIPPED, MonocabFile)
VEHICLE: MonocabFile = SHIPPED
CAD = MonocabParameters.from_values(VEHICLE.parameters.values)


def test_it_is_the_full_model_without_the_trim_mass() -> None:
    model, full = model_with_speed_loop(CAD), full_model(CAD)
    assert model.states == ("roll", "roll_rate", "precession_rate", "precession_acceleration", "precession_jerk")
    omega = np.geomspace(0.1, 100.0, 7)
    for each in 1j * omega:
        found = np.linalg.solve(each * np.eye(5) - model.A, model.B)[0, 0]
        expected = np.linalg.solve(each * np.eye(10) - full.A, full.B)[0, 1]
        assert found == pytest.approx(expected)
    assert model.measured is not None
    np.testing.assert_array_equal(model.measured @ np.arange(5.0), [0.0, 1.0, 2.0])


@pytest.mark.parametrize(("effort_weight", "unstable"), [(1.0, 4), (8.0, 0)])
def test_weights_as_shipped_are_not_stable_at_half_of_the_corners(effort_weight: float, unstable: int) -> None:
    """A fifth more or less of each uncertain parameter, with one period of delay or two: docs/decisions.md says what
    follows. Where a design is done with this speed loop, no corner is left."""
    section = VEHICLE.controller.model_copy(update={"effort_weight": effort_weight})
    gains = design(VEHICLE.model_copy(update={"controller": section})).gains
    found = []
    for factors in itertools.product((0.8, 1.2), repeat=len(UNCERTAIN)):
        plant = model_with_speed_loop(CAD.scaled(dict(zip(UNCERTAIN, factors, strict=True))))
        poles = [pole for delay in (1, 2) for pole in continuous_poles(closed_loop(plant, gains, delay), gains.period)]
        found.append(max(pole.real for pole in poles) >= 0.0)
    assert len(found) == 8
    assert sum(found) == unstable
