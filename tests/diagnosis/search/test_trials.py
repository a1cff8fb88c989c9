"""A candidate whose fits fail is excluded: the verdict is the same as without it, and the reason is reported."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from thorough import of_many

from benchmarks.free_decays import Body
from upright.diagnosis.diagnose import Diagnosis, Verdict, diagnose
from upright.diagnosis.trial import tried
from upright.estimators.contract import EstimationError
from upright.models.effect import Effect, EffectParameter, Family
from upright.models.parts import Place

pytestmark = pytest.mark.timeout(300)

OTHERS = ("coulomb_friction", "viscous_friction", "static_torque")
BODY = Body(dry=0.012, viscous=0.001)


def pushing(name: str, force: str) -> Effect:
    return Effect(
        name=name,
        family=Family.STRUCTURE,
        title=name,
        place=Place.JOINT,
        equation=force,
        parameters=(EffectParameter("size", "N m", "of it", amplitude=True, scale="force_scale"),),
        signature="none",
        confused_with=("coulomb_friction",),
        separated_by="nothing",
        force=force,
    )


DIVERGES = {
    "a_blow_up": "size * exp(60 * rate**2)",
    "no_number": "size * log(-1 - rate**2)",
    # To the score test it is a drag, but no step of a fit from there has a finite value.
    "a_trap": "size * rate * exp(1e9 * size**2)",
}
DIVERGED = "1e6 * size * rate**3"


@cache
def verdict(*further: str) -> Diagnosis:
    return diagnose(
        BODY.model(1e-3, 0.3),
        [BODY.by_encoder(4096)],
        candidates=(*OTHERS, *(pushing(each, DIVERGES[each]) for each in further)),
    )


@pytest.mark.parametrize("name", of_many(DIVERGES, "a_trap", "no_number"))
def test_verdict_does_not_change_with_a_candidate_that_always_diverges(name: str) -> None:
    without, beside = verdict(), verdict(name)
    assert without.verdict is Verdict.MISSING_EFFECT, without.reason
    assert beside.verdict is without.verdict, beside.reason
    assert [each.effect for each in beside.findings] == [each.effect for each in without.findings]
    for one, other in zip(beside.findings, without.findings, strict=True):
        for parameter, estimate in other.parameters.items():
            assert one.parameters[parameter].value == pytest.approx(estimate.value, rel=0.05)
    assert name in beside.to_json()["not_candidates"]


@pytest.mark.parametrize("error", [ArithmeticError("a"), np.linalg.LinAlgError("a"), FloatingPointError("a")])
def test_failed_fit_reports_its_reason(error: Exception) -> None:
    def fails() -> None:
        raise error

    failed: dict[str, str] = {}
    assert tried(fails, "an_effect", failed) is None
    assert failed == {"an_effect": "its fit fails: a"}
    assert tried(lambda: 1, "an_effect", failed) == 1
    assert failed == {}


def test_crossing_bounds_fail_one_trial_but_a_programming_error_is_raised() -> None:
    def crossing() -> None:
        raise EstimationError("parameter a", "its bounds cross", remedy="mend them.")

    def mistaken() -> None:
        raise TypeError

    assert tried(crossing) is None
    with pytest.raises(TypeError):
        tried(mistaken)


def test_model_that_diverges_by_itself_is_reported_as_diverging() -> None:
    model = BODY.model(1e-3, 0.3).add(pushing("a_runaway", DIVERGED)).change({"a_runaway.size": 1.0})
    held = model.change(estimated=[each.name for each in model.base_parameters if each.estimated])
    found = diagnose(held, [BODY.by_encoder(4096)], candidates=OTHERS)
    assert found.verdict is Verdict.UNKNOWN
    assert "diverges" in found.reason
