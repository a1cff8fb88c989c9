"""Effects that were found one after the other, looked for again beside each other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from thorough import of_many

from diagnosis.diagnose import Diagnosis, Finding, Verdict, diagnose
from diagnosis.evidence import SIGNIFICANT, beyond_chance
from diagnosis.fits.refit import full, log_ratio, t_ratio, with_effect
from diagnosis.prepare.workspace import Workspace
from diagnosis.search.explanation import Explanation, Search
from diagnosis.search.neighbours import merge, split, swap
from estimators.fit.result import inverse
from estimators.identify.run import with_values
from service.virtual.run import record
from vehicles.file import load
from vehicles.registry import nominal_model

VEHICLE = load("monocab")
MODEL = with_values(
    nominal_model("monocab").remove("static_torque"), VEHICLE.parameters.values, VEHICLE.parameters.deviations
)
DRAGS = ("viscous_friction", "coulomb_friction", "stribeck_friction", "quadratic_drag", "asymmetric_friction")


def found_in(*hide: str, candidates: tuple[str, ...] | None = None, duration: float = 20.0) -> Diagnosis:
    # Seed 31 took no part in any choice; 20 s are what the gate asks for with some to spare.
    recording = record("monocab", "multisine", hide=hide, seed=31, duration=duration)
    return diagnose(MODEL, [recording], support=VEHICLE.support, candidates=candidates)


@pytest.fixture(scope="module")
def two_drags() -> Diagnosis:
    """Quadratic drag and dry friction, each a few times what such a record would just show."""
    return found_in("coulomb_friction=0.04", "quadratic_drag=0.1", candidates=DRAGS)


class TestTwoDrags:
    def test_both_are_found_where_viscous_friction_explains_most_alone(self, two_drags: Diagnosis) -> None:
        found = two_drags
        assert found.verdict is Verdict.MISSING_EFFECT
        assert len(found.findings) == 2
        assert any({"quadratic_drag"} == {each.effect, *each.tied_with} for each in found.findings)
        assert any("coulomb_friction" in {each.effect, *each.tied_with} for each in found.findings)
        # What is shown step by step ends with both, whichever was found first.
        assert [len(each.model.effects) for each in found.steps] == [0, 1, 2]
        assert found.steps[-1].log_likelihood > found.steps[1].log_likelihood > found.steps[0].log_likelihood

    def test_each_is_told_with_its_size_beside_the_other(self, two_drags: Diagnosis) -> None:
        found = two_drags
        (drag,) = (each for each in found.findings if each.effect == "quadratic_drag")
        size = drag.parameters["quadratic_drag.coefficient"]
        assert size.value is not None
        assert size.std is not None
        # 0.1 of 5000 N m s^2/rad^2, to three standard deviations: bristles are not quite tanh.
        assert abs(size.value - 500.0) < 3.0 * size.std
        assert found.revised is not None
        assert found.revised.values["quadratic_drag.coefficient"] == size.value


def test_what_is_not_missing_beside_another_is_left_out() -> None:
    # Two thirds of the record are after the step: a constant torque explains most of it, alone.
    found = found_in("torque_step=0.02", candidates=("static_torque", "torque_step", "viscous_friction"))
    assert [each.effect for each in found.findings] == ["torque_step"]


def test_evidence_counts_the_further_parameters() -> None:
    recording = record("monocab", "multisine", hide=("viscous_friction=0.1",), seed=31, duration=20.0)
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, ("viscous_friction", "quadratic_drag"))
    base = full(MODEL, workspace)
    one = full(MODEL.add("viscous_friction"), workspace)
    two = full(MODEL.add("viscous_friction").add("quadratic_drag"), workspace)
    assert (base.count, one.count, two.count) == (0, 1, 2)
    assert beyond_chance(*log_ratio(one, base), len(workspace.candidates))
    # The second one is not there.
    assert not beyond_chance(*log_ratio(two, one), len(workspace.candidates))


def test_an_effect_that_is_made_of_two_is_taken_apart_into_what_they_are() -> None:
    """Friction that differs between the directions explains most of dry friction with a creeping torque, alone. 20 s
    do not tell the two from the one, by odds of 2; 30 s do, by millions."""
    candidates = ("coulomb_friction", "static_torque", "torque_drift", "asymmetric_friction")
    recording = record(
        "monocab", "multisine", hide=("coulomb_friction=0.03", "torque_drift=0.04"), seed=31, duration=30.0
    )
    one = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=("asymmetric_friction",))
    assert [each.effect for each in one.findings] == ["asymmetric_friction"]
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, candidates)
    told: list[str] = []
    how = Search(workspace, progress=lambda text, share: told.append(text))
    found = split(Explanation(one.findings, one.steps[-1]), how)
    assert "splitting asymmetric_friction in two" in told
    _are_dry_friction_and_a_creeping_torque(found.findings)
    # Looked for among all of them, the two are found without that.
    _are_dry_friction_and_a_creeping_torque(
        diagnose(MODEL, [recording], support=VEHICLE.support, candidates=candidates).findings
    )


def _are_dry_friction_and_a_creeping_torque(findings: Sequence[Finding]) -> None:
    names = [{each.effect, *each.tied_with} for each in findings]
    assert len(names) == 2
    assert any("coulomb_friction" in each and "torque_drift" not in each for each in names)
    assert any("torque_drift" in each and "coulomb_friction" not in each for each in names)


PARTS = ("coulomb_friction", "static_torque")


@pytest.mark.parametrize(
    ("hide", "together"),
    of_many(
        [(("asymmetric_friction=0.1",), True), (("coulomb_friction=0.03", "static_torque=0.02"), False)],
        (("asymmetric_friction=0.1",), True),
    ),
)
def test_two_are_put_together_where_one_that_is_made_of_them_does_as_well(
    hide: tuple[str, ...], together: bool
) -> None:
    """Both records look like dry friction and a torque to who knows no third."""
    recording = record("monocab", "multisine", hide=hide, seed=31, duration=30.0)
    two = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=PARTS)
    assert {each.effect for each in two.findings} == set(PARTS)
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, (*PARTS, "asymmetric_friction"))
    told: list[str] = []
    before = Explanation(two.findings, two.steps[-1])
    found = merge(before, Search(workspace, progress=lambda text, share: told.append(text)))
    assert len(told) == 1
    if not together:
        assert found is before
        return
    (asymmetric,) = found.findings
    assert [each.name for each in found.fit.model.effects] == [asymmetric.effect] == ["asymmetric_friction"]
    sizes = [asymmetric.parameters[f"asymmetric_friction.torque_{way}"].value for way in ("forward", "backward")]
    assert sizes[0] is not None
    assert sizes[1] is not None
    assert sizes[0] > sizes[1] > 0.0  # as it is hidden: a third, the other way


@pytest.mark.thorough
def test_what_explains_nearly_as_much_as_two_is_tied_with_the_one_that_is_like_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """As where the odds are for two: bristles keep their mean at rest, so that asymmetric friction looks like them."""
    recording = record("monocab", "multisine", hide=("asymmetric_friction=0.1",), seed=31, duration=30.0)
    two = diagnose(MODEL, [recording], support=VEHICLE.support, candidates=PARTS)
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, (*PARTS, "asymmetric_friction"))
    monkeypatch.setattr("diagnosis.search.neighbours.two_are_likelier", lambda *_: True)
    found = merge(Explanation(two.findings, two.steps[-1]), Search(workspace))
    assert {each.effect: each.tied_with for each in found.findings} == {
        each.effect: ("asymmetric_friction",) if each.effect == "coulomb_friction" else each.tied_with
        for each in two.findings
    }
    assert found.fit is two.steps[-1]


def test_looking_again_does_not_end_with_less_than_there_was(
    two_drags: Diagnosis, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A fit without an effect may end where no other helps, as the robot's did with a fifth of its lever arm."""
    last = two_drags.steps[-1]
    lost = replace(last, log_likelihood=last.log_likelihood - 1e3)
    recording = record(
        "monocab", "multisine", hide=("coulomb_friction=0.04", "quadratic_drag=0.1"), seed=31, duration=20.0
    )
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, DRAGS)
    monkeypatch.setattr("diagnosis.search.neighbours.remembered", lambda *_: lost)
    monkeypatch.setattr("diagnosis.search.neighbours.beyond_chance", lambda *_: False)
    monkeypatch.setattr("diagnosis.search.neighbours._again", lambda *_: None)
    before = Explanation(two_drags.findings, last)
    assert swap(before, Search(workspace)) is before


