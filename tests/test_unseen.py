"""What fits of a part of the data say of the rest, and which parts can say anything."""

from __future__ import annotations

import pytest

from diagnosis.diagnose import Diagnosis, Verdict, diagnose
from estimators.identify import nominal_model, with_values
from service.vehicle_file import load
from service.virtual_run import record
from simulation.hidden import HIDDEN

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
COUPLING = 0.25
"""Twice what 30 s of this excitation just show. The gimbals are away from zero in the first 3 s only."""


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    hide = (f"gimbal_angle_coupling={COUPLING / HIDDEN['gimbal_angle_coupling'].size:.4g}", "cubic_stiffness=0.06")
    return diagnose(MODEL, [record("monocab", "multisine", hide=hide, seed=71)], support=VEHICLE.support)


def test_an_effect_is_not_judged_where_it_does_nothing(found: Diagnosis) -> None:
    """The other two thirds had refused it: what they said of it was noise of other parameters."""
    assert found.verdict is Verdict.MISSING_EFFECT
    finding = next(each for each in found.findings if each.effect == "gimbal_angle_coupling")
    assert finding.held_out is None
    size = finding.parameters["gimbal_angle_coupling.coupling"]
    assert size.value is not None
    assert size.std is not None
    # Four standard deviations: a right one would miss with one seed in ten thousand.
    assert size.value == pytest.approx(COUPLING, abs=4.0 * size.std)


def test_it_is_said_that_nothing_was_held_against_it(found: Diagnosis) -> None:
    for each in found.findings:
        assert ("record once more" in each.explanation) == (each.held_out is None)
