"""How fits of one part of the data are judged on the rest, and which parts can judge an effect."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.gates import HeldOut
from upright.diagnosis.parts import diagnose_actuators
from upright.diagnosis.prepare.ready import ready
from upright.diagnosis.search.held_out import TAILS, WIDER, loss, with_possible_noise
from upright.estimators.data.segments import after_settling
from upright.estimators.fit.likelihood import FLOOR
from upright.estimators.fit.maximum_likelihood import fit
from upright.estimators.fit.problem import problem
from upright.estimators.identify.run import with_values
from upright.models.effects.catalogue import find
from upright.models.library import get
from upright.service.virtual.run import record
from upright.simulation.monocab.hidden import HIDDEN
from upright.vehicles import registry
from upright.vehicles.file import load
from upright.vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
COUPLING = 0.35
"""A little more than twice the minimum detectable coupling in 30 s of this excitation. The gimbals are away from zero
in the first 3 s only."""


@pytest.fixture(scope="module")
def found() -> Diagnosis:
    hide = (f"gimbal_angle_coupling={COUPLING / HIDDEN['gimbal_angle_coupling'].size:.4g}", "cubic_stiffness=0.06")
    return diagnose(MODEL, [record("monocab", "multisine", hide=hide, seed=71)], support=VEHICLE.support)


def test_effect_is_not_judged_on_data_in_which_it_does_not_act(found: Diagnosis) -> None:
    """The other two thirds used to reject it, although their result was only noise of other parameters."""
    assert found.verdict is Verdict.MISSING_EFFECT
    finding = next(each for each in found.findings if each.effect == "gimbal_angle_coupling")
    assert finding.held_out is None
    size = finding.parameters["gimbal_angle_coupling.coupling"]
    assert size.value is not None
    assert size.std is not None
    # Four standard deviations: a correct standard deviation would fail with one seed in ten thousand.
    assert size.value == pytest.approx(COUPLING, abs=4.0 * size.std)


def test_explanation_advises_another_record_if_none_was_held_out(found: Diagnosis) -> None:
    for each in found.findings:
        assert ("record once more" in each.explanation) == (each.held_out is None)


@pytest.mark.parametrize(
    ("closed", "closed_std", "closing", "stands"),
    [
        (90.0, 20.0, 85.0, True),
        (-80.0, 16.0, 55.0, False),  # it changes the error ahead by much, and for the worse
        (-30.0, 16.0, 55.0, True),  # not significantly
        (-9.0, 4.0, 2.0, True),  # it changes next to nothing there: other errors decide
        (None, None, None, True),
    ],
)
def test_error_ahead_judges_only_effects_that_change_it(
    closed: float | None, closed_std: float | None, closing: float | None, stands: bool
) -> None:
    result = HeldOut(30.0, 6.0, closed_percent=closed, closed_std=closed_std, closing_percent=closing)
    assert result.stands is stands


def test_likelihood_alone_judges_if_parts_collide() -> None:
    grows = HeldOut(30.0, 6.0, closed_percent=-80.0, closed_std=16.0, closing_percent=55.0)
    assert not grows.stands
    assert replace(grows, impacts=True).stands
    assert not replace(grows, impacts=True, gain=5.0).stands


def test_too_small_a_rise_of_the_likelihood_rejects_whatever_the_error_ahead() -> None:
    assert not HeldOut(3.0, 6.0, closed_percent=90.0, closed_std=10.0, closing_percent=90.0).stands


def test_small_input_asymmetry_is_confirmed_beside_errors_of_the_speed_loop() -> None:
    """It shows from sample to sample; half a second ahead the error is a dozen times its contribution."""
    hide = ("input_asymmetry=0.0008", "load_dependent_friction=0.01")
    recording = record("monocab", "multisine", hide=hide, seed=83, duration=30.0)
    values, deviations = VEHICLE.parameters.values, VEHICLE.parameters.deviations
    actuators = [with_values(each, values, deviations) for each in registry.of("monocab").models().actuators]
    candidates = [find(name) for name in ("input_asymmetry", "input_gain", "input_delay", "actuator_lag")]
    found = diagnose_actuators(actuators, [recording], support=VEHICLE.support, candidates=candidates)
    (finding,) = found.findings
    assert finding.effect == "input_asymmetry"
    assert finding.held_out is not None
    assert finding.held_out.closing_percent is not None
    assert finding.held_out.closed_std is not None
    assert finding.held_out.closing_percent < finding.held_out.closed_std


def test_one_outlier_does_not_outweigh_many_samples() -> None:
    """In the tails, an error costs what the wider distribution gives: the ratio of the densities at 0, and a hundredth
    of the square. Elsewhere it costs what a normal distribution gives, and outputs add up."""
    white = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 2.0], [60.0, 0.0]])
    none, one, two, impact = loss(white)
    assert (none, one, two) == pytest.approx((0.0, 0.5, 2.5), abs=2e-3)
    assert impact == pytest.approx(np.log(WIDER / TAILS) + 0.5 * (60.0 / WIDER) ** 2, abs=2e-3)


def test_possible_noise_keeps_the_floor_that_is_added_to_a_known_noise() -> None:
    """Innovations of a roll that is known to a hundred-thousandth of a radian are taken for ten times that. When they
    were scaled with the innovations of the larger noise, they were smaller, and the model without the effect was more
    likely by hundreds of nats."""
    quiet = record("monocab", "multisine", hide=["gimbal_imbalance"], seed=61, duration=20.0)
    model = with_values(get("monocab_roll"), VEHICLE.parameters.values, VEHICLE.parameters.deviations)
    recordings = after_settling(model, [quiet], VEHICLE.support)
    model = ready(model, recordings)
    fitted = fit(problem(model, recordings, support=VEHICLE.support))
    moved = with_possible_noise(fitted)
    assert moved is not fitted
    errors = np.concatenate(moved.innovations())
    for place, each in enumerate(model.outputs):
        added = (FLOOR * each.noise) ** 2 if each.noise_known else 0.0
        assert moved.covariance[place, place] == pytest.approx(np.mean(errors[:, place] ** 2) + added, rel=1e-6)