def test_the_size_of_an_effect_is_sure_though_its_shape_is_open() -> None:
    """20 s show no end of a creep of 45 s: where it settles is anything, that it creeps is beyond doubt."""
    recording = record("monocab", "multisine", hide=("torque_drift=0.1",), seed=31, duration=20.0)
    workspace = Workspace.of(MODEL, [recording], VEHICLE.support, ("torque_drift",))
    (candidate,) = workspace.candidates
    fitted = full(with_effect(MODEL, candidate, candidate.variants[0]), workspace, candidate)
    names = [each.name for each in fitted.fit.problem.parameters]
    place = names.index("torque_drift.torque")
    deviation = np.sqrt(inverse(fitted.fit.minimum.information)[place, place])
    assert abs(fitted.fit.minimum.common[place]) < SIGNIFICANT * deviation, "or this record tells where it settles"
    assert t_ratio(fitted, fitted.name) > 2.0 * SIGNIFICANT


def test_that_there_is_an_effect_is_sure_though_its_size_is_open() -> None:
    """All torques of the balancing robot are told together with the mass of its body, of which little is known."""
    vehicle = load("twsbr")
    model = with_values(nominal_model("twsbr"), vehicle.parameters.values, vehicle.parameters.deviations)
    model = model.change(estimated=[*(each.name for each in model.parameters if each.estimated), "body_mass"])
    recording = record("twsbr", "square", hide=("static_torque",), seed=31, duration=12.0)
    workspace = Workspace.of(model, [recording], vehicle.support, ("static_torque",))
    candidate = next(each for each in workspace.candidates if each.name == "static_torque")
    fitted = full(with_effect(model, candidate, candidate.variants[0]), workspace, candidate)
    names = [each.name for each in fitted.fit.problem.parameters]
    place = names.index("static_torque.torque")
    deviation = np.sqrt(inverse(fitted.fit.minimum.information)[place, place])
    assert abs(fitted.fit.minimum.common[place]) < 5.0 * deviation, "or this record tells the mass as well"
    assert t_ratio(fitted, fitted.name) > 50.0
